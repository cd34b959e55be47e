"""Publishers and subscriptions of the embedded DDS.

Invariants: a subscription whose reliability or durability is left open requests only what all publishers found offer,
and changes readers when that changes: the old reader stays for ``OVERLAP_S`` while publishers discover the new one; a
message that both receive is delivered once, and never after a later message of its publisher. A subscription's lock is
taken before its participant's, never after.
"""

from __future__ import annotations

import logging
import time
from abc import abstractmethod
from collections.abc import Iterable

from gr_ros2.core.errors import MiddlewareError
from gr_ros2.middleware.adapt import settle
from gr_ros2.middleware.base import MessageCallback, Publisher, Qos, Subscription
from gr_ros2.middleware.cdr_dds import BATCH, DdsError, Entity, RawReader, RawWriter, Sample
from gr_ros2.middleware.services import ServiceGraph

OVERLAP_S = 2.0
"""s that an outdated reader stays in parallel to its successor: Fast DDS may take a second to send to a new reader."""
SLACK = 256
"""Messages that a volatile reader holds beyond its depth: DDS silently drops messages that exceed the history, so the
subscription limits the depth itself, and counts. A transient-local reader has exactly its depth, because it would
otherwise get more old messages than requested; its drops are not counted."""

_SEEN_PER_PUBLISHER = 256
_SEEN_PUBLISHERS = 64
_LEAST = Qos("best_effort", "volatile")
"""The weakest request, which every publisher matches."""

_log = logging.getLogger(__name__)


class DdsParticipant(ServiceGraph):
    """The interface of a participant for its endpoints.

    :ivar closed: whether it has left its domain
    :ivar own_guid: its GUID
    """

    closed: bool
    own_guid: bytes

    @abstractmethod
    def make_reader(self, subscription: DdsSubscription, qos: Qos) -> RawReader:
        """A reader of the subscription's topic; its samples come by ``subscription.service``."""

    @abstractmethod
    def drop_reader(self, reader: RawReader) -> None:
        """Delete a reader."""

    @abstractmethod
    def forget(self, endpoint: DdsSubscription | DdsPublisher) -> None:
        """Remove a closed endpoint from the graph."""

    @abstractmethod
    def announce(self) -> None:
        """Announce to the graph which endpoints belong to this node."""

    def count_incompatible(self, topic: str, refused: tuple[int, str], ignored: Iterable[str]) -> None:
        """Count endpoints with incompatible QoS by policy, except for policies in ``ignored``."""
        amount, policy = refused
        if amount > 0 and policy not in ignored:
            text = f"{topic}: another endpoint does not match, its {policy} is incompatible with this one's"
            self.count(f"incompatible_qos:{topic}:{policy}", text, amount)


class DdsPublisher(Publisher):
    """A writer. ``publish`` may be called from any thread."""

    def __init__(self, middleware: DdsParticipant, topic: str, writer: RawWriter) -> None:
        self._middleware = middleware
        self._topic = topic
        self.writer = writer
        self._closed = False

    def publish(self, payload: bytes) -> None:
        """Publish; the payload arrives with up to 3 zero bytes appended.

        :raises MiddlewareError: closed, not CDR (less than 5 bytes, unknown encapsulation), or a reliable subscriber
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
        """Called by the thread when the library reports a status of this writer."""
        self._middleware.count_incompatible(self._topic, self.writer.incompatible(), ())

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._middleware.forget(self)


class DdsSubscription(Subscription):
    """A reader, and for some seconds its predecessors. ``calling`` is also held while readers change."""

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
        """The QoS that the reader requests now."""
        return self._qos

    def adapt(self, offers: Iterable[Qos]) -> None:
        """Request the QoS that all publishers offer. Without publishers nothing changes; the first request is the
        weakest."""
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
        """When to delete the oldest outdated reader (time.monotonic()), None without one."""
        outdated = self._outdated
        return outdated[0][0] if outdated and not self._closed else None

    def retire(self, now: float) -> None:
        """Deliver the remaining messages of readers whose time is over, and delete these readers."""
        with self.calling:
            if self._closed:
                return
            ended = [reader for until, reader in self._outdated if until <= now]
            for reader in ended:
                self._serve_all(reader)
                self._middleware.drop_reader(reader)
            self._outdated = [(until, reader) for until, reader in self._outdated if until > now]
            if ended:
                self._middleware.announce()

    def service(self, reader: RawReader) -> int:
        """Deliver the messages of one reader (BATCH at a time where the depth is unbounded); returns their number."""
        with self.calling:
            if reader is self._reader:  # its predecessors may hold earlier messages
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
            text = f"{self.topic}: callbacks do not keep up, depth {self._wanted.depth} is full, the oldest are dropped"
            self._middleware.count_lost(self, self.topic, text, excess)
            fresh = fresh[excess:]
        newest = {sample.source: sample.stamp for sample in fresh}
        for sample in fresh:
            if self._closed:
                break
            self.waited_s = max(0.0, (newest[sample.source] - sample.stamp) * 1e-9)
            self.source = sample.source
            self._middleware.deliver(self.topic, self._callback, sample.payload)
        return len(samples)

    def _count_lost(self, reader: RawReader) -> None:
        """Count lost samples. For an outdated reader only those from before its replacement count: another reader may
        have received later ones."""
        lost = reader.lost()
        if lost and reader is self._reader:
            self._middleware.count_lost(self, self.topic, f"{self.topic}: the DDS lost messages", lost)

    def _is_next(self, sample: Sample, reader: RawReader) -> bool:
        """Whether to deliver a message: another reader has not received it, and no later message was delivered.

        The order is that of the publisher's clock. Since that clock may be set back, only messages of readers that
        exist at the same time are compared. A message older than all received ones of its publisher counts as published
        before the subscription.
        """
        stamps = self._seen.get(sample.source)
        heard_by = None if stamps is None else next(iter(stamps.values()))
        now = self._reader
        if now is not None and now is not reader and now.brings_past and heard_by in (None, now.entity):
            return False  # that reader delivers this message too, in the right order
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
                # As if the subscription had joined a moment later.
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
        """The reader of this subscription, and those with an earlier QoS that still have messages."""
        return [*([self._reader] if self._reader else []), *(reader for _, reader in self._outdated)]

    def mute(self) -> None:
        """Start no callback from now on."""
        self._closed = True

    def close(self) -> None:
        if self._closed:
            return
        self.mute()
        self.wait_for_callback()
        self._middleware.forget(self)
