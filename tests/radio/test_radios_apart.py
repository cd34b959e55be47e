"""Several radios of which one is on a channel that other robots share, or has an adaptive rate."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from gr_ros2.cli.capture import packets_in
from gr_ros2.cli.status import radio_words
from gr_ros2.core.errors import ConfigError
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.observe.capture import PacketCapture
from gr_ros2.radio.config import link_from
from gr_ros2.radio.findings import about, differences
from gr_ros2.state.keys import new_key_file
from tests.domains import domain, free_ports
from tests.middleware.calling import Adder, Caller
from tests.middleware.support import CUSTOM, message
from tests.radio.robots import QOS, RATE, Robot
from tests.radio.team import FAST, Team, modem
from tests.waiting import wait_for


@pytest.fixture
def closing() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


class Fleet:
    """Robots 1 and 2 with a radio for both alone, ``near``, and one on a channel of all, ``far``, which is all that
    robot 3 has.

    :param medium: of that channel
    :param settings: of single robots
    """

    def __init__(
        self, folder: Path, closing: ExitStack, medium: str, settings: dict[int, dict[str, Any]], **values: Any
    ) -> None:
        far = free_ports(3)
        near = free_ports(2)
        registry = folder / "topics.csv"
        registry.write_text(f"chat,{CUSTOM}\nnews,{CUSTOM}\n")
        self.robots: dict[int, Robot] = {}
        for number in (1, 2, 3):
            radios = [self._radio(near, number, name="near", phy=modem(200_000))] if number < 3 else []
            radios.append(self._radio(far, number, name="far", phy=modem(50_000), medium=medium, packet_len=80))
            own = {"registry": str(registry), **values, **settings.get(number, {})}
            if number < 3:
                own["radios"] = radios
            else:
                only = radios[0]
                own |= {"phy": only["phy"], "medium": medium, "packet_len": 80}
            front_end = {"name": "sim"} if number < 3 else radios[0]["front_end"]
            others = tuple(other for other in (1, 2, 3) if other != number)
            state = str(folder / f"{number}.json")
            self.robots[number] = closing.enter_context(Robot(number, front_end, others, state=state, **own))

    @staticmethod
    def _radio(ports: list[int], number: int, **values: Any) -> dict[str, Any]:
        others = [f"127.0.0.1:{port}" for at, port in enumerate(ports, 1) if at != number]
        front_end = {"name": "udp", "listen": f"127.0.0.1:{ports[number - 1]}", "send_to": others}
        return {"front_end": front_end, **values}

    def bound(self, number: int) -> dict[str, Any]:
        told: dict[str, Any] = self.robots[number].link.stats()["radios"]["far"]["bound"]
        return told

    def meet(self) -> None:
        """All hear all over the shared channel, and robots 1 and 2 each other over their own."""
        wait_for(lambda: all(sorted(self.bound(n)["heard"]) == [3 - n, 3] for n in (1, 2)), "robots on the channel")
        only = self.robots[3].link
        wait_for(lambda: {peer["robot"] for peer in only.stats()["peers"]} == {1, 2}, "robot 3 to hear both")
        wait_for(lambda: all(self.robots[n].link.stats()["peers"] for n in (1, 2)), "robots 1 and 2 over their own")


@pytest.mark.parametrize("medium", ["slots", "aloha"])
@pytest.mark.parametrize("sealed", [False, True])
def test_a_shared_channel_carries_what_is_bound_to_it_to_robots_that_have_it_alone(
    tmp_path: Path, closing: ExitStack, medium: str, sealed: bool
) -> None:
    keys = {}
    if sealed:
        new_key_file(path := tmp_path / "key")
        keys = {"key": str(path)}
    topics: dict[str, Any] = {"chat": {"via": "far"}, "news": {}}
    capture = closing.enter_context(PacketCapture(tmp_path / "one.pcapng"))
    fleet = Fleet(
        tmp_path, closing, medium, {1: {"topics": topics, "observer": capture}, 2: {"topics": topics}}, **keys
    )
    fleet.meet()
    graph = MemoryMiddleware(domain_id=domain(1))
    closing.callback(graph.close)
    near = MemoryMiddleware(domain_id=domain(2))
    closing.callback(near.close)
    heard: list[bytes] = []
    near.subscribe("/rx_robot_1/news", CUSTOM, QOS, heard.append)
    news = graph.advertise("/robot_1/news", CUSTOM, QOS)
    wait_for(news.matched, "the link to take news")
    told = [message(number, 200) for number in range(5)]
    for payload in told:
        news.publish(payload)
    said = {number: fleet.robots[number].say(*range(10 * number, 10 * number + 3)) for number in (1, 2, 3)}
    for number, robot in fleet.robots.items():
        others = [each for other, all_of in said.items() if other != number for each in all_of]
        wait_for(lambda: sorted(robot.heard) == sorted(others), "what the others said")  # noqa: B023
    wait_for(lambda: heard == told, "news over the other radio")
    assert "/rx_robot_1/news" not in fleet.robots[3].link.stats()["sink"]["topics"]
    for number in (1, 2):
        stats = fleet.robots[number].link.stats()
        assert stats["radios"]["far"]["copied"] == stats["radios"]["far"]["sent"] == 0
        assert not stats["radios"]["far"]["carries"]
        words = "\n".join(radio_words(stats))
        assert "carries only what names it" in words
        assert f"radio far alone: /robot_{number}/chat; " in words
        assert stats["sink"]["rejected"] == {}
    assert fleet.robots[3].link.stats()["sink"]["rejected"] == {}
    fleet.robots[1].link.stop()
    captured = [packet for packet, _ in packets_in((tmp_path / "one.pcapng").read_bytes(), None, "")]
    assert {packet[1] for packet in captured} == {1, 2, 3}, "as they are on the air, without a byte before them"


def test_over_a_shared_channel_services_are_called_and_topics_asked_for(tmp_path: Path, closing: ExitStack) -> None:
    own = {"topics": {"add": {"via": "far"}}, "offer": {"scan": {"via": "far"}, "odom": {}}, "registry": ""}
    fleet = Fleet(tmp_path, closing, "slots", {1: own, 2: {"topics": []}, 3: {"topics": []}})
    fleet.meet()
    far = MemoryMiddleware(domain_id=domain(1))
    near = MemoryMiddleware(domain_id=domain(3))
    for graph in (far, near):
        closing.callback(graph.close)
    Adder(far, "/robot_1/add")
    caller, heard = Caller(near, "/rx_robot_1/add"), list[bytes]()
    wait_for(lambda: caller.there, "the service")
    caller.call(1)
    wait_for(lambda: caller.got == {1: [1001]}, "the sum")
    near.subscribe("/rx_robot_1/scan", CUSTOM, QOS, heard.append)
    scan = far.advertise("/robot_1/scan", CUSTOM, QOS)
    odom = far.advertise("/robot_1/odom", CUSTOM, QOS)
    wishes = fleet.robots[3].link.wishes
    both = fleet.robots[2].link.wishes

    def offered() -> list[str]:
        both.offers(1, anew=True)
        wait_for(lambda: both.offers(1)["age_s"] is not None, "the lists of both radios")
        return [row["name"] for row in both.offers(1)["rows"]]

    wait_for(lambda: offered() == ["odom", "scan"], "what is offered over either")
    told: list[tuple[bool, str]] = []
    both.want(1, "scan", told=lambda done, words: told.append((done, words)))
    wait_for(lambda: bool(told), "the answer of either")
    assert told[0][0] and "robot 1 sends scan" in told[0][1]
    wait_for(lambda: [w["state"] for w in fleet.robots[2].link.stats()["wishes"]["wants"]] == ["sent"], "one wish")
    both.want(1, "nothing", told=lambda done, words: told.append((done, words)))
    wait_for(lambda: len(told) == 2, "both answers")
    assert not told[1][0] and "does not offer nothing" in told[1][1]
    both.give_up(1, "scan")
    wait_for(lambda: not fleet.robots[1].link.stats()["wishes"]["wanted"], "it to be given up")

    def listed() -> list[str]:
        wishes.offers(1, anew=True)
        wait_for(lambda: wishes.offers(1)["age_s"] is not None, "the list")
        return [row["name"] for row in wishes.offers(1)["rows"]]

    wait_for(lambda: listed() == ["scan"], "what is offered over this channel")
    wishes.want(1, "scan")
    wait_for(lambda: wishes.wish(1, "scan")["state"] == "sent", "the answer")
    assert [wish["words"] for wish in fleet.robots[1].link.stats()["wishes"]["wanted"]] == ["robot 3 wants scan"]
    wait_for(scan.matched, "the link to take it")
    scan.publish(told := message(1, 60))
    wait_for(lambda: heard == [told], "the message")
    assert odom is not None

    def answered(one: int, other: int) -> bool:
        told = fleet.robots[one].link.ping(other)
        return told["answered"] > 0 and told["about"] is not None and told["clock_s"] is not None

    for one, other in ((1, 3), (3, 1)):
        wait_for(lambda: answered(one, other), "an answer")  # noqa: B023
    assert 3 in fleet.robots[1].link.clocks()
    own = fleet.robots[1].link.wishes
    own.offers(3, anew=True)
    wait_for(lambda: own.offers(3)["age_s"] is not None, "what robot 3 offers")


def test_robots_with_unlike_sets_of_radios_are_not_said_to_differ(tmp_path: Path, closing: ExitStack) -> None:
    fleet = Fleet(tmp_path, closing, "slots", {}, topics=[])
    fleet.meet()
    told = {n: about(each.link.config, [one.phy for one in each.link.radios]) for n, each in fleet.robots.items()}

    def asked(one: int, other: int) -> dict[str, Any] | None:
        found: dict[str, Any] | None = fleet.robots[one].link.ping(other)["about"]
        return found

    for one, other in ((1, 2), (1, 3), (3, 1)):
        wait_for(lambda: asked(one, other) is not None, "what the other robot is")  # noqa: B023
        found = asked(one, other)
        assert found is not None
        assert differences(told[one], found) == [], (told[one], found)


@pytest.mark.slow
@pytest.mark.parametrize("medium", ["slots", "aloha"])
def test_a_radio_on_a_shared_channel_comes_back_and_either_end_may_start_again(
    tmp_path: Path, closing: ExitStack, medium: str
) -> None:
    more = {"left": {"medium": medium}}
    new_key_file(key := tmp_path / "key")
    team = Team(tmp_path, (FAST, FAST), closing, more=more, topics={"chat": {"via": "left"}}, key=str(key))
    team.talk(0, 2)
    team.cables[0].pull()
    wait_for(lambda: not team.radio(1, "left")["present"], "the radio to be missed")
    said = team.robots[0].say(10, 11)
    team.cables[0].plug()
    wait_for(lambda: team.robots[1].heard[2:] == said, "what had waited")
    team.cables[1].pull()
    team.talk(20, 2)
    team.cables[1].plug()
    for number in (2, 1):
        team.restart(number)
        wait_for(lambda: team.radio(number, "left")["bound"]["heard"] == [3 - number], "the other robot")  # noqa: B023
        team.talk(10 * number, 2)
    assert team.robots[1].link.stats()["sink"]["rejected"] == {}


@pytest.mark.slow
@pytest.mark.parametrize("via", ["ofdm", "auto"])
def test_an_adaptive_rate_is_that_of_what_is_bound(tmp_path: Path, closing: ExitStack, via: str) -> None:
    pytest.importorskip("zmq", reason="needs pyzmq")
    zmq = [f"ipc://{tmp_path}/{number}" for number in (1, 2)]
    udp = [f"127.0.0.1:{port}" for port in free_ports(2)]
    robots = []
    for at in (0, 1):
        radios = [
            {
                "name": "ofdm",
                "phy": {"name": "ofdm", "sample_rate": RATE, "options": {"rate": "adaptive"}},
                "front_end": {"name": "zmq", "bind": zmq[at], "connect": [zmq[1 - at]]},
            },
            {
                "name": "modem",
                "phy": modem(5_000),
                "front_end": {"name": "udp", "listen": udp[at], "send_to": [udp[1 - at]]},
            },
        ]
        values = {"radios": radios, "topics": {"chat": {"via": via}}}
        robots.append(closing.enter_context(Robot(at + 1, {"name": "sim"}, (2 - at,), **values)))
    one, two = robots
    table = [mcs.name for mcs in one.link.radios[0].phy.mcs_table]

    def mcs() -> str | None:
        name: str | None = one.link.stats()["radios"]["ofdm"]["phy"].get("mcs")
        return name

    said: list[bytes] = []

    def talked() -> bool:
        said.extend(one.say(len(said)))
        return len(two.heard) > 20 and (via == "auto" or mcs() == table[6])

    wait_for(talked, "messages")
    wait_for(lambda: two.heard == said, "all of them")
    assert mcs() == (None if via == "auto" else table[6])


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"medium": "slots"}, "all have medium slots, so none carries what names no radio in via"),
        ({"relay": "gain"}, "set medium: slots"),
        (
            {"phy": {"name": "direct"}, "a": {"medium": "slots"}},
            "radios.0.medium = 'slots': phy direct takes no airtime",
        ),
        ({"medium": "slots", "a": {"medium": "exclusive"}, "b": {"medium": "aloha"}}, "each radio has its own"),
    ],
)
def test_what_no_radios_can_have_is_refused(change: dict[str, Any], problem: str) -> None:
    radios = [{"name": name, "front_end": {"name": "udp", "listen": "1"}, **change.pop(name, {})} for name in "ab"]
    with pytest.raises(ConfigError) as refused:
        link_from({"robot": 1, "phy": modem(9600), "radios": radios, **change})
    assert problem in str(refused.value)
