"""Every setting, once: names, units, ranges and defaults shared by YAML, CLI, GNU Radio blocks and ROS parameters.

Invariant: a setting exists in exactly one dataclass here; an unknown key or a value out of range is a ConfigError that
names the key, the value and what is allowed.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

from pydantic import AfterValidator, ConfigDict, Field, TypeAdapter, ValidationError, model_validator
from pydantic.dataclasses import dataclass

from gr_ros2.errors import ConfigError
from gr_ros2.names import (
    checked_frame_form,
    checked_merged_topic,
    checked_namespace,
    checked_namespace_form,
    checked_topic_form,
)
from gr_ros2.wire import BROADCAST, FORMATS, Format, format_of
from gr_ros2.yaml_bounds import read_bounded
from gr_ros2.yaml_text import parse_yaml

MIN_PACKET_LEN = min(version.min_packet_len for version in FORMATS.values())
MAX_PACKET_LEN = max(version.max_packet_len for version in FORMATS.values())

_STRICT = ConfigDict(extra="forbid", str_strip_whitespace=True)
_T = TypeVar("_T")
_KINDS = {
    "bool": "true or false",
    "complex": "a number such as 0.5 or 0.5+0.2j",
    "dataclass": "keys and values",
    "dict": "keys and values",
    "float": "a number",
    "int": "a whole number",
    "list": "a list",
    "string": "a text",
    "tuple": "a list",
}
"""What a value must be, in words, by pydantic's name of the error."""

PacketLen = Annotated[int, Field(ge=MIN_PACKET_LEN, le=MAX_PACKET_LEN)]
RobotId = Annotated[int, Field(ge=-1, lt=BROADCAST)]
Seconds = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=0)]
Probability = Annotated[float, Field(ge=0, le=1)]
Namespace = Annotated[str, AfterValidator(checked_namespace)]
NamespaceForm = Annotated[str, AfterValidator(checked_namespace_form)]
TopicForm = Annotated[str, AfterValidator(checked_topic_form)]
MergedTopic = Annotated[str, AfterValidator(checked_merged_topic)]
FrameForm = Annotated[str, AfterValidator(checked_frame_form)]
QosClass = Literal["default", "latency", "bulk"]
QueuePolicy = Literal["latest", "fifo", "deadline"]
WireVersion = Literal[0, 1]
Repairs = Literal["idle", "thrifty", "off"]
Kernels = Literal["auto", "numpy"]


@dataclass(frozen=True, config=_STRICT)
class TopicOptions:
    """Options of one topic: named registry columns, or ``topic_options`` in the configuration.

    :param qos: class of its packets, the two QoS bits of the header
    :param reliability: None adapts the subscription to the publishers found
    :param durability: None adapts likewise; the sink publishes volatile unless this says transient_local
    :param depth: QoS depth of subscription and publisher, None takes ``subscriber_depth``/``publisher_depth``
    :param queue_depth: messages waiting at the source, 0 unbounded, None takes the source's ``queue_depth``
    :param publish_as: topic name at the sink, ``{src_id}`` allowed; '' takes ``namespace_format``
    :param queue: what waits at the source: latest (a new message replaces what has not started), fifo (all, up to
        ``queue_depth``), deadline (fifo, and stale after ``deadline_s``); None follows ``depth`` and the
        publishers' QoS (docs/explanation/scheduling.md)
    :param deadline_s: s from submission to delivery at the other end; a later message is dropped. 0 = no deadline, or
        without ``queue`` the publishers' lifespan
    :param weight: weight of this topic's age relative to other topics, 0.001..1000 (``scheduler: freshness``)
    :param max_rate: messages/s sent at most, 0 unlimited
    :param codec: auto, none, fields or zstd, where ``compression`` is on (docs/explanation/compression.md)
    :param quantize: bounded loss per field, '' lossless (docs/explanation/compression.md)
    """

    qos: QosClass = "default"
    reliability: Literal["reliable", "best_effort"] | None = None
    durability: Literal["volatile", "transient_local"] | None = None
    depth: Count | None = None
    queue_depth: Count | None = None
    publish_as: TopicForm = ""
    queue: QueuePolicy | None = None
    deadline_s: Annotated[float, Field(ge=0, le=3_600, allow_inf_nan=False)] = 0.0
    weight: Annotated[float, Field(ge=0.001, le=1000, allow_inf_nan=False)] = 1.0
    max_rate: Annotated[float, Field(ge=0, le=1_000_000, allow_inf_nan=False)] = 0.0
    codec: str = "auto"
    quantize: str = ""

    @model_validator(mode="after")
    def _deadline(self) -> TopicOptions:
        if self.queue == "deadline" and not self.deadline_s:
            raise ValueError("queue = 'deadline': deadline_s is missing; set it above 0")
        return self


DEFAULT_MIDDLEWARE = "dds"
"""Of everything that joins a ROS graph; a name of ``gr_ros2.middleware.MIDDLEWARE``."""


@dataclass(frozen=True, config=_STRICT)
class SourceConfig:
    """ROS Source (the paper, section 4.3; docs/reference/parameters.md).

    :param registry: CSV path, the same on both ends; '' where a Registry object is handed over
    :param topics: subset of the registry, with or without leading slash; [] = all
    :param namespace: namespace of the robot on the ROS graph; a registry row ``/x`` is absolute
    :param robot_id: source id 0..254; -1 takes the last run of digits of the namespace
    :param dst_id: destination id, 255 broadcast
    :param packet_len: bytes on the wire, 14..4095; 40 or more with version 1
    :param version: of the wire format, 0 the paper's, 1 with repair, announcements and seals; the same on both ends
    :param key: file of the fleet's keys (gr-ros2 key new), with version 1; '' sends packets that anybody can read and
        forge
    :param seal: with a key: encrypt packets, or authenticate them alone, where a radio's licence forbids encryption
    :param state: file that counts this robot's starts (version 1); '' takes one of its own in the user's state folder
    :param min_fragment: k_min, lower bound on an entry's payload, bytes
    :param greedy: several entries of one topic in a packet, back to back
    :param flush_timeout_s: s a partly filled packet waits for further messages; 0 = it is sent at once
    :param subscriber_depth: QoS depth of the subscriptions, 0 unbounded
    :param hop: initial hop count (TTL) 0..15
    :param packet_rate: packets/s offered to the flowgraph, 0 unpaced
    :param queue_depth: messages waiting per topic, oldest dropped and counted; 0 unbounded
    :param backpressure: make the middleware wait instead of dropping when a queue is full (bags)
    :param entry_ids: sequential per topic, or random as the paper has it (compatibility trials only)
    :param scheduler: how packets are filled, a name of ``gr_ros2.link.SCHEDULER``
    :param repeat_s: s between repeats of a transient-local topic, 0 off; with version 1 only while no robot reports
    :param repair: what idle air is spent on with version 1: idle = all of it on what may have been lost, thrifty = as
        much as losses are known or expected, off; None takes thrifty where receivers report, idle where none does
    :param expected_loss: share of packets lost, 0..1, as long as no report tells (thrifty)
    :param compression: code every message, C = 1; the sink must have the same setting
    :param dictionaries: files of dictionaries of your own, the same at both ends
    :param topic_options: per topic name, over the registry's columns
    :param middleware: a name of ``gr_ros2.middleware.MIDDLEWARE``
    :param domain_id: DDS domain, -1 takes ROS_DOMAIN_ID
    :param debug: readable log of headers, topic ids and entries
    """

    registry: str = ""
    topics: tuple[str, ...] = ()
    namespace: Namespace = ""
    robot_id: RobotId = -1
    dst_id: Annotated[int, Field(ge=0, le=BROADCAST)] = BROADCAST
    packet_len: PacketLen = 220
    version: WireVersion = 0
    key: str = ""
    seal: Literal["encrypt", "authenticate"] = "encrypt"
    state: str = ""
    min_fragment: Annotated[int, Field(ge=1)] = 16
    greedy: bool = False
    flush_timeout_s: Seconds = 0.0
    subscriber_depth: Count = 10
    hop: Annotated[int, Field(ge=0, le=15)] = 1
    packet_rate: Seconds = 0.0
    queue_depth: Count = 100
    backpressure: bool = False
    entry_ids: Literal["sequential", "random"] = "sequential"
    scheduler: str = "paper"
    repeat_s: Seconds = 10.0
    repair: Repairs | None = None
    expected_loss: Annotated[float, Field(ge=0, lt=1)] = 0.2
    compression: bool = False
    dictionaries: tuple[str, ...] = ()
    topic_options: dict[str, TopicOptions] = Field(default_factory=dict)
    middleware: str = DEFAULT_MIDDLEWARE
    domain_id: Annotated[int, Field(ge=-1, le=232)] = -1
    debug: bool = False

    @model_validator(mode="after")
    def _fits(self) -> SourceConfig:
        least = self.wire_format.min_packet_len
        if self.packet_len < least:
            raise ValueError(f"packet_len = {self.packet_len}: version {self.version} needs at least {least}")
        most = self.wire_format.single_entry_payload(self.packet_len)
        if self.min_fragment > most:
            raise ValueError(
                f"min_fragment = {self.min_fragment} does not fit packet_len = {self.packet_len}; at most {most}"
            )
        return self

    @property
    def wire_format(self) -> Format:
        """The version that packets are written in."""
        return format_of(self.version)

    def src_id(self) -> int:
        """The source id on the wire: ``robot_id``, or the last run of digits of the namespace (section 4.3).

        :raises ConfigError: when -1 finds no digits or a number of 255 or more
        """
        if self.robot_id >= 0:
            return self.robot_id
        runs = re.findall(r"[0-9]+", self.namespace)
        if not runs:
            raise ConfigError(f"robot_id = -1: namespace {self.namespace!r} has no digits; set robot_id to 0..254")
        if int(runs[-1]) >= BROADCAST:
            raise ConfigError(
                f"robot_id = -1: {int(runs[-1])} from namespace {self.namespace!r} is not below 255; "
                "set robot_id to 0..254"
            )
        return int(runs[-1])


@dataclass(frozen=True, config=_STRICT)
class SinkConfig:
    """ROS Sink (the paper, section 4.4).

    :param registry: CSV path, the same on both ends; '' where a Registry object is handed over
    :param packet_len: bytes on the wire, 14..4095, the same on both ends
    :param version: of the wire format, the same on both ends
    :param key: file of the fleet's keys, with version 1; sealed packets alone are taken then
    :param seal: how packets of this robot are sealed
    :param state: file of what was heard before a restart (version 1), see :class:`SourceConfig`
    :param namespace_format: topics come out as this + '/' + row name; ``{src_id}`` is the sender
    :param publisher_depth: QoS depth of the publishers, 0 unbounded
    :param reassembly_timeout_s: s an incomplete message is kept; version 1 keeps it for as long as it may be repaired
    :param hold_s: s that a message of a reliable topic waits for an earlier one that may yet be repaired (version 1)
    :param robot_id: own id: its packets and those for others are dropped and counted; -1 takes everything
    :param max_sources: senders served at a time; packets of further ones are counted and dropped
    :param max_source_bytes: fragments held per sender; the oldest incomplete message goes first
    :param max_bytes: fragments held in all
    :param compression: decode messages of packets with C = 1
    :param dictionaries: files of dictionaries of your own, the same at both ends
    :param topic_options: per topic name, over the registry's columns
    :param use_sim_time: take latency from stamps on the graph's /clock instead of wall time
    :param frame_prefix: before every frame name of a message, ``{src_id}`` is the sender; '' leaves messages as sent
    :param merge_tf: topic on which the transforms of all senders come out too, and their static ones, latched, on this
        + ``_static``; needs ``frame_prefix``; '' off
    :param middleware: a name of ``gr_ros2.middleware.MIDDLEWARE``
    :param domain_id: DDS domain, -1 takes ROS_DOMAIN_ID
    :param debug: readable log of headers, topic ids and entries
    """

    registry: str = ""
    packet_len: PacketLen = 220
    version: WireVersion = 0
    key: str = ""
    seal: Literal["encrypt", "authenticate"] = "encrypt"
    state: str = ""
    namespace_format: NamespaceForm = "/rx_robot_{src_id}"
    publisher_depth: Count = 10
    reassembly_timeout_s: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.0
    hold_s: Seconds = 1.0
    robot_id: RobotId = -1
    max_sources: Annotated[int, Field(ge=1, le=BROADCAST + 1)] = 16
    max_source_bytes: Annotated[int, Field(ge=4096)] = 32_000_000
    max_bytes: Annotated[int, Field(ge=4096)] = 64_000_000
    compression: bool = False
    dictionaries: tuple[str, ...] = ()
    topic_options: dict[str, TopicOptions] = Field(default_factory=dict)
    use_sim_time: bool = False
    frame_prefix: FrameForm = ""
    merge_tf: MergedTopic = ""
    middleware: str = DEFAULT_MIDDLEWARE
    domain_id: Annotated[int, Field(ge=-1, le=232)] = -1
    debug: bool = False

    @model_validator(mode="after")
    def _frames_stay_apart(self) -> SinkConfig:
        if self.merge_tf and not self.frame_prefix:
            raise ValueError(
                f"merge_tf = {self.merge_tf!r}: frames of several robots would be mixed up; set frame_prefix, "
                "for instance to 'robot_{src_id}/'"
            )
        return self

    @property
    def merged_topics(self) -> tuple[str, ...]:
        """The topics of ``merge_tf``: moving and static transforms; () where it is off."""
        return (self.merge_tf, f"{self.merge_tf}_static") if self.merge_tf else ()


@dataclass(frozen=True, config=_STRICT)
class BurstLoss:
    """Losses that come in bursts: the two-state model of Gilbert and Elliott, one step per packet.

    The mean share of lost packets and the mean length of a stay in the bad state are :attr:`mean_loss` and
    ``1 / p_bad_to_good`` packets.

    :param p_good_to_bad: probability that the packet after one in the good state finds the bad one, 0..1
    :param p_bad_to_good: the other way round, above 0..1
    :param loss_good: probability that a packet is lost in the good state, 0..1
    :param loss_bad: the same in the bad state, 0..1
    """

    p_good_to_bad: Probability
    p_bad_to_good: Annotated[float, Field(gt=0, le=1)]
    loss_good: Probability = 0.0
    loss_bad: Probability = 1.0

    @property
    def share_bad(self) -> float:
        """Long-run share of packets that find the bad state, 0..1."""
        return self.p_good_to_bad / (self.p_good_to_bad + self.p_bad_to_good)

    @property
    def mean_loss(self) -> float:
        """Long-run share of packets that are lost, 0..1."""
        return self.share_bad * self.loss_bad + (1 - self.share_bad) * self.loss_good


@dataclass(frozen=True, config=_STRICT)
class ChannelConfig:
    """The simulated channel between transmitter and receiver (docs/reference/channels.md).

    ``snr_db`` to ``doppler_hz`` act on samples, and a PHY without samples refuses them; ``packet_loss`` to ``outages``
    act on packets, whatever the PHY.

    :param snr_db: mean burst power over noise power in the sampled band, dB, -50..100; None = no noise
    :param frequency_offset: carrier frequency offset, fraction of the sample rate, -0.5..0.5
    :param epsilon: sample clock ratio, 1.0 = none, 0.99..1.01
    :param taps: complex impulse response at the sample rate
    :param doppler_hz: Rayleigh fading with this maximum Doppler shift, Hz; every tap fades by itself; 0 = none
    :param packet_loss: probability that a packet is dropped between PHY and sink, 0..1
    :param burst_loss: losses in bursts; None = none
    :param outages: [from_s, to_s) during which nothing passes, s since the run began, in order of time
    :param seed: of noise, fading and losses
    """

    snr_db: Annotated[float, Field(ge=-50, le=100, allow_inf_nan=False)] | None = None
    frequency_offset: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    epsilon: Annotated[float, Field(ge=0.99, le=1.01)] = 1.0
    taps: Annotated[tuple[complex, ...], Field(min_length=1)] = (1.0 + 0.0j,)
    doppler_hz: Seconds = 0.0
    packet_loss: Probability = 0.0
    burst_loss: BurstLoss | None = None
    outages: tuple[tuple[Seconds, Seconds], ...] = ()
    seed: Count = 0

    @model_validator(mode="after")
    def _outages_in_order(self) -> ChannelConfig:
        before = 0.0
        for begin, end in self.outages:
            if not before <= begin < end:
                raise ValueError(
                    f"outages: [{begin:g}, {end:g}] ends before it begins, or begins before the one before it has "
                    "ended; write [from_s, to_s] in order of time"
                )
            before = end
        return self

    def on_samples(self) -> dict[str, Any]:
        """The settings that act on samples and are not at their defaults, by name."""
        default = ChannelConfig()
        names = ("snr_db", "frequency_offset", "epsilon", "taps", "doppler_hz")
        return {name: getattr(self, name) for name in names if getattr(self, name) != getattr(default, name)}

    @property
    def loses_packets(self) -> bool:
        """Whether anything here drops whole packets."""
        return bool(self.packet_loss or self.burst_loss or self.outages)


@dataclass(frozen=True, config=_STRICT)
class PhyConfig:
    """Which physical layer, and how fast.

    :param name: a name of ``gr_ros2.phy.PHY``
    :param sample_rate: samples/s; 0 = chosen by the experiment to carry ``headroom`` times the offered load
    :param headroom: capacity over offered load where sample_rate is 0
    :param kernels: what works on the samples of this end: auto = compiled kernels where they were built, else numpy;
        numpy = the reference, several times slower
    :param options: settings of that PHY, by its constructor's parameter names
    """

    name: str = "ofdm"
    sample_rate: Seconds = 0.0
    headroom: Annotated[float, Field(gt=0, le=1000)] = 1.2
    kernels: Kernels = "auto"
    options: dict[str, Any] = Field(default_factory=dict)


@dataclass(frozen=True, config=_STRICT)
class DiagnosticsConfig:
    """What a live link says about itself on ``/diagnostics``, and when it calls that a warning or an error.

    :param period_s: s between two messages, 0 = none at all
    :param window_s: s over which rates and losses are taken, 1 or more
    :param packet_loss_warn: share of packets lost, 0..1; 0 = never, as for all limits
    :param packet_loss_error: the same for an error
    :param message_loss_warn: share of messages lost, 0..1
    :param message_loss_error: the same for an error
    :param latency_warn_s: s from a message's stamp to its publication here, median of the newest
    :param latency_error_s: the same for an error
    :param age_warn_s: s since the stamp of a topic's newest message (where it has none, since its publication)
    :param age_error_s: the same for an error
    :param silence_warn_s: s without any packet, once there was one
    :param silence_error_s: the same for an error
    :param queue_warn: share of ``queue_depth`` that waits to be sent, 0..1
    """

    period_s: Seconds = 1.0
    window_s: Annotated[float, Field(ge=1, le=3600)] = 10.0
    packet_loss_warn: Probability = 0.1
    packet_loss_error: Probability = 0.5
    message_loss_warn: Probability = 0.1
    message_loss_error: Probability = 0.5
    latency_warn_s: Seconds = 1.0
    latency_error_s: Seconds = 5.0
    age_warn_s: Seconds = 0.0
    age_error_s: Seconds = 0.0
    silence_warn_s: Seconds = 3.0
    silence_error_s: Seconds = 10.0
    queue_warn: Probability = 0.8


def build(cls: type[_T], values: Mapping[str, Any], where: str = "") -> _T:
    """Make a configuration object from a mapping.

    :param cls: one of the dataclasses above, or one made of them
    :param where: what to call it in errors, for instance the file name
    :raises ConfigError: naming key, value and what is allowed
    """
    if not isinstance(values, Mapping):
        raise ConfigError(f"{where or cls.__name__}: expected keys and values, found {values!r}")
    try:
        return TypeAdapter(cls).validate_python(dict(values))
    except ValidationError as error:
        items = error.errors()
        # What several parts take over from the top level is wrong once, and not in every part.
        top = [(item["loc"], item["input"]) for item in items if len(item["loc"]) == 1]
        told = [item for item in items if len(item["loc"]) == 1 or (item["loc"][-1:], item["input"]) not in top]
        raise ConfigError("; ".join(_explain(cls, item, where) for item in told)) from error


def replaced(config: _T, **changes: Any) -> _T:
    """A configuration with some settings changed, validated again.

    :raises ConfigError: naming key, value and what is allowed
    """
    current = {item.name: getattr(config, item.name) for item in fields(config)}  # type: ignore[arg-type]
    return build(type(config), {**current, **changes})


def meanings(cls: type[Any]) -> dict[str, str]:
    """What the docstrings of a configuration class and its bases say of each setting, one line each."""
    said: dict[str, str] = {}
    for part in reversed(cls.__mro__):  # what a class says of a setting goes before what its base says
        text = re.sub(r"\s*\n\s+(?!:param)", " ", part.__doc__ or "")
        said |= {name: line.strip() for name, line in re.findall(r":param (\w+): (.*?)(?=\s*:param|\s*$)", text, re.S)}
    return said


def _explain(cls: type[Any], item: Any, where: str) -> str:
    prefix = f"{where}: " if where else ""
    key = ".".join(str(part) for part in item["loc"])
    message = item["msg"].removeprefix("Value error, ")
    if not key:
        return f"{prefix}{message}"
    owner = _class_at(cls, item["loc"][:-1])
    if item["type"] in ("unexpected_keyword_argument", "extra_forbidden"):
        known = [] if owner is None else [field.name for field in fields(owner)]
        return f"{prefix}unknown key {key}" + (f"; known are {', '.join(known)}" if known else "")
    meaning = {} if owner is None else meanings(owner)
    said = re.split(r"[.;](?: |$)", meaning.get(item["loc"][-1], "").replace("``", ""))[0]  # its first sentence
    said = f" ({said})" if said else ""
    if item["type"] in ("missing", "missing_argument"):
        return f"{prefix}{key} is missing{said}"
    value = "" if isinstance(item["input"], Mapping) else f" = {item['input']!r}"
    kind, _, problem = item["type"].partition("_")
    if kind in _KINDS and problem in ("type", "parsing", "str_parsing", "from_float"):
        return f"{prefix}{key}{value}: must be {_KINDS[kind]}{said}"
    asked = re.fullmatch(r"\w+ should (.+?)(?: after validation.*)?", message)
    return f"{prefix}{key}{value}: " + (f"must {asked[1]}" if asked else f"{message[0].lower()}{message[1:]}")


def _class_at(cls: Any, loc: tuple[Any, ...]) -> Any:
    """The dataclass at a place in the tree, None where it is not one of ours."""
    for part in loc:
        known = {field.name: field.type for field in fields(cls)} if hasattr(cls, "__dataclass_fields__") else {}
        annotation = known.get(part)
        cls = getattr(cls, "__pydantic_fields__", {}).get(part)
        cls = getattr(cls, "annotation", None) or annotation
        cls = next((kind for kind in get_args(cls) if kind is not type(None)), cls)  # X of X | None
    return cls if hasattr(cls, "__dataclass_fields__") else None


def read_yaml(path: str | Path) -> dict[str, Any]:
    """One YAML file as a mapping.

    :raises ConfigError: when it cannot be read, is no mapping, has a key twice, or is past what
        :mod:`gr_ros2.yaml_bounds` allows; names file and line
    """
    try:
        text = read_bounded(Path(path))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from error
    values = parse_yaml(text, str(path))
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: expected keys and values, found {type(values).__name__}")
    return values
