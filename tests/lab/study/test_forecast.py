"""The plan: forecasts that add up, and advice that holds when it is followed."""

from __future__ import annotations

import os
import time

import numpy as np
import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.gr.factory import message_codec
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import load_scenario
from gr_ros2_lab.run.simulate import simulate
from gr_ros2_lab.sim.fleet import Fleet
from gr_ros2_lab.study.forecast import Advice, Effect, Planner


def planner(name: str, *overrides: str, duration: float = 5.0) -> Planner:
    return Planner(load_scenario(name, overrides, duration_s=duration))


@pytest.mark.parametrize("name", ["paper-ofdm-paced", "six-topics-paced", "demo"])
def test_the_shares_of_the_topics_are_the_airtime_used(name: str) -> None:
    """Without repair, which uses air too; hellos and the rows of the table after each take the rest: 5 % of the packets
    in 20 s of ``paper-ofdm-paced``, 8 % of those in the first 5 s, at whose start they come often."""
    one_way = "robots=[{direction: send}, {direction: receive}]"
    forecast = planner(name, one_way, "repair='off'", duration=20.0).forecast()
    assert min(1.0, sum(topic.share for topic in forecast.topics)) == pytest.approx(forecast.used, rel=0.08)
    assert forecast.capacity == pytest.approx(1 / forecast.airtime_s)


def test_commands_come_in_time_on_a_link_that_is_full() -> None:
    settings = ["phy={name: modem, options: {bit_rate: 9600}}", "topics=auto"]
    full = planner("six-topics-paced", *settings, duration=20.0).forecast()
    late = planner("six-topics-paced", *settings, "commands=[]", duration=20.0).forecast()
    now, before = ({topic.topic: topic.result for topic in plan.topics}["/robot_1/cmd_vel"] for plan in (full, late))
    assert full.load > 10
    assert now.latency_s.p99 is not None
    assert before.latency_s.p99 is not None
    assert now.latency_s.p99 < 0.33
    assert before.latency_s.p99 > 3 * 0.33
    assert {"stale", "cannot_complete"} & now.ledger.keys(), "what is dropped is counted"


@pytest.mark.parametrize(("limit", "share"), [("eu869.4", 0.09), ("{duty_cycle: 0.01, window_s: 600}", 0.009)])
def test_a_plan_keeps_the_limit_of_airtime(limit: str, share: float) -> None:
    free = planner("six-topics-paced", duration=20.0).forecast()
    kept = planner("six-topics-paced", f"airtime={limit}", duration=20.0).forecast()
    assert kept.allowed == pytest.approx(share)
    assert kept.used < 1.2 * share
    assert kept.capacity == pytest.approx(share * free.capacity)
    assert kept.load > 5 * free.load


@pytest.mark.slow
def test_what_to_cut_is_known_where_a_topic_finds_no_place_at_all() -> None:
    cuts = planner("six-topics-paced", "airtime=eu868", duration=20.0).cuts()
    assert cuts[-1].load <= 1


def test_a_camera_fits_what_is_left_and_is_not_cut() -> None:
    pytest.importorskip("av", reason="needs PyAV")
    for rate in (5, 200):
        plan = planner("cameras", f"sim.odom_rate={rate}", duration=4.0)
        forecast = plan.forecast()
        (camera,) = [topic for topic in forecast.topics if topic.frames is not None]
        assert camera.topic == "/robot_1/camera"
        assert camera.frames is not None
        assert camera.air_bytes * camera.frames.rate_hz == pytest.approx(125 * camera.frames.kbit_s)
        assert (forecast.load > 1) == (rate == 200)
        assert {cut.topic for cut in plan.cuts()} <= {"odom of every robot"}
        assert camera.frames.rate_hz > 2


def test_what_fits_is_said_to_fit() -> None:
    fits = planner("paper-ofdm-paced", "repair='off'", duration=20.0).forecast()
    assert fits.load == pytest.approx(fits.used, rel=0.08)
    assert fits.load < 1
    assert fits.topics[0].rate_hz == pytest.approx(fits.topics[0].offered_hz)
    assert planner("narrow-ofdm-paced").forecast().load > 1


def test_rows_of_the_table_delay_no_messages() -> None:
    """One way they follow each hello, and wait for the message that is due: fewer than 1 in 100 comes late."""
    (odom,) = planner("paper-ofdm-paced", "repair='off'", duration=30.0).forecast().topics
    assert odom.result.latency_s.p99 is not None
    assert odom.result.latency_s.p99 < 0.02


def test_a_forecast_is_what_the_link_does() -> None:
    scenario = load_scenario("six-topics-paced", ["time=packets"], duration_s=5.0)
    done = {topic.topic: topic for topic in simulate(scenario).topics}
    forecast = Planner(scenario).forecast()
    assert {topic.topic for topic in forecast.topics} == set(done)
    for topic in forecast.topics:
        assert topic.result.delivered == done[topic.topic].delivered


@pytest.mark.parametrize(
    ("settings", "least_pdr", "most_packets"),
    [
        (["channel.packet_loss=0.2"], 0.995, 2.8),
        (["channel.packet_loss=0.2", "robots=[{}, {topics: []}]"], 0.995, 1.75),
        (["robots=[{}, {topics: []}]"], 1.0, 1.1),
        (["channel.packet_loss=0.2", "repair='off'"], 0.7, 1.1),
    ],
)
def test_repair_is_forecast_as_a_run_in_simulated_time_has_it(
    settings: list[str], least_pdr: float, most_packets: float
) -> None:
    """PDR, packets per message and latency of version 1 under a stated loss."""
    scenario = load_scenario("paper-ofdm-paced", ["time=packets", *settings], duration_s=20.0)
    forecast = Planner(scenario).forecast()
    real = run_scenario(scenario).result
    (topic,), (there,) = forecast.topics, real.topics
    assert topic.result.pdr == pytest.approx(there.pdr, abs=0.01)
    assert topic.result.pdr is not None
    assert topic.result.pdr >= least_pdr
    assert topic.result.latency_s.p99 == pytest.approx(there.latency_s.p99 or 0, rel=0.15, abs=0.005)
    packets = sum(count for kind, count in forecast.air.items() if kind != "report")
    assert (forecast.air["report"] > 0) == ("robots=[{}, {topics: []}]" in settings)
    spent_s = sum(real.phy["airtime_of_kinds_s"].values())
    assert sum(forecast.air.values()) == pytest.approx(spent_s / real.phy["airtime_s"] / there.sent, rel=0.03)
    assert 1 <= packets <= most_packets
    assert forecast.air["new"] == pytest.approx(1, rel=0.03)
    assert forecast.air.get("repair", 0) <= packets - 1


def test_a_forecast_of_six_topics_is_what_the_flowgraph_does() -> None:
    """On the clock of its samples; in real time it is a row of the benchmark."""
    scenario = load_scenario("six-topics-paced", ["time=samples"], duration_s=5.0)
    real = {topic.topic: topic for topic in run_scenario(scenario).result.topics}
    forecast = Planner(scenario).forecast()
    assert {topic.topic for topic in forecast.topics} == set(real)
    for topic in forecast.topics:
        delivered = topic.result.delivered
        assert real[topic.topic].delivered == pytest.approx(delivered, rel=0.10, abs=1), topic.topic
        if delivered > 1:
            assert real[topic.topic].age_s.mean == pytest.approx(topic.result.age_s.mean, rel=0.10), topic.topic


def test_advice_holds_when_it_is_followed() -> None:
    plain = ("compression=false", "repair='off'")
    best = planner("paper-ofdm-paced", *plain).advice()[0]
    assert best.setting == "compression=true"
    followed = planner("paper-ofdm-paced", *plain, best.setting)
    assert followed.forecast().load < 1
    lens = [advice for advice in followed.advice() if advice.setting.startswith("packet_len=")]
    assert lens, "a packet length that fits the message"
    per_message = planner("paper-ofdm-paced", *plain, best.setting, lens[0].setting).forecast().air_bytes_per_message
    assert per_message is not None
    assert per_message <= 115


def effect(age: tuple[float, float], pdr: tuple[float, float] = (1.0, 1.0), weight: float = 1.0) -> Effect:
    return Effect("/odom", weight, age, pdr)


@pytest.mark.parametrize(
    ("one", "says"),
    [
        (effect((0.1, 0.05)), {"younger"}),
        (effect((0.1, 0.2)), {"older"}),
        (effect((0.1, 0.098)), set()),
        (effect((0.001, 0.0015)), set()),  # half a millisecond, which nobody notices
        (effect((0.1, 0.05), (1.0, 0.5)), {"younger", "fewer"}),
        (effect((0.1, 0.1), (0.5, 1.0)), {"more"}),
    ],
)
def test_what_a_change_does_to_a_topic(one: Effect, says: set[str]) -> None:
    assert {name for name in ("younger", "older", "fewer", "more") if getattr(one, name)} == says


@pytest.mark.parametrize(
    ("effects", "used", "worth_it", "harmless"),
    [
        ([effect((0.1, 0.05)), effect((0.1, 0.1))], (1.0, 1.0), True, True),
        ([effect((9.0, 0.1)), *[effect((0.1, 0.2))] * 4, effect((0.1, 0.1))], (1.0, 0.5), False, False),  # four of six
        ([effect((0.1, 0.05)), effect((0.1, 0.05)), effect((0.1, 0.11))], (1.0, 1.0), True, False),
        ([effect((0.1, 0.05), weight=4.0), *[effect((0.1, 0.11))] * 3], (1.0, 1.0), True, False),  # the one that counts
        ([effect((0.1, 0.1))], (1.0, 0.5), True, True),
        ([effect((0.1, 0.1), (1.0, 0.9))], (1.0, 0.5), False, False),
        ([effect((0.1, 0.1))], (1.0, 1.0), False, True),
    ],
)
def test_what_is_proposed(effects: list[Effect], used: tuple[float, float], worth_it: bool, harmless: bool) -> None:
    forecast = planner("paper-ofdm-paced", duration=1.0).forecast()
    advice = Advice("packet_len=100", forecast, used, tuple(effects))
    assert (advice.worth_it, advice.harmless) == (worth_it, harmless)


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("six-topics-paced", ()),
        ("demo", ("compression=false",)),
        ("narrow-ofdm-paced", ()),
    ],
)
def test_nothing_is_called_better_that_makes_more_topics_older_than_younger(
    name: str, settings: tuple[str, ...]
) -> None:
    proposed = planner(name, *settings, duration=1.0).advice()
    assert proposed
    for advice in proposed:
        younger, older = ([e for e in advice.effects if getattr(e, word)] for word in ("younger", "older"))
        assert sum(e.weight for e in older) < sum(e.weight for e in younger) or advice.harmless
    assert [advice.harmless for advice in proposed] == sorted((advice.harmless for advice in proposed), reverse=True)


def test_several_processes_say_what_one_says(monkeypatch: pytest.MonkeyPatch) -> None:
    said = []
    for processors in (1, 3):
        monkeypatch.setattr(os, "sched_getaffinity", lambda _pid, many=processors: set(range(many)))
        plan, told = planner("narrow-ofdm-paced", duration=1.0), []
        if processors > 1:
            plan.begin()
        said.append((plan.cuts(), plan.advice(tell=lambda *done, told=told: told.append(done))))
        assert told == [(done, len(told)) for done in range(1, len(told) + 1)] != []
    assert said[0] == said[1] and all(said[0])


def test_a_planned_packet_length_fits_messages_stamped_by_the_wall_clock() -> None:
    plan = planner("paper-ofdm-paced")
    codec = message_codec(plan.registry)
    sent = [m.payload for m in Fleet(plan.scenario.sim).messages(5.0, time.time()) if m.topic == "/robot_1/odom"]
    sizes = sorted(len(codec.encode(0, payload)) for payload in sent)
    assert plan.forecast().topics[0].air_bytes == pytest.approx(np.mean(sizes), abs=0.5)
    whole = min(plan._packet_lens(), key=lambda packet_len: abs(packet_len - 13 - sizes[-1]))
    assert sum(size <= whole - 13 for size in sizes) >= 0.95 * len(sizes), "one packet each"


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (["phy.name=direct"], "takes no airtime"),
        (["sim.robots=1", "robots.0.robot=/robot_7"], "has no message of odom"),
    ],
)
def test_what_cannot_be_planned(overrides: list[str], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        planner("paper-ofdm-paced", *overrides)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "duration", "rows"), [("team", 6.0, 3), ("two-robots-half-duplex", 6.0, 2), ("twenty-robots", 0.5, 19)]
)
def test_robots_on_one_channel_are_forecast_together(name: str, duration: float, rows: int) -> None:
    """Robot 1 of a run counts what it hears; a forecast counts what the first robot hears that hears a sender. Without
    repair, which where packets overlap makes a small difference large."""
    scenario = load_scenario(name, ["repair='off'"], duration_s=duration)
    forecast = Planner(scenario).forecast()
    real = run_scenario(scenario).result
    there = {topic.topic: topic for topic in real.topics}
    assert len(there) == rows
    topics = {topic.topic: topic for topic in forecast.topics}
    assert list(topics) == [f"/robot_{number}/odom" for number in range(1, len(scenario.robots) + 1)]
    for topic, result in there.items():
        assert topics[topic].result.delivered == pytest.approx(result.delivered, rel=0.1, abs=1), topic
    messages = sum(topic.sent for topic in there.values())
    assert sum(forecast.air.values()) == pytest.approx(real.packets["sent"] / messages, rel=0.1)


def test_slots_are_proposed_where_packets_overlap() -> None:
    two = "two-robots-half-duplex", "sim.odom_rate=15"
    (slots,) = (one for one in planner(*two, duration=10.0).advice() if one.setting == "medium=slots")
    assert slots.harmless
    followed = planner(*two, slots.setting, duration=10.0).forecast()
    assert followed.used == pytest.approx(slots.forecast.used)


@pytest.mark.slow
def test_slots_deliver_what_overlap_loses() -> None:
    plan = planner("two-robots-half-duplex", "repair='off'", duration=15.0)
    (slots,) = (advice for advice in plan.advice() if advice.setting == "medium=slots")
    lost, with_slots = (min(effect.pdr[after] for effect in slots.effects) for after in (False, True))
    assert lost < 0.98 < with_slots


def test_cuts_are_the_same_for_every_robot() -> None:
    load = ["sim.odom_rate=50", "phy.sample_rate=100000"]
    cuts = planner("team", *load).cuts()
    assert [cut.topic for cut in cuts] == ["odom of every robot"]
    followed = planner("team", *load, *cuts[-1].settings).forecast()
    assert followed.load == pytest.approx(cuts[-1].load)
    assert followed.load <= 1 < planner("team", *load).forecast().load
