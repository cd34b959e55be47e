"""The interface of a physical layer: packets in, packets out, and the airtime of a packet.

A PHY with samples gives two GNU Radio hier blocks, `transmitter` (message port `pdus` in, complex stream out)
and `receiver` (complex stream in, message port `pdus` out). The PHYs `direct` and `modem` have no samples: their
packets cross as messages. Invariant: the airtime of a packet depends on its length alone.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, get_args

import numpy as np
import numpy.typing as npt
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from gr_ros2.core.errors import ConfigError, PhyError
from gr_ros2.link.rate import Mcs
from gr_ros2.settings.config import ChannelConfig, Kernels, build

if TYPE_CHECKING:
    from gr_ros2.phy.burst import BurstModem  # with GNU Radio

Samples = npt.NDArray[np.complex64]
LENGTH_TAG = "burst_len"
"""Tag on the first sample of a burst: the number of its samples. With ``tx_sob`` and ``tx_eob`` instead,
``uhd.usrp_sink`` would begin a burst of its own at its start. That burst can damage our first two (gnuradio#1944)."""


class PacketTransmitter(Protocol):
    """A GNU Radio block: message port `pdus` in, one complex stream out.

    :class:`gr_ros2.phy.flowgraph.TransmitterBlock` is the base class in this package.
    """

    @property
    def refused(self) -> int:
        """PDUs that were not a packet of the right length, as far as the PHY reports them."""

    def packets_sent(self) -> int:
        """Packets that have left it as samples."""

    def release(self) -> None:
        """Release everything inside. The flowgraph has stopped, or never ran. Idempotent."""


class SymbolSource(Protocol):
    """A source of the symbols from which packets are decoded, or of samples, for display."""

    def samples(self) -> Samples | None:
        """The newest, None before the first packet."""


class PacketReceiver(Protocol):
    """A GNU Radio block: one complex stream in, message port `pdus` out.

    :class:`gr_ros2.phy.flowgraph.ReceiverBlock` is the base class in this package.
    """

    @property
    def damaged(self) -> int:
        """Packets received with errors, as far as the PHY reports them."""

    @property
    def foreign(self) -> int:
        """Whole frames of other networks or of other uses, dropped; 0 where the PHY cannot tell them."""

    @property
    def snr_db(self) -> float | None:
        """SNR of the newest packets, dB over the sampled band; None before the first, or if the PHY does not measure
        it."""

    def follow_clock(self, offset: Callable[[], float]) -> None:
        """Take the times in tags ``rx_time`` of the stream.

        :param offset: returns s to add to them for the machine's monotonic clock
        """

    def tap_symbols(self) -> SymbolSource | None:
        """Make the decoded symbols visible; None if the PHY cannot. Call it once, before the start."""

    def release(self) -> None:
        """Release everything inside. The flowgraph has stopped, or never ran. Idempotent."""


class BurstCarrier(Protocol):
    """What carries bursts."""

    def send(self, samples: Samples, at: float | None) -> None:
        """Send a burst and its gap.

        :param samples: may be used again after the call
        :param at: s, monotonic, when it begins; None where nothing says so
        """

    def listen(self, take: Callable[[Samples, float | None], None] | None) -> None:
        """Call a function with each burst that comes, and when it began as far as that is known; None: no more."""


class PacketTransceiver(PacketTransmitter, PacketReceiver, Protocol):
    """A GNU Radio block: message ports `pdus` in and out, around a :class:`BurstCarrier`.

    :ivar channel: what becomes of received samples, before the receiver; None: nothing
    """

    channel: Callable[[Samples], Samples] | None

    def tap_samples(self, size: int) -> SymbolSource:
        """Make the newest samples received visible, behind the channel."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class PhyOptions:
    """Options of a PHY that has no settings except packet length and sample rate."""


class Phy(ABC):
    """One physical layer at one packet length and sample rate.

    :param packet_len: bytes of the longest packet, 14..4095
    :param sample_rate: samples/s of the complex stream; ignored where ``has_samples`` is False
    :param kernels: what processes the samples: ``auto`` = compiled kernels where they exist, or ``numpy``
    :param options: fields of ``Options``
    :raises ConfigError: for an option that is unknown or out of range, a sample rate that is not above 0 where one is
        needed, or kernels that do not exist
    """

    name: ClassVar[str]
    has_samples: ClassVar[bool] = True
    has_airtime: ClassVar[bool] = True
    """Whether a packet takes time on the air."""
    Options: ClassVar[type[Any]] = PhyOptions
    """A frozen dataclass: the settings of this PHY, each with a default."""

    def __init__(self, packet_len: int, sample_rate: float, *, kernels: Kernels = "auto", **options: Any) -> None:
        self.options: Any = build(self.Options, options, f"phy {self.name}")
        if self.has_samples and not sample_rate > 0:
            raise ConfigError(f"phy {self.name}: sample_rate = {sample_rate}: must be above 0 samples/s")
        if kernels not in get_args(Kernels):
            raise ConfigError(f"phy {self.name}: kernels = {kernels!r}: write {' or '.join(get_args(Kernels))}")
        self.kernels = kernels
        self.packet_len = packet_len
        self.sample_rate = sample_rate

    @property
    def any_length(self) -> bool:
        """Whether packets may be shorter than ``packet_len``, and then take less airtime.

        The transmitter then tags each burst with its samples, gap included (:data:`LENGTH_TAG`).
        """
        return False

    def pad_all(self) -> None:  # noqa: B027 - most PHYs have nothing to do
        """From now on :attr:`any_length` is False. Needed where all bursts must have the same length."""

    @property
    def mcs_table(self) -> tuple[Mcs, ...]:
        return ()

    @property
    def rates(self) -> tuple[Phy, ...]:
        """The PHY of each MCS, with its rate fixed; this PHY alone where the rate is fixed."""
        return (self,)

    def on_mcs(self, mcs: int) -> Phy:
        """The PHY of an MCS by its index; that of the most robust one for an index of other settings."""
        rates = self.rates
        return rates[mcs if 0 <= mcs < len(rates) else 0]

    @abstractmethod
    def airtime_samples(self, packet_len: int | None = None) -> int:
        """Samples one packet occupies on the air, gap included; 0 for a PHY without samples.

        :param packet_len: its bytes, None = the longest; ignored if :attr:`any_length` is False
        """

    def airtime(self, packet_len: int | None = None, mcs: int = 0) -> float:
        """Seconds one packet occupies on the air, gap included.

        :param packet_len: its bytes, as in :meth:`airtime_samples`
        :param mcs: see :meth:`on_mcs`
        """
        return self.on_mcs(mcs).airtime_samples(packet_len) / self.sample_rate if self.has_samples else 0.0

    @abstractmethod
    def burst_power(self) -> float:
        """Mean of the squared magnitude of the longest packet's samples, gap excluded; 0 for a PHY without samples."""

    def computed_pdr(self, snr_db: float) -> float:  # noqa: ARG002
        """Share of the longest packets an ideal receiver would deliver in white noise, 0..1.

        1 for a PHY without samples.

        :param snr_db: mean burst power over noise power in the sampled band, dB
        """
        return 1.0

    def check_channel(self, channel: ChannelConfig) -> None:
        """Refuse channel settings that this PHY cannot apply.

        :raises ConfigError: for a setting that acts on samples if there are none, or a Doppler shift too large for the
            sample rate; names it
        """
        sampled = channel.on_samples()
        if sampled and not self.has_samples:
            name, value = next(iter(sampled.items()))
            raise ConfigError(
                f"channel.{name} = {value!r}: phy {self.name} has no samples for it to act on; leave it out, or choose "
                "another phy"
            )
        if self.has_samples and channel.doppler_hz > self.sample_rate / 2:
            raise ConfigError(
                f"channel.doppler_hz = {channel.doppler_hz:g}: phy {self.name} has {self.sample_rate:g} samples/s; "
                f"at most {self.sample_rate / 2:g}"
            )

    @property
    def burst_modem(self) -> BurstModem | None:
        """What turns packets into samples and back without a flowgraph; None where GNU Radio's blocks do."""
        return None

    @property
    def lag(self) -> int:
        """Samples from the end of a burst, as sent, to where the modem says that it ends, behind its filter."""
        return 0

    @property
    def receiver_taps(self) -> Any:
        """The filter in front of the modem; None = no filter."""
        return None

    def runs_on(self) -> str:
        """What processes the samples, in a few words; '' for a PHY without samples."""
        return ""

    def leaves_tags(self) -> bool:
        """Whether the transmitter's samples carry tags, which a receiver in the same flowgraph must not see."""
        return False

    def prefer_latency(self) -> None:  # noqa: B027 - most PHYs have nothing to do
        """Called when a flowgraph with this PHY runs in real time: prefer latency to throughput where that helps."""

    @abstractmethod
    def transmitter(self) -> PacketTransmitter:
        """A fresh hier block: message port `pdus` in, one complex stream out.

        :raises PhyError: for a PHY without samples
        """

    @abstractmethod
    def receiver(self) -> PacketReceiver:
        """A fresh hier block: one complex stream in, message port `pdus` out.

        :raises PhyError: for a PHY without samples
        """

    def transceiver(self, carrier: BurstCarrier) -> PacketTransceiver | None:  # noqa: ARG002
        """A fresh block in place of both, without streams; None where GNU Radio's blocks process the samples."""
        return None


class PacketPhy(Phy):
    """A PHY without samples: its packets cross as messages.

    :param sample_rate: ignored
    """

    has_samples = False
    crossing: ClassVar[str]
    """How packets cross instead, for errors."""

    def __init__(self, packet_len: int, sample_rate: float = 0.0, **options: Any) -> None:
        super().__init__(packet_len, sample_rate, **options)

    def airtime_samples(self, packet_len: int | None = None) -> int:  # noqa: ARG002
        return 0

    def burst_power(self) -> float:
        return 0.0

    def transmitter(self) -> PacketTransmitter:
        raise PhyError(f"phy {self.name} has no transmitter; {self.crossing}")

    def receiver(self) -> PacketReceiver:
        raise PhyError(f"phy {self.name} has no receiver; {self.crossing}")
