"""When a robot sends hellos, what they contain, and what it requests from others.

Hellos are sent at the start, several in the first second because any of them may be lost; whenever the table of topics
changes; at once to answer a robot that is heard for the first time; and otherwise every one or two seconds, about
50 bytes/s, or less and less often while nobody is heard. While messages wait, hellos are delayed: by half a second, or
by two seconds if receivers report.

Invariant: a hello names a kept message only after the receivers had time to get it when it was first sent.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from math import inf
from typing import TypeVar

from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.neighbours import Neighbour
from gr_ros2.wire.control import (
    CAN_HEAR,
    ENCRYPTS,
    HEARD_LEN,
    HELLO_LEN,
    MARK_LEN,
    REPORTED,
    WANTS_PROOF,
    Ask,
    Control,
    Heard,
    Hello,
)
from gr_ros2.wire.v1 import TABLE_TOPIC

_T = TypeVar("_T")

STARTING_S = (0.0, 0.1, 0.25, 0.5, 1.0)
"""Times in s after the start at which hellos are sent."""
HELLO_BYTES_S = 50.0
"""Bytes/s that hellos take, as far as the interval stays between ``OFTEN_S`` and ``SELDOM_S``."""
OFTEN_S, SELDOM_S = 1.0, 2.0
LONE_S = 10.0
"""Most s between two hellos of a robot that hears nobody: the time doubles with each hello, as in Trickle (RFC 6206). A
robot that starts is met at once, by its own hellos."""
EAGER_S, EAGER = 0.1, 20
"""s between hellos, and number of them, while another robot has not proven yet that it heard this start: until then its
messages are not delivered."""
LATENCY_S = 0.15
"""s for which a hello lets messages of class latency go first."""
ASK_LEN = 3
"""Bytes of a request for messages, without the topics."""
ASK_S = 0.5
"""s after which a request is repeated."""
LOOK_S = 0.02
"""s between two checks of what is missing."""


class Talk:
    """The hellos and requests of one robot.

    :param encrypts: whether its packets are encrypted
    """

    def __init__(self, settings: Settings, boot: int, *, encrypts: bool) -> None:
        self._settings = settings
        self._boot = boot
        self._capabilities = settings.hears * CAN_HEAR | encrypts * ENCRYPTS
        self._period = min(max(OFTEN_S, settings.packet_len / HELLO_BYTES_S), SELDOM_S)
        self._pause = self._period
        """s to the next hello."""
        self._starting: deque[float] = deque()
        self._apart: list[Control] = []
        """What did not fit into the last hello and goes into a packet of its own."""
        self._mark = self._heard = self._eager = 0
        self._answering = False
        self._look_at = -inf
        self.lacking = False
        """Whether other robots keep messages that this one lacked when it last looked."""
        self.due = -inf
        """When the next hello is due, s."""

    def start(self, now: float) -> None:
        """The first packet may be sent now."""
        self._starting = deque(now + after for after in STARTING_S)
        self.due = self._starting.popleft()

    @property
    def starting(self) -> bool:
        """Whether hellos are still frequent."""
        return bool(self._starting)

    def met(self, now: float) -> None:
        """A start of a robot is heard for the first time: send it hellos, several because any of them may be lost."""
        self._starting = deque(now + after for after in STARTING_S[1:])
        self._eager = EAGER
        self.answer(now)

    def answer(self, now: float) -> None:
        """Send the next hello at once, before messages."""
        self._answering = True
        self.hurry(now)

    def hurry(self, now: float) -> None:
        """Send the next hello at once."""
        self.due = min(self.due, now)

    def urgent(self, now: float, *, idle: bool, latency: bool, heard: bool) -> bool:
        """Whether a hello goes before messages.

        :param idle: no message waits
        :param latency: a message of class latency waits
        :param heard: some robot reports, so a new robot announces itself and is answered at once
        """
        late = now - self.due
        if late < 0 or idle or self._answering:
            return late >= 0
        if self._starting:
            return late >= latency * LATENCY_S
        return late > (SELDOM_S if heard else OFTEN_S / 2) + latency * LATENCY_S

    def hello(
        self,
        room: int,
        turns: int,
        digest: int,
        marks: Sequence[tuple[int, int]],
        *,
        heard: Sequence[Heard],
        wants: bool,
        reported: bool,
        lone: bool,
        now: float,
    ) -> list[Control]:
        """The entries of a hello; also sets the time of the next one.

        Where ``heard`` does not fit beside a hello, it goes into the next packet, alone.

        :param room: bytes free for it
        :param turns: how often the packet number has wrapped around
        :param digest: CRC-32 of the table of topics
        :param marks: marks of the kept messages
        :param heard: what proves to the other robots that they were heard
        :param wants: whether such a proof of another robot is missing here
        :param reported: whether robots report to this one
        :param lone: whether nobody is heard, though somebody could be
        """
        self._answering = False
        if self._apart:
            apart, self._apart = self._apart, []
            self.due = self._next(now, wants=wants)
            return apart
        free = room - HELLO_LEN
        self._pause = min(2 * self._pause, LONE_S) if lone and not self._starting else self._period
        proofs, self._heard = _in_turn(heard, self._heard, max(free // HEARD_LEN - bool(marks), 1))
        if free < HEARD_LEN:
            self._apart, proofs = [*proofs], []
        free -= len(proofs) * HEARD_LEN
        named, self._mark = _in_turn(marks, self._mark, free // MARK_LEN)
        self.due = now if self._apart else self._next(now, wants=wants)
        capabilities = self._capabilities | reported * REPORTED | wants * WANTS_PROOF
        return [Hello(self._boot, turns, capabilities, digest, tuple(named)), *proofs]

    def _next(self, now: float, *, wants: bool) -> float:
        """When the next hello is due, s."""
        due = self._starting.popleft() if self._starting else now + self._pause
        if not wants or not self._eager:
            return due
        self._eager -= 1
        return min(due, now + EAGER_S)

    def asks(self, neighbours: Iterable[Neighbour], now: float, room: int) -> list[Ask]:
        """Requests for messages that other robots keep and this one lacks, as many as ``room`` bytes hold."""
        found: list[Ask] = []
        if now < self._look_at or not self._settings.hears:
            return found
        self._look_at = now + LOOK_S
        self.lacking = False
        for neighbour in neighbours:
            hello, inbox, asked = neighbour.hello, neighbour.inbox, neighbour.asked
            lacking = [mark[0] for mark in hello.marks if inbox.lacks(mark, now)]
            if hello.digest and hello.digest != inbox.digest and inbox.lacks((TABLE_TOPIC, hello.digest), now):
                lacking.append(TABLE_TOPIC)
            self.lacking = self.lacking or bool(lacking)
            wanted = bytes(topic for topic in dict.fromkeys(lacking) if now >= asked.get(topic, -inf))
            if wanted and room >= ASK_LEN + len(wanted):
                room -= ASK_LEN + len(wanted)
                found.append(Ask(neighbour.src_id, wanted))
                asked.update(dict.fromkeys(wanted, now + ASK_S))
        return found


def _in_turn(items: Sequence[_T], turn: int, most: int) -> tuple[list[_T], int]:
    """So many of the items from a place on, and the place after them."""
    count = min(len(items), most)
    return [*items, *items][turn : turn + count], (turn + count) % max(len(items), 1)
