"""The settings of the race: the recordings, the radio, and the sample rate that follows from the load.

Invariants: a load is the share of the airtime that the recordings would need if each message were one uncompressed
frame with the overhead of a version 0 packet. Every contender has the same recordings at the same sample rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from dataclasses import dataclass as plain_dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from gr_ros2.core.errors import BackendMissingError, ConfigError
from gr_ros2.core.names import first
from gr_ros2.middleware import Qos
from gr_ros2.middleware.bag import BagMiddleware
from gr_ros2.middleware.bag_files import bag_contents, read_bag
from gr_ros2.phy import PHY, Phy
from gr_ros2.settings.config import PacketLen, SampleRate, Text, Traffic
from gr_ros2.settings.fields import AUTO, Auto
from gr_ros2.wire import FORMATS
from gr_ros2_lab.race.contenders import MTU, Contender, Races, chosen
from gr_ros2_lab.race.fast import has_fast_dds, library
from gr_ros2_lab.race.rows import ROWS, RowName
from gr_ros2_lab.sim.fleet import Fleet
from gr_ros2_lab.sim.sim_settings import SimSettings

PHY_NAME = "ofdm"
"""The PHY with its defaults. For every contender, a frame is only as long on the air as its bytes need."""
MOST_ROBOTS = 10
_SIM_START_NS = 1_700_000_000_000_000_000
"""Start of a recording of the simulator, ns since 1970. It is constant, so the messages are always the same."""
_SIM_HZ = 35.0
_LARGEST_IN_IP = MTU - 200
"""Bytes of the largest message that fits into an IP packet with the headers of any contender."""

MATCH_S = 30.0
"""s that all ends have to find each other."""
DRAIN_S = 10.0
"""s that what is on its way has after the last message was published."""
Share = Annotated[float, Field(ge=0, le=1)]
Load = Annotated[float, Field(gt=0, le=100)]


@dataclass(frozen=True, kw_only=True, config=ConfigDict(extra="forbid"))
class RaceSettings(Traffic):
    """One race: every contender at every load and every loss."""

    robots: Annotated[int, Field(ge=2, le=MOST_ROBOTS)] | None = None
    """all send to all others on one channel; null = one robot sends to another"""
    row: RowName = "steady"
    """of a race of two, what happens beside the odometry"""
    bag_topic: Text = AUTO
    """topic of the bag; auto where it has only one"""
    peers: tuple[str, ...] = ()
    """names of ``CONTENDERS``; [] = all"""
    loss: Annotated[tuple[Share, ...], Field(min_length=1)] = (0.0, 0.05, 0.2, 0.4)
    """probability that a frame is lost, 0..1, in each direction"""
    sample_rate: SampleRate | Auto = AUTO
    """samples/s instead of ``load``; auto = chosen by it"""
    load: Annotated[tuple[Load, ...], Field(min_length=1)] = (0.5, 2.0)
    """of the link by the recording as it is, 1 = all of its capacity"""
    duration_s: Annotated[float, Field(gt=0, le=3600)] = 15.0
    """s of the recording"""
    packet_len: PacketLen = 64
    """bytes of gr-ros2's longest packets; of `gr-ros2-plain` they are as long as a message needs"""

    @property
    def races(self) -> Races:
        """Which contenders and which numbers belong to it."""
        if self.robots:
            return "team"
        return "two" if self.row == "steady" else "row"


@plain_dataclass(frozen=True)
class RaceRecording:
    """What every contender carries: one topic of a bag.

    :param path: path of the bag
    :param payloads: the messages, in order
    :param due: due time of each message, s after the first one
    :param phase_s: s from the beginning of all recordings to the first message
    :param qos: of its publisher; None: the contender's
    """

    path: Path
    topic: str
    type_name: str
    payloads: tuple[bytes, ...]
    due: tuple[float, ...]
    phase_s: float = 0.0
    qos: Qos | None = None

    @property
    def hz(self) -> float:
        """Mean rate, messages/s."""
        return (len(self.due) - 1) / self.due[-1]

    @property
    def largest(self) -> int:
        """Bytes of its largest message."""
        return max(map(len, self.payloads))

    @property
    def single_packet_len(self) -> int:
        """Bytes of a version 0 packet that holds any one of the messages without compression."""
        return min(FORMATS[0].packed_len([self.largest]), FORMATS[0].max_packet_len)


@plain_dataclass(frozen=True)
class Condition:
    """A condition, which is the same for all contenders."""

    load: float
    sample_rate: float
    loss: float


def racing(settings: RaceSettings) -> dict[str, Contender]:
    """The contenders that race, by name. Of Fast DDS only those that are named where it is not installed."""
    found = chosen(settings.peers, settings.races)
    if not settings.peers and not has_fast_dds():
        return {name: contender for name, contender in found.items() if contender.stack != "fast"}
    return found


def check(settings: RaceSettings) -> None:
    """Check the settings before anything is started.

    :raises ConfigError: when a setting is wrong; the message names it
    :raises BackendMissingError: when a contender is not installed
    """
    if settings.robots and settings.row != "steady":
        raise ConfigError(f"row = {settings.row!r}: of a race of two; leave out robots, or the row")
    stacks = {contender.stack for contender in racing(settings).values()}
    if "fast" in stacks:
        library()
    if "zenoh" in stacks and find_spec("zenoh") is None:
        raise BackendMissingError("zenoh is not installed: pip install eclipse-zenoh==1.10.2, or race other --peers")
    PHY.load(PHY_NAME)(settings.packet_len, 1.0)


def conditions(settings: RaceSettings, recordings: Sequence[RaceRecording]) -> list[Condition]:
    """Every combination of load and loss, the smallest first.

    :param recordings: those that share the air
    """
    needed = 0.0
    for recording in recordings:
        phy: Phy = PHY.load(PHY_NAME)(recording.single_packet_len, 1.0)
        needed += recording.hz * phy.airtime_samples()
    if settings.sample_rate != AUTO:
        rates = {needed / settings.sample_rate: settings.sample_rate}
    else:
        rates = {load: needed / load for load in sorted(settings.load)}
    return [Condition(load, rate, loss) for load, rate in rates.items() for loss in sorted(settings.loss)]


def record_sim(folder: Path, settings: RaceSettings) -> Path:
    """Write the simulated robots' odometry as a bag.

    :param folder: where the bag goes
    """
    path = folder / "recording"
    fleet = Fleet(SimSettings(seed=settings.seed, robots=settings.robots or 1, odom_rate=_SIM_HZ))
    topics = [f"/robot_{number}/odom" for number in fleet.robot_ids]
    with BagMiddleware(path=path, mode="write") as bag:
        publishers = {topic: bag.advertise(topic, "nav_msgs/msg/Odometry", Qos()) for topic in topics}
        for message in fleet.messages(settings.duration_s, _SIM_START_NS * 1e-9, topics):
            publisher = publishers[message.topic]
            publisher.publish_at(message.payload, _SIM_START_NS + round(message.t * 1e9))
    return path


def read_recordings(settings: RaceSettings, folder: Path) -> list[RaceRecording]:
    """Read what each robot sends. A recording of the simulator is made first.

    :param folder: folder for the bag of the simulator
    :raises ConfigError: when the bag has no such topic, too few messages of it, or messages that are too large
    :raises BagError: when the bag cannot be read
    """
    robots = settings.robots or 1
    if settings.bag_path is None:
        path = record_sim(folder, settings)
        found = [_read(settings, path, f"/robot_{number + 1}/odom") for number in range(robots)]
        first = min(stamp for _, stamp in found)
        return [replace(recording, phase_s=(stamp - first) * 1e-9) for recording, stamp in found]
    recording, _ = _read(settings, settings.bag_path, settings.bag_topic)
    return [replace(recording, phase_s=number / robots / recording.hz) for number in range(robots)]


def beside(settings: RaceSettings, folder: Path, stack: str) -> list[RaceRecording]:
    """What a contender of a stack carries beside the odometry in this row, each written as a bag first.

    :param folder: where the bags go
    """
    row, found = ROWS[settings.row], []
    offers = list(row.offers(stack, settings.duration_s))
    for number, (topic, type_name, qos) in enumerate(row.topics(stack)):
        mine = [offer for offer in offers if offer.topic == topic]
        path = folder / f"{stack}-{number}"
        with BagMiddleware(path=path, mode="write") as bag:
            publisher = bag.advertise(topic, type_name, qos)
            for offer in mine:
                publisher.publish_at(offer.payload, _SIM_START_NS + round(offer.t * 1e9))
        due = tuple(offer.t - mine[0].t for offer in mine)
        payloads = tuple(offer.payload for offer in mine)
        found.append(RaceRecording(path, topic, type_name, payloads, due, mine[0].t, qos))
    return found


def _read(settings: RaceSettings, path: Path, asked: str) -> tuple[RaceRecording, int]:
    """A topic of a bag, and the stamp of its first message in ns."""
    contents = bag_contents(path)
    found = {name: topic.info.type_name for name, topic in contents.topics.items()}
    topic = next(iter(found), "") if asked == AUTO else f"/{asked.lstrip('/')}"
    if topic not in found or (len(found) > 1 and asked == AUTO):
        has = "; ".join([", ".join(first(found)) or "it has none", *contents.remarks])
        raise ConfigError(f"topic = {asked!r}: name one that {path} has: {has}")
    payloads: list[bytes] = []
    stamps: list[int] = []
    for message in read_bag(path, [topic]):
        if stamps and (message.stamp_ns - stamps[0]) * 1e-9 >= settings.duration_s:
            break
        payloads.append(message.payload)
        stamps.append(message.stamp_ns)
    if len(payloads) < 2 or stamps[-1] == stamps[0]:
        raise ConfigError(f"{path}: {topic} has {len(payloads)} messages in {settings.duration_s:g} s; 2 are needed")
    due = tuple((stamp - stamps[0]) * 1e-9 for stamp in stamps)
    recording = RaceRecording(path, topic, found[topic], tuple(payloads), due)
    if recording.largest > _LARGEST_IN_IP:
        raise ConfigError(
            f"{path}: {topic} has messages of {recording.largest} B; the race takes up to {_LARGEST_IN_IP} B, which "
            "fit one IP packet"
        )
    return recording, stamps[0]


def dump(settings: RaceSettings) -> dict[str, Any]:
    """The settings as JSON values."""
    return asdict(settings)
