"""Publishes the state of a link on the ROS graph: ``/diagnostics`` for common tools, the messages that were lost in
rosbag2's form, and all counters as JSON.

Invariants: one thread publishes what somebody reads, and this thread leaves the graph. It counts every failure and
continues. Nothing is published after ``stop`` has returned. ``gr.health`` makes all judgements.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from gr_ros2.core.errors import GrRos2Error
from gr_ros2.gr.health import Level, LinkHealth, Status
from gr_ros2.middleware import Middleware, Publisher, Qos
from gr_ros2.middleware.type_definitions import typestore
from gr_ros2.radio.findings import doubled
from gr_ros2.radio.lost_messages import LOST_TYPE, LostMessages
from gr_ros2.settings.config import DiagnosticsConfig

DIAGNOSTICS_TOPIC, DIAGNOSTICS_TYPE = "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"
STATISTICS_TYPE = "std_msgs/msg/String"

STATUS_TYPE = "diagnostic_msgs/msg/DiagnosticStatus"

_QOS = Qos("reliable", "volatile", 10)
_KEPT = Qos("reliable", "transient_local", 1)
_JOIN_S = 5.0
"""How long ``stop`` waits, s. A slow subscriber delays each of the two messages by a second."""
_log = logging.getLogger(__name__)


class Diagnostics:
    """Publishes diagnostics and counters every ``period_s``.

    :param node_name: node name of the link on the graph; its counters are published on ``/<node_name>/statistics``
    :param stats: returns a snapshot of the link's counters
    :param clock: s, monotonic
    :ivar failed: how often publishing failed
    :raises MiddlewareError: when the topics cannot be announced
    """

    def __init__(
        self,
        config: DiagnosticsConfig,
        middleware: Middleware,
        node_name: str,
        stats: Callable[[], Mapping[str, Any]],
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._period_s = config.period_s
        self._node_name = node_name
        self._stats = stats
        self._clock = clock
        self._health = LinkHealth(config, node_name)
        self._array = middleware.advertise(DIAGNOSTICS_TOPIC, DIAGNOSTICS_TYPE, _QOS)
        self._middleware, self._statistics = middleware, f"/{node_name}/statistics"
        self._counters = middleware.advertise(self._statistics, STATISTICS_TYPE, _QOS)
        self._alone = True
        self._links: dict[int, Publisher] = {}
        self._lost = LostMessages(node_name)
        self._events: Publisher | None = None
        try:
            self._events = middleware.advertise(f"/{node_name}/events/messages_lost", LOST_TYPE, _QOS)
        except GrRos2Error as error:  # rclpy needs the package, which Humble and Jazzy do not have with this message
            _log.info("%s: no events of lost messages: %s", node_name, error)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="gr-ros2-diagnostics", daemon=True)
        self.failed = 0

    def start(self) -> None:
        """Start the thread. Call this only once."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread, and remove both topics from the graph. Idempotent."""
        self._stop.set()
        if self._thread.ident is None:
            self._leave()
        else:
            self._thread.join(_JOIN_S)

    def _run(self) -> None:
        while not self._stop.wait(self._period_s):
            try:
                self._tell()
            except Exception as error:  # noqa: BLE001 - nobody would notice that the diagnostics have ended
                self.failed += 1
                if self.failed == 1:
                    trace = None if isinstance(error, GrRos2Error) else error
                    _log.warning("%s: diagnostics were not published: %s", self._node_name, error, exc_info=trace)
        self._leave()

    def _tell(self) -> None:
        stats = self._stats()
        judged = self._health.judge(stats, self._clock())
        statuses = [*judged, *self._second_sender()]
        if twins := doubled(stats["peers"]):
            statuses.append(Status(f"{self._node_name}: numbers", Level.WARN, twins))
        if jumps := stats["clocks"]["set"]:
            statuses.append(Status(f"{self._node_name}: clocks", Level.WARN, jumps))
        for src_id, state in self._health.links(stats, judged[0]).items():
            if not self._stop.is_set():
                status = _status(state, self._node_name)
                self._link(src_id).publish(bytes(typestore().serialize_cdr(status, STATUS_TYPE)))
        messages: list[tuple[Publisher, Callable[[], bytes]]] = [
            (self._array, lambda: diagnostic_array(statuses, self._node_name, time.time_ns())),
            (self._counters, lambda: statistics(stats)),
        ]
        if self._events is not None and (lost := self._lost.event(stats)) is not None:
            messages.append((self._events, lambda: lost))
        for publisher, message in messages:
            # The step before may have taken longer than ``stop`` waits.
            if publisher.matched() and not self._stop.is_set():
                publisher.publish(message())

    def _link(self, src_id: int) -> Publisher:
        """Says how the link to a robot is, to programs that start later too."""
        if src_id not in self._links:
            self._links[src_id] = self._middleware.advertise(f"/gr_ros2/link_{src_id}", STATUS_TYPE, _KEPT)
        return self._links[src_id]

    def _second_sender(self) -> list[Status]:
        """A status if another link on this graph sends the topics of the same robot. It is logged once."""
        if not any(info.topic == self._statistics and info.publishers for info in self._middleware.discover()):
            self._alone = True
            return []
        text = (
            f"a second {self._node_name} is on this ROS graph: both send the topics of one namespace under one id; "
            "give each robot a namespace and a domain_id of its own"
        )
        if self._alone:
            self._alone = False
            _log.warning(text)
        return [Status(f"{self._node_name}: robot id", Level.WARN, [text])]

    def _leave(self) -> None:
        self._array.close()
        self._counters.close()
        if self._events is not None:
            self._events.close()
        for publisher in self._links.values():
            publisher.close()


def diagnostic_array(statuses: list[Status], hardware_id: str, stamp_ns: int) -> bytes:
    """A diagnostic_msgs/DiagnosticArray, serialized.

    :param stamp_ns: ns since the epoch
    """
    types = typestore().types
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    message = types[DIAGNOSTICS_TYPE](
        header=types["std_msgs/msg/Header"](
            stamp=types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds), frame_id=""
        ),
        status=[_status(status, hardware_id) for status in statuses],
    )
    return bytes(typestore().serialize_cdr(message, DIAGNOSTICS_TYPE))


def _status(status: Status, hardware_id: str) -> Any:
    types = typestore().types
    key_value = types["diagnostic_msgs/msg/KeyValue"]
    return types[STATUS_TYPE](
        level=int(status.level),
        name=status.name,
        message=status.message,
        hardware_id=hardware_id,
        values=[key_value(key=key, value=value) for key, value in status.values.items()],
    )


def statistics(stats: Mapping[str, Any]) -> bytes:
    """A std_msgs/String with the counters as one line of JSON, serialized."""
    message = typestore().types[STATISTICS_TYPE](data=json.dumps(stats))
    return bytes(typestore().serialize_cdr(message, STATISTICS_TYPE))
