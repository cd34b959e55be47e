"""When a robot says who it is, what it says, and what it asks others for.

Hellos leave at the start, a few in the first second since any may be lost; whenever the table of topics changes; at
once to answer a robot that is heard for the first time; and otherwise every one or two seconds, about 50 bytes/s. Where
messages wait they are late: by half a second, or by two where receivers report.

Invariant: a hello never says of a message that it is kept before whoever listens had time to get it the first time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from math import inf

from gr_ros2.link.v1.neighbours import Neighbour
from gr_ros2.link.v1.settings import Settings
from gr_ros2.wire.control import CAN_HEAR, ENCRYPTS, HEARD_LEN, HELLO_LEN, MARK_LEN, Ask, Control, Heard, Hello
from gr_ros2.wire.v1 import TABLE_TOPIC

STARTING_S = (0.0, 0.1, 0.25, 0.5, 1.0)
"""When hellos leave after the start, s."""
HELLO_BYTES_S = 50.0
"""Bytes/s that hellos take, as far as that means one every ``OFTEN_S`` to ``SELDOM_S``."""
OFTEN_S, SELDOM_S = 1.0, 2.0
LATENCY_S = 0.15
"""s that a hello lets messages of class latency go first."""
ASK_S = 0.5
"""s after which a request is made again."""
LOOK_S = 0.02
"""s from one look at what is lacking to the next."""


class Talk:
    """The hellos and requests of one robot.

    :param encrypts: whether its packets are encrypted
    """

    def __init__(self, settings: Settings, boot: int, *, encrypts: bool) -> None:
        self._settings = settings
        self._boot = boot
        self._capabilities = settings.hears * CAN_HEAR | encrypts * ENCRYPTS
        self._period = min(max(OFTEN_S, settings.packet_len / HELLO_BYTES_S), SELDOM_S)
        self._starting: deque[float] = deque()
        self._answers: dict[int, int] = {}
        self._mark = 0
        self._look_at = -inf
        self.due = -inf
        """When the next hello is to leave, s."""

    def start(self, now: float) -> None:
        """The first packet may go now."""
        self._starting = deque(now + after for after in STARTING_S)
        self.due = self._starting.popleft()

    @property
    def starting(self) -> bool:
        """Whether hellos are still frequent."""
        return bool(self._starting)

    def met(self, src_id: int, boot: int, now: float) -> None:
        """A start of a robot is heard for the first time: let it know, and again, since any hello may be lost."""
        self._answers[src_id] = boot
        self._starting = deque(now + after for after in STARTING_S[1:])
        self.hurry(now)

    def hurry(self, now: float) -> None:
        """The next hello leaves at once."""
        self.due = min(self.due, now)

    def urgent(self, now: float, *, idle: bool, latency: bool, heard: bool) -> bool:
        """Whether a hello goes before messages.

        :param idle: no message waits
        :param latency: one of class latency waits
        :param heard: somebody reports, so who is new here says so, and is answered at once
        """
        late = now - self.due
        if late < 0 or idle:
            return late >= 0
        if self._starting:
            return late >= latency * LATENCY_S
        return late > (SELDOM_S if heard else OFTEN_S / 2) + latency * LATENCY_S

    def hello(self, room: int, turns: int, digest: int, marks: Sequence[tuple[int, int]], now: float) -> list[Control]:
        """The entries of a hello; the next one is due later.

        :param room: bytes free for it
        :param turns: how often the packet number has come round
        :param digest: of the table of topics
        :param marks: of the messages kept
        """
        free = room - HELLO_LEN
        answers = [Heard(*answer) for answer in list(self._answers.items())[: free // HEARD_LEN]]
        free -= len(answers) * HEARD_LEN
        if not self._starting or len(answers) < len(self._answers):
            for answer in answers:
                del self._answers[answer.src_id]
        count = min(len(marks), free // MARK_LEN)
        named = tuple([*marks, *marks][self._mark : self._mark + count])
        self._mark = (self._mark + count) % max(len(marks), 1)
        self.due = self._starting.popleft() if self._starting else now + self._period
        return [Hello(self._boot, turns, self._capabilities, digest, named), *answers]

    def asks(self, neighbours: Iterable[Neighbour], now: float) -> list[Ask]:
        """What other robots keep and this one lacks."""
        found: list[Ask] = []
        if now < self._look_at or not self._settings.hears:
            return found
        self._look_at = now + LOOK_S
        for neighbour in neighbours:
            hello, inbox, asked = neighbour.hello, neighbour.inbox, neighbour.asked
            lacking = [mark[0] for mark in hello.marks if inbox.lacks(mark, now)]
            if hello.digest and hello.digest != inbox.digest and inbox.lacks((TABLE_TOPIC, hello.digest), now):
                lacking.append(TABLE_TOPIC)
            wanted = bytes(topic for topic in dict.fromkeys(lacking) if now >= asked.get(topic, -inf))
            if wanted:
                found.append(Ask(neighbour.src_id, wanted))
                asked.update(dict.fromkeys(wanted, now + ASK_S))
        return found
