"""Plays simulated robots on ROS graphs in real time.

Invariants: message n is published when the clock reaches start + t(n), never before. A late message is published at
once and does not delay later ones. ``stop`` takes effect before the next message. An error of the graph ends the
playback, and ``stop`` raises it.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Protocol

from gr_ros2.core.errors import MiddlewareError
from gr_ros2.middleware import join_graph
from gr_ros2.middleware.base import Middleware, Publisher, Qos
from gr_ros2.settings.fields import AUTO, Auto
from gr_ros2.settings.registry import Registry
from gr_ros2_lab.sim.fleet import Fleet
from gr_ros2_lab.sim.sim_settings import SimSettings
from gr_ros2_lab.sim.transforms import TransformPublisher

_DEPTH = 100
_JOIN_S = 1.0


class Playable(Protocol):
    """A message for a graph. ``payload`` is asked for at ``t``, so it may depend on what came before."""

    @property
    def t(self) -> float:
        """When it is due, s after the start."""

    @property
    def topic(self) -> str:
        """Absolute name."""

    @property
    def payload(self) -> bytes:
        """Serialized."""


class Robots(Protocol):
    """Who publishes: :class:`gr_ros2_lab.sim.fleet.Fleet`, or the robots of a task."""

    @property
    def settings(self) -> SimSettings:
        """Of all robots."""

    @property
    def robot_ids(self) -> Sequence[int]:
        """From 1 on."""

    def namespace(self, robot_id: int) -> str:
        """Of a robot's topics, absolute."""

    def topics(self) -> Mapping[str, str]:
        """Types of all topics, by absolute name."""

    def messages(self, duration_s: float, start_time_s: float | None = None) -> Iterator[Playable]:
        """All messages with 0 <= t < duration_s, in time order; their stamps are ``start_time_s`` + t, None takes that
        of the settings."""

    def drive_ahead(self, duration_s: float) -> None:
        """Plan what does not depend on what robots hear, so that planning takes no time from the links later: with a
        third of the processor time that the demo needs, its messages were published .4 to 2.5 s late, and are .1 s late
        (``python -m bench slow_computer``)."""


class SimPublisher:
    """Publishes simulated robots on ROS graphs, in a thread of its own.

    Publishers are announced at construction, so subscribers can be found before ``start``. They stay until ``close``,
    so that a late joiner still gets the map.

    :param middleware: one graph for all robots, or one per robot id; robots without a graph do not publish
    :param duration_s: duration of the playback, s; may be infinite
    :param start_time: called at ``start``, returns the stamp of t = 0, s; None takes the fleet's ``start_time_s``
        setting
    :param clock: monotonic, s
    :ivar published: messages published, per topic
    :ivar worst_lag_s: largest delay of a message, s
    :raises MiddlewareError: when a topic cannot be announced
    """

    def __init__(
        self,
        fleet: Robots,
        middleware: Middleware | Mapping[int, Middleware],
        duration_s: float,
        start_time: Callable[[], float] | None = time.time,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._fleet, self._duration_s = fleet, duration_s
        self._start_time, self._clock = start_time, clock
        self.published: Counter[str] = Counter()
        self.worst_lag_s = 0.0
        self._error: Exception | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="sim-publisher", daemon=True)
        graphs = middleware if isinstance(middleware, Mapping) else dict.fromkeys(fleet.robot_ids, middleware)
        self._publishers: dict[str, Publisher] = {
            name: graphs[robot_id].advertise(
                name, topic.type_name, Qos("reliable", "transient_local" if topic.latched else "volatile", _DEPTH)
            )
            for robot_id in fleet.robot_ids
            if robot_id in graphs
            for topic in Registry.from_rows(fleet.topics())
            for name in [topic.on_graph(fleet.namespace(robot_id))]
        }
        self._transforms: dict[str, TransformPublisher] = {}
        if fleet.settings.transforms:
            self._transforms = {
                f"{fleet.namespace(robot_id)}/odom": TransformPublisher(
                    graphs[robot_id], fleet.settings.frame_prefix(robot_id)
                )
                for robot_id in fleet.robot_ids
                if robot_id in graphs
            }

    @property
    def publishers(self) -> Mapping[str, Publisher]:
        """Publishers by absolute topic name, for instance to wait until they are matched."""
        return self._publishers

    @property
    def finished(self) -> bool:
        """True if the playback has started and is over: all published, stopped, or failed."""
        return self._thread.ident is not None and not self._thread.is_alive()

    def start(self) -> None:
        """Start the playback; t = 0 is now. Call this only once."""
        self._thread.start()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until the playback is finished. Returns whether it is."""
        self._thread.join(timeout_s)
        return self.finished

    def stop(self) -> None:
        """End the playback; the publishers stay. Idempotent.

        :raises Exception: the error that ended the playback early, for instance a MiddlewareError
        """
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(_JOIN_S)
            if self._thread.is_alive():
                raise MiddlewareError(f"simulator: publishing blocks for more than {_JOIN_S:g} s; is the graph stuck?")
        error, self._error = self._error, None
        if error is not None:
            raise error

    def close(self) -> None:
        """Stop, and remove the publishers from the graph."""
        try:
            self.stop()
        finally:
            for publisher in self._publishers.values():
                publisher.close()
            for transforms in self._transforms.values():
                transforms.close()

    def _run(self) -> None:
        try:
            self._play()
        except Exception as error:  # noqa: BLE001 - kept for stop(), which raises it in the caller's thread
            self._error = error

    def _play(self) -> None:
        start_time = None if self._start_time is None else self._start_time()
        begin = self._clock()
        for transforms in self._transforms.values():
            transforms.start(round((self._fleet.settings.start_time_s if start_time is None else start_time) * 1e9))
        for message in self._fleet.messages(self._duration_s, start_time):
            publisher = self._publishers.get(message.topic)
            if publisher is None:
                continue
            while (ahead := begin + message.t - self._clock()) > 0:
                if self._stop.wait(min(ahead, _JOIN_S)):
                    return
            if self._stop.is_set():
                return
            self.published[message.topic] += 1  # before, so that nobody has received more than this says
            payload = message.payload
            publisher.publish(payload)
            self.worst_lag_s = max(self.worst_lag_s, -ahead)
            if message.topic in self._transforms:
                self._transforms[message.topic].follow(payload)


def simulated_robot(middleware: str = "dds", domain_id: int | Auto = AUTO) -> SimPublisher:
    """Robot 1 alone, on a graph of its own, driving until the program ends; for GRC.

    :param middleware, domain_id: see :func:`gr_ros2.middleware.join_graph`
    :raises GrRos2Error: as :func:`gr_ros2.middleware.join_graph`
    """
    graph = join_graph(middleware, domain_id=domain_id, node_name="simulated_robot")
    robot = SimPublisher(Fleet(SimSettings(robots=1)), graph, float("inf"))
    robot.start()
    return robot
