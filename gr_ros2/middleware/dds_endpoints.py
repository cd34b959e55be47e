"""Publishers and subscriptions of the embedded DDS.

Invariants: a subscription whose reliability or durability is left open asks only for what all publishers found offer,
and changes readers when that changes: the old reader stays for ``OVERLAP_S`` while the new one is being found, what
both receive is delivered once, and never a message after a later one of its publisher. A subscription's lock is taken
before its participant's, never after.
"""

from __future__ import annotations

import logging
import time
from abc import abstractmethod
from collections.abc import Iterable

from gr_ros2.errors import MiddlewareError
from gr_ros2.middleware.adapt import settle
from gr_ros2.middleware.base import MessageCallback, Middleware, Publisher, Qos, Subscription
from gr_ros2.middleware.cdr_dds import BATCH, DdsError, Entity, RawReader, RawWriter, Sample

OVERLAP_S = 2.0
"""s an outdated reader stays beside its successor: Fast DDS may take a second to send to a new reader."""
SLACK = 256
"""Messages a volatile reader holds beyond its depth: a DDS drops in silence what exceeds a history, so the subscription
cuts to its depth itself, and counts. A transient-local reader has its depth and no more, else it would get more of the
past than was asked for; what such a one drops is not counted."""

_SEEN_PER_PUBLISHER = 256
_SEEN_PUBLISHERS = 64
_LEAST = Qos("best_effort", "volatile")
"""Asks for the least, and so is matched by every publisher."""

_log = logging.getLogger(__name__)


class DdsParticipant(Middleware):
    """What the endpoints ask of their participant."""

    @property
    @abstractmethod
    def closed(self) -> bool: ...

    @abstractmethod
    def make_reader(self, subscription: DdsSubscription, qos: Qos) -> RawReader:
        """A reader of the subscription's topic; its samples come by ``subscription.service``."""

    @abstractmethod
    def drop_reader(self, reader: RawReader) -> None:
        """Delete a reader."""

    @abstractmethod
    def forget(self, endpoint: DdsSubscription | DdsPublisher) -> None:
        """Take a closed endpoint off the graph."""

    @abstractmethod
    def announce(self) -> None:
        """Tell the graph which endpoints belong to our node."""

    def count_incompatible(self, topic: str, refused: tuple[int, str], ignored: Iterable[str]) -> None:
        """Count endpoints that refused ours, by the policy that does not fit, unless that is one of ``ignored``."""
        amount, policy = refused
        if amount > 0 and policy not in ignored:
            text = f"{topic}: another endpoint does not match, its {policy} does not fit ours"
            self.count(f"incompatible_qos:{topic}:{policy}", text, amount)


class DdsPublisher(Publisher):
    """A writer. ``publish`` may be called from any thread."""

    def __init__(self, middleware: DdsParticipant, topic: str, writer: RawWriter) -> None:
        self._middleware = middleware
        self._topic = topic
        self.writer = writer
        self._closed = False

    def publish(self, payload: bytes) -> None:
        """Publish; the payload arrives with up to 3 zeros behind it.

        :raises MiddlewareError: closed, no CDR (less than 5 bytes, unknown encapsulation), or a reliable subscriber
            did not take unbounded or large messages within a second (counted as ``publish_blocked:/topic``)
        """
        if self._closed or self._middleware.closed:
            raise MiddlewareError(f"publish on {self._topic}: the publisher is closed")
        try:
            self.writer.write(payload)
        except DdsError as error:
            if error.timeout:
                explanation = "a reliable subscriber does not keep up; one message was not published"
                self._middleware.count(f"publish_blocked:{self._topic}", f"{self._topic}: {explanation}")
                raise MiddlewareError(f"publish on {self._topic}: {explanation}") from error
            raise MiddlewareError(f"publish on {self._topic}: {error}") from error

    def matched(self) -> int:
        return 0 if self._closed or self._middleware.closed else self.writer.matched()

    def service(self) -> None:
        """Called by the thread when the library has something to tell about this writer."""
        self._middleware.count_incompatible(self._topic, self.writer.incompatible(), ())

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._middleware.forget(self)


class DdsSubscription(Subscription):
    """A reader, and for a while its predecessors. ``calling`` is held while readers change, too."""

    def __init__(
        self, middleware: DdsParticipant, topic: str, type_name: str, qos: Qos, callback: MessageCallback
    ) -> None:
        super().__init__()
        self.topic = topic
        self.type_name = type_name
        self._middleware = middleware
        self._callback = callback
        self._wanted = qos
        self._open_policies = [name for name in ("reliability", "durability") if getattr(qos, name) is None]
        self._closed = False
        self._qos: Qos | None = None
        self._reader: RawReader | None = None
        self._outdated: list[tuple[float, RawReader]] = []
        self._seen: dict[int, dict[int, Entity]] = {}  # publisher -> stamp -> reader that had it, newest last

    @property
    def qos(self) -> Qos | None:
        """What the reader currently asks for."""
        return self._qos

    def adapt(self, offers: Iterable[Qos]) -> None:
        """Ask for what all publishers offer. Without any, leave things as they are, at first the least."""
        offers = list(offers)
        with self.calling:
            if self._closed or (self._reader and not offers):
                return
            self.found(offers)
            qos = settle(self._wanted, offers or [_LEAST])
            if qos == self._qos:
                return
            if self._reader:
                _log.info("%s: asking for %s, %s from now on", self.topic, qos.reliability, qos.durability)
                self._count_lost(self._reader)
                self._outdated.append((time.monotonic() + OVERLAP_S, self._reader))
            self._reader = self._middleware.make_reader(self, qos)
            self._qos = qos
        self._middleware.announce()

    @property
    def outdated(self) -> float | None:
        """When the oldest outdated reader is due (time.monotonic()), None without any."""
        outdated = self._outdated
        return outdated[0][0] if outdated and not self._closed else None

    def retire(self, now: float) -> None:
        """Delete readers whose time is over, with what they still hold delivered."""
        with self.calling:
            if self._closed:
                return
            over = [reader for until, reader in self._outdated if until <= now]
            for reader in over:
                self._serve_all(reader)
                self._middleware.drop_reader(reader)
            self._outdated = [(until, reader) for until, reader in self._outdated if until > now]
            if over:
                self._middleware.announce()

    def service(self, reader: RawReader) -> int:
        """Deliver what one reader holds (BATCH at a time where the depth is unbounded); returns how many there were."""
        with self.calling:
            if reader is self._reader:  # its predecessors may hold what came before
                for _, older in self._outdated:
                    self._serve_all(older)
            return self._serve(reader)

    def _serve_all(self, reader: RawReader) -> None:
        while self._serve(reader) >= BATCH:
            pass

    def _serve(self, reader: RawReader) -> int:
        if self._closed:
            return 0
        self._count_lost(reader)
        self._middleware.count_incompatible(self.topic, reader.incompatible(), self._open_policies)
        samples = batch = reader.take()
        while self._wanted.depth and len(batch) == BATCH:
            batch = reader.take()
            samples = samples + batch
        fresh = [sample for sample in samples if self._is_next(sample, reader)] if self._open_policies else samples
        excess = len(fresh) - self._wanted.depth
        if self._wanted.depth and excess > 0 and not reader.latched:
            text = f"{self.topic}: callbacks do not keep up, depth {self._wanted.depth} is full, the oldest go"
            self._middleware.count_lost(self, self.topic, text, excess)
            fresh = fresh[excess:]
        for sample in fresh:
            if self._closed:
                break
            self._middleware.deliver(self.topic, self._callback, sample.payload)
        return len(samples)

    def _count_lost(self, reader: RawReader) -> None:
        """Of outdated readers only what they lost before they were: what they miss from then on, another may have."""
        lost = reader.lost()
        if lost and reader is self._reader:
            self._middleware.count_lost(self, self.topic, f"{self.topic}: the DDS lost messages", lost)

    def _is_next(self, sample: Sample, reader: RawReader) -> bool:
        """Whether a message is to be delivered: neither had by another reader nor overtaken by a later one.

        Order is by the publisher's clock, which may be set back, hence only among readers that are there at once. What
        is older than all that was heard of a publisher counts as published before our time.
        """
        stamps = self._seen.get(sample.source)
        heard_by = None if stamps is None else next(iter(stamps.values()))
        now = self._reader
        if now is not None and now is not reader and now.brings_past and heard_by in (None, now.entity):
            return False  # that one brings this message too, in its place
        if stamps is None:
            if len(self._seen) >= _SEEN_PUBLISHERS:
                del self._seen[next(iter(self._seen))]
            self._seen[sample.source] = {sample.stamp: reader.entity}
            return True
        if stamps.get(sample.stamp, reader.entity) != reader.entity:
            return False
        last = next(reversed(stamps))
        if self._outdated and sample.stamp < last and stamps[last] != reader.entity:
            if sample.stamp > next(iter(stamps)):
                # As if we had joined a moment later.
                text = f"{self.topic}: a message came after a later one while the QoS changed; not delivered"
                self._middleware.count(f"overtaken:{self.topic}", text, level=logging.INFO)
            return False
        stamps[sample.stamp] = reader.entity
        if len(stamps) > _SEEN_PER_PUBLISHER:
            del stamps[next(iter(stamps))]
        return True

    def matched(self) -> int:
        reader = self._reader
        return 0 if self._closed or self._middleware.closed or reader is None else reader.matched()

    def readers(self) -> list[RawReader]:
        return [*([self._reader] if self._reader else []), *(reader for _, reader in self._outdated)]

    def mute(self) -> None:
        """No callback begins from now on."""
        self._closed = True

    def close(self) -> None:
        if self._closed:
            return
        self.mute()
        self.wait_for_callback()
        self._middleware.forget(self)
