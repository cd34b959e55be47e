"""How a subscription adapts to the publishers found (DESIGN, QoS): which QoS DDS matches, and when to join again.

Invariant: this module only evaluates reports of discovery and received messages; it uses no DDS, thread or clock.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from gr_ros2.middleware.base import Qos

REPLAY_S = 2.0
"""s after a subscription joined again in which publishers may repeat the messages that they keep for late joiners."""

_REMEMBERED = 256


def settle(asked: Qos, offered: Iterable[Qos]) -> Qos:
    """The QoS of a subscription: as requested; where None, the strictest that every publisher offers."""
    offers = tuple(offered)
    reliable = all(offer.reliability == "reliable" for offer in offers)
    latched = all(offer.durability == "transient_local" for offer in offers)
    return replace(
        asked,
        reliability=asked.reliability or ("reliable" if reliable else "best_effort"),
        durability=asked.durability or ("transient_local" if latched else "volatile"),
    )


def offered(qos: Qos) -> Qos:
    """The QoS of a publisher, with defaults where None."""
    return replace(qos, reliability=qos.reliability or "reliable", durability=qos.durability or "volatile")


def refused_policies(offer: Qos, request: Qos) -> list[str]:
    """Policies in which an offer does not satisfy a request; a policy that the request leaves open is always
    satisfied."""
    refused = []
    if request.reliability == "reliable" and offer.reliability == "best_effort":
        refused.append("reliability")
    if request.durability == "transient_local" and offer.durability == "volatile":
        refused.append("durability")
    if request.deadline_s and not 0 < offer.deadline_s <= request.deadline_s:
        refused.append("deadline")
    return refused


def compatible(offer: Qos, request: Qos) -> bool:
    """Whether DDS matches a publisher that offers with a subscription that requests."""
    return not refused_policies(offer, request)


def agreed(offers: Sequence[Qos]) -> Qos:
    """The combined QoS of all publishers of a topic.

    History and deadline apply to one publisher: its newest message replaces its own earlier ones, not those of another
    publisher. So with several publishers the history is unbounded, there is no deadline, and the longest lifespan
    counts.

    :param offers: at least one
    """
    if len(offers) == 1:
        return offers[0]
    lifespans = [offer.lifespan_s for offer in offers]
    return replace(offers[0], depth=0, lifespan_s=max(lifespans) if all(lifespans) else 0.0, deadline_s=0.0)


class Adaptation:
    """Decides with which QoS a subscription joins the graph.

    A subscription that requests every policy joins at once. A subscription that adapts joins when the first publisher
    appears: before that there is nothing to receive, and so its QoS always fits that publisher. It joins again only
    when a new publisher requires a different QoS; the departure of a publisher is no reason to risk a loss of samples.

    :param asked: the requested QoS, None = adapt
    """

    def __init__(self, asked: Qos) -> None:
        self.asked = asked
        self.settled: Qos | None = None
        self._seen: frozenset[bytes] = frozenset()

    @property
    def adaptive(self) -> bool:
        """Whether anything is left to adapt."""
        return self.asked.reliability is None or self.asked.durability is None

    def adapts(self, policy: str) -> bool:
        """Whether this policy (``reliability``, ``durability``, …) adapts."""
        return getattr(self.asked, policy, policy) is None

    def consider(self, publishers: Mapping[bytes, Qos]) -> Qos | None:
        """The QoS with which to join (again), None for no change.

        :param publishers: the offered QoS of each publisher of the topic and type that is on the graph now, by its id
        """
        appeared = publishers.keys() - self._seen
        self._seen = frozenset(publishers)
        if self.adaptive and not appeared:
            return None
        qos = settle(self.asked, publishers.values())
        if qos == self.settled:
            return None
        self.settled = qos
        return qos


class Replays:
    """Recognises messages that publishers repeat for late joiners because the subscription joined again.

    It compares the content, for middlewares without a publication time, as in Humble's rclpy. Without this an old
    message would be delivered after newer ones.
    """

    def __init__(self) -> None:
        self._had: deque[int] = deque(maxlen=_REMEMBERED)
        self._expected: Counter[int] = Counter()
        self._until = 0.0

    def join(self, qos: Qos, now: float) -> None:
        """Messages received so far may come again, if the subscription is transient-local."""
        self._expected = Counter(self._had if qos.durability == "transient_local" else ())
        self._until = now + REPLAY_S

    def has(self, payload: bytes, now: float) -> bool:
        """Whether this message is a repetition; each received message is expected once more."""
        key = hash(payload)
        if now < self._until and self._expected[key] > 0:
            self._expected[key] -= 1
            return True
        self._had.append(key)
        return False
