"""What the dashboard says against what the result says, and that it stays small."""

from __future__ import annotations

import random
import re
import resource
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gr_ros2.dashboard.state import LATENCIES, PACKETS_SHOWN, UNDER_WAY, DashboardState
from gr_ros2.dashboard.tables import heard_html
from gr_ros2.dashboard.views import Snapshot
from gr_ros2.link.clocks import ClockOffset
from gr_ros2.link.events import Accepted, Announced, Delivered, SentPacket
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Topic
from gr_ros2.wire.table import AnnouncedTopic
from gr_ros2_lab.record.recorder import Recorder
from gr_ros2_lab.record.result import Result
from tests.dashboard.feed import NAMES, REGISTRY, SRC, Feed, Hears, at
from tests.link.v1.air import Robot, registry


def make(recorder: Recorder | None = None, packet_len: int = 64) -> DashboardState:
    ledger = None if recorder is None else recorder.ledger.fates
    return DashboardState(REGISTRY, NAMES, packet_len, name="test", duration_s=10.0, ledger=ledger)


def lossy_run(seed: int, *observers: Hears, share: float = 0.05) -> Feed:
    """10 s of positions at 10 Hz and of other messages at 5 Hz, through packet loss."""
    lost = random.Random(seed)
    feed = Feed(*observers, lost=lambda _number: lost.random() < share, packet_len=64)
    for step in range(100):
        now = 50 + step / 10
        feed.submit(0, at(step, 2 * step), now)
        if step % 2:
            feed.submit(1, random.Random(step).randbytes(300), now)
        if step % 40 == 0:
            feed.submit(1, bytes(60_000), now)  # too large
        feed.fly(now)
        feed.pass_time(now)
    return feed


def result_of(recorder: Recorder) -> Result:
    topics = recorder.finish(duration_s=10.0, t_end=60.0, drained=True)
    return Result("test", 0, 10.0, {}, topics, recorder.ledger.packets(), {})


@pytest.mark.parametrize("with_ledger", [True, False])
@pytest.mark.parametrize("seed", range(5))
def test_live_numbers_are_the_results(seed: int, with_ledger: bool) -> None:
    recorder = Recorder(REGISTRY, {SRC: "/robot_4"})
    state = make(recorder if with_ledger else None)
    feed = lossy_run(seed, recorder, state)
    feed.sender.ledger.missed(0, 5)
    feed.pass_time(61.0)
    snapshot = state.tick(60.0)
    result = result_of(recorder)
    assert snapshot.phase == "running"
    assert snapshot.packets == {"sent": feed.packets, "received": result.packets["received"]}
    for view, topic in zip(snapshot.topics, result.topics, strict=True):
        assert (view.name, view.type_name) == (topic.topic, topic.type)
        assert (view.sent, view.delivered, view.pdr) == (topic.sent, topic.delivered, topic.pdr)
        assert view.goodput_Bps == pytest.approx(topic.goodput_Bps)
        assert sum(view.ledger.values()) == view.sent
        assert view.latency_cdf_s == pytest.approx(topic.latency_cdf_s)
        assert view.latency_s is not None
        assert view.latency_s.p95 == pytest.approx(topic.latency_s.p95)
        assert (view.age_mean_s, view.age_peak_s) == pytest.approx((topic.age_s.mean, topic.age_s.peak), rel=1e-6)
        lost = {fate: count for fate, count in topic.ledger.items() if fate in ("too_large", "lost_on_graph")}
        assert {fate: view.ledger[fate] for fate in lost} == lost


def test_once_it_is_over_every_number_is_the_results() -> None:
    recorder = Recorder(REGISTRY, {SRC: "/robot_4"})
    state = make(recorder)
    lossy_run(7, recorder, state)
    before = state.tick(60.0)
    result = result_of(recorder)
    state.finish(result)
    after = state.tick(75.0)
    assert (after.phase, after.elapsed_s) == ("ended", 10.0)
    for view, topic in zip(after.topics, result.topics, strict=True):
        assert dict(view.ledger) == topic.ledger
        assert (view.sent, view.delivered, view.pdr, view.goodput_Bps) == (
            topic.sent,
            topic.delivered,
            topic.pdr,
            topic.goodput_Bps,
        )
        assert view.path_error_m == topic.path_error_m
        assert view.latency_cdf_s == topic.latency_cdf_s
    # History stops with the run.
    assert len(after.series[0].t) == len(before.series[0].t) == 1


def test_a_run_that_failed_keeps_what_was_seen() -> None:
    state = make()
    lossy_run(1, state)
    before = state.tick(60.0)
    state.finish(None, failed=True)
    after = state.tick(60.0)
    assert after.phase == "failed"
    assert after.topics == before.topics


def test_before_anything_happens() -> None:
    snapshot = make().tick(5.0)
    assert (snapshot.phase, snapshot.sent, snapshot.pdr, snapshot.elapsed_s) == ("waiting", 0, None, 0.0)
    assert [topic.name for topic in snapshot.topics] == list(NAMES.values())
    assert all(topic.pdr is topic.latency_s is topic.age_now_s is topic.pdr_now is None for topic in snapshot.topics)


def test_the_error_is_what_the_other_robot_believes_wrongly() -> None:
    outage = {"on": False}
    state = make()
    feed = Feed(state, lost=lambda _number: outage["on"], packet_len=64)
    for step in range(50):
        outage["on"] = step >= 30
        feed.submit(0, at(step, 0.0), step / 5)
        feed.fly(step / 5, latency=0.0)
    snapshot = state.tick(10.0)
    (path,) = snapshot.paths
    assert (path.truth, path.belief, path.error_m) == ((49.0, 0.0), (29.0, 0.0), 20.0)
    assert path.sent_x[-1] == 49
    assert path.received_x[-1] == 29
    assert path.errors_m[-1] == pytest.approx(20)
    assert path.errors_m[10] == pytest.approx(1)  # before the packet of that very position arrives
    assert snapshot.topics[0].age_now_s == pytest.approx(10.0 - 29 / 5)


def test_now_means_the_last_seconds() -> None:
    outage = {"on": False}
    state = make()
    feed = Feed(state, lost=lambda _number: outage["on"], packet_len=64)
    for step in range(200):
        outage["on"] = step >= 100
        feed.submit(0, at(step, 0.0), step / 10)
        feed.fly(step / 10, latency=0.0)
        if step in (99, 199):
            topic = state.tick(step / 10).topics[0]
            assert topic.pdr_now == (1.0 if step == 99 else 0.0)
    assert topic.pdr == 0.5
    assert topic.goodput_now_Bps == 0


@pytest.mark.parametrize("with_ledger", [True, False])
def test_a_repeat_counts_only_where_it_delivers_the_message_it_repeats(with_ledger: bool) -> None:
    recorder = Recorder(REGISTRY, {SRC: "/robot_4"})
    state = make(recorder if with_ledger else None)
    latched = {"raw": SendOptions(durability="transient_local")}
    feed = Feed(recorder, state, lost=lambda number: number == 1, packet_len=64, topics=latched, repeat_s=2.0)
    feed.submit(1, b"the map", 10.0)
    feed.fly(10.0)
    feed.fly(12.5)
    assert feed.packets == 2
    topic = state.tick(13.0).topics[1]
    assert (topic.sent, topic.delivered, topic.ledger) == (1, 1, {"delivered": 1})
    assert topic.latency_s is not None
    assert topic.latency_s.max == pytest.approx(2.55)
    feed.forget()  # the other robot starts anew, and gets the map once more
    feed.fly(15.0)
    topic = state.tick(16.0).topics[1]
    assert (feed.packets, topic.sent, topic.delivered, topic.ledger) == (3, 1, 1, {"delivered": 1})


def test_packets_field_by_field() -> None:
    state = make()
    feed = Feed(state, lost=lambda number: number in (3, 4), packet_len=64, hop=5)
    feed.submit(1, bytes(300), 10.0)
    feed.fly(10.0)
    feed.hear(b"no packet", 11.0)
    *packets, refused = state.tick(12.0).last_packets
    assert [packet.missing for packet in packets] == [0, 0, 2, *[0] * (len(packets) - 3)]
    first = packets[0].packet
    assert first is not None
    assert (first.version, first.src_id, first.dst_id, first.hop, first.qos) == (0, SRC, 255, 5, 0)
    assert len(first.entries) == 1
    *_, entry, crc = packets[0].spans
    assert (entry.kind, entry.colour, entry.size, crc.kind) == ("entry", 1, 56, "crc")
    assert re.fullmatch(r"raw #\d+\[0/6\] 51 B", entry.text)
    assert [span.kind for span in packets[-1].spans] == ["head", "ids", "entry", "pad", "crc"]
    assert all(sum(span.size for span in packet.spans) == 64 for packet in packets)
    assert refused.refused.startswith("length:")
    assert refused.t == pytest.approx(1.0)


def test_topics_get_the_names_that_their_robot_announces() -> None:
    state = make()
    state.receiver_event(Delivered(9, 3, at(1, 2), 0, "key"), 1.0)
    assert [topic.name for topic in state.tick(1.0).topics if topic.src_id == 9] == ["/source_9/topic_3"]
    state.receiver_event(Announced(9, (AnnouncedTopic(3, "ground_truth", "nav_msgs/msg/Odometry"),)), 2.0)
    state.receiver_event(Delivered(9, 3, at(2, 3), 0, "later"), 3.0)
    (topic,) = [topic for topic in state.tick(3.0).topics if topic.src_id == 9]
    assert (topic.name, topic.type_name) == ("/source_9/ground_truth", "nav_msgs/msg/Odometry")
    assert any(path.name == topic.name for path in state.tick(3.0).paths), "its positions are shown from now on"


def test_what_comes_of_a_sender_that_is_not_observed_has_an_age() -> None:
    """At least: for how long it is here and was under way."""
    state = make()
    state.receiver_event(Delivered(9, 3, at(1, 2), 0, "key", age_s=0.25), 1.0)
    (topic,) = [topic for topic in state.tick(4.0).topics if topic.src_id == 9]
    assert topic.age_now_s == pytest.approx(3.25)
    assert topic.latency_s is None


def test_where_the_clock_of_a_sender_is_known_its_messages_have_a_latency() -> None:
    state, clock = make(), ClockOffset(3600.5, 0.002, 0, 0.0, 1, 3600.5, 0.002, 0.0)
    state.receiver_event(Delivered(9, 3, at(1, 2), 0, "key", hops=1, over=4, age_s=0.1, latency_s=0.75), 1.0)
    snapshot = state.tick(2.0, clocks={9: clock})
    [topic], [robot] = [topic for topic in snapshot.topics if topic.src_id == 9], snapshot.heard
    assert topic.latency_s is not None
    assert (topic.latency_s.p50, topic.age_now_s) == (0.75, 1.75)
    assert "3,600,500.0 ± 2.0 ms" in heard_html(snapshot)
    assert robot.clock == clock


def test_one_end_of_a_link_does_not_say_what_arrives_of_what_it_sends() -> None:
    """It sends to others, and hears others: 1 of 1 would be of different topics."""
    state = make()
    state.sender_event(SRC, Accepted(0, 0, at(1, 2), 1.0))
    state.receiver_event(Delivered(9, 0, at(1, 2), 0, "key"), 1.0)
    for shown in (state.tick(1.0), state.tick(2.0)):
        own, other = (next(topic for topic in shown.topics if topic.src_id == src_id) for src_id in (SRC, 9))
        assert (own.sent, other.delivered) == (1, 1)
        assert (own.goes, own.comes, other.goes, other.comes) == (True, False, False, True)
        assert own.pdr is own.pdr_now is other.pdr is shown.pdr is None
        assert not own.ledger
        assert np.isnan(shown.series[0].pdr).all()
        assert other.name == "/source_9/topic_0", (
            "what an id of another robot means does not stand in this one's registry"
        )


def test_topics_found_while_the_source_runs_have_their_names_on_the_graph() -> None:
    state = make()
    found = Topic(5, "found", "nav_msgs/msg/Odometry", SendOptions())
    state.subscribed(SRC, [("/robot_4/found", found)])
    state.sender_event(SRC, Accepted(0, 5, at(1, 2), 1.0))
    assert [topic.name for topic in state.tick(1.0).topics if topic.topic_id == 5] == ["/robot_4/found"]


def test_queues_and_colours_go_with_their_topic() -> None:
    state = make()
    lossy_run(1, state)
    snapshot = state.tick(60.0, {(SRC, 1): 17})
    assert [topic.queued for topic in snapshot.topics] == [None, 17]
    assert [topic.colour for topic in snapshot.topics] == [0, 1]
    assert snapshot.series[1].queued[-1] == 17
    assert np.isnan(snapshot.series[0].queued[-1])


def sizes(snapshot: Snapshot) -> dict[str, int]:
    """Items in everything that could grow."""
    return {
        "series": sum(len(line.t) for line in snapshot.series),
        "paths": sum(len(path.sent_x) + len(path.received_x) + len(path.errors_m) for path in snapshot.paths),
        "latency": sum(len(topic.latency_cdf_s) for topic in snapshot.topics),
        "packets": len(snapshot.last_packets),
    }


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="no /proc to read the memory from")
def test_18_minutes_at_35_hz_take_no_more_memory_than_ten() -> None:
    state = make(packet_len=220)
    lost = random.Random(1)
    feed = Feed(state, lost=lambda _number: lost.random() < 0.2, packet_len=220)
    payloads = [at(step, -step) for step in range(500)]
    early: tuple[dict[str, int], float] | None = None
    tick_at = 0.0
    for step in range(1080 * 35):
        now = step / 35
        feed.submit(0, payloads[step % len(payloads)], now)
        feed.fly(now)
        if now >= tick_at:
            tick_at += 2.0  # four times a real one's, for speed
            snapshot = state.tick(now)
        if step == 600 * 35:
            early = sizes(snapshot), resident_mb()
    snapshot = state.tick(1080.0)
    assert early is not None
    assert sizes(snapshot)["paths"] <= early[0]["paths"] + 3
    assert sizes(snapshot)["packets"] == PACKETS_SHOWN
    assert sizes(snapshot)["series"] <= 2 * 360
    assert snapshot.sent == 1080 * 35
    assert snapshot.delivered > 0.7 * snapshot.sent
    source = state._sources[SRC]
    assert len(source.messages) <= UNDER_WAY
    assert len(state._topics[SRC, 0].latencies) == LATENCIES
    assert resident_mb() - early[1] < 3


def test_packets_that_stand_at_the_newest_number_are_not_a_turn_ahead() -> None:
    """Version 1: repairs and reports have no number of their own, and a lost packet may be sent again."""
    sender, receiver = Robot(SRC, registry()), Robot(5)
    state = DashboardState(registry(), {}, 64)
    heard, lost = 0, random.Random(3)
    for slot in range(400):
        now = slot / 75
        if slot % 3 == 0:
            sender.end.messages.submit(0, slot.to_bytes(2, "little") * 10, now)
        for robot, other in ((sender, receiver), (receiver, sender)):
            data = robot.slot(now)
            for event in other.receive(data, now) if data is not None and lost.random() > 0.3 else ():
                state.receiver_event(event, now)
        for event in sender.events:
            if isinstance(event, SentPacket):
                state.sender_event(SRC, event)
        sender.events.clear()
        shown = state.tick(now).last_packets
        heard += sum(packet.missing for packet in shown)
        assert all(packet.missing < 30 for packet in shown)
    assert heard, "packets were missing"
    lost_now = state.tick(now).lost_now
    assert lost_now == pytest.approx(0.3, abs=0.06), "repairs and reports that came do not make it less"
    air = state.tick(now).packets
    assert air["air_repair"] > 0
    assert air["air_new"] + air["air_repair"] + air["air_report"] + air["air_hello"] == air["sent"]


def test_a_page_of_a_program_that_was_frozen_accuses_nobody() -> None:
    """Who was heard before it is `down` only after as long a silence from then on."""
    sender, state = Robot(SRC, registry()), DashboardState(registry(), {}, 64, tick_s=0.5)
    other = Robot(5)
    sender.end.messages.submit(0, b"x" * 20, 0.0)
    data = sender.slot(0.0)
    assert data is not None
    for event in other.receive(data, 0.0):
        state.receiver_event(event, 0.0)
    assert [state.tick(now).state for now in (0.5, 1.0, 60.0, 61.0)] == ["up"] * 4
    assert {state.tick(61.0 + 0.5 * n).state for n in range(1, 12)} == {"up", "down"}


def test_what_the_receiver_cannot_hear_is_not_judged() -> None:
    """In a team, the page shows what the first robot receives: its own topics are not among that."""
    state = DashboardState(REGISTRY, {**NAMES, (9, 0): "/robot_9/at"}, 64, ledger=dict, senders={9})
    feed = Feed(state, lost=lambda _: True, packet_len=64)
    for step in range(40):
        feed.submit(0, at(step, 0), step / 4)
        feed.fly(step / 4)
    shown = state.tick(10.0)
    assert [topic.name for topic in shown.topics] == ["/robot_9/at"]
    assert shown.packets["sent"] == 0
    assert not any("arrived" in alarm for alarm in shown.alarms)


def test_lost_packets_are_told_apart_from_lost_messages_with_marks_and_gaps() -> None:
    state = DashboardState(REGISTRY, NAMES, 64)
    feed = Feed(state, lost=lambda number: number % 4 == 0, packet_len=64)
    for step in range(80):
        feed.submit(0, at(step, 0), step / 8)
        feed.fly(step / 8)
        if step == 40:
            state.changed(step / 8)
        shown = state.tick(step / 8, snr_db=20.0)
    assert shown.lost_now == pytest.approx(0.25, abs=0.03)
    assert shown.air is not None
    assert shown.air.changes == pytest.approx((5.0,), abs=0.2)
    assert np.nanmax(shown.air.lost) < 0.4
    for step in range(4 * 12):
        shown = state.tick(10.0 + step / 4, snr_db=20.0)
    assert shown.old
    assert shown.lost_now is None
    assert shown.air is not None
    assert np.nanmin(shown.air.lost[shown.air.t > 10]) > 0.1, "the last packets that came do not say that none is lost"
    assert np.isnan(shown.air.snr_db[-1]), "a value of a packet long ago is none of now"
    assert shown.state == "down"


def test_no_more_air_is_used_than_there_is_when_a_page_begins() -> None:
    state = DashboardState(REGISTRY, NAMES, 64, airtime=lambda _size, _mcs: 0.02)
    feed = Feed(packet_len=64)
    feed.submit(0, at(0, 0), 0.0)
    data = feed.sender.next_packet(0.0)
    assert data is not None
    for step in range(100):
        state.sender_event(SRC, data._replace(now=step / 20 - 5.0))  # hellos before the first message
    live = Feed(state, packet_len=64)
    for step in range(100):
        live.submit(0, at(step, 0), step / 100)
        live.fly(step / 100, most=1)
        shown = state.tick(step / 100)
    assert shown.air is not None
    assert 0 < len(shown.air.t) < 10
    assert max(map(max, shown.air.busy.values())) < 2.5


def test_a_dead_link_comes_before_a_late_computer_and_after_the_run_its_share_decides() -> None:
    state = DashboardState(REGISTRY, NAMES, 64)
    feed = Feed(state, lost=lambda number: number > 3, packet_len=64)
    for step in range(60):
        feed.submit(0, at(step, 0), step / 4)
        feed.fly(step / 4)
        shown = state.tick(step / 4, late_s=0.06)
    assert shown.state == "down"
    assert "no robot has been heard" in shown.alarms[0]
    for delivered, verdict in ((0, "down"), (8, "degraded"), (10, "up")):
        topic = replace(shown.topics[0], sent=10, delivered=delivered, pdr=delivered / 10)
        assert Snapshot(phase="ended", topics=(topic,)).verdict == verdict


def test_a_slow_computer_does_not_paint_what_arrives_red() -> None:
    state = DashboardState(REGISTRY, NAMES, 64)
    Feed(state, packet_len=64).submit(0, at(0, 0), 0.0)
    topic, _ = state.tick(0.1).topics

    def said(state: str, delivered: int) -> str:
        view = replace(topic, sent=100, delivered=delivered, pdr=delivered / 100)
        return Snapshot(phase="running", state=state, topics=(view,)).delivery

    assert [said(state, 99) for state in ("up", "late", "degraded", "down")] == ["up", "up", "up", "down"]
    assert [said(state, 80) for state in ("up", "late", "degraded", "down")] == ["", "degraded", "degraded", "down"]
    assert Snapshot().delivery == ""


def test_no_more_than_all_arrives_in_the_last_seconds() -> None:
    state = DashboardState(REGISTRY, NAMES, 64)
    feed = Feed(state, packet_len=64)
    for step in range(40):
        feed.submit(0, at(step, 0), step / 4)
    feed.fly(9.9)
    assert state.tick(12.0).topics[0].pdr_now == 1.0


def test_packets_that_are_sent_into_an_outage_are_lost_and_not_unknown() -> None:
    lost = False
    state = DashboardState(REGISTRY, NAMES, 64, ledger=dict)
    feed = Feed(state, lost=lambda _: lost, packet_len=64)
    share = {}
    for step in range(200):
        lost = 80 <= step < 160
        feed.submit(0, at(step, 0), step / 10)
        feed.fly(step / 10)
        share[step / 10] = state.tick(step / 10).lost_now
    assert share[7.0] == 0.0
    assert share[10.5] == pytest.approx(0.5, abs=0.05), "half of the last 5 s"
    assert share[15.0] == 1.0
    assert share[18.5] == pytest.approx(2 / 3, abs=0.1), "what was sent in the last 5 s, not in all of the outage"
