"""How a subscription adapts to the publishers found (DESIGN, QoS): what DDS matches, and when to join anew.

Law: pure bookkeeping over what discovery reports; nothing here knows a DDS, a thread or a clock.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from gr_ros2.middleware.base import Qos


def settle(asked: Qos, offered: Iterable[Qos]) -> Qos:
    """The QoS of a subscription: as asked; where None, the strictest that every publisher offers."""
    offers = tuple(offered)
    reliable = all(offer.reliability == "reliable" for offer in offers)
    latched = all(offer.durability == "transient_local" for offer in offers)
    return Qos(
        asked.reliability or ("reliable" if reliable else "best_effort"),
        asked.durability or ("transient_local" if latched else "volatile"),
        asked.depth,
    )


def compatible(offer: Qos, request: Qos) -> bool:
    """Whether DDS matches a publisher that offers with a subscription that requests."""
    return (request.reliability != "reliable" or offer.reliability == "reliable") and (
        request.durability != "transient_local" or offer.durability == "transient_local"
    )


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
