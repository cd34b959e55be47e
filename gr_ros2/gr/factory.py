"""Makes the endpoint of a robot: its start, its keys, and the codec of its messages.

Invariant: no other module of this part knows the engine of a version.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from gr_ros2.core.errors import ConfigError
from gr_ros2.core.tuning import Tuning
from gr_ros2.gr.starts import state_file
from gr_ros2.link.air import Air
from gr_ros2.link.endpoint import OpenEndpoint
from gr_ros2.link.events import SenderEvent
from gr_ros2.link.message_codec import MessageCodec
from gr_ros2.link.v1.endpoint import EndpointV1
from gr_ros2.link.v1.endpoint_settings import end_settings
from gr_ros2.link.v1.replays import Save
from gr_ros2.link.v1.sealing import Keys
from gr_ros2.settings.registry import Registry, Topic
from gr_ros2.settings.robot import RobotConfig
from gr_ros2.state.boots import RANDOM_BITS, BootFile
from gr_ros2.state.keys import KEY_LEN, read_key_file

if TYPE_CHECKING:
    from gr_ros2.compression import LinkCodec


def message_codec(registry: Sequence[Topic] = ()) -> LinkCodec:
    """The codec of a link.

    :param registry: with topic options applied
    :raises ConfigError: for a wrong ``codec``, ``quantize`` or ``cloud`` of a topic
    """
    from gr_ros2.codecs.whole import whole_of  # imported here: they take longer than the rest of a block
    from gr_ros2.compression import LinkCodec

    return LinkCodec(registry, whole=whole_of)


@dataclass(frozen=True)
class Start:
    """One start of a robot.

    :param boot: its number, greater than all earlier ones
    :param keys: of the fleet; None: its packets are not sealed
    :param heard: the last packet heard from each other robot before it, by robot id: boot number and packet number
    :param save: stores ``heard``, see :class:`gr_ros2.state.boots.BootFile`
    :param close: lets another process start this robot; nothing is stored afterwards
    """

    boot: int = 1
    keys: Keys | None = None
    heard: Mapping[int, tuple[int, int]] = field(default_factory=dict)
    save: Save | None = None
    close: Callable[[], None] = lambda: None


def start_of(robot: RobotConfig) -> Start:
    """Count this start of a robot in its state file, and read the robot's keys.

    :raises ConfigError: for a key file or a state file that cannot be read or understood
    """
    keys = Keys(read_key_file(robot.key), robot.seal) if robot.key else None
    path = state_file(robot.state, robot.robot_id)
    file = BootFile(path, time.time(), secrets.randbits(RANDOM_BITS), sealed=keys is not None)
    return Start(file.boot, keys, file.heard, file.save, file.close)


def keys_of_run(robot: RobotConfig) -> Keys | None:
    """Keys that stand in for a robot's in a run that counts no starts, None where it has no key file.

    Not the fleet's own: packets of the same numbers come again in every run, and recordings of them would betray it.
    """
    return Keys((bytes(KEY_LEN),), robot.seal) if robot.key else None


def make_endpoint(
    robot: RobotConfig,
    registry: Registry,
    *,
    air: Air,
    start: Start,
    codec: MessageCodec | None = None,
    observer: Callable[[SenderEvent], None] | None = None,
    calls: bool = False,
    loops_back: bool = False,
    tuning: Tuning = Tuning(),
) -> OpenEndpoint:
    """Make one robot's end of a link.

    :param registry: the topics that it may send
    :param codec: codec of all messages; None: made here
    :param calls: whether services cross the link: the last topic of the endpoint's registry is for requests and replies
    :param loops_back, tuning: see :func:`end_settings`
    :raises ConfigError: for settings that contradict each other
    """
    if registry.services and not calls:
        raise ConfigError(
            f"registry: {registry.services[0].name} is a service, which needs both directions of a link; set "
            "direction: both"
        )
    topics = registry.with_options(robot.options) if robot.sends else Registry.empty()
    if calls:
        topics = topics.with_calls()
    from gr_ros2.codecs.instances import instances_of  # as in message_codec

    known = message_codec()
    return EndpointV1(
        topics or None,
        end_settings(robot, air, loops_back=loops_back, tuning=tuning),
        boot=start.boot,
        keys=start.keys,
        codec=(codec or message_codec(topics)) if robot.compression and (robot.sends or calls) else None,
        decoder_for=lambda topics: (
            codec
            or known.of(
                [Topic(topic.topic_id, topic.name, topic.type_name) for topic in topics],
                {topic.topic_id: topic.codec for topic in topics},
            )
        ),
        heard=start.heard,
        save=start.save,
        observer=observer,
        mcs_table=air.mcs_table,
        instances=instances_of,
    )
