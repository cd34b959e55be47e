"""Services and actions that a link finds on its robot's graph, as `topics: auto` has it."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

pytest.importorskip("zmq", reason="needs pyzmq")

from gr_ros2.middleware import Qos
from gr_ros2.radio.waiting import Waiting
from gr_ros2.settings.service_rows import parts
from tests.middleware.calling import Adder, Caller
from tests.radio.calling_robots import Robots
from tests.radio.fibonacci import CANCELED, FIBONACCI, FibonacciClient, FibonacciServer
from tests.waiting import wait_for

NEAR, FAR = "/rx_robot_2/add", "/robot_2/add"
GOAL = bytes(range(16))
SET = "rcl_interfaces/srv/SetParameters"
DESCRIBE = "type_description_interfaces/srv/GetTypeDescription"
QUIET = "/robot_2/quiet/_action/status"
STRING = "std_msgs/msg/String"


def offered(robots: Robots, number: int) -> list[str]:
    found: list[str] = robots.links[number].stats()["calls"]["offered"]
    return found


def reached(robots: Robots, number: int) -> list[str]:
    found: list[str] = robots.links[number].stats()["calls"]["reached"]
    return found


def services_of(action: str) -> list[str]:
    return sorted(name for name in parts(action, FIBONACCI) if not name.endswith(("feedback", "status")))


@pytest.mark.slow
@pytest.mark.real_time
@pytest.mark.parametrize("middleware", ["memory", "dds"])
def test_auto_offers_services_and_actions_of_the_namespace(
    tmp_path: Path, middleware: str, caplog: pytest.LogCaptureFixture
) -> None:
    words = ["auto", "-left_out", "-left_out_action", "-quiet/_action/feedback"]
    robots = Robots(tmp_path, "", middleware, topics=words, packet_loss=0.1)
    with robots.stack:
        near, far = robots.graphs
        for name in ("/elsewhere/add", "/robot_2/left_out", "/robot_2/_hidden"):
            Adder(far, name)
        for name, kind in (("set_parameters", SET), ("get_type_description", DESCRIBE)):
            far.serve(f"/robot_2/planner/{name}", kind, lambda *_: None)
        FibonacciServer(far, "/robot_2/left_out_action")
        for name in ("/robot_2/count", "/robot_2/quiet"):
            FibonacciServer(far, name)
        client, caller = FibonacciClient(near, "/rx_robot_2/count"), Caller(near, NEAR)
        adder = Adder(far, FAR)
        wait_for(lambda: caller.there and client.there, "service and action to appear")
        for prefix, found, number in (("/robot_2", offered, 2), ("/rx_robot_2", reached, 1)):
            wanted = sorted(
                [f"{prefix}/add", *services_of(f"{prefix}/count"), *services_of(f"{prefix}/quiet")],
            )
            wait_for(lambda: found(robots, number) == wanted, "all services")  # noqa: B023 - called at once
        assert {name for name in robots.links[2].source.subscriptions.subscribed if "quiet" in name} == {QUIET}
        caller.call(1)
        wait_for(lambda: caller.got == {1: [1001]}, "the reply")
        client.ask("send_goal", GOAL, struct.pack("<i", 40))
        wait_for(lambda: client.feedback, "feedback")
        client.ask("get_result", GOAL)
        client.ask("cancel_goal", GOAL, bytes(8))
        wait_for(lambda: "get_result" in client.replies, "the result")
        assert client.replies["get_result"][4] == CANCELED
        said = Waiting(robots.links[2].source).look()
        assert said is not None
        assert said.endswith("; services and actions: /robot_2/add, /robot_2/count, /robot_2/quiet")
        assert "_action" not in said
        adder.server.close()
        wait_for(lambda: not caller.there, "the service to vanish")
        again = Adder(far, FAR)
        wait_for(lambda: caller.there, "the service to come back")
        caller.call(2)
        wait_for(lambda: again.taken == [2] and 2 in caller.got, "the reply of the new server")
    assert caplog.text.count("can be called by whoever can send on this link, as it has no key") == 1


@pytest.mark.slow
@pytest.mark.real_time
def test_a_service_that_came_by_radio_is_not_offered_again(tmp_path: Path) -> None:
    """Both robots take everything there is on their graphs, and each graph has the other robot's services."""
    robots = Robots(tmp_path, "", topics=["/*", "/robot_2/planner"])
    with robots.stack:
        near, far = robots.graphs
        Adder(far, FAR)
        FibonacciServer(far, "/robot_2/count")
        far.serve("/robot_2/planner/set_parameters", SET, lambda *_: None)
        fars = sorted([FAR, "/robot_2/planner/set_parameters", *services_of("/robot_2/count")])
        wait_for(lambda: len(reached(robots, 1)) == len(fars), "the services to appear")
        Adder(near, "/robot_1/later")
        wait_for(lambda: offered(robots, 1) == ["/robot_1/later"], "what was made after them to be found")
        wait_for(lambda: len(reached(robots, 2)) == 1, "it to appear at the other robot")
        Adder(far, "/robot_2/last")
        wait_for(lambda: offered(robots, 2) == sorted([*fars, "/robot_2/last"]), "the same at the other robot")
        assert offered(robots, 1) == ["/robot_1/later"]


@pytest.mark.real_time
def test_services_can_be_left_to_the_robot(tmp_path: Path) -> None:
    robots = Robots(tmp_path, "")
    with robots.stack:
        robots.links[2].stop()
        robots.start(2, topics=["auto"], services=False)
        Adder(robots.graphs[1], FAR)
        robots.graphs[1].advertise("/robot_2/later", STRING, Qos())
        source = robots.links[2].source
        wait_for(
            lambda: "/robot_2/later" in source.subscriptions.subscribed, "a topic that was made after it to be found"
        )
        assert not source.found.offered
        assert not offered(robots, 2)


@pytest.mark.real_time
def test_what_finds_no_room_is_left_out_as_a_whole(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    robots = Robots(tmp_path, "", topics=["auto"])
    with robots.stack:
        source = robots.links[2].source
        for number in range(235):  # with the row of calls, four numbers are left
            robots.graphs[1].advertise(f"/robot_2/topic_{number}", STRING, Qos())
        wait_for(lambda: len(source.subscriptions.subscribed) == 235, "the topics to be found")
        FibonacciServer(robots.graphs[1], "/robot_2/count")
        wait_for(lambda: "/robot_2/count (example_interfaces/action/Fibonacci) is not offered" in caplog.text, "a word")
        Adder(robots.graphs[1], FAR)
        wait_for(lambda: offered(robots, 2) == [FAR], "a service that fits")
        assert not [name for name in source.subscriptions.subscribed if "_action" in name]
