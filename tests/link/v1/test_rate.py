"""Endpoints with an adaptive rate: receivers report the SNR, and each packet is sent as its receivers need it."""

from __future__ import annotations

from gr_ros2.link import AirPacket
from gr_ros2.link.events import SenderEvent, SentPacket
from gr_ros2.link.rate import Mcs
from gr_ros2.link.v1.endpoint import EndpointV1
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.relay.robots import GONE_S
from gr_ros2.settings.registry import Registry
from gr_ros2.wire import BROADCAST
from gr_ros2.wire.control import Report
from tests.packets import data_of

MCS_TABLE = (Mcs("slow", 0.01, 0.0, 0.4), Mcs("middle", 0.005, 8.0, 0.4), Mcs("fast", 0.0025, 16.0, 0.4))
TOPICS = Registry.from_rows([("odom", "nav_msgs/msg/Odometry")])
STEP_S = 0.01


class Fleet:
    """A sender and its receivers, which hear each other at an SNR of their own; None: not at all."""

    def __init__(self, snrs: dict[int, float | None], dst_id: int = BROADCAST) -> None:
        self.snrs = snrs
        self.sent: list[SentPacket] = []
        self.now = 0.0
        settings = Settings(1, packet_len=64, any_length=True, dst_id=dst_id, packet_rate=0)
        self.sender = EndpointV1(TOPICS, settings, boot=5, observer=self._observe, mcs_table=MCS_TABLE)
        self.receivers = {
            number: EndpointV1(
                None,
                Settings(number, packet_len=64, any_length=True),
                boot=5,
                mcs_table=MCS_TABLE,
            )
            for number in snrs
        }

    def _observe(self, event: SenderEvent) -> None:
        if isinstance(event, SentPacket):
            self.sent.append(event)

    def run(self, messages: int) -> list[int]:
        """Send messages; returns the rates of the packets that carried them."""
        before = len(self.sent)
        for _ in range(messages):
            self.now += STEP_S
            self.sender.messages.submit(0, bytes(30), self.now)
            for _ in range(3):
                data = data_of(self.sender.next_packet(self.now))
                for number, receiver in self.receivers.items():
                    snr_db = self.snrs[number]
                    if snr_db is None:
                        continue
                    if data is not None:
                        receiver.receive(AirPacket(data, snr_db=snr_db), self.now)
                    if (answer := data_of(receiver.next_packet(self.now))) is not None:
                        self.sender.receive(AirPacket(answer, snr_db=10.0), self.now)
        return [event.mcs for event in self.sent[before:] if event.kind == "new"]


def test_the_rate_follows_the_weakest_receiver_that_reports() -> None:
    fleet = Fleet({2: 30.0, 3: 30.0})
    assert fleet.run(100)[-1] == 2
    fleet.snrs[3] = 10.0
    assert fleet.run(50)[-1] == 1
    fleet.snrs[3] = 25.0
    assert fleet.run(200)[-1] == 2


def test_a_receiver_that_falls_silent_is_served_at_the_most_robust_rate_until_it_is_given_up() -> None:
    fleet = Fleet({2: 30.0, 3: 30.0})
    assert fleet.run(100)[-1] == 2
    fleet.snrs[3] = None
    assert fleet.run(200)[-1] == 0
    fleet.sender.handle_timeout(fleet.now)
    fleet.now += GONE_S
    fleet.run(1)
    fleet.sender.handle_timeout(fleet.now)
    assert fleet.run(200)[-1] == 2


def test_a_packet_to_one_robot_is_sent_as_this_one_needs_it() -> None:
    fleet = Fleet({2: 30.0, 3: 2.0}, dst_id=2)
    assert fleet.run(100)[-1] == 2


def test_hellos_are_for_everybody_and_reports_tell_the_snr() -> None:
    fleet = Fleet({2: 30.0})
    fleet.run(300)
    assert {event.mcs for event in fleet.sent if event.kind == "hello"} == {0}
    (inbox,) = (neighbour.inbox for neighbour in fleet.receivers[2].neighbours.all.values())
    report = inbox.reports.make(fleet.now)
    assert isinstance(report, Report)
    assert report.snr_db == 30.0


def test_without_an_mcs_table_nothing_is_chosen_and_without_an_snr_none_is_reported() -> None:
    sender = EndpointV1(TOPICS, Settings(1, packet_len=64, packet_rate=0), boot=5)
    receiver = EndpointV1(None, Settings(2, packet_len=64), boot=5)
    sender.messages.submit(0, bytes(30), 0.0)
    while (sent := sender.next_packet(0.0)) is not None:
        receiver.receive(AirPacket(sent.data), 0.0)
        assert sent.mcs == 0
    (neighbour,) = receiver.neighbours.all.values()
    assert neighbour.inbox.reports.make(0.0).snr_db is None


def test_reports_leave_at_the_most_robust_rate() -> None:
    fleet = Fleet({2: 30.0})
    fleet.run(100)
    settings = Settings(3, packet_len=64, any_length=True, packet_rate=0)
    told: list[SenderEvent] = []
    other = EndpointV1(TOPICS, settings, boot=6, observer=told.append, mcs_table=MCS_TABLE)
    for number in range(100):
        now = fleet.now + number * STEP_S
        fleet.sender.messages.submit(0, bytes(30), now)
        data = data_of(fleet.sender.next_packet(now))
        if data is not None:
            other.receive(AirPacket(data, snr_db=30.0), now)
        if (answer := data_of(other.next_packet(now))) is not None:
            fleet.sender.receive(AirPacket(answer, snr_db=30.0), now)
    reports = [event for event in told if isinstance(event, SentPacket) and event.kind == "report"]
    assert reports
    assert {event.mcs for event in reports} == {0}


def test_the_reported_snr_follows_a_channel_that_changes_and_averages_one_that_does_not() -> None:
    fleet = Fleet({2: 20.0})
    fleet.run(100)
    (inbox,) = (neighbour.inbox for neighbour in fleet.receivers[2].neighbours.all.values())
    for error_db in (1.0, -1.0) * 20:
        inbox.reports.snr.measured(20.0 + error_db)
    assert inbox.reports.snr.snr_db is not None
    assert abs(inbox.reports.snr.snr_db - 20.0) < 0.5
    for step in range(12):
        inbox.reports.snr.measured(20.0 - 2.0 * step)
    assert inbox.reports.snr.snr_db < 20.0 - 2.0 * 11 + 3.0
