"""The simulated link: honest about the air, repeatable, and as good as the scenarios promise."""

from __future__ import annotations

import re
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import pytest

from gr_ros2.core.arrays import Floats
from gr_ros2.core.errors import RunError
from gr_ros2.gr.factory import message_codec
from gr_ros2.link import AirPacket, Delivered, ReceiverEvent, SenderEvent
from gr_ros2.link.airtime import LEAD_S
from gr_ros2.paper.endpoint import EndpointV0
from gr_ros2.phy.direct import DirectPhy
from gr_ros2.settings.config import ChannelConfig
from gr_ros2_lab.medium import FixedPaths, RadioPath
from gr_ros2_lab.medium.packets import PacketMedium
from gr_ros2_lab.record.trace import Trace
from gr_ros2_lab.run.load import make_phy
from gr_ros2_lab.run.scenario import Scenario, load_scenario
from gr_ros2_lab.run.simulate import EventLoop, Offered, Robot, Simulated, simulate

README = Path(__file__).parents[3] / "README.md"


class Sized:
    """A codec of the sizes that are promised of the real one: messages become tokens of so many bytes."""

    def __init__(self, *sizes: int) -> None:
        self._sizes = sizes
        self._messages: list[bytes] = []

    def canonical(self, topic_id: int, payload: bytes) -> bytes:  # noqa: ARG002
        return payload

    def announcement(self, topic_id: int) -> str:  # noqa: ARG002
        return ""

    def lacks(self, topic_id: int, coded: bytes) -> bool:  # noqa: ARG002
        return False

    def encode(self, topic_id: int, payload: bytes) -> bytes:  # noqa: ARG002 - all topics are alike
        number = len(self._messages)
        self._messages.append(payload)
        return number.to_bytes(4, "big") + bytes(self._sizes[number % len(self._sizes)] - 4)

    def decode(self, topic_id: int, coded: bytes) -> bytes:  # noqa: ARG002
        return self._messages[int.from_bytes(coded[:4], "big")]


def scenario(name: str, *overrides: str, duration: float = 10.0) -> Scenario:
    return load_scenario(name, overrides, duration_s=duration)


def run(name: str, *overrides: str, duration: float = 10.0, **settings: Any) -> Simulated:
    return simulate(scenario(name, *overrides, duration=duration), **settings)


def books(done: Simulated) -> dict[str, Any]:
    """The results by topic."""
    return {topic.topic.rsplit("/", 1)[-1]: topic for topic in done.topics}


def longest_silence(done: Simulated, topic: str) -> float:
    """s between two deliveries of a topic, from the start to the end of submission."""
    (messages,) = (m for m in trace(done).messages() if m.topic.endswith(topic))
    times = np.sort(messages.t_delivered[messages.delivered])
    return float(np.diff([0.0, *times, done.duration_s]).max())


def only(done: Simulated) -> Any:
    """The result of the only topic."""
    (topic,) = done.topics
    return topic


def as_the_readme_says(name: str, odom: Any) -> bool:
    """Whether the README's table has these figures: messages sent and received, and the 99th percentile of latency."""
    row = re.search(
        rf"^\| `gr-ros2 run {name}`.*?\| ([\d,]+) \| ([\d,]+) \| (\d+) (m?)s", README.read_text("utf-8"), re.M
    )
    assert row
    sent, received, p99 = (int(cell.replace(",", "")) for cell in row.groups()[:3])
    return (sent, received, p99) == (odom.sent, odom.delivered, round(odom.latency_s.p99 * (1000 if row[4] else 1)))


def trace(done: Simulated) -> Trace:
    return done.recorder.trace(0.0, done.duration_s, {})


def arrived(done: Simulated) -> tuple[Floats, Floats]:
    """When each packet that arrived left and arrived."""
    sent, received = trace(done).packets().times()
    there = ~np.isnan(received)
    return sent[there], received[there]


@pytest.mark.parametrize("name", ["paper-ofdm", "paper-ofdm-paced", "six-topics-paced"])
def test_no_message_completes_before_its_packets_have_been_on_the_air(name: str) -> None:
    done = run(name, duration=5.0)
    sent, received = arrived(done)
    assert (received - sent).min() >= done.airtime_s - 1e-9
    assert np.diff(np.sort(received)).min() >= done.airtime_s - 1e-9


def test_a_packet_is_composed_just_before_the_air_is_free() -> None:
    done = run("narrow-ofdm-paced", duration=5.0)
    sent, received = arrived(done)
    assert (received - sent).max() <= done.airtime_s + LEAD_S + 1e-9
    assert max(((sent <= now) & (now < received)).sum() for now in sent) <= 2


def test_the_same_scenario_gives_the_same_numbers() -> None:
    assert run("six-topics-paced", duration=3.0).topics == run("six-topics-paced", duration=3.0).topics


def test_plain_and_unpaced_is_as_bad_as_it_was() -> None:
    odom = only(run("paper-ofdm", duration=38.0))
    assert odom.pdr < 0.2
    assert as_the_readme_says("paper-ofdm", odom)


@pytest.mark.parametrize("codec", [None, Sized(102), Sized(*[85] * 99, 150)], ids=["real", "102", "a few larger"])
def test_every_message_of_the_paper_arrives_and_is_fresh(codec: Sized | None) -> None:
    odom = only(run("paper-ofdm-paced", duration=38.0, codec=codec))
    assert odom.pdr >= 0.99
    assert odom.latency_s.p99 <= (0.060 if codec is None else 0.070)  # two packets a message, and hellos between
    assert odom.goodput_Bps >= 25_000
    assert codec or as_the_readme_says("paper-ofdm-paced", odom)


@pytest.mark.parametrize("codec", [None, Sized(102)], ids=["real", "102"])
def test_a_third_of_the_rate_is_evenly_spaced_and_fresh(codec: Sized | None) -> None:
    done = run("narrow-ofdm-paced", duration=38.0, codec=codec)
    odom = only(done)
    assert odom.delivered / done.duration_s >= 11
    assert odom.age_s.mean <= 0.160
    packets = 3 if codec is None else 6  # at the start a hello and the table of topics go first
    assert longest_silence(done, "odom") < packets * done.airtime_s + 1 / 35


@pytest.mark.slow
def test_six_topics_share_a_link_that_carries_a_third_of_them() -> None:
    done = run("six-topics-paced", duration=38.0)
    topics = books(done)
    assert topics["odom"].delivered / done.duration_s >= 15
    others = (books(run("six-topics-paced", f"seed={seed}", duration=38.0)) for seed in (1, 2))
    assert fmean(found["cmd_vel"].latency_s.p99 for found in (topics, *others)) <= 0.100
    assert topics["map"].delivered == 1
    assert all(longest_silence(done, name) < 5 for name in topics if name != "map"), "which is sent once"


def test_a_link_that_carries_everything_carries_everything() -> None:
    plain = books(run("demo", "compression=false"))
    paced = books(run("demo"))
    assert paced.keys() == plain.keys() == {"scan", "odom", "imu", "cmd_vel", "map", "clock"}
    for name, topic in paced.items():
        assert topic.pdr == 1.0
        assert topic.latency_s.p50 <= plain[name].latency_s.p50 + 1e-9


def test_with_version_1_packets_take_as_much_air_as_they_need() -> None:
    """Where the link has room; a backlog fills packets anyway."""

    def airtime_per_message(lengths: str) -> float:
        radio = f"phy.options={{payload_modulation: bpsk, lengths: {lengths}}}"
        settings = (radio, "phy.sample_rate=400000", 'repair="off"')
        there = scenario("six-topics-paced", *settings, duration=2.0)
        phy = make_phy(there, there.load_registry())
        done = simulate(there, phy=phy)
        found = done.recorder.airtime(phy.airtime)
        assert (found["airtime_mean_s"] == found["airtime_s"]) == (lengths == "fixed")
        assert found["airtime_per_message_s"] is not None
        return found["airtime_per_message_s"]

    assert airtime_per_message("any") < 0.75 * airtime_per_message("fixed")


def test_messages_too_late_have_their_own_rows_and_the_ledger_adds_up() -> None:
    deadline = "topics={odom: {queue: deadline, deadline_s: 0.4}}"
    odom = only(run("narrow-ofdm-paced", deadline, "compression=false"))
    assert {"cannot_complete", "stale"} & odom.ledger.keys()
    assert sum(odom.ledger.values()) == odom.sent


def test_lost_packets_are_lost() -> None:
    odom = only(run("paper-ofdm-paced", "channel.packet_loss=0.2", "repair='off'"))
    assert 0.7 < odom.pdr < 0.9
    assert sum(odom.ledger.values()) == odom.sent


def test_the_time_of_the_computer_is_added_to_every_latency() -> None:
    bare, with_it = (only(run("paper-ofdm-paced", overhead_s=s, duration=2.0)) for s in (0.0, 0.004))
    assert with_it.latency_s.p50 == pytest.approx(bare.latency_s.p50 + 0.004)


class Answering(EndpointV0):
    """Says the size of every message it gets, as an end that acknowledges would."""

    answers = True

    def receive(self, arrival: AirPacket, now: float) -> list[ReceiverEvent]:
        events = super().receive(arrival, now)
        for event in events:
            if isinstance(event, Delivered):
                self.messages.submit(event.topic_id, len(event.payload).to_bytes(4, "big"), now)
        return events


def test_a_robot_may_answer_what_it_hears() -> None:
    settings = scenario("two-way", "time=packets", "paper={}", "topics=auto", duration=2.0)
    registry = settings.load_registry()
    coming = [Offered(0.5, 0, bytes(51)), Offered(1.0, 0, bytes(300))]
    robots = []
    for number, one in enumerate(settings.all_robots):
        told: list[SenderEvent] = []
        kind = Answering if number else EndpointV0
        assert settings.paper is not None
        codec = message_codec(registry)
        endpoint = kind(registry, one.config, settings.paper, codec=codec, observer=told.append)
        messages = iter(() if number else coming)
        common: dict[str, Any] = {"src_id": one.robot_id, "airtime": lambda *_: 0.01}
        robots.append(Robot(settings, number, endpoint, events=told, messages=messages, **common))
    paths = [[RadioPath(1, ChannelConfig())], [RadioPath(0, ChannelConfig())]]
    medium = PacketMedium(FixedPaths(paths), [DirectPhy(220)] * 2)
    heard = [(now, event) for now, _, event in EventLoop(robots, medium).run() if isinstance(event, Delivered)]
    times = [now for now, _ in heard]
    there, back = (one.robot_id for one in settings.all_robots)
    assert [event.payload for _, event in heard if event.src_id == there] == [bytes(51), bytes(300)]
    answers = [event.payload for _, event in heard if event.src_id == back]
    assert [int.from_bytes(answer, "big") for answer in answers] == [51, 300]
    assert times == sorted(times)
    assert times[1] - times[0] == pytest.approx(0.01), "the answer is on the air as soon as the message has landed"


class Stuck(EndpointV0):
    """Says at all times that it has something to do at once, and does nothing."""

    answers = True

    def next_departure(self, *, credited: bool = False) -> float | None:  # noqa: ARG002
        return 0.0


def test_a_simulation_that_stands_still_says_which_end_and_which_timer() -> None:
    settings = scenario("paper-ofdm", "time=packets", duration=2.0)
    registry = settings.load_registry()
    assert settings.paper is not None
    endpoint = Stuck(registry, settings.first, settings.paper, codec=None)
    messages = iter([Offered(0.5, 0, bytes(51))])
    stuck = Robot(settings, 0, endpoint, src_id=1, airtime=lambda *_: 0.0, events=[], messages=messages)
    medium = PacketMedium(FixedPaths([[]]), [DirectPhy(220)])
    with pytest.raises(RunError, match=r"stands still at 0.0.* s: departure of robot 1 is due at 0\.0"):
        list(EventLoop([stuck], medium).run())
