"""What is raced over: the recording, the radio, and how the sample rate follows from the load.

Invariants: a load is the share of the air that the recording would need if each message were one frame, as it is, with
the overhead of a version 0 packet; every contender has the same recording at the same sample rate.
"""

from __future__ import annotations

from dataclasses import asdict
from dataclasses import dataclass as plain_dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from gr_ros2.config import PacketLen, Seconds
from gr_ros2.errors import BackendMissingError, ConfigError
from gr_ros2.middleware import Qos
from gr_ros2.middleware.bag import BagMiddleware
from gr_ros2.middleware.bag_files import bag_contents, read_bag
from gr_ros2.phy import PHY, Phy
from gr_ros2.race.contenders import MTU, chosen
from gr_ros2.sim.fleet import Fleet
from gr_ros2.sim.settings import SimSettings
from gr_ros2.wire.v0 import V0

PHY_NAME = "ofdm"
SIM_TOPIC = "/robot_1/odom"
_SIM_ROBOT = 1
_SIM_START_NS = 1_700_000_000_000_000_000
"""ns since 1970, of a recording of the simulator; the same always, so that the messages are."""
_SIM_HZ = 35.0
_LARGEST_IN_IP = MTU - 200
"""Bytes of a message that fits an IP packet with any contender's headers."""

Share = Annotated[float, Field(ge=0, le=1)]
Load = Annotated[float, Field(gt=0, le=100)]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class RaceSettings:
    """One race: every contender at every load and every loss.

    :param source: `sim`, the odometry of a simulated robot at 35 Hz, or `bag:PATH`
    :param topic: of the bag; '' where it has only one
    :param peers: names of ``CONTENDERS``; [] = all
    :param loss: probability that a frame is lost, 0..1, in each direction
    :param load: of the link by the recording as it is, 1 = all of its capacity
    :param sample_rate: samples/s instead of ``load``, 0 = chosen by it
    :param duration_s: s of the recording
    :param packet_len: bytes of gr-ros2's packets; of `gr-ros2-plain` they are as long as a message needs
    :param match_s: s that both ends have to find each other
    :param drain_s: s that what is on its way has after the last message was published
    :param gap: samples between two frames
    :param seed: of the simulator, the losses and gr-ros2's sender
    """

    source: str = "sim"
    topic: str = ""
    peers: tuple[str, ...] = ()
    loss: Annotated[tuple[Share, ...], Field(min_length=1)] = (0.0, 0.05, 0.2)
    load: Annotated[tuple[Load, ...], Field(min_length=1)] = (0.5, 2.0)
    sample_rate: Seconds = 0.0
    duration_s: Annotated[float, Field(gt=0, le=3600)] = 15.0
    packet_len: PacketLen = 64
    gap: int = 112
    match_s: Seconds = 30.0
    drain_s: Seconds = 10.0
    seed: Annotated[int, Field(ge=0)] = 0


@plain_dataclass(frozen=True)
class RaceRecording:
    """What every contender carries: one topic of a bag.

    :param path: of the bag
    :param payloads: the messages, in order
    :param due: s after the first of them, of each
    """

    path: Path
    topic: str
    type_name: str
    payloads: tuple[bytes, ...]
    due: tuple[float, ...]

    @property
    def hz(self) -> float:
        """Messages/s, mean."""
        return (len(self.due) - 1) / self.due[-1]

    @property
    def largest(self) -> int:
        """Bytes of its largest message."""
        return max(map(len, self.payloads))

    @property
    def single_packet_len(self) -> int:
        """Bytes of a version 0 packet that holds any of its messages, as it is."""
        return min(V0.packed_len([self.largest]), V0.max_packet_len)


@plain_dataclass(frozen=True)
class Condition:
    """What all contenders meet alike."""

    load: float
    sample_rate: float
    loss: float


def check(settings: RaceSettings) -> None:
    """Find what is wrong with settings before anything is started.

    :raises ConfigError: naming it
    :raises BackendMissingError: when a contender is not installed
    """
    racing = chosen(settings.peers).values()
    if any(contender.stack == "zenoh" for contender in racing) and find_spec("zenoh") is None:
        raise BackendMissingError("zenoh is not installed: pip install eclipse-zenoh==1.10.2, or race other --peers")
    if settings.source != "sim" and not settings.source.removeprefix("bag:").strip():
        raise ConfigError(f"source = {settings.source!r}: the path of the bag is missing; write bag:PATH")
    if settings.source != "sim" and not settings.source.startswith("bag:"):
        raise ConfigError(f"source = {settings.source!r}: write sim or bag:PATH")
    PHY.load(PHY_NAME)(settings.packet_len, 1.0, **phy_options(settings))


def phy_options(settings: RaceSettings) -> dict[str, Any]:
    """Of the PHY, beside packet length and sample rate: GNU RaceRadio's own blocks, which take frames of any length."""
    return {"gap": settings.gap, "detection_threshold": "stock"}


def conditions(settings: RaceSettings, recording: RaceRecording) -> list[Condition]:
    """Every load with every loss, the lightest first."""
    phy: Phy = PHY.load(PHY_NAME)(recording.single_packet_len, 1.0, **phy_options(settings))
    needed = recording.hz * phy.airtime_samples()
    if settings.sample_rate:
        rates = {needed / settings.sample_rate: settings.sample_rate}
    else:
        rates = {load: needed / load for load in sorted(settings.load)}
    return [Condition(load, rate, loss) for load, rate in rates.items() for loss in sorted(settings.loss)]


def record_sim(folder: Path, settings: RaceSettings) -> Path:
    """Write the simulated robot's odometry as a bag.

    :param folder: where the bag goes
    """
    path = folder / "recording"
    fleet = Fleet(SimSettings(seed=settings.seed, robots=1, odom_rate=_SIM_HZ))
    with BagMiddleware(path=path, mode="write") as bag:
        publisher = bag.advertise(SIM_TOPIC, "nav_msgs/msg/Odometry", Qos())
        for message in fleet.messages(settings.duration_s, _SIM_START_NS * 1e-9):
            if message.topic == SIM_TOPIC:
                publisher.publish_at(message.payload, _SIM_START_NS + round(message.t * 1e9))  # type: ignore[attr-defined]
    return path


def read_recording(settings: RaceSettings, folder: Path) -> RaceRecording:
    """The recording of the race; that of the simulator is made first.

    :param folder: for the bag of the simulator
    :raises ConfigError: where it has no such topic, too little on it, or messages that do not fit
    :raises BagError: where it cannot be read
    """
    if settings.source == "sim":
        path = record_sim(folder, settings)
    else:
        path = Path(settings.source.removeprefix("bag:").strip()).expanduser()
    contents = bag_contents(path)
    found = {name: topic.info.type_name for name, topic in contents.topics.items()}
    topic = f"/{settings.topic.lstrip('/')}" if settings.topic else next(iter(found), "")
    if topic not in found or (len(found) > 1 and not settings.topic):
        has = "; ".join([", ".join(found) or "it has none", *contents.remarks])
        raise ConfigError(f"topic = {settings.topic!r}: name one that {path} has: {has}")
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
    return recording


def dump(settings: RaceSettings) -> dict[str, Any]:
    """As JSON values."""
    return asdict(settings)
