"""The judgement of a live link, from counters handed to it."""

from __future__ import annotations

from typing import Any

import pytest

from gr_ros2.gr.health import Level, LinkHealth, Status
from gr_ros2.settings.config import DiagnosticsConfig


def stats(**changes: Any) -> dict[str, Any]:
    """What a link would say after a quiet start."""
    values: dict[str, Any] = {
        "out": 0, "packets": 0, "missing": 0, "rejected": 0, "delivered": 0, "lost": 0, "latency": None, "age": None,
        "queued": 0, "depth": 100, "queue": "fifo", "snr_db": None, "lost_on_graph": 0, "unpublished": 0,
        "state_unsaved": 0, "hops": 0, **changes,
    }  # fmt: skip
    latency = None if values["latency"] is None else {"p50": values["latency"], "p95": 2 * values["latency"]}
    return {
        "source": {
            "topics": {
                "/odom": {
                    "sent": 7,
                    "queued": values["queued"],
                    "queue": values["queue"],
                    "queue_depth": values["depth"],
                    "refused": {"stale": 3},
                    "lost_on_graph": values["lost_on_graph"],
                },
                "/map": {
                    "sent": 0,
                    "queued": values["queued"],
                    "queue": "fifo",
                    "queue_depth": 1000,
                    "refused": {},
                    "lost_on_graph": 0,
                },
            }
        },
        "sink": {
            "packets": values["packets"],
            "packet_loss_est": values["missing"],
            "rejected": {"crc": values["rejected"]},
            "dropped": {"state_not_written": values["state_unsaved"]},
            "silence_s": {},
            "held_bytes": 0,
            "publish_failed": values["unpublished"],
            "topics": {
                "/rx_robot_2/odom": {
                    "delivered": values["delivered"],
                    "lost": {"expired": values["lost"]},
                    "recent_latency_s": latency,
                    "age_s": values["age"],
                    "hops": values["hops"],
                    "over": 3 if values["hops"] else None,
                }
            },
        },
        "peers": [],
        "packets": {"out": values["out"], "backlog": 0, "damaged": 0, "foreign": 0},
        "phy": {"airtime_s": 0.01, "snr_db": values["snr_db"]},
        "front_end": {"name": "sim", "passed": {}, "lost": {}},
        "airtime": {"transmits": True, "sent_s": 0.0, "refused": {}, **values.get("airtime", {})},
    }


def parts(health: LinkHealth, now: float, **changes: Any) -> tuple[Status, Status, Status]:
    receiver, transmitter, topic = health.judge(stats(**changes), now)
    return receiver, transmitter, topic


def make(**limits: Any) -> LinkHealth:
    return LinkHealth(DiagnosticsConfig(**limits), "link")


def test_a_quiet_start_is_ok() -> None:
    for status in make().judge(stats(), 0.0):
        assert (status.level, status.message) == (Level.OK, "OK")


@pytest.mark.parametrize(
    ("missing", "level"), [(0, Level.OK), (10, Level.OK), (40, Level.WARN), (200, Level.ERROR), (-5, Level.OK)]
)
def test_packet_loss_is_a_share_of_the_last_seconds(missing: int, level: Level) -> None:
    health = make()
    parts(health, 0.0, packets=1000, missing=900)
    receiver, _, _ = parts(health, 1.0, packets=1100, missing=900 + missing)
    assert receiver.level is level
    lost = max(missing, 0)
    assert float(receiver.values["packet loss"]) == pytest.approx(lost / (100 + lost), abs=1e-2)
    assert receiver.values["packets received (1/s)"] == "100"


def test_what_is_long_past_does_not_count() -> None:
    health = make()
    parts(health, 0.0)
    assert parts(health, 1.0, packets=10, missing=90)[0].level is Level.ERROR
    for second in range(2, 13):
        receiver, _, _ = parts(health, float(second), packets=10 + 10 * second, missing=90)
    assert (receiver.level, receiver.values["packet loss"]) == (Level.OK, "0")


def test_a_state_file_that_cannot_be_written_is_shown() -> None:
    health = make()
    parts(health, 0.0)
    receiver, _, _ = parts(health, 1.0, state_unsaved=2)
    assert (receiver.level, receiver.message) == (Level.WARN, "2 times that the state file could not be written")


def test_silence_counts_from_the_last_packet() -> None:
    health = make(silence_s=(3, 10), period_s=5)
    assert parts(health, 0.0)[0].values["silence (s)"] == "nothing received yet"
    levels = [parts(health, now, packets=1)[0].level for now in (1.0, 4.0, 4.1, 11.1)]
    assert levels == [Level.OK, Level.OK, Level.WARN, Level.ERROR]


def test_topics_are_judged_each() -> None:
    health = make(latency_s=(0.5, 2), age_s=(1, 0))
    parts(health, 0.0)
    *_, topic = parts(health, 1.0, delivered=60, lost=40, latency=0.7, age=0.2)
    assert topic.level is Level.WARN
    assert topic.message == "messages lost 0.4; latency 0.7 s"
    assert topic.values["latency, 95 % (s)"] == "1.4"
    *_, topic = parts(health, 2.0, delivered=120, lost=40, latency=2.5, age=1.5)
    assert topic.level is Level.ERROR
    assert "age 1.5 s" in topic.message


def test_the_transmitter_tells_airtime_queues_and_drops() -> None:
    health = make()
    parts(health, 0.0)
    _, transmitter, _ = parts(health, 2.0, out=100, queued=9, depth=10, airtime={"sent_s": 1.0})
    assert transmitter.level is Level.WARN
    assert transmitter.message == "fullest queue 0.9"
    assert transmitter.values["airtime used"] == "0.5"
    assert transmitter.values["messages dropped: stale"] == "3"


def test_figures_of_the_last_seconds() -> None:
    health = make()
    parts(health, 0.0, out=5, packets=7, delivered=3, lost=3)
    assert health.recent() == (0.0, 0.0, 0.0, None)
    parts(health, 2.0, out=25, packets=17, delivered=9, lost=5, airtime={"sent_s": 0.5})
    assert health.recent() == (10.0, 5.0, 0.25, 0.75)


def test_of_several_radios_the_busiest_counts_also_one_that_was_opened_again() -> None:
    health = make()

    def judge(now: float, near_s: float, far_s: float) -> float:
        shared = stats()
        radio = {"present": True, "carries": True, "heard": {}, "sent": 0, "copied": 0, "skipped": 0, "came": 0}
        shared["radios"] = {
            name: {**radio, "copies": 0, "airtime": {"sent_s": sent_s}}
            for name, sent_s in (("near", near_s), ("far", far_s))
        }
        health.judge(shared, now)
        return health.recent().air

    assert judge(0.0, 3.0, 5.0) == 0.0
    assert judge(2.0, 3.5, 6.0) == 0.5
    assert judge(4.0, 0.4, 6.0) == 0.25


@pytest.mark.parametrize("queue", [{"depth": 0}, {"depth": 1, "queue": "latest"}])
def test_a_queue_without_a_bound_or_of_the_newest_alone_is_never_full(queue: dict[str, Any]) -> None:
    _, transmitter, _ = parts(make(), 0.0, queued=9, **queue)
    assert (transmitter.level, transmitter.values["fullest queue"]) == (Level.OK, "0.009")
    alone = stats(queued=9, **queue)
    del alone["source"]["topics"]["/map"]
    assert "fullest queue" not in make().judge(alone, 0.0)[1].values


def test_the_snr_is_told_where_it_is_known() -> None:
    assert parts(make(), 0.0, snr_db=17.25)[0].values["SNR (dB)"] == "17.2"
    assert "SNR (dB)" not in parts(make(), 0.0)[0].values


def test_what_comes_over_others_says_over_whom_and_its_link_is_lost_when_nothing_comes_any_more() -> None:
    health = make(period_s=10)
    assert "hops" not in parts(health, 0.0)[2].values
    topic = parts(health, 1.0, hops=2)[2]
    assert (topic.values["hops"], topic.values["over robot"]) == ("2", "3")
    reached = {
        **stats(),
        "peers": [{"robot": 7, "heard_s": 0.5, "hops": 2, "over": 3, "doubled": False, "clock": None}],
    }
    state = health.links(reached, health.judge(reached, 2.0)[0])[7]
    assert (state.message, state.values) == ("up", {"age (s)": "0.50", "hops": "2", "over robot": "3"})
    reached["peers"][0]["doubled"] = True
    state = health.links(reached, health.judge(reached, 2.0)[0])[7]
    assert (state.level, state.message) == (Level.WARN, "up; two robots have this number")
    state = health.links(stats(), health.judge(stats(), 20.0)[0])[7]
    assert (state.message, state.values) == ("lost", {"age (s)": "18.50"})


def test_a_link_that_was_frozen_itself_accuses_nobody_and_counts_anew() -> None:
    health = make()

    def judged(now: float, silence_s: float) -> tuple[Status, Status]:
        values = stats(packets=9)
        values["sink"]["silence_s"] = {2: silence_s}
        receiver = health.judge(values, now)[0]
        return receiver, health.links(values, receiver)[2]

    judged(0.0, 0.1)
    for receiver, link in (judged(1.0, 0.6), judged(13.0, 12.6)):
        assert (receiver.level, link.message) == (Level.OK, "up")
    assert link.values == {"age (s)": "12.60"}, "how old it is remains true"
    told = [judged(13.0 + n, 12.6 + n)[1].message for n in range(1, 10)]
    assert (told[0], told[-1]) == ("degraded", "lost")


def test_a_limit_of_zero_is_none() -> None:
    health = make(loss=(0, 0), silence_s=(0, 0))
    parts(health, 0.0)
    parts(health, 1.0, packets=1, missing=99)
    assert parts(health, 99.0, packets=1, missing=99)[0].level is Level.OK


def test_what_a_front_end_loses_warns_once_and_is_named() -> None:
    health = make()
    at = iter(range(10))

    def front_end(passed: dict[str, int], **lost: int) -> Status:
        values = {**stats(), "front_end": {"name": "uhd", "passed": passed, "lost": lost}}
        (status,) = (status for status in health.judge(values, float(next(at))) if status.name == "link: front end")
        return status

    assert front_end({"bursts_out": 5}, underflows=0).message == "OK"
    grown = front_end({"bursts_out": 9, "blanked": 700}, underflows=2, sequence_errors=1)
    assert (grown.level, grown.message) == (Level.WARN, "2 underflows; 1 sequence errors")
    assert grown.values == {"underflows": "2", "sequence errors": "1", "bursts out": "9", "blanked": "700"}
    assert front_end({"bursts_out": 12, "blanked": 900}, underflows=2, sequence_errors=1).level == Level.OK


def test_what_the_ros_graph_lost_and_what_was_not_published_warn_while_they_are_new() -> None:
    health = make()
    told = [
        parts(health, now, lost_on_graph=lost, unpublished=lost // 2)[:2]
        for now, lost in ((0, 2), (5, 2), (9, 6), (30, 6))
    ]
    assert [transmitter.message for _, transmitter in told] == [
        "2 messages lost on the ROS graph", "OK", "4 messages lost on the ROS graph", "OK",
    ]  # fmt: skip
    assert [receiver.message for receiver, _ in told] == [
        "1 messages not published", "OK", "2 messages not published", "OK",
    ]  # fmt: skip
    assert [transmitter.level for _, transmitter in told] == [Level.WARN, Level.OK, Level.WARN, Level.OK]
    receiver, transmitter = told[-1]
    assert transmitter.values["messages lost on the ROS graph"] == "6"
    assert receiver.values["messages not published"] == "3"


def test_what_a_front_end_lost_before_the_first_look_is_told() -> None:
    values = {**stats(), "front_end": {"name": "uhd", "passed": {}, "lost": {"overflows": 3}}}
    assert [status.message for status in make().judge(values, 0.0)] == ["OK", "OK", "3 overflows", "OK"]


def test_a_front_end_that_counts_nothing_is_no_part() -> None:
    assert len(make().judge(stats(), 0.0)) == 3


def test_every_topic_has_its_counters() -> None:
    _, transmitter, topic = parts(make(), 0.0, delivered=11, lost=2)
    assert (topic.values["messages delivered"], topic.values["messages lost: expired"]) == ("11", "2")
    assert transmitter.values["/odom (sent, dropped)"] == "7, 3"
