"""Makes the endpoint of a robot, of the version in its settings: the only module outside ``wire`` and ``link`` that
knows a version."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from gr_ros2.core.errors import ConfigError
from gr_ros2.link.access import Access
from gr_ros2.link.endpoint import Endpoint
from gr_ros2.link.events import SenderEvent
from gr_ros2.link.message_codec import MessageCodec
from gr_ros2.link.rate import Mcs
from gr_ros2.link.v0.endpoint import EndpointV0
from gr_ros2.link.v1.endpoint import EndpointV1
from gr_ros2.link.v1.endpoint_settings import settings_of
from gr_ros2.link.v1.replays import Save
from gr_ros2.link.v1.sealing import Keys
from gr_ros2.settings.config import SinkConfig, SourceConfig, robot_of
from gr_ros2.settings.effect import refuse_without_effect
from gr_ros2.settings.registry import Registry, Topic
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
class EndpointSetup:
    """What a version 1 endpoint must know about its robot's radio, and about the current start of its robot.

    :param boot: number of this start, greater than all earlier numbers
    :param heard: the last packet heard from each other robot before this start, by robot id: boot number and packet
        number
    :param save: stores ``heard``, see :class:`gr_ros2.state.boots.BootFile`
    :param reports: whether the robots from which it receives can also receive from it
    :param half_duplex: whether sending and receiving share the airtime
    :param any_length: whether the PHY carries shorter packets in less time, see :attr:`gr_ros2.phy.Phy.any_length`
    :param mcs_table: the rates of an adaptive rate, see :attr:`gr_ros2.phy.Phy.mcs_table`; () for a fixed rate
    :param airtime_s: of the longest packet, s; 0 = not known
    :param access: makes what decides when the robot with an id may send; None from it: whenever there is a credit
    :param relay: whether messages of other robots are sent on
    :param airtime_share: part of the time that this robot may send, above 0..1
    :param close: lets another process start this robot; nothing is stored afterwards
    """

    boot: int = 1
    keys: Keys | None = None
    heard: Mapping[int, tuple[int, int]] = field(default_factory=dict)
    save: Save | None = None
    reports: bool = False
    half_duplex: bool = False
    any_length: bool = False
    mcs_table: Sequence[Mcs] = ()
    airtime_share: float = 1.0
    airtime_s: float = 0.0
    close: Callable[[], None] = lambda: None
    access: Callable[[int], Access | None] = lambda _: None
    relay: bool = False


def make_endpoint(
    registry: Registry,
    source: SourceConfig | None,
    sink: SinkConfig | None,
    *,
    start: EndpointSetup | None = None,
    codec: MessageCodec | None = None,
    rng: random.Random | None = None,
    observer: Callable[[SenderEvent], None] | None = None,
    calls: bool = False,
) -> Endpoint:
    """Make one robot's end of a link, of the version in its settings.

    :param source: settings of the sending half; None: it sends nothing
    :param sink: settings of the receiving half; None: it receives nothing
    :param start: for version 1 only
    :param codec: codec of all messages; None: made here
    :param calls: whether services cross the link: the last topic of the endpoint's registry is for requests and replies
    :raises ConfigError: for settings that contradict each other
    """
    if registry.services and not calls:
        raise ConfigError(
            f"registry: {registry.services[0].name} is a service, which needs both directions of a link and version 1; "
            "take gr-ros2 link or RosLink"
        )
    topics = registry if source is None else registry.with_options(source.topic_options)
    end = source if source is not None else sink
    version = 1 if end is None else end.version
    for topic in topics:
        try:
            refuse_without_effect(topic.options, version, f"topic {topic.name}: ")
        except ValueError as error:
            raise ConfigError(f"registry: {error}") from None
    if calls:
        topics = topics.with_calls()
    to_air = None
    if source is not None and source.compresses:
        to_air = codec or message_codec(topics)
    if not version:
        if start is not None and start.mcs_table:
            raise ConfigError("phy.options.rate = 'adaptive' with version 0, which has no reports; set version to 1")
        from_air = None if sink is None else codec or message_codec(registry)
        return EndpointV0(registry, source, sink, codecs=(to_air, from_air), rng=rng, observer=observer)
    start = start or EndpointSetup()
    from gr_ros2.codecs.instances import instances_of  # as in message_codec

    known = message_codec()
    return EndpointV1(
        None if source is None or not topics else topics,
        settings_of(
            source,
            sink,
            hears=start.reports,
            half_duplex=start.half_duplex,
            fixed=not start.any_length,
            airtime_share=start.airtime_share,
            airtime_s=start.airtime_s,
            relay=start.relay,
        ),
        boot=start.boot,
        keys=start.keys,
        codec=to_air,
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
        mcs_table=start.mcs_table,
        access=start.access(robot_of(source, sink)),
        instances=instances_of,
    )


def keys_of(config: SourceConfig | SinkConfig) -> Keys | None:
    """The keys of a robot, None where it has no key file.

    :raises ConfigError: for a key file that cannot be read or understood
    """
    return Keys(read_key_file(config.key), config.seal) if config.key else None


def keys_of_run(config: SourceConfig) -> Keys | None:
    """Keys that stand in for a robot's in a run that counts no starts, None where it has no key file.

    Not the fleet's own: packets of the same numbers come again in every run, and recordings of them would betray it.
    """
    return Keys((bytes(KEY_LEN),), config.seal) if config.key else None
