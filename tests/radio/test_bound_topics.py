"""Topics that go over one radio of two alone, a slow one beside a fast one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gr_ros2.cli.link import _live
from gr_ros2.cli.main import run
from gr_ros2.cli.status import radio_words
from gr_ros2.core.errors import ConfigError
from gr_ros2.gr.bound import BoundEnds
from gr_ros2.link.events import AirPacket
from gr_ros2.middleware.bag_files import read_bag
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.observe.bag import OutputBag
from gr_ros2.observe.capture import PacketCapture
from gr_ros2.observe.positions import humble_types
from gr_ros2.radio.config import link_from
from gr_ros2.radio.live_settings import LiveSettings
from gr_ros2.state.keys import new_key_file
from gr_ros2.wire import BOUND
from tests.domains import domain
from tests.middleware.support import CUSTOM, message
from tests.radio.robots import QOS, Robot
from tests.radio.team import FAST, SLOW, Team, modem
from tests.waiting import wait_for

CHAT = {"chat": {"via": "left"}}
"""The topic is bound to the left radio, the slow one."""


@pytest.fixture
def closing() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def key(folder: Path) -> dict[str, Any]:
    path = folder / "key"
    new_key_file(path)
    return {"key": str(path)}


def left(team: Team, number: int = 1) -> dict[str, Any]:
    """What a robot says of what is bound to its left radio."""
    bound: dict[str, Any] = team.radio(number, "left")["bound"]
    return bound


def recording(robot: Robot) -> list[AirPacket]:
    """The packets of bound topics that a robot hears from now on."""
    bound, recorded = robot.link.sink.apart, list[AirPacket]()
    assert bound is not None

    def take(radio: int, packets: Sequence[AirPacket]) -> list[AirPacket]:
        recorded.extend(packet for packet in packets if packet.data.startswith(BOUND))
        return bound.take(radio, packets)

    robot.link.sink.apart = SimpleNamespace(take=take)
    return recorded


@pytest.mark.parametrize("sealed", [False, True])
def test_a_bound_topic_goes_over_its_radio_alone_and_comes_whole_and_in_order(
    tmp_path: Path, closing: ExitStack, sealed: bool
) -> None:
    team = Team(tmp_path, (SLOW, FAST), closing, topics=CHAT, **(key(tmp_path) if sealed else {}))
    team.talk(0, 5)  # of several packets each
    assert left(team)["packets"] > 20
    assert left(team)["topics"] == ["/robot_1/chat"]
    assert left(team)["heard"] == [2]
    assert team.robots[0].link.source.stats()["topics"] == {}, "what leaves over the other radio"
    assert team.robots[1].link.stats()["sink"]["rejected"] == {}


def test_another_topic_does_not_wait_for_it(tmp_path: Path, closing: ExitStack) -> None:
    registry = tmp_path / "topics.csv"
    registry.write_text(f"chat,{CUSTOM}\nnews,{CUSTOM}\n")
    team = Team(tmp_path, (SLOW, FAST), closing, topics={"news": {}, **CHAT}, registry=str(registry))
    graphs = [MemoryMiddleware(domain_id=domain(number)) for number in (1, 2)]
    for graph in graphs:
        closing.callback(graph.close)
    news, heard = graphs[0].advertise("/robot_1/news", CUSTOM, QOS), []
    graphs[1].subscribe("/rx_robot_1/news", CUSTOM, QOS, heard.append)
    wait_for(news.matched, "the link to take news")
    said = team.robots[0].say(*range(10))
    told = [message(number, 200) for number in range(50, 60)]
    for payload in told:
        news.publish(payload)
    wait_for(lambda: len(heard) == len(told), "the news")
    assert heard == told
    assert len(team.robots[1].heard) < len(said), "the slow radio still carries what was said before"
    wait_for(lambda: team.robots[1].heard == said, "all of it")


def test_a_bag_has_what_came_over_one_radio_alone_and_over_all(tmp_path: Path, closing: ExitStack) -> None:
    registry = tmp_path / "topics.csv"
    registry.write_text(f"news,{CUSTOM}\nchat,{CUSTOM}\n")
    bag = OutputBag(tmp_path / "bag")
    values = {"topics": {"news": {}, **CHAT}, "registry": str(registry)}
    team = Team(tmp_path, (FAST, FAST), closing, second={"observer": bag, "registry": ""}, **values)
    bag.run_started(_live(team.robots[1].link))
    graph = MemoryMiddleware(domain_id=domain(1))
    closing.callback(graph.close)
    news = graph.advertise("/robot_1/news", CUSTOM, QOS)
    wait_for(news.matched, "the link to take news")
    news.publish(told := message(50, 200))
    said = team.robots[0].say(1, 2, 3)
    sink = team.robots[1].link
    wait_for(lambda: sum(t["delivered"] for t in sink.stats()["sink"]["topics"].values()) == 4, "all messages")
    sink.stop()
    bag.close()
    found = [(each.topic, each.payload) for each in read_bag(tmp_path / "bag")]
    assert sorted(found) == sorted([("/rx_robot_1/news", told), *(("/rx_robot_1/chat", each) for each in said)])
    assert bag.incomplete() == []


@pytest.mark.parametrize("sealed", [False, True])
def test_a_capture_has_what_went_over_one_radio_alone(
    tmp_path: Path, closing: ExitStack, sealed: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    keys = key(tmp_path) if sealed else {}
    paths = [tmp_path / f"{number}.pcapng" for number in (1, 2)]
    first, second = (closing.enter_context(PacketCapture(path)) for path in paths)
    team = Team(tmp_path, (FAST, FAST), closing, second={"observer": second}, topics=CHAT, observer=first, **keys)
    team.talk(0, 3)
    for robot in team.robots:
        robot.link.stop()
    for path in paths:
        options = ["--key", str(tmp_path / "key")] if sealed else []
        assert run(["packet", "decode", str(path), "--packet-len", "64", *options]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert not [line for line in lines if "not opened" in line or "not checked" in line]
        bound = [line for line in lines if "bound to one radio, source" in line]
        assert {line.partition("src ")[2][0] for line in bound} == {"1", "2"}
        assert len([line for line in lines if ": topic 0" in line]) > 2
        assert [line for line in lines if "version 1, control" in line], "what leaves over both"


@pytest.mark.parametrize("sealed", [False, True])
def test_while_its_radio_is_pulled_out_it_waits_which_is_said(tmp_path: Path, closing: ExitStack, sealed: bool) -> None:
    team = Team(tmp_path, (SLOW, FAST), closing, topics=CHAT, **(key(tmp_path) if sealed else {}))
    team.talk(0, 2)
    team.cables[0].pull()
    wait_for(lambda: not team.radio(1, "left")["present"], "the radio to be missed")
    said = team.robots[0].say(10, 11, 12)
    words = "\n".join(radio_words(team.robots[0].link.stats()))
    assert "/robot_1/chat" in words
    assert "until the device is back" in words
    assert left(team)["waiting"] > 0
    team.cables[0].plug()
    wait_for(lambda: team.robots[1].heard[2:] == said, "what had waited")
    team.cables[1].pull()
    team.talk(20, 2)


@pytest.mark.slow
@pytest.mark.parametrize("sealed", [False, True])
@pytest.mark.parametrize("number", [1, 2])
def test_either_end_may_start_again(tmp_path: Path, closing: ExitStack, number: int, sealed: bool) -> None:
    team = Team(tmp_path, (SLOW, FAST), closing, topics=CHAT, **(key(tmp_path) if sealed else {}))
    team.talk(0, 2)
    team.restart(number)
    wait_for(lambda: left(team, number)["heard"] == [3 - number], "it to hear the other robot")
    team.talk(10, 3)
    assert team.robots[1].link.stats()["sink"]["rejected"] == {}


@pytest.mark.slow
@pytest.mark.parametrize("rates", [(SLOW, FAST), (FAST, SLOW), (FAST, FAST)])
def test_where_packets_are_lost_everything_comes_in_order(
    tmp_path: Path, closing: ExitStack, rates: tuple[int, int]
) -> None:
    team = Team(tmp_path, rates, closing, topics=CHAT)
    for cable in team.cables:
        cable.loses = 0.2
    for first in (0, 100):
        team.talk(first, 10)
    assert len(team.robots[1].heard) == 20


def test_a_radio_has_longer_packets_for_what_goes_over_it_alone(tmp_path: Path, closing: ExitStack) -> None:
    team = Team(tmp_path, (FAST, FAST), closing, more={"left": {"packet_len": 400}}, topics=CHAT)
    wait_for(lambda: left(team)["heard"] == [2], "the robot to be heard")
    recorded = recording(team.robots[1])
    team.talk(0, 4)
    assert 64 < max(len(packet.data) for packet in recorded) <= 400


@pytest.mark.parametrize("sealed", [False, True])
def test_a_robot_that_has_bound_nothing_hears_what_others_have(
    tmp_path: Path, closing: ExitStack, sealed: bool
) -> None:
    keys = key(tmp_path) if sealed else {}
    team = Team(tmp_path, (SLOW, FAST), closing, second={"topics": []}, topics=CHAT, **keys)
    wait_for(lambda: left(team)["heard"] == [2], "its reports")
    team.talk(0, 3)
    assert left(team, 2)["topics"] == []


def test_the_clock_of_a_robot_is_known_for_what_is_bound_too(tmp_path: Path, closing: ExitStack) -> None:
    registry, kind = tmp_path / "topics.csv", "geometry_msgs/msg/PointStamped"
    registry.write_text(f"place,{kind}\n")
    mine = {"publish": {"stamps": "mine"}, "topics": [], "registry": "", "clock": {"every_s": 0.2}}
    values = {"topics": {"place": {"via": "left"}}, "registry": str(registry)}
    team = Team(tmp_path, (FAST, FAST), closing, second=mine, **values)
    near, far = team.robots[1].link, MemoryMiddleware(domain_id=domain(1))
    closing.callback(far.close)

    def known() -> bool:
        near.check()
        return 1 in near.clocks()

    wait_for(known, "its clock")
    place = far.advertise("/robot_1/place", kind, QOS)
    wait_for(place.matched, "the link to take places")
    store = humble_types()
    header = store.types["std_msgs/msg/Header"](store.types["builtin_interfaces/msg/Time"](5, 0), "map")
    point = store.types[kind](header, store.types["geometry_msgs/msg/Point"](0.0, 0.0, 0.0))
    place.publish(bytes(store.serialize_cdr(point, kind)))
    wait_for(lambda: near.stats()["sink"]["topics"].get("/rx_robot_1/place", {}).get("delivered"), "a place")
    bounds = near.sink.apart
    assert isinstance(bounds, BoundEnds)
    (bound,) = bounds
    assert bound.sink.stats()["stamps_not_moved"] == 0


def test_a_robot_with_one_radio_hears_what_others_have_bound_to_theirs(tmp_path: Path, closing: ExitStack) -> None:
    team = Team(tmp_path, (FAST, FAST), closing, topics=CHAT)
    team.robots.pop().__exit__(None, None, None)
    front_end = {"name": "serial", "device": str(team.cables[0].ends[1]), "baud": 230400}
    one = Robot(2, front_end, (1,), phy=modem(FAST), topics=[], state=str(tmp_path / "one.json"))
    team.robots.append(closing.enter_context(one))
    wait_for(lambda: left(team)["heard"] == [2], "its reports")
    team.talk(0, 3)


def test_what_only_looks_like_a_packet_of_such_a_topic_makes_nothing_leave(tmp_path: Path, closing: ExitStack) -> None:
    team = Team(tmp_path, (FAST, FAST), closing, topics=[], **key(tmp_path))
    link = team.robots[0].link
    for junk in (BOUND, BOUND + bytes(3), BOUND + bytes(60), BOUND + b"\x1b" + bytes(50), BOUND * 60):
        link.sink.take([AirPacket(junk)], 0)
    wait_for(lambda: team.radio(1, "left")["bound"], "the packets to be taken")
    assert left(team)["packets"] == 0
    sink = link.stats()["sink"]
    assert sum(sink["rejected"].values()) + sink["dropped"]["early"] == 5


def test_a_recording_of_such_packets_without_their_first_byte_is_refused(tmp_path: Path, closing: ExitStack) -> None:
    team = Team(tmp_path, (FAST, FAST), closing, topics=CHAT, **key(tmp_path))
    link = team.robots[1].link
    recorded = recording(team.robots[1])
    team.talk(0, 2)
    before = link.stats()
    link.sink.take([packet._replace(data=packet.data.removeprefix(BOUND)) for packet in recorded], 0)
    after = link.stats()
    assert [peer["start"] for peer in after["peers"]] == [peer["start"] for peer in before["peers"]]
    assert recorded
    assert sum(after["sink"]["rejected"].values()) == len(recorded)


def test_a_limit_of_airtime_is_shared_and_refuses_nothing(tmp_path: Path, closing: ExitStack) -> None:
    limit = {"duty_cycle": 0.3, "window_s": 4.0}
    team = Team(tmp_path, (50_000, FAST), closing, more={"left": {"airtime": limit}}, topics={"chat": {"via": "left"}})
    team.talk(0, 40)
    account = team.radio(1, "left")["airtime"]
    assert account["refused"] == {}
    assert account["spent_s"] <= account["allowed_s"]


def test_an_option_of_such_a_topic_changes_while_the_link_runs(tmp_path: Path, closing: ExitStack) -> None:
    team = Team(tmp_path, (FAST, FAST), closing, topics=CHAT)
    link = team.robots[0].link
    settings = LiveSettings(link.source, link.sink)
    assert settings.change("topics.chat.max_rate", 2.0) == "topics.chat.max_rate = 2.0"
    assert link.stats()["source"]["topics"]["/robot_1/chat"]["queue"] == "latest"
    with pytest.raises(ConfigError, match="via cannot change"):
        settings.change("topics.chat.via", "right")


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"topics": {"odom": {"via": "c"}}}, "topics.odom.via = 'c': best, all, or one of a, b"),
        ({"offer": {"odom": {"via": "c"}}}, "offer.odom.via = 'c': best, all, or one of a, b"),
        ({"radios": [{"name": n, "front_end": {"name": "sim"}} for n in ("a", "all")]}, "one is called 'all'"),
        (
            {"topics": {"odom": {"via": "a"}}, "packet_len": 40},
            "packet_len = 40 of radio a: topics bound to it need 41",
        ),
    ],
)
def test_what_cannot_be_bound_is_refused(change: dict[str, Any], problem: str) -> None:
    radios = [{"name": name, "front_end": {"name": "sim"}} for name in ("a", "b")]
    with pytest.raises(ConfigError) as refused:
        link_from({"robot": 1, "phy": {"name": "direct"}, "radios": radios, **change})
    assert problem in str(refused.value)
