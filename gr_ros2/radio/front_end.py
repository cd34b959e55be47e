"""The interface of a front end: a block that takes samples, a block that gives samples, and the time of a packet.

A front end for a device with a modulation of its own has one block that takes and gives packets instead.

Invariants: the constructor opens the front end, so that a wrong device or address is an error at once and not later in
a thread. `close` releases everything and may be called twice. `counters` counts everything that is lost.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Annotated, Any, ClassVar, NamedTuple

from pydantic import Field
from pydantic.dataclasses import dataclass

from gr_ros2.core.errors import ConfigError
from gr_ros2.phy import Phy
from gr_ros2.phy.base import BurstCarrier
from gr_ros2.settings.config import STRICT, Seconds, build

AGAIN_MS = 1
"""Time after which GNU Radio calls a source without data again, ms; its default is 250 ms."""
Hertz = Annotated[float, Field(gt=0, allow_inf_nan=False)]


@dataclass(frozen=True, kw_only=True, config=STRICT)
class FrontEndOptions:
    """What every front end takes."""

    guard_s: Annotated[Seconds, Field(title="Silence after a packet (s)")] = 0.0
    """s of silence after each packet"""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class SharedAir(FrontEndOptions):
    """What a front end takes that may have one channel for both directions."""

    half_duplex: bool = False
    """nothing can be received while something is sent"""


class FrontEndCounters(NamedTuple):
    """Counters of a front end, by name.

    :ivar passed: no trouble: what was sent and received, what others sent, and what is not received by design
    :ivar lost: what was lost or refused, which should not grow
    """

    passed: dict[str, int]
    lost: dict[str, int]


class FrontEnd(ABC):
    """The connection of one robot to the air.

    :param phy: PHY whose samples it carries, at its sample rate
    :param transmits: whether it may send; if not, no transmitter is opened
    :param options: fields of ``Options``
    :raises ConfigError: for an option that is unknown or out of range, or a PHY without samples
    :raises RadioError: when the device, address or file cannot be opened
    """

    name: ClassVar[str]
    Options: ClassVar[type[FrontEndOptions]] = FrontEndOptions
    has_radio: ClassVar[bool] = False
    """Whether the channel is a real one. Settings cannot impair a real channel."""
    loops_back: ClassVar[bool] = False
    """Whether a robot receives its own packets as if another robot had sent them."""
    any_length: ClassVar[bool] = False
    """Whether bursts may have different lengths. If not, all bursts and packets are as long as the longest."""
    carries_packets: ClassVar[bool] = False
    """Whether it carries packets and not samples, because the device behind it modulates them itself."""
    hears_always: ClassVar[bool] = True
    """Whether its samples, where it has some, are those of all the time, and not of bursts alone."""
    may_return: ClassVar[bool] = False
    """Whether a device that has vanished can be opened again in this process."""
    find_with: ClassVar[str] = ""
    """Command that lists the devices present, for errors and `gr-ros2 doctor`; '' = there is none."""
    timing_error_s: float = 0.01
    """s by which a burst may begin later than asked, and by which the time of a received burst may be wrong. Medium
    access keeps as much silence between the packets of two robots."""
    refuses: ClassVar[frozenset[str]] = frozenset()
    """Options of its base class that it does not support. GRC does not offer them."""

    def __init__(self, phy: Phy, *, transmits: bool = True, **options: Any) -> None:
        self.options: Any = build(self.Options, options, f"front_end {self.name}")
        if not self.carries(type(phy)):
            raise ConfigError(
                f"front_end {self.name}: takes packets for a modem of a known bit rate, which phy {phy.name} does not "
                "have; set phy to {name: modem, options: {bit_rate: …}}"
                if self.carries_packets
                else f"front_end {self.name}: phy {phy.name} has no samples to carry; choose another phy, or front_end "
                "sim"
            )
        if not self.any_length:
            phy.pad_all()
        self.phy, self.transmits = phy, transmits

    @classmethod
    def carries(cls, phy: type[Phy]) -> bool:
        """Whether it works with a PHY."""
        if cls.carries_packets:
            return phy.has_airtime and not phy.has_samples
        return phy.has_samples or cls.loops_back

    @classmethod
    def asks(cls, options: Mapping[str, Any]) -> bool:  # noqa: ARG003 - most do so in any case, or never
        """Whether it sends only with a person's word, and with a key: where a transmitter is on the air."""
        return cls.has_radio

    @classmethod
    def on_air(cls, options: Mapping[str, Any]) -> str:  # noqa: ARG003 - the radio knows, and does not tell
        """Where and how loud it sends with these settings, as far as that is known here, in a few words.

        :raises ConfigError: for a setting that it needs to say so, and that is missing or wrong
        """
        return "at the frequency and power that the radio is set to"

    @property
    @abstractmethod
    def sink(self) -> Any:
        """Block that takes the transmitter's samples; None if the transmitter is not connected."""

    @property
    @abstractmethod
    def source(self) -> Any:
        """Block that gives the received samples; None if nothing is received."""

    @property
    def packets(self) -> Any:
        """Block with message ports `pdus` in and out that carries packets; None if it carries samples."""
        return None

    @property
    def bursts(self) -> BurstCarrier | None:
        """What carries each burst as a whole, without ``sink`` and ``source``; None if it needs streams."""
        return None

    def wire(self, graph: Any) -> None:  # noqa: B027 - most have one block in each direction
        """Connect the blocks after ``sink`` and before ``source`` in a flowgraph."""

    @property
    def receive_frequency(self) -> float | None:
        """Frequency at which it receives, Hz; None if there is no radio."""
        return None

    @property
    def rssi_dbm(self) -> int | None:
        """Strength of the newest packet received, dBm; None if the device does not tell it."""
        return None

    @property
    def busy(self) -> Callable[[], bool] | None:
        """Returns whether somebody else sends now; None where the receiver measures no power at the frequency at which
        this robot sends, or hears itself."""
        return None

    @property
    def ready(self) -> Callable[[], bool] | None:
        """Returns whether the device is there; packets wait for it. None where it always is, or its absence ends the
        flowgraph."""
        return None

    def airtime(self, packet_len: int | None = None, mcs: int = 0) -> float:
        """Time from the start of one packet to the earliest start of the next, s.

        :param packet_len: length of the packet, bytes; None: that of the longest
        :param mcs: with an adaptive rate, the MCS that it is sent with
        """
        return self.airtime_with(self.phy, self.options, packet_len, mcs)

    @classmethod
    def airtime_with(cls, phy: Phy, chosen: Any, packet_len: int | None = None, mcs: int = 0) -> float:
        """What :meth:`airtime` says where a front end has these options, without one that is open.

        :param chosen: an object of ``Options``
        """
        return phy.airtime(packet_len, mcs) + float(chosen.guard_s)

    def ahead(self) -> float | None:
        """How long before the begin of its airtime a packet must arrive, s. None if samples take no time to pass: a
        packet then arrives when its airtime is over."""
        return None

    @property
    def clock(self) -> Callable[[], float]:
        """The clock of the link, s, monotonic."""
        return time.monotonic

    def follow(self, passed: Callable[[], int | None]) -> None:  # noqa: B027 - only a simulated clock needs it
        """Learn how many packets have passed to this front end; None while one should pass now."""

    @property
    def clock_offset(self) -> Callable[[], float] | None:
        """A function that returns the s to add to the clock of the device, which tags what it receives and sends at a
        time, for the machine's monotonic clock. None where the device has no clock."""
        return None

    @property
    def finished(self) -> bool:
        """Whether nothing more will be received, as at the end of a recording."""
        return False

    def check(self, now: float) -> None:  # noqa: B027 - most have nothing that can break
        """Check the device. Call this from time to time while the flowgraph runs.

        :param now: s, monotonic
        :raises RadioError: when the device gives or takes no more samples
        """

    def counters(self) -> FrontEndCounters:
        """What passed and what was lost here."""
        return FrontEndCounters({}, {})

    def drain(self, packets: int) -> None:  # noqa: B027 - a radio that is stopped is silent at once
        """Wait until all packets that have passed to it are where they have to be; the flowgraph stops next.

        :param packets: their number
        """

    def close(self) -> None:  # noqa: B027 - most have nothing to release
        """Release device, sockets and files. The flowgraph must have stopped."""
