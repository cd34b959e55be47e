"""The bytes with which a robot asks another one for topics, and those of the answers: the payloads of calls of
``OF_LINK`` (docs/reference/wire-format.md).

Invariants: reading raises nothing but a named WireError; what is written is read as it was.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from math import inf
from struct import Struct

from gr_ros2.core.errors import EncodeError, EntryBoundsError, EntryKindError

LONGEST_S = 65535
"""s for which a wish can be made."""
MOST_RATE = 1e6
MOST_OFFERS = 512
"""Rows of a list of what is offered."""
_MOST_BYTES = 2.0**32
_LIST, _WANT, _GIVE_UP = range(3)
_WISH = Struct(">fH")
_ANSWER = Struct(">Bfff")
_ROW = Struct(">BffBB")


class WishOutcome(IntEnum):
    """What became of a wish."""

    SENT = 0
    """It is sent from now on, or is sent already."""
    NOT_OFFERED = 1
    NO_ROOM = 2
    """It would take more of the air than is free."""
    TOO_MANY = 3
    """The robot that asks has too many wishes."""
    NOT_FOR_YOU = 4
    """It is sent to another robot alone."""
    FAILED = 5
    """It cannot be sent, for instance because a link carries no more topics."""
    SENT_ANYWAY = 6
    """It is sent whether somebody asks or not."""


@dataclass(frozen=True, slots=True)
class ListRequest:
    """What is offered?"""


@dataclass(frozen=True, slots=True)
class WishRequest:
    """A topic is wanted.

    :param name: as in the list of what is offered
    :param rate: messages/s at most; 0 = as they come
    :param for_s: whole s after which the wish ends, unless it is renewed, 1..65535
    """

    name: str
    rate: float
    for_s: int


@dataclass(frozen=True, slots=True)
class GiveUp:
    """A topic is wanted no more."""

    name: str


@dataclass(frozen=True, slots=True)
class WishAnswer:
    """What became of a wish.

    :param rate: messages/s that are sent at most, or where there is no room, that would fit; 0 = as they come, or none
    :param cost: bytes/s that the wish takes; 0 = not known
    :param free: bytes/s that are free; infinite where the air has no known limit
    """

    outcome: WishOutcome
    rate: float = 0.0
    cost: float = 0.0
    free: float = inf


@dataclass(frozen=True, slots=True)
class OfferRow:
    """A topic, service or action that a robot offers.

    :param rate: messages/s that come on its graph; 0 where it is not known
    :param size: bytes of a message as it is sent, on average; 0 where it is not known
    :param wanted: whether somebody wants it now
    :param fits: whether it is made to fit what is free, as pictures are
    """

    name: str
    type_name: str
    rate: float = 0.0
    size: float = 0.0
    wanted: bool = False
    fits: bool = False


LinkRequest = ListRequest | WishRequest | GiveUp


def write_request(request: LinkRequest) -> bytes:
    """The bytes of a request.

    :raises EncodeError: a field out of range
    """
    match request:
        case ListRequest():
            return bytes((_LIST,))
        case WishRequest(name, rate, for_s):
            if not 0 <= rate <= MOST_RATE or not 1 <= for_s <= LONGEST_S:
                raise EncodeError(f"a wish for {name}: rate {rate}, {for_s} s")
            return bytes((_WANT,)) + _WISH.pack(rate, for_s) + _name(name)
        case GiveUp(name):
            return bytes((_GIVE_UP,)) + _name(name)


def read_request(data: bytes) -> LinkRequest:
    """The request of these bytes.

    :raises WireError: EntryBoundsError (cut off) or EntryKindError (a kind or a field that cannot be)
    """
    kind = data[0] if data else -1
    if kind == _LIST and len(data) == 1:
        return ListRequest()
    if kind == _GIVE_UP:
        return GiveUp(_text(data[1:]))
    if kind != _WANT:
        raise EntryKindError(f"kind {kind} in a request to a link")
    if len(data) < 1 + _WISH.size:
        raise EntryBoundsError(f"a wish ends at byte {len(data)}")
    rate, for_s = _WISH.unpack_from(data, 1)
    if not 0 <= rate <= MOST_RATE or not for_s:
        raise EntryKindError(f"a wish for {rate}/s, {for_s} s")
    return WishRequest(_text(data[1 + _WISH.size :]), rate, for_s)


def write_answer(answer: WishAnswer) -> bytes:
    """The bytes of the answer to a wish, and to giving one up."""
    return _ANSWER.pack(answer.outcome, answer.rate, answer.cost, answer.free)


def read_answer(data: bytes) -> WishAnswer:
    """The answer of these bytes.

    :raises WireError: EntryBoundsError (not as long as an answer) or EntryKindError (a field that cannot be)
    """
    if len(data) != _ANSWER.size:
        raise EntryBoundsError(f"the answer to a wish has {len(data)} bytes")
    outcome, rate, cost, free = _ANSWER.unpack(data)
    if outcome not in list(WishOutcome) or not (0 <= rate < inf and 0 <= cost < inf and free >= 0):
        raise EntryKindError(f"outcome {outcome}, {rate}/s, {cost} of {free} bytes/s in the answer to a wish")
    return WishAnswer(WishOutcome(outcome), rate, cost, free)


def write_offers(rows: Iterable[OfferRow]) -> bytes:
    """The bytes of a list of what is offered."""
    return b"".join(
        _ROW.pack(row.wanted | row.fits << 1, row.rate, row.size, len(name), len(kind)) + name + kind
        for row in rows
        for name, kind in ((_name(row.name), _name(row.type_name)),)
    )


def read_offers(data: bytes) -> list[OfferRow]:
    """The rows of these bytes.

    :raises WireError: as :func:`read_answer`
    """
    rows: list[OfferRow] = []
    at = 0
    while at < len(data):
        if len(data) < at + _ROW.size:
            raise EntryBoundsError(f"a list of offers ends at byte {len(data)}")
        flags, rate, size, names, kinds = _ROW.unpack_from(data, at)
        at, begin = at + _ROW.size + names + kinds, at + _ROW.size
        if len(data) < at:
            raise EntryBoundsError(f"a list of offers ends at byte {len(data)}")
        if flags > 3 or not (0 <= rate <= MOST_RATE and 0 <= size <= _MOST_BYTES) or len(rows) == MOST_OFFERS:
            raise EntryKindError(f"flags {flags}, {rate}/s, {size} bytes in row {len(rows)} of a list of offers")
        name, kind = _text(data[begin : begin + names]), _text(data[begin + names : at])
        rows.append(OfferRow(name, kind, rate, size, bool(flags & 1), bool(flags & 2)))
    return rows


def _name(text: str) -> bytes:
    data = text.encode()
    if not 0 < len(data) < 256 or not text.isprintable():
        raise EncodeError(f"{text!r} as a name in a request to a link")
    return data


def _text(data: bytes) -> str:
    if not 0 < len(data) < 256:
        raise EntryBoundsError(f"a name of {len(data)} bytes in a request to a link")
    try:
        text = data.decode()
    except UnicodeDecodeError as error:
        raise EntryKindError("a name that is no UTF-8 in a request to a link") from error
    if not text.isprintable():
        raise EntryKindError(f"{text!r} as a name in a request to a link")
    return text
