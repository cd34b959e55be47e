"""Every packet that leaves or arrives, as a capture that Wireshark reads.

A pcapng file of link type USER0 with two interfaces: `sent` (packets that our source composed) and `received` (packets
that the PHY passed to the sink).

Invariants: a packet is in the file as soon as its call returns. The file ends after a whole record, whatever happens to
the process or the disk. Times are wall-clock times. A run in simulated time starts at the current wall-clock time.
"""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from gr_ros2.core.clocks import wall_ahead
from gr_ros2.core.closing import Closing
from gr_ros2.core.errors import ConfigError, RunError
from gr_ros2.link.events import BoundPacket, Received, ReceiverEvent, Rejected, SenderEvent, SentPacket

if TYPE_CHECKING:
    from gr_ros2.observe.observers import LiveRun
    from gr_ros2.observe.result import RunResult

LINK_TYPE = 147
"""DLT_USER0, for private use. The dissector gives it a meaning."""

_SENT, _RECEIVED = 0, 1
_SECTION, _INTERFACE, _PACKET = 0x0A0D0D0A, 1, 6
_ORDER_MAGIC = 0x1A2B3C4D
_OPT_APPLICATION, _OPT_NAME, _OPT_TIME_RESOLUTION, _OPT_FLAGS = 4, 2, 9, 2
_INBOUND, _OUTBOUND = 1, 2
_NANOSECONDS = 9
_CLOSE_S = 1.0


class PacketCapture(Closing):
    """An open capture: a :class:`gr_ros2.observe.observers.RunObserver`, and also the observer of a link without runs.

    :param path: file to write, replaced if it exists
    :param clock: the clock of the events, s, until a run brings its own clock
    :raises ConfigError: when the file cannot be written
    """

    instruments = False

    def __init__(self, path: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self._offset = wall_ahead(clock)
        self.name = f"capture {path}"
        self.packets = 0
        """Packets in the file."""
        self._path = path
        self._lock = threading.Lock()
        self._size = 0
        self._failed: RunError | None = None
        application = _option(_OPT_APPLICATION, b"gr-ros2")
        head = [_block(_SECTION, struct.pack("<IHHq", _ORDER_MAGIC, 1, 0, -1), application)]
        for name in (b"sent", b"received"):
            options = _option(_OPT_NAME, name) + _option(_OPT_TIME_RESOLUTION, bytes([_NANOSECONDS]))
            head.append(_block(_INTERFACE, struct.pack("<HHI", LINK_TYPE, 0, 0), options))
        try:
            # Unbuffered, so that the file has all packets even if the process is killed.
            self._file = path.open("wb", buffering=0)
            self._put(b"".join(head))
        except OSError as error:
            raise ConfigError(
                f"--pcap {path}: cannot be written ({error.strerror}); name a file in a folder of yours"
            ) from error

    def run_started(self, run: LiveRun) -> None:
        """Take the run's clock."""
        self._offset = wall_ahead(run.clock)

    def run_ended(self, result: RunResult | None) -> None:
        """Do nothing: the code that opened the capture closes it."""

    def sender_event(self, src_id: int, event: SenderEvent) -> None:  # noqa: ARG002 - a LinkObserver's signature
        """Write a packet that leaves.

        :raises RunError: when this write fails, or an earlier one has failed
        """
        if isinstance(event, SentPacket | BoundPacket):
            self._write(_SENT, event.data, event.now)

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:
        """Write a packet that arrived, accepted or rejected. Errors are the same as in :meth:`sender_event`."""
        if isinstance(event, Received | Rejected | BoundPacket):
            self._write(_RECEIVED, event.data, now)

    def close(self) -> None:
        """Close the file. Idempotent. If a write hangs, such as into a pipe without a reader, the file stays open."""
        if self._lock.acquire(timeout=_CLOSE_S):
            with suppress(OSError):  # every record has been written by now
                self._file.close()
            self._lock.release()

    def _write(self, interface: int, data: bytes, now: float) -> None:
        stamp = int((now + self._offset) * 1e9)
        fixed = struct.pack("<IIIII", interface, stamp >> 32, stamp & 0xFFFFFFFF, len(data), len(data))
        direction = _OUTBOUND if interface == _SENT else _INBOUND
        record = _block(_PACKET, fixed + _padded(data), _option(_OPT_FLAGS, struct.pack("<I", direction)))
        with self._lock:
            if self._failed is not None:
                raise self._failed
            if self._file.closed:
                return
            try:
                self._put(record)
            except OSError as error:
                with suppress(OSError):  # a pipe keeps the part of a record that it took
                    self._file.truncate(self._size)
                self._failed = RunError(f"after {self.packets} packets: {error.strerror}")
                raise self._failed from error
            self.packets += 1

    def _put(self, data: bytes) -> None:
        """Write all bytes. A disk that is nearly full takes only a part of them at first."""
        left = memoryview(data)
        while left:
            left = left[self._file.write(left) :]
        self._size += len(data)


def _padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % 4)


def _option(code: int, value: bytes) -> bytes:
    return struct.pack("<HH", code, len(value)) + _padded(value)


def _block(kind: int, body: bytes, options: bytes = b"") -> bytes:
    body += options + bytes(4) if options else b""
    length = struct.pack("<I", len(body) + 12)
    return struct.pack("<I", kind) + length + body + length
