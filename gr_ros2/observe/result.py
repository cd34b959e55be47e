"""What a run found out about its topics, as values.

Invariant: a number that does not apply is None, never NaN and never invented.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field
from typing import Annotated, Protocol

from pydantic import ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

READ = ConfigDict(extra="ignore")
"""Keys of later versions are ignored."""
Count = Annotated[int, Field(ge=0)]
Number = Annotated[float, Field(allow_inf_nan=False)]


@dataclass(frozen=True, config=READ)
class LatencyResult:
    """s; see :class:`gr_ros2.observe.latency.Latency`."""

    p50: Number | None = None
    p95: Number | None = None
    p99: Number | None = None
    max: Number | None = None


@dataclass(frozen=True, config=READ)
class AgeResult:
    """s; see :class:`gr_ros2_lab.record.metrics.Age`."""

    mean: Number | None = None
    peak: Number | None = None


@dataclass(frozen=True, config=READ)
class TopicResult:
    """One topic of one source.

    :param topic: absolute name at the source
    :param latency_clock: submit, stamp_wall or stamp_sim; None where there is no latency
    :param path_error_m: mean distance of the paths along their length, None where the type has no position
    :param rms_error_m: RMS distance at equal times, likewise
    :param sent: messages for this link: handed to the source, or lost before by its ROS graph (``lost_on_graph``)
    :param ledger: fate -> messages; the fates add up to ``sent``
    :param hops: robots that have sent a message on -> messages delivered; they add up to ``delivered``
    :param left_out_sent, left_out_received: messages sent, and messages received, that are left out of the path and of
        its errors: their position is not finite, is beyond 1e9 m, or cannot be read
    :param corrupt: deliveries that match no message sent; a number above 0 indicates a serious fault
    :param repeats_delivered: deliveries of repeats; they are not counted in any other number
    :param latency_cdf_s: the latencies at 0 %, 1 %, … 100 %, empty where nothing was delivered
    """

    topic: str
    type: str
    src_id: int
    sent: Count
    delivered: Count
    pdr: Number | None
    goodput_Bps: Number | None
    latency_s: LatencyResult
    latency_clock: str | None
    age_s: AgeResult
    path_error_m: Number | None
    ledger: dict[str, Count]
    hops: dict[str, Count] = field(default_factory=dict)
    rms_error_m: Number | None = None
    left_out_sent: Count = 0
    left_out_received: Count = 0
    corrupt: Count = 0
    repeats_delivered: Count = 0
    negative_latencies: Count = 0
    latency_cdf_s: tuple[Number, ...] = ()

    @model_validator(mode="after")
    def _adds_up(self) -> TopicResult:
        if sum(self.ledger.values()) != self.sent:
            raise ValueError(f"ledger fates add up to {sum(self.ledger.values())}, sent are {self.sent}")
        return self


class RunResult(Protocol):
    """The part of a result that an observer may ask for.

    :ivar duration_s: s during which messages were submitted
    """

    @property
    def duration_s(self) -> float: ...
    @property
    def topics(self) -> Sequence[TopicResult]: ...
