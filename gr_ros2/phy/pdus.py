"""Fast conversion of bytes to PDUs and back.

Invariant: a PDU is a PMT pair of a dictionary and a u8vector.
"""

from __future__ import annotations

from typing import Any

import pmt

PDUS, CREDIT = pmt.intern("pdus"), pmt.intern("credit")
"""The message ports of the blocks: packets, and the credits that request them."""

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


def pdu_of(data: bytes) -> Any:
    """A packet as a PDU without metadata."""
    return pmt.cons(_NO_METADATA, u8vector(data))
