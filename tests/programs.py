"""Programs of ours, each in a process of its own, without the second of processor time in which it would load modules.

A test process has a nursery: one process that has loaded what programs load, and forks one for each start. The program
has its own arguments, folder, environment and streams, its memory is its own, and the test process is its parent. What
matters as Python begins (another ``PYTHONPATH`` or home, memory, the time to start) is tried with ``subprocess``, or by
:data:`ANEW`. What a thread in another network namespace starts begins anew, too.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, AnyStr

LOADED = (
    *("gr_ros2.cli.main", "gr_ros2.radio.robot_link", "gr_ros2.compression", "gr_ros2.middleware.dds"),
    *("gr_ros2.middleware.memory", "gr_ros2.phy.modem", "gr_ros2.phy.ofdm", "gr_ros2.phy.psk", "gr_ros2.radio.udp"),
    *("gr_ros2.radio.zmq", "gr_ros2_lab.race.runner", "gr_ros2_lab.report.page", "gr_ros2_lab.run.runner"),
)
_AT_START = ("GR_", "HOME", "LANG", "LC_", "LD_", "MPL", "OPENBLAS", "PYTHON", "TZ", "XDG_CACHE", "XDG_CONFIG")
"""Beginnings of the names of what is read as modules are loaded."""
ANEW = (sys.executable, "-B", "-m")
"""How a command begins whose program loads everything itself."""
_ALLOCATOR = "jemalloc_bg_thd"
"""Of pyarrow; jemalloc looks after it in forks itself."""
_ENVIRONMENT = dict(os.environ)
"""Of the nursery."""
_NETWORK = Path("/proc/thread-self/ns/net")
"""Names the network namespace of a thread, which may have entered another one."""
_HERE = _NETWORK.readlink()
_SUBREAPER = 36
"""``PR_SET_CHILD_SUBREAPER`` of prctl(2)."""


class ProgramProcess(subprocess.Popen[AnyStr]):
    """As ``subprocess.Popen``; ``python -m MODULE …`` with this Python comes out of the nursery."""

    def _execute_child(self, args: Any, executable: Any, preexec_fn: Any, *more: Any) -> None:
        _, _, cwd, env, _, _, shell, *pipes = more[:13]
        ours = not isinstance(args, str) and tuple(map(str, args[:2])) == (sys.executable, "-m")
        session = more[18]
        elsewhere = _NETWORK.readlink() != _HERE
        if not ours or elsewhere or shell or preexec_fn is not None or _at_start(env) != _at_start(_ENVIRONMENT):
            super()._execute_child(args, executable, preexec_fn, *more)  # type: ignore[misc]
            return
        stdin, _, _, stdout, _, stderr = pipes
        streams = [own if fd == -1 else fd for own, fd in enumerate((stdin, stdout, stderr))]
        self.pid = _nursery().start([str(word) for word in args[2:]], cwd, env, streams, session=session)
        self._child_created = True
        self._close_pipe_fds(*pipes)  # type: ignore[attr-defined]


def run_program(
    command: Sequence[Any],
    *,
    input: Any = None,
    capture_output: bool = False,
    timeout: float | None = None,
    check: bool = False,
    **options: Any,
) -> subprocess.CompletedProcess[Any]:
    """As ``subprocess.run``, of a :class:`ProgramProcess`."""
    if input is not None:
        options["stdin"] = subprocess.PIPE
    if capture_output:
        options["stdout"] = options["stderr"] = subprocess.PIPE
    with ProgramProcess(list(command), **options) as process:
        try:
            out, err = process.communicate(input, timeout)
        except BaseException:
            process.kill()
            raise
    done = subprocess.CompletedProcess(process.args, process.returncode, out, err)
    if check:
        done.check_returncode()
    return done


def _text(env: Mapping[Any, Any] | None) -> dict[str, str]:
    return {os.fsdecode(name): os.fsdecode(value) for name, value in (os.environ if env is None else env).items()}


def _at_start(env: Mapping[Any, Any] | None) -> dict[str, str]:
    return {name: value for name, value in _text(env).items() if name.startswith(_AT_START)}


class _Nursery:
    """The process that forks."""

    def __init__(self) -> None:
        self._line, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._lock = threading.Lock()
        self._adopt = ctypes.CDLL(None, use_errno=True).prctl
        command = [sys.executable, "-m", __name__, str(theirs.fileno())]
        self._process = subprocess.Popen(
            command, env=_ENVIRONMENT, stdin=subprocess.DEVNULL, pass_fds=[theirs.fileno()]
        )
        theirs.close()

    def start(
        self, words: list[str], cwd: Any, env: Mapping[Any, Any] | None, streams: list[int], *, session: bool
    ) -> int:
        """Start ``python -m WORDS``; returns the number of the process, a child of this one."""
        asked = [words, os.fspath(cwd or Path.cwd()), _text(env), bool(session)]
        with self._lock:
            # While it lasts, children of this process's children become its own when their parents end.
            self._adopt(_SUBREAPER, 1)
            try:
                socket.send_fds(self._line, [json.dumps(asked).encode()], streams)
                pid = int(self._line.recv(100))
                assert self._line.recv(100) == b"adopted"
            finally:
                self._adopt(_SUBREAPER, 0)
        return pid


@cache
def _nursery() -> _Nursery:
    return _Nursery()


def _born(line: socket.socket) -> list[Any]:
    """Fork for each request, until the test process has ended. It returns in the forked process alone."""
    while True:
        request, streams, _, _ = socket.recv_fds(line, 1 << 20, 3)
        if not request:
            sys.exit()
        between = os.fork()
        if between == 0:
            between = os.getpid()
            child = os.fork()
            if child:
                line.send(str(child).encode())
                os._exit(0)
            for own, fd in enumerate(streams):
                os.dup2(fd, own)
                os.close(fd)
            line.close()
            while os.getppid() == between:
                time.sleep(0.001)
            found: list[Any] = json.loads(request)
            return found
        os.waitpid(between, 0)
        line.send(b"adopted")
        for fd in streams:
            os.close(fd)


def _main(number: str) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for name in LOADED:
        with suppress(ImportError):  # an extra that is not there
            import_module(name)
    threads = [path.read_text().strip() for path in Path("/proc/self/task").glob("*/comm")]
    assert len(threads) - threads.count(_ALLOCATOR) == 1, f"a fork would lack other threads: {threads}"
    gc.collect()
    gc.freeze()
    words, cwd, env, session = _born(socket.socket(fileno=int(number)))
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if session:
        os.setsid()
    os.environ.clear()
    os.environ.update(env)
    os.chdir(cwd)
    module, *sys.argv[1:] = words
    sys.path[0] = cwd
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    _main(sys.argv[1])
