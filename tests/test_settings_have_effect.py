"""Every row of docs/reference/parameters.md has an effect.

``EFFECTS`` has an entry for every row: an experiment whose outcome the setting changes; or the test elsewhere that
shows its effect, where that takes processes, real time or a module that few machines have. A row without an entry
fails, and so does an entry whose two outcomes are equal, and one whose test is not there or does not name the setting.
"""

from __future__ import annotations

import ast
import functools
import json
import random
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any

import pytest
from click.testing import CliRunner

from gr_ros2.codecs.messages import CLOUD
from gr_ros2.core.errors import ConfigError
from gr_ros2.gr.factory import Start, make_endpoint
from gr_ros2.link.air import Air as RadioFacts
from gr_ros2.link.endpoint import LIVE_OPTIONS, Endpoint, OpenEndpoint
from gr_ros2.link.v1.endpoint import EndpointV1
from gr_ros2.link.v1.endpoint_settings import end_settings
from gr_ros2.link.v1.sealing import NOT_A_REPAIR, Keys, SealMode
from gr_ros2.paper.endpoint import EndpointV0
from gr_ros2.paper.factory import make_paper_endpoint
from gr_ros2.paper.settings import PaperConfig, check, check_rows
from gr_ros2.phy.wifi_frames import DataFrames
from gr_ros2.settings.config import (
    CameraOptions,
    CloudOptions,
    DepthOptions,
    DiagnosticsConfig,
    SendOptions,
    build,
)
from gr_ros2.settings.fields import AUTO, Setting, settings_of
from gr_ros2.settings.registry import PICTURES, Registry, Topic
from gr_ros2.settings.robot import PublishOptions, RobotConfig, robot_from
from gr_ros2_lab.cli.medium import medium
from gr_ros2_lab.race.contenders import chosen
from gr_ros2_lab.run.scenario import load_scenario
from gr_ros2_lab.run.simulate import simulate
from gr_ros2_lab.sim.fleet import Fleet
from gr_ros2_lab.sim.sim_settings import SimSettings
from tests.codecs import scenes
from tests.experiments import (
    GRAPH,
    drawn,
    guarded,
    heard,
    impaired,
    kept,
    lasting,
    levels,
    linked,
    prepared,
    printed,
    published,
    raced,
    rates,
    reached,
    replayed,
    sent,
    wifi,
)
from tests.gr.test_health import make, parts
from tests.link.v1.air import Air, Robot, registry
from tests.radio.carried import addresses, carried
from tests.radio.opened import opened

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
        elif line.startswith("As in ["):
            yield from ((section, name) for name in re.findall(r"`(\w+)`", line.partition("): ")[2]))
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


def withheld(**settings: Any) -> list[bytes]:
    """Messages that are taken of sealed packets which somebody held back for 5 s."""
    take = end_settings(robot_from(robot=2, key="fleet.key", **settings), RadioFacts())
    one = Robot(1, registry(cmd_vel=SendOptions(queue="deadline", deadline_s=1.0)), mode="encrypt")
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
    """The test that shows the effect of the setting, ``file::function`` below this folder; it names the setting."""


def differs(experiment: Callable[..., Any], *beside: str, **changed: Any) -> Outcomes:
    """The outcome of an experiment without and with a change."""
    return lambda: (experiment(*beside), experiment(*beside, **changed))


def impairs(**changed: Any) -> Outcomes:
    """Samples after a channel that does nothing, and after one with a change."""
    return differs(impaired, **changed)


def reaches(setting: str, *others: str) -> Outcomes:
    """Levels that follow from positions, without and with a setting of the channel."""
    base = ("from=positions", *others)
    return lambda: (levels(*base), levels(*base, setting))


def sends(phy: str, beside: Mapping[str, Any] = MappingProxyType({}), **changed: Any) -> Outcomes:
    """The samples of a PHY, without and with a change."""
    return lambda: (sent(phy, **beside), sent(phy, **beside, **changed))


def sweeps(beside: Mapping[str, Any] = MappingProxyType({}), **changed: Any) -> Outcomes:
    """What a sweep runs and draws, without and with a change."""
    return lambda: (drawn(**beside), drawn(**beside, **changed))


LINE = "gains_db=[[-100, -100, null], [-100, -100, -100], [null, -100, -100]]"


LOSSY, PAPER, REPORTING = "channel.packet_loss=0.2", ("paper={}", "topics=auto"), "robots=[{}, {topics: []}]"
OPTION = "topics."
DRIVE = (
    f"source=bag:{REPOSITORY}/tests/data/simulated_drive",
    "topics=[odom]",
)
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
    to=run(OPTION + "odom.to=3"),
    keep_s=Elsewhere("link/v1/test_latest_state.py::test_keep_s_says_how_long_a_robot_out_of_range_can_still_get_it"),
    quantize=run(OPTION + "odom.quantize=pose.pose.position=0.1"),
    instance=Elsewhere(
        "link/v1/test_instances.py::test_of_a_type_whose_instances_are_not_told_apart_the_newest_message_is_sent"
    ),
    camera=Elsewhere("codecs/test_frames.py::test_the_options_of_a_camera_say_what_comes_out"),
    depth_image=Elsewhere("codecs/test_frames.py::test_depth_comes_out_as_depth"),
    cloud=Elsewhere("codecs/test_whole.py::test_cells_come_out_as_they_were_said_to"),
    via=Elsewhere("radio/test_two_radios.py::test_via_says_what_leaves_over_all_radios"),
    depth=run(OPTION + "odom.depth=1", OPTION + "odom={queue: auto}"),
    reliability=run(OPTION + "odom.reliability=best_effort", LOSSY, REPORTING, scenario="paper-ofdm-paced"),
    durability=run(OPTION + "odom.durability=transient_local", "repeat_s=0.5"),
)
effects(
    "Cameras",
    **{
        name: Elsewhere("codecs/test_frames.py::test_the_options_of_a_camera_say_what_comes_out")
        for name in ("off", "size", "fps", "output")
    },
)
effects(
    "Depth images",
    **{
        name: Elsewhere("codecs/test_frames.py::test_depth_comes_out_as_depth")
        for name in ("off", "mode", "near", "far")
    },
)
effects(
    "Clouds",
    voxel=Elsewhere("codecs/test_whole.py::test_cells_come_out_as_they_were_said_to"),
    range=Elsewhere("codecs/test_whole.py::test_range_and_keep_say_what_of_a_cloud_leaves"),
    keep=Elsewhere("codecs/test_whole.py::test_range_and_keep_say_what_of_a_cloud_leaves"),
    fit=Elsewhere("codecs/test_cloud_frames.py::test_cells_are_as_small_as_the_air_allows"),
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
    map_rate=drives(map_rate=3.0),
    rtcm_rate=drives(rtcm_rate=3.0),
    camera_rate=drives(camera_rate=3.0),
    beams=drives(beams=90),
    map_cells=drives(map_cells=50),
    odom_noise=drives(odom_noise=(0.2, 0.2)),
    start_time_s=drives(start_time_s=1000.0),
    prefix_frames=drives(prefix_frames=True),
    transforms=Elsewhere("lab/sim/test_transforms.py::test_every_frame_hangs_on_the_map"),
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
    snr_db=impairs(snr_db=10.0),
    frequency_offset=impairs(frequency_offset=0.01),
    epsilon=impairs(epsilon=1.001),
    taps=impairs(taps=(1, 0.5)),
    doppler_hz=impairs(doppler_hz=50.0),
)
effects(
    "Channel of a scenario",
    trace=Elsewhere("lab/medium/test_trace.py::test_levels_follow_the_trace"),
    carrier_hz=reaches("carrier_hz=868e6"),
    decorrelation_m=reaches("decorrelation_m=1", "shadowing_db=6"),
    exponent=reaches("exponent=2"),
    height_m=reaches("height_m=2", "model=two_ray"),
    model=reaches("model=free_space"),
    noise_figure_db=reaches("noise_figure_db=3"),
    shadowing_db=reaches("shadowing_db=6"),
    tx_power_dbm=reaches("tx_power_dbm=3"),
    walls_db=reaches("walls_db=6"),
    **{"from": lambda: (levels(), levels("from=positions"))},
)
effects(
    "PHY",
    name=run("phy.name=psk", "phy.options={}"),
    sample_rate=run("phy.sample_rate=200000"),
    headroom=run("phy.headroom=2", "phy.sample_rate=auto"),
    options=run("phy.options={payload_modulation: qpsk}", "phy.options={}"),
    kernels=Elsewhere("phy/kernels/test_library.py::test_the_setting_chooses"),
)
effects(
    "Scenario",
    channel=run(LOSSY),
    paths=run("paths=[{to: 2, packet_loss: 0.2}]"),
    paper=run("paper={}", "topics=auto"),
    phy=run("phy.sample_rate=200000"),
    seed=run("seed=4"),
    source=lambda: (outcome("six-topics-paced", *DRIVE[1:]), outcome("six-topics-paced", *DRIVE)),
    duration_s=run("duration_s=3"),
    drain_s=run("drain_s=0", "packet_rate=0"),
    sim=run("sim.odom_rate=20"),
    task=Elsewhere("lab/run/test_task_run.py::test_followers_keep_their_places_by_the_link_alone"),
    controller=Elsewhere("lab/run/test_task_run.py::test_robots_meet_in_real_time_whoever_drives_them"),
    airtime=run("airtime=eu869.4"),
)
effects(
    "Path",
    trace=Elsewhere("lab/medium/test_trace.py::test_each_path_may_have_a_trace_of_its_own"),
    to=run("paths=[{to: 2, packet_loss: 0.2}]", "paths=[{to: 1, packet_loss: 0.2}]"),
    delay_s=run("paths=[{from: 2, delay_s: 0.3}]", LOSSY, REPORTING),
    **{"from": run("paths=[{from: 1, packet_loss: 0.2}]", "paths=[{from: 2, packet_loss: 0.2}]")},
)
effects(
    "Paper",
    dst_id=run("paper.dst_id=9", *PAPER),
    min_fragment=run("paper.min_fragment=150", *PAPER),
    greedy=run("paper.greedy=true", *PAPER),
    flush_timeout_s=run("paper.flush_timeout_s=0.2", *PAPER),
    hop=run("paper.hop=3", *PAPER),
    entry_ids=run("paper.entry_ids=random", *PAPER),
    compression=run("paper.compression=true", *PAPER),
    reassembly_timeout_s=run("paper.reassembly_timeout_s=0.05", *PAPER, LOSSY),
)
effects(
    "Airtime",
    band=run("airtime.band=eu868"),
    duty_cycle=run("airtime.duty_cycle=0.1"),
    window_s=run("airtime.window_s=10", "airtime.duty_cycle=0.1"),
    max_burst_s=run("airtime.max_burst_s=0.2"),
    listen_before_send=Elsewhere(
        "radio/test_devices.py::test_a_device_listens_where_it_sends_and_does_not_hear_itself"
    ),
)
effects(
    "Scenario",
    name=lambda: (printed(), printed("name=another")),
    own_domains=Elsewhere("lab/run/test_domains.py::test_one_graph_is_that_of_the_shell"),
    description=lambda: (printed(), printed("description=another")),
    repetitions=lambda: (printed(), printed("repetitions=2")),
    time=Elsewhere("lab/run/test_simulated_runner.py::test_in_noise_packets_lose_what_samples_lose"),
    bag_speed=run("bag_speed=2", *DRIVE),
    robots=run("robots=3", scenario="two-robots-half-duplex"),
    duplex=run("duplex=full", scenario="two-robots-half-duplex"),
    gains_db=lambda: (reached(), reached("gains_db=-90")),
    medium=run("medium=aloha", "robots=2", scenario="team"),
    relay=run("relay='off'", "robots=3", LINE, scenario="line"),
)
effects(
    "Robot of a scenario",
    tx_power_dbm=lambda: (reached(), reached("robots=[{tx_power_dbm: 10}, {}]")),
    noise_figure_db=lambda: (reached(), reached("robots=[{noise_figure_db: 3}, {}]")),
)
effects(
    "Robot",
    robot=run("robots.0.robot=7"),
    direction=run("robots.1.direction=receive", LOSSY, REPORTING),
    topics=run("topics=[odom, scan]"),
    backfill=Elsewhere("e2e/test_backfill.py::test_what_nobody_heard_in_an_outage_is_in_the_bag_afterwards"),
    publish=Elsewhere("radio/test_robot_link.py::test_parts_that_do_not_fit_are_refused_and_nothing_stays_open"),
    graph=run("robots.0.graph.namespace=/robot_2"),
    registry=run("registry=odom.csv", "topics=[odom]"),
    services=Elsewhere("radio/test_found_services.py::test_services_can_be_left_to_the_robot"),
    offer=Elsewhere("radio/test_asked_from_afar.py::test_who_may_ask_and_how_often_is_up_to_the_sender"),
    commands=run("commands=[]", OPTION + "cmd_vel={qos: auto}"),
    packet_len=run("packet_len=300"),
    key=run("key=fleet.key"),
    seal=run("seal=authenticate", "key=fleet.key"),
    state=differs(kept, state="{}/mine.json"),
    packet_rate=run("packet_rate=10"),
    queue_depth=run("queue_depth=2", OPTION + "odom={queue: fifo}"),
    compression=run("compression=false"),
    repair=run("repair='off'", scenario="paper-ofdm-paced"),
    expected_loss=run("expected_loss=0.6", LOSSY, "repair=thrifty", scenario="paper-ofdm-paced"),
    repeat_s=run("repeat_s=0.5"),
    beacon_s=run("beacon_s=0.05", LOSSY, REPORTING),
    hold_s=run("hold_s=0.1", LOSSY, OPTION + "scan={queue: fifo}", "phy.sample_rate=400000"),
    max_age_s=lambda: (withheld(), withheld(max_age_s=2.0)),
    max_sources=Elsewhere("paper/test_receiver.py::test_sources_beyond_the_bound_wait_until_one_has_gone_silent"),
    max_source_bytes=Elsewhere("link/v1/test_endpoint.py::test_a_long_message_is_given_up_when_its_memory_is_needed"),
    debug=Elsewhere("gr/test_source.py::test_debug_lines"),
)
effects(
    "Graph",
    middleware=Elsewhere("core/test_backends.py::test_choosing_what_is_not_installed_names_what_to_install"),
    domain_id=differs(published, graph_domain_id=GRAPH + 1),
    localhost_only=Elsewhere("middleware/test_dds.py::test_a_domain_is_on_loopback_or_not_for_the_whole_process"),
    namespace=run("robots.0.graph.namespace=/robot_2"),
    depth=Elsewhere("radio/test_config.py::test_the_depths_of_a_graph_are_those_of_its_blocks"),
    use_sim_time=Elsewhere("gr/test_sink.py::test_latency_by_simulated_clock"),
)
BACKFILL = Elsewhere("e2e/test_backfill.py::test_what_nobody_heard_in_an_outage_is_in_the_bag_afterwards")
effects(
    "Backfill",
    topics=BACKFILL,
    robots=Elsewhere("gr/test_backfill.py::test_what_one_who_records_has_not_heard_crosses_later_whoever_else_has"),
    for_s=Elsewhere("calls/test_backfill.py::test_what_is_too_old_is_given_up"),
    memory_mb=Elsewhere("e2e/test_backfill.py::test_what_does_not_fit_is_given_up_and_the_bag_says_so"),
)
CLOCKS = Elsewhere("e2e/test_clocks.py::test_a_computer_whose_clock_is_wrong_is_taken_into_account")
effects(
    "Publish",
    depth=differs(published, publish_depth=3),
    frame_prefix=differs(published, publish_frame_prefix="robot_{robot}/"),
    merge_tf=Elsewhere("gr/test_frame_ids.py::test_two_robots_on_one_graph_of_a_real_dds"),
    stamps=CLOCKS,
    topics=differs(published, publish_topics={"odom": {"as": "/here"}}),
    **{"as": differs(published, publish_as="/from_{robot}")},
)
effects(
    "Topics that come out",
    depth=differs(published, publish_topics={"odom": {"depth": 3}}),
    reliability=differs(published, publish_topics={"odom": {"reliability": "best_effort"}}),
    durability=differs(published, publish_topics={"odom": {"durability": "transient_local"}}),
    deadline_s=Elsewhere("radio/test_calls.py::test_calls_that_the_server_leaves_open_end_by_name"),
    max_age_s=lambda: (withheld(), withheld(publish_topics={"cmd_vel": {"max_age_s": 2.0}})),
    **{"as": differs(published, publish_topics={"odom": {"as": "/here"}})},
)
effects(
    "One of several radios",
    name=Elsewhere("radio/test_two_radios.py::test_each_radio_has_a_name_a_phy_a_front_end_and_airtime_of_its_own"),
    phy=Elsewhere("radio/test_two_radios.py::test_each_radio_has_a_name_a_phy_a_front_end_and_airtime_of_its_own"),
    front_end=Elsewhere(
        "radio/test_two_radios.py::test_each_radio_has_a_name_a_phy_a_front_end_and_airtime_of_its_own"
    ),
    airtime=Elsewhere("radio/test_two_radios.py::test_each_radio_has_a_name_a_phy_a_front_end_and_airtime_of_its_own"),
    packet_len=Elsewhere("radio/test_bound_topics.py::test_a_radio_has_longer_packets_for_what_goes_over_it_alone"),
    medium=Elsewhere(
        "radio/test_radios_apart.py::test_a_shared_channel_carries_what_is_bound_to_it_to_robots_that_have_it_alone"
    ),
)
effects(
    "Link",
    name=differs(linked, name="another"),
    channel=Elsewhere("radio/test_radio.py::test_a_channel_that_is_given_can_be_changed_while_it_runs"),
    phy=EFFECTS["Scenario", "phy"],
    airtime=EFFECTS["Scenario", "airtime"],
    medium=differs(linked, medium="slots"),
    relay=lambda: (linked(medium="slots"), linked(medium="slots", relay="gain")),
    front_end=Elsewhere("radio/test_devices.py::test_every_packet_goes_out_as_one_ended_burst_and_comes_back"),
    radios=Elsewhere("radio/test_two_radios.py::test_two_like_radios_share_the_load_and_every_message_comes_once"),
    transmit=differs(linked, transmit=False),
    open=Elsewhere("radio/test_permission.py::test_a_radio_asks_first"),
    record=Elsewhere("radio/test_radio.py::test_it_records_what_it_receives_and_finishes_it_without_being_closed"),
    clock=CLOCKS,
    diagnostics=Elsewhere("radio/test_diagnostics.py::test_a_running_link_is_diagnosed"),
)
effects("Clocks of other robots", every_s=CLOCKS, chrony=CLOCKS, robot=CLOCKS)


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

    def said(**limits: tuple[float, float]) -> list[Any]:
        health = make(**dict.fromkeys(LIMITS, (0.0, 0.0)) | limits)
        parts(health, 0.0)
        poor = {"packets": 60, "missing": 40, "delivered": 60, "lost": 40, "latency": 1.5, "age": 2.0}
        return [(part.level, part.message) for now in (1.0, 60.0) for part in parts(health, now, **poor)]

    return lambda: (said(), said(**{limit: (0.1, 0.0)}))


LIMITS = [item.name for item in fields(DiagnosticsConfig) if item.name != "period_s"]
effects(
    "Diagnostics",
    period_s=Elsewhere("radio/test_diagnostics.py::test_no_period_no_diagnostics"),
    **{name: judged(name) for name in LIMITS},
)


TWO = {"grid": {"channel.packet_loss": [0.0, 0.1], "packet_len": [64, 80]}}
BOTH = {"set": {"registry": "table4", "duration_s": 1}, "value": "latency_p50_s", "topic": "/robot_1/imu"}
effects(
    "Sweep",
    description=sweeps(description="another"),
    repetitions=sweeps(repetitions=3),
    time=sweeps(time="real"),
    scenario=sweeps(scenario="paper-ofdm"),
    grid=sweeps(grid={"channel.packet_loss": [0.0, 0.2]}),
    list=sweeps(list=[{"packet_len": 80}, {"packet_len": 96}]),
    set=sweeps(set={"duration_s": 2}),
    x=sweeps(TWO, x="packet_len"),
    y=sweeps({"grid": {**TWO["grid"], "queue_depth": [8, 16]}}, y="queue_depth"),
    by=sweeps(TWO, by=["packet_len"], x="channel.packet_loss"),
    value=sweeps(value="goodput_Bps"),
    topic=lambda: (drawn(**BOTH), drawn(**{**BOTH, "topic": "/robot_1/odom"})),
)
effects(
    "Race",
    robots=differs(prepared, robots=3),
    source=differs(prepared, source=DRIVE[0].removeprefix("source="), bag_topic="/robot_1/odom"),
    duration_s=differs(prepared, duration_s=0.3),
    packet_len=differs(raced, packet_len=96),
    sample_rate=differs(prepared, sample_rate=50_000.0),
    bag_topic=Elsewhere("lab/race/test_race_settings.py::test_of_a_bag_the_named_topic_is_taken_for_as_long_as_asked"),
    peers=lambda: (list(chosen((), "two")), list(chosen(("gr-ros2",), "two"))),
    loss=differs(prepared, loss=(0.5,)),
    load=differs(prepared, load=(0.8,)),
    row=differs(prepared, row="map"),
    seed=differs(prepared, seed=3),
)

PULSES: dict[str, Any] = {"gap": 500, "lengths": "fixed", "fec": "cc"}
for name, options in {
    "ofdm": {
        **PULSES, "payload_modulation": "qpsk", "fft_len": 128, "cp_len": 24, "scramble": True,
        "pilots": (-20, -8, 8, 20),
    },
    "gfsk": {**PULSES, "sps": 8, "bt": 0.3},
    "psk": {**PULSES, "sps": 8, "rolloff": 0.9, "modulation": "8psk"},
    "lora": {**PULSES, "spreading_factor": 8, "coding_rate": 2},
}.items():  # fmt: skip
    effects(f"PHY `{name}`", **{key: sends(name, **{key: value}) for key, value in options.items()})
effects(
    "PHY `ofdm`",
    carriers=sends("ofdm", {"pilots": (-20, -8, 8, 20)}, carriers=24),
    rate=differs(rates, "ofdm", rate="adaptive"),
    rates=lambda: (rates("ofdm", rate="adaptive"), rates("ofdm", rate="adaptive", rates=("bpsk-cc", "qpsk-cc"))),
    detection_threshold=lambda: (heard("ofdm"), heard("ofdm", detection_threshold=0.95)),
)
LORA, WIFI = "phy/test_lora_sdr.py::test_", "phy/test_wifi.py::test_"
effects(
    "PHY `lora`",
    implementation=Elsewhere(f"{LORA}without_the_module_the_remedy_is_told"),
    sync_word=Elsewhere(f"{LORA}another_networks_frames_are_not_heard"),
    ldro=Elsewhere(f"{LORA}symbols_are_counted_as_in_lora_modems_data_sheets"),
    carrier_hz=Elsewhere(f"{LORA}with_the_carrier_known_clocks_may_differ"),
)
HOME, GUEST = "02:67:72:2d:72:32", "02:00:00:00:00:01"
effects(
    "PHY `wifi`",
    gap=differs(wifi, gap=1000),
    lengths=differs(wifi, lengths="fixed"),
    encoding=differs(wifi, encoding="qpsk-1/2"),
    equalizer=Elsewhere(f"{WIFI}every_estimate_of_the_channel_receives"),
    network=lambda: (DataFrames(HOME, HOME).wrap(b"x", 0), DataFrames(GUEST, HOME).wrap(b"x", 0)),
    address=lambda: (DataFrames(HOME, HOME).wrap(b"x", 0), DataFrames(HOME, GUEST).wrap(b"x", 0)),
    channel_hz=Elsewhere(f"{WIFI}with_the_channel_known_clocks_may_differ"),
)
for name, value in {"bit_rate": 4800.0, "overhead_bytes": 8, "overhead_s": 0.1}.items():
    EFFECTS["PHY `modem`", name] = differs(lasting, "modem", **{name: value})

TUNED: dict[str, Any] = {"frequency": 433e6}
PLACES: dict[str, dict[str, Any]] = {
    "sim": {},
    "zmq": {"bind": "ipc:///tmp/a", "connect": ("ipc:///tmp/b",)},
    "file": {"write": "sent"},
    "soapy": TUNED,
    "uhd": TUNED,
    "pluto": TUNED,
    "kiss": {"device": "/dev/a"},
    "serial": {"device": "/dev/a"},
    "udp": {"listen": "5555", "send_to": ("10.0.0.1:5555",)},
    "audio": {},
}
"""What each front end cannot do without."""


def opens(front_end: str, beside: Mapping[str, Any] = MappingProxyType({}), **changed: Any) -> Outcomes:
    """What a front end asks of its device, without and with a change."""
    base = {**PLACES[front_end], **beside}
    return lambda: (opened(front_end, base), opened(front_end, {**base, **changed}))


for name, needed in PLACES.items():
    EFFECTS[f"Front end `{name}`", "guard_s"] = lambda name=name, needed=needed: (
        guarded(name, needed),
        guarded(name, {**needed, "guard_s": 0.1}),
    )
DEVICE: dict[str, Any] = {
    "half_duplex": True, "frequency": 868e6, "args": "serial=1", "frequency_rx": 434e6, "gain_tx": -10.0,
    "gain_rx": 20.0, "antenna_tx": "LEFT", "antenna_rx": "RIGHT", "bandwidth": 5e5, "level": 0.3,
    "tail": 100, "multiple": 500,
}  # fmt: skip
for name in ("soapy", "uhd", "pluto"):
    effects(f"Front end `{name}`", **{key: opens(name, **{key: value}) for key, value in DEVICE.items()})
    EFFECTS[f"Front end `{name}`", "turnaround_s"] = opens(name, {"half_duplex": True}, turnaround_s=0.1)
for key, value in {"clock_source": "external", "subdev_tx": "A:A", "subdev_rx": "A:B"}.items():
    EFFECTS["Front end `uhd`", key] = opens("uhd", **{key: value})
for name in ("kiss", "serial"):
    effects(
        f"Front end `{name}`",
        device=opens(name, device="/dev/b"),
        baud=opens(name, baud=9600),
        backoff_s=opens(name, backoff_s=1.0),
        half_duplex=differs(linked, name, options={"half_duplex": False}),
    )
effects(
    "Front end `kiss`",
    tnc_port=opens("kiss", tnc_port=1),
    callsign=opens("kiss", callsign="AA1AA"),
    destination=opens("kiss", {"callsign": "AA1AA"}, destination="OTHERS"),
)
effects(
    "Front end `serial`",
    framing=opens("serial", framing="slip"),
    rssi=Elsewhere("radio/test_packet_radios.py::test_the_byte_of_signal_strength_is_read_and_no_packet"),
)
KEYED = {"ptt": "rts", "ptt_device": "/dev/a"}
effects(
    "Front end `audio`",
    **{
        key: opens("audio", **{key: value})
        for key, value in {
            "half_duplex": True, "level": 0.3, "device": "USB", "device_rx": "USB", "centre_hz": 1500.0, "lead_s": 0.5,
            "latency_s": 0.2, "ptt": "vox",
        }.items()
    },
    turnaround_s=opens("audio", {"half_duplex": True}, turnaround_s=0.2),
    ptt_device=opens("audio", KEYED, ptt_device="/dev/b"),
)  # fmt: skip
effects(
    "Front end `udp`",
    listen=opens("udp", listen="5556"),
    send_to=opens("udp", send_to=("10.0.0.2:5555",)),
    half_duplex=differs(linked, "udp", options={"half_duplex": True}),
)
effects(
    "Front end `zmq`",
    bind=Elsewhere("radio/test_zmq.py::test_an_address_that_is_taken_or_wrong_is_said_in_a_line"),
    connect=Elsewhere("radio/test_zmq.py::test_what_a_slow_computer_does_not_take_is_dropped_and_counted"),
    medium_process=opens("zmq", medium_process="lockstep"),
)
READ = {"read": "{}/heard"}
effects(
    "Front end `file`",
    write=lambda: (replayed(**READ), replayed(**READ, write="{}/sent")),
    read=lambda: (replayed(write="{}/sent"), replayed(**READ, write="{}/sent")),
    speed=lambda: (replayed(**READ), replayed(**READ, speed=2.0)),
    repeat=lambda: (replayed(**READ, speed=0.0), replayed(**READ, speed=0.0, repeat=True)),
)


def test_every_row_of_the_page_has_an_entry() -> None:
    found = list(rows())
    assert len(found) > 200
    assert [row for row in found if row not in EFFECTS] == [], "a new setting needs an experiment that shows its effect"
    assert [row for row in EFFECTS if row not in found] == []


ELSEWHERE = [row for row, entry in EFFECTS.items() if isinstance(entry, Elsewhere)]


@pytest.mark.parametrize("row", ELSEWHERE, ids=": ".join)
def test_a_test_elsewhere_shows_the_effect_of_the_setting(row: Row) -> None:
    file, _, name = str(EFFECTS[row]).partition("::")
    assert name in (sources := sources_in(file)), f"{file} has no {name}"
    assert re.search(rf"\b(set_|graph_|publish_)?{row[1]}\b", sources[name]), f"{name} does not name {row[1]}"


@functools.cache
def sources_in(file: str) -> dict[str, str]:
    """The source of each test of a file, with its decorators."""
    text = (REPOSITORY / "tests" / file).read_text(encoding="utf-8")
    found = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef)]
    lines = text.splitlines()
    return {
        node.name: "\n".join(lines[min([node.lineno, *(d.lineno for d in node.decorator_list)]) - 1 : node.end_lineno])
        for node in found
        if node.name.startswith("test_")
    }


@pytest.mark.xdist_group("effects")  # they share what happens without a setting
@pytest.mark.parametrize("row", [row for row in EFFECTS if row not in ELSEWHERE], ids=": ".join)
def test_a_setting_has_an_effect(row: Row) -> None:
    entry = EFFECTS[row]
    assert not isinstance(entry, Elsewhere)
    without, with_it = entry()
    assert without != with_it


def other(setting: Setting) -> Any:
    """A value that is not the default."""
    if setting.name in ("key", "state"):
        return "somewhere"
    if setting.name == "to":
        return 7
    if setting.name == "offer":
        return {"scan": {}}
    if isinstance(setting.default, bool):
        return not setting.default
    if isinstance(setting.default, tuple | dict):
        return type(setting.default)()
    if setting.kinds == (str,):
        return "other"
    if setting.name in (made := {"cloud": CloudOptions(voxel=0.1), "camera": CameraOptions(off=True)}):
        return made[setting.name]
    if setting.name == "depth_image":
        return DepthOptions(off=True)
    choices = [choice for choice in setting.choices if choice not in (setting.default, AUTO)]
    if choices:
        return choices[0]
    if setting.default == AUTO and setting.kinds == (int,):
        return 3
    return 0.5 if setting.default == AUTO or setting.below is not None else setting.default + 1


OF_LINKS = [
    *("key", "seal", "state", "services", "commands", "beacon_s", "repair", "expected_loss", "hold_s", "max_age_s"),
    *(f"topics.odom.{name}" for name in ("queue", "deadline_s", "weight", "max_rate", "keep_s", "to")),
    *("topics.odom.instance", "topics.odom.camera", "topics.odom.depth_image"),
    *("publish.topics.odom.deadline_s", "publish.topics.odom.max_age_s", "compression", "offer"),
]
"""Settings of a robot that the paper's blocks do not have."""


@pytest.mark.parametrize("name", OF_LINKS)
def test_the_papers_blocks_refuse_what_only_links_have(name: str) -> None:
    (*parts, last), cls = name.split("."), RobotConfig
    cls = {"topics": SendOptions, "publish": PublishOptions}.get(parts[0] if parts else "", RobotConfig)
    value = other(next(setting for setting in settings_of(cls) if setting.name == last))
    beside = {"key": "fleet.key"} if last in ("seal", "max_age_s") else {}
    values: Any = {last: value}
    for part in reversed(parts):
        values = {part: values}
    robot = build(RobotConfig, {"robot": 1, **beside, **values})
    with pytest.raises(ValueError, match=r"the paper's blocks have (no such setting|a setting of their own)"):
        check(robot, PaperConfig())
    if parts[:1] == ["topics"]:
        row = Topic(0, "odom", "nav_msgs/msg/Odometry", robot.topics["odom"])
        with pytest.raises(ConfigError, match=f"registry: topic odom: {last} = .*the paper's blocks have no such"):
            check_rows(Registry([row]))


def test_a_running_link_refuses_what_cannot_change() -> None:
    rows = Registry.from_rows({"odom": "nav_msgs/Odometry"})
    end = link_end(rows)
    for setting in settings_of(RobotConfig):
        if setting.name not in end.live_settings:
            said = f"{setting.name} cannot change while running; these can: {', '.join(end.live_settings)}"
            with pytest.raises(ConfigError, match=re.escape(said)):
                end.reconfigure(**{setting.name: None})
    for option in settings_of(SendOptions):
        if option.name not in end.live_options:
            changed = replace(rows[0].options, **{option.name: other(option)})
            with pytest.raises(ConfigError, match=f"topic odom: {option.name} cannot change"):
                end.messages.change(0, changed)


def link_end(rows: Registry, **settings: Any) -> OpenEndpoint:
    return make_endpoint(RobotConfig(robot=1, **settings), rows, air=RadioFacts(hears=False), start=Start())


def says(version: int, **changes: Any) -> list[Any]:
    """What an end sends for 3 s, of which a setting changes in the first: packets with their times, and queues."""
    options = SendOptions(durability="transient_local", queue="fifo" if version else AUTO)
    rows = Registry([Topic(0, "odom", "nav_msgs/msg/Odometry", options)])
    end: Endpoint
    if version:
        end = link_end(rows, packet_rate=20.0, repeat_s=1.0)
    else:
        robot = RobotConfig(robot=1, packet_rate=20.0, repeat_s=1.0)
        end = make_paper_endpoint(robot, PaperConfig(), rows, rng=random.Random(1))
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
    same = says(version)
    assert says(version) == same
    for name in (EndpointV0, EndpointV1)[version].live_settings:
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
    "camera": ({}, CameraOptions(off=True)),
    "cloud": ({}, CloudOptions(voxel=0.1)),
    "depth_image": ({"camera": CameraOptions(off=True), "depth_image": DepthOptions(mode="10")}, DepthOptions()),
}
"""Options of a topic that runs, and the value that one takes."""


def optioned(kind: str, base: Mapping[str, Any], **changed: Any) -> list[bytes]:
    """What an end sends of two topics of a type that want more than there is, of which the options of one change."""
    options = SendOptions(**{"queue": "fifo", **base})
    rows = Registry([Topic(n, name, kind, options) for n, name in enumerate(("goal", "scan"))])
    clouds = kind == CLOUD
    end = link_end(rows, packet_rate=20.0, repeat_s=0.5, compression=clouds)
    payload = scenes.cloud(scenes.street(rings=2, columns=8)) if clouds else None
    sent, topic_id = [], 0
    for step in range(300):
        now = step * 0.01
        if step == 20:
            topic_id = end.messages.change(0, replace(options, **changed))[1].topic_id
        if step < 200 and step % 10 == 0:
            for topic in (topic_id, 1):
                end.messages.submit(topic, payload or b"message %3d of %d" % (step, topic) * 20, now)
        while (packet := end.next_packet(now)) is not None:
            sent.append(packet.data)
    return sent


@pytest.mark.parametrize("option", LIVE_OPTIONS)
def test_an_option_that_can_change_has_its_effect_then(option: str) -> None:
    base, value = CHANGED[option]
    kind = CLOUD if option == "cloud" else PICTURES[0]
    assert optioned(kind, base) == optioned(kind, base)
    assert optioned(kind, base, **{option: value}) != optioned(kind, base)


OF_A_GRAPH = {
    "graph.middleware": "memory",
    "graph.domain_id": 3,
    "graph.depth": 3,
    "graph.localhost_only": False,
    "graph.use_sim_time": True,
    "publish.depth": 3,
    "debug": True,
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
        build(RobotConfig, {"robot": 1, "seal": "authenticate"})
    with pytest.raises(ConfigError) as error:
        load_scenario("paper-direct", ["key=fleet.key"])
    assert str(error.value).count("the paper's blocks have no such setting") == 1
