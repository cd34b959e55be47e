"""GNU Radio blocks around a burst modem: PDUs in, samples out, and back, as streams or as whole bursts.

Invariants: a PDU that is not a packet of an allowed length is counted and dropped, never sent; each burst is sent at
once, followed by its gap; all behaviour is in the modem.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache
from typing import Annotated, Any, Literal

import numpy as np
import pmt
from gnuradio import gr
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from gr_ros2.link.events import AirPacket
from gr_ros2.phy.base import LENGTH_TAG, BurstCarrier, PacketReceiver, PacketTransceiver, PacketTransmitter, Phy
from gr_ros2.phy.burst import BurstModem, BurstReceiver, DemodulatedPacket, Frames, Samples
from gr_ros2.phy.fec import CodeName
from gr_ros2.phy.flowgraph import ReceiverBlock, TransmitterBlock
from gr_ros2.phy.kernels import decoders, fastest, which
from gr_ros2.phy.pdus import PDUS, PduPort
from gr_ros2.phy.stream_times import BURST_TIME, TX_TIME, StreamTimes, whole_and_rest
from gr_ros2.phy.taken_packets import TakesPackets
from gr_ros2.phy.tap import SYMBOLS_SHOWN, BurstTap, SymbolTap
from gr_ros2.phy.threads import KeptAlive, log_warnings_only
from gr_ros2.settings.fields import AUTO, Auto

STOCK = "GNU Radio's blocks"
"""Text of ``runs_on`` for PHYs made of GNU Radio's own blocks."""
_log = logging.getLogger(__name__)


_LENGTH = pmt.intern(LENGTH_TAG)
_POINTS = pmt.intern("points")
_BUFFER = 1 << 17
"""Samples that may wait behind the modulator. GNU Radio hands over at most half of them at once: so many that modulator
and receiver have a dozen long packets in a call. With a quarter of it, links carry half of the packets of 1,500 B."""
_WAKES = pmt.intern("wakes")
"""The message after which GNU Radio calls a block that has been given packets."""
_GAP = 32
"""Zero samples after a packet, unless a receiver needs more."""


class Demodulation:
    """Samples in, packets out, with their times.

    :param lag: see :attr:`gr_ros2.phy.base.Phy.lag`
    :param gap: zero samples after each burst
    :ivar times: when the samples were on the air; whoever feeds them says so
    """

    def __init__(self, modem: BurstModem, lag: int, gap: int, sample_rate: float) -> None:
        self._modem = modem
        self._engine: BurstReceiver | None = None
        self._damaged = 0
        self._failed = False
        self._snr_db: float | None = None
        self._first = 0
        """Number of the first sample that the engine was fed."""
        self.fed = 0
        """Number of samples that have come since the start."""
        self._lag, self._slack = lag, gap // 2
        self.times = StreamTimes(sample_rate)

    @property
    def damaged(self) -> int:
        """Bursts found whose CRC-32 was wrong."""
        return self._damaged + (self._engine.damaged if self._engine is not None else 0)

    @property
    def snr_db(self) -> float | None:
        """SNR over the sampled band of the newest packets, dB; None before the first."""
        engine = self._engine
        return self._snr_db if engine is None else engine.snr_db

    def points(self) -> Samples:
        """The constellation points of the newest packet; empty before the first."""
        engine = self._engine
        return np.empty(0, np.complex64) if engine is None else engine.points

    def start(self) -> None:
        """Samples come, counted anew."""
        self._engine = self._modem.receiver()
        self._first = self.fed = 0

    def stop(self) -> None:
        """No more samples come."""
        self._damaged, self._snr_db, self._engine = self.damaged, self.snr_db, None

    def feed(self, samples: Samples) -> list[AirPacket]:
        """The packets that the next samples complete."""
        assert self._engine is not None
        self.fed += len(samples)
        try:
            return [self._on_air(packet) for packet in self._engine.feed(samples)]
        except Exception as error:  # noqa: BLE001 - an exception would end the thread that feeds, and all reception
            if not self._failed:
                self._failed = True
                _log.exception("%s: starts again after %s", type(self._modem).__name__, error)
            self.stop()
            self._engine = self._modem.receiver()
            self._first = self.fed
            return []

    def _on_air(self, packet: DemodulatedPacket) -> AirPacket:
        modem = self._modem.rates[packet.mcs]
        end = self._first + packet.end
        first = end - self._lag - modem.samples_of(len(packet.data))
        mcs = packet.mcs if len(self._modem.rates) > 1 else None
        return AirPacket(packet.data, self.times.at(first, end, self._slack), mcs=mcs, snr_db=packet.snr_db)


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class AirOptions:
    """Settings that every PHY with samples has."""

    gap: Annotated[int, Field(ge=16, le=100_000, title="Gap after a packet (samples)")] | Auto = AUTO
    """zero samples after each packet; auto = 32, two symbols with `stock`, 32 chips with `lora_sdr`"""
    lengths: Annotated[Literal["any", "fixed"], Field(title="Packet lengths on the air")] = "any"
    """a packet is as long on the air as its bytes need, or (fixed) as the longest, which the blocks of others always
    send. The same at both ends"""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class BurstOptions(AirOptions):
    """Settings that every burst PHY has."""

    fec: Annotated[CodeName, Field(title="Forward error correction")] = "none"
    """forward error correction; cc is convolutional, constraint length 7, rate 1/2"""


class BurstPhy(Phy):
    """A PHY made of a burst modem. A subclass sets ``modem``, the modem's numpy form.

    :ivar gap: zero samples after each burst
    """

    Options = BurstOptions
    modem: BurstModem

    def __init__(self, packet_len: int, sample_rate: float, **options: Any) -> None:
        super().__init__(packet_len, sample_rate, **options)
        self._padded = False
        self.gap: int = _GAP if self.options.gap == AUTO else self.options.gap

    def frames(self, **form: Any) -> Frames:
        """The frames of this link, by its settings.

        :param form: further arguments of :class:`Frames`
        """
        fixed = self.options.lengths == "fixed"
        return Frames(self.packet_len, self.options.fec, fixed=fixed, decoders=decoders(self.kernels), **form)

    @property
    def any_length(self) -> bool:
        return not self.modem.frames.fixed and not self._padded

    @property
    def lengths(self) -> range:
        """Bytes that a packet may have."""
        return range(1 if self.any_length else self.packet_len, self.packet_len + 1)

    def pad_all(self) -> None:
        self._padded = True

    def airtime_samples(self, packet_len: int | None = None) -> int:
        length = packet_len if packet_len is not None and self.any_length else self.packet_len
        return self.modem.samples_of(length) + self.gap

    @cached_property
    def running_modem(self) -> BurstModem:
        """The modem that runs here: compiled or numpy."""
        return fastest(self.modem, self.kernels)

    @property
    def burst_modem(self) -> BurstModem | None:
        return self.running_modem if hasattr(self, "modem") else None

    @cached_property
    def lag(self) -> int:
        packet = bytes(range(min(self.packet_len, 32)))
        burst = self.running_modem.modulate(packet if self.any_length else packet.ljust(self.packet_len, b"\0"))
        before = self.running_modem.margin + self.running_modem.preamble_samples
        samples = np.pad(burst, (before, before + self.gap))
        if self.receiver_taps is not None:
            samples = np.convolve(samples, self.receiver_taps).astype(np.complex64)
        (heard,) = self.running_modem.receiver().feed(samples)
        return heard.end - before - len(burst)

    def runs_on(self) -> str:
        return which(self.kernels)

    def transmitter(self) -> PacketTransmitter:
        return BurstTransmitter(self)

    def receiver(self) -> PacketReceiver:
        return BurstSink(self)

    def transceiver(self, carrier: BurstCarrier) -> PacketTransceiver | None:
        return BurstTransceiver(self, carrier)


class BurstTransmitter(TransmitterBlock):
    """Message port `pdus` in, complex stream out."""

    def __init__(self, phy: BurstPhy) -> None:
        super().__init__(f"gr_ros2_{phy.name}_tx")
        self._modulator = _Modulator(phy)
        self.msg_connect((self, "pdus"), (self._modulator, "pdus"))
        self.leave_by(self._modulator)

    @property
    def refused(self) -> int:
        """PDUs that were not a packet of an allowed length."""
        return self._modulator.refused

    def packets_sent(self) -> int:
        return self._modulator.sent


class _Modulator(TakesPackets, gr.sync_block):  # type: ignore[misc]
    """Message port `pdus` in, samples out: each packet's burst and gap, tagged with its length if bursts differ in it,
    and with the time at which it begins, as far as that is known (:mod:`gr_ros2.phy.stream_times`).

    This is one block instead of a modulator before ``pdu_to_tagged_stream``: that block needs buffer space for a whole
    packet, and without it sleeps until the next message comes, or 250 ms.
    """

    def __init__(self, phy: BurstPhy) -> None:
        super().__init__(phy.lengths, f"gr_ros2_{phy.name}_modulator", None, [np.complex64])
        self._tagged = phy.any_length
        self._modem = phy.running_modem
        self._gap = phy.gap
        self._waiting: deque[tuple[BurstModem, AirPacket]] = deque()
        self._whole = np.zeros(phy.airtime_samples(), np.complex64)
        self._rest = self._whole[:0]
        """What has not left yet of a burst that did not fit."""
        self.sent = 0
        """Packets that have left as samples."""
        self._tag, self._wake = self.add_item_tag, self._post  # stored: each look-up would pass through two proxies
        log_warnings_only([self])
        self.set_min_output_buffer(_BUFFER)

    def take_packets(self, packets: list[AirPacket]) -> None:
        self._waiting.extend((self._modem.on_mcs(packet.mcs), packet) for packet in packets)

    def take(self, packets: Sequence[AirPacket]) -> None:
        super().take(packets)
        self._wake(PDUS, _WAKES)

    def _take(self, message: Any) -> None:
        if not pmt.eq(message, _WAKES):
            super()._take(message)

    def work(self, input_items: list[Any], output_items: list[Samples]) -> int:  # noqa: ARG002
        out = output_items[0]
        done = self._go_on(out)
        while self._waiting and done < len(out):
            modem = self._waiting[0][0]
            packets, sizes = self._fitting(modem, len(out) - done)
            if packets:
                modem.modulate_into([packet.data for packet in packets], self._gap, out[done:])
                for packet, size in zip(packets, sizes, strict=True):
                    self._begin(done, size, packet)
                    done += size
                self.sent += len(packets)
            else:
                _, packet = self._waiting.popleft()
                self._rest = self._whole[: self._size(modem, packet)]
                modem.modulate_into([packet.data], self._gap, self._rest)
                self._begin(done, len(self._rest), packet)
                done += self._go_on(out[done:])
        return done

    def _size(self, modem: BurstModem, packet: AirPacket) -> int:
        """Samples of a packet's burst and gap."""
        return modem.samples_of(len(packet.data)) + self._gap

    def _fitting(self, modem: BurstModem, space: int) -> tuple[list[AirPacket], list[int]]:
        """The next packets whose bursts fit, all of one modem, and the samples of each."""
        packets: list[AirPacket] = []
        sizes: list[int] = []
        while self._waiting and self._waiting[0][0] is modem and (size := self._size(*self._waiting[0])) <= space:
            packets.append(self._waiting.popleft()[1])
            sizes.append(size)
            space -= size
        return packets, sizes

    def _begin(self, place: int, size: int, packet: AirPacket) -> None:
        """A burst begins at a place of this call's samples."""
        at = self.nitems_written(0) + place
        if self._tagged:
            self._tag(0, at, _LENGTH, _number(size))
        if packet.at is not None:
            self._tag(0, at, BURST_TIME, pmt.from_double(packet.at))
        if packet.leave_at is not None:
            self._tag(0, at, TX_TIME, whole_and_rest(packet.leave_at))

    def _go_on(self, out: Samples) -> int:
        """Send as much as fits of the burst that has begun; returns its number of samples."""
        count = min(len(out), len(self._rest))
        if count:
            out[:count] = self._rest[:count]
            self._rest = self._rest[count:]
            self.sent += not len(self._rest)
        return count


@lru_cache
def _number(value: int) -> Any:
    return pmt.from_long(value)


class BurstSink(ReceiverBlock):
    """Complex stream in; message ports out: `pdus`, packets whose CRC-32 is right, and `points`, how they look."""

    def __init__(self, phy: BurstPhy) -> None:
        super().__init__(f"gr_ros2_{phy.name}_rx")
        self._demodulator = _Demodulator(phy)
        if phy.receiver_taps is None:
            self.connect(self, self._demodulator)
        else:
            from gnuradio import filter  # here: 10 MB that a link whose bursts come as a whole does not need

            self.connect(self, filter.fir_filter_ccf(1, phy.receiver_taps), self._demodulator)
        for port in ("pdus", "points"):
            self.msg_connect((self._demodulator, port), (self, port))

    @property
    def damaged(self) -> int:
        """Bursts found whose CRC-32 was wrong."""
        return self._demodulator.inside.damaged

    @property
    def snr_db(self) -> float | None:
        return self._demodulator.inside.snr_db

    def follow_clock(self, offset: Callable[[], float]) -> None:
        self._demodulator.inside.times.offset = offset

    def tap_symbols(self) -> SymbolTap:
        return SymbolTap(self._demodulator.inside.points)


class _Demodulator(KeptAlive, gr.sync_block):  # type: ignore[misc]
    """Filtered samples in, message ports `pdus` and `points` out."""

    def __init__(self, phy: BurstPhy) -> None:
        super().__init__(f"gr_ros2_{phy.name}_demodulator", [np.complex64], None)
        self.inside = Demodulation(phy.running_modem, phy.lag, phy.gap, phy.sample_rate)
        self._port = PduPort(self)
        self._shown = False
        """Whether somebody reads the port `points`."""
        self.message_port_register_out(_POINTS)

    def start(self) -> bool:
        self._port.find_readers()
        self._shown = pmt.is_pair(self.message_subscribers(_POINTS))
        self.inside.start()
        return super().start()

    def stop(self) -> bool:
        self.inside.stop()
        return super().stop()

    def work(self, input_items: list[Samples], output_items: list[Any]) -> int:  # noqa: ARG002
        count = len(input_items[0])
        self.inside.times.arrived(self.inside.fed + count, self.get_tags_in_window(0, 0, count))
        packets = self.inside.feed(input_items[0])
        self._port.send(packets)
        if self._shown and packets:
            points = self.inside.points()[-SYMBOLS_SHOWN:]
            self.message_port_pub(_POINTS, pmt.cons(pmt.PMT_NIL, pmt.to_pmt(points)))
        return count


class BurstTransceiver(TakesPackets, gr.basic_block):  # type: ignore[misc]
    """Message ports `pdus` in and out: transmitter and receiver of a burst PHY around what carries bursts.

    A packet is modulated and handed over in the thread that gives it. A burst is demodulated in the thread that hands
    it over, which also hands on the packets in it.
    """

    foreign = 0

    def __init__(self, phy: BurstPhy, carrier: BurstCarrier) -> None:
        super().__init__(phy.lengths, f"gr_ros2_{phy.name}", None, None)
        self._modem, self._gap, self._carrier = phy.running_modem, phy.gap, carrier
        self._whole = np.zeros(phy.airtime_samples(), np.complex64)
        self._demodulation = Demodulation(phy.running_modem, phy.lag, phy.gap, phy.sample_rate)
        self._taps = None if phy.receiver_taps is None else np.asarray(phy.receiver_taps, np.float32)
        self._before = np.zeros(0 if self._taps is None else len(self._taps) - 1, np.complex64)
        """The newest samples, which the filter still needs."""
        self._port = PduPort(self)
        self._sent = 0
        self._tap: BurstTap | None = None
        self.channel: Callable[[Samples], Samples] | None = None

    @property
    def damaged(self) -> int:
        """Bursts found whose CRC-32 was wrong."""
        return self._demodulation.damaged

    @property
    def snr_db(self) -> float | None:
        """SNR over the sampled band of the newest packets, dB; None before the first."""
        return self._demodulation.snr_db

    def packets_sent(self) -> int:
        return self._sent

    def follow_clock(self, offset: Callable[[], float]) -> None:
        """Do nothing: whatever carries bursts tells their times."""

    def tap_symbols(self) -> SymbolTap:
        """Make the received constellation points visible."""
        return SymbolTap(self._demodulation.points)

    def tap_samples(self, size: int) -> BurstTap:
        """Make the newest samples received visible."""
        self._tap = BurstTap(size)
        return self._tap

    def release(self) -> None:
        """Nothing is inside."""

    def start(self) -> bool:
        self._port.find_readers()
        self._demodulation.start()
        self._before[:] = 0
        self._carrier.listen(self._hear)
        return super().start()

    def stop(self) -> bool:
        self._carrier.listen(None)
        self._demodulation.stop()
        return super().stop()

    def take_packets(self, packets: list[AirPacket]) -> None:
        for packet in packets:
            modem = self._modem.on_mcs(packet.mcs)
            samples = self._whole[: modem.samples_of(len(packet.data)) + self._gap]
            modem.modulate_into([packet.data], self._gap, samples)
            self._carrier.send(samples, packet.at)
            self._sent += 1

    def _hear(self, samples: Samples, at: float | None) -> None:
        demodulation = self._demodulation
        if at is not None:
            demodulation.times.begins(demodulation.fed, at)
        demodulation.times.arrived(demodulation.fed + len(samples))
        if self.channel is not None:
            samples = self.channel(samples)
        if self._tap is not None:
            self._tap.add(samples)
        self._port.send(demodulation.feed(self._filtered(samples)))

    def _filtered(self, samples: Samples) -> Samples:
        if self._taps is None:
            return samples
        joined = np.concatenate([self._before, samples])
        self._before = joined[len(samples) :]
        return np.convolve(joined, self._taps, "valid").astype(np.complex64, copy=False)
