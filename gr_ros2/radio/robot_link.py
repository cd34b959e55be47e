"""One robot's end of a link as a flowgraph: from its ROS graph to the air and back, over one radio or several, until it
is stopped.

Invariants: neither direction waits for the other. Packets leave at the pace of the air, and each is composed just
before it leaves. A robot ignores its own packets, except from a front end that loops back. `stop` releases everything
that was opened. If opening fails half-way, everything is released too.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import partial
from math import inf
from typing import Any

from gr_ros2.core.clocks import wall_ahead
from gr_ros2.core.errors import ConfigError, RadioError
from gr_ros2.core.watch import Watch
from gr_ros2.gr.bound import BoundEnd
from gr_ros2.gr.calls import LiveCalls
from gr_ros2.gr.live_end import LiveEnd
from gr_ros2.gr.ros_link import LinkBlock, RosLink
from gr_ros2.gr.throughput import MAIN, LiveThroughput, ThroughputWays
from gr_ros2.gr.wish_ways import WishWays, best_of
from gr_ros2.gr.wishes import LiveWishes
from gr_ros2.link.bond import Bond
from gr_ros2.link.clocks import ClockOffset
from gr_ros2.link.observe import LinkObserver, Observers
from gr_ros2.middleware import Middleware
from gr_ros2.middleware.services import ServiceGraph
from gr_ros2.phy import Phy
from gr_ros2.phy.flowgraph import Flowgraph
from gr_ros2.phy.pdus import port_of
from gr_ros2.radio.clocks import ClockWatch
from gr_ros2.radio.config import LinkConfig
from gr_ros2.radio.diagnostics import Diagnostics
from gr_ros2.radio.findings import about, introduce, peers, ping, set_wall
from gr_ros2.radio.front_end import FrontEnd
from gr_ros2.radio.link_findings import LinkFindings
from gr_ros2.radio.mismatch import Mismatch
from gr_ros2.radio.one_radio import OneRadio, join_bound, together
from gr_ros2.radio.radio import Radio
from gr_ros2.radio.ros_side import RosSide
from gr_ros2.radio.spectrum import Listening
from gr_ros2.radio.switch import TransmitSwitch
from gr_ros2.radio.wish_service import WishService
from gr_ros2.settings.registry import Registry, Topic

_STOP_S = 10.0
"""s that a flowgraph may take to stop when its device has vanished."""
STALLED_S = 10.0
"""s after which a thread that sends counts as stuck: longer than a busy computer makes it wait."""
_log = logging.getLogger(__name__)


class RobotLink(Flowgraph):
    """A robot's end of a link.

    :param config: see :class:`LinkConfig`
    :param middleware: an open Middleware, which the caller closes; None: opened as the configuration
        says
    :param observer: called with everything that is sent and received. If it raises, it is not called again, and the
        link continues
    :param instrumented: see :class:`gr_ros2.radio.radio.Radio`
    :param front_end: opens the front end, given the PHY and ``transmits``; it has no radio. None: the one that the
        configuration names
    :param block: makes the block between the ROS graph and the radio, as :class:`RosLink` does
    :raises ConfigError: when the parts do not fit together
    :raises MiddlewareError: when the ROS graph cannot be joined
    :raises RadioError: when the front end cannot be opened
    """

    def __init__(
        self,
        config: LinkConfig,
        *,
        middleware: Middleware | None = None,
        observer: LinkObserver | None = None,
        instrumented: bool = False,
        front_end: Callable[..., FrontEnd] | None = None,
        block: Callable[..., LinkBlock] = RosLink,
    ) -> None:
        super().__init__(f"gr_ros2_link_{config.name}", config.name)
        self.config = config
        self._started: float | None = None
        self._watch = Watch()
        self.bond: Bond | None = None
        """Its radios, where there are several."""
        self._stack = ExitStack()
        self._observers = Observers[LinkObserver](() if observer is None else (observer,))
        try:
            self.radios = [
                OneRadio(
                    config,
                    own,
                    number,
                    front_end=front_end,
                    instrumented=instrumented,
                    on_ready=partial(self._note_present, number),
                    closing=self._stack,
                )
                for number, own in enumerate(config.own_radios)
            ]
            self.listening = Listening(self.radios)
            """What is on the air while it is silent; of an instrumented link."""
            self._stack.callback(self.listening.close)
            self._open(middleware, self._observers if observer is not None else None, block)
        except BaseException:
            self._stack.close()
            raise

    def _open(
        self, middleware: Middleware | None, observer: LinkObserver | None, block: Callable[..., LinkBlock]
    ) -> None:
        config, radios = self.config, self.radios
        self._clock = self.front_end.clock
        if len(radios) > 1:
            apart = [number for number, radio in enumerate(radios) if radio.own.shares]
            airtimes = [one.front_end.airtime(None if one.own.shares else config.packet_len) for one in radios]
            self.bond = Bond(airtimes, apart)
        self._ros = RosSide(
            config,
            radios,
            bond=self.bond,
            middleware=middleware,
            observer=observer,
            clock=self._clock,
            block=block,
            stack=self._stack,
        )
        self.node_name, graph = self._ros.node_name, self._ros.graph
        link = self._ros.link
        self.source, self.sink, self.end, self.calls = link.source, link.sink, link.end, link.calls
        self._wishes, self._throughput = WishWays(self._wish_ways), ThroughputWays(self._throughput_ways)
        for number in range(len(radios)):
            self._connect_radio(number)
        if all(radio.phy.has_airtime for radio in radios):  # without, nothing sets a pace
            self.source.use_credit()
        # A clock that a medium process tells stands still now and then, so it does not say how far others are ahead.
        ahead = wall_ahead if self._clock is time.monotonic else None
        told = about(config, [radio.phy for radio in radios])
        asked_by: Mapping[int, float] = {}
        if hasattr(self.end.endpoint, "pings"):  # the paper's robots ask nothing
            introduce(self.end, told, lambda: self.radio.snr_db, 0.0 if ahead is None else ahead())
            if link.bound is not None:
                link.bound.introduce_with(partial(self._introduce, told))
            asked_by = self.end.endpoint.pings.asked_by
        self._clocks = ClockWatch(
            config.clock,
            mine=config.publish.stamps == "mine",
            heard=self._heard,
            ask=self.ping,
            set_wall=self._set_wall,
            ahead=ahead,
        )
        self._stack.callback(self._clocks.close)
        self.findings = LinkFindings(
            config.robot_id,
            self.end,
            self._ros,
            mismatch=Mismatch(told, self.ping, asked_by),
            clocks=self._clocks,
            stats=self.stats,
            clock=self._clock,
        )
        """What a person should know about it."""
        if isinstance(graph, ServiceGraph):
            switch = TransmitSwitch(graph, self.node_name, lambda on: self.transmit(on=on))
            self._stack.callback(switch.close)
            if self._wish_ways():
                asking = WishService(graph, self.node_name, self.wishes)
                self._stack.callback(asking.close)
        self._diagnostics: Diagnostics | None = None
        if config.diagnostics.period_s:
            self._diagnostics = Diagnostics(config.diagnostics, graph, self.node_name, self.stats, clock=self._clock)
            self._stack.callback(self._diagnostics.stop)

    def _introduce(self, told: Mapping[str, Any], number: int, bound: BoundEnd) -> None:
        """Have the endpoint of one radio tell those who ask what this robot is, and what time it has.

        :param told: of all radios
        """
        one = self.radios[number]
        own = about(self.config, [one.phy], one.own) if one.own.shares else told
        introduce(bound.end, own, lambda: one.radio.snr_db, self.end.endpoint.pings.wall_s)

    @property
    def _ends(self) -> list[LiveEnd[Any]]:
        """The endpoint with all radios, and those that have one alone."""
        return [self.end, *(bound.end for bound in self._ros.link.bound or ())]

    def _heard(self, now: float) -> list[dict[str, Any]]:
        """The robots that are heard over any of them."""
        return [*{peer["robot"]: peer for live in reversed(self._ends) for peer in peers(live, now)}.values()]

    def _set_wall(self, wall_s: float) -> None:
        for live in self._ends:
            set_wall(live, wall_s)

    def _end_with(self, robot: int) -> LiveEnd[Any]:
        """The first of them that hears a robot, or else the one with all radios."""
        now = self._clock()
        heard = ((live, peers(live, now)) for live in self._ends)
        return next((live for live, known in heard if robot in {peer["robot"] for peer in known}), self.end)

    @property
    def radio(self) -> Radio:
        """The radio; of several, the first."""
        return self.radios[0].radio

    @property
    def front_end(self) -> FrontEnd:
        """The front end of that radio."""
        return self.radios[0].front_end

    @property
    def phy(self) -> Phy:
        """Its PHY."""
        return self.radios[0].phy

    def _connect_radio(self, number: int) -> None:
        link, one = self._ros.link, self.radios[number]
        pdus, credit = port_of("pdus", number), port_of("credit", number)
        if one.sends:
            self.msg_connect(link, pdus, one.radio, "pdus")
            if one.phy.has_airtime:
                self.msg_connect(one.radio, "credit", link, credit)
            if self.bond is None:  # of several, none waits for another
                one.front_end.follow(self._at_rest)
                self.source.drive(one.radio.gate)
        if self.config.receives:
            self.msg_connect(one.radio, "pdus", link, pdus)

    def _lose(self, one: OneRadio, error: RadioError) -> None:
        """The device of a radio has vanished: close it, and wait for it. The rest of the link keeps its state."""
        _log.warning("%s; waiting for it", error)
        self._note_present(self.radios.index(one), False)
        stopping = threading.Thread(target=super().stop, daemon=True)
        stopping.start()
        stopping.join(_STOP_S)
        if stopping.is_alive():  # the driver does not return; a new process is needed
            raise error
        self._connect_anew(lambda: one.lose(self._clock()))
        if self.bond is not None:
            super().start()

    def _retry(self, one: OneRadio) -> None:
        """Open the device of a radio again, if it is there."""
        if self._clock() < one.retry_at:
            return
        try:
            one.retry(self._clock())
        except RadioError as error:
            _log.debug("link %s: %s", self.config.name, error)
            return
        super().stop()
        self._connect_anew(lambda: None)
        super().start()
        self._note_present(self.radios.index(one), True, anew=True)
        _log.warning("link %s: front end %s is back", self.config.name, one.front_end.name)

    def _connect_anew(self, change: Callable[[], None]) -> None:
        """Connect the radios that are there, after a change. The flowgraph does not run."""
        self.disconnect_messages()
        self.disconnect_all()
        change()
        for number, one in enumerate(self.radios):
            if one.retry_at == inf:
                self._connect_radio(number)

    def _note_present(self, number: int, present: bool, *, anew: bool = False) -> None:
        """The device of one of several radios has vanished, or is there again."""
        if self.bond is None:
            return
        with self.end.lock:
            if present:
                self.bond.come_back(number, anew=anew)
            else:
                self.bond.vanish(number)
            if asks := self.bond.asks():
                self.end.endpoint.pace.credit(asks)
                self.end.wake()
        if anew and self._ros.link.bound is not None:
            self._ros.link.bound.opened_again(number)

    def transmit(self, *, on: bool) -> None:
        """Switch sending off, at once for all packets that have not reached the device, or on again.

        :raises ConfigError: where it only receives
        """
        self.listening.overruled()
        for one in self.radios:
            one.radio.transmit(on=on)
        _log.warning("link %s: sending is %s", self.config.name, "on" if on else "off")

    def _at_rest(self) -> int | None:
        """As :meth:`Radio.at_rest`; None also while a packet is composed or has to be."""
        composed = self.source.composed
        if self._ros.link.bound is not None:
            composed += sum(end.source.composed for end in self._ros.link.bound)
        if composed != self.radio.gate.arrived or self.source.due(self._clock()):
            return None
        return self.radio.at_rest()

    def announced(self) -> list[tuple[int, str, Topic]]:
        """Source id, absolute name here and meaning of each topic that another robot has announced, with topic ids as
        observers see them."""
        bound = self._ros.link.bound or ()
        return [*self.sink.outputs.heard.announced(), *(row for end in bound for row in end.announced())]

    def end_of(self, topic_id: int) -> tuple[LiveEnd[Any], int]:
        """The endpoint of a topic, by its id as observers see it, and its id there."""
        bound = self._ros.link.bound
        end = None if bound is None else bound.end_of(topic_id)
        return (self.sink.live, topic_id) if end is None else (end.end, topic_id - end.apart)

    def reached(self) -> dict[str, str]:
        """As :meth:`LiveCalls.reached`, over any of its radios."""
        return {name: kind for calls in self._all_calls for name, kind in calls.reached().items()}

    def call(self, name: str, payload: bytes) -> bytes:
        """As :meth:`LiveCalls.call`.

        :raises MiddlewareError: there is no such service, or no reply has come in time
        """
        calls = [*self._all_calls]
        return next((each for each in calls if name in each.reached()), calls[0]).call(name, payload)

    @property
    def _all_calls(self) -> list[LiveCalls]:
        """The services that cross over all radios, and over one alone."""
        bound = [] if self._ros.link.bound is None else self._ros.link.bound.calls
        return bound if self.calls is None else [self.calls, *bound]

    @property
    def registry(self) -> Registry:
        """The topics that are sent; it grows if they are looked for on the ROS graph."""
        return self.source.subscriptions.registry

    def start(self, max_noutput_items: int = 10_000_000) -> None:
        """Begin sending and receiving.

        :raises PhyError: when GNU Radio refuses the flowgraph
        """
        began = self._clock()  # packets leave before a busy computer comes back here
        super().start(max_noutput_items)
        self._started = began
        if self.config.remark:
            _log.info("link %s: %s", self.config.name, self.config.remark)
        for one in self.radios:
            one.phy.prefer_latency()
        if self._diagnostics is not None:
            self._diagnostics.start()

    def stop(self) -> None:
        """Stop, leave the ROS graph and close the front end. Idempotent. A stopped link cannot start again."""
        if self._running:
            for one in self.radios:
                one.radio.drain()
        for one in self.radios:
            one.retry_at = inf
        super().stop()
        # A device is released with its blocks. The flowgraph would keep them as long as it exists itself.
        self.disconnect_all()
        self._stack.close()

    def check(self) -> None:
        """Check the device and the threads that send. Call this from time to time while the link runs.

        A device that has vanished is waited for, and opened again.

        :raises RadioError: when a device that cannot come back gives or takes no more samples, which GNU Radio does not
            report; when its driver does not stop; when a thread that sends does not go on
        """
        for one in self.radios:
            if one.retry_at < inf:
                self._retry(one)
        if not self._running:
            return
        now = self._clock()
        self._clocks.look(now)
        sources = [self.source, *(end.source for end in self._ros.link.bound or () if end.sends)]
        stalled_s = max(source.stalled_s(now) for source in sources)
        _check_goes_on(self.config.name, "sending thread", self._watch, stalled_s, now)
        for one in self.radios:
            if one.retry_at < inf or one.gone:
                continue
            _check_goes_on(self.config.name, "thread that paces packets", one.pacing, one.radio.gate.stalled_s(), now)
            try:
                one.check(now)
            except RadioError as error:
                if one.open_again:
                    self._lose(one, error)
                elif self.bond is None:
                    raise
                else:
                    self._give_up(one, error)

    def _give_up(self, one: OneRadio, error: RadioError) -> None:
        """One of several radios has vanished, and cannot be opened again in this process.

        :raises RadioError: where none is left
        """
        one.gone = True
        if all(radio.gone for radio in self.radios):
            raise error
        self._note_present(self.radios.index(one), False)
        _log.warning("%s; the link goes on without it; start it again when the device is there", error)

    def ping(self, robot: int, *, anew: bool = False) -> dict[str, Any]:
        """Ask another robot, which answers at once; returns what has come of all questions to it so far.

        :param anew: forget the earlier ones
        :raises ConfigError: for a number that no other robot has
        """
        if robot == self.source.src_id:
            raise ConfigError(f"robot {robot}: asks here; name another one")
        return {**ping(self._end_with(robot), robot, self._clock(), anew=anew), **self.source.rate()}

    @property
    def wishes(self) -> WishWays:
        """What is asked for from afar, over all radios.

        :raises ConfigError: where nobody can be asked
        """
        if not self._wish_ways():
            raise ConfigError(f"link {self.config.name}: nobody can be asked over it; that needs direction: both")
        return self._wishes

    def _wish_ways(self) -> list[LiveWishes]:
        """What is asked for over all radios, and over each that has one alone."""
        link = self._ros.link
        ways = [link.wishes, *(bound.wishes for bound in link.bound or ())]
        return [wishes for wishes in ways if wishes is not None]

    @property
    def throughput(self) -> ThroughputWays:
        """Measurements of what the link carries.

        :raises ConfigError: where nobody can be asked over this link
        """
        if not self._throughput_ways():
            raise ConfigError(
                f"link {self.config.name}: goes one way, or has no room for calls, so nobody can be asked"
            )
        return self._throughput

    def _throughput_ways(self) -> dict[str, LiveThroughput]:
        """What is measured over any radio, and over each whose channel others share, by its name."""
        link = self._ros.link
        ways = {MAIN: link.throughput, **{bound.way.name: bound.throughput for bound in link.bound or ()}}
        return {name: measured for name, measured in ways.items() if measured is not None}

    def clocks(self) -> dict[int, ClockOffset]:
        """What is known of the clocks of the robots that are heard."""
        heard = self._heard(self._clock())
        return {peer["robot"]: ClockOffset(**peer["clock"]) for peer in heard if peer["clock"] is not None}

    @property
    def finished(self) -> bool:
        """Whether nothing more will be received, as at the end of a replayed recording."""
        return self.front_end.finished

    def incomplete(self) -> list[str]:
        """What observers missed and what the recording lacks: one line each, with reason and number; often none."""
        return [*self._observers.incomplete(), *self.radio.incomplete()]

    def stats(self) -> dict[str, Any]:
        """A snapshot: both blocks, calls of services, wishes, packets to and from the air, the PHY, the counters of the
        front end, and :meth:`incomplete`."""
        each = [one.stats() for one in self.radios]
        for stats in each:
            stats["phy"].update(self.source.rate())
            stats["packets"]["in"] = self.sink.handled
        radios = each[0]
        if self.bond is not None:
            with self.end.lock:  # packets change it
                radios = together(self.bond, self.radios, each)
        halves = self._ros.link.stats()
        if self._ros.link.bound is not None:
            join_bound(halves, radios, [one.name for one in self.radios], self._ros.link.bound.stats())
            halves["wishes"]["wants"] = best_of(halves["wishes"].get("wants", ()))
        return {
            "name": self.config.name,
            "uptime_s": 0.0 if self._started is None else self._clock() - self._started,
            **halves,
            "peers": peers(self.end, self._clock()),
            **radios,
            "clocks": {"set": self._clocks.lines(self._clock()), "given_to_chrony": self._clocks.given},
            "incomplete": self.incomplete(),
        }


def _check_goes_on(link: str, what: str, watch: Watch, told_s: float, now: float) -> None:
    """:raises RadioError: if a thread has not gone on for long"""
    stalled_s = inf if told_s == inf else watch.age(told_s, now)  # infinite: it has ended
    if stalled_s > STALLED_S:
        raise RadioError(
            f"link {link}: the {what} has not gone on for {stalled_s:.0f} s; start the link again, and report what it "
            "was doing (py-spy dump)"
        )
