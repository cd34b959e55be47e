"""Checks of the computer: its clock, and the limits that matter for a link in real time.

Invariant: nothing is changed. Every limit is reported with the value found and the value that is enough.
"""

from __future__ import annotations

import ctypes
import os
import resource
import time
from collections import Counter
from collections.abc import Iterator
from datetime import datetime, timezone
from pathlib import Path

from gr_ros2.doctor.finding import Finding

_BUILT = datetime(2025, 1, 1, tzinfo=timezone.utc)
"""This program was made later, so a clock that shows an earlier date is wrong."""
_FAR = datetime(2100, 1, 1, tzinfo=timezone.utc)
_TIME_ERROR, _UNSYNCHRONISED = 5, 0x0040
"""Result and status bit of ``adjtimex`` (Linux, adjtimex(2)) when the clock is not synchronised."""
_MEASURED_S = 0.5
_STEP_S = 0.005
"""s by which the two clocks may differ after ``_MEASURED_S``: 1 %, a hundred times the error of any oscillator."""
_ENOUGH_RTPRIO, _ENOUGH_MEMLOCK, _ENOUGH_FILES = 1, 64 << 20, 1024
_ENOUGH_BUFFER = 2_500_000
"""Bytes. UHD and DDS vendors ask for about this size."""
_SEGMENTS_WARN, _SEGMENTS_LEFT = 0.8, 64
_LIMITS = "/etc/security/limits.d/gr-ros2.conf"


class _Timex(ctypes.Structure):
    """The first fields of ``struct timex``. The kernel also writes the bytes after them."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_char * 256),
    )


def date() -> Finding:
    """Whether the date is plausible."""
    now = datetime.now(timezone.utc)
    text = f"{now:%Y-%m-%d %H:%M:%S} UTC"
    if _BUILT <= now <= _FAR:
        return Finding("date", "ok", text)
    return Finding(
        "date", "failed", f"{text} cannot be", "sudo timedatectl set-ntp true, or sudo date -s 'YYYY-MM-DD HH:MM'"
    )


def synchronised() -> Finding:
    """Whether the clock is synchronised. Latency is measured with the clocks of both robots."""
    timex = _Timex()
    state = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(timex))
    if state < 0:
        return Finding("NTP", "note", f"the kernel does not tell ({os.strerror(ctypes.get_errno())})")
    ppm = timex.freq / (1 << 16)
    if state == _TIME_ERROR or timex.status & _UNSYNCHRONISED:
        text = "the clock is not synchronised; latency between two computers is wrong by as much as their clocks differ"
        return Finding("NTP", "warning", text, "sudo timedatectl set-ntp true, or sudo apt install chrony")
    text = f"synchronised to {timex.maxerror / 1e3:.0f} ms at worst, oscillator corrected by {ppm:+.1f} ppm"
    return Finding("NTP", "ok", text)


def drift() -> Finding:
    """Whether the wall clock runs as fast as the monotonic clock. An adjusted wall clock makes latencies jump."""
    begin = time.time(), time.monotonic()
    time.sleep(_MEASURED_S)
    apart = (time.time() - begin[0]) - (time.monotonic() - begin[1])
    text = f"wall clock and monotonic clock parted by {apart * 1e6:+.0f} us in {_MEASURED_S:g} s"
    if abs(apart) > _STEP_S:
        return Finding("drift", "warning", text, "let NTP settle, or find who sets the clock")
    return Finding("drift", "ok", text)


def limits() -> Iterator[Finding]:
    """The limits of this process: priority, locked memory, open files."""
    yield _limit("rtprio", resource.RLIMIT_RTPRIO, _ENOUGH_RTPRIO, "95", "GNU Radio cannot have a real-time priority")
    yield _limit("memlock", resource.RLIMIT_MEMLOCK, _ENOUGH_MEMLOCK, "unlimited", "drivers cannot lock their buffers")
    yield _limit("nofile", resource.RLIMIT_NOFILE, _ENOUGH_FILES, "65536", "many flowgraphs or topics do not open")


def _limit(name: str, number: int, enough: int, proposed: str, effect: str) -> Finding:
    soft = resource.getrlimit(number)[0]
    text = "unlimited" if soft == resource.RLIM_INFINITY else f"{soft:,}"
    if soft == resource.RLIM_INFINITY or soft >= enough or (number == resource.RLIMIT_RTPRIO and os.geteuid() == 0):
        return Finding(name, "ok", text)
    remedy = f"echo '* - {name} {proposed}' | sudo tee -a {_LIMITS}; log in again"
    return Finding(name, "warning", f"{text}, {enough:,} is enough: {effect}", remedy)


def shared_memory(proc: Path = Path("/proc")) -> Iterator[Finding]:
    """Shared memory segments that are left for GNU Radio's buffers. Each buffer takes one segment.

    :param proc: the folder /proc
    """
    most = int((proc / "sys/kernel/shmmni").read_text())
    used = len((proc / "sysvipc/shm").read_text().splitlines()) - 1
    text = f"{used} of {most} segments in use"
    remedy = "ipcs -m lists them, ipcrm -m ID removes one of a program that has ended; sudo sysctl kernel.shmmni=8192"
    if most - used < _SEGMENTS_LEFT:
        yield Finding("shared memory", "failed", f"{text}: no flowgraph can start", remedy)
    elif used > _SEGMENTS_WARN * most:
        yield Finding("shared memory", "warning", text, remedy)
    else:
        yield Finding("shared memory", "ok", text)


def governor(cpus: Path = Path("/sys/devices/system/cpu")) -> Finding:
    """Whether the processor runs at full speed when a packet arrives.

    :param cpus: folder in which the kernel lists the processors
    """
    found = Counter(path.read_text().strip() for path in cpus.glob("cpu[0-9]*/cpufreq/scaling_governor"))
    if not found:
        return Finding("CPU governor", "note", "not told, as in a virtual machine")
    text = ", ".join(f"{name} on {count}" for name, count in found.most_common())
    if "powersave" in found:
        remedy = "sudo cpupower frequency-set -g performance"
        return Finding("CPU governor", "warning", f"{text}: packets may wait while the clock rises", remedy)
    return Finding("CPU governor", "ok", text)


def load() -> Finding:
    """Whether processors are free."""
    cores, busy = len(os.sched_getaffinity(0)), os.getloadavg()[0]
    text = f"{cores} for this process, {busy:.1f} busy in the last minute"
    if busy > cores:
        return Finding("processors", "warning", f"{text}: real time may fail", "end other programs, or use more cores")
    return Finding("processors", "ok", text)


def buffers(net: Path = Path("/proc/sys/net/core")) -> Iterator[Finding]:
    """Socket buffers, for network radios and large DDS messages.

    :param net: folder with the kernel's network settings
    """
    for name in ("rmem_max", "wmem_max"):
        value = int((net / name).read_text())
        if value >= _ENOUGH_BUFFER:
            yield Finding(name, "ok", f"{value:,} bytes")
        else:
            text = f"{value:,} bytes, {_ENOUGH_BUFFER:,} keep up with a network radio or a camera image"
            yield Finding(name, "note", text, f"sudo sysctl -w net.core.{name}={_ENOUGH_BUFFER}")


def message_ports() -> Finding:
    """GNU Radio's limit on messages that wait at a port. If a limit is set, packets beyond it are dropped."""
    name = "GR_CONF_DEFAULT_MAX_MESSAGES"
    value = os.environ.get(name, "")
    if value and value != "-1":
        return Finding("message ports", "warning", f"{name} = {value}: packets beyond are dropped", f"unset {name}")
    return Finding("message ports", "ok", "no limit, so no packet is dropped at one")
