"""A connection that carries packets instead of samples, as a GNU Radio block: what `kiss`, `serial` and `udp` share.

Invariants: one thread reads and writes the connection, and nobody waits for it. A connection that ends is opened again
every second, until the block stops. Every packet that does not leave is counted by its reason; so is everything
received that is no packet.
"""

from __future__ import annotations

import logging
import selectors
import socket
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from gnuradio import gr

from gr_ros2.core.errors import RadioError
from gr_ros2.link.events import AirPacket
from gr_ros2.phy import Phy
from gr_ros2.phy.pdus import PduPort, packets_of, take_messages
from gr_ros2.phy.threads import BlockThread
from gr_ros2.radio.framing import Framing
from gr_ros2.radio.front_end import FrontEnd, FrontEndCounters

_RETRY_S = 1.0
_JOIN_S = 5.0
"""s that ``stop`` waits: longer than an attempt to connect takes."""
_WAITING = 64
"""Packets that may wait for a connection that takes no more."""
_CHUNK = 4096
_READ = selectors.EVENT_READ
_WRITE = selectors.EVENT_WRITE
_log = logging.getLogger(__name__)


class Connection(ABC):
    """An open connection whose descriptor does not block."""

    @abstractmethod
    def fileno(self) -> int:
        """The descriptor."""

    @abstractmethod
    def receive(self) -> Iterator[bytes]:
        """The packets that have arrived.

        :raises OSError: when the connection has ended
        """

    @abstractmethod
    def send(self, packet: bytes) -> None:
        """Send a packet, or keep what the connection does not take yet.

        :raises OSError: when the connection has ended
        """

    @property
    def unsent(self) -> bool:
        """Whether a part of a packet waits until the connection takes more."""
        return False

    def flush(self) -> None:  # noqa: B027 - datagrams never wait
        """Send what waits.

        :raises OSError: when the connection has ended
        """

    @abstractmethod
    def close(self) -> None:
        """Close it."""


class StreamConnection(Connection):
    """Packets in a stream of bytes.

    :param descriptor: does not block
    :param read, write: as ``os.read`` and ``os.write`` of it, without the descriptor
    :param release: closes it
    :param framing: a new one
    """

    def __init__(
        self,
        descriptor: int,
        read: Callable[[int], bytes],
        write: Callable[[bytes], int],
        release: Callable[[], object],
        framing: Framing,
    ) -> None:
        self._descriptor, self._read, self._write, self._release = descriptor, read, write, release
        self._framing = framing
        self._rest = b""

    def fileno(self) -> int:
        return self._descriptor

    def receive(self) -> Iterator[bytes]:
        try:
            data = self._read(_CHUNK)
        except BlockingIOError:
            return
        if not data:
            raise ConnectionResetError("the other side has closed it")
        yield from self._framing.feed(data)

    def send(self, packet: bytes) -> None:
        self._rest += self._framing.frame(packet)
        self.flush()

    @property
    def unsent(self) -> bool:
        return bool(self._rest)

    def flush(self) -> None:
        try:
            self._rest = self._rest[self._write(self._rest) :]
        except BlockingIOError:
            return

    def close(self) -> None:
        self._release()


class PacketPort(gr.basic_block):  # type: ignore[misc]
    """Message ports `pdus` in and out.

    :param called: name of the front end, for the log
    :param connect: opens the connection or raises RadioError; called here and after each interruption
    :param counters: counts what passes and what does not
    :param airtime: s that a packet of so many bytes takes. A packet began that long before it came here
    :raises RadioError: when the connection cannot be opened
    """

    def __init__(
        self,
        called: str,
        connect: Callable[[], Connection],
        counters: Counter[str],
        airtime: Callable[[int], float],
    ) -> None:
        super().__init__(f"gr_ros2_{called}", None, None)
        self._airtime = airtime
        self._called, self._connect, self._counters = called, connect, counters
        self._connection: Connection | None = connect()
        self._outgoing: deque[bytes] = deque()
        self._ends = socket.socketpair()
        for end in self._ends:
            end.setblocking(False)
        self._stopped = threading.Event()
        self._stopped.set()
        self._thread = BlockThread()
        self._port = PduPort(self)
        take_messages(self, "pdus", "_arrive", called="take")

    def start(self) -> bool:
        self._port.find_readers()
        self._stopped.clear()
        self._thread.start(self._run, f"gr-ros2-{self._called}")
        return True

    def stop(self) -> bool:
        self._stopped.set()
        self._wake()
        self._thread.stop(_JOIN_S)
        return True

    @property
    def alive(self) -> bool:
        """Whether its thread runs, or is not meant to."""
        return self._stopped.is_set() or self._thread.alive

    def connected(self) -> bool:
        """Whether there is a connection now."""
        return self._connection is not None

    def close(self) -> None:
        """Close the connection. The block has stopped, or never ran. Idempotent."""
        self._disconnect()
        for end in self._ends:
            end.close()

    def _arrive(self, pdu: Any) -> None:
        self.take(packets_of(pdu)[0])

    def take(self, packets: Sequence[AirPacket]) -> None:
        """Packets are to leave."""
        for packet in packets:
            if self._connection is None:
                self._counters["disconnected"] += 1
            elif len(self._outgoing) >= _WAITING:
                self._counters["not_taken"] += 1
            else:
                self._outgoing.append(packet.data)
                self._wake()

    def _wake(self) -> None:
        try:
            self._ends[1].send(b"\0")
        except (BlockingIOError, OSError):
            return  # full, so the thread will wake anyway; or closed

    def _run(self) -> None:
        while not self._stopped.is_set():
            connection = self._connection or self._again()
            if connection is None:
                self._stopped.wait(_RETRY_S)
                continue
            try:
                self._serve(connection)
            except OSError as error:
                _log.warning("front_end %s: the connection is lost (%s); trying again", self._called, error)
                self._counters["interruptions"] += 1
                self._disconnect()
                self._counters["disconnected"] += len(self._outgoing)
                self._outgoing.clear()

    def _again(self) -> Connection | None:
        try:
            self._connection = self._connect()
        except RadioError as error:
            _log.debug("front_end %s: %s", self._called, error)
            return None
        _log.info("front_end %s: connected again", self._called)
        return self._connection

    def _disconnect(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    def _serve(self, connection: Connection) -> None:
        """Read and write until the block stops.

        :raises OSError: when the connection has ended
        """
        with selectors.DefaultSelector() as selector:
            selector.register(self._ends[0], _READ)
            selector.register(connection.fileno(), _READ, connection)
            while not self._stopped.is_set():
                selector.modify(connection.fileno(), _READ | (_WRITE if connection.unsent else 0), connection)
                for key, events in selector.select():
                    if key.data is None:
                        self._ends[0].recv(_CHUNK)
                        continue
                    if events & _READ:
                        self._receive(connection)
                    if events & _WRITE:
                        connection.flush()
                while self._outgoing and not connection.unsent:
                    connection.send(self._outgoing.popleft())
                    self._counters["frames_out"] += 1

    def _receive(self, connection: Connection) -> None:
        for packet in connection.receive():
            self._counters["frames_in"] += 1
            self._port.send([AirPacket(packet, at=time.monotonic() - self._airtime(len(packet)))])


class PacketFrontEnd(FrontEnd):
    """A front end whose radio takes packets and modulates them itself; it goes with phy ``modem``.

    The subclass provides ``_connect``.
    """

    carries_packets = True
    any_length = True
    timing_error_s = 0.02

    def __init__(self, phy: Phy, **options: Any) -> None:
        super().__init__(phy, **options)
        self._counters: Counter[str] = Counter()
        self._port = PacketPort(self.name, self._connect, self._counters, self.phy.airtime)

    @abstractmethod
    def _connect(self) -> Connection:
        """Open the connection.

        :raises RadioError: when it cannot be opened
        """

    @property
    def sink(self) -> None:
        return None

    @property
    def source(self) -> None:
        return None

    @property
    def packets(self) -> Any:
        return self._port

    @property
    def ready(self) -> Callable[[], bool]:
        return self._port.connected

    def check(self, now: float) -> None:  # noqa: ARG002 - it does not depend on time
        if not self._port.alive:
            raise RadioError(f"front_end {self.name}: its thread has ended; start the link again")

    def counters(self) -> FrontEndCounters:
        """Counters of what passed and what did not.

        ``frames_out``, ``frames_in``: packets sent and received. ``not_taken``: packets for which the device had no
        room. ``disconnected``: packets while there was no connection, and ``interruptions``: how often it was lost.
        ``malformed``, ``too_long``: received frames that are no packets. ``foreign``: frames of other stations.
        """
        passed = ("frames_out", "frames_in", "foreign")
        lost = ("not_taken", "disconnected", "interruptions", "malformed", "too_long")
        return FrontEndCounters(*({name: self._counters[name] for name in names} for names in (passed, lost)))

    def close(self) -> None:
        self._port.close()
