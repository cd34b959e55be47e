"""Runs on one computer do not receive each other's messages, and say so where they do."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path

import pytest

from gr_ros2.middleware import Qos
from gr_ros2.middleware.dds import DdsMiddleware
from gr_ros2_lab.record.result import read_result
from gr_ros2_lab.run.domains import ReservedDomain, on_own_domains
from gr_ros2_lab.run.robot_settings import RobotSettings
from gr_ros2_lab.run.scenario import load_scenario
from tests.domains import free_domains
from tests.programs import ProgramProcess
from tests.waiting import wait_for

RUN = [sys.executable, "-m", "gr_ros2.cli", "run", "paper-direct", "--no-report", "--duration", "2"]


def domains(robots: Iterable[RobotSettings]) -> list[int | str]:
    """Those of each robot's graph."""
    return [robot.config.graph.domain_id for robot in robots]


def begun(out: Path, *words: str) -> subprocess.Popen[str]:
    return ProgramProcess([*RUN, "--out", str(out), *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.slow
@pytest.mark.real_time
def test_two_runs_at_once_do_not_mix(tmp_path: Path) -> None:
    used = set()
    for number, one in enumerate([begun(tmp_path / str(number)) for number in range(2)]):
        out, err = one.communicate()
        assert one.returncode == 0, err
        used |= {int(domain) for domain in re.findall(r"ROS_DOMAIN_ID=(\d+)", out)}
        sent = {topic.topic: topic.sent for topic in read_result(tmp_path / str(number)).topics}
        # Two robots on one graph would send twice as many.
        assert sent["/robot_1/odom"] <= 60
    assert len(used) == 4


@pytest.mark.slow
@pytest.mark.real_time
def test_a_run_that_receives_what_it_did_not_send_fails(tmp_path: Path) -> None:
    (domain,) = free_domains(1)
    run = begun(tmp_path, "--set", f"graph.domain_id={domain}")
    with DdsMiddleware(domain_id=domain, localhost_only=True) as graph:
        publisher = graph.advertise("/robot_1/odom", "nav_msgs/msg/Odometry", Qos(depth=1))
        wait_for(lambda: publisher.publish(b"\0\1\0\0" + bytes(720)) or run.poll() is not None, "the run to end")
    _, err = run.communicate()
    assert run.returncode == 1
    assert re.search(
        rf"paper-direct: \d+ messages were received on /robot_1/odom and this run published \d+: another program "
        rf"publishes there, on ROS domain {domain}; end it, or set another domain_id",
        err,
    )


def test_a_domain_that_is_named_stays() -> None:
    words = ["robots.0.graph.domain_id=7"]
    with ExitStack() as stack:
        here, there = domains(on_own_domains(load_scenario("two-way", words), stack))
        assert here == 7
        assert there not in (7, "auto")


def test_two_ends_have_two_graphs_that_are_free_again_afterwards() -> None:
    with ExitStack() as stack:
        robots = on_own_domains(load_scenario("demo", ["robots=[{}, {topics: []}, {topics: []}]"]), stack)
        here, there, elsewhere = domains(robots)
        assert isinstance(here, int)
        assert len({here, there, elsewhere}) == 3, "each is on a graph of its own"
    with ReservedDomain([here]) as again:
        assert again.number == here


def test_one_graph_is_that_of_the_shell() -> None:
    with ExitStack() as stack:
        scenario = load_scenario("one-graph")  # it has own_domains: false
        assert on_own_domains(scenario, stack) is scenario.all_robots
