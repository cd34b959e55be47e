"""The values that the page draws.

Invariant: a number that does not apply is None, as in ``result.json``. No value here grows with the length of a run.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from gr_ros2.core.arrays import Floats
from gr_ros2.dashboard.windows import Point
from gr_ros2.link.clocks import ClockOffset
from gr_ros2.observe.latency import Latency
from gr_ros2.observe.team import TeamView
from gr_ros2.wire import Packet

SILENT_S = 5.0
"""s without a packet after which a link is down, and what was received is old."""
GOOD = 0.9
"""Share of a topic's messages delivered in the last seconds, below which the link is degraded."""


@dataclass(frozen=True)
class TopicView:
    """One topic of one source.

    :param colour: place in the palette
    :param pdr: delivered / sent of the whole run
    :param pdr_now: deliveries per submission in the last seconds; above 1 while a backlog arrives
    :param goodput_Bps: delivered bytes / duration of the whole run, B/s
    :param goodput_now_Bps: the same for the last seconds, B/s
    :param latency_s: latency of the last deliveries; of all deliveries when the run is over
    :param latency_cdf_s: quantiles of the same latencies, at 0 %, 1 %, … 100 %
    :param age_now_s: s since the newest delivered message was submitted
    :param queued: messages waiting at the source
    :param ledger: fate -> messages; the fates add up to ``sent``
    """

    name: str
    type_name: str
    src_id: int
    topic_id: int
    colour: int
    sent: int
    delivered: int
    pdr: float | None
    pdr_now: float | None
    goodput_Bps: float | None
    goodput_now_Bps: float
    latency_s: Latency | None
    latency_cdf_s: tuple[float, ...]
    age_now_s: float | None
    age_mean_s: float | None
    age_peak_s: float | None
    queued: int | None
    ledger: Mapping[str, int]
    path_error_m: float | None = None
    rms_error_m: float | None = None

    @property
    def goes(self) -> bool:
        """Whether it is known how much is sent: not what other robots send."""
        return bool(self.sent or not self.delivered)

    @property
    def comes(self) -> bool:
        """Whether it is known how much arrives: not at others."""
        return bool(self.delivered or self.pdr is not None or not self.sent)


@dataclass(frozen=True)
class PathView:
    """A topic that carries positions: both paths, m, and the error between them, m over s since the start."""

    name: str
    colour: int
    sent_x: Floats
    sent_y: Floats
    received_x: Floats
    received_y: Floats
    truth: Point | None
    belief: Point | None
    error_m: float | None
    error_t: Floats
    errors_m: Floats


@dataclass(frozen=True)
class PictureView:
    """The newest picture of a camera, or the newest map.

    :param pixels: RGBA in 32 bits each, the lowest row first
    :param age_s: s since it was made
    :param frozen: it is a picture of a camera and old, and therefore grey
    :param place: left, bottom, width and height: of a map in m
    """

    name: str
    pixels: npt.NDArray[np.uint32]
    age_s: float
    frozen: bool
    place: tuple[float, float, float, float]
    is_map: bool = False

    @property
    def words(self) -> str:
        """Its name and age."""
        return f"{self.name}: {'frozen, ' if self.frozen else ''}{self.age_s:.1f} s old"


@dataclass(frozen=True)
class SeriesView:
    """One topic's numbers over time; NaN where one does not apply. Times are s since the start."""

    name: str
    colour: int
    t: Floats
    pdr: Floats
    goodput_Bps: Floats
    age_s: Floats
    queued: Floats


@dataclass(frozen=True)
class SpanView:
    """A part of a packet's bytes.

    :param kind: head, ids, entry, pad or crc
    :param size: bytes
    :param text: description of the bytes; '' if there is none
    :param colour: place of an entry's topic in the palette
    """

    kind: str
    size: int
    text: str = ""
    colour: int = 0


@dataclass(frozen=True)
class PacketView:
    """One packet as the sink got it.

    :param t: s since the start
    :param packet: None where it is not a valid one
    :param refused: why it is not, '' if it is valid
    :param spans: the parts of the packet, in the order of its bytes
    :param missing: packets of this source that are missing between the one shown before and this one
    """

    t: float
    size: int
    packet: Packet | None = None
    refused: str = ""
    spans: tuple[SpanView, ...] = ()
    missing: int = 0


@dataclass(frozen=True)
class RobotView:
    """A robot that was heard.

    :param silent_s: s since its newest packet, or since something of it came over others
    :param packets: received of it
    :param hops: robots that have sent its newest message on
    :param over: the last of them; None where it is heard itself
    :param clock: its clock beside this computer's; None where it is not known
    """

    src_id: int
    silent_s: float
    packets: int
    hops: int = 0
    over: int | None = None
    clock: ClockOffset | None = None


@dataclass(frozen=True)
class AirView:
    """The air over time: share of it that packets of each kind took, and the SNR received. Times are s since the start.

    :param busy: by kind of packet; {} for a PHY that takes no air
    :param snr_db: NaN where nothing arrived
    :param lost: share of the packets that were lost on the way, by their numbers, 0..1; NaN where nothing arrived
    :param changes: when somebody changed the channel, s since the start
    """

    t: Floats
    busy: Mapping[str, Floats]
    snr_db: Floats
    lost: Floats
    changes: tuple[float, ...] = ()


@dataclass(frozen=True)
class Snapshot:
    """A link at one moment.

    :param phase: waiting, running, ended (result is in) or failed
    :param elapsed_s: s since the first message
    :param packets: sent, received and each refusal by name; if not all carried new messages, also ``air_new``,
        ``air_repair``, ``air_report`` and ``air_hello``: those sent, by what they were for
    :param packets_now: packets/s sent and received in the last seconds
    :param lost_now: share of the packets of the last seconds that were lost on the way; None where none arrived
    :param silent_s: s since the newest packet; None before the first
    :param state: of the link now: up, degraded, down, or late where the computer does not keep up; '' before and after
    :param alarms: what is wrong now, a sentence each
    """

    phase: str = "waiting"
    name: str = ""
    elapsed_s: float = 0.0
    duration_s: float = 0.0
    sent: int = 0
    delivered: int = 0
    topics: tuple[TopicView, ...] = ()
    series: tuple[SeriesView, ...] = ()
    paths: tuple[PathView, ...] = ()
    pictures: tuple[PictureView, ...] = ()
    last_packets: tuple[PacketView, ...] = ()
    packets: Mapping[str, int] = field(default_factory=dict)
    packets_now: tuple[float, float] = (0.0, 0.0)
    lost_now: float | None = None
    silent_s: float | None = None
    state: str = ""
    alarms: tuple[str, ...] = ()
    heard: tuple[RobotView, ...] = ()
    air: AirView | None = None
    team: TeamView | None = None

    def in_fate(self, fate: str) -> int:
        """Messages with this fate, over all topics."""
        return sum(topic.ledger.get(fate, 0) for topic in self.topics)

    @property
    def verdict(self) -> str:
        """The state of the link now, or after the run what its messages say: up, degraded or down."""
        return self.state if self.phase != "ended" else self.delivery or self.state

    @property
    def delivery(self) -> str:
        """What the share delivered says: up, degraded or down, however slow the computer is; '' where it is unknown,
        or has become good again."""
        if self.pdr is None:
            return ""
        if self.state == "down" or not self.pdr:
            return "down"
        return "up" if self.pdr >= GOOD else "" if self.state == "up" else "degraded"

    @property
    def old(self) -> bool:
        """Whether what was received last is old."""
        return self.silent_s is not None and self.silent_s > SILENT_S

    @property
    def oldest(self) -> TopicView | None:
        """The topic whose newest delivered message is the oldest, of those that come again and again."""
        again = [topic for topic in self.topics if topic.age_now_s is not None and topic.delivered > 1]
        return max(again, key=lambda topic: topic.age_now_s or 0.0, default=None)

    @property
    def busy_now(self) -> float | None:
        """Share of the air that packets of all kinds took since the picture before; None where they take none."""
        if self.air is None or not self.air.busy or not len(self.air.t):
            return None
        return float(sum(busy[-1] for busy in self.air.busy.values()))

    @property
    def pdr(self) -> float | None:
        """Delivered / sent, over all topics of which both are known."""
        known = [topic for topic in self.topics if topic.pdr is not None]
        sent = sum(topic.sent for topic in known)
        return sum(topic.delivered for topic in known) / sent if sent else None
