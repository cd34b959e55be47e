"""Two robots in two network namespaces that share nothing but samples over a cable: both ways, kills, a pulled plug."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

import pytest

pytest.importorskip("zmq", reason="needs pyzmq")

from gr_ros2.core.errors import RunError
from gr_ros2_lab.race.namespaces import Namespace, check_means, inside
from tests.e2e import link_peer
from tests.e2e.support import COMMAND
from tests.middleware.support import CUSTOM
from tests.spoken import Spoken
from tests.waiting import wait_for

ROOT = Path(__file__).resolve().parents[2]
CABLE = "air"
SOME = 10
"""Messages that show that a direction works, or would have come if it did."""


class Process(Spoken):
    """One in a namespace; the numbers it says are kept by their word."""

    def __init__(self, namespace: Namespace, command: Sequence[str]) -> None:
        self.numbers: dict[str, list[int]] = {"sent": [], "got": []}
        inside(namespace.path, lambda: super(Process, self).__init__(command, stderr=subprocess.STDOUT, cwd=ROOT))

    def take(self, line: str) -> None:
        word, _, number = line.strip().partition(" ")
        if word in self.numbers and number.isdigit():
            self.numbers[word].append(int(number))
        else:
            super().take(line)

    def newest(self, word: str) -> int:
        return self.numbers[word][-1] if self.numbers[word] else -1

    def close(self) -> None:
        self.process.kill()
        super().close()


def ip(namespace: Namespace, *words: str) -> None:
    inside(namespace.path, lambda: subprocess.run(["ip", *words], check=True, capture_output=True))


class Robot:
    """A namespace with one end of the cable, a robot's programs, and its end of the link."""

    def __init__(self, number: int, namespace: Namespace, folder: Path) -> None:
        self.number, self.other = number, 3 - number
        self.namespace = namespace
        self.config = folder / f"robot_{number}.yaml"
        self.config.write_text(
            f"""
            registry: topics.csv
            packet_len: 64
            robot: /robot_{number}
            graph: {{domain_id: {link_peer.DOMAIN}, localhost_only: true}}
            phy: {{name: psk, sample_rate: 1e6}}
            front_end: {{name: zmq, bind: "tcp://10.0.0.{number}:5555", connect: ["tcp://10.0.0.{self.other}:5555"]}}
            """
        )
        ip(namespace, "address", "add", f"10.0.0.{number}/24", "dev", CABLE)
        for interface in ("lo", CABLE):
            ip(namespace, "link", "set", interface, "up")
        self.programs = Process(namespace, [sys.executable, "-m", "tests.e2e.link_peer", str(number), str(self.other)])
        self.link = self.begin()

    def begin(self) -> Process:
        self.link = Process(self.namespace, [*COMMAND, "link", str(self.config)])
        return self.link

    def close(self) -> None:
        self.link.close()
        self.programs.close()


@pytest.fixture
def robots(tmp_path: Path) -> Iterator[list[Robot]]:
    try:
        check_means()
    except RunError as error:
        pytest.skip(str(error))
    (tmp_path / "topics.csv").write_text(f"chat,{CUSTOM}\n")
    with ExitStack() as stack:
        one, two = (stack.enter_context(Namespace()) for _ in range(2))
        ip(one, "link", "add", CABLE, "type", "veth", "peer", "name", CABLE, "netns", two.path)
        made = []
        for number, namespace in enumerate((one, two), start=1):
            made.append(Robot(number, namespace, tmp_path))
            stack.callback(made[-1].close)
        yield made


def both_hear_news(robots: Sequence[Robot], after: str) -> None:
    """Wait until each hears several messages that the other sends from now on."""
    sent_before = robots[1].programs.newest("sent"), robots[0].programs.newest("sent")

    def heard() -> bool:
        news = [
            sum(number > before for number in robot.programs.numbers["got"])
            for robot, before in zip(robots, sent_before, strict=True)
        ]
        return min(news) >= SOME

    try:
        wait_for(heard, f"both to hear each other after {after}")
    except AssertionError as error:
        raise AssertionError(f"{error}: {[(robot.link.said, robot.programs.said) for robot in robots]}") from error


def programs_go_on(*programs: Process) -> None:
    """Wait until each has sent many more messages."""
    before = [program.newest("sent") for program in programs]

    def sent() -> bool:
        return all(program.newest("sent") >= n + 5 * SOME for program, n in zip(programs, before, strict=True))

    wait_for(sent, "the robots' programs to go on")


@pytest.mark.slow
def test_both_ways_at_once_through_kills_and_a_pulled_plug(robots: list[Robot]) -> None:
    both_hear_news(robots, "the start")

    for robot in robots:
        robot.link.end(signal.SIGKILL)
        robot.begin()
        both_hear_news(robots, f"robot {robot.number} was killed")

    ip(robots[0].namespace, "link", "set", CABLE, "down")
    one, two = (robot.programs for robot in robots)

    def silent() -> bool:
        """Whether nothing came while both sent many more messages: what was on its way arrives first."""
        before = one.newest("got"), two.newest("got")
        programs_go_on(one, two)
        return (one.newest("got"), two.newest("got")) == before

    wait_for(silent, "nothing to come through a cable that is pulled out")
    ip(robots[0].namespace, "link", "set", CABLE, "up")
    both_hear_news(robots, "the plug was in again")

    for robot in robots:
        heard = robot.programs.numbers["got"]
        assert len(heard) == len(set(heard)), "a message came twice"
        assert heard == sorted(heard), "a message came after a later one"
        assert robot.link.end(signal.SIGINT) == 0, robot.link.said
        assert "received" in robot.link.said[-1]
