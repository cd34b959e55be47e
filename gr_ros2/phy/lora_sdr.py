"""LoRa frames by the out-of-tree module gr-lora_sdr: `implementation: lora_sdr` of the `lora` PHY.

Invariants: a frame is that of LoRa modems (explicit header, payload CRC-16), its payload is a packet and its CRC-32;
every output packet has the right CRC-32, so it equals the packet sent; packets pass the module as streams of nibbles
and bytes, since its message ports make a PMT symbol of each packet, which stays in memory until the process ends.
"""

from __future__ import annotations

import zlib
from binascii import crc_hqx
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from typing import Any

import numpy as np
import pmt
from gnuradio import filter, gr, pdu
from gnuradio.fft import window
from gnuradio.filter import firdes

from gr_ros2.core.errors import BackendMissingError
from gr_ros2.link.events import AirPacket
from gr_ros2.phy.burst import CRC_LEN, Octets
from gr_ros2.phy.flowgraph import ReceiverBlock, TransmitterBlock
from gr_ros2.phy.pdus import PDUS, pdu_of
from gr_ros2.phy.taken_packets import TakesPackets
from gr_ros2.phy.threads import KeptAlive, lift_message_limit

MAX_PAYLOAD = 255
"""Bytes; the header has 8 bits for them."""
MAX_SYMBOL = 2048
"""Samples. For a preamble that begins late in a symbol the module reads up to a quarter of a symbol before its current
position, and thus before the buffer when it is at its start (gr-lora_sdr, issue 144). GNU Radio guards its buffers with
one page, 512 samples; a read beyond it ends the process."""
PER_CHIP = 2
"""Samples of a chip. With more, fewer spreading factors stay below ``MAX_SYMBOL``."""
_PREAMBLE, _HEAD_QUARTERS = 8, 17
"""Up-chirps, and the quarters of a chirp after them: two chirps of the sync word, two and a quarter down-chirps."""
_HEADER_NIBBLES, _CRC_NIBBLES = 5, 4
_HEADER_SYMBOLS = 8
"""Symbols of the first block, which always has two bits fewer per symbol and four check bits."""
_HEADER_CHECKS = (0xF00, 0x8E1, 0x49A, 0x257, 0x12F)
"""For each check bit of a header, the bits of its first three nibbles that it adds up."""
_LARGEST = 2**32 - 1
"""Largest carrier frequency that the module accepts, Hz. The module uses only the quotient of carrier and bandwidth, to
compute a clock offset from a carrier offset; this value and 1 Hz make the clock offset 0."""
_TX_KEY = "frame_len"
_FRAME = pmt.intern("frame_info")
_PAY_LEN = pmt.intern("pay_len")


def load() -> Any:
    """The module.

    :raises BackendMissingError: if it is not installed
    """
    try:
        return import_module("gnuradio.lora_sdr")
    except ImportError as error:
        raise BackendMissingError(
            "phy lora: implementation 'lora_sdr' needs the GNU Radio module gr-lora_sdr "
            f"(https://github.com/tapparelj/gr-lora_sdr; {error}); or take 'own', at both ends"
        ) from error


@dataclass(frozen=True)
class SdrFrame:
    """The LoRa frame of a packet.

    :param sync_word: two nibbles, none of them 0
    :param ldro: low data rate optimisation: two bits fewer per symbol
    :param gap: zero samples after each packet
    :param carrier: the radio's carrier frequency divided by the chirp's bandwidth, None = unknown
    """

    packet_len: int
    spreading_factor: int
    coding_rate: int
    sync_word: int
    ldro: bool
    gap: int
    carrier: float | None = None

    @property
    def blocks(self) -> int:
        """Blocks of code words after the first."""
        nibbles = _HEADER_NIBBLES + 2 * (self.packet_len + CRC_LEN) + _CRC_NIBBLES - (self.spreading_factor - 2)
        return max(0, -(-nibbles // (self.spreading_factor - 2 * self.ldro)))

    @property
    def symbols(self) -> int:
        """Symbols after the preamble."""
        return _HEADER_SYMBOLS + self.blocks * (4 + self.coding_rate)

    @property
    def symbol_samples(self) -> int:
        """Samples of a symbol."""
        return PER_CHIP << self.spreading_factor

    @property
    def airtime_samples(self) -> int:
        """Samples of a frame, gap included."""
        quarters = 4 * (_PREAMBLE + self.symbols) + _HEAD_QUARTERS
        return quarters * self.symbol_samples // 4 + self.gap

    @property
    def carrier_and_bandwidth(self) -> tuple[int, int]:
        """Carrier frequency and bandwidth for the module: integers below 2^32."""
        if self.carrier is None:
            return _LARGEST, 1
        bandwidth = max(1, int(_LARGEST / self.carrier))
        return min(_LARGEST, round(self.carrier * bandwidth)), bandwidth

    def wrap(self, packet: bytes) -> bytes:
        """Nibbles of the frame: header, whitened payload, CRC-16 of the payload."""
        payload = packet + zlib.crc32(packet).to_bytes(CRC_LEN, "little")
        head = len(payload) << 4 | self.coding_rate << 1 | 1
        check = 0
        for bits in _HEADER_CHECKS:
            check = check << 1 | (head & bits).bit_count() & 1
        whitened = np.frombuffer(payload, np.uint8) ^ whitening(len(payload))
        crc = crc_hqx(payload[:-2], 0) ^ int.from_bytes(payload[-2:], "big")
        header = bytes((head >> 8, head >> 4 & 15, head & 15, check >> 4, check & 15))
        body = bytes(np.stack((whitened & 15, whitened >> 4), axis=1).reshape(-1))
        return header + body + bytes(crc >> shift & 15 for shift in (0, 4, 8, 12))

    def unwrap(self, payload: bytes) -> bytes | None:
        """The packet of a payload, or None if its CRC-32 does not match."""
        packet, crc = payload[: self.packet_len], payload[self.packet_len : self.packet_len + CRC_LEN]
        return packet if zlib.crc32(packet).to_bytes(CRC_LEN, "little") == crc else None


@lru_cache
def whitening(length: int) -> Octets:
    """LoRa's whitening sequence: x^8 + x^6 + x^5 + x^4 + 1, all ones at the start, one byte per step."""
    state, out = 0xFF, np.empty(length, np.uint8)
    for i in range(length):
        out[i] = state
        state = (state << 1 & 0xFF) | (state & 0xB8).bit_count() & 1
    return out


class SdrTransmitter(TransmitterBlock):
    """Message port `pdus` in, complex stream out: each packet is sent at once, followed by its gap."""

    def __init__(self, frame: SdrFrame) -> None:
        super().__init__("gr_ros2_lora_sdr_tx", frame.airtime_samples)
        lora = load()
        lift_message_limit()
        factor, rate = frame.spreading_factor, frame.coding_rate
        self._framer = _SdrFramer(frame)
        to_stream = pdu.pdu_to_tagged_stream(gr.types.byte_t, _TX_KEY)
        modulator = lora.modulate(factor, PER_CHIP, 1, [frame.sync_word], frame.gap, _PREAMBLE)
        self.msg_connect((self, "pdus"), (self._framer, "pdus"))
        self.msg_connect((self._framer, "pdus"), (to_stream, "pdus"))
        self.connect(
            to_stream,
            lora.hamming_enc(rate, factor),
            lora.interleaver(rate, factor, int(frame.ldro), 1),
            lora.gray_demap(factor),
            modulator,
        )
        self.leave_by(modulator)

    @property
    def refused(self) -> int:
        """PDUs that were not a packet of the right length."""
        return self._framer.refused


class _SdrFramer(TakesPackets, gr.basic_block):  # type: ignore[misc]
    """Message port `pdus` in, `pdus` out: nibbles of each packet's frame."""

    def __init__(self, frame: SdrFrame) -> None:
        super().__init__(range(frame.packet_len, frame.packet_len + 1), "gr_ros2_lora_sdr_framer", None, None)
        self._frame = frame
        self.message_port_register_out(PDUS)

    def take_packets(self, packets: list[AirPacket]) -> None:
        for packet in packets:
            self.message_port_pub(PDUS, pdu_of(self._frame.wrap(packet.data)))


class SdrReceiver(ReceiverBlock):
    """Complex stream in, message port `pdus` out: the packets whose CRC-32 is right."""

    def __init__(self, frame: SdrFrame) -> None:
        super().__init__("gr_ros2_lora_sdr_rx")
        lora = load()
        self._collector = _Collector(frame)
        factor = frame.spreading_factor
        # The module decimates without a filter, so that noise outside the band would alias into it.
        band = filter.fir_filter_ccf(1, firdes.low_pass(1, PER_CHIP, 0.52, 0.1, window.WIN_HAMMING))
        sync = lora.frame_sync(*frame.carrier_and_bandwidth, factor, False, [frame.sync_word], PER_CHIP, _PREAMBLE)
        header = lora.header_decoder(False, frame.coding_rate, MAX_PAYLOAD, True, int(frame.ldro), False)
        self.connect(
            self,
            band,
            sync,
            lora.fft_demod(True, True),
            lora.gray_mapping(True),
            lora.deinterleaver(True),
            lora.hamming_dec(True),
            header,
            lora.dewhitening(),
            self._collector,
        )
        self.msg_connect((header, "frame_info"), (sync, "frame_info"))
        self.msg_connect((self._collector, "pdus"), (self, "pdus"))

    @property
    def damaged(self) -> int:
        """Frames whose header was right, but whose length or CRC-32 was wrong."""
        return self._collector.damaged


class _Collector(KeptAlive, gr.sync_block):  # type: ignore[misc]
    """Bytes of frames in, message port `pdus` out."""

    def __init__(self, frame: SdrFrame) -> None:
        super().__init__("gr_ros2_lora_sdr_collector", [np.uint8], None)
        self._frame = frame
        self._payload = b""
        self._missing = 0
        self.damaged = 0
        self.message_port_register_out(PDUS)

    def work(self, input_items: list[Octets], output_items: list[Any]) -> int:  # noqa: ARG002
        octets = input_items[0]
        begin = self.nitems_read(0)
        cursor = 0
        for tag in self.get_tags_in_window(0, 0, len(octets), _FRAME):
            self._take(octets[cursor : tag.offset - begin])
            cursor = tag.offset - begin
            self._missing = pmt.to_long(pmt.dict_ref(tag.value, _PAY_LEN, pmt.PMT_NIL))
            self._payload = b""
        self._take(octets[cursor:])
        return len(octets)

    def _take(self, octets: Octets) -> None:
        if not self._missing:
            return
        new = octets[: self._missing]
        self._payload += new.tobytes()
        self._missing -= len(new)
        if self._missing:
            return
        packet = self._frame.unwrap(self._payload)
        if packet is None:
            self.damaged += 1
        else:
            self.message_port_pub(PDUS, pdu_of(packet))
