"""Services across a live link of two robots, whose graphs are in memory or on DDS: OFDM over ZeroMQ, packets lost."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count
from pathlib import Path

import pytest

pytest.importorskip("zmq", reason="needs pyzmq")

from gr_ros2.core.errors import ConfigError, MiddlewareError, RegistryError
from gr_ros2.gr import RosLink
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.paper import RosSink
from gr_ros2.radio.config import link_from
from gr_ros2.radio.robot_link import RobotLink
from gr_ros2.settings.registry import MAX_TOPICS, Registry
from gr_ros2.settings.robot import RobotConfig
from tests.domains import free_domains
from tests.gr.ends import link
from tests.middleware.calling import ADD, Adder, Caller
from tests.radio.calling_robots import Robots
from tests.waiting import wait_for

NEAR, FAR = "/rx_robot_2/add", "/robot_2/add"


@pytest.fixture
def robots(tmp_path: Path) -> Iterator[Robots]:
    robots = Robots(tmp_path, f"add,{ADD}", packet_loss=0.2)
    with robots.stack:
        yield robots


@pytest.mark.slow
@pytest.mark.real_time
def test_every_call_is_answered_once_though_packets_are_lost(robots: Robots) -> None:
    adder, caller = Adder(robots.graphs[1], FAR), Caller(robots.graphs[0], NEAR)
    wait_for(lambda: caller.there, "the service to appear")
    for number in range(50):
        caller.call(number)
        if number % 10 == 9:
            wait_for(lambda: len(caller.got) == number + 1, "the replies")  # noqa: B023 - called at once
    assert caller.got == {number: [number + 1000] for number in range(50)}
    assert adder.taken == list(range(50))
    assert robots.counted(1) == {f"called:{NEAR}": 50, f"answered:{NEAR}": 50}
    assert robots.counted(2) == {f"served:{FAR}": 50, f"replied:{FAR}": 50}
    stats = robots.links[1].stats()
    assert stats["calls"]["reached"] == [NEAR]
    assert stats["sink"]["topics"] == {}


@pytest.mark.slow
@pytest.mark.real_time
def test_a_service_is_there_only_while_its_server_and_both_links_are(robots: Robots) -> None:
    caller = Caller(robots.graphs[0], NEAR)
    for number in range(2):
        adder = Adder(robots.graphs[1], FAR)
        wait_for(lambda: caller.there, "the service to appear")
        caller.call(number)
        wait_for(lambda: number in caller.got, "the reply")  # noqa: B023 - called at once
        adder.server.close()
        wait_for(lambda: not caller.there, "the service to vanish")
    adder = Adder(robots.graphs[1], FAR)
    numbers = count(10)
    for restarted in (1, 2):
        wait_for(lambda: caller.there, "the service to appear")
        robots.restart(restarted)
        while not answered(robots, caller, next(numbers)):
            pass
    assert len(adder.taken) == len(set(adder.taken)) >= 2


def answered(robots: Robots, caller: Caller, number: int) -> bool:
    """Whether a call is answered. One that a restart has overtaken is not, and ends by name."""
    wait_for(lambda: caller.there, "the service to appear again")
    try:
        caller.call(number)
    except MiddlewareError:  # it has vanished in this moment
        return False
    wait_for(lambda: number in caller.got or not robots.links[1].stats()["calls"]["waiting"], "the call to end")
    return number in caller.got


@pytest.mark.slow
@pytest.mark.real_time
def test_calls_that_the_server_leaves_open_end_by_name(robots: Robots) -> None:
    taken: list[bytes] = []
    server = robots.graphs[1].serve(FAR, ADD, lambda _, payload: taken.append(payload))
    caller = Caller(robots.graphs[0], NEAR)
    wait_for(lambda: caller.there, "the service to appear")
    caller.call(1)
    wait_for(lambda: taken, "the request")
    server.close()
    wait_for(lambda: robots.counted(1).get(f"server_gone:{NEAR}"), "the call to be given up")
    assert not caller.got
    robots.links[1].stop()
    # Long enough for the request to arrive on a busy machine.
    robots.start(1, publish={"topics": {"add": {"deadline_s": 5.0}}})
    robots.graphs[1].serve(FAR, ADD, lambda _, payload: taken.append(payload))
    wait_for(lambda: caller.there, "the service to appear again")
    caller.call(2)
    wait_for(lambda: robots.counted(1).get(f"timed_out:{NEAR}"), "the call to time out")
    wait_for(lambda: robots.counted(2).get(f"unanswered:{FAR}"), "the other end to give it up")
    assert len(taken) == 2


@pytest.mark.slow
@pytest.mark.real_time
def test_the_parameters_of_a_node_are_set_across_the_link(tmp_path: Path) -> None:
    robots = Robots(tmp_path, "planner,parameters", packet_loss=0.2)
    asked, answers = b"\0\1\0\0a request of SetParameters", []
    with robots.stack:
        near, far = "/rx_robot_2/planner/set_parameters", "/robot_2/planner/set_parameters"
        kind = "rcl_interfaces/srv/SetParameters"
        there: list[bool] = []
        server = robots.graphs[1].serve(far, kind, lambda client, data: server.reply(client, data + b" and its reply"))
        client = robots.graphs[0].client(near, kind, lambda *answer: answers.append(answer), there.append)
        wait_for(lambda: there, "the service to appear")
        assert robots.links[1].stats()["calls"]["reached"] == [near]  # the other five have no server
        client.call(3, asked)
        wait_for(lambda: answers, "the reply")
        assert answers == [(3, asked + b" and its reply")]


def test_a_service_needs_both_directions_of_a_link() -> None:
    rows = Registry.from_rows({"add": ADD})
    with pytest.raises(ConfigError, match="add is a service, which needs both directions of a link"):
        link(robot=1, registry=rows, middleware=MemoryMiddleware(domain_id=1), direction="send")
    with pytest.raises(ConfigError, match="add is a service"):
        RosSink(rows, middleware=MemoryMiddleware(domain_id=1))
    psk = {"name": "psk", "sample_rate": 1e6}
    running = RobotLink(
        link_from({"robot": 1, "graph": {"middleware": "memory"}, "phy": psk, "front_end": {"name": "sim"}})
    )
    assert running.stats()["calls"] == {}
    running.stop()


@pytest.mark.slow
@pytest.mark.real_time
def test_a_service_that_cannot_be_offered_is_counted_and_the_others_are_offered(tmp_path: Path) -> None:
    robots = Robots(tmp_path, f"topic,type,publish_as\nadd,{ADD}")
    with robots.stack:
        near = {"topics": {"other": {"as": "/robot_1/own"}}}
        (tmp_path / "own.csv").write_text(f"own,{ADD}\n")
        (tmp_path / "services.csv").write_text(f"add,{ADD}\nother,{ADD}\n")
        for number in (1, 2):
            robots.links[number].stop()
        robots.start(1, registry=str(tmp_path / "own.csv"), publish=near)
        robots.start(2)
        for name in (FAR, "/robot_2/other"):
            Adder(robots.graphs[1], name)
        wait_for(lambda: robots.links[2].stats()["calls"]["offered"] == [FAR, "/robot_2/other"], "both servers")
        wait_for(lambda: robots.counted(1).get("not_served"), "a loop to be refused")
        wait_for(lambda: robots.links[1].stats()["calls"]["reached"] == [NEAR], "the other service")


def test_a_full_registry_has_no_room_for_calls(tmp_path: Path) -> None:
    def robot(rows: dict[str, str]) -> RobotConfig:
        (tmp_path / "rows.csv").write_text("".join(f"{name},{kind}\n" for name, kind in rows.items()))
        return RobotConfig(robot=1, registry=str(tmp_path / "rows.csv"))

    full = {f"topic_{number}": "std_msgs/String" for number in range(MAX_TOPICS)}
    with MemoryMiddleware(domain_id=free_domains(1)[0]) as graph:
        link = RosLink(robot(full), middleware=graph)
        assert link.calls is None
        link.close()
        with pytest.raises(RegistryError, match="241 topics"):
            RosLink(robot({**dict(list(full.items())[1:]), "add": ADD}), middleware=graph)
