"""How a subscription adapts to the publishers found (DESIGN, QoS): what DDS matches, and when to join anew.

Invariant: pure bookkeeping over what discovery reports and what is received; nothing here knows a DDS, a thread or a
clock.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from gr_ros2.middleware.base import Qos

REPLAY_S = 2.0
"""s after joining anew in which publishers may send once more what they keep for those who come late."""

_REMEMBERED = 256


def settle(asked: Qos, offered: Iterable[Qos]) -> Qos:
    """The QoS of a subscription: as asked; where None, the strictest that every publisher offers."""
    offers = tuple(offered)
    reliable = all(offer.reliability == "reliable" for offer in offers)
    latched = all(offer.durability == "transient_local" for offer in offers)
    return replace(
        asked,
        reliability=asked.reliability or ("reliable" if reliable else "best_effort"),
        durability=asked.durability or ("transient_local" if latched else "volatile"),
    )


def offered(qos: Qos) -> Qos:
    """The QoS of a publisher: what is left open has its default."""
    return replace(qos, reliability=qos.reliability or "reliable", durability=qos.durability or "volatile")


def refused_policies(offer: Qos, request: Qos) -> list[str]:
    """Policies in which an offer falls short of a request; what a request leaves open adapts and never does."""
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
    """What the publishers of a topic say about its messages, all together.

    History and deadline are of one publisher alone: its newest message replaces its own earlier ones, not those of
    another. So with several the history is unbounded, there is no deadline, and the longest lifespan counts.

    :param offers: one at least
    """
    if len(offers) == 1:
        return offers[0]
    lifespans = [offer.lifespan_s for offer in offers]
    return replace(offers[0], depth=0, lifespan_s=max(lifespans) if all(lifespans) else 0.0, deadline_s=0.0)


class Adaptation:
    """Decides with which QoS a subscription is on the graph.

    One that asks for everything is there from the start. One that adapts joins with the first publisher: before, there
    is nothing to hear, and so it never meets a publisher with a QoS that this one does not offer. It joins anew only
    when a publisher appears that calls for another QoS; departures alone are no reason to miss samples.

    :param asked: what the user wants, None = adapt
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
        """Whether this policy (``reliability``, ``durability``, …) is ours to adapt."""
        return getattr(self.asked, policy, policy) is None

    def consider(self, publishers: Mapping[bytes, Qos]) -> Qos | None:
        """The QoS to join (anew) with, None to stay as it is.

        :param publishers: what each publisher of the topic and type now on the graph offers, by its id
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
    """Tells messages that publishers send once more, since they keep them for those who come late and we joined anew.

    By content, for where nothing tells when a message was published, as in Humble's rclpy. Without this an old message
    would come after newer ones.
    """

    def __init__(self) -> None:
        self._had: deque[int] = deque(maxlen=_REMEMBERED)
        self._expected: Counter[int] = Counter()
        self._until = 0.0

    def join(self, qos: Qos, now: float) -> None:
        """What was received so far may come again, if we ask for the past."""
        self._expected = Counter(self._had if qos.durability == "transient_local" else ())
        self._until = now + REPLAY_S

    def has(self, payload: bytes, now: float) -> bool:
        """Whether this is one; each message received is expected once more."""
        key = hash(payload)
        if now < self._until and self._expected[key] > 0:
            self._expected[key] -= 1
            return True
        self._had.append(key)
        return False
