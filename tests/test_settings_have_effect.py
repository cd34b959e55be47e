"""Every row of docs/reference/parameters.md has an effect, or is refused where it has none.

``EFFECTS`` has an entry for every row: an experiment whose outcome the setting changes, or the test elsewhere in which
it does. A row without an entry fails, and so does an entry whose two outcomes are equal.
"""

from __future__ import annotations

import functools
import json
import random
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any

import pytest
from click.testing import CliRunner

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.cli.medium import medium
from gr_ros2.core.errors import ConfigError
from gr_ros2.gr.factory import make_endpoint
from gr_ros2.link.endpoint import LIVE_OPTIONS
from gr_ros2.link.v1.endpoint_settings import settings_of as end_settings
from gr_ros2.link.v1.sealing import NOT_A_REPAIR, Keys, SealMode
from gr_ros2.radio.ax25 import ui_header
from gr_ros2.radio.framing import Kiss
from gr_ros2.run.scenario import load_scenario
from gr_ros2.run.simulate import simulate
from gr_ros2.settings.config import DiagnosticsConfig, SinkConfig, SourceConfig, TopicOptions, build
from gr_ros2.settings.fields import AUTO, Setting, settings_of
from gr_ros2.settings.registry import Registry, Topic
from gr_ros2.sim.fleet import Fleet
from gr_ros2.sim.sim_settings import SimSettings
from tests.gr.test_health import make, parts
from tests.link.v1.air import Air, Robot, registry
from tests.radio.carried import addresses, carried

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


@functools.cache
def outcome(scenario: str, *settings: str) -> tuple[Any, ...]:
    """What a scenario sends in a simulated second, and what comes of it."""
    sent: list[bytes] = []
    words = ["duration_s=1", "seed=1", *settings]
    done = simulate(load_scenario(scenario, words), on_packet=lambda packet: sent.append(packet.data))
    topics = [(topic.topic, topic.ledger, topic.age_s.mean, topic.latency_s.max) for topic in done.topics]
    return sent, topics, done.duration_s, done.airtime_s, done.packets


def run(setting: str, *others: str, scenario: str = "six-topics-paced") -> Outcomes:
    """A scenario with some settings, without and with one more."""
    return lambda: (outcome(scenario, *others), outcome(scenario, *others, setting))


@functools.cache
def driven(**changed: Any) -> list[tuple[float, str, bytes]]:
    """What the simulated robots send in a second."""
    return [(m.t, m.topic, m.payload) for m in Fleet(SimSettings(**{"map_rate": 1.0, **changed})).messages(1.0)]


def drives(**changed: Any) -> Outcomes:
    """The simulated robots' messages, without and with a change."""
    return lambda: (driven(), driven(**changed))


def sealed() -> Outcomes:
    """A packet that is encrypted, and one that is only authenticated."""

    def close() -> tuple[bytes, bytes]:
        return sealed_as("encrypt"), sealed_as("authenticate")

    def sealed_as(mode: SealMode) -> bytes:
        return Keys((bytes(32),), mode).own(1, 1).close(b"head", b"body", 1, NOT_A_REPAIR)

    return close


def withheld(**sink: Any) -> list[bytes]:
    """Messages that are taken of sealed packets which somebody held back for 5 s."""
    take = end_settings(None, SinkConfig(robot_id=2, key="fleet.key", **sink), hears=True)
    one = Robot(1, registry(cmd_vel=TopicOptions(queue="deadline", deadline_s=1.0)), mode="encrypt")
    two = Robot(2, registry(), mode="encrypt", max_age_s=take.max_age_s, max_ages=take.max_ages)
    air = Air(one, two)
    air.run(2.0)
    air.lost = lambda sender, _: sender is one
    before = len(air.recorded)
    for number in range(10):
        one.end.messages.submit(0, b"late %d" % number, air.now)
        air.run(0.1)
    held = [data for sender, data in air.recorded[before:] if sender is one]
    air.robots = [two]
    air.run(5.0)
    for data in held:
        two.receive(data, air.now)
    return two.delivered()


class Elsewhere(str):
    """File with the test that shows the effect of the setting; it names it."""


class Hardware(str):
    """Why the effect of a setting shows only on a device."""


LOSSY, PAPER = "channel.packet_loss=0.2", ("version=0", "ros_source.topic_options={}")
OPTION = "ros_source.topic_options."
DRIVE = (
    f"source=bag:{REPOSITORY}/tests/data/simulated_drive",
    "ros_source.topics=[odom]",
    "ros_source.topic_options={}",
)
BURSTS = "channel.burst_loss={{p_good_to_bad: 0.1, p_bad_to_good: 0.3{}}}"

EFFECTS: dict[Row, Outcomes | Elsewhere | Hardware] = {}


def effects(section: str, **entries: Outcomes | Elsewhere | Hardware) -> None:
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
    max_age_s=lambda: (withheld(), withheld(topic_options={"cmd_vel": TopicOptions(max_age_s=2.0)})),
    codec=run(OPTION + "odom.codec=zstd"),
    to=Elsewhere("tests/link/v1/test_relaying.py"),
    keep_s=Elsewhere("tests/link/v1/test_latest_state.py"),
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
    seal=sealed(),
    state=Elsewhere("tests/radio/test_version1.py"),
    robot_id=run("ros_source.robot_id=7"),
    middleware=Elsewhere("tests/core/test_backends.py"),
    domain_id=Elsewhere("tests/gr/test_source.py"),
    commands=run("ros_source.commands=[]", OPTION + "cmd_vel={qos: auto}"),
    dictionaries=Elsewhere("tests/compression/test_link_codec.py"),
    topic_options=run(OPTION + "odom.max_rate=5"),
    debug=Elsewhere("tests/gr/test_source.py"),
    queue_depth=run("ros_source.queue_depth=2", OPTION + "odom={queue: fifo}"),
    topics=run("ros_source.topics=[odom, scan]"),
    services=Elsewhere("tests/radio/test_calls.py"),
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
    beacon_s=Elsewhere("tests/link/v1/test_commands.py"),
    expected_loss=run("ros_source.expected_loss=0.6", LOSSY, "ros_source.repair=thrifty", scenario="paper-ofdm-paced"),
)
effects(
    "ROS Sink",
    packet_len=run("packet_len=300"),
    registry=run("registry=odom.csv", "ros_source.topics=[odom]", OPTION[:-1] + "={}"),
    version=run("version=0", OPTION[:-1] + "={}"),
    key=Elsewhere("tests/radio/test_version1.py"),
    seal=sealed(),
    state=Elsewhere("tests/radio/test_version1.py"),
    robot_id=run("ros_sink.robot_id=9", "ros_source.dst_id=8"),
    middleware=Elsewhere("tests/core/test_backends.py"),
    domain_id=Elsewhere("tests/gr/test_sink.py"),
    dictionaries=Elsewhere("tests/compression/test_link_codec.py"),
    topic_options=Elsewhere("tests/gr/test_sink.py"),
    debug=Elsewhere("tests/gr/test_readable.py"),
    commands=Elsewhere("tests/link/v1/test_commands.py"),
    namespace_format=Elsewhere("tests/gr/test_sink.py"),
    publisher_depth=Elsewhere("tests/gr/test_sink.py"),
    reassembly_timeout_s=run("ros_sink.reassembly_timeout_s=0.05", *PAPER, LOSSY),
    max_age_s=lambda: (withheld(), withheld(max_age_s=2.0)),
    hold_s=run("ros_sink.hold_s=0.1", LOSSY, OPTION + "scan={queue: fifo}", "phy.sample_rate=400000"),
    max_sources=Elsewhere("tests/link/v0/test_receiver.py"),
    max_source_bytes=Elsewhere("tests/link/v1/test_endpoint.py"),
    max_bytes=Elsewhere("tests/link/v0/test_receiver.py"),
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
    rtcm_rate=drives(rtcm_rate=3.0),
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
    transforms=Elsewhere("tests/sim/test_transforms.py"),
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
    snr_db=Elsewhere("tests/phy/test_snr.py"),
    frequency_offset=Elsewhere("tests/phy/test_channel.py"),
    epsilon=Elsewhere("tests/phy/test_ofdm.py"),
    taps=Elsewhere("tests/phy/test_channel.py"),
    doppler_hz=Elsewhere("tests/phy/test_channel.py"),
)
effects(
    "Channel of a scenario",
    carrier_hz=Elsewhere("tests/medium/test_propagation.py"),
    decorrelation_m=Elsewhere("tests/medium/test_positions.py"),
    exponent=Elsewhere("tests/medium/test_propagation.py"),
    height_m=Elsewhere("tests/medium/test_propagation.py"),
    model=Elsewhere("tests/medium/test_propagation.py"),
    noise_figure_db=Elsewhere("tests/run/test_robots.py"),
    shadowing_db=Elsewhere("tests/medium/test_positions.py"),
    tx_power_dbm=Elsewhere("tests/medium/test_positions.py"),
    walls_db=Elsewhere("tests/medium/test_positions.py"),
    **{"from": Elsewhere("tests/medium/test_positions.py")},
)
effects(
    "PHY",
    name=run("phy.name=psk", "phy.options={}"),
    sample_rate=run("phy.sample_rate=200000"),
    headroom=run("phy.headroom=2", "phy.sample_rate=auto"),
    options=run("phy.options={payload_modulation: qpsk}", "phy.options={}"),
    kernels=Elsewhere("tests/phy/kernels/test_library.py"),
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
    task=Elsewhere("tests/run/test_task_run.py"),
    controller=Elsewhere("tests/run/test_task_run.py"),
    reports=run("reports={}", LOSSY),
    airtime=run("airtime=eu869.4"),
)
effects(
    "Airtime",
    band=run("airtime.band=eu868"),
    duty_cycle=run("airtime.duty_cycle=0.1"),
    window_s=run("airtime.window_s=10", "airtime.duty_cycle=0.1"),
    max_burst_s=run("airtime.max_burst_s=0.2"),
    listen_before_send=Elsewhere("tests/radio/test_radio.py"),
)
effects(
    "Reports",
    channel=run("reports={channel: {packet_loss: 0.6}}", LOSSY, "reports={}"),
    delay_s=run("reports={delay_s: 0.3}", LOSSY, "reports={}"),
)


BOTH_ENDS = {
    name: EFFECTS["ROS Source", name] for name in ("packet_len", "registry", "version", "key", "seal", "state")
}
LOCAL = Elsewhere("tests/middleware/test_dds.py")
effects(
    "Scenario",
    name=Elsewhere("tests/run/test_scenario.py"),
    key=BOTH_ENDS["key"],
    seal=BOTH_ENDS["seal"],
    state=BOTH_ENDS["state"],
    localhost_only=LOCAL,
    own_domains=Elsewhere("tests/run/test_domains.py"),
    description=Elsewhere("tests/run/test_scenario.py"),
    repetitions=Elsewhere("tests/run/test_repeat.py"),
    time=Elsewhere("tests/run/test_simulated_runner.py"),
    bag_speed=run("bag_speed=2", *DRIVE),
    back=Elsewhere("tests/run/test_scenario.py"),
    receivers=Elsewhere("tests/run/test_version1.py"),
)
for part in ("channel", "ros_source", "ros_sink"):
    EFFECTS["Reverse direction", part] = Elsewhere("tests/run/test_scenario.py")
effects("Scenario", **dict.fromkeys(("robots", "duplex", "gains_db"), Elsewhere("tests/run/test_robots.py")))
effects(
    "Scenario",
    medium=Elsewhere("tests/run/test_medium_access.py"),
    relay=Elsewhere("tests/run/test_relaying.py"),
)
effects(
    "Robot",
    ros_source=run("robots=[{ros_source: {repair: 'off'}}, {}]", scenario="two-robots-half-duplex"),
    tx_power_dbm=Elsewhere("tests/run/test_robots.py"),
    noise_figure_db=Elsewhere("tests/run/test_robots.py"),
)
effects(
    "Link",
    **BOTH_ENDS,
    name=Elsewhere("tests/radio/test_version1.py"),
    channel=Elsewhere("tests/radio/test_radio.py"),
    ros_source=EFFECTS["Scenario", "ros_source"],
    ros_sink=EFFECTS["Scenario", "ros_sink"],
    phy=EFFECTS["Scenario", "phy"],
    airtime=EFFECTS["Scenario", "airtime"],
    medium=Elsewhere("tests/radio/test_slots.py"),
    relay=Elsewhere("tests/radio/test_slots.py"),
    localhost_only=LOCAL,
    front_end=Elsewhere("tests/radio/test_devices.py"),
    transmit=Elsewhere("tests/radio/test_permission.py"),
    open=Elsewhere("tests/radio/test_permission.py"),
    record=Elsewhere("tests/radio/test_radio.py"),
    diagnostics=Elsewhere("tests/radio/test_diagnostics.py"),
)


def crosses(*robots: dict[str, Any], beside: Mapping[str, Any] = MappingProxyType({}), **changed: Any) -> Outcomes:
    """What a medium process makes of a burst, without and with a change."""
    return lambda: (carried(**beside), carried(*robots, **{**beside, **changed}))


def called(name: str) -> str:
    """What `gr-ros2 medium` says first."""
    with TemporaryDirectory() as folder:
        robots = [{"connect": f"ipc://{folder}/robot{n}", "bind": f"ipc://{folder}/medium{n}"} for n in (1, 2)]
        config = {"name": name, "phy": {"name": "psk", "sample_rate": 2e6}, "robots": robots}
        (Path(folder) / "air.yaml").write_text(json.dumps(config))
        return CliRunner().invoke(medium, [f"{folder}/air.yaml", "--duration", "0.001"]).output


HERE, THERE, AWAY = ({"position": [x, 0.0]} for x in (0.0, 9.0, 90.0))
GAINS, PLACED = {"gains_db": -90.0}, {"channel": {"from": "positions"}}
effects(
    "Medium",
    name=lambda: (called("air"), called("hall")),
    phy=crosses(phy={"name": "psk", "sample_rate": 1e6}),
    packet_len=crosses(packet_len=200),
    robots=crosses({}, {}, {}),
    gains_db=crosses(gains_db=-90.0),
    channel=crosses(channel={"snr_db": 3.0}),
    time=crosses(time="real"),
    seed=crosses(seed=3, beside={"channel": {"snr_db": 3.0}}),
)
effects(
    "Robot of a medium",
    tx_power_dbm=crosses({"tx_power_dbm": 3.0}, {}, beside=GAINS),
    noise_figure_db=crosses({}, {"noise_figure_db": 3.0}, beside=GAINS),
    connect=lambda: (addresses(), addresses(connect="ipc://{}/elsewhere")),
    bind=lambda: (addresses(), addresses(bind="ipc://{}/elsewhere")),
    position=lambda: (carried(HERE, THERE, **PLACED), carried(HERE, AWAY, **PLACED)),
)


def judged(limit: str) -> Outcomes:
    """What is said of a poor link without any limit, and with this one."""

    def said(**limits: float) -> list[Any]:
        health = make(
            **{item.name: 0.0 for item in fields(DiagnosticsConfig) if "_warn" in item.name or "_error" in item.name}
            | limits
        )
        parts(health, 0.0)
        poor = {
            "packets": 60,
            "missing": 40,
            "delivered": 60,
            "lost": 40,
            "latency": 1.5,
            "age": 2.0,
            "queued": 9,
            "depth": 10,
        }
        return [(part.level, part.message) for now in (1.0, 60.0) for part in parts(health, now, **poor)]

    return lambda: (said(), said(**{limit: 0.1}))


for item in fields(DiagnosticsConfig):
    EFFECTS["Diagnostics", item.name] = judged(item.name)
effects(
    "Diagnostics",
    period_s=Elsewhere("tests/radio/test_diagnostics.py"),
    window_s=Elsewhere("tests/gr/test_health.py"),
)


def elsewhere(section: str, **tests: str) -> None:
    """Entries of a section by the file that shows them: names of settings, with spaces between them."""
    for file, names in tests.items():
        folder, _, test = file.partition("_")
        effects(section, **dict.fromkeys(names.split(), Elsewhere(f"tests/{folder}/test_{test}.py")))


elsewhere(
    "Sweep",
    study_sweep_definition="description repetitions scenario grid x by value list",
    study_sweep_run="time",
    study_sweep_summaries="set y topic",
)
elsewhere("Race", race_race_settings="robots source duration_s packet_len sample_rate bag_topic peers loss load")
for name in ("match_s", "drain_s", "seed"):
    EFFECTS["Race", name] = Hardware("a race needs root: two network namespaces")
elsewhere(
    "PHY `ofdm`",
    phy_ofdm="gap lengths fec payload_modulation fft_len carriers pilots scramble detection_threshold",
    phy_ofdm_rate="cp_len rate rates",
)
elsewhere("PHY `gfsk`", phy_contract="gap lengths", phy_burst="fec sps bt")
elsewhere("PHY `psk`", phy_contract="gap lengths", phy_burst="fec sps rolloff", phy_snr="modulation")
elsewhere(
    "PHY `lora`",
    phy_lora_sdr="gap fec spreading_factor coding_rate implementation oversampling sync_word ldro carrier_hz",
    phy_contract="lengths",
)
elsewhere(
    "PHY `wifi`", phy_wifi="gap encoding equalizer sensitivity network address channel_hz", phy_contract="lengths"
)
elsewhere("PHY `modem`", phy_modem="bit_rate overhead_bytes overhead_s")
for name in ("sim", "zmq", "file", "soapy", "uhd", "pluto", "kiss", "serial", "udp"):
    elsewhere(f"Front end `{name}`", radio_devices="guard_s")
elsewhere("Front end `zmq`", radio_zmq="bind connect burst_queue", radio_medium="medium_process")
elsewhere("Front end `file`", radio_file="write read speed repeat")
for name in ("soapy", "uhd"):
    elsewhere(
        f"Front end `{name}`",
        radio_devices="half_duplex frequency args frequency_rx gain_tx gain_rx antenna_tx antenna_rx bandwidth level "
        "turnaround_s",
        radio_bursts="lead tail multiple",
    )
effects(
    "Front end `uhd`",
    **dict.fromkeys(("clock_source", "subdev_tx", "subdev_rx"), Hardware("gr-uhd hands them to a USRP as they are")),
)
elsewhere(
    "Front end `pluto`",
    radio_pluto="frequency args frequency_rx gain_tx gain_rx bandwidth",
    radio_devices="half_duplex level turnaround_s antenna_tx antenna_rx",
    radio_bursts="lead tail multiple",
)
EFFECTS["Front end `pluto`", "buffer_rx"] = Hardware("gr-iio hands it to a Pluto as it is")
for name in ("kiss", "serial", "udp"):
    elsewhere(f"Front end `{name}`", radio_devices="half_duplex")
elsewhere("Front end `kiss`", radio_modems="device baud callsign", radio_packet_radios="backoff_s")
effects(
    "Front end `kiss`",
    destination=lambda: (ui_header("GRROS2", "AA1AA"), ui_header("OTHERS", "AA1AA")),
    tnc_port=lambda: (Kiss(64, Counter(), port=0).frame(b"x"), Kiss(64, Counter(), port=1).frame(b"x")),
)
elsewhere("Front end `serial`", radio_modems="device baud framing", radio_packet_radios="rssi backoff_s")
elsewhere("Front end `udp`", radio_modems="listen send_to")


def test_every_row_of_the_page_has_an_entry() -> None:
    found = list(rows())
    assert len(found) > 250
    assert [row for row in found if row not in EFFECTS] == [], "a new setting needs an experiment that shows its effect"
    assert [row for row in EFFECTS if row not in found] == []


@pytest.mark.parametrize("row", [row for row, entry in EFFECTS.items() if isinstance(entry, Elsewhere)], ids=": ".join)
def test_a_test_elsewhere_names_the_setting(row: Row) -> None:
    text = (REPOSITORY / str(EFFECTS[row])).read_text(encoding="utf-8")
    assert re.search(rf"\b(set_)?{row[1]}\b", text)


@pytest.mark.parametrize(
    "row", [row for row, entry in EFFECTS.items() if not isinstance(entry, Elsewhere | Hardware)], ids=": ".join
)
def test_a_setting_has_an_effect(row: Row) -> None:
    entry = EFFECTS[row]
    assert not isinstance(entry, Elsewhere | Hardware)
    without, with_it = entry()
    assert without != with_it


def other(setting: Setting) -> Any:
    """A value that is not the default."""
    if setting.name in ("key", "state"):
        return "somewhere"
    if setting.name == "to":
        return 7
    if isinstance(setting.default, bool):
        return not setting.default
    if isinstance(setting.default, tuple | dict):
        return type(setting.default)()
    if setting.kinds == (str,):
        return "other"
    choices = [choice for choice in setting.choices if choice not in (setting.default, AUTO)]
    if choices:
        return choices[0]
    if setting.default == AUTO and setting.kinds == (int,):
        return 3
    return 0.5 if setting.default == AUTO or setting.below is not None else setting.default + 1


OF_ONE_VERSION = [
    (cls, setting)
    for cls in (SourceConfig, SinkConfig, TopicOptions)
    for setting in settings_of(cls)
    if setting.version is not None
]


@pytest.mark.parametrize(("cls", "setting"), OF_ONE_VERSION, ids=lambda one: getattr(one, "name", ""))
def test_a_version_refuses_what_only_the_other_one_has(cls: type[Any], setting: Setting) -> None:
    assert setting.version is not None
    version, value = 1 - setting.version, {setting.name: other(setting)}
    said = f"{setting.name} = {other(setting)!r}: version {version} has no such setting; leave it out, or set version"
    if cls is TopicOptions:
        with pytest.raises(ConfigError, match=re.escape(f"topic_options.odom.{said}")):
            build(SourceConfig, {"version": version, "topic_options": {"odom": value}})
        row = Topic(0, "odom", "nav_msgs/msg/Odometry", build(TopicOptions, value))
        with pytest.raises(ConfigError, match=re.escape(f"registry: topic odom: {said}")):
            make_endpoint(Registry([row]), SourceConfig(version=version, robot_id=1), None)
    else:
        with pytest.raises(ConfigError, match=re.escape(said)):
            build(cls, {"version": version, **value})
    build(cls, {setting.name: setting.default})


@pytest.mark.parametrize("version", [0, 1])
def test_a_running_link_refuses_what_cannot_change(version: int) -> None:
    rows = Registry.from_rows({"odom": "nav_msgs/Odometry"})
    end = make_endpoint(rows, SourceConfig(version=version, robot_id=1), None)
    for setting in settings_of(SourceConfig):
        if setting.name == "dst_id" and version:
            with pytest.raises(ConfigError, match="dst_id = 7: another destination needs a restart of the link"):
                end.reconfigure(dst_id=7)
        elif setting.name not in end.live_settings:
            said = f"{setting.name} cannot change while running; these can: {', '.join(end.live_settings)}"
            with pytest.raises(ConfigError, match=re.escape(said)):
                end.reconfigure(**{setting.name: other(setting)})
    for option in settings_of(TopicOptions):
        if option.name not in end.live_options:
            changed = replace(rows[0].options, **{option.name: other(option)})
            with pytest.raises(
                ConfigError, match=f"topic odom: ({option.name} cannot|with version 0, its options) change"
            ):
                end.messages.change(0, changed)


def says(version: int, **changes: Any) -> list[Any]:
    """What an end sends for 3 s, of which a setting changes in the first: packets with their times, and queues."""
    options = TopicOptions(durability="transient_local", queue="fifo" if version else AUTO)
    rows = Registry([Topic(0, "odom", "nav_msgs/msg/Odometry", options)])
    end = make_endpoint(
        rows, SourceConfig(version=version, robot_id=1, packet_rate=20.0, repeat_s=1.0), None, rng=random.Random(1)
    )
    sent: list[Any] = []
    for step in range(300):
        now = step * 0.01
        if step == 20:
            end.reconfigure(**changes)
        if step < 50 and step % 2 == 0:
            end.messages.submit(0, b"message %d" % step * 20, now)
        while (packet := end.next_packet(now)) is not None:
            sent.append((now, packet.data))
    return [*sent, dict(end.sent.refused)]


LIVE = {"packet_rate": 50.0, "dst_id": 7, "repeat_s": 0.3, "queue_depth": 3}


@pytest.mark.parametrize("version", [0, 1])
def test_what_can_change_while_a_link_runs_has_its_effect_then(version: int) -> None:
    end = make_endpoint(
        Registry.from_rows({"odom": "nav_msgs/Odometry"}), SourceConfig(version=version, robot_id=1), None
    )
    same = says(version)
    assert says(version) == same
    for name in end.live_settings:
        assert says(version, **{name: LIVE[name]}) != same, name
    assert len(says(version, repeat_s=0.0)) < len(same), "0 is off"


CHANGED: dict[str, tuple[dict[str, Any], Any]] = {
    "to": ({}, 3),
    "qos": ({}, "bulk"),
    "queue": ({}, "latest"),
    "queue_depth": ({}, 2),
    "deadline_s": ({"queue": "deadline", "deadline_s": 2.0}, 0.1),
    "weight": ({"queue": "latest"}, 50.0),
    "max_rate": ({"queue": "latest"}, 2.0),
    "keep_s": ({}, 5.0),
}
"""Options of a topic that runs, and the value that one takes."""


def optioned(base: Mapping[str, Any], **changed: Any) -> list[bytes]:
    """What an end sends of two topics that want more than there is, of which the options of one change."""
    options = TopicOptions(**{"queue": "fifo", **base})
    rows = Registry([Topic(n, name, "a_msgs/msg/B", options) for n, name in enumerate(("goal", "scan"))])
    config = SourceConfig(robot_id=1, packet_rate=20.0, repeat_s=0.5, compression=False)
    end = make_endpoint(rows, config, None)
    sent, topic_id = [], 0
    for step in range(300):
        now = step * 0.01
        if step == 20:
            topic_id = end.messages.change(0, replace(options, **changed))[1].topic_id
        if step < 200 and step % 10 == 0:
            for topic in (topic_id, 1):
                end.messages.submit(topic, b"message %3d of %d" % (step, topic) * 12, now)
        while (packet := end.next_packet(now)) is not None:
            sent.append(packet.data)
    return sent


@pytest.mark.parametrize("option", LIVE_OPTIONS)
def test_an_option_that_can_change_has_its_effect_then(option: str) -> None:
    base, value = CHANGED[option]
    assert optioned(base) == optioned(base)
    assert optioned(base, **{option: value}) != optioned(base)


OF_A_GRAPH = {
    "ros_source.middleware": "memory",
    "ros_source.domain_id": 3,
    "ros_source.subscriber_depth": 3,
    "ros_source.backpressure": True,
    "ros_source.debug": True,
    "ros_sink.middleware": "memory",
    "ros_sink.domain_id": 3,
    "ros_sink.publisher_depth": 3,
    "ros_sink.debug": True,
    "ros_sink.use_sim_time": True,
    "localhost_only": False,
    "own_domains": False,
    "sim.transforms": True,
}
"""Settings of ROS graphs, which a run in simulated time has not. They are taken all the same: a scenario is run in real
and in simulated time, and planned, as it is. The page says so (`time`)."""


@pytest.mark.parametrize("setting", OF_A_GRAPH)
def test_simulated_time_takes_the_settings_of_a_graph_that_it_has_not(setting: str) -> None:
    assert outcome("six-topics-paced") == outcome("six-topics-paced", f"{setting}={json.dumps(OF_A_GRAPH[setting])}")


def test_a_recording_takes_the_settings_of_the_simulator() -> None:
    """A scenario keeps its ``sim`` where ``--set source=bag:PATH`` puts a recording in its place."""
    assert outcome("six-topics-paced", *DRIVE) == outcome("six-topics-paced", *DRIVE, "sim={robots: 5, seed: 7}")


def test_a_seal_needs_a_key_and_a_shared_setting_is_refused_once() -> None:
    with pytest.raises(ConfigError, match="seal = 'authenticate': nothing is sealed without a key; set key"):
        build(SourceConfig, {"seal": "authenticate"})
    with pytest.raises(ConfigError) as error:
        load_scenario("paper-direct", ["key=fleet.key"])
    assert str(error.value).count("version 0 has no such setting") == 1
