"""Packets between blocks: as PDUs, or as they are, and the fast conversion of bytes to PDUs and back.

A message between two Python blocks costs as much time as a packet in source or sink, and wakes a thread. So where all
blocks that read a port are of this package, its block calls them, in its own thread, with the packets as they are. All
other blocks get a PDU per packet.

Invariants: a PDU is a PMT pair of a dictionary and a u8vector. Of its metadata, blocks of this package read ``mcs``,
``snr_db``, ``received_at``, ``begins_at`` and ``leave_at`` only, which are what a packet says that is handed over as it
is; the rest is for people and other blocks. Nobody sends while it holds a lock.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import partialmethod
from math import isfinite
from types import SimpleNamespace
from typing import Any, ClassVar
from weakref import WeakSet

import pmt

from gr_ros2.link.events import AirPacket

PDUS = pmt.intern("pdus")
"""The message port of the blocks for packets."""


def port_of(name: str, radio: int) -> str:
    """The message port of a block for one of several radios: that of the first has no number."""
    return f"{name}_{radio + 1}" if radio else name


def take_messages(block: Any, name: str, handler: str, radios: int = 1, *, called: str = "") -> None:
    """Have a block handle what comes for each of its radios: that of the first by its method of that name, that of
    others by a method that hands on their number as ``radio``.

    :param name: of the ports, see :func:`port_of`
    :param handler: the method that takes messages
    :param called: the method that blocks of this package call instead, with what their port sends; '' = none
    """
    for radio in range(radios):
        port = port_of(name, radio)
        block.message_port_register_in(pmt.intern(port))
        handles = SimpleNamespace(__name__=_method(block, handler, radio))
        block.set_msg_handler(pmt.intern(port), handles)  # GNU Radio looks the method up by this name
        if called:
            _OutPort.readable(block, port, _method(block, called, radio))


def _method(block: Any, name: str, radio: int) -> str:
    own = port_of(name, radio)
    if not hasattr(block, own):
        setattr(type(block), own, partialmethod(getattr(type(block), name), radio=radio))
    return own


_MCS, _SNR_DB, _RECEIVED_AT, _BEGINS_AT, _LEAVE_AT = (
    pmt.intern(key) for key in ("mcs", "snr_db", "received_at", "begins_at", "leave_at")
)
_NO_METADATA = pmt.make_dict()
_HEAD = b"\n\x00"
_OFFSET = 8
"""A serialized u8vector: type 10, kind 0, length u32 big-endian, one byte of padding and its count, then the bytes."""


def u8vector(data: bytes) -> Any:
    """Bytes as a u8vector."""
    # Nine times as fast as pmt.to_pmt of an array; also, for long packets, as pmt.init_u8vector.
    return pmt.deserialize_str(_HEAD + len(data).to_bytes(4, "big") + b"\x01\x00" + data)


def octets(vector: Any) -> bytes:
    """The bytes of a u8vector."""
    serialized: bytes = pmt.serialize_str(vector)
    return serialized[_OFFSET:]


def pdu_of(data: bytes, metadata: Any = _NO_METADATA) -> Any:
    """A packet as a PDU."""
    return pmt.cons(metadata, u8vector(data))


def pdu_to_send(packet: AirPacket, metadata: Any = _NO_METADATA) -> Any:
    """A packet as a PDU whose metadata also says its MCS and when its burst has to begin, if it has them."""
    if packet.mcs is not None:
        metadata = pmt.dict_add(metadata, _MCS, pmt.from_long(packet.mcs))
    if packet.leave_at is not None:
        metadata = pmt.dict_add(metadata, _LEAVE_AT, pmt.from_double(packet.leave_at))
    return pdu_of(packet.data, metadata)


def with_begin(pdu: Any, begins_at: float) -> Any:
    """A PDU with metadata that says when the packet's burst begins, s."""
    metadata = pmt.car(pdu)
    metadata = metadata if pmt.is_dict(metadata) else _NO_METADATA
    return pmt.cons(pmt.dict_add(metadata, _BEGINS_AT, pmt.from_double(begins_at)), pmt.cdr(pdu))


def pdu_heard(packet: AirPacket) -> Any:
    """A packet that was received as a PDU."""
    metadata = _NO_METADATA if packet.mcs is None else pmt.dict_add(_NO_METADATA, _MCS, pmt.from_long(packet.mcs))
    for key, value in ((_SNR_DB, packet.snr_db), (_RECEIVED_AT, packet.at)):
        if value is not None:
            metadata = pmt.dict_add(metadata, key, pmt.from_double(value))
    return pdu_of(packet.data, metadata)


def _number(metadata: Any, key: Any) -> float | None:
    value = pmt.dict_ref(metadata, key, pmt.PMT_NIL)
    if not pmt.is_number(value) or pmt.is_complex(value):
        return None
    number = float(pmt.to_double(value))
    return number if isfinite(number) else None


def packets_of(message: Any) -> tuple[list[AirPacket], str]:
    """The packets of a PDU and '', or no packets and the reason: ``not_a_pair`` or ``not_u8``."""
    if not pmt.is_pair(message):
        return [], "not_a_pair"
    vector = pmt.cdr(message)
    if not pmt.is_u8vector(vector):
        return [], "not_u8"
    data = octets(vector)
    metadata = pmt.car(message)
    if not pmt.is_dict(metadata) or pmt.eq(metadata, _NO_METADATA):
        return [AirPacket(data)], ""
    mcs, received_at = pmt.dict_ref(metadata, _MCS, pmt.PMT_NIL), _number(metadata, _RECEIVED_AT)
    at = _number(metadata, _BEGINS_AT) if received_at is None else received_at
    number = int(pmt.to_long(mcs)) if pmt.is_integer(mcs) else None
    return [AirPacket(data, at, _number(metadata, _LEAVE_AT), number, _number(metadata, _SNR_DB))], ""


class _OutPort:
    """Message port out of a Python block.

    :param block: the block
    :param name: of the port
    :ivar direct: whether all readers are called; known after :meth:`find_readers`
    """

    _readers: ClassVar[WeakSet[Any]] = WeakSet()
    """The blocks that can be called."""
    _lock: ClassVar[threading.Lock] = threading.Lock()

    def __init__(self, block: Any, name: str) -> None:
        self._port = pmt.intern(name)
        block.message_port_register_out(self._port)
        self._subscribers = block.message_subscribers
        self._publish = block.message_port_pub  # stored: each look-up would pass through two proxies
        self._calls: list[Callable[..., None]] = []
        self.direct = False

    @classmethod
    def readable(cls, block: Any, port: str, method: str) -> None:
        """What is sent to a port of a block may be handed over by a call of a method."""
        with cls._lock:
            if block not in cls._readers:
                cls._readers.add(block)
                block.called_for = {}
            block.called_for[port] = method

    def find_readers(self) -> bool:
        """Find out who reads this port; call this in the block's ``start``.

        :return: whether anybody does
        """
        with self._lock:
            known = {block.alias(): block for block in self._readers}
        calls: list[Callable[..., None] | None] = []
        rest = self._subscribers(self._port)
        while pmt.is_pair(rest):
            reader, port = pmt.car(pmt.car(rest)), pmt.cdr(pmt.car(rest))
            calls.append(self._call_of(known.get(pmt.symbol_to_string(reader)), pmt.symbol_to_string(port)))
            rest = pmt.cdr(rest)
        self._calls = [call for call in calls if call is not None]
        self.direct = bool(calls) and len(self._calls) == len(calls)
        return bool(calls)

    @staticmethod
    def _call_of(block: Any, port: str) -> Callable[..., None] | None:
        """The method of a block that takes what a port sends; None where only a message can be sent to it.

        What a block passes on to others, it has to get as they need it.
        """
        method = None if block is None else block.called_for.get(port)
        behind: PduPort | None = getattr(block, "passes_on_to", None)
        if method is None or (behind is not None and not (behind.find_readers() and behind.direct)):
            return None
        call: Callable[..., None] = getattr(block, method)
        return call


class PduPort(_OutPort):
    """Message port `pdus` out of a Python block."""

    def __init__(self, block: Any, name: str = "pdus") -> None:
        super().__init__(block, name)

    def send(self, packets: Sequence[AirPacket]) -> None:
        """Send packets: to readers that cannot be called, only packets that were received."""
        if not packets:
            return
        if self.direct:
            for call in self._calls:
                call(packets)
        else:
            for packet in packets:
                self._publish(self._port, pdu_heard(packet))

    def send_pdu(self, pdu: Any) -> None:
        """Send one packet as a PDU with metadata, to readers that cannot be called."""
        self._publish(self._port, pdu)


class CreditPort(_OutPort):
    """Message port `credit` out of a Python block."""

    def __init__(self, block: Any) -> None:
        super().__init__(block, "credit")

    def grant(self, packets: int, since: float | None) -> None:
        """Give credits; see :func:`credit_of`."""
        if self.direct:
            for call in self._calls:
                call(packets, since)
        else:
            self._publish(self._port, credit_of(packets, since))


def credit_of(packets: int, since: float | None) -> Any:
    """The credit for so many further packets.

    :param since: s on the clock of both blocks, since when the air is free for them; infinite = they were held back
        until now, by a limit or a switch; None = nothing is known of the air
    """
    if since is None:
        return pmt.from_long(packets)
    return pmt.cons(pmt.from_long(packets), pmt.from_double(since))


def credited(message: Any) -> tuple[int, float | None]:
    """What a credit says: how many packets, and since when the air is free for them. An integer alone says how many,
    any other message stands for one packet; both say nothing of the air (None)."""
    if pmt.is_pair(message) and pmt.is_integer(pmt.car(message)) and pmt.is_real(pmt.cdr(message)):
        return int(pmt.to_long(pmt.car(message))), float(pmt.to_double(pmt.cdr(message)))
    return (int(pmt.to_long(message)) if pmt.is_integer(message) else 1), None
