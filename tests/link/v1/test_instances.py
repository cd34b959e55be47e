"""The newest message of each instance: of each frame of /tf, of each publisher of a latched topic."""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest
from rosbags.typesys import get_types_from_msg

from gr_ros2.codecs.instances import instances_of
from gr_ros2.codecs.messages import read
from gr_ros2.compression import LinkCodec
from gr_ros2.core.errors import ConfigError
from gr_ros2.link.events import Refused
from gr_ros2.link.fates import Fate
from gr_ros2.link.queues import PublisherQos
from gr_ros2.link.v1.endpoint import EndpointV1
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry, Topic
from tests.codecs.test_instances import TF, diagnostics, joints, transforms
from tests.link.v1.air import Air, Robot

JOINTS, STATUS = "sensor_msgs/msg/JointState", "diagnostic_msgs/msg/DiagnosticArray"
LATCHED = SendOptions(durability="transient_local")


class Sender(Robot):
    """A robot that codes its messages and tells their instances apart."""

    def __init__(self, src_id: int, type_name: str, **options: Any) -> None:
        rows = Registry([Topic(0, "topic", type_name, SendOptions(**options))])
        super().__init__(src_id, rows, coding=(LinkCodec(rows), None), packet_len=220)

    def start(self, boot: int | None = None) -> None:
        super().start(boot)
        self.end = EndpointV1(
            self.topics,
            self.settings,
            boot=self.boot,
            codec=self.coding[0],
            observer=self.events.append,
            instances=instances_of,
        )
        self.end.pace.use_credit()

    def submit(self, payload: bytes, now: float, publisher: object = None) -> None:
        self.end.messages.submit(0, payload, now, publisher=publisher)


def receiver(src_id: int, type_name: str) -> Robot:
    known = LinkCodec([Topic(0, "topic", type_name)])
    return Robot(src_id, coding=(None, lambda _: known), packet_len=220)


def children(payloads: list[bytes]) -> Counter[str]:
    return Counter(one.child_frame_id for payload in payloads for one in read(TF, payload).transforms)


def play(air: Air, one: Sender, seconds: float, publishers: dict[bytes, float]) -> None:
    """Publishers of one message each, so many times a second."""
    due = dict.fromkeys(publishers, air.now)
    end = air.now + seconds
    while air.now < end:
        for number, (payload, rate) in enumerate(publishers.items()):
            while due[payload] <= air.now:
                one.submit(payload, air.now, number)
                due[payload] += 1 / rate
        air.step()


@pytest.mark.parametrize("loss", [0.0, 0.1])
def test_each_transform_of_three_broadcasters_comes_at_the_wanted_rate_in_few_messages(loss: float) -> None:
    one, two = Sender(1, TF, max_rate=5), receiver(2, TF)
    air = Air(one, two, loss=loss)
    play(air, one, 10.0, {transforms("odom"): 50, transforms("base", "laser"): 50, transforms("arm"): 20})
    came = children(two.delivered())
    assert set(came) == {"odom", "base", "laser", "arm"}
    assert all(4.0 <= count / 10.0 <= 6.0 for count in came.values()), came
    assert len(two.delivered()) <= 52


def test_a_queue_that_waits_has_the_newest_of_each_instance() -> None:
    one = Sender(1, TF, queue="latest")
    for children_of in (("odom",), ("base", "laser"), ("odom",)):
        one.submit(transforms(*children_of), 0.0)
    (waiting,) = one.end.messages.sent[0].queue
    assert waiting.plain == transforms("base", "laser", "odom")
    refused = [event.reason for event in one.events if isinstance(event, Refused)]
    assert refused == [Fate.SUPERSEDED] * 2


@pytest.mark.parametrize(
    ("type_name", "messages"),
    [
        (JOINTS, [joints("elbow"), joints("left", "right")]),
        (STATUS, [diagnostics("gps", sec=1), diagnostics("motor", sec=2)]),
    ],
)
def test_messages_that_cannot_be_merged_come_one_by_one_each_at_the_wanted_rate(
    type_name: str, messages: list[bytes]
) -> None:
    one, two = Sender(1, type_name, max_rate=5), receiver(2, type_name)
    air = Air(one, two, loss=0.1)
    play(air, one, 10.0, dict.fromkeys(messages, 50.0))
    came = Counter(two.delivered())
    assert all(4.0 <= came[message] / 10.0 <= 6.0 for message in messages), came.values()


def test_of_a_type_whose_instances_are_not_told_apart_the_newest_message_is_sent() -> None:
    one = Sender(1, TF, queue="latest", instance="none")
    one.submit(transforms("odom"), 0.0)
    one.submit(transforms("base"), 0.0)
    assert len(one.end.messages.sent[0].queue) == 1


def test_a_path_that_the_type_does_not_have_is_refused_by_the_name_of_the_topic() -> None:
    with pytest.raises(ConfigError, match=r"topic topic: instance: .* has no field"):
        Sender(1, TF, instance="transforms[].id")


def test_instances_of_a_users_type_are_told_once_its_definition_is_known() -> None:
    one = Sender(1, "fleet/msg/Robots", instance="robots[].id", queue="latest")
    assert one.end.messages.sent[0].instances is None
    definitions = {
        **get_types_from_msg("fleet/Robot[] robots", "fleet/msg/Robots"),
        **get_types_from_msg("uint8 id", "fleet/msg/Robot"),
    }
    one.end.messages.learn("fleet/msg/Robots", definitions)
    for robot in (1, 2, 1):
        one.submit(bytes((0, 1, 0, 0, 1, 0, 0, 0, robot)), 0.0)
    (waiting,) = one.end.messages.sent[0].queue
    assert waiting.plain[8:] == bytes((2, 1))


def latched(publishers: int) -> PublisherQos:
    return PublisherQos(latched=True, count=publishers, keeps=publishers)


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_a_late_robot_gets_the_newest_message_of_each_of_six_publishers(loss: float) -> None:
    one, two = Sender(1, "std_msgs/msg/String"), receiver(2, "std_msgs/msg/String")
    air = Air(one, two, loss=loss)
    one.end.messages.follow(0, latched(6))
    for turn in (b"old", b"new"):
        for number in range(6):
            one.submit(turn + bytes([number]), air.now, number)
    air.run(5.0)
    late = receiver(3, "std_msgs/msg/String")
    air.robots.append(late)
    air.run(30.0, lambda: len(late.delivered()) == 6)
    for _ in range(200):  # one of them goes on, faster than hellos
        one.submit(b"new" + bytes([0]), air.now, 0)
        air.run(0.1)
    wanted = {b"new" + bytes([number]) for number in range(6)}
    assert set(late.delivered()) == wanted
    assert all(late.delivered().count(message) == 1 for message in wanted - {b"new\0"})
    later = receiver(4, "std_msgs/msg/String")
    air.robots.append(later)
    air.run(30.0, lambda: set(later.delivered()) == wanted)
    assert set(later.delivered()) == wanted


def test_a_publisher_that_says_again_what_it_said_before_another_message_is_heard() -> None:
    one, two = Sender(1, "std_msgs/msg/String"), receiver(2, "std_msgs/msg/String")
    air = Air(one, two)
    one.end.messages.follow(0, latched(2))
    said = [b"auto", b"manual", b"auto", b"manual", b"manual"]
    for message in said:
        one.submit(message, air.now, 0)
        air.run(1.0)
    assert two.delivered() == said
