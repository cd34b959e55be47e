"""Packets in messages: fast conversion of bytes to PDUs and back, and several packets in one message.

Each message between two Python blocks costs as much time as a packet in source or sink. So a block that has several
packets at once sends them in one message, a *bundle*, if all blocks that read its port understand bundles. These are
blocks of this package; all other blocks get one PDU per packet.

Invariants: a PDU is a PMT pair of a dictionary and a u8vector; a bundle is a pair of the symbol ``bundle`` and a
u8vector with the head (``_HEAD_OF``) and the bytes of each packet. Of the metadata of a PDU, blocks of this package
read ``mcs``, ``snr_db``, ``received_at``, ``begins_at`` and ``leave_at`` only, and a bundle carries the same; the rest
is for people and other blocks.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from functools import partialmethod
from math import isfinite, nan
from struct import Struct
from types import SimpleNamespace
from typing import Any, ClassVar
from weakref import WeakSet

import pmt

from gr_ros2.link.events import AirPacket

PDUS, CREDIT = pmt.intern("pdus"), pmt.intern("credit")
"""The message ports of the blocks: packets, and the credits that request them."""


def port_of(name: str, radio: int) -> str:
    """The message port of a block for one of several radios: that of the first has no number."""
    return f"{name}_{radio + 1}" if radio else name


def take_messages(block: Any, name: str, handler: str, radios: int) -> None:
    """Have a block handle the messages for each of its radios: those of the first by its method of that name, those of
    others by a method that hands on their number as ``radio``.

    :param name: of the ports, see :func:`port_of`
    """
    for radio in range(radios):
        method = port_of(handler, radio)
        if not hasattr(block, method):
            own = partialmethod(getattr(type(block), handler), radio=radio)
            setattr(type(block), method, own)
        port = pmt.intern(port_of(name, radio))
        block.message_port_register_in(port)
        block.set_msg_handler(port, SimpleNamespace(__name__=method))  # GNU Radio looks the method up by this name


_BUNDLE = pmt.intern("bundle")
_MCS, _SNR_DB, _RECEIVED_AT, _BEGINS_AT, _LEAVE_AT = (
    pmt.intern(key) for key in ("mcs", "snr_db", "received_at", "begins_at", "leave_at")
)
_HEAD_OF = Struct(">Iddbf")
"""In a bundle, before each packet: its length in bytes, and ``at``, ``leave_at``, ``mcs`` and ``snr_db`` of
:class:`gr_ros2.link.events.AirPacket` (NaN for none, -1 for no ``mcs``)."""
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


def mcs_of(message: Any) -> int | None:
    """The MCS that the metadata of a PDU says; None if it says none."""
    mcs = _said(message, _MCS)
    return int(pmt.to_long(mcs)) if pmt.is_integer(mcs) else None


def leave_at_of(message: Any) -> float | None:
    """The time in s at which the burst of a PDU has to begin; None if its metadata says none."""
    return _number(message, _LEAVE_AT)


def _number(message: Any, key: Any) -> float | None:
    value = _said(message, key)
    if not pmt.is_number(value) or pmt.is_complex(value):
        return None
    number = float(pmt.to_double(value))
    return number if isfinite(number) else None


def _said(message: Any, key: Any) -> Any:
    metadata = pmt.car(message) if pmt.is_pair(message) else _NO_METADATA
    return pmt.dict_ref(metadata, key, pmt.PMT_NIL) if pmt.is_dict(metadata) else pmt.PMT_NIL


def packets_of(message: Any) -> tuple[list[AirPacket], str]:
    """The packets of a PDU or bundle and '', or no packets and the reason: ``not_a_pair`` or ``not_u8``."""
    if not pmt.is_pair(message):
        return [], "not_a_pair"
    vector = pmt.cdr(message)
    if not pmt.is_u8vector(vector):
        return [], "not_u8"
    data = octets(vector)
    metadata = pmt.car(message)
    if pmt.eq(metadata, _BUNDLE):
        return _unbundled(data), ""
    if not pmt.is_dict(metadata) or pmt.eq(metadata, _NO_METADATA):
        return [AirPacket(data)], ""
    received_at = _number(message, _RECEIVED_AT)
    at = _number(message, _BEGINS_AT) if received_at is None else received_at
    return [AirPacket(data, at, leave_at_of(message), mcs_of(message), _number(message, _SNR_DB))], ""


def _unbundled(data: bytes) -> list[AirPacket]:
    """The packets of a bundle; a packet that is cut off ends it."""
    packets = []
    start = _HEAD_OF.size
    while start <= len(data):
        length, at, leave_at, mcs, snr_db = _HEAD_OF.unpack_from(data, start - _HEAD_OF.size)
        end = start + length
        mcs = None if mcs < 0 else mcs
        packets.append(AirPacket(data[start:end], _known(at), _known(leave_at), mcs, _known(snr_db)))
        start = end + _HEAD_OF.size
    return packets


def _known(number: float) -> float | None:
    return number if isfinite(number) else None


def _bundled(packet: AirPacket) -> bytes:
    data, at, leave_at, mcs, snr_db = packet
    head = _HEAD_OF.pack(
        len(data),
        nan if at is None else at,
        nan if leave_at is None else leave_at,
        -1 if mcs is None else mcs,
        nan if snr_db is None else snr_db,
    )
    return head + data


class PduPort:
    """Message port `pdus` out of a Python block.

    :param block: the block
    :param name: of the port, where the block has several
    """

    _readers: ClassVar[WeakSet[Any]] = WeakSet()
    """The blocks that understand bundles."""
    _lock: ClassVar[threading.Lock] = threading.Lock()

    def __init__(self, block: Any, name: str = "pdus") -> None:
        self._port = pmt.intern(name)
        block.message_port_register_out(self._port)
        self._subscribers = block.message_subscribers
        self._publish = block.message_port_pub  # stored: each look-up would pass through two proxies
        self.bundles = False
        """Whether all readers understand bundles."""

    @classmethod
    def readable_by(cls, block: Any) -> None:
        """A block's port `pdus` in understands bundles; call this in its constructor."""
        with cls._lock:
            cls._readers.add(block)

    def find_readers(self) -> bool:
        """Find out who reads this port; call this in the block's ``start``.

        :return: whether anybody does
        """
        with self._lock:
            known = {block.alias() for block in self._readers}
        readers = set()
        rest = self._subscribers(self._port)
        while pmt.is_pair(rest):
            readers.add(pmt.symbol_to_string(pmt.car(pmt.car(rest))))
            rest = pmt.cdr(rest)
        self.bundles = bool(readers) and readers <= known
        return bool(readers)

    def send(self, packets: Sequence[AirPacket]) -> None:
        """Send packets: to readers that do not understand bundles, only packets that were received."""
        if self.bundles and len(packets) > 1:
            self._publish(self._port, pmt.cons(_BUNDLE, u8vector(b"".join(map(_bundled, packets)))))
        else:
            for packet in packets:
                self._publish(self._port, pdu_heard(packet))

    def send_pdu(self, pdu: Any) -> None:
        """Send one packet as a PDU with metadata."""
        self._publish(self._port, pdu)


def credit_of(packets: int, since: float) -> Any:
    """The credit for so many further packets.

    :param since: s on the clock of both blocks, since when the air is free for them; infinite = they were held back
        until now, by a limit or a switch
    """
    return pmt.cons(pmt.from_long(packets), pmt.from_double(since))


def credited(message: Any) -> tuple[int, float | None]:
    """What a credit says: how many packets, and since when the air is free for them. An integer alone says how many,
    any other message stands for one packet; both say nothing of the air (None)."""
    if pmt.is_pair(message) and pmt.is_integer(pmt.car(message)) and pmt.is_real(pmt.cdr(message)):
        return int(pmt.to_long(pmt.car(message))), float(pmt.to_double(pmt.cdr(message)))
    return (int(pmt.to_long(message)) if pmt.is_integer(message) else 1), None
