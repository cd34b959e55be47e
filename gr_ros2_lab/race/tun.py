"""A TUN device: an IP interface of a network namespace. This process carries the packets of the interface.

Invariants: packets that the radio cannot take yet wait in a queue that is bounded in bytes, as with a real interface,
so senders notice when the link is full: in the kernel in front of the device where the device has an air of its own
(:func:`own_air`), or where the packets are read (:mod:`gr_ros2_lab.race.channel`). Packets that the queue drops are
counted. The device is removed when it is closed.
"""

from __future__ import annotations

import fcntl
import json
import os
import select
import struct
import subprocess
from collections.abc import Sequence
from pathlib import Path

from gr_ros2.core.errors import RunError
from gr_ros2_lab.race.namespaces import inside

INTERFACE = "air0"
QUEUE_BYTES = 4000
"""Most bytes that wait in front of the device. The queue is short, like a short ``txqueuelen``, because a longer queue
only makes messages older."""

_RING_PACKETS = 8
_SHARED_RING_PACKETS = 1000
"""Packets in a device that shares a channel: its queue is bounded where the packets are read."""
_TUNSETIFF = 0x400454CA
_TUN_WITHOUT_HEADER = 0x1001
_FRAGMENTS_KEPT_S = 3


def own_air(
    address: str, peer: str, *, mtu: int, byte_rate: float, overhead: float, queue_bytes: int
) -> tuple[str, ...]:
    """Commands that set up a point-to-point interface with a queue in the kernel.

    :param address, peer: IPv4 addresses of this end and the other
    :param mtu: bytes of the largest IP packet
    :param byte_rate: bytes/s that the link carries
    :param queue_bytes: most bytes that wait in the queue
    :param overhead: airtime that the radio adds to each packet, as a number of bytes
    """
    return (
        f"ip link set {INTERFACE} mtu {mtu} txqueuelen {_RING_PACKETS} up",
        f"ip addr add {address} peer {peer} dev {INTERFACE}",
        f"tc qdisc replace dev {INTERFACE} root tbf rate {8 * byte_rate:.0f}bit burst {mtu + round(overhead)} "
        f"limit {queue_bytes} overhead {round(overhead)} linklayer ethernet",
    )


def shared_air(address: str, *, mtu: int) -> tuple[str, ...]:
    """Commands that set up an interface in a network of /24 in which everybody hears multicast.

    :param address: IPv4 address
    :param mtu: bytes of the largest IP packet
    """
    return (
        f"ip link set {INTERFACE} mtu {mtu} txqueuelen {_SHARED_RING_PACKETS} multicast on up",
        f"ip addr add {address}/24 dev {INTERFACE}",
        f"ip route add 224.0.0.0/4 dev {INTERFACE}",
    )


class Tun:
    """An IP interface.

    :param namespace: path of the network namespace that contains the interface
    :param setup: commands that set it up
    :raises RunError: when the interface cannot be created
    """

    def __init__(self, namespace: str, setup: Sequence[str]) -> None:
        self._namespace = namespace
        self._file = inside(namespace, _open)
        try:
            for command in ("ip link set lo up", *setup):
                inside(namespace, lambda command=command: _run(command))  # type: ignore[misc]
        except BaseException:
            self.close()
            raise

    def fileno(self) -> int:
        """The file to wait for, readable when there is a packet."""
        return self._file

    def read(self, timeout_s: float) -> bytes | None:
        """The next IP packet to send; None if there is none within ``timeout_s``."""
        if not select.select([self._file], [], [], timeout_s)[0]:
            return None
        return os.read(self._file, 1 << 16)

    def write(self, packet: bytes) -> None:
        """Give the kernel an IP packet that has arrived.

        :raises OSError: when the kernel refuses it
        """
        os.write(self._file, packet)

    def dropped(self) -> int:
        """Number of packets that the queue in front of the device has dropped because it was full."""
        text = inside(self._namespace, lambda: _run(f"tc -s -j qdisc show dev {INTERFACE}"))
        return int(json.loads(text)[0]["drops"])

    def close(self) -> None:
        """Remove the interface. Idempotent."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


def loopback_up(namespace: str) -> None:
    """Switch on the loopback interface of a namespace.

    :raises RunError: when that fails
    """
    inside(namespace, lambda: _run("ip link set lo up"))


def _open() -> int:
    settings = Path("/proc/sys/net")
    if (settings / "ipv6").exists():  # IPv6 would search for neighbours and routers over the radio
        (settings / "ipv6/conf/all/disable_ipv6").write_text("1")
    (settings / "ipv4/ipfrag_time").write_text(str(_FRAGMENTS_KEPT_S))
    file = os.open("/dev/net/tun", os.O_RDWR | os.O_CLOEXEC | os.O_NONBLOCK)
    try:
        fcntl.ioctl(file, _TUNSETIFF, struct.pack("16sH22x", INTERFACE.encode(), _TUN_WITHOUT_HEADER))
    except OSError as error:
        os.close(file)
        raise RunError(f"TUN device {INTERFACE}: cannot be made ({error.strerror}); it needs root") from error
    return file


def _run(command: str) -> str:
    done = subprocess.run(command.split(), capture_output=True, text=True, check=False)
    if done.returncode:
        raise RunError(f"{command}: {' '.join(done.stderr.split())}")
    return done.stdout
