"""What else is bound to one radio of two: services, topics that others ask for, and what crosses later."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from gr_ros2.cli.link import _live
from gr_ros2.middleware.bag_files import read_bag
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.observe.bag import OutputBag
from gr_ros2.state.keys import new_key_file
from tests.domains import domain
from tests.middleware.calling import Adder, Caller, request, total
from tests.middleware.support import CUSTOM, message
from tests.observe.test_bag import lost_of
from tests.radio.fibonacci import FibonacciClient, FibonacciServer
from tests.radio.robots import QOS
from tests.radio.team import FAST, SLOW, Team
from tests.waiting import wait_for

GOAL = bytes(range(16))


@pytest.fixture
def closing() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def graphs(closing: ExitStack) -> list[MemoryMiddleware]:
    """Of the programs of robots 1 and 2."""
    made = [MemoryMiddleware(domain_id=domain(number)) for number in (1, 2)]
    for graph in made:
        closing.callback(graph.close)
    return made


def key(folder: Path) -> dict[str, Any]:
    path = folder / "key"
    new_key_file(path)
    return {"key": str(path)}


@contextmanager
def talking(graph: MemoryMiddleware, topic: str) -> Iterator[list[bytes]]:
    """Numbered messages of a topic, one every 20 ms."""
    publisher, ended, said = graph.advertise(topic, CUSTOM, QOS), threading.Event(), list[bytes]()

    def talk() -> None:
        while not ended.wait(0.02):
            said.append(message(len(said), 60))
            publisher.publish(said[-1])

    thread = threading.Thread(target=talk)
    thread.start()
    try:
        yield said
    finally:
        ended.set()
        thread.join()


def bound(team: Team, number: int = 1) -> dict[str, Any]:
    """What a robot says of what is bound to its left radio."""
    told: dict[str, Any] = team.radio(number, "left")["bound"]
    return told


@pytest.mark.parametrize("sealed", [False, True])
def test_a_service_is_called_over_its_radio_alone(tmp_path: Path, closing: ExitStack, sealed: bool) -> None:
    keys = key(tmp_path) if sealed else {}
    topics = {"add": {"via": "left"}, "other": {}}
    team = Team(tmp_path, (FAST, FAST), closing, registry="", topics=topics, second={"topics": []}, **keys)
    far, near = graphs(closing)
    adders = [Adder(far, f"/robot_1/{name}") for name in ("add", "other")]
    callers = [Caller(near, f"/rx_robot_1/{name}") for name in ("add", "other")]
    wait_for(lambda: all(caller.there for caller in callers), "both services")
    team.cables[1].pull()  # what is bound does not need it
    callers[0].call(1)
    wait_for(lambda: callers[0].got == {1: [1001]}, "the sum")
    team.cables[1].plug()
    team.cables[0].pull()
    wait_for(lambda: team.radio(1, "right")["present"] and team.radio(2, "right")["present"], "the other radio")
    wait_for(lambda: not callers[0].there, "the bound one to be gone with its radio")
    callers[1].call(2)
    wait_for(lambda: callers[1].got == {2: [1002]}, "the sum of the one that goes over all")
    assert [adder.taken for adder in adders] == [[1], [2]]
    calls = team.robots[0].link.stats()["calls"]
    assert calls["offered"] == ["/robot_1/add", "/robot_1/other"]
    link = team.robots[1].link
    assert total(link.call("/rx_robot_1/other", request(3, 4))) == 7
    team.cables[0].plug()
    wait_for(lambda: "/rx_robot_1/add" in link.reached(), "the bound one to be there again")
    assert total(link.call("/rx_robot_1/add", request(3, 5))) == 8


def test_an_action_is_bound_whole(tmp_path: Path, closing: ExitStack) -> None:
    team = Team(tmp_path, (FAST, FAST), closing, registry="", topics={"count": {"via": "left"}}, second={"topics": []})
    far, near = graphs(closing)
    FibonacciServer(far, "/robot_1/count")
    client = FibonacciClient(near, "/rx_robot_1/count")
    wait_for(lambda: client.there, "the action")
    client.ask("send_goal", GOAL, (4).to_bytes(4, "little"))
    wait_for(lambda: "send_goal" in client.replies and client.feedback, "the goal to be taken")
    client.ask("get_result", GOAL)
    client.ask("cancel_goal", GOAL, bytes(8))
    wait_for(lambda: "get_result" in client.replies, "the result")
    assert team.robots[0].link.source.stats()["topics"] == {}, "what leaves over the other radio"
    assert bound(team)["topics"] == ["/robot_1/count/_action/feedback", "/robot_1/count/_action/status"]


def test_what_is_asked_for_goes_over_its_radio_alone(tmp_path: Path, closing: ExitStack) -> None:
    more = {"registry": "", "topics": ["nothing"], "offer": {"scan": {"via": "left"}, "odom": {}}}
    team = Team(tmp_path, (SLOW, FAST), closing, second={"offer": {}, "topics": []}, **more)
    wishes, heard = team.robots[1].link.wishes, list[bytes]()
    far, near = graphs(closing)
    near.subscribe("/rx_robot_1/scan", CUSTOM, QOS, heard.append)
    with talking(far, "/robot_1/scan") as said:
        found = team.robots[0].link.source.found
        wait_for(lambda: "scan" in found.offers, "the offer")
        assert bound(team)["topics"] == []
        wishes.want(1, "scan", 0.0)
        wait_for(lambda: wishes.wish(1, "scan")["state"] != "asked", "the answer")
        wish = wishes.wish(1, "scan")
        assert wish["state"] == "refused", "50 messages/s are more than the slow radio carries"
        assert wish["free_Bps"] < SLOW / 8
        wishes.want(1, "scan", 2.0)
        wait_for(lambda: wishes.wish(1, "scan")["state"] == "sent", "it to be sent more seldom")
        wait_for(lambda: len(heard) > 2, "messages")
        assert bound(team)["topics"] == ["/robot_1/scan"]
        assert team.robots[0].link.source.stats()["topics"] == {}
        wishes.give_up(1, "scan")
        wait_for(lambda: bound(team)["topics"] == [], "it to be sent no more")
        assert set(heard) <= set(said)


@pytest.mark.parametrize("sealed", [False, True])
def test_a_gap_of_what_is_bound_is_filled_over_its_radio(tmp_path: Path, closing: ExitStack, sealed: bool) -> None:
    keys = key(tmp_path) if sealed else {}
    registry = tmp_path / "topics.csv"
    registry.write_text(f"news,{CUSTOM}\nscan,{CUSTOM}\n")
    bag = OutputBag(tmp_path / "bag")
    topics = {"scan": {"via": "left", "queue": "latest"}, "news": {}}
    values = {"topics": topics, "registry": str(registry), "backfill": {"topics": ["*"]}, **keys}
    more = {"observer": bag, "registry": "", "topics": [], "backfill": {}}
    team = Team(tmp_path, (FAST, FAST), closing, second=more, **values)
    bag.run_started(_live(team.robots[1].link))
    one, two = (robot.link for robot in team.robots)
    heard = list[bytes]()
    far, near = graphs(closing)
    near.subscribe("/rx_robot_1/scan", CUSTOM, QOS, heard.append)
    with talking(far, "/robot_1/scan") as said:
        wait_for(lambda: len(heard) > 5, "messages")
        team.cables[0].loses = 1.0
        wait_for(lambda: one.stats()["backfill"]["kept"] > 60, "messages that nobody heard")
        team.cables[0].loses = 0.0
        wait_for(lambda: one.stats()["backfill"]["filled"] > 50, "the gap to be filled")
        wait_for(lambda: not one.stats()["backfill"]["kept"], "all of it")
    wait_for(lambda: said[-1] in heard, "the last")
    two.stop()
    bag.close()
    found = [each.payload for each in read_bag(tmp_path / "bag") if each.topic == "/rx_robot_1/scan"]
    places = [said.index(payload) for payload in found]
    assert sorted(places) == list(range(min(places), len(said))), "each once"
    # What came at once has the time at which it came, which on a busy computer is up to .1 s after it was said.
    filled = [place for place, payload in zip(places, found, strict=True) if payload not in heard]
    assert filled == sorted(filled), "in order"
    assert len(heard) < len(found) - 50, "not onto the topic"
    assert lost_of(tmp_path / "bag") == {}
    assert bag.incomplete() == []
