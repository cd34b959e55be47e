"""How much of the air one sender uses, beside what is made to fit into the rest.

Invariant: nothing is counted, and nothing costs time, before somebody asks for it (``on``).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from math import ceil, inf

from gr_ros2.link.events import SentPacket
from gr_ros2.link.pace import Pace
from gr_ros2.link.v1.packing import ENTRY
from gr_ros2.wire.v1 import Part

WINDOW, WINDOW_S = 32, 2.0
"""Packets, and s at least, over which a rate is a mean."""
_FEW_S = 0.3
"""s of a window at least, and at least one packet, so that the first ones do not stand for a rate."""


class UsedAir:
    """See the module.

    :param room: bytes of the longest body
    :param turn_s: tells s from one packet to the next, 0 = not known
    :param packet_len: bytes of the longest packet, where packets are only as long as they need; 0 where all are as long
    :param share: part of the time that this robot may send
    :ivar on: whether packets are counted
    """

    def __init__(self, pace: Pace, *, room: int, turn_s: Callable[[], float], packet_len: int, share: float) -> None:
        self.on = False
        self._pace, self._room, self._turn_s = pace, room, turn_s
        self._packet_len, self._share = packet_len, share
        self._fitted: set[int] = set()
        self._window: deque[tuple[float, int, int]] = deque()
        """When a packet left, the bytes that it used, and those of them that are no repair."""
        self._sum = self._needed = 0

    def leave_out(self, topic_id: int) -> None:
        """A topic is made to fit into what others leave."""
        self.on = True
        self._fitted.add(topic_id)

    def left(self, sent: SentPacket, now: float) -> None:
        """A packet has left."""
        used = len(sent.data) if self._packet_len else self._room
        if sent.kind == "new":
            parts = [entry for entry in sent.packet.entries if isinstance(entry, Part)]
            fitted = sum(len(part.payload) + ENTRY for part in parts if part.topic_id in self._fitted)
            if self._packet_len:  # in bytes of a body: a short packet takes the air of its header, too
                used = self._room * used // self._packet_len - fitted
            else:
                used = sum(len(part.payload) + ENTRY for part in parts) - fitted
        self._count(used, 0 if sent.kind == "repair" else used, now)

    def _count(self, used: int, needed: int, now: float) -> None:
        self._window.append((now, used, needed))
        self._sum += used
        self._needed += needed
        window_s = max(WINDOW_S, WINDOW * self._turn(now))
        while self._window[0][0] < now - window_s:
            _, used, needed = self._window.popleft()
            self._sum -= used
            self._needed -= needed

    def others_left(self, packets: Sequence[SentPacket], now: float) -> None:
        """Packets of another endpoint have left over the same radio."""
        for sent in packets if self.on else ():
            used = self._room * len(sent.data) // self._packet_len if self._packet_len else self._room
            self._count(used, used, now)

    def capacity(self, now: float) -> float:
        """bytes/s that fit on the air; infinite where its rate is not known."""
        turn_s = self._turn(now)
        return self._room / turn_s if turn_s else inf

    def rate(self, now: float) -> float:
        """bytes/s that were used lately, repairs too."""
        return self._sum / self._seconds(now)

    def free(self, now: float) -> float:
        """bytes/s of further messages that fit beside what is sent, within what this robot may send; infinite where the
        air has no known rate.

        Repairs do not count, as they fill whatever is idle. Neither does an interval that was measured where the
        airtime is known: between the few packets of a link with little to send it says nothing of what would fit.
        """
        turn_s = max(self._turn_s(), self._pace.spacing) or self._pace.sure_interval(now)
        if not turn_s:
            return inf
        return max(0.0, self._share * self._room / turn_s - self._needed / self._seconds(now))

    def cost(self, size: float) -> float:
        """bytes that a message of so many bytes takes."""
        return size + ENTRY * ceil(size / self._room)

    def _seconds(self, now: float) -> float:
        """s over which packets were counted."""
        since = self._window[0][0] if self._window else now
        return max(now - since, _FEW_S, self._turn(now))

    def _turn(self, now: float) -> float:
        return max(self._turn_s(), self._pace.sure_interval(now))
