"""An endpoint of version 1: what it delivers, to whom, in which order, and what it does without being asked."""

from __future__ import annotations

from dataclasses import replace

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.link import AirPacket
from gr_ros2.link.events import Announced, Delivered, Lost, Met, Refused, SentPacket
from gr_ros2.link.queues import PublisherQos
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.sealing import SealMode
from gr_ros2.relay.robots import GONE_S
from gr_ros2.settings.config import NOBODY, SendOptions
from gr_ros2.settings.registry import Registry
from gr_ros2.wire.v1 import MAX_MESSAGE, MAX_TOPICS, Part, body_room, read_header
from tests.link.v1.air import SLOT_S, Air, Robot, registry

MODES: list[SealMode] = ["none", "authenticate", "encrypt"]
ODOM, SCAN, MAP = 0, 1, 2
LATCHED = SendOptions(durability="transient_local", qos="bulk")


def text(number: int, size: int = 40) -> bytes:
    return f"message {number} ".encode().ljust(size, b".")


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("fixed", [True, False])
def test_messages_cross_both_ways_with_nothing_known_beforehand(mode: SealMode, fixed: bool) -> None:
    one, two = (Robot(n, registry(), mode=mode, any_length=not fixed) for n in (1, 2))
    air = Air(one, two, loss=0.2)
    for number in range(60):
        one.end.messages.submit(ODOM, text(number), air.now)
        two.end.messages.submit(MAP, text(number, 300), air.now) if number % 10 == 0 else None
        air.run(0.03)
    air.run(2.0)
    assert two.delivered() == [text(number) for number in range(60)]
    assert one.delivered() == [text(number, 300) for number in range(0, 60, 10)]
    rows = [event.topics for event in two.events if isinstance(event, Announced)][-1]
    assert [(row.name, row.type_name, row.reliable) for row in rows] == [
        ("odom", "std_msgs/msg/String", True),
        ("scan", "std_msgs/msg/String", False),
        ("map", "std_msgs/msg/String", True),
    ]
    assert all(len(data) <= 64 and (len(data) == 64 or not fixed) for _, data in air.recorded)
    assert not one.end.received.rejected
    assert any(text(7) in data for _, data in air.recorded) == (mode != "encrypt")


def test_nothing_but_new_packets_and_reports_leaves_without_losses() -> None:
    one, two = Robot(1, registry()), Robot(2)
    air = Air(one, two)
    air.run(1.5)
    before = one.end.sent.air["new"]
    for number in range(100):
        one.end.messages.submit(ODOM, text(number), air.now)
        air.run(0.05)
    assert len(two.delivered()) == 100
    assert one.end.sent.air["new"] - before == 100
    assert one.end.sent.air["repair"] == 0


def test_the_sending_thread_need_not_look_after_every_packet_and_credit() -> None:
    one, two = Robot(1, registry()), Robot(2)
    air = Air(one, two)
    air.run(1.5)
    one.end.messages.submit(ODOM, text(1), air.now)
    air.run(3 * SLOT_S)
    now = air.now
    one.end.messages.submit(ODOM, text(2), now)
    message = one.slot(now)
    assert message is not None
    two.end.receive(AirPacket(message), now)
    due = two.end.next_departure(credited=True)
    assert not two.end.urgent, "a message alone lets nothing leave"
    assert due is not None
    assert due > now, "its report may wait"
    assert one.end.next_departure() is None, "its credit is used"
    later = one.end.next_departure(credited=True)
    assert later is not None
    assert later > now, "a credit alone lets nothing leave"
    one.end.messages.add([("late", "std_msgs/msg/String", SendOptions())])
    one.slot(now)  # the new row, which is lost
    hello = one.slot(now)
    assert hello is not None
    two.end.receive(AirPacket(hello), now)
    assert two.end.urgent, "it asks for the row"
    two.slot(now)
    assert not two.end.urgent


def test_reports_become_rare_while_nothing_is_lost_and_frequent_again_after_a_loss() -> None:
    one, two = Robot(1, registry()), Robot(2)
    air = Air(one, two)

    def reports(seconds: float) -> int:
        """How many reports leave in so many seconds of odometry."""
        before, end = two.end.sent.air["report"], air.now + seconds
        while air.now < end:
            one.end.messages.submit(ODOM, text(0), air.now)
            air.run(0.03)
        return two.end.sent.air["report"] - before

    assert reports(2.0) >= 16
    reports(10.0)
    assert reports(5.0) <= 12
    assert one.end.sent.air["repair"] == 0
    air.lost = lambda sender, _: sender is one
    one.end.messages.submit(ODOM, text(0), air.now)
    air.run(3 * SLOT_S)
    air.lost = lambda *_: False
    assert reports(1.0) >= 8


@pytest.mark.parametrize("half_duplex", [False, True])
def test_while_packets_get_lost_more_is_reported_where_that_takes_no_slot_from_packets(half_duplex: bool) -> None:
    one, two = Robot(1, registry()), Robot(2, half_duplex=half_duplex)
    air = Air(one, two, loss=0.2)
    for number in range(200):
        one.end.messages.submit(ODOM, text(number), air.now)
        air.run(0.1)
    air.run(3.0)
    assert len(two.delivered()) == 200
    reports, arrived = two.end.sent.air["report"], two.end.received.packets
    assert (reports > 0.55 * arrived) != half_duplex
    assert (reports < 0.4 * arrived) == half_duplex


def test_a_topic_where_only_the_newest_matters_drops_what_is_overtaken() -> None:
    one, two = Robot(1, registry(), hears=False), Robot(2, hears=False)
    air = Air(one, two)
    air.run(0.5)
    lose = [True]
    air.lost = lambda *_: lose[0]
    one.end.messages.submit(SCAN, text(1), air.now)
    air.run(2 * SLOT_S)
    one.end.messages.submit(SCAN, text(2), air.now)
    air.run(2 * SLOT_S)
    lose[0] = False
    air.run(0.5)
    assert two.delivered() == [text(2)]


@pytest.mark.parametrize("mode", ["none", "authenticate", "encrypt"])
def test_an_end_without_an_id_listens(mode: SealMode) -> None:
    one, listener = Robot(1, registry(), mode=mode, hears=False), Robot(NOBODY, mode=mode, hears=False)
    air = Air(one, listener)
    air.run(0.5)
    one.end.messages.submit(SCAN, text(1), air.now)
    air.run(0.5)
    assert listener.delivered() == [text(1)]
    assert not listener.end.sent.air


def test_a_message_waits_for_an_earlier_one_and_not_for_ever() -> None:
    one, two = Robot(1, registry(), hears=False, repair="off"), Robot(2, hears=False, hold_s=0.3)
    air = Air(one, two)
    air.run(0.5)
    lose = [True]
    air.lost = lambda *_: lose[0]
    one.end.messages.submit(ODOM, text(1), air.now)
    air.run(4 * SLOT_S)  # a hello and the table of topics may go before it
    lose[0] = False
    one.end.messages.submit(ODOM, text(2), air.now)
    air.run(0.2)
    assert two.delivered() == []
    assert two.end.next_timeout() is not None
    waited = air.run(1.0, lambda: bool(two.delivered()))
    assert two.delivered() == [text(2)]
    assert waited < 0.15


@pytest.mark.parametrize("delay", [1, 8, 38])
def test_a_robot_that_joins_late_has_what_is_kept_within_two_round_trips(delay: int) -> None:
    topics = registry(odom=SendOptions(), map=LATCHED)
    one, two, late = Robot(1, topics), Robot(2), Robot(3)
    air = Air(one, two, delay=delay)
    one.end.messages.submit(1, text(1, 700), air.now)
    air.run(20.0)
    assert two.delivered() == [text(1, 700)]
    sent = one.end.sent.air["new"]
    air.run(60.0)
    assert one.end.sent.air["new"] == sent  # nothing is repeated: both have it
    air.robots.append(late)
    air.run(5.0, lambda: any(isinstance(event, Met) for event in late.events))
    waited = air.run(10.0, lambda: bool(late.delivered()))
    packets = -(-700 // 46)
    assert late.delivered() == [text(1, 700)]
    round_trip = 2 * delay * SLOT_S
    assert waited <= 2 * round_trip + (packets + 8) * SLOT_S  # with the packets of the map and of the table
    assert two.delivered() == [text(1, 700)]


@pytest.mark.parametrize(("mode", "restarts"), [("none", False), ("encrypt", True)])
def test_who_joins_while_a_message_is_under_way_gets_no_more_than_its_beginning_again(
    mode: SealMode, restarts: bool
) -> None:
    """Two join one after the other, and the first of them may start again after that."""
    one, first = Robot(1, registry(odom=SendOptions(), map=LATCHED), mode=mode), Robot(2, mode=mode)
    joiners = [Robot(3, mode=mode), Robot(4, mode=mode)]
    air, size = Air(one, first, loss=0.2), 12_000
    air.run(1.0)
    one.end.messages.submit(1, text(1, size), air.now)

    def left(share: float) -> bool:
        return one.end.sent.payload_bytes >= share * size

    air.run(60.0, lambda: left(0.2))
    air.robots.append(joiners[0])
    air.run(60.0, lambda: left(0.4))
    air.robots.append(joiners[1])
    air.run(60.0, lambda: left(0.6))
    if restarts:
        joiners[0].start()
    robots = [first, *joiners]
    air.run(60.0, lambda: all(robot.delivered() for robot in robots))
    air.run(10.0)
    assert [robot.delivered() for robot in robots] == [[text(1, size)]] * 3
    begun = 0.6 if restarts else 0.4  # when the last of them came
    assert one.end.sent.payload_bytes < (1 + begun + 0.1) * size


@pytest.mark.parametrize("hears", [True, False])
def test_several_messages_are_kept_of_a_topic_whose_depth_is_set(hears: bool) -> None:
    topics = registry(odom=SendOptions(), map=replace(LATCHED, depth=10))
    settings = {"hears": hears, "repeat_s": 0.0 if hears else 3.0}
    one, two, late = Robot(1, topics, **settings), Robot(2, hears=hears), Robot(3, hears=hears)
    air = Air(one, two)
    sent = [text(number) for number in range(5)]
    for payload in sent:
        one.end.messages.submit(1, payload, air.now)
        air.run(1.0)
    air.run(20.0)
    assert two.delivered() == sent
    air.robots.append(late)
    air.run(20.0)
    assert late.delivered() == sent
    repeats = one.end.sent.repeats
    air.run(60.0)
    assert (one.end.sent.repeats == repeats) == hears
    assert two.delivered() == late.delivered() == sent


@pytest.mark.parametrize("hears", [True, False])
def test_an_earlier_map_never_comes_after_a_later_one(hears: bool) -> None:
    """A mapper whose depth its graph does not tell (Fast DDS) starts three times; then the robots' links do."""
    topics = registry(odom=SendOptions(), map=LATCHED)
    settings = {"hears": hears, "repeat_s": 0.0 if hears else 3.0}
    one, two = Robot(1, topics, **settings), Robot(2, hears=hears)
    air = Air(one, two, loss=0.2)
    for number in range(3):
        one.end.messages.follow(1, PublisherQos(latched=True, depth=10))
        one.end.messages.submit(1, text(number, 300), air.now)
        air.run(20.0)
    assert two.delivered() == [text(number, 300) for number in range(3)]
    rows = [event.topics for event in two.events if isinstance(event, Announced)][-1]
    assert [row.depth for row in rows if row.latched] == [1]
    before = len(two.delivered())
    two.start()
    air.run(20.0)
    assert two.delivered()[before:] == [text(2, 300)]
    one.start()
    one.end.messages.submit(1, text(2, 300), air.now)  # the mapper is still there
    air.run(20.0)
    assert two.delivered()[before:] == [text(2, 300)]


def test_topics_that_come_later_are_announced_and_keep_what_their_publishers_keep() -> None:
    one, two = Robot(1), Robot(2)
    air = Air(one, two, loss=0.2)
    air.run(2.0)
    for number in range(MAX_TOPICS):
        one.end.messages.add([(f"topic_{number}", "std_msgs/msg/String", SendOptions())])
        one.end.messages.follow(number, PublisherQos(latched=number == 7))
    with pytest.raises(ConfigError, match="241 topics; a link carries at most 240"):
        one.end.messages.add([("one_more", "std_msgs/msg/String", SendOptions())])
    sent = [text(number) for number in range(MAX_TOPICS)]
    for number in reversed(range(MAX_TOPICS)):
        one.end.messages.submit(number, sent[number], air.now)
    air.run(60.0, lambda: len(two.delivered()) == MAX_TOPICS)
    assert sorted(two.delivered()) == sorted(sent)
    rows = [event.topics for event in two.events if isinstance(event, Announced)][-1]
    assert [row.topic_id for row in rows if row.latched] == [7]
    assert one.end.messages.topics is not None
    assert len(rows) == len(one.end.messages.topics) == MAX_TOPICS
    late = Robot(3)
    air.robots.append(late)
    air.run(60.0, lambda: bool(late.delivered()))
    assert late.delivered() == [sent[7]]


def test_a_kept_message_with_the_same_bytes_as_the_one_before_comes_out_once() -> None:
    """As the page on the wire format says: it cannot be told from a repeat for a robot that joins late."""
    one, two = Robot(1, registry(odom=SendOptions(), map=LATCHED)), Robot(2)
    air = Air(one, two)
    for number in (1, 1, 2, 1):
        one.end.messages.submit(1, text(number), air.now)
        air.run(2.0)
    assert two.delivered() == [text(1), text(2), text(1)]
    assert two.end.received.repeats >= 1


def test_an_older_hello_makes_nobody_ask_for_what_was_replaced() -> None:
    """A new map comes before the next hello, which names it."""
    latched = SendOptions(queue="latest", reliability="reliable", durability="transient_local")
    one, two = Robot(1, registry(map=latched)), Robot(2)
    air = Air(one, two)
    air.run(5.0)
    before = one.end.sent.repeats
    for number in range(10):
        one.end.messages.submit(0, b"map %d" % number, air.now)
        air.run(3.7)
    assert two.delivered() == [b"map %d" % number for number in range(10)]
    assert one.end.sent.repeats == before


def test_where_nobody_can_ask_what_is_kept_is_repeated() -> None:
    topics = registry(odom=SendOptions(), map=LATCHED)
    one, late = Robot(1, topics, hears=False, repeat_s=3.0), Robot(3, hears=False)
    air = Air(one)
    one.end.messages.submit(1, text(1, 300), air.now)
    air.run(5.0)
    air.robots.append(late)
    air.run(9.0)
    assert late.delivered() == [text(1, 300)]
    assert late.end.received.repeats >= 1


def test_a_robot_that_nobody_hears_falls_silent_and_is_there_for_a_newcomer() -> None:
    one, late = Robot(1, registry(odom=SendOptions(), map=LATCHED)), Robot(3)
    air = Air(one)
    packets = -(-2500 // 46)
    one.end.messages.submit(1, text(1, 2500), air.now)
    air.run(20.0)
    assert len(air.recorded) < 5 * packets
    air.run(310.0)  # the map has been repeated after up to 310 s
    before = len(air.recorded)
    air.run(60.0)
    assert len(air.recorded) - before < 10
    air.robots.append(late)
    air.run(5.0, lambda: any(isinstance(event, Met) for event in late.events))
    waited = air.run(10.0, lambda: bool(late.delivered()))
    assert late.delivered() == [text(1, 2500)]
    assert waited <= (packets + 12) * SLOT_S  # two round trips, the map and the table


def test_where_nobody_reports_repair_is_bounded_by_the_losses_that_are_expected() -> None:
    """Though the receiver could be anyone: what it lacks with the loss that is expected, it gets."""
    missing = 0
    for seed in range(100):
        one, two = Robot(1, registry(), hears=False), Robot(2, hears=False)
        air = Air(one, two, loss=0.2, seed=seed)
        air.run(3.0)
        before = one.end.sent.air["repair"]
        one.end.messages.submit(ODOM, text(seed), air.now)
        air.run(3.0)
        assert 3 <= one.end.sent.air["repair"] - before <= 12
        missing += two.delivered() != [text(seed)]
    assert missing <= 1


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("who", ["sender", "receiver", "both"])
def test_restarts_are_recovered_from_within_two_seconds(mode: SealMode, who: str) -> None:
    one, two = Robot(1, registry(), mode=mode), Robot(2, mode=mode)
    air = Air(one, two, loss=0.2)
    number = 0
    for restart in range(20):
        if who != "receiver":
            one.start()
        if who != "sender":
            two.start()
        first = number
        begin = air.now
        while air.now - begin < 2.0:
            one.end.messages.submit(ODOM, text(number), air.now)
            number += 1
            air.run(0.03)
        here = [int(payload.split()[1]) for payload in two.delivered()]
        assert here == sorted(set(here)), f"restart {restart}"
        assert here
        assert here[-1] >= first + (number - first) // 2, f"restart {restart}: {here[-1]} of {first}..{number}"


def test_a_sender_starts_before_its_receiver_and_the_other_way_round() -> None:
    for first in (0, 1):
        robots = [Robot(1, registry()), Robot(2)]
        air = Air(robots[first])
        robots[0].end.messages.submit(ODOM, text(0), 0.0)
        air.run(3.0)
        air.robots.append(robots[1 - first])
        air.run(0.2)
        robots[0].end.messages.submit(ODOM, text(1), air.now)
        air.run(1.0)
        assert text(1) in robots[1].delivered()


def test_packet_numbers_come_round() -> None:
    """Sealed, from shortly before the last number on; tests/link/v1/test_no_mixing.py has a whole life."""
    one, two = Robot(1, registry(), mode="encrypt"), Robot(2, mode="encrypt")
    one.end.window.packets.newest = one.end.window.packets.oldest = 64_000
    air = Air(one, two)
    air.run(0.2)
    count = 3_000
    for number in range(count):
        one.end.messages.submit(ODOM, text(number), air.now)
        if number % 500 < 495:
            data = one.slot(air.now)
            assert data is not None
            if number % 7:
                two.receive(data, air.now)
            air.now += 0.001
        else:
            air.step()
        if number % 20 == 0:
            air.step()
            while (data := one.slot(air.now)) is not None and one.end.messages.queued()[ODOM]:
                two.receive(data, air.now)
    air.run(2.0)
    here = [int(payload.split()[1]) for payload in two.delivered()]
    assert here == sorted(set(here))
    assert here[-1] == count - 1
    assert len(here) > 0.8 * count
    assert one.end.window.packets.newest > 65_536


def test_a_packet_for_another_robot_is_not_ours() -> None:
    one, two, three = Robot(1, registry(), dst_id=3), Robot(2), Robot(3)
    air = Air(one, two, three)
    one.end.messages.submit(ODOM, text(1, 35), air.now)
    air.run(2.0)
    assert three.delivered() == [text(1, 35)]
    assert two.delivered() == []
    assert two.end.received.dropped["not_for_us"] > 0


def test_a_long_message_is_given_up_when_its_memory_is_needed() -> None:
    one, two = Robot(1, registry(), hears=False), Robot(2, hears=False, max_source_bytes=20_000)
    air = Air(one, two)
    one.end.messages.submit(MAP, bytes(100_000), air.now)
    air.run(40.0)
    lost = [event for event in two.events if isinstance(event, Lost)]
    assert lost
    assert {event.reason for event in lost} <= {"memory", "expired", "given_up"}
    assert two.end.neighbours.all.get(1).inbox.held <= 20_000  # type: ignore[union-attr]


def test_an_announced_length_reserves_nothing() -> None:
    one, two = Robot(1, registry()), Robot(2)
    air = Air(one, two)
    air.run(1.0)
    inbox = two.end.neighbours.all.get(1).inbox  # type: ignore[union-attr]
    part = Part(MAP, b"x", 0, MAX_MESSAGE - 1, True)
    inbox.messages.take(inbox.newest, [part], 0, air.now, air.now, repaired=False)
    assert 0 < inbox.held < 1000


def test_a_message_beyond_the_largest_is_refused() -> None:
    one = Robot(1, registry())
    one.end.messages.submit(MAP, bytes(MAX_MESSAGE + 1), 0.0)
    assert [event.reason for event in one.events if isinstance(event, Refused)] == ["too_large"]


def test_a_lifespan_ends_repair_and_message() -> None:
    topics = registry(odom=SendOptions(queue="deadline", deadline_s=0.2))
    one, two = Robot(1, topics, hears=False), Robot(2, hears=False)
    air = Air(one, two)
    air.run(2.5)
    air.lost = lambda *_: True
    one.end.messages.submit(0, text(1), air.now)
    air.run(0.25)
    before = one.end.sent.air["repair"]
    assert before > 0
    air.lost = lambda *_: False
    air.run(1.0)
    assert one.end.sent.air["repair"] == before
    assert two.delivered() == []


def test_more_repairs_than_repair_ids_move_on_to_the_next_number() -> None:
    one, two = Robot(1, registry(), repair="idle"), Robot(2)
    air = Air(one, two)
    air.run(0.5)
    air.lost = lambda *_: True
    one.end.messages.submit(ODOM, text(1), air.now)
    air.run(GONE_S - 1)
    air.lost = lambda *_: False
    air.run(1.5)
    assert two.delivered() == [text(1)]
    packets = [data for robot, data in air.recorded if robot is one]
    assert len({data[:6] if read_header(data, 64).qos == 3 else data[:4] for data in packets}) == len(set(packets))


@pytest.mark.parametrize("mode", MODES)
def test_what_the_air_was_spent_on_adds_up(mode: SealMode) -> None:
    one, two = Robot(1, registry(), mode=mode), Robot(2, mode=mode)
    air = Air(one, two, loss=0.3)
    for number in range(100):
        one.end.messages.submit(ODOM, text(number), air.now)
        air.run(0.05)
    sent = [event for event in one.events if isinstance(event, SentPacket)]
    assert len(sent) == sum(one.end.sent.air.values()) == sum(robot is one for robot, _ in air.recorded)
    assert {"new", "repair", "hello"} <= {event.kind for event in sent}
    keys_sent = {part.key for event in sent for part in event.entries if part.topic_id == ODOM}
    keys_here = [event.key for event in two.events if isinstance(event, Delivered)]
    assert len(keys_here) == len(set(keys_here))
    assert set(keys_here) <= keys_sent
    assert any(event.repaired for event in two.events if isinstance(event, Delivered))


def test_settings_out_of_range_are_refused() -> None:
    for wrong in ({"packet_len": 30}, {"packet_len": 5000}, {"src_id": 255}):
        with pytest.raises(ConfigError):
            Settings(**{"src_id": 1, **wrong})
    assert body_room(Settings(1, packet_len=40).packet_len, sealed=True) >= 20


def test_a_service_is_announced_while_it_is_offered() -> None:
    rows = Registry.from_rows({"odom": "nav_msgs/Odometry", "add": "example_interfaces/srv/AddTwoInts"})
    one, two = Robot(1, rows.with_calls()), Robot(2)
    air = Air(one, two, loss=0.2)

    def known() -> list[str]:
        return [row.name for row in two.end.topics_of(1).values()]

    air.run(3.0)
    assert known() == ["odom"]
    for _ in range(3):
        one.end.messages.offer(1, offered=True)
        air.run(5.0, lambda: known() == ["odom", "add"])
        assert known() == ["odom", "add"]
        one.end.messages.offer(1, offered=False)
        air.run(5.0, lambda: known() == ["odom"])
        assert known() == ["odom"]


def test_a_robot_without_topics_announces_nothing_until_it_offers_something_and_then_also_that_it_is_over() -> None:
    one, two = Robot(1, Registry.empty().with_calls()), Robot(2)
    air = Air(one, two)
    air.run(2.0)
    assert one.end.messages.kept.digest == 0
    one.end.messages.offer(0, offered=True)
    air.run(1.0)
    assert [row.name for row in two.end.topics_of(1).values()] == ["_calls"]
    one.end.messages.offer(0, offered=False)
    air.run(1.0)
    assert not two.end.topics_of(1)


def test_a_service_that_is_there_from_the_start_is_announced_though_packets_are_lost() -> None:
    for seed in range(5):
        one, two = Robot(1, Registry.from_rows({"add": "example_interfaces/srv/AddTwoInts"}).with_calls()), Robot(2)
        one.end.messages.offer(0, offered=True)
        air = Air(one, two, loss=0.5, seed=seed)
        air.run(10.0, lambda: bool(two.end.topics_of(1)))  # noqa: B023 - called at once
        assert [row.name for row in two.end.topics_of(1).values()] == ["add"]


def test_a_packet_is_not_repaired_after_the_lifespan_of_its_message() -> None:
    one, two = Robot(1, Registry.empty().with_calls()), Robot(2)
    air = Air(one, two)
    one.end.messages.offer(0, offered=True)
    air.run(1.0)
    lose = [True]
    air.lost = lambda *_: lose[0]
    brief, long = text(1, 51), text(2, 51)  # a packet each: what shares one is repaired together
    one.end.messages.submit(0, brief, air.now, 0.5)
    one.end.messages.submit(0, long, air.now, 5.0)
    air.run(1.0)
    lose[0] = False
    air.run(3.0)
    assert two.delivered() == [long]


@pytest.mark.parametrize("mode", MODES)
def test_a_receiver_that_restarts_at_once_gets_no_message_twice(mode: SealMode) -> None:
    one, two = Robot(1, registry(), mode=mode), Robot(2, mode=mode)
    air = Air(one, two)
    for number in range(20):
        one.end.messages.submit(ODOM, text(number), air.now)
        air.run(4.0, lambda: text(number) in two.delivered())  # noqa: B023 - called at once
        two.start()  # before it has reported
        air.run(0.5)
    delivered = two.delivered()
    assert delivered == sorted(set(delivered), key=lambda payload: int(payload.split()[1]))
    one.end.messages.submit(ODOM, text(20), air.now)
    air.run(1.0)
    assert two.delivered()[-1] == text(20)
    assert len(delivered) >= 15


@pytest.mark.parametrize("loss", [0.05, 0.2, 0.4])
def test_no_repair_leaves_before_the_sending_thread_is_told_to_look(loss: float) -> None:
    """The thread sleeps until ``next_departure``, which it asks again after a message, a credit or a report."""
    one, two = Robot(1, registry()), Robot(2)
    air, repairs = Air(one, two, loss=loss), 0
    for number in range(600):
        one.end.messages.submit(ODOM, text(number), air.now)
        for _ in range(3):
            if one.end.pace.out_of_credit:
                one.end.pace.credit()
            at, before = one.end.next_departure(), one.end.sent.air["repair"]
            air.step()
            if one.end.sent.air["repair"] > before:
                repairs += 1
                assert at is not None and at < air.now, "the slot in which it left"
    assert repairs > 100 * loss


@pytest.mark.parametrize("mode", ["none", "encrypt"])
def test_lost_packets_are_those_since_a_robot_was_heard_the_same_in_total_and_by_robot(mode: SealMode) -> None:
    one, two = Robot(1, registry(), mode=mode), Robot(2, registry(), mode=mode)
    air = Air(one)
    for number in range(200):
        one.end.messages.submit(0, text(number), air.now)
        air.step()
    air.robots.append(two)
    for number in range(200, 400):
        one.end.messages.submit(0, text(number), air.now)
        air.step()
    assert len(two.delivered()) > 150
    assert two.end.received.packet_loss_est == 0
    air.lost = lambda _, receiver: receiver is two and air.rng.random() < 0.2
    for number in range(400, 600):
        one.end.messages.submit(0, text(number), air.now)
        air.step()
    (peer,) = two.end.peers(air.now)
    assert peer.lost == two.end.received.packet_loss_est
    assert 20 <= peer.lost <= 70
