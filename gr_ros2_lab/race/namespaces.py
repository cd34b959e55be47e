"""Network namespaces without names. A namespace exists only while a process holds it, so none can be left behind.

Invariants: a namespace contains the threads that enter it, and the threads and processes that these threads then
start. The rest of the process stays in its own namespace. The kernel removes a namespace with all its interfaces when
its last holder has ended, for any reason.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from gr_ros2.core.closing import Closing
from gr_ros2.core.errors import RunError

T = TypeVar("T")

_CLONE_NEWNET = 0x40000000
_OWN_NAMESPACE = "/proc/thread-self/ns/net"
_TUN_DEVICE = Path("/dev/net/tun")
_TOOLS = ("ip", "tc")
_libc = ctypes.CDLL(None, use_errno=True)


class Namespace(Closing):
    """A new network namespace. It contains only a loopback interface, which is down.

    :raises RunError: when this process has no permission to create one
    """

    def __init__(self) -> None:
        self._file = _in_thread(_make)

    @property
    def path(self) -> str:
        """Path of the namespace for this process and its children, valid while it is open."""
        return f"/proc/{os.getpid()}/fd/{self._file}"

    def close(self) -> None:
        """Release the namespace. Idempotent."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


def enter(path: str) -> None:
    """Move the calling thread into a namespace.

    :param path: see :attr:`Namespace.path`
    :raises RunError: when it cannot be entered
    """
    file = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        if _libc.setns(file, _CLONE_NEWNET):
            raise RunError(f"network namespace {path}: cannot be entered ({os.strerror(ctypes.get_errno())})")
    finally:
        os.close(file)


def inside(path: str, work: Callable[[], T]) -> T:
    """Run ``work`` in a new thread inside a namespace. Return or raise what ``work`` returns or raises."""

    def entered() -> T:
        enter(path)
        return work()

    return _in_thread(entered)


def check_means() -> None:
    """Check whether this computer can create namespaces and a TUN device.

    :raises RunError: when something is missing; the message names it and the remedy
    """
    missing = [tool for tool in _TOOLS if shutil.which(tool) is None]
    if missing:
        raise RunError(f"the race needs the command {missing[0]}: apt install iproute2")
    if not _TUN_DEVICE.exists():
        raise RunError(f"the race needs {_TUN_DEVICE}: modprobe tun, or in a container --device {_TUN_DEVICE}")
    Namespace().close()


def _make() -> int:
    if _libc.unshare(_CLONE_NEWNET):
        reason = os.strerror(ctypes.get_errno())
        raise RunError(
            f"the race needs root, for network namespaces ({reason}): run it with sudo, or in a container with "
            "--cap-add SYS_ADMIN --cap-add NET_ADMIN"
        )
    return os.open(_OWN_NAMESPACE, os.O_RDONLY | os.O_CLOEXEC)


def _in_thread(work: Callable[[], T]) -> T:
    results: list[T] = []
    errors: list[BaseException] = []

    def run() -> None:
        try:
            results.append(work())
        except BaseException as error:  # noqa: BLE001 - raised again by the caller's thread
            errors.append(error)

    thread = threading.Thread(target=run, name="gr-ros2-namespace")
    thread.start()
    thread.join()
    if errors:
        raise errors[0]
    return results[0]
