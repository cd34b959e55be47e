"""The interface between the adapter and any ROS graph: serialized bytes in, serialized bytes out.

Invariants: payloads are whole CDR messages including the 4-byte encapsulation header and are never parsed here;
callbacks run in a thread of the back-end and must not block it for long, except that a blocking callback slows down a
back-end which plays recorded data at link speed; ``close`` is idempotent, and no callback runs after it has returned.
"""

from __future__ import annotations

import logging
import threading
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

from gr_ros2.core.closing import Closing

Reliability = Literal["reliable", "best_effort"]
Durability = Literal["volatile", "transient_local"]
MessageCallback = Callable[[bytes], None]
JOIN_S = 1.0
"""s that closing waits for a callback to return."""
FOR_EVER_S = 1e9
"""A duration of this many seconds or more means no limit: DDS, rclpy and bags write "infinite" differently."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Qos:
    """The QoS of one subscription or publisher.

    :param reliability: None adapts a subscription to the publishers found (reliable only if all offer it);
        a publisher with None is reliable
    :param durability: None adapts likewise; a publisher with None is volatile
    :param depth: history depth in messages, 0 = unbounded (KeepAll); the default for a publisher whose discovery data
        does not contain it
    :param lifespan_s: of a publisher: s after which its messages are useless, 0 = no limit
    :param deadline_s: s within which a publisher promises the next message, or a subscription requests it, 0 = none
    """

    reliability: Reliability | None = None
    durability: Durability | None = None
    depth: int = 10
    lifespan_s: float = 0.0
    deadline_s: float = 0.0


OffersCallback = Callable[[Sequence[Qos]], None]


def finite(seconds: float) -> float:
    """A duration in the form of ``Qos``: 0 where there is no limit, or one longer than ``FOR_EVER_S``."""
    return seconds if 0 < seconds < FOR_EVER_S else 0.0


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """One topic found by discovery, without the endpoints of this participant.

    :param topic: absolute name with leading slash
    :param type_name: ``package/msg/Type``
    :param publishers: what each publisher offers
    :param subscribers: what each subscriber asks for
    """

    topic: str
    type_name: str
    publishers: tuple[Qos, ...] = ()
    subscribers: tuple[Qos, ...] = ()


def grouped(publishers: Iterable[tuple[str, str, Qos]], subscribers: Iterable[tuple[str, str, Qos]]) -> list[TopicInfo]:
    """Endpoints by topic and type, sorted by name.

    :param publishers: topic, type and QoS of each; likewise those of the subscribers
    """
    rows: dict[tuple[str, str], tuple[list[Qos], list[Qos]]] = {}
    for column, endpoints in enumerate((publishers, subscribers)):
        for topic, type_name, qos in endpoints:
            rows.setdefault((topic, type_name), ([], []))[column].append(qos)
    return [TopicInfo(*names, tuple(offers), tuple(requests)) for names, (offers, requests) in sorted(rows.items())]


class Publisher(ABC):
    """A publisher of this participant."""

    @abstractmethod
    def publish(self, payload: bytes) -> None:
        """Publish one serialized message (raises MiddlewareError once closed)."""

    @abstractmethod
    def matched(self) -> int:
        """Number of subscriptions currently matched."""

    @abstractmethod
    def close(self) -> None:
        """Leave the graph. Idempotent."""


class Subscription(ABC):
    """A subscription of this participant.

    :ivar lost: messages that were lost before they reached the callback, as far as the graph reports them
    :ivar waited_s: s for which the message that the callback gets has waited for it at least
    :ivar source: what tells its publisher apart from others; None = not known
    :ivar calling: for back-ends: held while calling back
    """

    def __init__(self) -> None:
        self.lost = 0
        self.waited_s = 0.0
        self.source: Hashable = None
        self.calling = threading.RLock()
        self._offers: list[Qos] = []
        self._on_offers: OffersCallback | None = None

    @abstractmethod
    def matched(self) -> int:
        """Number of publishers currently matched."""

    def follow(self, on_offers: OffersCallback) -> None:
        """Call ``on_offers`` with the QoS of the publishers found, now and whenever it has changed.

        It runs in the thread of the caller or of the back-end; without any publisher it is not called.
        """
        with self.calling:
            self._on_offers = on_offers
            self._tell()

    @abstractmethod
    def close(self) -> None:
        """Leave the graph; no callback begins afterwards. Idempotent."""

    # For back-ends

    def found(self, offers: Sequence[Qos]) -> None:
        """Tell the followers the QoS of the publishers found, if it has changed."""
        with self.calling:
            if list(offers) != self._offers:
                self._offers = list(offers)
                self._tell()

    def wait_for_callback(self) -> None:
        """Wait until a callback in progress ends, unless this call comes from it or the wait takes too long."""
        if self.calling.acquire(timeout=JOIN_S):
            self.calling.release()

    def _tell(self) -> None:
        if self._on_offers is not None and self._offers:
            self._on_offers(self._offers)


class Middleware(Closing, ABC):
    """One participant of a ROS graph (or of a substitute for one).

    ``counters`` names what went wrong, for statistics: ``samples_lost:/topic``, ``incompatible_qos:/topic:policy``,
    ``incompatible_type:/topic`` and ``callback_failed:/topic``. The first of each is also logged.

    :ivar domain_id: of its graph; None for a graph that nobody else can join, such as a file
    """

    name: ClassVar[str]
    settling_s: ClassVar[float] = 0.0
    """s from the moment when a new publisher has found a subscriber until that subscriber surely hears it."""
    domain_id: int | None = None

    def __init__(self) -> None:
        self.counters: Counter[str] = Counter()
        self._counting = threading.Lock()

    @abstractmethod
    def subscribe(self, topic: str, type_name: str, qos: Qos, callback: MessageCallback) -> Subscription:
        """Call ``callback(payload)`` for each message on an absolute topic name."""

    @abstractmethod
    def advertise(self, topic: str, type_name: str, qos: Qos) -> Publisher:
        """Announce a publisher on an absolute topic name."""

    @abstractmethod
    def discover(self) -> list[TopicInfo]:
        """The topics of the graph without the endpoints of this participant, sorted by name."""

    def start(self) -> None:
        """Start to deliver. Only finite sources (bags) wait for this call; others deliver from subscribe() on."""

    @property
    def finished(self) -> bool:
        """True once a finite source has delivered everything."""
        return False

    @abstractmethod
    def close(self) -> None:
        """Leave the graph with all publishers and subscriptions; no callback begins afterwards. Idempotent."""

    def count(self, key: str, text: str, n: int = 1, level: int = logging.WARNING) -> None:
        """Add to a counter, from any thread; log the text at its first occurrence."""
        with self._counting:
            first = key not in self.counters
            self.counters[key] += n
        if first:
            _log.log(level, "%s (counted as %s, not logged again)", text, key)

    def count_once(self, key: str, text: str, *, alike: bool = False) -> None:
        """Count a lasting condition, such as incompatible endpoints, only the first time.

        :param alike: of all keys that are the same up to a colon, the first one says it all, and it alone is a warning
        """
        if key not in self.counters:
            kind = key.partition(":")[0] + ":"
            told = alike and any(other.startswith(kind) for other in list(self.counters))
            self.count(key, text, level=logging.DEBUG if told else logging.WARNING)

    def count_lost(self, subscription: Subscription, topic: str, text: str, n: int = 1) -> None:
        """Count messages that a subscription will not receive, from any thread."""
        self.count(f"samples_lost:{topic}", text, n)
        with self._counting:
            subscription.lost += n

    def deliver(self, topic: str, callback: MessageCallback, payload: bytes) -> None:
        """Call back with one message; an exception of the callback is counted and logged, and the thread goes on."""
        try:
            callback(payload)
        except Exception as error:  # noqa: BLE001 - user code: whatever it raises must not stop the other topics
            self.count(f"callback_failed:{topic}", f"the callback of {topic} failed: {type(error).__name__}: {error}")
            _log.debug("callback of %s", topic, exc_info=True)

    def wait_for_thread(self, thread: threading.Thread) -> None:
        """Wait ``JOIN_S`` for a thread that calls back to end, unless called from it."""
        if thread is not threading.current_thread():
            thread.join(JOIN_S)
            if thread.is_alive():
                _log.warning("%s: a callback has not returned; closing without it", thread.name)
