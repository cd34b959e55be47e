"""Links of several robots over UDP, each in a process of its own, of which a test asks what they count."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from types import TracebackType
from typing import Any
from unittest.mock import patch

from gr_ros2.cli.main import run
from tests.domains import free_ports
from tests.e2e.support import COMMAND
from tests.spoken import Spoken
from tests.waiting import wait_for


class LinkProcess(Spoken):
    """One of them.

    :param command: what runs the link, before the name of its file
    """

    def __init__(self, file: Path, env: Mapping[str, str], command: Sequence[str], *more: str) -> None:
        self._env = env
        super().__init__([*command, str(file), *more], env={**os.environ, **env}, stderr=subprocess.STDOUT)

    def ask(self, *words: str) -> tuple[int, str]:
        """How a command that asks this link ends, and what it says."""
        with patch.dict(os.environ, self._env), redirect_stdout(StringIO()) as out, redirect_stderr(StringIO()) as err:
            status = run([*words, *(("--pid", str(self.process.pid)) if words[0] != "top" else ())])
        return status, out.getvalue() + err.getvalue()

    def status(self) -> Any:
        """What it counts, once it answers: a link that starts does not, nor one that gets no processor for seconds."""
        answers: list[str] = []

        def answered() -> bool:
            assert self.process.poll() is None, "\n".join(self.said)
            status, said = self.ask("status", "--json")
            answers.append(said)
            return status == 0

        wait_for(answered, "the link to answer")
        return json.loads(answers[-1])

    def heard(self) -> dict[int, Any]:
        """The robots that it hears."""
        return {peer["robot"]: peer for peer in self.status()["peers"]}

    def transmit(self, *, on: bool) -> None:
        """Switch its sending off, as in an outage, or on again."""
        self.process.send_signal(signal.SIGUSR2 if on else signal.SIGUSR1)

    def close(self) -> None:
        self.process.kill()
        super().close()


class Links:
    """Robots 1, 2, … that all hear each other, on graphs in memory.

    :param folder: for their files
    :param settings: of each robot, as in a file
    :param bit_rate: of the air, bit/s
    """

    def __init__(self, folder: Path, *settings: Mapping[str, Any], bit_rate: int = 1_000_000) -> None:
        self._folder = folder
        self._env = {"XDG_RUNTIME_DIR": str(folder), "XDG_STATE_HOME": str(folder / "state")}
        ports = free_ports(len(settings))
        self.files = []
        for number, (own, port) in enumerate(zip(settings, ports, strict=True), 1):
            others = [f"127.0.0.1:{other}" for other in ports if other != port]
            values = {
                "robot": f"/robot_{number}",
                "graph": {"middleware": "memory", "domain_id": 0},
                "phy": {"name": "modem", "options": {"bit_rate": bit_rate}},
                "front_end": {"name": "udp", "listen": f"127.0.0.1:{port}", "send_to": others},
                **own,
            }
            if "radios" in own:
                del values["front_end"]
            file = folder / f"robot_{number}.yaml"
            file.write_text(json.dumps(values))
            self.files.append(file)
        self._running: list[LinkProcess] = []

    def start(self, number: int, *more: str, command: Sequence[str] = (*COMMAND, "link")) -> LinkProcess:
        """Start the link of a robot.

        :param more: words after the name of its file
        :param command: what runs the link, before the name of its file
        """
        process = LinkProcess(self.files[number - 1], self._env, command, *more)
        self._running.append(process)
        return process

    def meet(self) -> None:
        """All running links hear each other."""
        for link in self._running:
            wait_for(lambda: len(link.heard()) == len(self._running) - 1, "the other robots to be heard")  # noqa: B023

    def __enter__(self) -> Links:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process in self._running:
            process.close()
