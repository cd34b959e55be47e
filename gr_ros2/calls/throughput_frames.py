"""The bytes with which a robot asks another one to measure what the link between them carries, and those of the answers
and of what crosses meanwhile: payloads of calls of ``OF_LINK``, and messages of a topic of ``FILLER_TYPE``.

Invariants: reading raises nothing but a named WireError; what is written is read as it was.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from math import isnan, nan
from struct import Struct

from gr_ros2.core.errors import EncodeError, EntryBoundsError, EntryKindError

LONGEST_S = 60
"""s that one direction is measured at most."""
MEASURE, REPORT = 3, 4
"""First byte of a request: to take part in a measurement, and to tell what has arrived."""
_REQUEST = Struct(">BIB")
_ANSWER = Struct(">BIIIIffff")


class MeasureOutcome(IntEnum):
    """What a robot answers."""

    RUNS = 0
    BUSY = 1
    """Another measurement goes on there."""
    SENDS_NOT = 2
    UNKNOWN = 3
    """It has never begun that measurement, or forgotten it."""


@dataclass(frozen=True, slots=True)
class MeasureRequest:
    """A measurement, or a question for what has come of it.

    :param number: of the measurement
    :param for_s: whole s for each direction, 1..60
    """

    kind: int
    number: int
    for_s: int


@dataclass(frozen=True, slots=True)
class Carried:
    """What one end has received in a measurement so far.

    :param sent: messages that it has sent for the measurement
    :param messages, size, span_ms: those that it has received: number, bytes of all but the first, and ms from the
        first to the last
    :param topics_per_s: messages/s of the other robot's topics, beside
    :param age_s, quiet_age_s: mean age of those topics' newest messages while they shared the air, and before, s; NaN
        where there are none
    :param worst_age_s: the highest of the former
    """

    outcome: MeasureOutcome
    sent: int = 0
    messages: int = 0
    size: int = 0
    span_ms: int = 0
    topics_per_s: float = 0.0
    age_s: float = nan
    quiet_age_s: float = nan
    worst_age_s: float = nan

    @property
    def rate_Bps(self) -> float | None:
        """Bytes/s of the measurement's messages; None before two have come."""
        return self.size / self.span_ms * 1e3 if self.span_ms else None


def write_measure(request: MeasureRequest) -> bytes:
    """The bytes of a request.

    :raises EncodeError: a field out of range
    """
    if request.kind not in (MEASURE, REPORT) or not 1 <= request.for_s <= LONGEST_S:
        raise EncodeError(f"a measurement of {request.for_s} s")
    return _REQUEST.pack(request.kind, request.number, request.for_s)


def read_measure(data: bytes) -> MeasureRequest:
    """The request of these bytes.

    :raises WireError: EntryBoundsError (not as long as one) or EntryKindError (a field that cannot be)
    """
    if len(data) != _REQUEST.size:
        raise EntryBoundsError(f"a request to measure has {len(data)} bytes")
    kind, number, for_s = _REQUEST.unpack(data)
    if kind not in (MEASURE, REPORT) or not 1 <= for_s <= LONGEST_S:
        raise EntryKindError(f"a measurement of kind {kind}, {for_s} s")
    return MeasureRequest(kind, number, for_s)


def write_measured(told: Carried) -> bytes:
    """The bytes of an answer."""
    counts = (min(count, 2**32 - 1) for count in (told.sent, told.messages, told.size, told.span_ms))
    return _ANSWER.pack(told.outcome, *counts, told.topics_per_s, told.age_s, told.quiet_age_s, told.worst_age_s)


def read_measured(data: bytes) -> Carried:
    """The answer of these bytes.

    :raises WireError: as :func:`read_measure`
    """
    if len(data) != _ANSWER.size:
        raise EntryBoundsError(f"what was measured has {len(data)} bytes")
    outcome, sent, messages, size, span_ms, topics, age, quiet, worst = _ANSWER.unpack(data)
    if outcome not in list(MeasureOutcome) or not 0 <= topics < 2**32 or not all(map(_is_age, (age, quiet, worst))):
        raise EntryKindError(f"outcome {outcome}, {topics} messages/s in what was measured")
    return Carried(MeasureOutcome(outcome), sent, messages, size, span_ms, topics, age, quiet, worst)


def _is_age(seconds: float) -> bool:
    """Whether it can be an age: below zero it is the error of a clock."""
    return isnan(seconds) or abs(seconds) < 2**32
