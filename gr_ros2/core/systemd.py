"""Tells systemd how a service is (sd_notify(3)). Without systemd, nothing happens."""

from __future__ import annotations

import os
import socket
from contextlib import suppress


def notify(state: str) -> None:
    """Send one state, ``READY=1``, ``WATCHDOG=1`` or ``STATUS=…``, to the socket that the environment names."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    path = f"\0{address[1:]}" if address.startswith("@") else address
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender, suppress(OSError):  # it may be restarting
        sender.setblocking(False)
        # Names of files may be no UTF-8, and a line of its own would be another state.
        sender.sendto(" ".join(state.splitlines()).encode(errors="replace"), path)
