"""Latency in a running sink: from a message's own stamp to its publication.

Invariants: only types whose first field is a std_msgs/Header have a latency. A stamp of zero means unset, as in ROS.
Negative values, caused by clocks that disagree, are kept and counted. A window of the newest values limits the memory.
"""

from __future__ import annotations

import struct
import time
from collections import deque
from itertools import islice
from typing import NamedTuple

from rosbags.typesys.store import Typestore

from gr_ros2.middleware import Middleware, Qos, Subscription
from gr_ros2.middleware.type_definitions import typestores

WINDOW = 10_000
"""Number of newest values in the percentiles."""
RECENT = 100
"""Number of newest values that show the current latency."""
CLOCK_TYPE = "rosgraph_msgs/msg/Clock"

_TIME = (struct.Struct(">iI"), struct.Struct("<iI"))
_CDR_HEAD = 4
_LITTLE_ENDIAN = 1
_CLOCK_DEPTH = 1


def has_header(type_name: str, *learned: Typestore) -> bool:
    """Whether messages of a type begin with a std_msgs/Header; False if the type is not known.

    :param learned: stores with definitions that come before those of ROS
    """
    for store in (*learned, *typestores(type_name))[:1]:  # no ROS type ever gained or lost its header
        _, members = store.fielddefs[type_name]
        return bool(members) and members[0][1][1] == "std_msgs/msg/Header"
    return False


def leading_time(payload: bytes) -> float | None:
    """The time at the start of a serialized message (a Header's stamp, or a Clock), s; None if unset or too short."""
    if len(payload) < _CDR_HEAD + 8 or payload[0] != 0:
        return None
    seconds, nanoseconds = _TIME[payload[1] & _LITTLE_ENDIAN].unpack_from(payload, _CDR_HEAD)
    return None if seconds == nanoseconds == 0 else seconds + nanoseconds * 1e-9


class LatencySummary(NamedTuple):
    """Latencies over the window, s; None if there are none. ``measured`` and ``negative`` count since the start."""

    p50: float | None
    p95: float | None
    p99: float | None
    max: float | None
    measured: int
    negative: int


class LatencyWindow:
    """The newest latencies of one topic."""

    def __init__(self) -> None:
        self._values: deque[float] = deque(maxlen=WINDOW)
        self._count = 0
        self._negative = 0

    def add(self, seconds: float) -> None:
        """Note the latency of a message, s."""
        self._values.append(seconds)
        self._count += 1
        self._negative += seconds < 0

    def forget(self) -> None:
        """Forget the values, which a wrong clock has measured; the counts stay."""
        self._values.clear()

    def copy(self) -> LatencyWindow:
        """A copy of the current state."""
        copied = LatencyWindow()
        copied._values = self._values.copy()
        copied._count, copied._negative = self._count, self._negative
        return copied

    @property
    def newest(self) -> float | None:
        """The latency measured last, s."""
        return self._values[-1] if self._values else None

    def summary(self, newest: int = WINDOW) -> LatencySummary:
        """Percentiles by nearest rank.

        :param newest: number of newest values to use
        """
        values = sorted(islice(reversed(self._values), newest))
        if not values:
            return LatencySummary(None, None, None, None, 0, 0)
        p50, p95, p99 = (values[-(-len(values) * percent // 100) - 1] for percent in (50, 95, 99))
        return LatencySummary(p50, p95, p99, values[-1], self._count, self._negative)


class Latencies:
    """Measures the latencies of messages by their stamps.

    :param middleware: where ``/clock`` is, if stamps are of simulated time
    """

    def __init__(self, middleware: Middleware, *, sim_time: bool) -> None:
        self.sim_time: float | None = None
        """The newest time of ``/clock``, s."""
        self._simulated = sim_time
        self._stamped: dict[str, bool] = {}
        self._clock: Subscription | None = None
        if sim_time:
            qos = Qos("best_effort", "volatile", _CLOCK_DEPTH)
            self._clock = middleware.subscribe("/clock", CLOCK_TYPE, qos, self._set)

    def close(self) -> None:
        """Hear no clock any more. Idempotent."""
        if self._clock is not None:
            self._clock.close()
            self._clock = None

    def learn(self, type_name: str, store: Typestore) -> None:
        """Take the definition of a type that was not known."""
        self._stamped[type_name] = has_header(type_name, store)

    def has(self, type_name: str) -> bool:
        """Whether messages of a type begin with a header."""
        stamped = self._stamped.get(type_name)
        if stamped is None:
            stamped = self._stamped[type_name] = has_header(type_name)
        return stamped

    def of(self, payload: bytes) -> float | None:
        """The latency of a message that is published now, s; None if it has no stamp, or there is no clock yet."""
        now, stamp = self.sim_time if self._simulated else time.time(), leading_time(payload)
        return None if now is None or stamp is None else now - stamp

    def _set(self, payload: bytes) -> None:
        self.sim_time = leading_time(payload)
