"""Every row of docs/reference/parameters.md has an effect, or is refused where it has none.

``EFFECTS`` has an entry for every row: an experiment whose outcome the setting changes, or the test elsewhere in which
it does. A row without an entry fails, and so does an entry whose two outcomes are equal.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.run.scenario import load_scenario
from gr_ros2.run.simulate import simulate
from gr_ros2.sim.fleet import Fleet
from gr_ros2.sim.sim_settings import SimSettings

REPOSITORY = Path(__file__).resolve().parent.parent
PAGE = REPOSITORY / "docs" / "reference" / "parameters.md"

Row = tuple[str, str]
"""A section of the page, and the name of a setting."""
Outcomes = Callable[[], tuple[Any, Any]]
"""What comes out without and with the setting."""


def rows() -> Iterator[Row]:
    """The rows of the page, without its tables of back-ends."""
    section = ""
    for line in PAGE.read_text(encoding="utf-8").partition("\n## Back-ends")[0].splitlines():
        if line.startswith("## "):
            section = line.removeprefix("## ")
        elif found := re.match(r"\| `(\w+)` \|", line):
            yield section, found[1]


def outcome(scenario: str, *settings: str) -> tuple[Any, ...]:
    """What a scenario sends in two simulated seconds, and what comes of it."""
    sent: list[bytes] = []
    words = ["duration_s=2", "seed=1", *settings]
    done = simulate(load_scenario(scenario, words), on_packet=lambda packet: sent.append(packet.data))
    topics = [(topic.topic, topic.ledger, topic.age_s.mean, topic.latency_s.max) for topic in done.topics]
    return sent, topics, done.duration_s, done.airtime_s, done.packets


def run(setting: str, *others: str, scenario: str = "six-topics-paced") -> Outcomes:
    """A scenario with some settings, without and with one more."""
    return lambda: (outcome(scenario, *others), outcome(scenario, *others, setting))


def drives(**changed: Any) -> Outcomes:
    """The simulated robots' messages, without and with a change."""
    return lambda: tuple(
        [(m.t, m.topic, m.payload) for m in Fleet(SimSettings(**{"map_rate": 1.0, **values})).messages(1.0)]
        for values in ({}, changed)
    )  # type: ignore[return-value]


class Elsewhere(str):
    """File of a test that shows the effect of the setting, and names it."""


LOSSY, PAPER = "channel.packet_loss=0.2", ("version=0", "ros_source.topic_options={}")
OPTION = "ros_source.topic_options."
BURSTS = "channel.burst_loss={{p_good_to_bad: 0.1, p_bad_to_good: 0.3{}}}"

EFFECTS: dict[Row, Outcomes | Elsewhere] = {}


def effects(section: str, **entries: Outcomes | Elsewhere) -> None:
    """Add the entries of a section."""
    EFFECTS.update({(section, name): entry for name, entry in entries.items()})


effects(
    "Topic options",
    queue_depth=run(OPTION + "odom={queue: fifo, queue_depth: 2}", OPTION + "odom={queue: fifo}"),
    qos=run(OPTION + "scan.qos=bulk"),
    queue=run(OPTION + "odom.queue=fifo"),
    deadline_s=run(OPTION + "scan.deadline_s=0.2"),
    weight=run(OPTION + "odom.weight=1"),
    max_rate=run(OPTION + "odom.max_rate=5"),
    codec=run(OPTION + "odom.codec=zstd"),
    quantize=run(OPTION + "odom.quantize=pose.pose.position=0.1"),
    depth=run(OPTION + "odom.depth=1", OPTION + "odom={queue: auto}"),
    reliability=run(OPTION + "odom.reliability=best_effort", LOSSY, "reports={}", scenario="paper-ofdm-paced"),
    durability=run(OPTION + "odom.durability=transient_local", "ros_source.repeat_s=0.5"),
    publish_as=Elsewhere("tests/gr/test_sink.py"),
)
effects(
    "ROS Source",
    packet_len=run("packet_len=300"),
    registry=run("registry=odom.csv", "ros_source.topics=[odom]", OPTION[:-1] + "={}"),
    version=run("version=0", OPTION[:-1] + "={}"),
    key=Elsewhere("tests/radio/test_version1.py"),
    seal=Elsewhere("tests/link/v1/test_sealing.py"),
    state=Elsewhere("tests/gr/test_ends.py"),
    robot_id=run("ros_source.robot_id=7"),
    middleware=Elsewhere("tests/test_backends.py"),
    domain_id=Elsewhere("tests/gr/test_source.py"),
    dictionaries=Elsewhere("tests/compression/test_dictionary.py"),
    topic_options=run(OPTION + "odom.max_rate=5"),
    debug=Elsewhere("tests/gr/test_source.py"),
    queue_depth=run("ros_source.queue_depth=2", OPTION + "odom={queue: fifo}"),
    topics=run("ros_source.topics=[odom, scan]"),
    services=Elsewhere("tests/gr/test_topic_search.py"),
    namespace=run("ros_source.namespace=/robot_2"),
    dst_id=run("ros_source.dst_id=9"),
    min_fragment=run("ros_source.min_fragment=150", *PAPER),
    greedy=run("ros_source.greedy=true", *PAPER),
    flush_timeout_s=run("ros_source.flush_timeout_s=0.2", *PAPER),
    subscriber_depth=Elsewhere("tests/gr/test_source.py"),
    hop=run("ros_source.hop=3", *PAPER),
    packet_rate=run("ros_source.packet_rate=10"),
    backpressure=Elsewhere("tests/gr/test_source.py"),
    entry_ids=run("ros_source.entry_ids=random", *PAPER),
    repeat_s=run("ros_source.repeat_s=0.5"),
    compression=run("ros_source.compression=false"),
    repair=run("ros_source.repair='off'", scenario="paper-ofdm-paced"),
    expected_loss=run("ros_source.expected_loss=0.6", LOSSY, "ros_source.repair=thrifty", scenario="paper-ofdm-paced"),
)
effects(
    "ROS Sink",
    packet_len=run("packet_len=300"),
    registry=run("registry=odom.csv", "ros_source.topics=[odom]", OPTION[:-1] + "={}"),
    version=run("version=0", OPTION[:-1] + "={}"),
    key=Elsewhere("tests/radio/test_version1.py"),
    seal=Elsewhere("tests/link/v1/test_sealing.py"),
    state=Elsewhere("tests/gr/test_ends.py"),
    robot_id=run("ros_sink.robot_id=9", "ros_source.dst_id=8"),
    middleware=Elsewhere("tests/test_backends.py"),
    domain_id=Elsewhere("tests/gr/test_sink.py"),
    dictionaries=Elsewhere("tests/compression/test_dictionary.py"),
    topic_options=Elsewhere("tests/gr/test_sink.py"),
    debug=Elsewhere("tests/gr/test_sink.py"),
    namespace_format=Elsewhere("tests/gr/test_sink.py"),
    publisher_depth=Elsewhere("tests/gr/test_sink.py"),
    reassembly_timeout_s=run("ros_sink.reassembly_timeout_s=0.05", *PAPER, LOSSY),
    hold_s=run("ros_sink.hold_s=0.1", LOSSY, OPTION + "scan={queue: fifo}", "phy.sample_rate=400000"),
    max_sources=Elsewhere("tests/link/test_receiver.py"),
    max_source_bytes=Elsewhere("tests/link/v1/test_endpoint.py"),
    max_bytes=Elsewhere("tests/link/test_receiver.py"),
    use_sim_time=Elsewhere("tests/gr/test_sink.py"),
    frame_prefix=Elsewhere("tests/gr/test_sink.py"),
    merge_tf=Elsewhere("tests/gr/test_frame_ids.py"),
)
effects(
    "Simulator",
    seed=drives(seed=3),
    robots=drives(robots=3),
    size_m=drives(size_m=30.0),
    obstacles=drives(obstacles=3),
    max_speed=drives(max_speed=0.5),
    scan_rate=drives(scan_rate=7.0),
    odom_rate=drives(odom_rate=20.0),
    imu_rate=drives(imu_rate=20.0),
    cmd_vel_rate=drives(cmd_vel_rate=5.0),
    clock_rate=drives(clock_rate=5.0),
    map_rate=drives(map_rate=3.0),
    beams=drives(beams=90),
    scan_range=drives(scan_range=3.0),
    map_cells=drives(map_cells=50),
    scan_noise=drives(scan_noise=0.2),
    odom_linear_noise=drives(odom_linear_noise=0.2),
    odom_angular_noise=drives(odom_angular_noise=0.2),
    imu_gyro_noise=drives(imu_gyro_noise=0.2),
    imu_accel_noise=drives(imu_accel_noise=0.5),
    imu_orientation_noise=drives(imu_orientation_noise=0.2),
    start_time_s=drives(start_time_s=1000.0),
    prefix_frames=drives(prefix_frames=True),
    transforms=Elsewhere("tests/sim/test_fleet.py"),
)
effects(
    "Losses in bursts",
    p_good_to_bad=run(BURSTS.format("").replace("0.1", "0.3"), BURSTS.format("")),
    p_bad_to_good=run(BURSTS.format("").replace("0.3", "0.9"), BURSTS.format("")),
    loss_good=run(BURSTS.format(", loss_good: 0.3"), BURSTS.format("")),
    loss_bad=run(BURSTS.format(", loss_bad: 0.3"), BURSTS.format("")),
)
effects(
    "Channel",
    seed=run("channel.seed=7", LOSSY),
    packet_loss=run(LOSSY),
    burst_loss=run(BURSTS.format("")),
    outages=run("channel.outages=[[0.5, 1]]"),
    **{name: Elsewhere("tests/run/test_channels.py") for name in ("snr_db", "frequency_offset", "epsilon", "taps")},
    doppler_hz=Elsewhere("tests/phy/test_channel.py"),
)
effects(
    "PHY",
    name=run("phy.name=psk", "phy.options={}"),
    sample_rate=run("phy.sample_rate=200000"),
    headroom=run("phy.headroom=2", "phy.sample_rate=auto"),
    options=run("phy.options={payload_modulation: qpsk}", "phy.options={}"),
    kernels=Elsewhere("tests/phy/test_kernels_choice.py"),
)
effects(
    "Scenario",
    packet_len=run("packet_len=300"),
    registry=run("registry=odom.csv", "ros_source.topics=[odom]", OPTION[:-1] + "={}"),
    version=run("version=0", OPTION[:-1] + "={}"),
    channel=run(LOSSY),
    ros_source=run("ros_source.packet_rate=10"),
    ros_sink=run("ros_sink.robot_id=9", "ros_source.dst_id=8"),
    phy=run("phy.sample_rate=200000"),
    seed=run("seed=4"),
    source=Elsewhere("tests/run/test_replay.py"),
    duration_s=run("duration_s=3"),
    drain_s=run("drain_s=0", "ros_source.packet_rate=0"),
    sim=run("sim.odom_rate=20"),
    reports=run("reports={}", LOSSY),
)
effects(
    "Reports",
    channel=run("reports={channel: {packet_loss: 0.6}}", LOSSY, "reports={}"),
    delay_s=run("reports={delay_s: 0.3}", LOSSY, "reports={}"),
)


@pytest.mark.parametrize(
    "row", [row for row, entry in EFFECTS.items() if not isinstance(entry, Elsewhere)], ids=": ".join
)
def test_a_setting_has_an_effect(row: Row) -> None:
    entry = EFFECTS[row]
    assert not isinstance(entry, Elsewhere)
    without, with_it = entry()
    assert without != with_it
