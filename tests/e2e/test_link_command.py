"""`gr-ros2 link` as a person uses it: it says what it does, ends at Ctrl-C, and says in a line what is wrong."""

from __future__ import annotations

import re
import signal
import subprocess
from pathlib import Path

import pytest

from gr_ros2.cli.main import run
from gr_ros2.middleware import Qos
from gr_ros2.middleware.dds import DdsMiddleware
from tests.domains import free_domains
from tests.e2e.support import COMMAND, set_options
from tests.middleware.support import CUSTOM, message
from tests.programs import ProgramProcess
from tests.waiting import PATIENCE_S, wait_for


@pytest.fixture
def domain() -> int:
    """A DDS domain nobody uses."""
    return free_domains(1)[0]


@pytest.fixture
def config(tmp_path: Path, domain: int) -> Path:
    """A link without a radio, on that domain."""
    (tmp_path / "topics.csv").write_text(f"chat,{CUSTOM}\n")
    path = tmp_path / "robot.yaml"
    path.write_text(
        f"""
        registry: topics.csv
        packet_len: 64
        robot: /robot_1
        graph: {{domain_id: {domain}, localhost_only: true}}
        queue_depth: 0
        phy: {{name: psk, sample_rate: 1e6}}
        """
    )
    return path


def link(*arguments: str | Path) -> subprocess.Popen[str]:
    return ProgramProcess(
        [*COMMAND, "link", *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_messages_come_back_until_it_is_stopped(
    config: Path, tmp_path: Path, domain: int, number: signal.Signals
) -> None:
    heard: list[bytes] = []
    with DdsMiddleware(domain_id=domain, localhost_only=True) as graph:
        graph.subscribe("/rx_robot_1/chat", CUSTOM, Qos("reliable", "volatile", 0), heard.append)
        chat = graph.advertise("/robot_1/chat", CUSTOM, Qos("reliable", "volatile", 0))
        running = link(config, "--pcap", tmp_path / "packets.pcapng")
        try:

            def answered() -> bool:
                chat.publish(message(7, 200))
                return len(heard) >= 5

            wait_for(answered, "messages to come back")
            running.send_signal(number)
            output, errors = running.communicate(timeout=PATIENCE_S)
        finally:
            running.kill()
    assert (running.returncode, errors) == (0, "")
    first, *_, last = output.splitlines()
    assert re.fullmatch(
        r"robot 1 on sim: psk at 1,000,000 samples/s, one packet per 1\.48 ms, runs on .+; Ctrl-C ends it", first
    )
    assert last.split("; ")[1].startswith("sent ")
    assert (tmp_path / "packets.pcapng").stat().st_size > 5 * 2 * 4 * 64


def test_it_ends_after_a_duration(config: Path) -> None:
    output, errors = link(config, "--duration", "0.2").communicate(timeout=PATIENCE_S)
    assert errors == ""
    assert output.splitlines()[-1].startswith("0 s; nothing sent, no publisher on /robot_1/chat; ")
    assert "no key, so anybody can read" in output


@pytest.mark.parametrize(
    ("change", "said", "status"),
    [
        ("front_end.name=rtl", "front_end.name = 'rtl': no such front_end; known are sim, zmq", 2),
        ("front_end={name: sim, gain: 3}", "front_end sim: unknown key gain", 2),
        ("phy.sample_rate=auto", "phy.sample_rate = auto: a link needs one", 2),
        ("front_end={name: soapy, args: driver=none, frequency: 1e8}", "front_end soapy: args = 'driver=none'", 1),
    ],
)
def test_what_is_wrong_is_said_in_a_line(
    config: Path, change: str, said: str, status: int, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["link", str(config), "--transmit", "--open", *set_options([change])]) == status
    output, errors = capsys.readouterr()
    assert output == ""
    assert errors.startswith("gr-ros2: ") and said in errors
    assert errors.count("\n") == 1
