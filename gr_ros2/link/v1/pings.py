"""Round trips: a robot asks another one, which answers at once; and what each end tells of itself.

Invariants: one answer waits per robot at most, and one leaves every ``ANSWER_S`` and in every other packet at most, so
that questions take a bounded share of the air; of each robot asked, the newest ``KEPT`` round trips are kept; there is
no clock here, so the caller passes in the time, and the difference to the clock of the wall.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf
from typing import Any

from gr_ros2.core.errors import ConfigError
from gr_ros2.link.clocks import ClockOffset, OtherClock
from gr_ros2.wire import BROADCAST
from gr_ros2.wire.control import ABOUT_LEN, HELD_STEP_S, PING_LEN, About, Ping, reportable

ANSWER_S, ASK_S = 0.05, 0.1
"""Least s between two answers, and between two questions to one robot, so that none of them replaces another."""
KEPT = 1000
_MOST_HELD = 0xFFFF
_WAITING = 64
"""Questions that may still be answered; of older ones an answer counts, but not its time."""


@dataclass
class RoundTrips:
    """What came of the questions to one robot.

    :ivar asked: questions that have left
    :ivar earlier: those of them that do not count any more
    :ivar answered: answers that have come
    :ivar arrived: questions that have arrived there, from the first that was answered to the newest; None before it
    :ivar round_trips: s from a question's leaving to its answer's arrival, the newest ``KEPT``
    :ivar held_s: s of the newest one for which the other robot held it
    :ivar clock: the other robot's; nothing is known of it if one has no clock
    :ivar snr_there_db: SNR at the other robot of what this one sends; None where it is not measured
    :ivar about: what the other end is; None if it has not said so
    :ivar not_before: time in s before which it is not asked again
    """

    asked: int = 0
    answered: int = 0
    arrived: int | None = None
    round_trips: deque[float] = field(default_factory=lambda: deque(maxlen=KEPT))
    held_s: float = 0.0
    clock: OtherClock = field(default_factory=OtherClock)
    snr_there_db: float | None = None
    about: About | None = None
    not_before: float = -inf
    earlier: int = 0
    _left: dict[int, float] = field(default_factory=dict)
    _counted: int = 0
    _first: int = 0
    _newest: int = 0
    """Number of the first question that was answered, and of the newest; and the count of the first answer."""

    def ask(self, robot: int, clock_us: int, now: float, *, wants_about: bool) -> Ping:
        """The next question to a robot; it leaves now.

        :param clock_us: clock of the wall, us; 0 = unknown
        """
        self.asked += 1
        self._left[self.asked & 0xFFFF] = now
        if len(self._left) > _WAITING:
            del self._left[next(iter(self._left))]
        return Ping(robot, self.asked & 0xFFFF, wants_about=wants_about, clock_us=clock_us)

    def answer(self, ping: Ping, wall_s: float, now: float) -> None:
        """Take an answer; one to a question that is too old, or was never asked, changes nothing.

        :param wall_s: clock of the wall minus ``now``, s; 0 = unknown
        """
        left = self._left.pop(ping.number, None)
        if left is None:
            return
        number = self.asked - (self.asked - ping.number & 0xFFFF)
        if self.arrived is None:  # the other robot may have counted questions of an earlier start of this one
            self._counted, self._first = ping.arrived, number
        self.arrived = 1 + (ping.arrived - self._counted & 0xFFFF)
        self._newest = max(self._newest, number)
        self.answered += 1
        self.snr_there_db = ping.snr_db
        took = now - left
        self.round_trips.append(took)
        self.held_s = ping.held * HELD_STEP_S
        if ping.clock_us and wall_s:
            ways_s = took - self.held_s
            self.clock.answered(ping.clock_us * 1e-6 - (wall_s + now - ways_s / 2), ways_s + HELD_STEP_S, now)

    def summary(self, now: float) -> dict[str, Any]:
        """All of it as plain values, with the median and the 99th percentile of the round trips."""
        clock = self.clock.at(now)
        took, about = sorted(self.round_trips), self.about
        told = None if about is None else {**about._asdict(), "text": about.text.decode("utf-8", "replace")}
        return {
            "asked": self.asked - self.earlier,
            "answered": self.answered,
            "lost_there": self.lost_there,
            "lost_back": self.lost_back,
            "round_trip_s": {
                "p50": took[len(took) // 2] if took else None,
                "p99": took[min(len(took) * 99 // 100, len(took) - 1)] if took else None,
                "last": self.round_trips[-1] if took else None,
            },
            "held_s": self.held_s if took else None,
            "clock_s": None if clock is None else clock.ahead_s,
            "clock_error_s": None if clock is None else clock.error_s,
            "snr_there_db": self.snr_there_db,
            "about": told,
        }

    @property
    def lost_there(self) -> int | None:
        """Questions that did not arrive, from the first that was answered to the newest; None before the first."""
        return None if self.arrived is None else max(0, self._newest - self._first + 1 - self.arrived)

    @property
    def lost_back(self) -> int | None:
        """Answers that did not arrive; None before the first has."""
        return None if self.arrived is None else max(0, self.arrived - self.answered)


@dataclass
class _Question:
    number: int
    arrived: float
    wants_about: bool


class Pings:
    """The questions and answers of one robot.

    :param about: what this end is, to be told to those who ask; None tells nothing
    :param turn_s: tells s from one packet of this robot to its next; 0 = not known
    :ivar snr_db: returns the SNR of the newest packets of all robots, for PHYs that do not tell it packet by packet
    :ivar asked: what came of the questions, by robot
    :ivar asked_by: when each robot asked last what this one is, s
    """

    def __init__(self, about: About | None = None, turn_s: Callable[[], float] = lambda: 0.0) -> None:
        self.about = about
        self._turn_s = turn_s
        self._wall_s = 0.0
        self.snr_db: Callable[[], float | None] = lambda: None
        self.asked: dict[int, RoundTrips] = {}
        self.asked_by: dict[int, float] = {}
        self._to_ask: dict[int, bool] = {}
        self._to_answer: dict[int, _Question] = {}
        self._counts: dict[int, int] = {}
        self._not_before = -inf
        self.due = inf
        """When a question or an answer is to leave, s; infinite if none waits."""

    @property
    def wall_s(self) -> float:
        """Clock of the wall minus ``now``, s; 0 = unknown. Setting it moves what is known of other clocks."""
        return self._wall_s

    @wall_s.setter
    def wall_s(self, wall_s: float) -> None:
        if self._wall_s:
            for trips in self.asked.values():
                trips.clock.own_was_set(wall_s - self._wall_s)
        self._wall_s = wall_s

    def clock_of(self, robot: int, now: float) -> ClockOffset | None:
        """What is known of another robot's clock."""
        trips = self.asked.get(robot)
        return None if trips is None else trips.clock.at(now)

    def introduce(self, packet_len: int, phy: int, key: int, text: str) -> None:
        """Tell those who ask what this end is.

        :param phy: number that stands for the settings of the PHY
        :param key: number that stands for the key, 0 for none
        """
        self.about = About(packet_len, phy, key, text.encode())

    def put(self, robot: int, now: float, *, anew: bool = False) -> dict[str, Any]:
        """Ask a robot as soon as a packet may leave; returns what has come of all questions to it so far.

        :param anew: forget the earlier ones
        :raises ConfigError: for a number that no robot has
        """
        if anew and (before := self.asked.get(robot)) is not None:  # numbers go on, so that no late answer counts
            self.asked[robot] = RoundTrips(before.asked, earlier=before.asked, about=before.about, clock=before.clock)
        return self.ask(robot, now, wants_about=True).summary(now)

    def ask(self, robot: int, now: float, *, wants_about: bool = False) -> RoundTrips:
        """Ask a robot as soon as a packet may leave, unless it was asked less than ``ASK_S`` ago; returns what has come
        of all questions to it.

        :raises ConfigError: for a number that no robot has
        """
        if not 0 <= robot < BROADCAST:
            raise ConfigError(f"robot = {robot}: who can be asked is 0 to {BROADCAST - 1}")
        trips = self.asked.setdefault(robot, RoundTrips())
        if now >= trips.not_before:
            trips.not_before = now + self._rest(ASK_S)
            self._to_ask[robot] = wants_about
            self.due = -inf
        return trips

    def entries(self, room: int, snrs_db: dict[int, float | None], now: float) -> list[Ping | About]:
        """The entries of the next packet; empty if none is due.

        :param room: bytes free
        :param snrs_db: SNR of what each robot sends, as it is received here
        """
        if self._to_ask:
            robot, wants_about = self._to_ask.popitem()
            self._plan()
            return [self.asked[robot].ask(robot, self._clock_us(now), now, wants_about=wants_about)]
        if not self._to_answer or now < self._not_before:
            return []
        self._not_before = now + self._rest(ANSWER_S)
        robot = next(iter(self._to_answer))
        question = self._to_answer.pop(robot)
        self._plan()
        held = min(round((now - question.arrived) / HELD_STEP_S), _MOST_HELD)
        count, clock_us, snr_db = self._counts[robot] & 0xFFFF, self._clock_us(now), snrs_db.get(robot)
        if snr_db is None:
            snr_db = self.snr_db()
        snr_db = None if snr_db is None else reportable(snr_db)
        entries: list[Ping | About] = [Ping(robot, question.number, True, False, count, held, clock_us, snr_db)]
        free = room - PING_LEN - ABOUT_LEN
        if question.wants_about and self.about is not None and free >= 0:
            entries.append(self.about._replace(text=self.about.text[: min(free, 255)]))
        return entries

    def receive(self, src_id: int, own_id: int, entry: Ping | About, now: float) -> None:
        """A question, an answer or what another end is, from a packet that was opened."""
        if isinstance(entry, About):
            if src_id in self.asked:
                self.asked[src_id].about = entry
        elif entry.robot != own_id:
            return
        elif not entry.reply:
            self._counts[src_id] = self._counts.get(src_id, 0) + 1
            if entry.wants_about:
                self.asked_by[src_id] = now
            self._to_answer[src_id] = _Question(entry.number, now, entry.wants_about)
            self.due = min(self.due, self._not_before)
        elif src_id in self.asked:
            self.asked[src_id].answer(entry, self.wall_s, now)

    def _rest(self, seconds: float) -> float:
        """s between two of them: every other packet is for messages."""
        return max(seconds, 2 * self._turn_s())

    def _plan(self) -> None:
        """Something of what waited leaves."""
        self.due = -inf if self._to_ask else self._not_before if self._to_answer else inf

    def _clock_us(self, now: float) -> int:
        return round((self.wall_s + now) * 1e6) if self.wall_s else 0
