"""Publishes the state of a link on the ROS graph: ``/diagnostics`` for common tools, and all its counters as JSON.

Invariants: one thread publishes, and this thread leaves the graph. It counts every failure and continues. Nothing is
published after ``stop`` has returned. ``gr.health`` makes all judgements.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from gr_ros2.core.errors import GrRos2Error
from gr_ros2.gr.health import LinkHealth, Status
from gr_ros2.middleware import Middleware, Qos
from gr_ros2.middleware.type_definitions import typestore
from gr_ros2.settings.config import DiagnosticsConfig

DIAGNOSTICS_TOPIC, DIAGNOSTICS_TYPE = "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"
STATISTICS_TYPE = "std_msgs/msg/String"

_QOS = Qos("reliable", "volatile", 10)
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
        self._counters = middleware.advertise(f"/{node_name}/statistics", STATISTICS_TYPE, _QOS)
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
        statuses = self._health.judge(stats, self._clock())
        array = diagnostic_array(statuses, self._node_name, time.time_ns())
        for publisher, message in ((self._array, array), (self._counters, statistics(stats))):
            # The step before may have taken longer than ``stop`` waits.
            if not self._stop.is_set():
                publisher.publish(message)

    def _leave(self) -> None:
        self._array.close()
        self._counters.close()


def diagnostic_array(statuses: list[Status], hardware_id: str, stamp_ns: int) -> bytes:
    """A diagnostic_msgs/DiagnosticArray, serialized.

    :param stamp_ns: ns since the epoch
    """
    types = typestore().types
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    key_value = types["diagnostic_msgs/msg/KeyValue"]
    message = types[DIAGNOSTICS_TYPE](
        header=types["std_msgs/msg/Header"](
            stamp=types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds), frame_id=""
        ),
        status=[
            types["diagnostic_msgs/msg/DiagnosticStatus"](
                level=int(status.level),
                name=status.name,
                message=status.message,
                hardware_id=hardware_id,
                values=[key_value(key=key, value=value) for key, value in status.values.items()],
            )
            for status in statuses
        ],
    )
    return bytes(typestore().serialize_cdr(message, DIAGNOSTICS_TYPE))


def statistics(stats: Mapping[str, Any]) -> bytes:
    """A std_msgs/String with the counters as one line of JSON, serialized."""
    message = typestore().types[STATISTICS_TYPE](data=json.dumps(stats))
    return bytes(typestore().serialize_cdr(message, STATISTICS_TYPE))
