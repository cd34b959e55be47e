"""What stands in a link of a run for :class:`gr_ros2.gr.ros_link.RosLink` where robots are the paper's: its blocks ROS
Source and ROS Sink, as one.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from typing import Any

from gr_ros2.gr.live_end import LiveEnd
from gr_ros2.gr.receiving import ReceivingBlock
from gr_ros2.gr.ros_link import LinkBlock
from gr_ros2.gr.sending import SendingBlock
from gr_ros2.link.air import Air
from gr_ros2.link.observe import LinkObserver
from gr_ros2.middleware import Middleware
from gr_ros2.paper.factory import make_paper_endpoint
from gr_ros2.paper.settings import PaperConfig
from gr_ros2.settings.registry import Registry
from gr_ros2.settings.robot import RobotConfig


class PaperLink(LinkBlock):
    """The blocks ROS Source and ROS Sink as one block, whose parameters are those of
    :class:`gr_ros2.gr.ros_link.RosLink`.

    :param seed: of sequence number and entry ids
    """

    def __init__(
        self,
        config: RobotConfig,
        *,
        paper: PaperConfig,
        registry: Registry,
        seed: int,
        middleware: Middleware,
        air: Air | None = None,  # noqa: ARG002 - the paper's robots ask nothing of the radio
        loops_back: bool = False,  # noqa: ARG002
        observer: LinkObserver | None = None,
        clock: Callable[[], float] = time.monotonic,
        backpressure: bool = False,
    ) -> None:
        super().__init__(config)
        rng = random.Random(seed)
        self.end = LiveEnd(lambda events: make_paper_endpoint(config, paper, registry, rng=rng, observer=events))
        common: dict[str, Any] = {"observer": observer, "clock": clock}
        sent = registry if config.sends else Registry.empty()
        heard = registry.with_options(config.publish.topics)
        self.source = SendingBlock(config, sent, self.end, middleware, backpressure=backpressure, **common)
        self.sink = ReceivingBlock(config, heard, self.end, middleware, **common)
        self._connect()
