"""An action across a live link: a goal, its feedback, its cancellation and its result, with one packet in five lost."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

pytest.importorskip("zmq", reason="needs pyzmq")

from tests.radio.calling_robots import Robots
from tests.radio.fibonacci import CANCELED, EXECUTING, FIBONACCI, FibonacciClient, FibonacciServer, statuses
from tests.waiting import wait_for

GOAL = bytes(range(16))
NEAR, FAR = "/rx_robot_2/count", "/robot_2/count"


@pytest.mark.slow
@pytest.mark.real_time
@pytest.mark.parametrize("middleware", ["memory", "dds"])
def test_a_goal_gives_feedback_is_cancelled_half_way_and_has_its_result(tmp_path: Path, middleware: str) -> None:
    robots = Robots(tmp_path, f"count,{FIBONACCI}", middleware, packet_loss=0.2)
    with robots.stack:
        client = FibonacciClient(robots.graphs[0], NEAR)
        server = FibonacciServer(robots.graphs[1], FAR)
        wait_for(lambda: client.there, "the action to appear")
        client.ask("send_goal", GOAL, struct.pack("<i", 40))
        wait_for(lambda: "send_goal" in client.replies, "the goal to be accepted")
        assert client.replies["send_goal"][4]
        client.ask("get_result", GOAL)
        wait_for(lambda: len(client.feedback) >= 10, "feedback")
        assert "get_result" not in client.replies
        client.ask("cancel_goal", GOAL, bytes(8))
        wait_for(lambda: "cancel_goal" in client.replies and "get_result" in client.replies, "the goal to end")
        status, count = struct.unpack_from("<b3xI", client.replies["get_result"], 4)
        result = list(struct.unpack_from(f"<{count}i", client.replies["get_result"], 12))
        assert status == CANCELED
        lengths = [len(numbers) for numbers in client.feedback]
        assert lengths == sorted(set(lengths)) and lengths[-1] <= count
        assert all(numbers == result[: len(numbers)] for numbers in client.feedback)
        wait_for(lambda: client.statuses[-1:] == [CANCELED], "the goal's last status")
        assert client.statuses in ([EXECUTING, CANCELED], [CANCELED])
        late, found = statuses(robots.graphs[0], NEAR)
        wait_for(lambda: found, "the status for a program that joins late")
        assert found == [CANCELED]
        late.close()
        assert server.goals == [GOAL]
        counted = robots.counted(1)
        assert {name: counted[f"answered:{NEAR}/_action/{name}"] for name in client.replies} == dict.fromkeys(
            ("send_goal", "cancel_goal", "get_result"), 1
        )
