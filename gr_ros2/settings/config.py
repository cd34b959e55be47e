"""Every setting, once: names, units, ranges and defaults shared by YAML, CLI, GNU Radio blocks and ROS parameters.

Invariants: what several dataclasses have is inherited, so that each text stands once; a derived value is written
``auto``; durations are in seconds; an unknown key or a value out of range is a ConfigError that names the key, the
value and what is allowed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
    model_validator,
)
from pydantic.dataclasses import dataclass

from gr_ros2.core.errors import ConfigError, reason
from gr_ros2.core.names import (
    checked_frame_form,
    checked_merged_topic,
    checked_namespace,
    checked_namespace_form,
    checked_topic_form,
)
from gr_ros2.settings.airtime import Airtime, AirtimeConfig
from gr_ros2.settings.effect import ActsWhere, refuse_without_effect
from gr_ros2.settings.fields import AUTO, Auto
from gr_ros2.settings.problems import explain
from gr_ros2.settings.yaml_bounds import read_bounded
from gr_ros2.settings.yaml_text import parse_yaml
from gr_ros2.wire import BROADCAST, FORMATS

NOBODY = -1
"""Id of an end that belongs to no robot."""
MIN_PACKET_LEN = min(version.min_packet_len for version in FORMATS.values())
MAX_PACKET_LEN = max(version.max_packet_len for version in FORMATS.values())

STRICT = ConfigDict(extra="forbid", str_strip_whitespace=True)
_T = TypeVar("_T")

PacketLen = Annotated[int, Field(ge=MIN_PACKET_LEN, le=MAX_PACKET_LEN)]
RobotId = Annotated[int, Field(ge=0, le=BROADCAST - 1)]
DomainId = Annotated[int, Field(ge=0, le=232)]
SampleRate = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Seconds = Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=0, le=2**31 - 1)]
"""Of what DDS and GNU Radio take as a signed number of 32 bits."""
Seed = Annotated[int, Field(ge=0, le=2**63 - 1)]
"""More than a person writes: parts of a run add to the seed of the run."""
Bytes = Annotated[int, Field(ge=4096, le=2**40)]
Probability = Annotated[float, Field(ge=0, le=1)]
Decibels = Annotated[float, Field(ge=-500, le=500, allow_inf_nan=False)]
Text = Annotated[str, Field(min_length=1)]
Namespace = Annotated[str, AfterValidator(checked_namespace)]
NamespaceForm = Annotated[str, AfterValidator(checked_namespace_form)]
TopicForm = Annotated[str, Field(min_length=1), AfterValidator(checked_topic_form)]
MergedTopic = Annotated[str, AfterValidator(checked_merged_topic)]
FrameForm = Annotated[str, AfterValidator(checked_frame_form)]
QosClass = Literal["default", "latency", "bulk"]
Medium = Literal["exclusive", "slots", "aloha"]
QueuePolicy = Literal["latest", "fifo", "deadline"]
Repairs = Literal["idle", "thrifty", "off"]
Kernels = Literal["auto", "numpy"]

DEFAULT_MIDDLEWARE = "dds"
"""Of everything that joins a ROS graph; a name of ``gr_ros2.middleware.MIDDLEWARE``."""


BOUND_TO_NONE = frozenset((AUTO, "best", "all"))
"""Values of ``via`` that are no name of a radio."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Seeded:
    """What draws random numbers."""

    seed: Seed = 0
    """of everything random in it; the same seed draws the same numbers. That of a scenario is that of its channel and
    simulator too, unless it is set there"""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Traffic(Seeded):
    """What a link is given to carry."""

    source: str = "sim"
    """where messages come from: `sim`, the simulated robots, or `bag:PATH`, a recording"""
    duration_s: Seconds = 15.0
    """s during which messages are submitted; 0 = no limit: as long as the recording"""

    @model_validator(mode="after")
    def _sim_or_bag(self) -> Traffic:
        if self.source != "sim" and not self.source.removeprefix("bag:").strip():
            raise ValueError(f"source = {self.source!r}: the path of the bag is missing; write bag:PATH")
        if self.source != "sim" and not self.source.startswith("bag:"):
            raise ValueError(f"source = {self.source!r}: write sim or bag:PATH")
        return self

    @property
    def bag_path(self) -> Path | None:
        """The recording to play, None when the simulator is the source."""
        return None if self.source == "sim" else Path(self.source.removeprefix("bag:").strip()).expanduser()


@dataclass(frozen=True, kw_only=True, config=STRICT)
class CloudOptions:
    """What leaves of a point cloud."""

    voxel: Annotated[Literal[0] | Annotated[float, Field(ge=0.001, le=1000)], Field(title="Cell (m)")] = 0
    """m, edge of the cells that points become; 0 = every point, exactly"""
    range: Annotated[float, Field(gt=0, le=1e6)] | Auto = AUTO
    """m from the origin of the cloud's frame, beyond which cells are left out; auto = none"""
    keep: Literal["", "intensity", "rgb"] = ""
    """what of a cell's points is sent beside their place, as a mean"""
    fit: bool = False
    """the newest cloud fits what other topics leave of the air, with larger cells where that is little"""
    conditions: ClassVar[Any] = (
        ActsWhere(
            ("range", "keep", "fit"), lambda cloud: cloud.voxel > 0, "an exact cloud has every point; set voxel above 0"
        ),
    )

    @model_validator(mode="after")
    def _has_effect(self) -> CloudOptions:
        refuse_without_effect(self)
        return self


BY_TYPE = (
    *("cloud.voxel", "camera.size", "camera.fps", "camera.output"),
    *("depth_image.mode", "depth_image.near", "depth_image.far"),
)
"""Options of a topic that say how its type alone is coded."""
CODING = ("codec", "quantize", *BY_TYPE)


def _off(given: object) -> object:
    """``off`` instead of options; YAML 1.1 reads it as false."""
    return {"off": True} if given is False or given == "off" else given


@dataclass(frozen=True, kw_only=True, config=STRICT)
class MayBeOff:
    """Of what would else be made smaller."""

    off: bool = False
    """they pass exactly"""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class CameraOptions(MayBeOff):
    """What leaves of pictures."""

    size: Annotated[str, Field(pattern=r"^(auto|full|[1-9]\d{0,4}x[1-9]\d{0,4})$")] = AUTO
    """pixels at most, such as 320x240; full = as they come, auto = halved where the air is short"""
    fps: Annotated[float, Field(gt=0, le=1000)] | Auto = AUTO
    """pictures/s at most; auto = as many as the air carries"""
    output: Literal["same", "CompressedImage", "CompressedVideo", "FFMPEGPacket"] = "same"
    """type that comes out; CompressedVideo is of foxglove_msgs, FFMPEGPacket of ffmpeg_image_transport_msgs"""
    conditions: ClassVar[Any] = (
        ActsWhere(("size", "fps", "output"), lambda camera: not camera.off, "it is off; leave off out"),
    )

    @model_validator(mode="after")
    def _has_effect(self) -> CameraOptions:
        refuse_without_effect(self)
        return self


@dataclass(frozen=True, kw_only=True, config=STRICT)
class DepthOptions(MayBeOff):
    """What leaves of depth images (16UC1, 32FC1, compressedDepth)."""

    mode: Literal["auto", "8", "10", "12", "exact"] = AUTO
    """auto = video of inverse distances that fits the air; or so many bits"""
    near: Annotated[float, Field(ge=0, allow_inf_nan=False, title="Nearest (m)")] = 0.0
    """m, the nearest distance; 0 = found from the images"""
    far: Annotated[float, Field(ge=0, allow_inf_nan=False, title="Farthest (m)")] = 0.0
    """m, the farthest distance; 0 = found from the images"""
    conditions: ClassVar[Any] = (
        ActsWhere(("mode", "near", "far"), lambda depth: not depth.off, "it is off; leave off out"),
    )

    @model_validator(mode="after")
    def _has_effect(self) -> DepthOptions:
        refuse_without_effect(self)
        if 0 < self.far <= self.near:
            raise ValueError(f"far = {self.far:g} is not beyond near = {self.near:g}")
        return self


@dataclass(frozen=True, kw_only=True, config=STRICT)
class SendOptions:
    """Options of one topic that a robot sends."""

    qos: QosClass | Auto = AUTO
    """class of its packets; auto = latency for ``commands``, else default"""
    reliability: Literal["reliable", "best_effort"] | Auto = AUTO
    """auto adapts the subscription to the publishers found"""
    durability: Literal["volatile", "transient_local"] | Auto = AUTO
    """auto adapts likewise; the sink publishes volatile unless this says transient_local"""
    depth: Count | Auto = AUTO
    """QoS depth, auto that of `graph` or `publish`; of a transient-local topic also how many messages late robots get,
    auto 1"""
    queue_depth: Annotated[Count | Auto, Field(title="Queue depth (messages per topic)")] = AUTO
    """as of the robot, which auto takes"""
    queue: QueuePolicy | Auto = AUTO
    """what waits: the newest, all up to `queue_depth`, or all until `deadline_s`; auto follows the publishers' QoS
    (docs/explanation/scheduling.md)"""
    deadline_s: Annotated[float, Field(ge=0, le=3600, allow_inf_nan=False)] | Auto = AUTO
    """s after which a message is dropped; 0 none, auto the publishers' lifespan where `queue` is auto, else 0.3 for
    `commands` and none for others. Of a service: s that a call waits, auto 30"""
    weight: Annotated[float, Field(ge=0.001, le=1000, allow_inf_nan=False)] = 1.0
    """what a second of this topic's age counts beside other topics, 0.001..1000"""
    max_rate: Annotated[float, Field(ge=0, le=1_000_000, allow_inf_nan=False)] = 0.0
    """messages/s at most, the newest unless `queue` is set; 0 unlimited"""
    keep_s: Seconds = 0.0
    """s for which robots that lack its newest message get it, though not transient-local (an e-stop, a mode). Commands
    are never kept"""
    to: RobotId | Auto = AUTO
    """robot for which it is; auto = all"""
    via: str = AUTO
    """of several radios: all = over each, best = over the fastest that is heard, a name = that one alone; auto = all
    for class latency, else best"""
    codec: str = AUTO
    """auto, none, fields or zstd, where ``compression`` is on (docs/explanation/compression.md)"""
    quantize: str = ""
    """bounded loss per field, '' lossless (docs/explanation/compression.md)"""
    instance: str = ""
    """fields that tell apart what messages speak of, such as robots[].id, so that max_rate and queue latest act on
    each; '' = those known of its type (/tf, /diagnostics, JointState, markers), none = no fields"""
    cloud: CloudOptions = Field(default_factory=CloudOptions)
    """what leaves of a PointCloud2, such as {voxel: 0.1, range: 30} (docs/explanation/codecs.md)"""
    camera: Annotated[CameraOptions, BeforeValidator(_off)] = Field(default_factory=CameraOptions)
    """the same of pictures, such as {size: 320x240, fps: 10}; off = exactly (docs/how-to/cameras.md)"""
    depth_image: Annotated[DepthOptions, BeforeValidator(_off)] = Field(default_factory=DepthOptions)
    """the same of depth images, such as {mode: 10}"""
    conditions: ClassVar[Any] = (
        ActsWhere(
            ("queue_depth",),
            lambda topic: topic.queue != "latest",
            "queue latest keeps the newest message alone; leave it out, or set another queue",
        ),
        ActsWhere(BY_TYPE, lambda topic: topic.codec == AUTO, "codec has to be auto for it; leave codec out"),
    )

    @property
    def passes_pictures(self) -> bool:
        """Whether pictures pass as any message does."""
        return self.camera.off and self.depth_image in (DepthOptions(), DepthOptions(off=True))

    @model_validator(mode="after")
    def _deadline(self) -> SendOptions:
        refuse_without_effect(self)
        if self.queue == "deadline" and self.deadline_s in (0, AUTO):
            raise ValueError("queue = 'deadline': deadline_s is missing; set it above 0")
        return self


@dataclass(frozen=True, config=STRICT)
class BurstLoss:
    """Losses that come in bursts: the two-state model of Gilbert and Elliott, one step per packet.

    The mean share of lost packets and the mean length of a stay in the bad state are :attr:`mean_loss` and
    ``1 / p_bad_to_good`` packets.
    """

    p_good_to_bad: Probability
    """that a packet after one in the good state finds the bad one, 0..1"""
    p_bad_to_good: Annotated[float, Field(gt=0, le=1)]
    """the other way round, above 0..1"""
    loss_good: Probability = 0.0
    """that a packet is lost in the good state, 0..1"""
    loss_bad: Probability = 1.0
    """the same in the bad state, 0..1"""

    @property
    def share_bad(self) -> float:
        """Long-run share of packets that find the bad state, 0..1."""
        return self.p_good_to_bad / (self.p_good_to_bad + self.p_bad_to_good)

    @property
    def mean_loss(self) -> float:
        """Long-run share of packets that are lost, 0..1."""
        return self.share_bad * self.loss_bad + (1 - self.share_bad) * self.loss_good


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ChannelConfig(Seeded):
    """The simulated channel between transmitter and receiver (docs/reference/channels.md).

    ``snr_db`` to ``doppler_hz`` act on samples, and a PHY without samples refuses them; ``packet_loss`` to ``outages``
    act on packets, whatever the PHY.
    """

    snr_db: Annotated[
        Annotated[float, Field(ge=-50, le=100, allow_inf_nan=False)] | None, Field(title="Signal-to-noise ratio (dB)")
    ] = None
    """mean burst power over noise power in the sampled band, dB, -50..100; null = no noise"""
    frequency_offset: Annotated[float, Field(ge=-0.5, le=0.5, title="Frequency offset (share of the sample rate)")] = (
        0.0
    )
    """carrier frequency offset, fraction of the sample rate, -0.5..0.5"""
    epsilon: Annotated[float, Field(ge=0.99, le=1.01)] = 1.0
    """sample clock ratio, 1.0 = none, 0.99..1.01"""
    taps: Annotated[tuple[complex, ...], Field(min_length=1)] = (1.0 + 0.0j,)
    """complex impulse response at the sample rate"""
    doppler_hz: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    """Rayleigh fading with this maximum Doppler shift, Hz; every tap fades by itself; 0 = none"""
    packet_loss: Annotated[Probability, Field(title="Packet loss (share of packets)")] = 0.0
    """probability that a packet is dropped between PHY and sink, 0..1"""
    burst_loss: BurstLoss | None = None
    """losses in bursts; null = none"""
    outages: tuple[tuple[Seconds, Seconds], ...] = ()
    """[from_s, to_s) since the run began in which nothing passes, in order of time"""

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


@dataclass(frozen=True, kw_only=True, config=STRICT)
class MeasuredChannel(ChannelConfig):
    """A channel that may have been measured."""

    trace: str = ""
    """file of a channel that was measured, which says SNR, losses or capacity over time, or over place
    (docs/how-to/measured-channels.md); '' = none"""

    @property
    def on_the_way(self) -> ChannelConfig:
        """What happens on the way, without what levels follow from."""
        return ChannelConfig(**{item.name: getattr(self, item.name) for item in fields(ChannelConfig)})


@dataclass(frozen=True, kw_only=True, config=ConfigDict(**STRICT, populate_by_name=True))
class PathConfig(MeasuredChannel):
    """The channel from one robot to another, where it is not that of all."""

    from_: Annotated[RobotId | None, Field(alias="from", title="From")] = None
    """number of the robot that sends; null = whoever"""
    to: RobotId | None = None
    """number of the robot that hears it; null = whoever"""
    delay_s: Seconds = 0.0
    """s that a packet takes beside its airtime"""

    def between(self, sender: int, receiver: int) -> bool:
        """Whether it lies between two robots, by their numbers."""
        return self.from_ in (None, sender) and self.to in (None, receiver)


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Transceiver:
    """What levels at a receiver follow from."""

    tx_power_dbm: Decibels | Auto = AUTO
    """power that it transmits, dBm; auto = the channel's"""
    noise_figure_db: Decibels | Auto = AUTO
    """of its receiver, dB; auto = the channel's"""


@dataclass(frozen=True, kw_only=True, config=ConfigDict(**STRICT, populate_by_name=True))
class ScenarioChannel(Transceiver, MeasuredChannel):
    """The channel of a scenario, which may follow from where the robots are (docs/explanation/medium.md)."""

    from_: Annotated[Literal["settings", "positions"], Field(alias="from", title="From")] = "settings"
    """what says the levels: ``snr_db``, or where the robots are in the simulator's world or by a recording's
    odometry"""
    model: Literal["log_distance", "two_ray", "free_space"] = "log_distance"
    """of the path loss; two_ray has the reflection from the ground"""
    exponent: Annotated[float, Field(ge=1, le=8)] = 3.0
    """of log_distance: 2 as in free space, 1.6 to 1.8 in corridors, 2.7 to 4 among obstacles"""
    height_m: Annotated[float, Field(gt=0, le=1000)] = 0.5
    """of two_ray: height of all antennas, m"""
    walls_db: Annotated[float, Field(ge=0, le=100)] = 0.0
    """loss in each obstacle on the straight line between two robots, dB"""
    shadowing_db: Annotated[float, Field(ge=0, le=30)] = 0.0
    """standard deviation of the shadowing, dB; 0 = none"""
    decorrelation_m: Annotated[float, Field(gt=0, le=10_000)] = 5.0
    """way of a robot after which 1/e of the correlation is left, m"""
    tx_power_dbm: Decibels = 20.0
    """power that a robot transmits, dBm"""
    noise_figure_db: Decibels = 6.0
    """of a receiver, dB"""
    carrier_hz: Annotated[float, Field(ge=1e3, le=1e12)] = 2.4e9
    """carrier frequency, Hz"""
    conditions: ClassVar[Any] = (
        ActsWhere(
            ("model", "exponent", "height_m", "walls_db", "shadowing_db", "decorrelation_m", "carrier_hz"),
            lambda channel: channel.from_positions,
            "acts only where levels follow from positions; set from: positions",
        ),
        ActsWhere(
            ("snr_db",),
            lambda channel: not channel.from_positions,
            "follows from positions; leave it out, or set from: settings",
        ),
        ActsWhere(
            ("exponent",),
            lambda channel: channel.model == "log_distance",
            "only model log_distance has it; leave it out, or set model: log_distance",
        ),
        ActsWhere(
            ("height_m",),
            lambda channel: channel.model == "two_ray",
            "only model two_ray has it; leave it out, or set model: two_ray",
        ),
        ActsWhere(
            ("decorrelation_m",),
            lambda channel: channel.shadowing_db > 0,
            "nothing is shadowed; set shadowing_db above 0",
        ),
    )

    @property
    def from_positions(self) -> bool:
        """Whether the levels follow from where the robots are."""
        return self.from_ == "positions"

    def levels(self, robot: Transceiver) -> tuple[float, float]:
        """Transmit power of a robot in dBm, and noise figure of its receiver in dB."""
        power, figure = robot.tx_power_dbm, robot.noise_figure_db
        return self.tx_power_dbm if power == AUTO else power, self.noise_figure_db if figure == AUTO else figure

    @model_validator(mode="after")
    def _one_origin(self) -> ScenarioChannel:
        refuse_without_effect(self)
        if self.trace and self.from_positions:
            raise ValueError(f"trace = {self.trace!r}: levels follow from positions; leave it out, or from")
        return self


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Reach:
    """Who of several robots hears whom, and how well."""

    channel: ScenarioChannel = Field(default_factory=ScenarioChannel)
    """what lies between all of them"""
    gains_db: Decibels | tuple[tuple[Decibels | None, ...], ...] | None = None
    """gain from robot to robot, dB: one number, or a row for each, null where nothing arrives; the SNR then follows
    from power, noise figure and `phy.sample_rate`. null = `channel.snr_db` between all"""

    def check_levels(self, robots: int) -> None:
        """Check that the levels have one origin, and that it says something of each robot.

        :raises ValueError: naming the setting
        """
        matrix = self.gains_db
        if isinstance(matrix, tuple) and [len(row) for row in matrix] != [robots] * robots:
            raise ValueError(f"gains_db: {robots} robots need {robots} rows of {robots} numbers")
        if self.channel.trace and matrix is not None:
            raise ValueError("gains_db: levels follow from the trace; leave one of them out")
        if self.channel.from_positions and matrix is not None:
            raise ValueError("gains_db: levels follow from positions; leave it out, or set channel.from: settings")


LEVELS = (
    ActsWhere(
        ("channel.snr_db",),
        lambda robots: robots.gains_db is None,
        "follows from gains_db; leave one of them out",
    ),
    ActsWhere(
        ("channel.tx_power_dbm", "channel.noise_figure_db", "robots.*.tx_power_dbm", "robots.*.noise_figure_db"),
        lambda robots: robots.gains_db is not None or robots.channel.from_positions,
        "no level follows from it; set gains_db, or channel.from: positions",
    ),
)
"""Of what has ``robots`` with ``gains_db`` and a ``channel``."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class PhyConfig:
    """Which physical layer, and how fast."""

    name: str = "ofdm"
    """a name of ``gr_ros2.phy.PHY``"""
    sample_rate: Annotated[SampleRate | Auto, Field(title="Sample rate (samples/s)")] = AUTO
    """samples/s, which a radio needs; auto = an experiment chooses it by what it offers"""
    headroom: Annotated[float, Field(gt=0, le=1000)] = 1.2
    """capacity over offered load where sample_rate is auto"""
    kernels: Kernels = AUTO
    """auto = compiled ones where they were built; numpy = the reference, several times slower"""
    options: dict[str, Any] = Field(default_factory=dict)
    """settings of that PHY"""
    conditions: ClassVar[Any] = (
        ActsWhere(
            ("headroom",),
            lambda phy: phy.sample_rate == AUTO,
            "acts where the sample rate is chosen by it; leave it out, or set sample_rate: auto",
        ),
    )

    @model_validator(mode="after")
    def _has_effect(self) -> PhyConfig:
        refuse_without_effect(self)
        return self

    @property
    def takes_airtime(self) -> bool:
        """Whether packets last for some time. Settings load no back-end, so this is known of its name only."""
        return self.name != "direct"


def check_medium(medium: Medium, phy: PhyConfig, airtime: AirtimeConfig, where: str = "") -> None:
    """:raises ValueError: for a medium that does not fit PHY and airtime limit"""
    if medium != "exclusive" and not phy.takes_airtime:
        raise ValueError(f"{where}medium = {medium!r}: phy direct takes no airtime; choose another")
    if airtime.listen_before_send and medium != "exclusive":
        raise ValueError(f"{where}airtime.listen_before_send: medium = {medium!r} has times of its own; leave it out")


@dataclass(frozen=True, kw_only=True, config=STRICT)
class AirConfig:
    """How robots send, which is the same for all that share a channel."""

    name: Text
    """what results, tables and errors call it; the file's name unless it is set"""
    phy: PhyConfig = Field(default_factory=PhyConfig)
    """which physical layer, and how fast; the same at every robot"""
    medium: Medium = "exclusive"
    """when a robot sends: whenever it has something, in slots that it derives from the packets heard, or at random
    (aloha)"""
    relay: Literal["off", "gain"] = "off"
    """gain = a robot sends messages of others on; medium: slots"""
    airtime: Airtime = Field(default_factory=AirtimeConfig)
    """how much a robot may send: settings, or the name of a band"""

    @property
    def has_slots(self) -> bool:
        """Whether packets are sent in slots."""
        return self.medium == "slots"

    @model_validator(mode="after")
    def _medium_fits(self) -> AirConfig:
        if self.relay != "off" and not self.has_slots:
            raise ValueError(f"relay = {self.relay!r}: the packets of slots name who hears whom; set medium: slots")
        check_medium(self.medium, self.phy, self.airtime)
        if self.airtime.rule is not None and not self.phy.takes_airtime:
            raise ValueError("airtime: phy direct takes no airtime, so there is nothing to limit; leave it out")
        return self


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ClockConfig:
    """How a live link watches the clocks of other robots."""

    every_s: Annotated[
        Annotated[float, Field(ge=0, le=3600, allow_inf_nan=False)] | Auto, Field(title="Asked every (s)")
    ] = AUTO
    """s between two questions for the clock of each robot heard; 0 = only `gr-ros2 ping` asks; auto = 10 where
    `publish.stamps` is mine, 1 with `chrony`, else 0"""
    chrony: Annotated[str, Field(title="Socket of chrony")] = ""
    """socket of a reference clock of chrony (refclock SOCK), which is given the clock of ``robot``; '' = none"""
    robot: RobotId | None = None
    """number of the robot whose clock chrony is given"""

    @model_validator(mode="after")
    def _whole(self) -> ClockConfig:
        if bool(self.chrony) != (self.robot is not None):
            raise ValueError("chrony and robot: the socket and whose clock it is given belong together; set both")
        if self.chrony and self.every_s == 0:
            raise ValueError("every_s = 0: nobody asks for the clock that chrony is given; leave it out")
        return self


@dataclass(frozen=True, kw_only=True, config=STRICT)
class DiagnosticsConfig:
    """What a live link says about itself on ``/diagnostics``, and when it calls that a warning or an error."""

    period_s: Seconds = 1.0
    """s between two messages, 0 = none at all"""
    loss: tuple[Probability, Probability] = (0.1, 0.5)
    """share of packets, and of a topic's messages, lost in the last 10 s: [warning, error]; 0 = never, as for all
    limits"""
    latency_s: tuple[Seconds, Seconds] = (1.0, 5.0)
    """s from a message's stamp to its publication here, median of the newest: [warning, error]"""
    age_s: tuple[Seconds, Seconds] = (0.0, 0.0)
    """s since the stamp of a topic's newest message (where it has none, since its publication): [warning, error]"""
    silence_s: tuple[Seconds, Seconds] = (3.0, 10.0)
    """s without any packet, once there was one: [warning, error]"""


def build(cls: type[_T], values: Mapping[str, Any], where: str = "") -> _T:
    """Make a configuration object from a mapping.

    :param cls: one of the dataclasses above, or one composed of them
    :param where: name of the settings in errors, for instance the file name
    :raises ConfigError: naming key, value and what is allowed
    """
    if not isinstance(values, Mapping):
        raise ConfigError(f"{where or cls.__name__}: expected keys and values, found {values!r}")
    try:
        return TypeAdapter(cls).validate_python(dict(values))
    except ValidationError as error:
        raise ConfigError(explain(cls, error.errors(), where)) from error


def airtime_from(given: str | Mapping[str, Any]) -> AirtimeConfig:
    """How much a robot may send, from the name of a band ('' = no limit) or from settings.

    :raises ConfigError: naming key, value and what is allowed
    """
    return build(AirtimeConfig, {"band": given} if isinstance(given, str) else given, "airtime")


def replaced(config: _T, **changes: Any) -> _T:
    """A configuration with some settings changed, validated again.

    :raises ConfigError: naming key, value and what is allowed
    """
    return build(type(config), {**vars_of(config), **changes})


def vars_of(config: Any) -> dict[str, Any]:
    """The fields of a settings object by name."""
    return {item.name: getattr(config, item.name) for item in fields(config)}


def read_yaml(path: str | Path) -> dict[str, Any]:
    """One YAML file as a mapping.

    :raises ConfigError: when it cannot be read, is not a mapping, has a key twice, or exceeds the limits of
        :mod:`gr_ros2.settings.yaml_bounds`; names file and line
    """
    try:
        text = read_bounded(Path(path))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({reason(error)})") from error
    values = parse_yaml(text, str(path))
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: expected keys and values, found {type(values).__name__}")
    return values
