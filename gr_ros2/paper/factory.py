"""Makes the endpoint of a robot of the paper."""

from __future__ import annotations

import random
from collections.abc import Callable

from gr_ros2.gr.factory import message_codec
from gr_ros2.link.events import SenderEvent
from gr_ros2.link.message_codec import MessageCodec
from gr_ros2.paper.endpoint import EndpointV0
from gr_ros2.paper.settings import PaperConfig, check_rows
from gr_ros2.settings.registry import Registry, check_outputs
from gr_ros2.settings.robot import RobotConfig


def make_paper_endpoint(
    robot: RobotConfig,
    paper: PaperConfig,
    registry: Registry,
    *,
    codec: MessageCodec | None = None,
    own: int | None = None,
    rng: random.Random | None = None,
    observer: Callable[[SenderEvent], None] | None = None,
) -> EndpointV0:
    """Make one robot's end of a link.

    :param codec: codec of all messages; None: made here, where it needs one
    :param own, rng, observer: see :class:`EndpointV0`
    :raises ConfigError: for a registry that has what the paper's blocks do not have
    """
    check_rows(registry)
    if robot.receives:
        check_outputs(registry, robot.publish, announced=False)
    if codec is None and (paper.compression or robot.receives):
        codec = message_codec(registry.with_options(robot.options))
    return EndpointV0(registry, robot, paper, codec=codec, own=own, rng=rng, observer=observer)
