"""Services over a link of two processes: OFDM over ZeroMQ, one packet in five lost, programs laid out as rmw_cyclonedds
has them, and every part killed once."""

from __future__ import annotations

import json
import subprocess
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest

pytest.importorskip("zmq", reason="needs pyzmq")
pytest.importorskip("cyclonedds.domain", reason="the Python part of cyclonedds does not import", exc_type=ImportError)

from gr_ros2.middleware import Qos
from gr_ros2.middleware.dds import DdsMiddleware
from tests.domains import free_domains
from tests.e2e.support import COMMAND
from tests.middleware.calling import ADD, Program
from tests.programs import ProgramProcess
from tests.waiting import wait_for

CALLS = 80
AT_A_TIME = 5
"""Calls under way: fewer than the depth of a client's reader, 10 in ROS."""
DEADLINE_S = 5.0
NEAR, FAR = "/rx_robot_2/add", "/robot_2/add"
MOST_REPORTS = 600
"""Reports of a link, which come every 0.2 s, within which a call is answered."""
OWN = {"/gr_ros2_link_1/transmit", "/gr_ros2_link_1/want"}
"""The services of the link itself, which stay on its graph."""


class Robots:
    """Two links, a server and a client, each a process of its own.

    :param found: whether robot 2 finds its services on its graph, instead of in a registry
    """

    def __init__(self, folder: Path, *, found: bool = False) -> None:
        self._folder, self._found = folder, found
        self.domains = free_domains(2)
        self.stack = ExitStack()
        (folder / "services.csv").write_text(f"add,{ADD}\n")
        self._links = {number: self._link(number) for number in (1, 2)}
        self.servers = [self._program("server")]
        self.clients = [self._program("client")]
        self.called = 0
        self.told: Counter[str] = Counter()
        self.reports = 0
        graph = self.stack.enter_context(DdsMiddleware(domain_id=self.domains[0], localhost_only=True))
        graph.subscribe("/gr_ros2_link_1/statistics", "std_msgs/msg/String", Qos(), self._told)

    def replace(self, part: str) -> None:
        """Kill a process, and start another in its place."""
        if part == "server":
            self.servers[-1].kill()
            self.servers.append(self._program("server"))
        elif part == "client":
            self.clients[-1].kill()
            self.clients.append(self._program("client"))
        else:
            self._links[int(part)].kill()
            self._links[int(part)] = self._link(int(part))

    def call(self) -> int:
        number, self.called = self.called, self.called + 1
        self.clients[-1].call(number)
        return number

    def call_until_answered(self) -> None:
        """Call, again with each report of link 1, until a call is answered.

        What a client sends to a server that has just left its graph, or died, nobody hears of.
        """
        first, begun = self.called, self.reports
        while not any(number >= first for number in self.answered):
            reports = self.reports
            assert reports - begun < MOST_REPORTS, f"{self.called - first} calls, no answer; link 1 tells {self.told}"
            if self.clients[-1].there:
                self.call()
            wait_for(lambda: self.reports != reports, "a report of link 1")  # noqa: B023 - called at once

    @property
    def answered(self) -> list[int]:
        """The numbers that were answered, one for each answer."""
        return [total - 1000 for client in self.clients for _, total in client.heard("got")]

    @property
    def taken(self) -> list[int]:
        """The numbers that a server has executed, one for each time."""
        return [number for server in self.servers for (number,) in server.heard("took")]

    def _told(self, payload: bytes) -> None:
        said = json.loads(payload[8:].rstrip(b"\0"))
        self.told = Counter(said["calls"]["counters"])
        self.reports += 1

    def _program(self, role: str) -> Program:
        domain, service = (self.domains[1], FAR) if role == "server" else (self.domains[0], NEAR)
        return self.stack.enter_context(closing(Program(domain, service, role)))

    def _link(self, number: int) -> subprocess.Popen[str]:
        own, other = (f"ipc://{self._folder}/{robot}" for robot in (number, 3 - number))
        path = self._folder / f"robot-{number}.yaml"
        path.write_text(
            f"""
            {"registry: services.csv" if number == 2 and not self._found else ""}
            packet_len: 64
            phy: {{name: ofdm, sample_rate: 4e5}}
            front_end: {{name: zmq, bind: "{own}", connect: ["{other}"]}}
            channel: {{packet_loss: 0.2, seed: {number}}}
            state: {self._folder}/state-{number}
            diagnostics: {{period_s: 0.2}}
            robot: /robot_{number}
            topics: {"auto" if self._found or number == 2 else []}
            graph: {{domain_id: {self.domains[number - 1]}, localhost_only: true}}
            publish: {{topics: {{add: {{deadline_s: {DEADLINE_S}}}}}}}
            """
        )
        link = ProgramProcess([*COMMAND, "link", str(path)], stdout=subprocess.DEVNULL, text=True)
        self.stack.callback(link.wait)
        self.stack.callback(link.kill)
        return link


@pytest.fixture
def robots(tmp_path: Path) -> Iterator[Robots]:
    robots = Robots(tmp_path)
    with robots.stack:
        yield robots


@pytest.mark.slow
@pytest.mark.real_time
def test_every_call_is_answered_once_or_times_out_by_name_and_none_runs_twice(robots: Robots) -> None:
    wait_for(lambda: robots.clients[0].there, "the service to appear at the other robot")

    def ended() -> int:
        return len(robots.answered) + robots.told[f"timed_out:{NEAR}"]

    for number in range(CALLS):
        robots.call()
        wait_for(lambda: ended() > number - AT_A_TIME, "earlier calls to end")  # noqa: B023 - called at once
    wait_for(lambda: ended() == CALLS, "the last calls to end")
    ends = [f"answered:{NEAR}", f"timed_out:{NEAR}"]
    wait_for(lambda: sum(robots.told[end] for end in ends) == CALLS, "the link to have told it")
    assert robots.told[f"called:{NEAR}"] == CALLS
    assert robots.told[ends[0]] == len(robots.answered) == len(set(robots.answered)) > 0.9 * CALLS
    assert len(robots.taken) == len(set(robots.taken))
    assert set(robots.answered) <= set(robots.taken)


@pytest.mark.slow
@pytest.mark.real_time
def test_a_service_that_was_found_is_there_only_while_its_server_is(tmp_path: Path) -> None:
    robots = Robots(tmp_path, found=True)
    with robots.stack:
        near, far = (
            robots.stack.enter_context(DdsMiddleware(domain_id=domain, localhost_only=True))
            for domain in robots.domains
        )
        for replaced in ("", "server", "2"):
            if replaced:
                robots.replace(replaced)
            wait_for(lambda: robots.clients[0].there and FAR in far.discover_services(), "the service to appear")
            assert set(near.discover_services()) == {NEAR} | OWN
            robots.call_until_answered()
        robots.servers[-1].close()
        wait_for(lambda: set(near.discover_services()) == OWN, "the service to vanish")
        assert len(robots.taken) == len(set(robots.taken))


@pytest.mark.slow
@pytest.mark.real_time
def test_calls_go_on_after_a_kill_of_each_part(robots: Robots) -> None:
    robots.call_until_answered()
    for part in ("server", "client", "1", "2"):
        robots.replace(part)
        robots.call_until_answered()
    assert len(robots.taken) == len(set(robots.taken))
    assert len(robots.answered) == len(set(robots.answered))
