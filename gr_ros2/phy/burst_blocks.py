"""GNU Radio shells around a burst modem: PDUs in, samples out, and back.

Laws: a PDU that is not one packet of the right length is counted and dropped, never sent; each burst leaves at once,
tagged with its length, its gap behind it; all behaviour is in the modem.
"""

from __future__ import annotations

import logging
from abc import abstractmethod
from collections import deque
from typing import Annotated, Any

import numpy as np
import pmt
from gnuradio import filter, gr, pdu
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from gr_ros2.phy.base import Phy
from gr_ros2.phy.burst import BurstModem, BurstReceiver, Samples
from gr_ros2.phy.fec import CodeName
from gr_ros2.phy.tap import SymbolTap
from gr_ros2.phy.threads import BlockThread, keep_messages, only_warnings

_PDUS = pmt.intern("pdus")
_TX_KEY = "gr_ros2_tx_len"
_SAMPLE_LEN = 8
_SMALLEST_BUFFER = 32768
_U8_OFFSET = 8
"""A serialized u8vector: type 10, kind 0, length u32 big-endian, one byte of padding and its count, then the bytes."""
_log = logging.getLogger(__name__)

_alive: set[Any] = set()
_stopped: deque[Any] = deque(maxlen=32)
"""GNU Radio calls Python blocks without holding a reference, so a flowgraph whose maker dropped the hier block around
them would crash. They are held here until they have stopped, and a while longer, since a flowgraph may start again; not
for ever, since a block holds the buffers in front of it."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class BurstOptions:
    """Settings that every burst PHY has.

    :param gap: zero samples after each packet, 16..100000; fewer would keep the last packet waiting for the next
    :param fec: forward error correction: none, cc (convolutional, constraint length 7, rate 1/2), ldpc or polar
    """

    gap: Annotated[int, Field(ge=16, le=100_000)] = 32
    fec: CodeName = "none"


class BurstPhy(Phy):
    """A PHY made of a burst modem; a subclass sets ``modem`` and ``gap`` (zero samples after each burst)."""

    has_samples = True
    modem: BurstModem
    gap: int

    def airtime_samples(self) -> int:
        return self.modem.burst_samples + self.gap

    @property
    @abstractmethod
    def receiver_taps(self) -> Any:
        """The filter the samples pass before the modem sees them; None = none."""

    def transmitter(self) -> BurstTransmitter:
        return BurstTransmitter(self)

    def receiver(self) -> BurstSink:
        return BurstSink(self)


class BurstTransmitter(gr.hier_block2):  # type: ignore[misc]
    """Message port `pdus` in, complex stream out."""

    def __init__(self, phy: BurstPhy) -> None:
        super().__init__(f"gr_ros2_{phy.name}_tx", gr.io_signature(0, 0, 0), gr.io_signature(1, 1, _SAMPLE_LEN))
        keep_messages()
        self.message_port_register_hier_in("pdus")
        self._airtime_samples = phy.airtime_samples()
        self._modulator = _Modulator(phy)
        with only_warnings():
            self._to_stream = pdu.pdu_to_tagged_stream(gr.types.complex_t, _TX_KEY)
        if 2 * _SAMPLE_LEN * self._airtime_samples > _SMALLEST_BUFFER:
            self._to_stream.set_min_output_buffer(2 * self._airtime_samples)
        self.msg_connect((self, "pdus"), (self._modulator, "pdus"))
        self.msg_connect((self._modulator, "pdus"), (self._to_stream, "pdus"))
        self.connect(self._to_stream, self)

    def packets_sent(self) -> int:
        """Packets that have left as samples; 0 before the flowgraph runs."""
        try:
            return int(self._to_stream.nitems_written(0)) // self._airtime_samples
        except RuntimeError:  # GNU Radio's counters exist while the block is part of a running flowgraph only
            return 0

    @property
    def refused(self) -> int:
        """PDUs that were no packet of the right length."""
        return self._modulator.refused


class _Modulator(gr.basic_block):  # type: ignore[misc]
    """Message port `pdus` in, `pdus` out: a packet's burst and gap as bytes."""

    def __init__(self, phy: BurstPhy) -> None:
        super().__init__(f"gr_ros2_{phy.name}_modulator", None, None)
        self._modem = phy.modem
        self._gap = [0j] * phy.gap
        self._packet_len = phy.packet_len
        self.refused = 0
        self._block_thread = BlockThread()
        self.message_port_register_in(_PDUS)
        self.message_port_register_out(_PDUS)
        self.set_msg_handler(_PDUS, self._send)
        _alive.add(self)

    def start(self) -> bool:
        _alive.add(self)
        self._block_thread.keep()
        return True

    def stop(self) -> bool:
        self._block_thread.release()
        _alive.discard(self)
        _stopped.append(self)
        return True

    def _send(self, message: Any) -> None:
        vector = pmt.cdr(message) if pmt.is_pair(message) else message
        if not pmt.is_u8vector(vector) or pmt.length(vector) != self._packet_len:
            self.refused += 1
            if self.refused == 1:
                _log.warning("%s: dropped a PDU that is not %d bytes", self.name(), self._packet_len)
            return
        burst = self._modem.modulate(pmt.serialize_str(vector)[_U8_OFFSET:])
        samples = burst.tolist() + self._gap
        self.message_port_pub(_PDUS, pmt.cons(pmt.make_dict(), pmt.init_c32vector(len(samples), samples)))


class BurstSink(gr.hier_block2):  # type: ignore[misc]
    """Complex stream in, message port `pdus` out: the packets whose CRC-32 is right."""

    def __init__(self, phy: BurstPhy) -> None:
        super().__init__(f"gr_ros2_{phy.name}_rx", gr.io_signature(1, 1, _SAMPLE_LEN), gr.io_signature(0, 0, 0))
        self.message_port_register_hier_out("pdus")
        self._demodulator = _Demodulator(phy)
        if phy.receiver_taps is None:
            self.connect(self, self._demodulator)
        else:
            self.connect(self, filter.fir_filter_ccf(1, phy.receiver_taps), self._demodulator)
        self.msg_connect((self._demodulator, "pdus"), (self, "pdus"))

    @property
    def damaged(self) -> int:
        """Bursts found whose CRC-32 was wrong."""
        return self._demodulator.damaged

    def tap_symbols(self) -> SymbolTap:
        """Let the points that packets are read from be seen."""
        return SymbolTap(self._demodulator.points)


class _Demodulator(gr.sync_block):  # type: ignore[misc]
    """Filtered samples in, message port `pdus` out."""

    def __init__(self, phy: BurstPhy) -> None:
        super().__init__(f"gr_ros2_{phy.name}_demodulator", [np.complex64], None)
        self._modem = phy.modem
        self._engine: BurstReceiver | None = None
        self._damaged = 0
        self._block_thread = BlockThread()
        self.message_port_register_out(_PDUS)
        _alive.add(self)

    @property
    def damaged(self) -> int:
        return self._damaged + (self._engine.damaged if self._engine is not None else 0)

    def points(self) -> Samples:
        """What the newest packet was read from; empty before the first."""
        engine = self._engine
        return np.empty(0, np.complex64) if engine is None else engine.points

    def start(self) -> bool:
        _alive.add(self)
        self._block_thread.keep()
        self._engine = BurstReceiver(self._modem)
        return True

    def stop(self) -> bool:
        self._damaged, self._engine = self.damaged, None
        self._block_thread.release()
        _alive.discard(self)
        _stopped.append(self)
        return True

    def work(self, input_items: list[Samples], output_items: list[Any]) -> int:  # noqa: ARG002
        assert self._engine is not None
        for packet in self._engine.feed(input_items[0]):
            self.message_port_pub(_PDUS, pdu_of(packet))
        return len(input_items[0])


def pdu_of(data: bytes) -> Any:
    """A packet as a PDU without metadata."""
    # Nine times as fast as pmt.to_pmt of an array, and for long packets as pmt.init_u8vector.
    vector = pmt.deserialize_str(b"\n\x00" + len(data).to_bytes(4, "big") + b"\x01\x00" + data)
    return pmt.cons(pmt.make_dict(), vector)
