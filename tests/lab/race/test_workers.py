from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path

import pytest

from gr_ros2.core.errors import ConfigError, RunError
from gr_ros2_lab.race.namespaces import Namespace
from gr_ros2_lab.race.workers import Worker
from tests.lab.race.support import needs_namespaces


class Helper:
    """What the workers of these tests serve."""

    def __init__(self, closed: Path | None = None, broken: bool = False) -> None:
        if broken:
            raise ConfigError("broken = True: make it whole")
        self._closed = closed
        self.pid = os.getpid()

    def namespace(self) -> str:
        return str(Path("/proc/thread-self/ns/net").readlink())

    def namespace_of_a_thread(self) -> str:
        found: list[str] = []
        thread = threading.Thread(target=lambda: found.append(self.namespace()))
        thread.start()
        thread.join()
        return found[0]

    def fail(self) -> None:
        raise ValueError("no good")

    def hang(self) -> None:
        time.sleep(1e6)

    def __enter__(self) -> Helper:
        return self

    def __exit__(self, *_: object) -> None:
        if self._closed is not None:
            self._closed.touch()


def gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


def test_a_worker_answers_and_closes_what_it_serves(tmp_path: Path) -> None:
    with Worker("helper", "", Helper, tmp_path / "closed") as worker:
        pid = worker.call("pid")
        assert pid != os.getpid()
    assert gone(pid)
    assert (tmp_path / "closed").exists()


def test_what_fails_in_a_worker_fails_here_in_the_same_words() -> None:
    with pytest.raises(RunError, match="the race's helper: broken = True: make it whole"):
        Worker("helper", "", Helper, None, True)
    with Worker("helper", "", Helper) as worker:
        with pytest.raises(RunError, match="the race's helper: ValueError: no good"):
            worker.call("fail")
        with pytest.raises(RunError, match="has ended before its time"):
            worker.call("pid")


def test_a_worker_that_is_killed_is_missed() -> None:
    with Worker("helper", "", Helper) as worker:
        os.kill(worker.call("pid"), signal.SIGKILL)
        with pytest.raises(RunError, match="the race's helper has ended before its time"):
            worker.call("hang")


def test_a_worker_that_hangs_is_given_up_and_ended() -> None:
    with pytest.raises(RunError, match=r"has not answered for 0\.1 s"), Worker("helper", "", Helper) as worker:
        pid = worker.call("pid")
        worker.call("hang", timeout_s=0.1)
    assert gone(pid)


@needs_namespaces
def test_a_worker_and_its_threads_are_in_their_namespace() -> None:
    with Namespace() as namespace, Worker("helper", namespace.path, Helper) as worker:
        inside = worker.call("namespace")
        assert inside == worker.call("namespace_of_a_thread") != str(Path("/proc/thread-self/ns/net").readlink())
