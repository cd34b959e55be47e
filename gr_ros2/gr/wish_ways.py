"""Topics asked for from afar, over all radios of a robot at once.

What a robot offers over all its radios, and what it offers over one that other robots share, it says on different
radios (:mod:`gr_ros2.gr.bound`). Whoever asks a robot need not know on which, so it is asked on all over which it is
heard, and the best answer counts.

Invariant: nothing is kept here; a robot is asked by the ways over which it is heard at that moment.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from gr_ros2.gr.wishes import LiveWishes, Told

_BEST = ("sent", "asked", "refused", "over")
"""States of a wish; the earlier ones count where several ways tell of one. That a way does not offer it counts last."""


class WishWays:
    """The wishes of one robot over each of its ways.

    :param ways: those that there are now, at least one; the one over all radios first
    """

    def __init__(self, ways: Callable[[], Sequence[LiveWishes]]) -> None:
        self._ways = ways

    def want(self, robot: int, name: str, rate: float = 0.0, for_s: float = 60.0, told: Told | None = None) -> None:
        """As :meth:`LiveWishes.want`; ``told`` is called once, when it is sent or nobody is left who may say so."""
        ways = self._to(robot)
        once = None if told is None else _Once(told, len(ways), lambda: self.wish(robot, name))
        for way in ways:
            way.want(robot, name, rate, for_s, None if once is None else once.told)

    def give_up(self, robot: int, name: str) -> None:
        for way in self._to(robot):
            way.give_up(robot, name)

    def wish(self, robot: int, name: str) -> dict[str, Any]:
        """As :meth:`LiveWishes.wish`."""
        return min((way.wish(robot, name) for way in self._ways()), key=_rank)

    def offers(self, robot: int, *, anew: bool = False) -> dict[str, Any]:
        """As :meth:`LiveWishes.offers`; ``age_s`` is None until it has answered on all of them."""
        told = [way.offers(robot, anew=anew) for way in self._to(robot)]
        ages = [each["age_s"] for each in told]
        return {
            "robot": robot,
            "age_s": None if None in ages else max(ages),
            "rows": _rows(each["rows"] for each in told),
        }

    def known(self) -> dict[int, list[dict[str, Any]]]:
        told = [way.known() for way in self._ways()]
        robots = sorted({robot for each in told for robot in each})
        return {robot: _rows(each.get(robot, []) for each in told) for robot in robots}

    def stats(self) -> dict[str, Any]:
        """The wishes of this robot and of others, as :meth:`LiveWishes.stats` has them."""
        told = [way.stats() for way in self._ways()]
        return {
            "wanted": [wish for each in told for wish in each["wanted"]],
            "wants": best_of(wish for each in told for wish in each["wants"]),
        }

    def _to(self, robot: int) -> list[LiveWishes]:
        """The ways over which a robot is heard; where it is not, the first, which says so."""
        ways = self._ways()
        return [way for way in ways if way.hears(robot)] or [ways[0]]


class _Once:
    """Tells once what has become of a wish that several ways were asked for.

    :param ways: how many of them tell
    :param look: what is known of the wish now
    """

    def __init__(self, told: Told, ways: int, look: Callable[[], Mapping[str, Any]]) -> None:
        self._tell, self._left, self._look = told, ways, look
        self._lock = threading.Lock()

    def told(self, done: bool, words: str) -> None:
        """One of them has told."""
        with self._lock:
            self._left -= 1
            over = self._left < 0 or not (done or self._left == 0)
            if done:
                self._left = 0
        if not over:
            found = self._look()
            self._tell(done, found["words"] if found["state"] == "refused" else words)


def best_of(wishes: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Of the wishes that several ways tell of, one for each robot and topic."""
    found: dict[tuple[int, str], Mapping[str, Any]] = {}
    for wish in sorted(wishes, key=_rank):
        found.setdefault((wish["robot"], wish["topic"]), wish)
    return [found[key] for key in sorted(found)]


def _rank(wish: Mapping[str, Any]) -> int:
    state = wish["state"]
    return len(_BEST) + (state == "none") if state not in _BEST or not wish["offered"] else _BEST.index(state)


def _rows(lists: Iterable[list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """What a robot offers on several ways, each once."""
    rows: dict[str, dict[str, Any]] = {}
    for each in lists:
        for row in each:
            rows.setdefault(row["name"], row)
    return [rows[name] for name in sorted(rows)]
