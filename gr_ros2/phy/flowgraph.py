"""Flowgraphs and hier blocks that start and stop cleanly.

Invariants: a block lives as long as it is connected; after a flowgraph's ``stop`` none of its threads runs, whatever
its state was; after a hier block's ``release`` only its creator still refers to it, its blocks or their buffers.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any, TypeVar

from gnuradio import gr

from gr_ros2.core.errors import PhyError
from gr_ros2.core.preferences import check_preferences
from gr_ros2.phy.base import SymbolSource
from gr_ros2.phy.threads import start_flowgraph

_Self = TypeVar("_Self", bound="Flowgraph")


class _Holds:
    """Keeps connected blocks alive.

    GNU Radio's threads call the methods of a block that is written in Python, but do not keep its Python object alive.
    Once it has a message handler, it is part of a reference cycle. Python's garbage collector then ends it at any time,
    and GNU Radio calls what is not there any more: the process crashes.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._held: list[Any] = []
        """Blocks whose streams are connected."""
        self._messages: list[tuple[Any, ...]] = []
        """The ends of message connections."""

    def connect(self, *points: Any) -> None:
        """Connect streams, with the arguments of GNU Radio's method."""
        super().connect(*points)  # type: ignore[misc]
        blocks = (point[0] if isinstance(point, tuple) else point for point in points)
        self._held += [block for block in blocks if block is not self]

    def msg_connect(self, *ends: Any) -> None:
        """Connect two message ports, with the arguments of GNU Radio's method."""
        super().msg_connect(*ends)  # type: ignore[misc]
        self._messages.append(ends)

    def disconnect_all(self) -> None:
        """Forget the stream connections, as GNU Radio's method does, and let go of their blocks."""
        self._impl.disconnect_all()  # type: ignore[attr-defined]
        self._held.clear()

    def disconnect_messages(self) -> None:
        """Forget the message connections. The flowgraph does not run."""
        while self._messages:
            # GNU Radio disconnects a hier block's own port, but then raises, because nothing has subscribed to it.
            with suppress(RuntimeError):
                self.msg_disconnect(*self._messages.pop())  # type: ignore[attr-defined]


class Flowgraph(_Holds, gr.top_block):  # type: ignore[misc]
    """Blocks that start and stop together, for instance in a ``with`` statement.

    :param name: name in GNU Radio's log
    :param called: name in errors
    :raises PhyError: when GNU Radio cannot write its preferences
    """

    def __init__(self, name: str, called: str) -> None:
        check_preferences()
        super().__init__(name, catch_exceptions=True)
        self._called = called
        self._running = False

    def start(self, max_noutput_items: int = 10_000_000) -> None:
        """Start every block's thread.

        :raises PhyError: when GNU Radio refuses the flowgraph
        """
        self._running = True
        try:
            start_flowgraph(partial(super().start, max_noutput_items))
        except PhyError as error:
            self.stop()
            raise PhyError(f"{self._called}: {error}") from error
        except BaseException:  # Ctrl-C: the caller cannot stop a flowgraph that has not started completely
            self.stop()
            raise

    def stop(self) -> None:
        """Stop and wait for every thread; does nothing if it is not running."""
        if self._running:
            self._running = False
            super().stop()
            self.wait()

    def __enter__(self: _Self) -> _Self:
        self.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()


class HierBlock(_Holds, gr.hier_block2):  # type: ignore[misc]
    """A hier block with message ports.

    GNU Radio's ``disconnect_all`` forgets stream connections only. The message connections would keep it alive, and
    with it shared memory, of which a system has 4096 segments: an OFDM receiver of stock blocks takes 60.
    """

    def release(self) -> None:
        self.disconnect_messages()
        self.disconnect_all()


class TransmitterBlock(HierBlock):
    """Message port `pdus` in, complex stream out.

    :param name: name in GNU Radio's log
    :param airtime_samples: samples of a packet, gap included, if every packet has the same number
    """

    def __init__(self, name: str, airtime_samples: int = 0) -> None:
        super().__init__(name, gr.io_signature(0, 0, 0), gr.io_signature(1, 1, gr.sizeof_gr_complex))
        self.message_port_register_hier_in("pdus")
        self._airtime_samples = airtime_samples
        self._last: Any = None

    @property
    def refused(self) -> int:
        """PDUs that were not a packet of the right length; 0 if GNU Radio's own blocks receive them, since these do not
        report it."""
        return 0

    def leave_by(self, block: Any) -> None:
        """Connect the output to a block inside."""
        self._last = block
        self.connect(block, self)

    def packets_sent(self) -> int:
        """Packets that have left as samples; 0 before the flowgraph runs."""
        try:
            return int(self._last.nitems_written(0)) // self._airtime_samples
        except RuntimeError:  # GNU Radio's counters exist only while the block is part of a running flowgraph
            return 0


class ReceiverBlock(HierBlock):
    """Complex stream in, message ports `pdus` and `points` out. Values that a receiver does not measure are 0 or None.

    `points` gives the constellation points of the newest packets, for a constellation sink, where a PHY has any.

    :param name: name in GNU Radio's log
    """

    def __init__(self, name: str) -> None:
        super().__init__(name, gr.io_signature(1, 1, gr.sizeof_gr_complex), gr.io_signature(0, 0, 0))
        for port in ("pdus", "points"):
            self.message_port_register_hier_out(port)

    @property
    def damaged(self) -> int:
        """Packets received with errors."""
        return 0

    @property
    def foreign(self) -> int:
        """Whole frames of other networks or of other uses, dropped."""
        return 0

    @property
    def snr_db(self) -> float | None:
        """SNR over the sampled band of the newest packets, dB; None before the first."""
        return None

    def follow_clock(self, offset: Callable[[], float]) -> None:
        """Do nothing: these blocks tell no times of bursts."""

    def tap_symbols(self) -> SymbolSource | None:
        """Make the received constellation points visible."""
        return None
