"""When a robot sends hellos, what they contain, and what it requests from others.

Hellos are sent at the start, several in the first second because any of them may be lost; whenever the table of topics
changes; at once to answer a robot that is heard for the first time; and otherwise every one or two seconds, about
50 bytes/s. While messages wait, hellos are delayed: by half a second, or by two seconds if receivers report.

Invariant: a hello names a kept message only after the receivers had time to get it when it was first sent.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from math import inf

from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.neighbours import Neighbour
from gr_ros2.wire.control import CAN_HEAR, ENCRYPTS, HEARD_LEN, HELLO_LEN, MARK_LEN, Ask, Control, Heard, Hello
from gr_ros2.wire.v1 import TABLE_TOPIC

STARTING_S = (0.0, 0.1, 0.25, 0.5, 1.0)
"""Times in s after the start at which hellos are sent."""
HELLO_BYTES_S = 50.0
"""Bytes/s that hellos take, as far as the interval stays between ``OFTEN_S`` and ``SELDOM_S``."""
OFTEN_S, SELDOM_S = 1.0, 2.0
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
        self._starting: deque[float] = deque()
        self._answers: dict[int, int] = {}
        self._mark = 0
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

    def met(self, src_id: int, boot: int, now: float) -> None:
        """A start of a robot is heard for the first time: send it hellos, several because any of them may be lost."""
        self._answers[src_id] = boot
        self._starting = deque(now + after for after in STARTING_S[1:])
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
        if late < 0 or idle:
            return late >= 0
        if self._starting:
            return late >= latency * LATENCY_S
        return late > (SELDOM_S if heard else OFTEN_S / 2) + latency * LATENCY_S

    def hello(self, room: int, turns: int, digest: int, marks: Sequence[tuple[int, int]], now: float) -> list[Control]:
        """The entries of a hello; also sets the time of the next one.

        :param room: bytes free for it
        :param turns: how often the packet number has wrapped around
        :param digest: CRC-32 of the table of topics
        :param marks: marks of the kept messages
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
