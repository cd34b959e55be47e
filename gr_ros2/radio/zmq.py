"""The `zmq` front end: bursts of samples over ZeroMQ, between processes or machines without radios.

Every robot publishes at one address and subscribes to the addresses of the others. Each packet is one message: a
header, then its samples. Instead of the others there may be a medium process (`gr-ros2 medium`), which sends
what all of them together make of the air at this robot. In lock step it also sends the time, as messages without
samples, which the robot sends back when it has sent all that begins before.

Invariants: only bursts are sent, so silence costs nothing. A burst is sent completely or not at all. Nobody waits for a
peer. What is sent while a peer is away, or while the cable is unplugged, is lost as on the air. Either end may be
killed and started again, and the other end continues. A thread keeps libzmq's receive queue empty; the bounded queue
behind it drops what the flowgraph does not take in time. The header of a message is checked before anything else in it
is used. A sample that is not a finite number never reaches a receiver, because the filters and loops of a receiver
would not recover from it.
"""

from __future__ import annotations

import logging
import os
import queue
import struct
import threading
import time
import weakref
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cached_property
from math import isfinite, nan
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import pmt
import zmq
from gnuradio import gr
from numpy.typing import NDArray
from pydantic import AfterValidator, Field
from pydantic.dataclasses import dataclass

from gr_ros2.core.errors import RadioError
from gr_ros2.phy import Phy
from gr_ros2.phy.base import BurstCarrier
from gr_ros2.phy.stream_times import BURST_TIME
from gr_ros2.phy.threads import KeepsThreadState
from gr_ros2.radio.bursts import BurstCutter
from gr_ros2.radio.front_end import AGAIN_MS, FrontEnd, FrontEndCounters, FrontEndOptions
from gr_ros2.settings.config import STRICT

HEADER = struct.Struct("<4sIQdd")
"""Magic, number of the sender (random at each start), number of the burst, samples/s, and the time in s of the first
sample on the clock of the medium process, NaN without one. The samples follow as complex64, little-endian."""
MAGIC = b"GRI1"

SAMPLE = np.dtype("<c8")
WAITING = 300
"""Bursts that may wait for a slow peer, and for this computer when received; beyond, new ones are dropped."""
_HEARTBEAT_MS, _DEAD_MS = 250, 1000
"""Interval and limit of heartbeats. The connection to a peer that is silent up to the limit is closed, with all bursts
that wait for it. Then a new connection is tried."""
_RECONNECT_MS, _RECONNECT_MAX_MS = 50, 500
_READABLE = int(zmq.POLLIN)  # as a number: to combine flags takes longer than to ask for them
_WAIT_S = 0.1
_LOOK_S = 2e-4
"""s between two looks whether all has been sent that begins before the time of the medium process."""
_MOST_STEP_S = 1.0
"""s by which one word of a medium process moves the clock at most."""
_ANSWER_S = 0.5
"""s after which a time is not answered; the medium process sends it again."""
_LOCKED_S = 0.001
"""``timing_error_s`` in lock step, where the medium process tells when a burst began and begins it when asked."""
MAX_SENDERS = 256
"""Largest number of senders whose burst numbers are followed. Beyond it, the one heard longest ago is forgotten."""
MOST_SAMPLES = 1 << 20
"""Samples of the longest burst that is accepted, whatever another end has set."""
_MAX_PORT = 65535
_Arrived = tuple[NDArray[np.complex64], float | None]
"""Samples of a burst, and when it began on the link's clock, as far as a medium process tells it."""
_log = logging.getLogger(__name__)


def _with_port(address: str) -> str:
    # ZeroMQ accepts a wrong port and uses its last 16 bits, or the part that is a number. No peer calls that port.
    _, colon, port = address.removeprefix("tcp://").rpartition(":")
    numbered = address.startswith("tcp://") and colon and port != "*"
    if numbered and not (port.isdecimal() and 1 <= int(port) <= _MAX_PORT):
        raise ValueError(f"port {port}: must be 1 to {_MAX_PORT}")
    return address


def _with_transport(address: str) -> str:
    return address if "://" in address else f"tcp://{address}"


def _any_interface(address: str) -> str:
    return f"*:{address.removeprefix(':')}" if address.removeprefix(":").isdecimal() else address


Address = Annotated[str, Field(min_length=1), AfterValidator(_with_transport), AfterValidator(_with_port)]
"""An address as ZeroMQ writes it. Without a transport it is a TCP address."""
OwnAddress = Annotated[
    str,
    Field(min_length=1),
    AfterValidator(_any_interface),
    AfterValidator(_with_transport),
    AfterValidator(_with_port),
]
"""The same, but a port alone means all interfaces."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ZmqOptions(FrontEndOptions):
    """Settings of this front end."""

    bind: Annotated[OwnAddress, Field(title="Own address")]
    """address to publish at: `5555` (all interfaces), `10.0.0.1:5555`, `ipc:///tmp/a`"""
    connect: Annotated[tuple[Address, ...], Field(min_length=1, title="Addresses of other robots")]
    """addresses of the other robots, ``10.0.0.2:5555``"""
    medium_process: Annotated[Literal["none", "lockstep", "real"], Field(title="Medium process")] = "none"
    """what ``connect`` names: none = other robots; lockstep or real = ``gr-ros2 medium`` with this ``time``"""


class MediumClock:
    """The clock of a link in lock step: it goes as a medium process says, and stands still without one.

    Invariants: it never goes back, also when the medium process is started again; all links of this process that use
    one medium process have one clock.

    :param machine: s, monotonic
    """

    _OFFSETS: ClassVar[dict[int, float]] = {}
    """s of this machine's clock at the start of each medium process, by its number."""

    def __init__(self, machine: Callable[[], float] = time.monotonic) -> None:
        self._machine = machine
        self._now = machine()
        self._medium = -1
        self._offset = nan

    def __call__(self) -> float:
        return self._now

    def tick(self, medium: int, at: float) -> None:
        """It is ``at`` on the clock of a medium process, which has drawn this number at its start."""
        if medium != self._medium:
            self._medium, self._offset = medium, self._OFFSETS.setdefault(medium, self._machine() - at)
        self._now = min(max(self._now, at + self._offset), self._now + _MOST_STEP_S)

    def there(self, at: float) -> float:
        """A time of this clock on that of the medium process; NaN before its first word."""
        return at - self._offset

    def here(self, at: float) -> float:
        """A time of the medium process on this clock."""
        return at + self._offset


class ZmqFrontEnd(FrontEnd):
    """Bursts published to other processes, and those of others."""

    name = "zmq"
    hears_always = False
    Options = ZmqOptions
    timing_error_s = 0.005
    any_length = True

    def __init__(self, phy: Phy, **options: Any) -> None:
        super().__init__(phy, **options)
        self._context, self._sockets = zmq.Context(), list[Any]()
        # Close the sockets first: a context that is garbage-collected together with them waits for them without end.
        self._let_go = weakref.finalize(self, _let_go, self._context, self._sockets)
        self._counters: Counter[str] = Counter()
        self._passed: Callable[[], int | None] = lambda: None
        self._medium_clock = MediumClock() if self.options.medium_process == "lockstep" else None
        self._out: _Departures | None = None
        if self._medium_clock is not None:
            self.timing_error_s = _LOCKED_S
        try:
            if self.transmits or self._medium_clock is not None:  # in lock step, who only listens answers too
                publisher = self._socket(zmq.PUB)
                open_socket(publisher.bind, "bind", self.options.bind)
                self._out = _Departures(publisher, phy, self._counters, self._medium_clock)
            subscriber = self._socket(zmq.SUB)
            subscriber.subscribe(b"")
            for address in self.options.connect:
                open_socket(subscriber.connect, "connect", address)
        except RadioError:
            self._let_go()
            raise
        self._sockets.remove(subscriber)  # its thread closes it
        told = None if self._medium_clock is None else self._told
        self.arrivals = _Arrivals(subscriber, phy, WAITING, self._counters, clock=self._medium_clock, told=told)

    @cached_property
    def sink(self) -> Any:
        return None if self._out is None else _BurstPublisher(self._out, self.phy)

    @cached_property
    def source(self) -> Any:
        return _BurstSubscriber(self.arrivals)

    @property
    def bursts(self) -> BurstCarrier:
        return self

    def send(self, samples: NDArray[np.complex64], at: float | None) -> None:
        """Send a burst to all who listen."""
        if self._out is not None:
            self._out.send(samples, at)

    def listen(self, take: Callable[[NDArray[np.complex64], float | None], None] | None) -> None:
        """Call a function with each burst that comes."""
        self.arrivals.listen(take)

    def ahead(self) -> float | None:
        return None if self.options.medium_process == "none" else 0.0

    @property
    def clock(self) -> Callable[[], float]:
        return time.monotonic if self._medium_clock is None else self._medium_clock

    def follow(self, passed: Callable[[], int | None]) -> None:
        self._passed = passed

    def _told(self, medium: int, at: float) -> None:
        """The medium process has told the time: answer when all has been sent that begins before, and the receiver has
        what came."""
        assert self._medium_clock is not None
        assert self._out is not None
        self._medium_clock.tick(medium, at)
        limit = time.monotonic() + _ANSWER_S
        while self._passed() != self._counters["bursts_out"] or self.arrivals.behind:
            if time.monotonic() > limit or self._out.closed:
                return
            time.sleep(_LOOK_S)
        self._out.answer(at)

    def counters(self) -> FrontEndCounters:
        """Counters of what passed and what did not.

        ``bursts_out``, ``bursts_in``: bursts sent and received. ``missed``: gaps in the numbers of a sender.
        ``restarts``: senders beyond one for each address. ``malformed`` and ``wrong_rate``: refused messages.
        ``overflows``: bursts that arrived while ``WAITING`` bursts waited for the flowgraph, and were dropped.
        """
        lost = {name: self._counters[name] for name in ("missed", "malformed", "wrong_rate", "overflows")}
        lost["restarts"] = max(0, self._counters["senders"] - len(self.options.connect))
        return FrontEndCounters({name: self._counters[name] for name in ("bursts_out", "bursts_in")}, lost)

    def close(self) -> None:
        if self._out is not None:
            self._out.close()
        self._let_go()

    def _socket(self, kind: int) -> Any:
        socket = self._context.socket(kind)
        self._sockets.append(socket)
        addresses = (self.options.bind, *self.options.connect)
        prepare(socket, WAITING, self.phy.airtime_samples(), addresses)
        return socket


def prepare(socket: Any, most: int, samples: int, addresses: Iterable[str]) -> None:
    """Set up a socket for bursts.

    :param most: bursts that may wait to be sent
    :param samples: of the longest burst here
    :param addresses: to which it will be bound or connected
    """
    socket.linger = 0
    socket.sndhwm = most
    # libzmq aborts the process if a receive queue with a limit is full while the heartbeats replace the connection
    # (libzmq issues 3937 and 4767). So it has no limit, and _Arrivals keeps it empty.
    socket.rcvhwm = 0
    socket.setsockopt(zmq.HEARTBEAT_IVL, _HEARTBEAT_MS)
    socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, _DEAD_MS)
    socket.setsockopt(zmq.HEARTBEAT_TTL, _DEAD_MS)
    socket.setsockopt(zmq.CONNECT_TIMEOUT, _DEAD_MS)
    socket.setsockopt(zmq.RECONNECT_IVL, _RECONNECT_MS)
    socket.setsockopt(zmq.RECONNECT_IVL_MAX, _RECONNECT_MAX_MS)
    socket.setsockopt(zmq.IPV6, any("[" in address for address in addresses))
    # One burst is one message. ZeroMQ closes the connection of a larger one and says nothing, so bursts of an end with
    # another packet_len or other options have to pass: the receiver counts them as damaged.
    most_samples = max(2 * samples, MOST_SAMPLES)
    socket.setsockopt(zmq.MAXMSGSIZE, HEADER.size + most_samples * SAMPLE.itemsize)


def _let_go(context: Any, sockets: list[Any]) -> None:
    for socket in sockets:
        socket.close(linger=0)
    context.term()


def open_socket(action: Callable[[str], object], key: str, address: str, whom: str = "front_end zmq") -> None:
    """Bind or connect a socket.

    :raises RadioError: when the address cannot be used
    """
    try:
        action(address)
    except zmq.ZMQError as error:
        whose = "an address of this machine and a free port" if key == "bind" else "another robot's address"
        raise RadioError(
            f"{whom}: {key} = {address!r}: {error.strerror}; write {whose}, as tcp://HOST:PORT or ipc:///PATH"
        ) from error


class _Departures:
    """Sends each burst as one message."""

    def __init__(self, socket: Any, phy: Phy, counters: Counter[str], clock: MediumClock | None) -> None:
        self._socket = socket
        self._sample_rate = phy.sample_rate
        self._sender = int.from_bytes(os.urandom(4), "little")
        self._counters = counters
        self._medium_clock = clock
        self._sending = threading.Lock()  # the link and arrivals send

    def send(self, samples: NDArray[np.complex64], at: float | None) -> None:
        """Send a burst, which begins at a time of the link's clock, as far as that is known."""
        there = nan if at is None or self._medium_clock is None else self._medium_clock.there(at)
        self._send(there, samples.astype(SAMPLE, copy=False).data)
        self._counters["bursts_out"] += 1

    def answer(self, at: float) -> None:
        """Tell the medium process that all has been sent that begins before ``at``."""
        self._send(at, b"")

    def _send(self, at: float, samples: bytes | memoryview) -> None:
        header = HEADER.pack(MAGIC, self._sender, self._counters["bursts_out"], self._sample_rate, at)
        with self._sending:
            if not self._socket.closed:  # by close(), while arrivals were about to answer
                self._socket.send(b"".join((header, samples)), zmq.NOBLOCK)

    @property
    def closed(self) -> bool:
        """Whether nothing is sent any more."""
        return bool(self._socket.closed)

    def close(self) -> None:
        """Send nothing from now on. Idempotent."""
        with self._sending:
            self._socket.close(linger=0)


class _Arrivals:
    """Received bursts, which a function takes at once, or a flowgraph when it is ready for them.

    Invariants: one thread empties the socket, checks and counts each message, and waits for nobody but the function,
    before each call of which it empties the socket; at most ``most`` bursts wait, in the order of their arrival, each
    no longer than twice the longest packet here; the thread ends, and closes the socket, with the context.
    """

    def __init__(
        self,
        socket: Any,
        phy: Phy,
        most: int,
        counters: Counter[str],
        *,
        clock: MediumClock | None = None,
        told: Callable[[int, float], None] | None = None,
    ) -> None:
        self._socket = socket
        self._sample_rate = phy.sample_rate
        self._longest = 2 * phy.airtime_samples()
        self._most = most
        self._senders: dict[int, int] = {}
        self._counters = counters
        self._clock, self._told = clock, told
        self._waiting: queue.SimpleQueue[_Arrived] = queue.SimpleQueue()
        self._listener: Callable[[NDArray[np.complex64], float | None], None] | None = None
        self._listening = threading.Lock()
        self.unread = 0
        """Samples of the newest burst that a flowgraph has not taken yet."""
        threading.Thread(target=self._run, name="zmq-arrivals", daemon=True).start()

    def take(self, timeout_s: float) -> _Arrived | None:
        """Samples of the oldest burst that waits and when it began, or None if none has come in time."""
        try:
            return self._waiting.get(timeout=timeout_s)
        except queue.Empty:
            return None

    def listen(self, listener: Callable[[NDArray[np.complex64], float | None], None] | None) -> None:
        """Hand over each burst from now on, those that wait too; None: let them wait. Returns when no call goes on."""
        with self._listening:
            self._listener = listener
        while self._hand_over():
            pass

    @property
    def behind(self) -> bool:
        """Whether not all that has arrived has been taken."""
        return bool(self.unread) or not self._waiting.empty()

    def _hand_over(self) -> bool:
        """Hand the oldest burst over; returns whether there may be another."""
        with self._listening:
            if self._listener is None or self._waiting.empty():
                return False
            self._listener(*self._waiting.get())
        return True

    def _run(self) -> None:
        socket = self._socket
        with socket, suppress(zmq.ContextTerminated):
            while True:
                if self.behind and self._listener and not socket.get(zmq.EVENTS) & _READABLE:
                    self._hand_over()
                else:
                    self.arrived(socket.recv())

    def arrived(self, message: bytes) -> None:
        """Keep the samples of a message, unless it is refused or the queue is full."""
        burst = self._burst(message)
        if burst is None:
            return
        # Only this thread adds to the queue, so there is room for what it has seen room for.
        if self._waiting.qsize() >= self._most:
            self._count("overflows", f"{self._most} bursts wait, this computer is too slow; new ones are dropped")
            return
        self._counters["bursts_in"] += 1
        self._waiting.put(burst)

    def _burst(self, message: bytes) -> _Arrived | None:
        size = len(message) - HEADER.size
        if size < 0 or size % SAMPLE.itemsize or message[: len(MAGIC)] != MAGIC:
            self._count("malformed", f"a message of {len(message)} bytes is no burst of samples")
            return None
        _, sender, number, sample_rate, at = HEADER.unpack_from(message)
        if sample_rate != self._sample_rate:
            self._count(
                "wrong_rate",
                f"a peer sends {sample_rate:g} samples/s, not {self._sample_rate:g}; set the same phy at both ends",
            )
            return None
        if not size and self._told is not None:
            if isfinite(at):
                while self._hand_over():  # what has come before
                    pass
                self._told(sender, at)
            else:
                self._count("malformed", "a time that is no finite number")
            return None
        samples = np.frombuffer(message, SAMPLE, offset=HEADER.size).astype(np.complex64, copy=False)
        if not np.isfinite(samples).all():
            self._count("malformed", "a burst has samples that are no finite numbers")
            return None
        self._follow(sender, number)
        samples = samples if len(samples) <= self._longest else samples[: self._longest].copy()
        return samples, self._clock.here(at) if self._clock is not None and isfinite(at) else None

    def _follow(self, sender: int, number: int) -> None:
        before = self._senders.pop(sender, None)
        if before is None:
            if len(self._senders) == MAX_SENDERS:
                # A sender moves to the end when it is heard, so the first one is the oldest.
                del self._senders[next(iter(self._senders))]
            self._counters["senders"] += 1
        else:
            self._counters["missed"] += max(0, number - before - 1)
        self._senders[sender] = number

    def _count(self, name: str, problem: str) -> None:
        self._counters[name] += 1
        if self._counters[name] == 1:
            _log.warning("front_end zmq: %s", problem)


class _BurstPublisher(KeepsThreadState, gr.sync_block):  # type: ignore[misc]
    """Sends the bursts of a stream."""

    def __init__(self, departures: _Departures, phy: Phy) -> None:
        super().__init__("gr_ros2_zmq_publisher", [np.complex64], None)
        self._departures = departures
        self._cutter = BurstCutter(phy.airtime_samples(), phy.any_length)

    def work(self, input_items: list[NDArray[np.complex64]], output_items: list[Any]) -> int:  # noqa: ARG002
        bursts, taken = self._cutter.cut(self, input_items[0])
        for burst in bursts:
            self._departures.send(burst.samples, burst.at)
        return taken


class _BurstSubscriber(KeepsThreadState, gr.sync_block):  # type: ignore[misc]
    """Gives the samples of the bursts that have arrived as a stream."""

    def __init__(self, arrivals: _Arrivals) -> None:
        super().__init__("gr_ros2_zmq_subscriber", None, [np.complex64])
        self._arrivals = arrivals
        self._rest: NDArray[np.complex64] = np.empty(0, np.complex64)
        self.set_blkd_input_timer_value(AGAIN_MS)

    def work(self, input_items: list[Any], output_items: list[NDArray[np.complex64]]) -> int:  # noqa: ARG002
        if not len(self._rest):
            # Wait for a limited time: GNU Radio can end this thread only between two calls.
            burst = self._arrivals.take(_WAIT_S)
            if burst is None:
                return 0
            self._rest, at = burst
            if at is not None:
                self.add_item_tag(0, self.nitems_written(0), BURST_TIME, pmt.from_double(at))
        count = min(len(self._rest), len(output_items[0]))
        output_items[0][:count] = self._rest[:count]
        self._rest = self._rest[count:]
        self._arrivals.unread = len(self._rest)
        return count
