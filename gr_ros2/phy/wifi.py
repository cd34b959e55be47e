"""The `wifi` PHY: IEEE 802.11 a/g/p frames by the out-of-tree module gr-ieee802-11.

Invariants: a packet is the payload of one broadcast data frame (IEEE 802.11-2020, 9.3.2) with an LLC/SNAP header (IEEE
802) and an FCS, so every output packet equals the packet sent; a frame has the length of its packet; a whole frame that
is not ours is counted and dropped. The module's blocks encode, modulate, synchronise and decode. Stock blocks of GNU
Radio between them are connected as in the module's ``wifi_phy_hier``. The sampled band is the channel: 10 MS/s for
802.11p, 20 MS/s for 802.11a and g.
"""

from __future__ import annotations

import os
import zlib
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from math import log10
from statistics import median
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import pmt
from gnuradio import blocks, digital, fft, gr
from numpy.typing import NDArray
from pydantic import AfterValidator, ConfigDict, Field
from pydantic.dataclasses import dataclass

from gr_ros2.errors import ConfigError
from gr_ros2.phy import PHY
from gr_ros2.phy.base import LENGTH_TAG, PacketReceiver, PacketTransmitter, Phy
from gr_ros2.phy.burst import Samples
from gr_ros2.phy.burst_blocks import STOCK, TakesPackets
from gr_ros2.phy.flowgraph import ReceiverBlock, TransmitterBlock
from gr_ros2.phy.pdus import PDUS, PduPort, octets, pdu_of
from gr_ros2.phy.tap import SYMBOLS_SHOWN, SymbolTap
from gr_ros2.phy.theory import convolutional_success, qam_bit_error
from gr_ros2.phy.threads import KeptAlive, lift_message_limit

MAX_PSDU = 1528
"""Bytes of the longest frame that the module decodes, header and FCS included."""
_HEADER_LEN, _FCS_LEN = 32, 4
MAX_PACKET = MAX_PSDU - _HEADER_LEN - _FCS_LEN
_DATA, _BROADCAST = b"\x08\x00\x00\x00", b"\xff" * 6
"""Frame control and duration of a data frame within no infrastructure; the receiver's address."""
_SNAP = bytes.fromhex("aaaa03000000 88b5")
"""LLC/SNAP header with the first EtherType for local experiments."""
_FFT, _CP, _CARRIERS = 64, 16, 48
_USED = 52
"""Carriers with power: data and pilots."""
_SYMBOL = _FFT + _CP
_PREAMBLE = 4
"""Symbols: two of short training, two of long training."""
_SERVICE_BITS, _TAIL_BITS = 16, 6
_SIGNAL_BITS = 24
_ROLLOFF = 2
"""Samples in which a symbol passes into the next; a frame is one less longer."""
_TX_KEY = "packet_len"
"""The length tag of the module's blocks, which cannot be changed."""
_SMALLEST_BUFFER = 32768
"""Bytes that GNU Radio gives every buffer by default."""
_UNKNOWN_CARRIER = 1e15
"""Hz. The module divides a carrier offset by the carrier to compute a clock offset; this makes it 0."""
_HEAD, _SNR = pmt.intern("frame bytes"), pmt.intern("snr")
_LOOKED_BACK = 16
"""Packets whose SNRs are averaged (median)."""
_SHORT = np.sqrt(13 / 6) * (1 + 1j) * np.array([1, -1, 1, -1, -1, 1, 0, -1, -1, 1, 1, 1, 1])
"""Carriers -24, -20, ... 24 of the short training symbols (IEEE 802.11-2020, equation 17-7)."""
_LONG = "++--++-+-++++++--++-+-++++0+--++-+-+-----++--+-+-++++"
"""Carriers -26 to 26 of the long training symbols (equation 17-8)."""
_PILOTS = (-21, -7, 7, 21)


class Encoding(NamedTuple):
    """Modulation and code rate of a frame's data.

    :param constant: its name in the module
    :param carrier_bits: coded bits of a carrier
    :param symbol_bits: bits of a symbol before coding
    """

    constant: str
    carrier_bits: int
    symbol_bits: int

    def symbols(self, packet_len: int) -> int:
        """Symbols with data of a packet of ``packet_len`` bytes."""
        return -(-data_bits(packet_len) // self.symbol_bits)

    def samples(self, packet_len: int) -> int:
        """Samples of its frame."""
        return (_PREAMBLE + 1 + self.symbols(packet_len)) * _SYMBOL + _ROLLOFF - 1


def data_bits(packet_len: int) -> int:
    """Bits that the code carries for a packet, before padding."""
    return _SERVICE_BITS + 8 * (_HEADER_LEN + packet_len + _FCS_LEN) + _TAIL_BITS


ENCODINGS = {
    "bpsk-1/2": Encoding("BPSK_1_2", 1, 24),
    "bpsk-3/4": Encoding("BPSK_3_4", 1, 36),
    "qpsk-1/2": Encoding("QPSK_1_2", 2, 48),
    "qpsk-3/4": Encoding("QPSK_3_4", 2, 72),
    "16qam-1/2": Encoding("QAM16_1_2", 4, 96),
    "16qam-3/4": Encoding("QAM16_3_4", 4, 144),
    "64qam-2/3": Encoding("QAM64_2_3", 6, 192),
    "64qam-3/4": Encoding("QAM64_3_4", 6, 216),
}


def _address(text: str) -> str:
    parts = text.split(":")
    if len(parts) != 6 or any(len(part) != 2 or set(part) - set("0123456789abcdefABCDEF") for part in parts):
        raise ValueError("must be six octets with colons, such as 02:67:72:00:00:01")
    return text.lower()


Address = Annotated[str, AfterValidator(_address)]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class WifiOptions:
    """Settings of this PHY beside packet length and sample rate, which is the channel's bandwidth: 10e6 samples/s for
    802.11p, 20e6 for 802.11a and g.

    :param encoding: modulation and code rate; at 10 MS/s 3, 4.5, 6, 9, 12, 18, 24 and 27 Mbit/s, at 20 MS/s twice as
        much. The receiver reads it in each frame
    :param equalizer: how the receiver estimates the channel: ``ls`` = from the preamble, ``lms`` = follows it by the
        decided symbols, ``comb`` = from the pilots, ``sta`` = averages over time and carriers. ``comb`` reports no SNR
    :param gap: zero samples after each packet, 400..100000; fewer would keep the last packet in the receiver
    :param lengths: ``any`` = a packet is as long on the air as its bytes need; ``fixed`` = all have ``packet_len``
        bytes. The same at both ends
    :param detection_threshold: part of the preamble's autocorrelation from which on a frame is looked at, 0.3..0.9; the
        module's default is 0.56, which hears frames from 5 dB on
    :param network: address 3 (BSSID) of the frames, six octets in hexadecimal. Frames of others are counted as
        ``foreign`` and dropped
    :param address: address 2 of the frames sent, of this radio, for those who listen with other programs
    :param carrier_hz: the radio's carrier frequency, 1e6..1e11 Hz, by which the module tells how much the clocks
        differ; null = it takes them to be alike
    """

    encoding: Literal[
        "bpsk-1/2", "bpsk-3/4", "qpsk-1/2", "qpsk-3/4", "16qam-1/2", "16qam-3/4", "64qam-2/3", "64qam-3/4"
    ] = "bpsk-1/2"
    equalizer: Literal["ls", "lms", "comb", "sta"] = "ls"
    gap: Annotated[int, Field(ge=400, le=100_000, title="Gap after a packet (samples)")] = 600
    lengths: Annotated[Literal["any", "fixed"], Field(title="Packet lengths on the air")] = "any"
    detection_threshold: Annotated[float, Field(ge=0.3, le=0.9)] = 0.5
    network: Annotated[Address, Field(title="Network (BSSID)")] = "02:67:72:2d:72:32"
    address: Annotated[Address, Field(title="Own address")] = "02:67:72:00:00:01"
    carrier_hz: Annotated[float, Field(ge=1e6, le=1e11, title="Carrier frequency (Hz)")] | None = None


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
        self.gap: int = self.options.gap
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
        snr = 10 ** (snr_db / 10) * _FFT / _USED / 1.5
        carrier_bits, symbol_bits = self.encoding.carrier_bits, self.encoding.symbol_bits
        header = convolutional_success((1, 2), qam_bit_error(1, snr), _SIGNAL_BITS)
        wrong, rate = qam_bit_error(carrier_bits, snr), (symbol_bits, carrier_bits * _CARRIERS)
        return header * convolutional_success(rate, wrong, data_bits(self.packet_len))

    def runs_on(self) -> str:
        return STOCK

    def transmitter(self) -> PacketTransmitter:
        return WifiTransmitter(self)

    def receiver(self, own_process: bool = False) -> PacketReceiver:  # noqa: ARG002 - the blocks are not Python's
        return WifiReceiver(self)


class DataFrames:
    """The broadcast data frames of a network.

    :param options: network and own address
    """

    def __init__(self, options: WifiOptions) -> None:
        self._network = bytes.fromhex(options.network.replace(":", ""))
        self._addresses = _BROADCAST + bytes.fromhex(options.address.replace(":", "")) + self._network

    def wrap(self, packet: bytes, number: int) -> bytes:
        """The frame of a packet, FCS included.

        :param number: sequence number; its lowest 12 bits are sent
        """
        body = _DATA + self._addresses + (number % 4096 << 4).to_bytes(2, "little") + _SNAP + packet
        return body + zlib.crc32(body).to_bytes(_FCS_LEN, "little")

    def unwrap(self, frame: bytes) -> bytes | None:
        """The packet of a frame without FCS; None if it is not a frame of this network."""
        ours = _DATA[:2], _BROADCAST, self._network, _SNAP
        return frame[_HEADER_LEN:] if (frame[:2], frame[4:10], frame[16:22], frame[24:_HEADER_LEN]) == ours else None


def training() -> list[list[complex]]:
    """The four symbols of the preamble, by carrier from -32 on."""
    short, long = np.zeros(_FFT, np.complex128), np.zeros(_FFT, np.complex128)
    short[8:57:4] = _SHORT
    long[6:59] = [{"+": 1, "-": -1, "0": 0}[sign] for sign in _LONG]
    # The first symbol of long training has a cyclic prefix of 32 samples, and so begins 16 samples early.
    early = long * (-1j) ** (np.arange(_FFT) % 4)
    return [symbol.tolist() for symbol in (short, short, early, long)]


def polarity() -> list[int]:
    """The pilots' signs, symbol by symbol (equation 17-25): x^7 + x^4 + 1, all ones at the start."""
    state, signs = 0x7F, []
    for _ in range(127):
        bit = (state >> 6 ^ state >> 3) & 1
        state = state << 1 & 0x7F | bit
        signs.append(1 - 2 * bit)
    return signs


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
        self._framer, self._bursts = _Framer(phy), _Bursts(phy.any_length)
        with _silenced():
            mapper = wifi.mapper(getattr(wifi, phy.encoding.constant), False)
        points = wifi.chunks_to_symbols()
        header = digital.packet_headergenerator_bb(wifi.signal_field().formatter(), _TX_KEY)
        header_points = digital.chunks_to_symbols_bc([-1, 1], 1)
        join = blocks.tagged_stream_mux(gr.sizeof_gr_complex, _TX_KEY, 1)
        data = [*range(-26, -21), *range(-20, -7), *range(-6, 0), *range(1, 7), *range(8, 21), *range(22, 27)]
        pilots = [(sign, sign, sign, -sign) for sign in polarity()]
        carriers = digital.ofdm_carrier_allocator_cvc(_FFT, [data], [_PILOTS], pilots, training(), _TX_KEY, True)
        inverse = fft.fft_vcc(_FFT, False, [_USED**-0.5] * _FFT, True, 1)
        prefix = digital.ofdm_cyclic_prefixer(_FFT, _SYMBOL, _ROLLOFF, _TX_KEY)
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
        symbols = _PREAMBLE + 1 + phy.encoding.symbols(phy.packet_len)
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
    items = symbols if size >= _FFT else samples
    if 2 * items * size > _SMALLEST_BUFFER:
        block.set_min_output_buffer(0, 2 * items)


class _Framer(TakesPackets, gr.basic_block):  # type: ignore[misc]
    """Message port `pdus` in, `pdus` out: the frame of each packet."""

    def __init__(self, phy: WifiPhy) -> None:
        super().__init__(phy.lengths, "gr_ros2_wifi_framer", None, None)
        self._frames = DataFrames(phy.options)
        self._number = 0
        self.message_port_register_out(PDUS)

    def take_packet(self, packet: bytes) -> None:
        self.message_port_pub(PDUS, pdu_of(self._frames.wrap(packet, self._number)))
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
        late = blocks.delay(gr.sizeof_gr_complex, _CP)
        product, turned = blocks.multiply_cc(), blocks.conjugate_cc()
        correlation = blocks.moving_average_cc(window, 1, 4000)
        power = blocks.moving_average_ff(window + _CP, 1, 4000)
        ratio = blocks.divide_ff()
        short = wifi.sync_short(options.detection_threshold, 2, False, False)
        long = wifi.sync_long(length, False, False)
        carrier = _UNKNOWN_CARRIER if options.carrier_hz is None else options.carrier_hz
        estimate = getattr(wifi, options.equalizer.upper())
        self._equalizer = wifi.frame_equalizer(estimate, carrier, phy.sample_rate, False, False)
        decoder = wifi.decode_mac(False, False)
        self._heads, self._collector = _Heads(), _Collector(phy)
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
            blocks.stream_to_vector(gr.sizeof_gr_complex, _FFT),
            fft.fft_vcc(_FFT, True, [], True, 1),
            self._equalizer,
            decoder,
        )
        self.connect(self._equalizer, self._heads)
        self.msg_connect((decoder, "out"), (self._collector, "frames"))
        self.msg_connect((self._collector, "pdus"), (self, "pdus"))

    @property
    def damaged(self) -> int:
        """Frames with a header whose FCS was wrong, whoever sent them; noise taken for a preamble counts too. Frames
        that are being decoded count until they are."""
        return max(0, self._heads.ended - self._collector.whole)

    @property
    def foreign(self) -> int:
        """Whole frames that are not packets of this link."""
        return self._collector.foreign

    @property
    def snr_db(self) -> float | None:
        """SNR over the sampled band of the newest packets, dB; None before the first."""
        return self._collector.snr_db

    def tap_symbols(self) -> SymbolTap:
        """Make the received constellation points visible."""
        points = _Points()
        self.msg_connect((self._equalizer, "symbols"), (points, "symbols"))
        return SymbolTap(points.newest)


class _Heads(KeptAlive, gr.sync_block):  # type: ignore[misc]
    """Symbols of frames in: counts the frames that have ended, whole or damaged."""

    def __init__(self) -> None:
        super().__init__("gr_ros2_wifi_heads", [(np.uint8, _CARRIERS)], None)
        self.ended = 0

    def work(self, input_items: list[Any], output_items: list[Any]) -> int:  # noqa: ARG002
        self.ended += len(self.get_tags_in_window(0, 0, len(input_items[0]), _HEAD))
        return len(input_items[0])


class _Collector(KeptAlive, gr.basic_block):  # type: ignore[misc]
    """Message port `frames` in, whose FCS is right; message port `pdus` out: the packets of this link."""

    def __init__(self, phy: WifiPhy) -> None:
        super().__init__("gr_ros2_wifi_collector", None, None)
        self._frames, self._lengths = DataFrames(phy.options), phy.lengths
        self._measures = phy.options.equalizer != "comb"
        self.whole = self.foreign = 0
        self._snrs: deque[float] = deque(maxlen=_LOOKED_BACK)
        self._port = PduPort(self)
        self.message_port_register_in(pmt.intern("frames"))
        self.set_msg_handler(pmt.intern("frames"), self._take)

    @property
    def snr_db(self) -> float | None:
        """The median of the newest packets."""
        snrs = tuple(self._snrs)
        return median(snrs) if snrs else None

    def start(self) -> bool:
        self._port.find_readers()
        return super().start()

    def _take(self, message: Any) -> None:
        self.whole += 1
        packet = self._frames.unwrap(octets(pmt.cdr(message)))
        if packet is None or len(packet) not in self._lengths:
            self.foreign += 1
            return
        if self._measures:
            self._snrs.append(band_snr_db(pmt.to_double(pmt.dict_ref(pmt.car(message), _SNR, pmt.from_double(0)))))
        self._port.send([packet])


def band_snr_db(told_db: float) -> float:
    """The SNR over the sampled band, dB, of the value that the module tells.

    The module compares sum and difference of the two long training symbols: of signal S and noise N of a used carrier
    it gives S/N + 1/2. The band has noise in all carriers.
    """
    return 10 * log10(max(10 ** (told_db / 10) - 0.5, 1e-4) * _USED / _FFT)


class _Points(KeptAlive, gr.basic_block):  # type: ignore[misc]
    """Message port `symbols` in: the points of each symbol."""

    def __init__(self) -> None:
        super().__init__("gr_ros2_wifi_points", None, None)
        self._kept: deque[NDArray[np.complex64]] = deque(maxlen=SYMBOLS_SHOWN // _CARRIERS)
        self.message_port_register_in(pmt.intern("symbols"))
        self.set_msg_handler(pmt.intern("symbols"), self._take)

    def newest(self) -> Samples:
        """The newest points; empty before the first."""
        kept = tuple(self._kept)
        return np.concatenate(kept) if kept else np.empty(0, np.complex64)

    def _take(self, message: Any) -> None:
        self._kept.append(np.array(pmt.c32vector_elements(pmt.cdr(message)), np.complex64))
