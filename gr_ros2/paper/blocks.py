"""ROS Source and ROS Sink, the paper's blocks (sections 4.3 and 4.4). They speak version 0, in one direction each."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from typing import Any

from gr_ros2.core.errors import ConfigError, GrRos2Error
from gr_ros2.gr.live_end import LiveEnd
from gr_ros2.gr.receiving import ReceivingBlock
from gr_ros2.gr.sending import SendingBlock
from gr_ros2.link.observe import LinkObserver
from gr_ros2.middleware import Middleware, joined
from gr_ros2.paper.factory import make_paper_endpoint
from gr_ros2.paper.settings import PaperConfig, paper_from
from gr_ros2.settings.config import NOBODY
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import Registry
from gr_ros2.settings.robot import RobotConfig


class RosSource(SendingBlock):
    """Subscribes to the topics of a registry, and sends them as the paper has it.

    :param registry: CSV path or Registry
    :param middleware: an open Middleware, which the caller closes; None: opened as the settings say
    :param observer, clock, backpressure: see :class:`SendingBlock`
    :param seed: seed of sequence number and entry ids; None: random
    :param values: settings of the robot and of the paper, see :func:`gr_ros2.paper.settings.paper_from`
    :raises ConfigError: for a wrong setting; the message names the key, the value and what is allowed
    """

    def __init__(
        self,
        registry: str | Registry = "",
        *,
        middleware: Middleware | None = None,
        observer: LinkObserver | None = None,
        clock: Callable[[], float] = time.monotonic,
        seed: int | None = None,
        backpressure: bool = False,
        **values: Any,
    ) -> None:
        robot, paper = _settings(registry, {"direction": "send", **values})
        topics = _read(registry)
        rng = random.Random(seed)
        end = LiveEnd(lambda events: make_paper_endpoint(robot, paper, topics, rng=rng, observer=events))
        graph, self._leave = joined(self, middleware, robot.graph, f"gr_ros2_source_{robot.robot_id}")
        try:
            super().__init__(robot, topics, end, graph, observer=observer, clock=clock, backpressure=backpressure)
        except GrRos2Error:
            self._leave()
            raise

    def close(self) -> None:
        """Take no further messages, and leave the ROS graph. Idempotent."""
        super().close()
        self._leave()

    def set_dst_id(self, dst_id: int) -> None:
        """Set the destination id; 255 is broadcast.

        :raises ConfigError: out of range
        """
        with self._lock:
            self._end.reconfigure(dst_id=dst_id)
            self.live.rouse()


class RosSink(ReceivingBlock):
    """Publishes the topics of a registry that a ROS Source sends.

    :param registry: CSV path or Registry, the same as at the source
    :param middleware: an open Middleware, which the caller closes; None: opened as the settings say
    :param observer, clock: see :class:`ReceivingBlock`
    :param values: settings of the robot and of the paper. Without ``robot`` it takes the packets of and for all robots;
        a robot drops and counts its own and those for others
    :raises ConfigError: for a wrong setting; the message names the key, the value and what is allowed
    """

    def __init__(
        self,
        registry: str | Registry = "",
        *,
        middleware: Middleware | None = None,
        observer: LinkObserver | None = None,
        clock: Callable[[], float] = time.monotonic,
        **values: Any,
    ) -> None:
        own = None
        if values.get("robot", AUTO) == AUTO:
            values["robot"], own = 0, NOBODY
        robot, paper = _settings(registry, {"direction": "receive", **values})
        topics = _read(registry)
        end = LiveEnd(lambda events: make_paper_endpoint(robot, paper, topics, own=own, observer=events))
        graph, self._leave = joined(self, middleware, robot.graph, "gr_ros2_sink")
        try:
            super().__init__(
                robot, topics.with_options(robot.publish.topics), end, graph, observer=observer, clock=clock
            )
        except GrRos2Error:
            self._leave()
            raise

    def close(self) -> None:
        """Publish nothing any more, and leave the ROS graph. Idempotent."""
        super().close()
        self._leave()


def _read(registry: str | Registry) -> Registry:
    if not registry:
        raise ConfigError("registry is missing; give the path of a CSV with rows of the form name,type")
    return registry if isinstance(registry, Registry) else Registry.from_csv(registry)


def _settings(registry: str | Registry, values: dict[str, Any]) -> tuple[RobotConfig, PaperConfig]:
    return paper_from(**values, **({"registry": registry} if isinstance(registry, str) else {}))
