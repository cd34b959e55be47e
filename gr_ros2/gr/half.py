"""What the two halves of a link's block have in common."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from gnuradio import gr

from gr_ros2.core.guard import Guard
from gr_ros2.gr.live_end import LiveEnd
from gr_ros2.gr.readable import debug_logger
from gr_ros2.link.bond import Bond
from gr_ros2.link.endpoint import Endpoint
from gr_ros2.link.observe import LinkObserver
from gr_ros2.middleware import Middleware
from gr_ros2.phy.threads import BlockThread
from gr_ros2.settings.config import replaced
from gr_ros2.settings.robot import RobotConfig


class HalfBlock(gr.basic_block):  # type: ignore[misc]
    """A block that sends or receives.

    :param name: what messages call it; its first word is its kind
    :param end: the robot's endpoint
    :param graph: the robot's participant on its ROS graph, which the caller closes
    :param observer: called with every event, in order. One that raises is not called again
    :param clock: s, monotonic
    :param bond: the radios, where there are several
    :ivar middleware: the participant
    :ivar radios: the number of radios
    """

    def __init__(
        self,
        name: str,
        config: RobotConfig,
        end: LiveEnd[Endpoint],
        graph: Middleware,
        *,
        observer: LinkObserver | None,
        clock: Callable[[], float],
        bond: Bond | None,
    ) -> None:
        kind, _, _ = name.partition(" ")
        super().__init__(kind, None, None)
        self.config = config
        self.live, self._end = end, end.endpoint
        self._lock = end.lock
        self.middleware = graph
        self._bond = bond
        self.radios = 1 if bond is None else len(bond.carries)
        self._observer = observer
        self._guard = Guard(f"observer of {name}")
        self.clock = clock
        self._log: Any = debug_logger(f"gr_ros2.gr.{kind.removeprefix('ros2_')}", config.debug)
        self._running = False
        self._thread = BlockThread()

    def set_debug(self, debug: bool) -> None:
        """Turn the readable log of headers, topic ids and entries on or off."""
        with self._lock:
            self.config = replaced(self.config, debug=debug)
        self._log = debug_logger(self._log.name, self.config.debug)
