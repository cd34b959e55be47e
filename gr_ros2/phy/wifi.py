"""The `wifi` PHY: IEEE 802.11 a/g/p frames by the out-of-tree module gr-ieee802-11.

Invariants: a frame has the length of its packet, and an FCS, so every output packet equals the packet sent; a whole
frame that is not ours is counted and dropped. The module's blocks encode, map, synchronise, equalise and decide. Stock
blocks of GNU Radio between them are connected as in the module's ``wifi_phy_hier``. Decoding is in ``wifi_frames``,
since the module's decoder reads beyond the end of a frame. The sampled band is the channel: 10 MS/s for 802.11p, 20
MS/s for 802.11a and g.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from math import log10
from statistics import median
from typing import Annotated, Any, Literal

import numpy as np
import pmt
from gnuradio import blocks, digital, fft, filter, gr
from numpy.typing import NDArray
from pydantic import AfterValidator, ConfigDict, Field
from pydantic.dataclasses import dataclass

from gr_ros2.core.errors import ConfigError
from gr_ros2.link.events import AirPacket
from gr_ros2.phy import PHY
from gr_ros2.phy.base import LENGTH_TAG, PacketReceiver, PacketTransmitter, Phy
from gr_ros2.phy.burst import Samples
from gr_ros2.phy.burst_blocks import STOCK, AirOptions
from gr_ros2.phy.flowgraph import ReceiverBlock, TransmitterBlock
from gr_ros2.phy.kernels import decoders
from gr_ros2.phy.pdus import PDUS, PduPort, pdu_of
from gr_ros2.phy.taken_packets import TakesPackets
from gr_ros2.phy.tap import SYMBOLS_SHOWN, SymbolTap
from gr_ros2.phy.theory import convolutional_success, qam_bit_error
from gr_ros2.phy.threads import KeptAlive, lift_message_limit
from gr_ros2.phy.wifi_frames import (
    CARRIERS,
    CP_LEN,
    ENCODINGS,
    FCS_LEN,
    FFT_LEN,
    HEADER_LEN,
    MAX_PACKET,
    MAX_PSDU,
    PREAMBLE,
    ROLLOFF,
    SIGNAL_BITS,
    USED_CARRIERS,
    DataFrames,
    FrameDecoder,
    data_bits,
    scrambler,
    training,
)
from gr_ros2.settings.fields import AUTO, Auto

_TX_KEY = "packet_len"
"""The length tag of the module's blocks, which cannot be changed."""
_SMALLEST_BUFFER = 32768
"""Bytes that GNU Radio gives every buffer by default."""
_UNKNOWN_CARRIER = 1e15
"""Hz. The module divides a carrier offset by the carrier to compute a clock offset; this makes it 0."""
_SENSITIVITY = 0.5
"""Part of the preamble's autocorrelation from which on a frame is looked at: frames are heard from 3 dB on. With the
module's own 0.56 they are from 5 dB on."""
_GAP = 400
"""Zero samples after a packet. With 336 the receiver would keep most of the last packets."""
_LOOKED_BACK = 16
"""Packets whose SNRs are averaged (median)."""
_PILOTS = (-21, -7, 7, 21)


def _address(text: str) -> str:
    parts = text.split(":")
    if len(parts) != 6 or any(len(part) != 2 or set(part) - set("0123456789abcdefABCDEF") for part in parts):
        raise ValueError("must be six octets with colons, such as 02:67:72:00:00:01")
    return text.lower()


Address = Annotated[str, AfterValidator(_address)]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class WifiOptions(AirOptions):
    """Settings of this PHY beside packet length and sample rate, which is the channel's bandwidth: 10e6 samples/s for
    802.11p, 20e6 for 802.11a and g.
    """

    encoding: Literal[
        "bpsk-1/2", "bpsk-3/4", "qpsk-1/2", "qpsk-3/4", "16qam-1/2", "16qam-3/4", "64qam-2/3", "64qam-3/4"
    ] = "bpsk-1/2"
    """modulation and code rate: 3 to 27 Mbit/s at 10 MS/s. A receiver hears all"""
    equalizer: Literal["ls", "lms", "comb", "sta"] = "ls"
    """how the channel is estimated: from the preamble; `lms` also by decided symbols; `comb` from the pilots, without
    an SNR; `sta` averages"""
    gap: Annotated[int, Field(ge=360, le=100_000, title="Gap after a packet (samples)")] | Auto = AUTO
    """zero samples after each packet, 360..100000; auto = 400"""
    network: Annotated[Address, Field(title="Network (BSSID)")] = "02:67:72:2d:72:32"
    """address 3 (BSSID) of the frames; those of others are counted as `foreign` and dropped"""
    address: Annotated[Address, Field(title="Own address")] = "02:67:72:00:00:01"
    """address 2 of the frames sent"""
    channel_hz: Annotated[float, Field(ge=1e6, le=1e11, title="Channel frequency (Hz)")] | None = None
    """centre frequency of the channel, Hz, by which the module tells how much the clocks differ; null = not at all"""


class WifiPhy(Phy):
    """The frames of cars and Wi-Fi devices, for channels with echoes, at high rates.

    A packet has up to 1492 bytes. An echo may be 16 samples late, 1.6 us at 10 MS/s.

    :param options: see :class:`WifiOptions`
    :raises ConfigError: for an option that is unknown or out of range, or a packet that is too long
    :raises BackendMissingError: where gr-ieee802-11 is not installed
    """

    name = "wifi"
    Options = WifiOptions

    def __init__(self, packet_len: int, sample_rate: float, **options: Any) -> None:
        super().__init__(packet_len, sample_rate, **options)
        if packet_len > MAX_PACKET:
            raise ConfigError(
                f"phy wifi: packet_len = {packet_len}: at most {MAX_PACKET}; a frame has up to {MAX_PSDU} bytes, "
                f"{MAX_PSDU - MAX_PACKET} of them header and FCS"
            )
        (self.module,) = PHY.modules(self.name)
        self.encoding = ENCODINGS[self.options.encoding]
        self.gap: int = _GAP if self.options.gap == AUTO else self.options.gap
        self._padded = self.options.lengths == "fixed"

    @property
    def any_length(self) -> bool:
        return not self._padded

    def pad_all(self) -> None:
        self._padded = True

    @property
    def lengths(self) -> range:
        """Allowed packet lengths, bytes."""
        return range(1 if self.any_length else self.packet_len, self.packet_len + 1)

    def airtime_samples(self, packet_len: int | None = None) -> int:
        length = packet_len if packet_len is not None and self.any_length else self.packet_len
        return self.encoding.samples(length) + self.gap

    def burst_power(self) -> float:
        return 1.0

    def computed_pdr(self, snr_db: float) -> float:
        """For hard decisions, and a channel estimated from the two long training symbols, as the module does it."""
        # Noise is in all 64 carriers, power in 52; the estimate has half the noise of a symbol and adds it.
        snr = 10 ** (snr_db / 10) * FFT_LEN / USED_CARRIERS / 1.5
        header = convolutional_success((1, 2), qam_bit_error(1, snr), SIGNAL_BITS)
        wrong = qam_bit_error(self.encoding.carrier_bits, snr)
        return header * convolutional_success(self.encoding.rate, wrong, data_bits(self.packet_len))

    def runs_on(self) -> str:
        return STOCK

    def transmitter(self) -> PacketTransmitter:
        return WifiTransmitter(self)

    def receiver(self) -> PacketReceiver:
        return WifiReceiver(self)


@contextmanager
def _silenced() -> Iterator[None]:
    """Keep from standard output what a block of the module prints while it is made."""
    kept = os.dup(1)
    with open(os.devnull, "w") as nothing:
        os.dup2(nothing.fileno(), 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


class WifiTransmitter(TransmitterBlock):
    """Message port `pdus` in, complex stream out: each packet is sent at once, followed by its gap."""

    def __init__(self, phy: WifiPhy) -> None:
        super().__init__("gr_ros2_wifi_tx")
        lift_message_limit()
        wifi = phy.module
        self._framer, self._bursts = _WifiFramer(phy), _Bursts(phy.any_length)
        with _silenced():
            mapper = wifi.mapper(getattr(wifi, phy.encoding.constant), False)
        points = wifi.chunks_to_symbols()
        header = digital.packet_headergenerator_bb(wifi.signal_field().formatter(), _TX_KEY)
        header_points = digital.chunks_to_symbols_bc([-1, 1], 1)
        join = blocks.tagged_stream_mux(gr.sizeof_gr_complex, _TX_KEY, 1)
        data = [*range(-26, -21), *range(-20, -7), *range(-6, 0), *range(1, 7), *range(8, 21), *range(22, 27)]
        pilots = [(sign, sign, sign, -sign) for sign in (1 - 2 * int(bit) for bit in scrambler())]
        carriers = digital.ofdm_carrier_allocator_cvc(FFT_LEN, [data], [_PILOTS], pilots, training(), _TX_KEY, True)
        inverse = fft.fft_vcc(FFT_LEN, False, [USED_CARRIERS**-0.5] * FFT_LEN, True, 1)
        prefix = digital.ofdm_cyclic_prefixer(FFT_LEN, (FFT_LEN + CP_LEN), ROLLOFF, _TX_KEY)
        zeros = blocks.vector_source_c([0j] * phy.gap, True, 1, [_length_tag(phy.gap)])
        spaced = blocks.tagged_stream_mux(gr.sizeof_gr_complex, _TX_KEY)
        self.msg_connect((self, "pdus"), (self._framer, "pdus"))
        self.msg_connect((self._framer, "pdus"), (mapper, "in"))
        self.connect(mapper, header, header_points, (join, 0))
        self.connect(mapper, points, (join, 1))
        self.connect(join, carriers, inverse, prefix, (spaced, 0))
        self.connect(zeros, (spaced, 1))
        self.connect(spaced, self._bursts)
        self.leave_by(self._bursts)
        symbols = PREAMBLE + 1 + phy.encoding.symbols(phy.packet_len)
        for block in (mapper, points, header, header_points, join, carriers, inverse, prefix, zeros, spaced):
            _fit_buffer(block, symbols, phy.airtime_samples())

    @property
    def refused(self) -> int:
        """PDUs that were not a packet of an allowed length."""
        return self._framer.refused

    def packets_sent(self) -> int:
        return self._bursts.sent


def _length_tag(length: int) -> Any:
    tag = gr.tag_t()
    tag.key, tag.value = pmt.intern(_TX_KEY), pmt.from_long(length)
    return tag


def _fit_buffer(block: Any, symbols: int, samples: int) -> None:
    """Give a block buffer space for two frames where GNU Radio's default is too small: the blocks here take a frame at
    a time, and one that cannot get it stalls the flowgraph."""
    size = block.output_signature().sizeof_stream_item(0)
    items = symbols if size >= FFT_LEN else samples
    if 2 * items * size > _SMALLEST_BUFFER:
        block.set_min_output_buffer(0, 2 * items)


class _WifiFramer(TakesPackets, gr.basic_block):  # type: ignore[misc]
    """Message port `pdus` in, `pdus` out: the frame of each packet."""

    def __init__(self, phy: WifiPhy) -> None:
        super().__init__(phy.lengths, "gr_ros2_wifi_framer", None, None)
        self._frames = DataFrames(phy.options.network, phy.options.address)
        self._number = 0
        self.message_port_register_out(PDUS)

    def take_packets(self, packets: list[AirPacket]) -> None:
        for packet in packets:
            self.message_port_pub(PDUS, pdu_of(self._frames.wrap(packet.data, self._number)))
            self._number += 1


class _Bursts(KeptAlive, gr.sync_block):  # type: ignore[misc]
    """Samples in and out: counts the bursts that leave, and tags them if they differ in length.

    :param tagged: whether they do
    """

    def __init__(self, tagged: bool) -> None:
        super().__init__("gr_ros2_wifi_bursts", [np.complex64], [np.complex64])
        self.set_tag_propagation_policy(gr.TPP_DONT)
        self._tagged = tagged
        self._ends: deque[int] = deque()
        self.sent = 0
        """Packets that have left as samples."""

    def work(self, input_items: list[Samples], output_items: list[Samples]) -> int:
        count = len(input_items[0])
        output_items[0][:] = input_items[0]
        for tag in self.get_tags_in_window(0, 0, count, pmt.intern(_TX_KEY)):
            self._ends.append(tag.offset + pmt.to_long(tag.value))
            if self._tagged:
                self.add_item_tag(0, tag.offset, pmt.intern(LENGTH_TAG), tag.value)
        while self._ends and self._ends[0] <= self.nitems_written(0) + count:
            self._ends.popleft()
            self.sent += 1
        return count


class WifiReceiver(ReceiverBlock):
    """Complex stream in, message port `pdus` out: the packets of this network's frames whose FCS is right."""

    def __init__(self, phy: WifiPhy) -> None:
        super().__init__("gr_ros2_wifi_rx")
        wifi, options = phy.module, phy.options
        window, length = 48, 320
        late = blocks.delay(gr.sizeof_gr_complex, CP_LEN)
        product, turned = blocks.multiply_cc(), blocks.conjugate_cc()
        # Filters, not moving averages: rounding leaves something of a burst in these, which looks like a preamble in
        # the zeros behind it.
        correlation = filter.fir_filter_ccf(1, [1.0] * window)
        power = filter.fir_filter_fff(1, [1.0] * (window + CP_LEN))
        ratio = blocks.divide_ff()
        short = wifi.sync_short(_SENSITIVITY, 2, False, False)
        long = wifi.sync_long(length, False, False)
        # The module corrects the clock offset in the wrong direction; the sign turns it round.
        carrier = _UNKNOWN_CARRIER if options.channel_hz is None else -options.channel_hz
        estimate = getattr(wifi, options.equalizer.upper())
        self._equalizer = wifi.frame_equalizer(estimate, carrier, phy.sample_rate, False, False)
        self._decoder = _Decoder(phy)
        self.connect(self, late, (short, 0))
        self.connect(late, turned, (product, 1))
        self.connect(self, (product, 0))
        self.connect(product, correlation, (short, 1))
        self.connect(correlation, blocks.complex_to_mag(1), (ratio, 0))
        self.connect(self, blocks.complex_to_mag_squared(1), power, (ratio, 1))
        self.connect(ratio, (short, 2))
        self.connect(short, (long, 0))
        self.connect(short, blocks.delay(gr.sizeof_gr_complex, length), (long, 1))
        self.connect(
            long,
            blocks.stream_to_vector(gr.sizeof_gr_complex, FFT_LEN),
            fft.fft_vcc(FFT_LEN, True, [], True, 1),
            self._equalizer,
            self._decoder,
        )
        self.msg_connect((self._decoder, "pdus"), (self, "pdus"))

    @property
    def damaged(self) -> int:
        """Frames whose FCS was wrong, whoever sent them; noise taken for a preamble counts too."""
        return self._decoder.damaged

    @property
    def foreign(self) -> int:
        """Whole frames that are not packets of this link."""
        return self._decoder.foreign

    @property
    def snr_db(self) -> float | None:
        return self._decoder.snr_db

    def tap_symbols(self) -> SymbolTap:
        points = _Points()
        self.msg_connect((self._equalizer, "symbols"), (points, "symbols"))
        return SymbolTap(points.newest)


class _Decoder(KeptAlive, gr.sync_block):  # type: ignore[misc]
    """Symbols of frames in, whose first has tags; message port `pdus` out: the packets of this link."""

    def __init__(self, phy: WifiPhy) -> None:
        super().__init__("gr_ros2_wifi_decoder", [(np.uint8, CARRIERS)], None)
        self._frames, self._lengths = DataFrames(phy.options.network, phy.options.address), phy.lengths
        self._frame_decoder = FrameDecoder(decoders(phy.kernels))
        self._measures = phy.options.equalizer != "comb"
        self._encoding, self._length, self._snr_db = phy.encoding, 0, 0.0
        self._symbols: list[NDArray[np.uint8]] = []
        self._missing = 0
        """Symbols of the present frame that have not come yet."""
        self._snrs: deque[float] = deque(maxlen=_LOOKED_BACK)
        self.damaged = self.foreign = 0
        self._port = PduPort(self)

    @property
    def snr_db(self) -> float | None:
        """The median of the newest packets."""
        snrs = tuple(self._snrs)
        return median(snrs) if snrs else None

    def start(self) -> bool:
        self._port.find_readers()
        return super().start()

    def work(self, input_items: list[NDArray[np.uint8]], output_items: list[Any]) -> int:  # noqa: ARG002
        symbols = input_items[0]
        begin, cursor = self.nitems_read(0), 0
        packets: list[bytes] = []
        heads: dict[int, dict[Any, Any]] = {}
        for tag in self.get_tags_in_window(0, 0, len(symbols)):
            heads.setdefault(tag.offset - begin, {})[pmt.symbol_to_string(tag.key)] = tag.value
        for place, head in sorted(heads.items()):
            packets += self._take(symbols[cursor:place])
            self._begin(head)
            cursor = place
        packets += self._take(symbols[cursor:])
        self._port.send([AirPacket(packet) for packet in packets])
        return len(symbols)

    def _begin(self, head: dict[str, Any]) -> None:
        """A frame begins; one that has not ended is damaged."""
        self.damaged += bool(self._missing)
        self._length = pmt.to_uint64(head["frame bytes"])
        self._encoding = tuple(ENCODINGS.values())[pmt.to_uint64(head["encoding"])]
        self._snr_db = band_snr_db(pmt.to_double(head["snr"]))
        self._missing = self._encoding.symbols(self._length - HEADER_LEN - FCS_LEN)
        self._symbols = []

    def _take(self, symbols: NDArray[np.uint8]) -> list[bytes]:
        """Further symbols; the packet that they complete."""
        if not self._missing:
            return []
        new = symbols[: self._missing].copy()
        self._symbols.append(new)
        self._missing -= len(new)
        if self._missing:
            return []
        frame = self._frame_decoder.decode(self._encoding, self._length, np.concatenate(self._symbols))
        packet = None if frame is None else self._frames.unwrap(frame)
        if frame is None:
            self.damaged += 1
        elif packet is None or len(packet) not in self._lengths:
            self.foreign += 1
        else:
            if self._measures:
                self._snrs.append(self._snr_db)
            return [packet]
        return []


def band_snr_db(told_db: float) -> float:
    """The SNR over the sampled band, dB, of the value that the module tells.

    The module compares sum and difference of the two long training symbols: of signal S and noise N of a used carrier
    it gives S/N + 1/2. The band has noise in all carriers.
    """
    return 10 * log10(max(10 ** (told_db / 10) - 0.5, 1e-4) * USED_CARRIERS / FFT_LEN)


class _Points(KeptAlive, gr.basic_block):  # type: ignore[misc]
    """Message port `symbols` in: the points of each symbol."""

    def __init__(self) -> None:
        super().__init__("gr_ros2_wifi_points", None, None)
        self._kept: deque[NDArray[np.complex64]] = deque(maxlen=SYMBOLS_SHOWN // CARRIERS)
        self.message_port_register_in(pmt.intern("symbols"))
        self.set_msg_handler(pmt.intern("symbols"), self._take)

    def newest(self) -> Samples:
        """The newest points; empty before the first."""
        kept = tuple(self._kept)
        return np.concatenate(kept) if kept else np.empty(0, np.complex64)

    def _take(self, message: Any) -> None:
        self._kept.append(np.array(pmt.c32vector_elements(pmt.cdr(message)), np.complex64))
