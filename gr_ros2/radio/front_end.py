"""What a link asks of a front end: a place to put samples, a place samples come from, and how long a packet takes.

Invariants: a front end is opened when it is made, so that a wrong device or address is an error at once and not later
in a thread; `close` gives everything back and may be called twice; whatever it loses it counts in `counters`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, Any, ClassVar

from pydantic import Field
from pydantic.dataclasses import dataclass

from gr_ros2.config import STRICT, Seconds, build
from gr_ros2.errors import ConfigError
from gr_ros2.phy import Phy

AGAIN_MS = 1
"""ms after which GNU Radio calls a source again that had nothing to give; otherwise it waits 250."""
Hertz = Annotated[float, Field(gt=0, allow_inf_nan=False)]


@dataclass(frozen=True, kw_only=True, config=STRICT)
class FrontEndOptions:
    """What every front end takes.

    :param guard_s: s of silence after each packet
    """

    guard_s: Annotated[Seconds, Field(title="Silence after a packet (s)")] = 0.0


class FrontEnd(ABC):
    """One robot's way to the air.

    :param phy: whose samples it carries, at its sample rate
    :param options: fields of ``Options``
    :raises ConfigError: for an option that is unknown or out of range, or a PHY without samples
    :raises RadioError: when the device, address or file cannot be opened
    """

    name: ClassVar[str]
    Options: ClassVar[type[FrontEndOptions]] = FrontEndOptions
    has_radio: ClassVar[bool] = False
    """Whether the channel is a real one, which no setting can impair."""
    loops_back: ClassVar[bool] = False
    """Whether a robot hears itself as if it were another."""
    any_length: ClassVar[bool] = False
    """Whether bursts may be of different lengths; else each is as long as the longest, and packets with it."""
    refuses: ClassVar[frozenset[str]] = frozenset()
    """Options of its base that it cannot have, and GRC does not offer."""

    def __init__(self, phy: Phy, **options: Any) -> None:
        self.options: Any = build(self.Options, options, f"front_end {self.name}")
        if not phy.has_samples and not self.loops_back:
            raise ConfigError(
                f"front_end {self.name}: phy {phy.name} has no samples to carry; choose another phy, or front_end sim"
            )
        if not self.any_length:
            phy.pad_all()
        self.phy = phy

    @property
    @abstractmethod
    def sink(self) -> Any:
        """Block that takes the transmitter's samples; None where the transmitter is not connected."""

    @property
    @abstractmethod
    def source(self) -> Any:
        """Block that gives the samples received; None where nothing is received."""

    def wire(self, graph: Any) -> None:  # noqa: B027 - most are one block each way
        """Connect what lies behind ``sink`` and before ``source`` in a flowgraph."""

    @property
    def receive_frequency(self) -> float | None:
        """Hz at which it receives; None where there is no radio."""
        return None

    def airtime(self, packet_len: int | None = None) -> float:
        """s from the start of one packet to the earliest start of the next.

        :param packet_len: its bytes, None = those of the longest
        """
        return self.phy.airtime(packet_len) + float(self.options.guard_s)

    def early(self) -> float:
        """s before its airtime is over at which a packet has to come: 0 where samples need no time to pass."""
        return 0.0

    @property
    def ends(self) -> bool:
        """Whether what is received comes to an end by itself, as a recording does."""
        return False

    @property
    def finished(self) -> bool:
        """Whether nothing will ever be received any more, as at the end of a recording."""
        return False

    def check(self, now: float) -> None:  # noqa: B027 - most have nothing that can break
        """To be called now and then while the flowgraph runs.

        :param now: s, monotonic
        :raises RadioError: when the device has gone silent
        """

    def counters(self) -> dict[str, int]:
        """What was lost or refused here, and what came and went, by name."""
        return {}

    def close(self) -> None:  # noqa: B027 - most have nothing to give back
        """Give back device, sockets and files. The flowgraph has stopped."""
