"""Services on the embedded DDS: what rmw_cyclonedds expects of a server and of a client, in both roles."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing

import pytest

from gr_ros2.middleware import ros_graph
from gr_ros2.middleware.cdr_dds import DiscoveredEndpoint
from gr_ros2.middleware.dds import DdsMiddleware
from gr_ros2.middleware.dds_services import DdsServer, with_header, without_header
from gr_ros2.middleware.ros_graph import NodeEntities, dds_service, ros_service
from gr_ros2.middleware.services import SERVICE_QOS
from tests.middleware.calling import ADD, Adder, Caller, Program
from tests.waiting import wait_for

pytest.importorskip("cyclonedds.domain", reason="the Python part of cyclonedds does not import", exc_type=ImportError)

SERVICE = "/robot_1/add"


def test_a_client_of_another_program_is_answered(graph: DdsMiddleware, domain: int) -> None:
    adder = Adder(graph, SERVICE)
    with closing(Program(domain, SERVICE, "client")) as client:
        wait_for(lambda: client.there, "the client to find the server")
        for number in range(50):
            client.call(number)
            wait_for(lambda: len(client.heard("got")) > number, "the reply")  # noqa: B023 - called at once
        assert client.heard("got") == [[number, number + 1000] for number in range(50)]
        assert adder.taken == list(range(50))
        adder.server.close()
        wait_for(lambda: not client.there, "the client to see that it has left")
    assert not graph.counters


def test_a_server_of_another_program_answers_and_is_seen_to_come_and_go(graph: DdsMiddleware, domain: int) -> None:
    caller = Caller(graph, SERVICE)
    assert not caller.there
    for start in (0, 100):
        with closing(Program(domain, SERVICE, "server")) as server:
            wait_for(lambda: caller.there, "the server to be found")
            for number in range(start, start + 50):
                caller.call(number)
                wait_for(lambda: number in caller.got, "the reply")  # noqa: B023 - called at once
            requests = [[number] for number in range(start, start + 50)]
            wait_for(lambda: server.heard("took") == requests, "what the program says")  # noqa: B023 - called at once
        wait_for(lambda: not caller.there, "the server to be missed")
    assert caller.got == {number: [number + 1000] for number in (*range(50), *range(100, 150))}


def test_a_server_rests_while_nobody_calls(graph: DdsMiddleware, domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A status that is not reset calls its thread again at once, for ever."""
    looks: list[str] = []
    service = DdsServer.service
    monkeypatch.setattr(DdsServer, "service", lambda self: [looks.append(self.name), service(self)][1])
    with DdsMiddleware(domain_id=domain, localhost_only=True) as other:
        adder, caller = Adder(other, SERVICE), Caller(graph, SERVICE)
        wait_for(lambda: caller.there, "the server to be found")
        for number in range(20):
            caller.call(number)
            wait_for(lambda: number in caller.got, "the reply")  # noqa: B023 - called at once
        assert sorted(adder.taken) == list(range(20))
        assert len(looks) <= 2 * 20 + 10


def test_a_client_takes_only_its_own_replies(graph: DdsMiddleware, domain: int) -> None:
    with DdsMiddleware(domain_id=domain, localhost_only=True) as other:
        adder = Adder(other, SERVICE)
        one, two = Caller(graph, SERVICE), Caller(graph, SERVICE)
        wait_for(lambda: one.there and two.there, "the server to be found")
        one.call(1)
        two.call(2)
        wait_for(lambda: one.got and two.got, "the replies")
        assert (one.got, two.got) == ({1: [1001]}, {2: [1002]})
        assert sorted(adder.taken) == [1, 2]


def test_a_server_of_the_same_participant_does_not_count(graph: DdsMiddleware, domain: int) -> None:
    Adder(graph, SERVICE)
    caller = Caller(graph, SERVICE)
    with DdsMiddleware(domain_id=domain, localhost_only=True) as other:
        elsewhere = Caller(other, SERVICE)
        wait_for(lambda: elsewhere.there, "a client elsewhere to find the server")
        assert not caller.there


def test_the_services_of_other_programs_are_found_as_long_as_they_have_a_server(
    graph: DdsMiddleware, domain: int
) -> None:
    with closing(Program(domain, SERVICE, "server")), closing(Program(domain, "/robot_1/wanted", "client")) as client:
        wait_for(lambda: graph.discover_services() == {SERVICE: ADD}, "the server to be found")
        wait_for(lambda: client.ready, "the client")
        Adder(graph, "/robot_1/own")
        with DdsMiddleware(domain_id=domain, localhost_only=True) as other:
            Adder(other, "/robot_1/another")
            wait_for(lambda: len(graph.discover_services()) == 2, "the second server")
            assert graph.discover_services() == {SERVICE: ADD, "/robot_1/another": ADD}
            wait_for(lambda: "/robot_1/own" in other.discover_services(), "what others see")
    wait_for(lambda: not graph.discover_services(), "the servers to be missed")


def test_a_reader_of_requests_alone_is_no_server(graph: DdsMiddleware, domain: int) -> None:
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    from tests.middleware.service_peer import AddRequest, endpoints

    participant = DomainParticipant(domain)
    alone = DataReader(participant, Topic(participant, f"rq{SERVICE}Request", AddRequest))
    whole = endpoints(participant, "/robot_1/whole", "server")
    wait_for(lambda: "/robot_1/whole" in graph.discover_services(), "a server that was made later")
    assert graph.discover_services() == {"/robot_1/whole": ADD}
    del alone, whole


def test_names_and_types_are_those_of_ros() -> None:
    for name, kind in (("/robot_1/add", ADD), ("/a/_action/send_goal", "b/action/C_SendGoal")):
        (requests, request), (replies, reply) = dds_service(name, kind)
        assert ros_service(requests, request) == (name, kind)
        assert ros_service(replies, reply) is None
    assert ros_service("rt/odomRequest", "nav_msgs::msg::dds_::Odometry_") is None
    assert dds_service("/robot_1/add", ADD) == (
        ("rq/robot_1/addRequest", "example_interfaces::srv::dds_::AddTwoInts_Request_"),
        ("rr/robot_1/addReply", "example_interfaces::srv::dds_::AddTwoInts_Response_"),
    )


def test_the_header_stands_between_encapsulation_and_message() -> None:
    header, payload = bytes(range(16)), b"\0\1\0\0message!"
    assert with_header(header, payload) == b"\0\1\0\0" + header + b"message!"
    assert without_header(with_header(header, payload)) == (header, payload)
    assert without_header(b"\0\1\0\0" + bytes(15)) is None


def test_services_are_announced_with_their_node(graph: DdsMiddleware, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[Sequence[NodeEntities]] = []
    write = ros_graph.participant_entities_info
    monkeypatch.setattr(
        ros_graph, "participant_entities_info", lambda *given, **more: told.append(given[1]) or write(*given, **more)
    )
    own = graph.serve("/rx_robot_2/add", ADD, lambda *_: None)
    params = graph.serve("/rx_robot_2/planner/set", ADD, lambda *_: None, "/rx_robot_2/planner")
    assert [tuple(node) for node in told[-1]] == [
        ("gr_ros2", "/", [own.reader.guid], [own.writers[0].guid]),
        ("planner", "/rx_robot_2", [params.reader.guid], [params.writers[0].guid]),
    ]
    params.close()
    assert len(told[-1]) == 1


def test_services_of_another_rmw_are_found_and_known_to_be_out_of_reach(graph: DdsMiddleware) -> None:
    (requests, asks), (replies, answers) = dds_service(SERVICE, ADD)
    fast = bytes((1, 15)) + bytes(14)
    ends = [DiscoveredEndpoint(fast, fast, *names, SERVICE_QOS) for names in ((replies, answers), (requests, asks))]
    for end, publishers in zip(ends, (True, False), strict=True):
        graph._others.change([(end.key, end)], publishers=publishers)
    assert graph.discover_services() == {SERVICE: ADD}
    assert graph.uncallable() == {SERVICE}
