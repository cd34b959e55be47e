"""Discrete-event simulation of a scenario, without threads and waiting: the clock jumps from event to event.

An event loop (:class:`EventLoop`) serves the robots (:class:`Robot`) and the medium between them
(:class:`gr_ros2_lab.medium.Medium`). It asks a robot for packets when the robot may have one, and hands them to the
medium, which says who receives them when their airtime is over. Whoever received something may send in response. What
the computer takes (middleware, Python, signal processing) is one constant, ``overhead_s``, 0 by default.

Invariants: the same scenario gives the same numbers; the packets of a robot are sent one after the other, each for its
airtime, so no message is complete before all its packets have been on the air; events are reported in the order of
time; the work for an event does not depend on the number of robots that it does not concern.
"""

from __future__ import annotations

import heapq
import random
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from math import inf
from typing import Any, Protocol

from gr_ros2.codecs.frames import FrameSender, TimedCoder
from gr_ros2.codecs.received_frames import FrameReceiver
from gr_ros2.core.errors import BagError, CodecError, ConfigError, RunError
from gr_ros2.core.tuning import Tuning
from gr_ros2.gr.factory import make_endpoint
from gr_ros2.link import Delivered, Lost, Received, ReceiverEvent, SenderEvent, SenderStats, SentPacket
from gr_ros2.link.airtime import AirtimeClock
from gr_ros2.link.airtime_limit import AirtimeLimit, at_full_load
from gr_ros2.link.endpoint import Endpoint
from gr_ros2.link.events import Announced
from gr_ros2.link.message_codec import MessageCodec
from gr_ros2.link.observe import LinkObserver
from gr_ros2.middleware.bag_files import read_bag
from gr_ros2.observe.result import TopicResult
from gr_ros2.paper.factory import make_paper_endpoint
from gr_ros2.phy import Phy
from gr_ros2.settings.registry import Registry
from gr_ros2.settings.robot import RobotConfig
from gr_ros2_lab.medium import FixedPaths, Medium, Reception, Transmission, make_medium
from gr_ros2_lab.medium.packets import PacketMedium
from gr_ros2_lab.record.recorder import Recorder
from gr_ros2_lab.run.load import make_phy, recorded_names, source_names
from gr_ros2_lab.run.recorders import make_recorder
from gr_ros2_lab.run.robot_settings import senders_of
from gr_ros2_lab.run.robots import air_of_run, hearer_of, start_of_run, surroundings
from gr_ros2_lab.run.scenario import Scenario
from gr_ros2_lab.run.task_run import TaskRun
from gr_ros2_lab.sim.fleet import Fleet, SimMessage
from gr_ros2_lab.sim.sim_settings import SimSettings

_LONGEST_GAP_S = 30 * 86400.0
"""s between two consecutive messages of a recording. A longer gap means that a stamp was never set. The link would be
simulated for all of the gap: decades where the first stamp is 0."""
_IN_VAIN = 1000
"""Steps in a row without an event at one time after which a simulation is said to stand still."""
_REMEMBERED_S = 60.0
"""Simulated messages of runs up to this long are cached: 5 MB for two robots with all their topics."""


class Upcoming(Protocol):
    """A message for the source.

    :ivar t: when it is submitted, s after the start
    :ivar payload: is asked for at ``t``, so it may depend on what came before
    """

    @property
    def t(self) -> float: ...

    @property
    def topic_id(self) -> int: ...

    @property
    def payload(self) -> bytes: ...


@dataclass(frozen=True, slots=True)
class Offered:
    """A message handed to the source ``t`` s after the start."""

    t: float
    topic_id: int
    payload: bytes


TimedEvent = tuple[float, "Robot", SenderEvent | ReceiverEvent]
"""Time of the event, s after the start; the robot that sent or received; and the event itself."""
Airtime = Callable[[int | None, int], float]
"""s that a packet of this many bytes, sent with this MCS, is on the air; None stands for the longest packet."""


@dataclass(frozen=True)
class Simulated:
    """The result of a simulation.

    :param duration_s: s during which messages were offered
    :param airtime_s: of the longest packet, s; 0 for a PHY without airtime
    :param packets: as in ``result.json``
    :param stats: by source id
    :param frames: what was made of topics that are sent as frames, by source and topic id
    """

    duration_s: float
    airtime_s: float
    topics: tuple[TopicResult, ...]
    packets: dict[str, Any]
    stats: Mapping[int, SenderStats]
    recorder: Recorder
    frames: Mapping[tuple[int, int], dict[str, Any]]


def offered(scenario: Scenario, registry: Registry) -> Iterator[Offered]:
    """What the source of a scenario with one gives to the link, in time order.

    :raises ConfigError: for a recording played as fast as the link takes it, because its messages have no times
    :raises BagError: for a recording whose times jump by more than 30 days
    """
    if scenario.bag_path is None:
        names = source_names(scenario.first, registry)
        for sent in _simulated(scenario.sim, scenario.duration_s, frozenset(names)):
            yield Offered(sent.t, names[sent.topic], sent.payload)
        return
    if not scenario.bag_speed:
        raise ConfigError("bag_speed = 0: a recording as fast as the link takes it cannot be simulated; set it above 0")
    names = recorded_names(scenario, registry)
    first = last = None
    for message in read_bag(scenario.bag_path, names):
        first = message.stamp_ns if first is None else first
        t = (message.stamp_ns - first) * 1e-9 / scenario.bag_speed
        if scenario.duration_s and t >= scenario.duration_s:
            return
        gap = 0.0 if last is None else (message.stamp_ns - last) * 1e-9
        if gap > _LONGEST_GAP_S:
            raise BagError(
                f"bag {scenario.bag_path}: a message on {message.topic} was recorded {gap / 86400:.0f} days after the "
                "one before it; cut the recording there, or set duration_s to end before it"
            )
        last = message.stamp_ns
        yield Offered(t, names[message.topic], message.payload)


def offered_by(scenario: Scenario, registry: Registry) -> list[Iterator[Offered]]:
    """What each robot that sends gives to the link. The robots of a simulator drive only once."""
    names = [source_names(robot, registry) for robot in senders_of(scenario.all_robots)]
    if len(names) == 1:
        return [offered(scenario, registry)]
    sent = list(_simulated(scenario.sim, scenario.duration_s, frozenset().union(*names)))
    return [_own(sent, own) for own in names]


def _own(sent: Sequence[SimMessage], names: Mapping[str, int]) -> Iterator[Offered]:
    for message in sent:
        if message.topic in names:
            yield Offered(message.t, names[message.topic], message.payload)


def _simulated(settings: SimSettings, duration_s: float, topics: frozenset[str]) -> Iterable[SimMessage]:
    """The simulator's messages. Those of short runs are cached, because a sweep needs them many times."""
    if duration_s <= _REMEMBERED_S:
        return _remembered(settings, duration_s, topics)
    return Fleet(settings).messages(duration_s, topics=topics)


@lru_cache(maxsize=4)
def _remembered(settings: SimSettings, duration_s: float, topics: frozenset[str]) -> tuple[SimMessage, ...]:
    return tuple(Fleet(settings).messages(duration_s, topics=topics))


def simulate(
    scenario: Scenario,
    *,
    registry: Registry | None = None,
    phy: Phy | None = None,
    messages: Sequence[Iterator[Offered]] | None = None,
    codec: MessageCodec | None = None,
    tuning: Tuning = Tuning(),
    on_packet: Callable[[SentPacket], None] | None = None,
    overhead_s: float = 0.0,
) -> Simulated:
    """Forecast a scenario, see :func:`coupled`. Only those settings of the channel that lose whole packets have an
    effect, or that were measured, and packets that overlap are lost. The messages of a robot count as delivered at the
    first robot that hears it.

    :param registry: None takes the scenario's
    :param phy: None makes the scenario's
    :param messages: those that each robot that sends is offered, in time order; None takes the scenario's source
    :param codec: of all messages; None makes one
    :param tuning: of all robots
    :param on_packet: called with every packet that leaves a robot
    :param overhead_s: s from the end of a packet's airtime to the republication of what it completes
    :raises ConfigError: when the scenario cannot be set up
    """
    scenario = coupled(scenario)
    registry = registry or scenario.load_registry()
    phy = phy or make_phy(scenario, registry)
    if phy.mcs_table:
        raise ConfigError("rate = 'adaptive': a forecast has one rate; set phy.options.rate to fixed")
    run = Simulation(scenario, registry, phy, messages=messages, codec=codec, tuning=tuning, ideal=True)
    senders = senders_of(scenario.all_robots)
    ids = [robot.robot_id for robot in senders]
    listeners = {src_id: hearer_of(run.around, number) for number, src_id in enumerate(ids)}
    recorder = make_recorder(registry, senders)
    for timed_event in run.events():
        _, robot, event = timed_event
        if not isinstance(event, _OfSender) or listeners.get(event.src_id, robot.number) == robot.number:
            pass_on(recorder, timed_event, overhead_s)
        if on_packet is not None and isinstance(event, SentPacket):
            on_packet(event)
    return Simulated(
        duration_s=run.duration_s,
        airtime_s=phy.airtime(),
        topics=recorder.finish(run.duration_s, run.duration_s, run.empty),
        packets=recorder.ledger.packets(),
        stats={src_id: robot.endpoint.sent for src_id, robot in zip(ids, run.robots, strict=False)},
        recorder=recorder,
        frames={(robot.src_id, topic_id): made for robot in run.robots for topic_id, made in robot.made().items()},
    )


def coupled(scenario: Scenario) -> Scenario:
    """What is forecast together: all robots that send, with one receiver where only one does."""
    senders = [robot for robot in scenario.robots if robot.sends]
    others = [robot for robot in scenario.robots if not robot.sends]
    gains = scenario.gains_db if isinstance(scenario.gains_db, float | int | None) else None
    kept = (*senders, *others[: 1 if len(senders) == 1 else 0])
    return scenario if len(kept) == len(scenario.robots) else replace(scenario, robots=kept, gains_db=gains)


_OfSender = Received | Delivered | Lost
"""Events of a receiver about what one sender has sent."""


def pass_on(observer: LinkObserver, timed_event: TimedEvent, overhead_s: float = 0.0) -> None:
    """Pass an event on to an observer."""
    now, robot, event = timed_event
    if isinstance(event, SenderEvent):
        observer.sender_event(robot.src_id, event)
    else:
        observer.receiver_event(event, now + overhead_s if isinstance(event, Delivered) else now)


class Simulation:
    """The robots of a scenario and the medium between them: all that a run in simulated time consists of.

    :param phy: of all robots, see :func:`gr_ros2_lab.run.load.make_phy`
    :param messages: those that each robot that sends is offered, in time order; None takes the scenario's source
    :param task: offers them instead, and moves the robots
    :param codec: of all messages; None makes one
    :param tuning: of all robots
    :param ideal: the PHY loses nothing, unless its levels were measured
    """

    def __init__(
        self,
        scenario: Scenario,
        registry: Registry,
        phy: Phy,
        *,
        messages: Sequence[Iterator[Upcoming]] | None = None,
        task: TaskRun | None = None,
        codec: MessageCodec | None = None,
        tuning: Tuning = Tuning(),
        ideal: bool = False,
    ) -> None:
        if messages is None:
            messages = offered_by(scenario, registry) if task is None else task.offered()
        self.robots = _robots(scenario, registry, phy, messages, codec=codec, tuning=tuning, busy=ideal)
        self.around = around = surroundings(scenario, phy.sample_rate, task)
        shared, phys = scenario.duplex == "half", [phy] * len(self.robots)
        if ideal:
            lossless = not around.surveyed
            self.medium: Medium = PacketMedium(around, phys, shared=shared, seed=scenario.seed, ideal=lossless)
        else:
            heard = {receiver for number in range(len(self.robots)) for receiver in around.reached(number)}
            answered = any(self.robots[number].endpoint.answers for number in heard)
            self.medium = make_medium(
                around,
                phys,
                samples=scenario.time == "samples",
                shared=shared,
                seed=scenario.seed,
                ahead=() if answered else _rehearsed(scenario, registry, phy),
            )

    def events(self) -> Iterator[TimedEvent]:
        """Everything that happens, in the order of time. To be called only once."""
        return EventLoop(self.robots, self.medium).run()

    def end(self, now: float) -> None:
        """Offer nothing more; what has been offered is still sent."""
        for robot in self.robots:
            robot.end(now)

    @property
    def duration_s(self) -> float:
        """s during which messages were offered."""
        return max(robot.duration_s for robot in self.robots)

    @property
    def empty(self) -> bool:
        """Whether nothing waits at a robot or for the air."""
        return all(robot.empty for robot in self.robots)


def _robots(
    scenario: Scenario,
    registry: Registry,
    phy: Phy,
    messages: Sequence[Iterator[Upcoming]],
    *,
    codec: MessageCodec | None = None,
    tuning: Tuning = Tuning(),
    busy: bool = False,
) -> list[Robot]:
    """The robots of a run, those that send first; see :class:`Simulation` and :class:`Robot`."""
    start, air, coming = start_of_run(scenario), air_of_run(scenario, phy, tuning), iter(messages)
    airtime = cache(phy.airtime)
    robots: list[Robot] = []
    for number, settings in enumerate(scenario.all_robots):
        events: list[SenderEvent] = []
        config, rng = settings.config, random.Random(scenario.seed)
        endpoint: Endpoint
        common: dict[str, Any] = {"codec": codec, "observer": events.append}
        if scenario.paper is None:
            endpoint = make_endpoint(config, registry, air=air, start=start, tuning=tuning, **common)
        else:
            endpoint = make_paper_endpoint(config, scenario.paper, registry, rng=rng, **common)
        robot = Robot(
            scenario,
            number,
            endpoint,
            events=events,
            src_id=settings.robot_id,
            airtime=airtime,
            messages=iter(()) if not config.sends else next(coming),
            start_s=settings.start_s,
            busy=busy,
            frames=frames_of(endpoint, config, registry),
        )
        robots.append(robot)
    return robots


def frames_of(endpoint: Endpoint, robot: RobotConfig, registry: Registry) -> FrameSender | None:
    """The topics of a robot that are sent as frames; None where none is."""
    if endpoint.frames is None or not robot.sends or not robot.compression:
        return None
    sender = FrameSender(endpoint.frames)
    sent = [sender.add(topic) for topic in registry.with_options(robot.options) if topic.is_topic]
    return sender if any(sent) else None


class _Unheard(Medium):
    """A medium on which nobody hears anything.

    :ivar over: packets whose airtime is over
    """

    def __init__(self, robots: int) -> None:
        super().__init__(FixedPaths([[]] * robots), shared=False)
        self.over: list[Transmission] = []

    def outcome(self, sent: Transmission) -> tuple[()]:
        self.over.append(sent)
        return ()


def _rehearsed(scenario: Scenario, registry: Registry, phy: Phy) -> Iterator[Transmission]:
    """What the robots send as long as they hear nothing. Where nobody answers, that is what they send in any case."""
    robots = _robots(scenario, registry, phy, offered_by(scenario, registry))
    medium = _Unheard(len(robots))
    for _ in EventLoop(robots, medium).run():
        yield from medium.over
        medium.over.clear()
    yield from medium.over


class Robot:
    """A robot of a simulated run: its endpoint, the messages offered to it, and the airtime of its packets.

    :param number: its place among the robots
    :param events: events of its sending half that have not been reported yet
    :param src_id: -1 for none
    :param airtime: of a packet by its bytes, None = of the longest, s; 0 for a PHY without airtime
    :param messages: in the order of time
    :param start_s: s, when it begins to send
    :param busy: whether it has had more to send than its airtime allows before the run
    :param frames: its topics that are sent as frames; None where none is
    """

    def __init__(
        self,
        scenario: Scenario,
        number: int,
        endpoint: Endpoint,
        *,
        events: list[SenderEvent],
        src_id: int,
        airtime: Airtime,
        messages: Iterator[Upcoming],
        start_s: float = 0.0,
        busy: bool = False,
        frames: FrameSender | None = None,
    ) -> None:
        self._start_s = start_s
        self._frames, self._received = frames, FrameReceiver()
        self._coder = None if frames is None else TimedCoder(frames)
        self.number, self.endpoint, self.src_id = number, endpoint, src_id
        self.over = False
        """Whether it has nothing more to send, as far as is known: a robot that answers may send later."""
        self.due = start_s
        """s, time at which it may do something next; infinite when it is over."""
        self.duration_s = scenario.duration_s
        """s during which messages were offered. Where the length of the bag decides this, it is known at the end."""
        self._events = events
        self._messages = messages
        self._coming = next(messages, None)
        self._airtime = airtime
        longest = airtime(None, 0)
        limit, rule = None, scenario.airtime.rule
        if rule is not None:
            limit = at_full_load(rule, longest) if busy else AirtimeLimit(rule, longest)
        self._clock: AirtimeClock[None] | None = AirtimeClock(longest, limit=limit) if longest else None
        self._drain = scenario.drain_s
        self._shares = scenario.medium != "exclusive"
        self._until = scenario.duration_s
        if self._clock is not None:
            endpoint.pace.use_credit()

    @property
    def empty(self) -> bool:
        """Whether nothing waits here or for the air."""
        return self.endpoint.idle and not (self._clock and self._clock.backlog)

    def step(self, now: float, medium: Medium) -> Iterator[TimedEvent]:
        """Take the messages that have come by ``now``, and send what may leave."""
        if self._clock is not None:
            self._clock.due(now)
            credits = self._clock.grants(now)
            self.endpoint.pace.credit(credits, inf if credits and self._clock.held else None)
        while self._coming is not None and self._coming.t <= now:
            topic_id, payload = self._coming.topic_id, self._coming.payload
            changed = None if self._frames is None else self._frames.changed(topic_id, payload)
            if self._frames is not None and changed is not None:
                self._frames.take(changed, now)
            elif self._frames is not None and topic_id in self._frames:
                self._frames.offer(topic_id, payload, now)
            else:
                self.endpoint.messages.submit(topic_id, payload, now)
            if not self._until:
                self.duration_s = now
            self._coming = next(self._messages, None)
        self._code(now)
        while (sent := self.endpoint.next_packet(now)) is not None:
            self._code(now)
            airtime = self._airtime(len(sent.data), sent.mcs)
            start = now if self._clock is None else self._clock.offer(None, now, airtime)
            assert start is not None, "a packet with a credit was refused"
            medium.send(self.number, sent.data, start, airtime, sent.mcs)
        yield from ((now, self, event) for event in self._events)
        self._events.clear()
        self.due = self._next(now)

    def end(self, now: float) -> None:
        """Take no further message."""
        self._messages, self._coming = iter(()), None
        self.duration_s = min(self.duration_s, now)

    def receive(self, reception: Reception) -> Iterator[TimedEvent]:
        """Take what has come out of the receiver."""
        for event in self.endpoint.receive(reception.packet, reception.at):
            yield reception.at, self, self._shown(event, reception.at)
        self._code(reception.at)

    def expire(self, now: float) -> Iterator[TimedEvent]:
        """Do what is due by ``now`` other than to send."""
        at = self.endpoint.next_timeout()
        if at is not None and at <= now:
            yield from ((now, self, self._shown(event, now)) for event in self.endpoint.handle_timeout(now))

    def finish(self, now: float) -> Iterator[TimedEvent]:
        """Say what becomes of messages that still wait to be coded."""
        if self._frames is not None:
            self._frames.end()
            yield from ((now, self, event) for event in self._events)
            self._events.clear()

    def made(self) -> dict[int, dict[str, Any]]:
        """What was made of its topics that are sent as frames, by topic id."""
        frames = self._frames
        if frames is None:
            return {}
        found = {topic_id: frames.stats(topic_id, self.duration_s) for topic_id in self.endpoint.messages.queued()}
        return {topic_id: made for topic_id, made in found.items() if made is not None}

    def _code(self, now: float) -> None:
        if self._coder is not None:
            self._coder.look(now)

    def _shown(self, event: ReceiverEvent, now: float) -> ReceiverEvent:
        """An event with the message that a frame is. One that cannot be decoded stays a frame."""
        if isinstance(event, Announced):
            for told in event.topics:
                self._received.announce((event.src_id, told.topic_id), told)
        elif isinstance(event, Delivered):
            try:
                shown = self._received.decode((event.src_id, event.topic_id), "", event.payload, now)
            except CodecError:
                if self.endpoint.frames is not None:
                    self.endpoint.frames.lost(event.src_id, event.topic_id)
                return event
            return event if shown is event.payload else event._replace(shown=shown)
        return event

    def wake(self, now: float) -> None:
        """Look again at when there is a packet. Something has just been received and may let one leave earlier."""
        if self._coder is not None:
            self.due = min(self.due, max(now, self._coder.due))
        at = self.endpoint.next_departure() if self.endpoint.answers else None
        if at is not None:
            self.due = min(self.due, max(now, at, self._start_s))
            # Robots with slots of their own send for ever.
            self.over = self._shares and now > self.duration_s + self._drain

    def _next(self, now: float) -> float:
        """Time at which something may happen next; infinite when all is done, or the time to drain is over."""
        coming = self._coming
        answers = self.endpoint.answers
        done = coming is None and now >= self.duration_s and self.empty
        if done and not answers:
            self.over = True
            return inf
        clock = self._clock.next_timeout(now) if self._clock is not None else None
        coded = None if self._coder is None else self._coder.due
        times = (None if coming is None else coming.t, clock, coded, self.endpoint.next_departure())
        soonest = min((at for at in times if at is not None), default=inf)
        if soonest == inf and now < self.duration_s:
            soonest = self.duration_s  # nothing more happens before the end of the run
        soonest = max(now, soonest)
        self.over = done or (coming is None and soonest > self.duration_s + self._drain)
        return inf if self.over and not answers else soonest


class EventLoop:
    """Robots and the medium between them on one clock.

    :param robots: by their number
    """

    def __init__(self, robots: Sequence[Robot], medium: Medium) -> None:
        self._robots, self._medium = robots, medium
        self._at = [inf] * len(robots)
        self._queue: list[tuple[float, int]] = []
        self._busy = set(range(len(robots)))
        self.now = 0.0

    def run(self) -> Iterator[TimedEvent]:
        """Everything that happens, in the order of time, until nothing is left or the time to drain is over. To be
        called only once."""
        for robot in self._robots:
            self._plan(robot)
        in_vain = 0
        # What takes no time on the air is received although its robot is over since it has sent it.
        while self._busy or self._medium.next_due <= self.now:
            now = min(self._soonest(), self._medium.next_due)
            if now == inf:
                break
            before, self.now = self.now, now
            happened = False
            for timed_event in self._happen(now):
                happened = True
                yield timed_event
            in_vain = 0 if happened or now > before else in_vain + 1
            if in_vain == _IN_VAIN:
                raise self._stalled()
        for robot in self._robots:
            yield from robot.expire(self.now)
            yield from robot.finish(self.now)

    def _stalled(self) -> RunError:
        """The error that names the robots whose timers are due without effect."""
        timers = [
            f"{name} of robot {robot.src_id} is due at {at:.6f} s"
            for robot in self._robots
            for name, at in (
                ("departure", robot.endpoint.next_departure()),
                ("timeout", robot.endpoint.next_timeout()),
            )
            if at is not None and at <= self.now
        ]
        return RunError(
            f"the simulation stands still at {self.now:.6f} s: {', '.join(timers) or 'no timer'}, and nothing is done "
            "about it; this is a defect of gr-ros2, please report it with the scenario"
        )

    def _happen(self, now: float) -> Iterator[TimedEvent]:
        concerned: set[int] = set()
        while self._soonest() <= now:
            number = heapq.heappop(self._queue)[1]
            self._at[number] = inf
            concerned.add(number)
            for timed_event in self._robots[number].expire(now):
                yield timed_event
                self._robots[number].wake(now)
        for reception in self._medium.receptions(now):
            concerned.add(reception.receiver)
            robot = self._robots[reception.receiver]
            for timed_event in robot.receive(reception):
                yield timed_event
                robot.wake(now)
        for number in sorted(concerned):
            robot = self._robots[number]
            if robot.due <= now:
                yield from robot.step(now, self._medium)
            self._plan(robot)

    def _soonest(self) -> float:
        """When a robot has something to do next."""
        while self._queue and self._at[self._queue[0][1]] != self._queue[0][0]:
            heapq.heappop(self._queue)  # it has been planned anew since
        return self._queue[0][0] if self._queue else inf

    def _plan(self, robot: Robot) -> None:
        """Note when a robot has something to do next."""
        timeout = robot.endpoint.next_timeout()
        # A timeout that stays in the past has been handled.
        at, number = robot.due, robot.number
        if timeout is not None and self.now < timeout < at:
            at = timeout
        if at != self._at[number]:
            self._at[number] = at
            heapq.heappush(self._queue, (at, number))
        (self._busy.discard if robot.over else self._busy.add)(number)
