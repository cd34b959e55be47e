"""What a client may ask a running link: whatever it asks, the link goes on, and a refusal says what is allowed."""

from __future__ import annotations

import json
import os
import random
import re
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from gr_ros2.cli.console import console
from gr_ros2.cli.control_socket import PING, SET, STATUS, folder, parse, request
from gr_ros2.cli.dashboard import audience
from gr_ros2.cli.link import _answers
from gr_ros2.core.errors import RunError
from gr_ros2.radio.live_settings import LiveSettings
from tests.domains import free_ports
from tests.middleware.support import message
from tests.radio.robots import Robot
from tests.waiting import PATIENCE_S, wait_for


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Robot]:
    """One whose link can be asked."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    own, other = free_ports(2)
    udp = {"name": "udp", "listen": f"127.0.0.1:{own}", "send_to": [f"127.0.0.1:{other}"]}
    modem = {"name": "modem", "options": {"bit_rate": 1e6}}
    with (
        Robot(1, udp, phy=modem, state=str(tmp_path / "state")) as made,
        audience(None, console(), "robot", answers=_answers(made.link)),
    ):
        yield made


def goes_on(robot: Robot) -> None:
    """Its sending thread has had no error, and packets leave."""
    before = robot.link.stats()["packets"]["out"]
    wait_for(lambda: robot.link.stats()["packets"]["out"] > before, "another packet")
    assert robot.link.source.stats()["pump_failed"] == 0


@pytest.mark.parametrize(
    ("question", "said"),
    [
        ({PING: {"robot": 300}}, "ping: robot = 300: .* 254"),
        ({PING: {"robot": -5, "anew": True}}, "ping: robot = -5: .* 0"),
        ({PING: {"robot": "seven"}}, "ping: robot = 'seven'"),
        ({PING: {}}, "ping: robot"),
        ({PING: 7}, "ping: expected keys and values, found 7"),
        ({SET: "repeat_s"}, "set: changes = 'repeat_s'"),
        ({SET: [["repeat_s"]]}, "set: changes"),
        ({SET: [["repeat_s", "soon"]]}, "repeat_s = 'soon'"),
        ({SET: [["packet_len", 7]]}, "packet_len cannot change while the link runs"),
        ({SET: [["queue_depth", 10**30]]}, "queue_depth = 10+: must be less"),
        ({SET: [["topic\nx\x1b[1m", 7]]}, r"topic x\\x1b\[1m cannot change"),
        ({SET: [["topics.a\nb.to", 7]]}, r"topics: 'a\\nb' '\\n' may not stand in a ROS name"),
        ({"p\nong": 7}, "p ong: no question here"),
        (
            {"pong": 7},
            "pong: no question here; known are address, listen, measure, offers, ping, port, set, status, want",
        ),
        ({"address": "127.0.0.1", "port": 70000}, "dashboard: port = 70000: .* 65535"),
        ({"address": "127.0.0.1"}, "dashboard: port"),
    ],
)
def test_what_cannot_be_asked_is_refused_and_says_what_can(robot: Robot, question: dict[str, Any], said: str) -> None:
    with pytest.raises(RunError, match=said) as refused:
        request(os.getpid(), question)
    assert "\n" not in str(refused.value)
    goes_on(robot)


def test_a_run_that_answers_nothing_else_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with audience(None, console(), "run"), pytest.raises(RunError, match=r"run is a run, and only a link answers this"):
        request(os.getpid(), {"pong": 7})


def test_a_number_given_as_text_is_a_number(robot: Robot) -> None:
    request(os.getpid(), {SET: [["packet_rate", "70"], ["repeat_s", "3"]]})
    assert robot.link.source.config.packet_rate == 70
    goes_on(robot)


ATOMS = [
    *(None, True, 0, 1, -5, 7, 254, 255, 300, 2**31, 2**64, 10**400),
    *(0.5, -0.5, 1e-320, 1e300, float("inf"), float("nan")),
    *("", "x", "auto", "7", "\0", "\ud800", "é" * 300, "latest", "deadline", "off", [], {}, {"chat": {"to": -1}}),
]  # fmt: skip


def anything(rng: random.Random, depth: int = 0) -> Any:
    if depth == 3 or rng.random() < 0.7:
        return rng.choice(ATOMS)
    if rng.random() < 0.5:
        return [anything(rng, depth + 1) for _ in range(rng.randrange(4))]
    return {str(rng.choice(ATOMS)): anything(rng, depth + 1) for _ in range(rng.randrange(4))}


@pytest.mark.parametrize("seed", range(3))
def test_whatever_is_asked_the_link_goes_on_and_no_error_is_of_the_program(robot: Robot, seed: int) -> None:
    rng, live = random.Random(seed), LiveSettings(robot.link.source, robot.link.sink)
    topics = [f"topics.{topic}.{option}" for topic in ("chat", "x", "") for option in live._options]
    names = [*live._setters, *topics, "topics", "", None, 7]
    quiet = [name for name in names if not str(name).endswith("debug")]
    for number in range(600):
        question: Any = rng.choice(
            [
                {PING: rng.choice([anything(rng), {"robot": anything(rng), "anew": anything(rng)}])},
                {SET: [[rng.choice(quiet), anything(rng)]]},
                {SET: [[rng.choice(quiet), anything(rng)]]},
                {rng.choice([PING, SET, "address", "x"]): anything(rng)},
                anything(rng),
            ]
        )
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(str(folder() / f"{os.getpid()}.sock"))
            client.sendall(json.dumps(question).encode() + b"\n")
            client.settimeout(PATIENCE_S)
            answer = parse(client.makefile("rb").readline())
        refused = str(answer.get("error", ""))
        assert not re.match(r"\w+(Error|Exception): ", refused), (question, refused)
        assert "\n" not in refused
        if number % 20 == 0:
            robot.publish(message(number, 100))
    request(os.getpid(), {SET: [["packet_rate", "auto"]]})
    goes_on(robot)
    assert "findings" in request(os.getpid(), {STATUS: True})[STATUS]
