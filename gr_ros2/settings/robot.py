"""The configuration of one robot: the same in a link file, in each robot of a scenario, in GRC's ROS Link and as ROS
parameters.

Invariants: a value has one name and one place; ``topics`` is a mapping, whatever form a file gives it; what a robot
does not send or does not receive has no settings that act.
"""

from __future__ import annotations

import re
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, field_validator, model_validator
from pydantic.dataclasses import dataclass

from gr_ros2.core.errors import ConfigError
from gr_ros2.settings.commands import COMMAND_TYPES, checked_commands
from gr_ros2.settings.config import (
    CODING,
    DEFAULT_MIDDLEWARE,
    STRICT,
    Bytes,
    Count,
    DomainId,
    FrameForm,
    MergedTopic,
    Namespace,
    NamespaceForm,
    PacketLen,
    Repairs,
    RobotId,
    Seconds,
    SendOptions,
    TopicForm,
    build,
)
from gr_ros2.settings.effect import ActsWhere, refuse_without_effect
from gr_ros2.settings.fields import AUTO, Auto
from gr_ros2.settings.topic_choice import LEAVES_OUT, checked_words, topics_of
from gr_ros2.state.keys import checked_key_file
from gr_ros2.wire import BROADCAST

ONE_RADIO = "a robot with one radio sends everything over that"
"""Why ``via`` does nothing there."""
_ALIASED = ConfigDict(**STRICT, populate_by_name=True)
Direction = Literal["both", "send", "receive"]
Age = Annotated[Seconds | Auto, Field(title="Oldest sealed message (s)")]


def _checked_topics(topics: dict[str, SendOptions]) -> dict[str, SendOptions]:
    checked_words(tuple(topics))
    for word, options in topics.items():
        if word.startswith(LEAVES_OUT) and options != SendOptions():
            raise ValueError(f"{word!r} leaves topics out, which have no options; leave these out")
    return topics


def _named(topics: dict[str, Any]) -> dict[str, Any]:
    checked_words(tuple(topics))
    return topics


@dataclass(frozen=True, kw_only=True, config=STRICT)
class GraphConfig:
    """The ROS graph of a robot."""

    middleware: str = DEFAULT_MIDDLEWARE
    """where it is reached, a name of ``gr_ros2.middleware.MIDDLEWARE``"""
    domain_id: Annotated[DomainId | Auto, Field(title="Domain ID")] = AUTO
    """ROS domain, 0..232; auto takes ROS_DOMAIN_ID"""
    localhost_only: bool | Auto = AUTO
    """DDS stays on the loopback interface; auto = as ROS's environment says, in a scenario true"""
    namespace: Namespace | Auto = AUTO
    """of the robot's topics there; '' is the root, auto its name"""
    depth: Annotated[Count, Field(title="Depth of subscriptions (messages)")] = 10
    """QoS depth of the subscriptions, 0 unbounded"""
    use_sim_time: Annotated[bool, Field(title="Use /clock")] = False
    """latency counts from stamps by the graph's /clock instead of wall time"""


@dataclass(frozen=True, kw_only=True, config=_ALIASED)
class PublishOptions:
    """How one topic of other robots comes out, and how long its messages count."""

    as_: Annotated[TopicForm, Field(alias="as", title="Published as")] = AUTO
    """its name on the graph, ``{robot}`` allowed; auto = ``publish.as`` and the topic's own name"""
    reliability: Literal["reliable", "best_effort"] | Auto = AUTO
    """of its publisher; auto leaves it to the middleware"""
    durability: Literal["volatile", "transient_local"] | Auto = AUTO
    """of its publisher; auto as its sender announces it"""
    depth: Count | Auto = AUTO
    """QoS depth of its publisher; auto = ``publish.depth``, of a transient-local topic 1"""
    deadline_s: Annotated[float, Field(ge=0, le=3600, allow_inf_nan=False)] | Auto = AUTO
    """s after which a message is not delivered; 0 = any time, auto that of its sender. Of a service: s that a call
    waits, auto 30"""
    max_age_s: Age = AUTO
    """as of the robot, which auto takes; 0 = any time"""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class BackfillConfig:
    """What a robot keeps and sends when the air has room again."""

    topics: Annotated[tuple[str, ...], AfterValidator(checked_words), Field(title="Topics filled later")] = ()
    """names (with * and ?) of topics: what was superseded, or sent while nobody heard, crosses later; [] = none"""
    robots: Annotated[tuple[RobotId, ...], Field(title="Robots that record")] = ()
    """numbers of those who record: what none of them has heard crosses later; [] = what no robot has"""
    for_s: Annotated[float, Field(gt=0, le=86400, title="Kept for filling (s)")] = 600.0
    """s for which a message is kept to cross later"""
    memory_mb: Annotated[float, Field(gt=0, le=65536, title="Memory for filling (MB)")] = 64.0
    """MB of memory that messages to cross later take at most; of more, the oldest are given up"""


@dataclass(frozen=True, kw_only=True, config=_ALIASED)
class PublishConfig:
    """How what a robot receives comes out on its graph."""

    as_: Annotated[NamespaceForm, Field(alias="as", title="Published under")] = "/rx_robot_{robot}"
    """topics come out as this + '/' + their names; ``{robot}`` is the number of the sender"""
    depth: Annotated[Count, Field(title="Depth of publishers (messages)")] = 10
    """QoS depth of the publishers, 0 unbounded"""
    frame_prefix: FrameForm = ""
    """before every frame name of a message, ``{robot}`` is the sender; '' none"""
    merge_tf: Annotated[MergedTopic, Field(title="Merged transforms")] = ""
    """topic for the transforms of all senders too, static ones on this + `_static`; needs `frame_prefix`; '' off"""
    stamps: Annotated[Literal["theirs", "mine"], Field(title="Header stamps")] = "theirs"
    """of messages: theirs = as sent; mine = moved to this computer's clock, as answers to questions tell it"""
    topics: Annotated[dict[str, PublishOptions], AfterValidator(_named), Field(title="Topics that come out")] = Field(
        default_factory=dict
    )
    """single topics, such as {odom: {depth: 100}}; with * and ?"""

    @property
    def merged_topics(self) -> tuple[str, ...]:
        """The topics of ``merge_tf``: moving and static transforms; () where it is off."""
        return (self.merge_tf, f"{self.merge_tf}_static") if self.merge_tf else ()


@dataclass(frozen=True, kw_only=True, config=STRICT)
class RobotConfig:
    """One robot: what it sends, what it takes, and how it joins its graph and the link."""

    robot: Annotated[int, Field(ge=0, le=BROADCAST - 1)] | str
    """its number on the air, 0..254, or its name, of which the last digits are the number: /robot_1 is robot 1"""
    direction: Direction = "both"
    """with send it gets no reports, with receive it gives none"""
    topics: Annotated[dict[str, SendOptions], BeforeValidator(topics_of), AfterValidator(_checked_topics)] = Field(
        default_factory=lambda: {AUTO: SendOptions()}
    )
    """what it sends: names (with * and ?), or a mapping of names to options; auto = every topic of the registry,
    without one of its namespace on the graph; -NAME leaves out; [] = nothing"""
    offer: Annotated[dict[str, SendOptions], BeforeValidator(topics_of), AfterValidator(_checked_topics)] = Field(
        default_factory=dict
    )
    """what it sends when another robot asks for it, written as `topics`: topics, services and actions of its graph that
    it does not send anyway; max_rate limits what may be asked for, to says who may"""
    backfill: BackfillConfig = Field(default_factory=BackfillConfig)
    """what crosses later where a gap was: to those who record (gr-ros2 link --bag)"""
    publish: PublishConfig = Field(default_factory=PublishConfig)
    """how what it receives comes out"""
    graph: GraphConfig = Field(default_factory=GraphConfig)
    """its ROS graph"""
    registry: Annotated[str, Field(title="Registry CSV")] = ""
    """file of topics and types, or a built-in one such as `table4`; '' = topics are found on the graph"""
    services: Annotated[bool, Field(title="Services and actions too")] = True
    """``topics`` choose services and actions of the graph too, which other robots may call"""
    commands: Annotated[tuple[str, ...], AfterValidator(checked_commands)] = COMMAND_TYPES
    """types and names (with * and ?) of topics whose messages come first, and within 0.3 s or not at all"""
    packet_len: Annotated[PacketLen, Field(title="Packet length (bytes)")] = 220
    """bytes of the longest packet, 40 at least (14 of the paper's blocks), the same at all robots"""
    key: Annotated[str, Field(title="Keys of the fleet"), AfterValidator(checked_key_file)] = ""
    """file of the fleet's keys (gr-ros2 key new); '' = anybody can read and forge packets"""
    seal: Literal["encrypt", "authenticate"] = "encrypt"
    """with a key: authenticate alone, where a radio's licence forbids encryption"""
    state: Annotated[str, Field(title="State file")] = ""
    """file with the starts of this robot and what was heard of others; '' = in the user's state folder"""
    packet_rate: Annotated[
        Annotated[float, Field(ge=0, allow_inf_nan=False)] | Auto, Field(title="Packet rate (packets/s)")
    ] = AUTO
    """packets/s at most; auto = what the PHY grants, 0 = every packet at once, as the paper has it"""
    queue_depth: Annotated[Count, Field(title="Queue depth (messages per topic)")] = 100
    """messages waiting per topic, of more the oldest goes; 0 unbounded"""
    compression: bool = True
    """code messages; receivers see it by themselves"""
    repair: Repairs | Auto = AUTO
    """idle = in all idle air, thrifty = what is known or expected to be lost; auto = thrifty where receivers report,
    else idle"""
    expected_loss: Annotated[float, Field(ge=0, lt=1, title="Expected loss (share of packets)")] = 0.2
    """share of packets lost, while no report tells (thrifty)"""
    repeat_s: Annotated[Seconds, Field(title="Repeat latched topics every (s)")] = 10.0
    """s between repeats of transient-local topics while no robot reports, longer while none is heard; 0 off"""
    beacon_s: Annotated[Seconds, Field(title="Time until only beacons are sent (s)")] = 0.0
    """s without hearing any robot after which one hello every so many s is all that is sent; 0 = never"""
    hold_s: Annotated[Seconds, Field(title="Wait for repair (s)")] = 1.0
    """s that a reliable message waits for an earlier one where the sender gets no reports"""
    max_age_s: Age = AUTO
    """s for which a sealed message may have been withheld; auto = 15 for calls and topics with a deadline or lifespan
    (over other robots that, if longer; more where packets are long), else any time; 0 = any time"""
    max_sources: Annotated[int, Field(ge=1, le=BROADCAST + 1, title="Most senders at a time")] = 16
    """robots heard at a time; packets of more are dropped"""
    max_source_bytes: Annotated[Bytes, Field(title="Memory per sender (bytes)")] = 72_000_000
    """memory per robot known, a quarter of it for incomplete messages, and as much for all that is relayed; the oldest
    goes first"""
    debug: Annotated[bool, Field(title="Debug log")] = False
    """readable log of headers, topic ids and entries"""
    conditions: ClassVar[tuple[ActsWhere, ...]] = (
        ActsWhere(
            ("seal", "max_age_s", "publish.topics.*.max_age_s"),
            lambda robot: bool(robot.key),
            "nothing is sealed without a key; set key, or leave it out",
        ),
        ActsWhere(
            tuple(f"{part}.*.{option}" for part in ("topics", "offer") for option in CODING),
            lambda robot: robot.compression,
            "no message is coded without compression; set compression: true, or leave it out",
        ),
        ActsWhere(
            ("offer",),
            lambda robot: robot.direction == "both",
            "nobody can ask over a link that goes one way; leave it out, or set direction: both",
        ),
        ActsWhere(
            ("backfill.robots", "backfill.for_s", "backfill.memory_mb"),
            lambda robot: bool(robot.backfill.topics),
            "nothing is kept; set backfill.topics, or leave it out",
        ),
        ActsWhere(
            ("expected_loss",),
            lambda robot: robot.repair != "off",
            "nothing is repaired; set repair to thrifty, or leave it out",
        ),
        ActsWhere(
            ("beacon_s",),
            lambda robot: robot.direction == "both",
            "who hears nobody would fall silent for ever; leave it out, or set direction: both",
        ),
    )

    @field_validator("repair", mode="before")
    @classmethod
    def _off_is_a_word(cls, value: object) -> object:
        """YAML 1.1 reads an unquoted ``off`` as false."""
        return "off" if value is False else value

    @field_validator("robot", mode="after")
    @classmethod
    def _has_a_number(cls, robot: int | str) -> int | str:
        if isinstance(robot, str):
            if robot.isdecimal():
                robot = int(robot)
            number_of(robot)
        return robot

    @model_validator(mode="after")
    def _fits(self) -> RobotConfig:
        refuse_without_effect(self)
        if self.publish.merge_tf and not self.publish.frame_prefix:
            raise ValueError(
                f"publish.merge_tf = {self.publish.merge_tf!r}: frames of several robots would be mixed up; set "
                "publish.frame_prefix, for instance to 'robot_{robot}/'"
            )
        return self

    @property
    def robot_id(self) -> int:
        """Its number on the air."""
        return number_of(self.robot)

    @property
    def namespace(self) -> str:
        """Namespace of its topics on its graph; '' is the root."""
        if self.graph.namespace != AUTO:
            return self.graph.namespace
        return f"/robot_{self.robot}" if isinstance(self.robot, int) else self.robot

    @property
    def sends(self) -> bool:
        """Whether it offers messages, rather than reports alone."""
        return bool(self.topics) and self.direction != "receive"

    @property
    def words(self) -> tuple[str, ...]:
        """The words that choose what it sends, of its registry or of its graph; () = nothing."""
        return tuple(self.topics) if self.sends else ()

    @property
    def options(self) -> dict[str, SendOptions]:
        """What is set for some of the topics that it sends, by these words."""
        chosen = self.topics.items() if self.sends else ()
        return {word: options for word, options in chosen if options != SendOptions()}

    @property
    def receives(self) -> bool:
        """Whether messages of others come out."""
        return self.direction != "send"


def number_of(robot: int | str) -> int:
    """The number of a robot: itself, or the last digits of a name.

    :raises ConfigError: for a name without digits, one that ROS does not allow, or a number of 255 or more
    """
    if isinstance(robot, int):
        return robot
    runs = re.findall(r"[0-9]+", robot)
    if not runs:
        raise ConfigError("the name has no digits; write the robot's number, and its name as graph.namespace")
    if int(runs[-1]) >= BROADCAST:
        raise ConfigError(
            f"{int(runs[-1])} is not below 255; write a number of 0..254, and the name as graph.namespace"
        )
    return int(runs[-1])


_PARTS = ("graph", "publish", "backfill")


def robot_from(**given: Any) -> RobotConfig:
    """A robot from settings in one list, as GRC has them: those of its parts may stand beside the others as
    ``graph_domain_id``, ``publish_as``, ``backfill_topics``.

    :raises ConfigError: for an unknown setting, a value out of range, or settings that contradict each other
    """
    values: dict[str, Any] = {part: {} for part in _PARTS}
    for name, value in given.items():
        part, _, setting = name.partition("_")
        if part in _PARTS and setting:
            values[part] = {**values[part], setting: value}
        else:
            values[name] = value
    return build(RobotConfig, values)
