"""The least mean age that a sender can reach with reports, in-order delivery and a given number of packets a message.

*The link* is that of the scenario paper-ofdm-paced: odometry every 28.6 ms, packets of 13.1 ms, each lost with
probability ``LOSS``, and reports of the same length and loss in reverse. A repair may follow the new packet (the
first one), and a second repair may follow when the report about the new packet is due. The second one delays the next
message.

*The sender* is an oracle. A repair that arrives is the packet that the receiver needs first. A report says everything
that the receiver has. The second repair delays one message and not those after it. There are no hellos.

*The bound.* What the sender knows is a state: what the last report said, and which packets have left since. A packet
whose report is overdue was lost with probability p / (p + (1 - p) p). Value iteration finds the policy with the least
mean delay, where each repair costs ``price``. For each price this gives a lower bound on the delay of all senders with
at most so many repairs (Lagrange). By Little's law, the mean age is half of the interval, plus the airtime, plus the
mean time for which a message that has had its turn is not delivered.
"""

from __future__ import annotations

import random
from bisect import insort
from functools import lru_cache
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from bench.rows import Row

INTERVAL_S, AIRTIME_S = 1 / 35, 0.01312
LOSS = 0.2
PACKETS = 1.65
"""Packets a message, at most; reports apart."""
PRICES_S = (0.008, 0.009, 0.0095, 0.010)
"""s that a repair costs; the bound for ``PACKETS`` is highest between these."""
VERSION_0_S = INTERVAL_S / 2 + AIRTIME_S + INTERVAL_S * LOSS / (1 - LOSS)
"""Mean age of version 0: each message that is lost adds an interval."""
_REMEMBERED = 6
"""Messages that the oracle keeps in mind. Older ones count as delivered, which cannot raise the bound."""
_SILENT = 6
"""Packets in a row without a report after which the oracle is told what has arrived."""
_ROUNDS = 60
_REPORTED = (1 - LOSS) ** 2
"""Probability that a packet and its report arrive."""
_OVERDUE = LOSS / (LOSS + (1 - LOSS) * LOSS)
"""Probability that a packet whose report is overdue is lost."""

_State = TypeVar("_State")
Packets = tuple[tuple[str, float], ...]
"""``new`` or ``repair``, and the probability of loss."""


class Known(NamedTuple):
    """What the sender knows.

    :param received: messages from the first missing one on, as the last report has it: 1 arrived, 0 missing
    :param since: the packets that this report does not cover
    """

    received: str
    since: Packets


class Leaf(NamedTuple):
    """What follows from a decision about the second repair, until the next new packet has been on the air.

    :param cost: s of delay
    """

    cost: float
    repairs: int
    following: dict[Known, float]


def _then(received: str, kind: str, *, lost: bool) -> str:
    """What the receiver has after one more packet."""
    if kind == "new":
        received += "0" if lost else "1"
    elif not lost and received:
        received = "1" + received[1:]
    return received[-_REMEMBERED:].lstrip("1")


@lru_cache(None)
def _beliefs(known: Known) -> dict[str, float]:
    """What the receiver may have, with its probability."""
    found = {known.received: 1.0}
    for kind, loss in known.since:
        before, found = found, {}
        for received, weight in before.items():
            for lost, chance in ((False, 1 - loss), (True, loss)):
                _add(found, _then(received, kind, lost=lost), weight * chance)
    return found


def _add(weights: dict[_State, float], state: _State, weight: float) -> None:
    weights[state] = weights.get(state, 0.0) + weight


def _held(known: Known) -> float:
    """Expected number of messages that have had their turn and are not delivered."""
    return sum(len(received) * weight for received, weight in _beliefs(known).items())


def _after(known: Known, packets: Packets) -> dict[Known, float]:
    """What the sender may know when the reports about some more packets are due, with its probability."""
    found: dict[Known, float] = {}
    unseen = 1.0
    for place in reversed(range(len(packets))):
        earlier = Known(known.received, known.since + packets[:place])
        later = tuple((kind, _OVERDUE) for kind, _ in packets[place + 1 :])
        for received, weight in _beliefs(earlier).items():
            state = Known(_then(received, packets[place][0], lost=False), later)
            _add(found, state, unseen * _REPORTED * weight)
        unseen *= 1 - _REPORTED
    silent = Known(known.received, known.since + tuple((kind, _OVERDUE) for kind, _ in packets))
    if len(silent.since) <= _SILENT:
        _add(found, silent, unseen)
    else:
        for received, weight in _beliefs(silent).items():
            _add(found, Known(received, ()), unseen * weight)
    return found


def _leaf(known: Known, first: int, second: int) -> Leaf:
    """The second repair leaves or not, when the report about the new packet is due."""
    repairs: Packets = (("repair", LOSS),)
    cost = _held(Known(known.received, known.since + repairs * first)) * AIRTIME_S
    every = repairs * (first + second)
    cost += _held(Known(known.received, known.since + every)) * (INTERVAL_S - 2 * AIRTIME_S)
    cost += second * (3 * AIRTIME_S - INTERVAL_S)
    return Leaf(cost, first + second, _after(known, every))


class Process:
    """The decisions of all states, as arrays."""

    def __init__(self) -> None:
        states = {Known("", ()): 0}
        waiting = [Known("", ())]
        before: list[float] = []
        costs: list[float] = []
        repairs: list[int] = []
        edges: list[tuple[int, int, float]] = []
        choices: list[tuple[int, float, int]] = []
        for number, known in enumerate(waiting):
            new: Packets = (("new", LOSS),)
            before.append(_held(Known(known.received, known.since + new)) * AIRTIME_S)
            for first in (0, 1):
                for reported, weight in _after(known, new).items():
                    choices.append((2 * number + first, weight, len(costs)))
                    for second in (0, 1):
                        leaf = _leaf(reported, first, second)
                        for state, chance in leaf.following.items():
                            if state not in states:
                                states[state] = len(waiting)
                                waiting.append(state)
                            edges.append((len(costs), states[state], chance))
                        costs.append(leaf.cost)
                        repairs.append(leaf.repairs)
        self.before, self.costs, self.repairs = np.array(before), np.array(costs), np.array(repairs)
        self._edges = [np.array(column) for column in zip(*edges, strict=True)]
        self._choices = [np.array(column) for column in zip(*choices, strict=True)]

    def least(self, price: float) -> float:
        """Mean delay of a message plus ``price`` times its repairs, s, for the best policy."""
        decision, share, leaf = self._choices
        costs = self.costs + price * self.repairs
        worth = np.zeros(len(self.before))
        least = 0.0
        for _ in range(_ROUNDS):
            leaves = costs + self._expected(worth)
            best = np.minimum(leaves[leaf], leaves[leaf + 1])
            firsts = np.bincount(decision, weights=share * best).reshape(-1, 2)
            new = self.before + firsts.min(axis=1)
            least = float((new - worth).min())
            worth = new - new[0]
        return least

    def _expected(self, worth: NDArray[np.float64]) -> NDArray[np.float64]:
        """Expected worth of the states after each leaf."""
        leaf_of, state_of, chance = self._edges
        expected: NDArray[np.float64] = np.bincount(leaf_of, chance * worth[state_of], len(self.costs))  # type: ignore[assignment]
        return expected


def least_age(packets: float = PACKETS) -> float:
    """Mean age in s that no sender goes below with at most so many packets a message."""
    process = Process()
    delay = max(process.least(price) - price * (packets - 1) for price in PRICES_S)
    return INTERVAL_S / 2 + AIRTIME_S + delay


def ideal_age(loss: float, *, waits: bool, messages: int = 40_000, seed: int = 1) -> float:
    """Mean age in s, in order, of a sender that knows every loss at once and repairs the oldest one first.

    :param waits: whether a repair waits that would delay the next message by more than a quarter of an airtime
    """
    rng = random.Random(seed)
    lost: list[int] = []
    arrived: set[int] = set()
    sent = delivered = 0
    now = delay = 0.0
    while sent < messages:
        due = sent * INTERVAL_S
        if due <= now:
            number = sent
            sent += 1
        elif lost and (not waits or now + AIRTIME_S <= due + AIRTIME_S / 4):
            number = lost.pop(0)
        else:
            now = due
            continue
        now += AIRTIME_S
        if rng.random() < loss:
            insort(lost, number)
        else:
            arrived.add(number)
        while delivered in arrived:
            arrived.discard(delivered)
            delay += now - delivered * INTERVAL_S
            delivered += 1
    return INTERVAL_S / 2 + delay / delivered


def bound() -> list[Row]:
    """What thrifty repair could reach, over version 0's mean age; and the ages of a sender that knows every loss."""
    what = f"bound: {LOSS:.0%} lost, reports, in order, {PACKETS} packets a message: least mean age over version 0's"
    rows = [Row(what, least_age() / VERSION_0_S, form="{:.3f}")]
    for loss in (0.05, 0.1, 0.2, 0.27):
        for waits, name in ((False, "never waits"), (True, "waits for new messages")):
            what = f"bound: {loss:.0%} lost, every loss known at once, a repair {name}: mean age in order"
            rows.append(Row(what, ideal_age(loss, waits=waits) * 1e3, "ms", form="{:.1f}"))
    return rows
