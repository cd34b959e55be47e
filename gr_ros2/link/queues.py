"""The queues of the source, one per topic, and which messages they drop: whole messages, never fragments.

Invariants: a message that is being sent is first in its queue, and no newer message replaces it; every dropped message
is returned with its fate. Fates: ``superseded`` (latest: a newer one came), ``queue_bound`` (fifo: the oldest,
when full), ``overload`` (fifo: the oldest, while the computer is too slow), ``stale`` (its deadline passed),
``cannot_complete`` (not started: even alone on the link it would be late), ``abandoned`` (started, and it would be
late).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice, takewhile
from math import inf
from typing import Generic, TypeVar

from gr_ros2.link.fates import Fate
from gr_ros2.link.instances import ALL, Keys, replaced
from gr_ros2.settings.commands import COMMAND_DEADLINE_S
from gr_ros2.settings.config import QueuePolicy, SendOptions
from gr_ros2.settings.fields import AUTO
from gr_ros2.wire import QOS_DEFAULT, QOS_LATENCY, QOS_NAMES

OVERLOAD_S = 0.25
"""s for which a message of a stream waits at most while the computer is too slow. At a third of the processor time that
the demo needs (``python -m bench slow_computer``), its IMU was 1.9 s old where only the queue's bound dropped. With 0.5
s its oldest topic was 0.7 to 1.6 s old, with 0.25 s 0.8 s."""

OVERLOADED = f"it waited for {OVERLOAD_S:g} s and newer ones came"


@dataclass(slots=True, eq=False)
class Outgoing:
    """A message being sent.

    :param serial: number of the submitted message
    :param payload: the bytes that are sent: the message, coded if the link compresses
    :param qos: QoS class of its entries
    :param submitted: time of submission, s
    :param weight: weight of its age relative to other topics
    :param lifespan_s: s after which the message is useless, where its queue's deadline is later
    :param expires: time after which the message is useless, s
    :param repeat: the message was sent before, and is sent again for robots that join late (transient-local topics)
    :param index: next fragment to send
    :param offset: bytes sent
    :param keys: the instances that it speaks of; it replaces messages of no others
    :param released: ``max_rate`` lets it start, together with those that waited beside it
    """

    serial: int
    topic_id: int
    payload: bytes
    qos: int
    submitted: float
    weight: float = 1.0
    lifespan_s: float = inf
    expires: float = inf
    repeat: bool = False
    index: int = 0
    offset: int = 0
    keys: Keys = ALL
    released: bool = False

    @property
    def started(self) -> bool:
        """Whether at least one fragment has left."""
        return self.index > 0

    @property
    def remaining(self) -> int:
        """Bytes not yet sent."""
        return len(self.payload) - self.offset

    def take(self, length: int) -> bytes:
        """The next fragment, of this many bytes."""
        payload = self.payload[self.offset : self.offset + length]
        self.index += 1
        self.offset += length
        return payload


M = TypeVar("M", bound=Outgoing)


@dataclass(frozen=True, slots=True)
class Dropped(Generic[M]):
    """A message that will not be sent: its fate, and why in words."""

    message: M
    fate: Fate
    detail: str


@dataclass(frozen=True, slots=True)
class PublisherQos:
    """The QoS that all publishers of a topic offer.

    :param reliable: whether all are reliable
    :param latched: whether all keep messages for late joiners (transient-local)
    :param depth: depth of their history, 0 for unbounded or unknown
    :param lifespan_s: s after which a message is useless, 0 without limit
    :param period_s: their deadline: s within which they promise a message, 0 for no promise
    :param count: number of publishers
    :param keeps: how many messages they keep together for late joiners
    """

    reliable: bool = True
    latched: bool = False
    depth: int = 0
    lifespan_s: float = 0.0
    period_s: float = 0.0
    count: int = 1
    keeps: int = 1


UNKNOWN_QOS = PublisherQos()
"""That of a topic of whose publishers nothing is known."""


class TopicQueue(deque[M], Generic[M]):
    """The messages of one topic, in the order in which they are sent.

    :param policy: see ``SendOptions.queue``
    :param deadline_s: s a message may take from submission to the far end, 0 no limit
    :param max_rate: messages/s that may start, 0 unlimited
    """

    def __init__(self, policy: QueuePolicy, deadline_s: float = 0.0, max_rate: float = 0.0) -> None:
        super().__init__()
        self.policy = policy
        self.deadline_s = deadline_s
        self._by_age = True
        """Whether no message becomes useless before an earlier one."""
        self.limit(max_rate)
        self._opens = float("-inf")
        self.since = inf
        """When ``flush_timeout_s`` began to run: with the first message, or when a message started. A drop does not
        restart it; otherwise a topic faster than the timeout would never be sent."""
        self.closed = False
        """Whether no message may start for now."""

    def change(self, policy: QueuePolicy, deadline_s: float) -> None:
        """Set another policy or deadline, from now on; the deadline applies to waiting messages too."""
        self.policy = policy
        self.deadline_s = deadline_s
        for message in self:
            message.expires = self._expiry(message) if deadline_s else inf

    def limit(self, max_rate: float) -> None:
        """Let so many messages/s start from now on, 0 for any number."""
        self._interval = 1 / max_rate if max_rate else 0.0

    def has_space(self, depth: int) -> bool:
        """Whether one more message fits without a drop. ``depth``: messages that may wait, 0 for unbounded."""
        if self.policy == "latest":
            return not self or (len(self) == 1 and self[0].started)
        return not depth or len(self) < depth

    def admit(self, message: M, depth: int) -> list[Dropped[M]]:
        """Add a message; returns the messages dropped to make room for it."""
        if not self:
            self.since = message.submitted
        dropped: list[Dropped[M]] = []
        if self.policy == "latest":
            for old in replaced([waiting for waiting in self if not waiting.started], message.keys):
                self.remove(old)
                message.released |= old.released
                dropped.append(Dropped(old, Fate.SUPERSEDED, "a newer message came before it could start"))
        if (self.policy != "latest" or message.keys) and depth and len(self) >= depth:
            for victim in [waiting for waiting in self if not waiting.started][: len(self) - depth + 1]:
                self.remove(victim)
                dropped.append(Dropped(victim, Fate.QUEUE_BOUND, f"{depth} messages were waiting"))
        if self.deadline_s:
            message.expires = self._expiry(message)
        self._by_age = self._by_age and message.lifespan_s >= self.deadline_s
        self.append(message)
        return dropped

    def shed(self, now: float) -> Iterator[Dropped[M]]:
        """A message has come while the computer is too slow: drop those before it that have waited for too long."""
        if self.policy != "fifo":
            return
        for message in [waiting for waiting in self if now - waiting.submitted > OVERLOAD_S and not waiting.started]:
            self.remove(message)
            yield Dropped(message, Fate.OVERLOAD, OVERLOADED)

    def expire(self, now: float, interval: float, lead: float, payload: int) -> Iterator[Dropped[M]]:
        """Drop the messages that cannot be delivered in time, even if they had the link to themselves.

        :param interval: s from one packet to the next, 0 if unknown
        :param lead: s between composing a packet and its first sample
        :param payload: bytes of a message that fit in a packet
        """
        if not self.deadline_s:
            return
        for message in list(self):
            packets = max(-(-message.remaining // payload), 1)
            late = now + packets * interval + lead * bool(interval) > message.expires
            if not late and now < message.expires:
                if self._by_age:
                    return  # the following messages are younger, and wait for this one
                continue
            self.remove(message)
            yield Dropped(message, *self._reason(message, now, packets * interval))

    def started(self, message: M, now: float) -> None:
        """A message is started: compute when the next one may start. Where the newest message of each instance is
        sent, all that wait may."""
        self.since = now
        if self._interval and not message.released:
            for waiting in self if self.policy == "latest" else ():
                waiting.released = True
            # The delay of one start is not added to the next, unless it was a whole interval.
            self._opens = (self._opens if now - self._opens < self._interval else now) + self._interval

    def open(self, now: float) -> Sequence[M]:
        """The messages that may continue or start."""
        if not self._interval and not self.closed:
            return self
        opened = now >= self._opens and not self.closed
        if opened and self.policy == "latest":
            return self
        let = list(takewhile(lambda one: one.started or (one.released and not self.closed), self))
        return let or list(islice(self, opened))

    def opens(self, now: float) -> float:
        """When the next message may start, if one waits for ``max_rate``; otherwise infinite."""
        return self._opens if self and now < self._opens and not (self[0].started or self[0].released) else inf

    def _expiry(self, message: Outgoing) -> float:
        return message.submitted + min(self.deadline_s, message.lifespan_s)

    def _reason(self, message: Outgoing, now: float, needs: float) -> tuple[Fate, str]:
        limit = f"{min(self.deadline_s, message.lifespan_s) * 1e3:g} ms"
        if message.started:
            return Fate.ABANDONED, f"{message.remaining} bytes could not follow within {limit}"
        if now >= message.expires:
            return Fate.STALE, f"it waited longer than {limit}"
        return Fate.CANNOT_COMPLETE, f"{needs * 1e3:.0f} ms on the air end after {limit}"


def qos_class(options: SendOptions, *, command: bool = False) -> int:
    """The QoS class of a topic's messages.

    :param command: whether it is one of commands, which go first unless the options say otherwise
    """
    if options.qos == AUTO:
        return QOS_LATENCY if command else QOS_DEFAULT
    return QOS_NAMES.index(options.qos)


def queue_for(
    options: SendOptions, publishers: PublisherQos = UNKNOWN_QOS, *, command: bool = False
) -> tuple[QueuePolicy, float]:
    """The policy of a topic's queue and its deadline in s (0 = none): the configured ones, otherwise from its
    publishers' QoS.

    A configured ``queue`` is used as it is. A history of one message (which the registry may set too) or a promise of
    one message per period means that only the newest message matters: ``latest``. So does ``max_rate``: messages that
    come faster are thinned out, the newest at each turn, and do not queue up. A lifespan says when a message becomes
    useless.

    :param command: whether it is one of commands, which have a deadline of their own
    """
    own_s = COMMAND_DEADLINE_S * command
    if options.queue != AUTO:
        return options.queue, own_s if options.deadline_s == AUTO else options.deadline_s
    deadline_s = (publishers.lifespan_s or own_s) if options.deadline_s == AUTO else options.deadline_s
    newest = publishers.depth == 1 or publishers.period_s > 0
    if options.max_rate or options.depth == 1 or (options.depth == AUTO and newest):
        return "latest", deadline_s
    return ("deadline" if deadline_s else "fifo"), deadline_s
