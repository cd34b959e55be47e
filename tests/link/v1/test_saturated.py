"""Links that are full: version 1 takes no air from what is new, so that no topic is older than with version 0."""

from __future__ import annotations

import pytest

from bench.saturated import SCENARIOS, TOLERANCE, paced_ratios, ratios, run
from gr_ros2.link.events import Delivered
from gr_ros2.link.queues import PublisherQos
from gr_ros2.settings.config import SendOptions
from tests.link.v1.air import Air, Robot, registry
from tests.link.v1.test_relayed_reliable import Cell
from tests.link.v1.test_relaying import robot as relaying_robot

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")


@pytest.mark.slow
@pytest.mark.parametrize("loss", [0.0, 0.2])
@pytest.mark.parametrize("name", SCENARIOS)
def test_no_topic_is_older_than_with_version_0(name: str, loss: float) -> None:
    found = ratios(name, loss)
    assert found
    for topic, (ratio, note) in found.items():
        assert ratio <= TOLERANCE[loss], f"{topic}: {note}"


@pytest.mark.slow
def test_no_topic_is_older_where_packets_leave_as_soon_as_the_air_is_free() -> None:
    for topic, ratio in paced_ratios("six-topics-paced", 0.0, seeds=(1,)).items():
        assert ratio <= TOLERANCE[0.0], topic


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_a_repair_that_cannot_be_interrupted_delays_no_message(loss: float) -> None:
    (ratio,) = paced_ratios("paper-ofdm-paced", loss, seeds=(1,)).values()
    assert ratio <= TOLERANCE[loss]


@pytest.mark.slow
@pytest.mark.parametrize(("best_effort", "most"), [((), 1.25), (("odom",), TOLERANCE[0.2])])
def test_waiting_for_reports_makes_odometry_older_only_where_it_comes_in_order(
    best_effort: tuple[str, ...], most: float
) -> None:
    (ratio,) = paced_ratios("paper-ofdm-paced", 0.2, back=True, seeds=(1,), best_effort=best_effort).values()
    assert ratio <= most


@pytest.mark.parametrize("name", SCENARIOS[1:])
def test_a_full_link_repairs_nothing(name: str) -> None:
    _, air = run(name, 0.2, seconds=10.0)
    assert air["new"] > 0.9 * air["sent"]
    assert not air["repair"]


def test_a_full_link_that_nobody_answers_tells_its_topics_in_the_first_second() -> None:
    for seed in range(1, 9):
        topics, _ = run("six-topics-paced", 0.2, seconds=5.0, seed=seed)
        busy = [topic for topic in topics if topic.submitted > 100]
        assert busy
        assert all(topic.delivered > 5 for topic in busy)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("loss", [0.1, 0.3])
@pytest.mark.parametrize("best_effort", [(), ("imu",)])
def test_nothing_waits_for_long_on_a_full_link_where_topics_of_all_kinds_lose_packets(
    loss: float, best_effort: tuple[str, ...], seed: int
) -> None:
    """A message in order waits for every packet before it, also for those of the table and of best-effort topics."""
    sender, receiver = Robot(1, registry(odom=SendOptions(), imu=SendOptions())), Robot(2)
    for topic_id, name in enumerate(("odom", "imu")):
        sender.end.messages.follow(topic_id, PublisherQos(reliable=name not in best_effort))
    air = Air(sender, receiver, loss=loss, seed=seed)
    air.lost = lambda by, _: air.rng.random() < (0.8 if by is sender and air.now < 0.3 else loss)
    number, at = 0, 0.0
    while air.now < 8.0:
        for topic_id in (0, 1, 1):
            number += 1
            sender.end.messages.submit(topic_id, number.to_bytes(40, "little"), air.now)
        before = len(receiver.delivered())
        air.step()
        if any(event.topic_id == 0 for event in _delivered(receiver)[before:]):
            at = air.now
        assert air.now - at < 3.0


def _delivered(robot: Robot) -> list[Delivered]:
    return [event for event in robot.events if isinstance(event, Delivered)]


@pytest.mark.parametrize(("robots", "full", "loss"), [(2, 1, 0.6), (2, 2, 0.3), (4, 4, 0.55)])
def test_a_full_link_brings_in_order_what_it_took(robots: int, full: int, loss: float) -> None:
    """Receivers lacked ever more, and the order stood still as long as something new waited: with one repair for each
    new packet where more than half is lost, and where full packets have no room for reports."""
    topics = registry(few=SendOptions(queue="latest", reliability="best_effort"), many=SendOptions())
    if robots == 2:
        many = [Robot(1, topics), Robot(2, topics)]
        channel: Air | Cell = Air(*many, loss=loss)
    else:
        many = [relaying_robot(src_id, topics=topics, relay=False) for src_id in range(1, robots + 1)]
        channel = Cell(*many, loss=loss)
    channel.run(10)
    said = 0
    while channel.now < 50:
        for one in many[:full]:
            while one.end.messages.queued()[1] < 10:
                said += 1
                one.end.messages.submit(1, b"%45d" % said, channel.now)
        channel.run(0.1)
    came = sum(len(payload) == 45 for one in many for payload in one.delivered())
    assert came >= 0.8 * (robots - 1) * said
