"""What the link to another robot carries each way, and at which age beside the topics that run.

Both ends look at their topics for ``QUIET_S``. Then the robot that asks fills what its topics leave of the air with
messages of class bulk, and after it the other one. Each end counts what it receives. The other robot is asked, and
tells what it has counted, by calls of the link itself.

Invariants: at most one measurement goes on here; it ends by itself, whatever becomes of the other robot; without one
there is no thread and no work per message. At most ``WAITING`` of its messages wait. Where airtime is limited, no more
of them leave than what the limit allows in the long run, beside the topics.
"""

from __future__ import annotations

import logging
import random
import secrets
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from math import inf, isnan, nan
from typing import Any

from gr_ros2.calls import Request
from gr_ros2.calls.throughput_frames import (
    LONGEST_S,
    MEASURE,
    REPORT,
    Carried,
    MeasureOutcome,
    MeasureRequest,
    read_measure,
    read_measured,
    write_measure,
    write_measured,
)
from gr_ros2.core.errors import ConfigError, GrRos2Error, WireError
from gr_ros2.gr.bulk_topic import add_bulk_topic
from gr_ros2.gr.calls import LiveCalls
from gr_ros2.gr.live_end import LiveEnd
from gr_ros2.gr.receiving import ReceivingBlock
from gr_ros2.link.endpoint import OpenEndpoint
from gr_ros2.settings.registry import FILLER_TYPE
from gr_ros2.settings.robot import RobotConfig

QUIET_S = 2.0
"""s for which both ends look at their topics alone."""
WAITING = 16
PATIENCE_S = 30.0
"""s for which answers of the other robot are waited for."""
_STEP_S, _LOOK_S, _REPORT_S = 0.005, 0.2, 1.0
"""s between two looks at what waits, two at the ages of topics, and two questions for what has arrived there."""
_STILL_S = 2.0
"""s from one look to the next after which this process has stood still, and nothing can be said of the link."""
_REST_S = 3.0
"""s for which messages may still arrive at the robot that asks."""
_HEAD = 64
"""bytes of a packet that are left for its head and those of its messages."""
_LEAST = 16
_NUMBER = 4
_log = logging.getLogger(__name__)
MAIN = ""
"""Name of the way that any radio may carry."""
_OVER = ("done", "failed")


class ThroughputWays:
    """The measurements of one robot over each of its ways, at the same time: no two have air in common.

    What any radio may carry is one way, and each radio whose channel other robots share is another one with an endpoint
    of its own (:mod:`gr_ros2.gr.bound`).

    :param ways: those that there are now, at least one, by the names of their radios
    """

    def __init__(self, ways: Callable[[], Mapping[str, LiveThroughput]]) -> None:
        self._ways = ways
        self._measured: Mapping[str, LiveThroughput] = {}

    def measure(self, robot: int, for_s: int) -> None:
        """As :meth:`LiveThroughput.measure`, over all ways over which the robot is heard, or over none."""
        ways = self._ways()
        heard = {name: way for name, way in ways.items() if way.hears(robot)} or dict([next(iter(ways.items()))])
        for way in heard.values():
            way.check(robot, for_s)
        for way in heard.values():
            way.measure(robot, for_s)
        self._measured = heard

    def look(self) -> dict[str, Any]:
        """As :meth:`LiveThroughput.look`, of what any radio may carry, with ``radios``: the same of each that has its
        channel for itself, by name. The state is that of the way that takes longest; failed, if none did not."""
        told = {name: way.look() for name, way in self._measured.items()}
        if not told:
            return {"state": "none"}
        first = next(iter(told.values()))
        ends = [each for each in told.values() if each["state"] == "done"] or [first]
        going = [each for each in told.values() if each["state"] not in _OVER]
        nothing = {"there": None, "back": None}
        return {
            **first,
            **{way: told.get(MAIN, nothing)[way] for way in nothing},
            "state": (going or ends)[0]["state"],
            "words": "; ".join(dict.fromkeys(each["words"] for each in told.values() if each["words"])),
            "radios": {name: each for name, each in told.items() if name != MAIN},
        }


@dataclass(slots=True)
class _Ages:
    """Ages of topics, looked at again and again, s."""

    total: float = 0.0
    count: int = 0
    worst: float = nan

    def add(self, ages: Iterable[float]) -> None:
        for age in ages:
            self.total, self.count = self.total + age, self.count + 1
            self.worst = age if isnan(self.worst) else max(self.worst, age)

    @property
    def mean(self) -> float:
        return self.total / self.count if self.count else nan


@dataclass(slots=True)
class _Run:
    """A measurement at this end.

    :param sends_at: when this end begins to send, s
    :param receives_at: when the other one does, s
    :param asks: whether this end has begun it
    :param began: when it was asked for, s
    :param filled, allowed: when messages were made last, s, and bytes that may leave until then
    """

    robot: int
    number: int
    for_s: int
    sends_at: float
    receives_at: float
    asks: bool
    began: float
    sent: int = 0
    messages: int = 0
    size: int = 0
    first: float = nan
    last: float = nan
    quiet: _Ages = field(default_factory=_Ages)
    busy: _Ages = field(default_factory=_Ages)
    topics: tuple[float, int] | None = None
    topics_per_s: float = 0.0
    filled: float = -inf
    allowed: float = 0.0
    there: Carried | None = None
    answered: float = -inf
    refused: str = ""
    over: bool = False

    @property
    def over_at(self) -> float:
        return max(self.sends_at, self.receives_at) + self.for_s + _REST_S

    def here(self) -> Carried:
        """What has arrived here so far."""
        span_ms = 0 if isnan(self.first) else round((self.last - self.first) * 1e3)
        return Carried(
            MeasureOutcome.RUNS,
            self.sent,
            self.messages,
            self.size,
            span_ms,
            self.topics_per_s,
            self.busy.mean,
            self.quiet.mean,
            self.busy.worst,
        )


class LiveThroughput:
    """The measurements of one robot's link.

    :param share: part of the time that its transmitter may send
    :param sends: whether it may send at all
    """

    def __init__(
        self,
        config: RobotConfig,
        end: LiveEnd[OpenEndpoint],
        calls: LiveCalls,
        sink: ReceivingBlock,
        *,
        share: float,
        sends: bool,
        clock: Callable[[], float],
    ) -> None:
        self._config, self._end, self._calls, self._sink = config, end, calls, sink
        self._share, self._sends, self._clock = share, sends, clock
        self._lock = threading.Lock()
        """Protects what follows; no other lock is taken while it is held."""
        self._run: _Run | None = None
        self._thread: threading.Thread | None = None
        self._closed = threading.Event()
        self._topic_id: int | None = None
        self._made = random.Random()
        calls.link_calls |= dict.fromkeys((MEASURE, REPORT), self._called)
        calls.on_filler = self._arrived

    def close(self) -> None:
        """End what goes on. Idempotent."""
        self._closed.set()
        with self._lock:
            thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join()

    def hears(self, robot: int) -> bool:
        """Whether a robot can be asked."""
        return robot in self._calls.heard()

    def check(self, robot: int, for_s: int) -> None:
        """Check that the link to another robot can be measured now; see :meth:`measure`.

        :raises ConfigError: if not
        """
        if not 1 <= for_s <= LONGEST_S:
            raise ConfigError(f"for = {for_s} s: write 1 to {LONGEST_S} s")
        if not self._sends:
            raise ConfigError("this robot does not transmit, so it cannot ask another one")
        self._calls.check_heard(robot)
        with self._lock:
            self._check_free(robot)

    def _check_free(self, robot: int) -> None:
        """Check that no measurement goes on; the caller holds the lock."""
        if self._thread is not None:
            raise ConfigError(f"a measurement of the link to robot {self._run.robot if self._run else robot} goes on")

    def measure(self, robot: int, for_s: int) -> None:
        """Measure the link to another robot.

        :param for_s: s for each direction
        :raises ConfigError: for a robot that is not heard, a wrong time, or while a measurement goes on
        """
        self.check(robot, for_s)
        number, now = secrets.randbits(32), self._clock()
        with self._lock:
            self._check_free(robot)
            asked = _Run(robot, number, for_s, inf, inf, True, now)
            self._begin(asked)
        request = write_measure(MeasureRequest(MEASURE, number, for_s))
        if not self._calls.ask(robot, request, partial(self._answered, asked), PATIENCE_S):
            asked.refused = f"robot {robot} is not heard any more"

    def look(self) -> dict[str, Any]:
        """What has come of the newest measurement: ``state`` (none, asked, quiet, there, back, done or failed), and
        ``there`` and ``back``, what has arrived at the other robot and here."""
        with self._lock:
            run = self._run
        if run is None:
            return {"state": "none"}
        now = self._clock()
        if run.refused:
            state = "failed"
        elif run.over:
            state = "done"
        elif run.sends_at == inf:
            state = "asked"
        elif now < min(run.sends_at, run.receives_at):
            state = "quiet"
        else:
            state = "there" if run.sends_at <= now < run.sends_at + run.for_s else "back"
        return {
            "robot": run.robot,
            "state": state,
            "words": run.refused,
            "for_s": run.for_s,
            "there": None if run.there is None else _told(run.there, run.sent),
            "back": _told(run.here(), None if run.there is None else run.there.sent),
        }

    # ---- the other robot

    def _called(self, robot: int, _boot: int, request: Request) -> None:
        """Answer another robot, in the thread that receives.

        :raises WireError: its request cannot be read
        """
        asked = read_measure(request.payload)
        now = self._clock()
        with self._lock:
            run = self._run
            if run is not None and (run.robot, run.number) == (robot, asked.number):
                told = run.here()
            elif asked.kind == REPORT:
                told = Carried(MeasureOutcome.UNKNOWN)
            elif self._thread is not None or self._closed.is_set():
                told = Carried(MeasureOutcome.BUSY)
            elif not self._sends:
                told = Carried(MeasureOutcome.SENDS_NOT)
            else:
                began = now + QUIET_S
                self._begin(_Run(robot, asked.number, asked.for_s, began + asked.for_s, began, False, now))
                told = Carried(MeasureOutcome.RUNS)
        self._calls.answer(request.ticket, write_measured(told))

    def _answered(self, run: _Run, reply: bytes) -> None:
        """An answer has come, in the thread that receives."""
        try:
            told = read_measured(reply)
        except WireError:
            run.refused = f"robot {run.robot} answers what cannot be read"
            return
        now = self._clock()
        match told.outcome:
            case MeasureOutcome.RUNS if run.sends_at == inf:
                run.sends_at, run.receives_at = now + QUIET_S, now + QUIET_S + run.for_s
            case MeasureOutcome.RUNS:
                run.there, run.answered = told, now
            case MeasureOutcome.BUSY:
                run.refused = f"robot {run.robot} measures the link to another robot now; ask again later"
            case MeasureOutcome.SENDS_NOT:
                run.refused = f"robot {run.robot} sends nothing"
            case MeasureOutcome.UNKNOWN:
                run.refused = f"robot {run.robot} has started again meanwhile"

    def _arrived(self, robot: int, payload: bytes) -> None:
        """A message of a measurement, in the thread that receives."""
        run, now = self._run, self._clock()
        if run is None or robot != run.robot or payload[:_NUMBER] != run.number.to_bytes(_NUMBER, "big"):
            return
        run.messages += 1
        if isnan(run.first):
            run.first = now
        else:
            run.size += len(payload)
        run.last = now

    # ---- the thread

    def _begin(self, run: _Run) -> None:
        """Begin a measurement; the caller holds the lock."""
        self._run = run
        self._thread = threading.Thread(target=self._go_on, args=(run,), name="gr-ros2-throughput", daemon=True)
        self._thread.start()

    def _go_on(self, run: _Run) -> None:
        try:
            self._measure(run)
        except GrRos2Error as error:
            run.refused = str(error)
        finally:
            with self._lock:
                self._thread, run.over = None, True

    def _measure(self, run: _Run) -> None:
        look_at = report_at = -inf
        looked, dropped = self._clock(), False
        while not self._closed.wait(_STEP_S if run.sends_at < inf else _LOOK_S / 4):
            before, looked = looked, self._clock()
            now = looked
            if run.asks and not run.refused and now > before + _STILL_S:
                run.refused = f"this link stood still for {now - before:.0f} s itself meanwhile; measure again"
            if run.refused:
                break
            if run.sends_at == inf:
                self._calls.check_heard(run.robot)  # who goes away meanwhile does not answer
                if now > run.began + PATIENCE_S:
                    run.refused = f"robot {run.robot} has not answered in {PATIENCE_S:.0f} s: an older gr-ros2 does not"
                continue
            topic_id = self._announce() if self._topic_id is None else self._topic_id
            if now >= look_at:
                look_at = now + _LOOK_S
                self._look_at_topics(run, now)
            if run.sends_at <= now < run.sends_at + run.for_s:
                self._fill(run, topic_id, now)
            elif now >= run.sends_at + run.for_s and not dropped:
                dropped = True
                self._drop(run)
            if run.asks and now >= max(report_at, run.sends_at) and run.answered < run.over_at - _REST_S:
                report_at = now + _REPORT_S
                asked = MeasureRequest(REPORT, run.number, run.for_s)
                self._calls.ask(run.robot, write_measure(asked), partial(self._answered, run), PATIENCE_S)
            if not run.asks and now >= run.sends_at + run.for_s:
                break
            done = now >= run.over_at and run.answered >= run.over_at - _REST_S
            if done or now >= run.over_at + PATIENCE_S:
                if not done:
                    run.refused = f"robot {run.robot} has not told what arrived; it is out of range"
                break
        self._drop(run)

    def _look_at_topics(self, run: _Run, now: float) -> None:
        """Ages of the newest messages of the other robot's topics, and what comes of them."""
        with self._end.lock:
            topics = [topic for topic in self._sink.outputs.stats().values() if topic["src_id"] == run.robot]
        ages = [topic["age_s"] for topic in topics if topic["age_s"] is not None]
        delivered = sum(topic["delivered"] for topic in topics)
        if now < min(run.sends_at, run.receives_at):
            run.quiet.add(ages)
        elif run.receives_at + _LOOK_S <= now < run.receives_at + run.for_s:
            run.busy.add(ages)
            if run.topics is None:
                run.topics = now, delivered
            else:
                run.topics_per_s = (delivered - run.topics[1]) / (now - run.topics[0])

    def _announce(self) -> int:
        """Tell the other robots of the topic of these messages; returns its number."""
        with self._end.lock:
            self._topic_id = add_bulk_topic(
                self._end.endpoint, "_filler", FILLER_TYPE, waiting=WAITING, reliability="best_effort"
            )
            self._end.wake()
        return self._topic_id

    def _fill(self, run: _Run, topic_id: int, now: float) -> None:
        """Let messages wait for what is left of the air."""
        size = max(_LEAST, self._config.packet_len - _HEAD)
        head = run.number.to_bytes(_NUMBER, "big")
        with self._end.lock:
            messages = self._end.endpoint.messages
            count = WAITING - messages.queued().get(topic_id, 0)
            if self._share < 1:
                run.allowed += min(self._end.endpoint.used_air.free(now) * (now - max(run.filled, run.sends_at)), 1e9)
                count = min(count, int(run.allowed // size))
                run.allowed -= count * size
            run.filled = now
        for _ in range(count):
            payload = head + self._made.randbytes(size - _NUMBER)
            with self._end.lock:
                messages.submit(topic_id, payload, now)
                self._end.wake()
        run.sent += count

    def _drop(self, run: _Run) -> None:
        """What still waits is of no use any more."""
        with self._end.lock:
            if self._topic_id is not None:
                messages = self._end.endpoint.messages
                before = messages.queued().get(self._topic_id, 0)
                messages.stop(self._topic_id)
                run.sent -= before - messages.queued().get(self._topic_id, 0)


def _told(measured: Carried, sent: int | None) -> dict[str, Any]:
    """What has arrived at one end, as plain values.

    :param sent: messages that the other end has sent
    """
    arrived = measured.messages
    lost = None if not sent else max(0.0, 1 - arrived / sent)
    values = {
        "Bps": measured.rate_Bps,
        "messages": arrived,
        "lost": lost,
        "topics_per_s": measured.topics_per_s,
        "age_s": measured.age_s,
        "worst_age_s": measured.worst_age_s,
        "quiet_age_s": measured.quiet_age_s,
    }
    return {name: None if isinstance(value, float) and isnan(value) else value for name, value in values.items()}
