"""What observers hear, and the ledger asked while it is open."""

from __future__ import annotations

from gr_ros2.core.errors import LengthError
from gr_ros2.link.events import Accepted, ReceiverEvent, Rejected, SenderEvent
from gr_ros2.link.observe import Observers
from gr_ros2.observe.observers import LateObservers, LiveRun
from gr_ros2.settings.registry import Registry
from gr_ros2_lab.record.ledger import Ledger
from gr_ros2_lab.record.recorder import Recorder
from gr_ros2_lab.record.result import Result
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import load_scenario


class RecordingObserver:
    """Counts what it hears."""

    instruments = True

    def __init__(self) -> None:
        self.heard: list[str] = []
        self.run: LiveRun | None = None
        self.result: Result | None = None

    def run_started(self, run: LiveRun) -> None:
        assert not self.heard
        self.run = run

    def run_ended(self, result: Result | None) -> None:
        self.result = result

    def sender_event(self, src_id: int, event: SenderEvent) -> None:
        assert src_id == 1
        self.heard.append(type(event).__name__)

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:  # noqa: ARG002
        self.heard.append(type(event).__name__)


def test_an_onlooker_hears_what_the_result_counts() -> None:
    observer = RecordingObserver()
    ends = ["graph.middleware=memory"]
    result = run_scenario(load_scenario("paper-direct", ends, duration_s=1.0), observers=[observer]).result
    assert observer.result is result
    (topic,) = result.topics
    assert observer.heard.count("Accepted") == topic.sent
    assert observer.heard.count("Delivered") == topic.delivered
    assert observer.heard.count("SentPacket") == result.packets["sent"]
    assert observer.heard.count("Received") == result.packets["received"]
    assert observer.run is not None
    assert observer.run.topics == {(1, 0): "/robot_1/odom"}
    assert observer.run.fates()[1, 0] == topic.ledger
    observer.run.links[0].set_packet_loss(0.5)  # which without an observer this PHY refuses


def test_everyone_hears_in_turn() -> None:
    one, other = RecordingObserver(), RecordingObserver()
    fanout = Observers([one, other])
    fanout.sender_event(1, Accepted(0, 0, b"", 0.0))
    fanout.receiver_event(Rejected(b"", LengthError("0 bytes")), 0.0)
    assert one.heard == other.heard == ["Accepted", "Rejected"]


def test_the_fates_of_an_open_ledger_add_up() -> None:
    recorder = Recorder(Registry.from_rows({"a": "std_msgs/String"}), {1: "/robot_1"})
    for serial in range(10):
        recorder.sender_event(1, Accepted(serial, 0, bytes([serial]), float(serial)))
    assert recorder.ledger.fates() == {(1, 0): {"in_flight": 10}}
    assert recorder.ledger.fates() == {(1, 0): {"in_flight": 10}}
    assert Ledger().fates() == {}


def test_who_comes_late_is_told_of_the_run_and_hears_from_then_on() -> None:
    audience, early, late = LateObservers(), RecordingObserver(), RecordingObserver()

    class Invites(RecordingObserver):
        """Lets the late one in when the first message is delivered."""

        def receiver_event(self, event: ReceiverEvent, now: float) -> None:
            if not self.heard:
                audience.invite(late)
            super().receiver_event(event, now)

        def sender_event(self, src_id: int, event: SenderEvent) -> None:
            """Not counted."""

    ends = ["graph.middleware=memory"]
    for observer in (Invites(), early):
        audience.invite(observer)
    result = run_scenario(load_scenario("paper-direct", ends, duration_s=1.0), observers=[audience]).result
    assert late.run is early.run
    assert late.result is early.result is result
    assert 0 < late.heard.count("Delivered") <= early.heard.count("Delivered") == result.topics[0].delivered
    assert late.heard.count("Accepted") < early.heard.count("Accepted")
