"""When a robot sends hellos, and what they contain.

Hellos are sent at the start, several in the first second because any of them may be lost; whenever the table of topics
changes; at once to answer a robot that is heard for the first time; and otherwise every one or two seconds, about
50 bytes/s, every two where nothing is lost, or less and less often while nobody is heard. While messages wait, hellos
are delayed: by half a second, or by two seconds if receivers report. On a slow channel all of it takes longer
(``Settings.slower``). The time between regular hellos is random by a part (RFC 5148): in a channel that is bad in just
their rhythm none would ever pass.

Invariant: a hello names a kept message only after the receivers had time to get it when it was first sent.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Sequence
from math import inf
from typing import TypeVar

from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.neighbours import Neighbours
from gr_ros2.link.v1.outbox import Outbox
from gr_ros2.link.v1.repair import RepairWindow
from gr_ros2.wire.control import (
    CAN_HEAR,
    ENCRYPTS,
    HEARD_LEN,
    HELLO_LEN,
    MARK_LEN,
    READS_LEFT_OUT,
    REPORTED,
    WANTS_PROOF,
    Control,
    Hello,
)

_T = TypeVar("_T")


class Hellos:
    """The hellos of one robot.

    :param messages: gives the table of topics, and the messages that are kept
    :param encrypts: whether its packets are encrypted
    """

    def __init__(
        self,
        settings: Settings,
        boot: int,
        messages: Outbox,
        window: RepairWindow,
        neighbours: Neighbours,
        *,
        encrypts: bool,
    ) -> None:
        self._settings, self._tuning = settings, settings.tuning
        self._messages, self._window, self._neighbours = messages, window, neighbours
        self._boot = boot
        self._rng = random.Random(f"hellos {boot} {settings.src_id}")
        self._capabilities = settings.hears * (CAN_HEAR | READS_LEFT_OUT) | encrypts * ENCRYPTS
        self._pause = self._period
        """s to the next hello at most."""
        self._starting: deque[float] = deque()
        self._apart: list[Control] = []
        """What did not fit into the last hello and goes into a packet of its own."""
        self._mark = self._heard = self._eager = 0
        self._answering = False
        self.due = -inf
        """When the next hello is due, s."""
        self._yields = 0
        """Packets of messages, if any wait, that leave before the next hello, unless this answers another robot."""
        self._talks, self._said = False, 0
        """Whether messages had left when a hello was written last, since the one before; and how many in all."""

    def start(self, now: float) -> None:
        """The first packet may be sent now."""
        self._starting = deque(now + after * self._settings.slower for after in self._tuning.hello_starting_s)
        self.due = self._starting.popleft()

    @property
    def starting(self) -> bool:
        """Whether hellos are still frequent."""
        return bool(self._starting)

    def met(self, now: float, *, knows: bool = False) -> None:
        """A start of a robot is heard for the first time: send it hellos, several because any of them may be lost.

        :param knows: it has opened a packet of this robot, so it has a hello
        """
        if knows and self._settings.slower > 1:
            self._eager = self._tuning.hello_eager
            return
        self._starting = deque(now + after * self._settings.slower for after in self._tuning.hello_starting_s[1:])
        self._eager = self._tuning.hello_eager
        self.answer(now)

    def answer(self, now: float) -> None:
        """Send the next hello at once, before messages."""
        self._answering = True
        self.hurry(now)

    def hurry(self, now: float) -> None:
        """Send the next hello at once."""
        self.due = min(self.due, now)

    def early(self, pause_s: float) -> float:
        """A time in s, and this one in the mean, for what nobody may hear if it comes in an exact rhythm."""
        early = self._tuning.hello_early
        return pause_s * (1 - early * self._rng.random()) / (1 - early / 2)

    def urgent(self, now: float, *, idle: bool, latency: bool, heard: bool) -> bool:
        """Whether a hello goes before messages.

        :param idle: no message waits
        :param latency: a message of class latency waits
        :param heard: some robot reports, so a new robot announces itself and is answered at once
        """
        late = now - self.due
        if late < 0 or idle or self._answering:
            return late >= 0
        slower, tuning = self._settings.slower, self._tuning
        first_s = latency * tuning.hello_latency_s
        if self._starting:
            rests = slower > 1 and self._rests and late <= tuning.hello_seldom_s * slower
            return late >= first_s and not rests
        return late > (tuning.hello_seldom_s if heard else tuning.hello_often_s / 2) * slower + first_s

    def yielded(self) -> None:
        """A packet of messages leaves."""
        self._yields -= self._yields > 0

    def begin(self) -> None:
        """A hello is written next."""
        said = self._messages.stats.sent.total()
        self._talks, self._said = said > self._said, said

    @property
    def lone(self) -> bool:
        """Whether nothing of any robot comes, though it could, and nothing is said for robots that only listen."""
        return self._settings.hears and not self._talks and not self._hears_others

    @property
    def _hears_others(self) -> bool:
        return any(not neighbour.silent for neighbour in self._neighbours.all.values())

    @property
    def met_all(self) -> bool:
        """Whether robots are heard, and all of them have heard this one and prove it."""
        heard = [neighbour for neighbour in self._neighbours.all.values() if not neighbour.silent]
        return bool(heard) and all(neighbour.knows and neighbour.proven for neighbour in heard)

    @property
    def _rests(self) -> bool:
        """Whether messages go before hellos on a slow channel: always where all that are heard have heard this robot,
        and prove it."""
        access = self._settings.access
        named = access is not None and access.named
        return self.met_all or (self._hears_others and self._yields > 0 and named)

    @property
    def _period(self) -> float:
        """s from one hello to the next."""
        settings, tuning = self._settings, self._tuning
        often_s = max(tuning.hello_often_s, settings.packet_len / tuning.hello_bytes_s)
        return min(often_s, tuning.hello_seldom_s) * settings.slower

    @property
    def _calm(self) -> bool:
        """Whether a robot is heard, and nothing is lost either way."""
        losses = [
            self._window.peers.loss,
            *(neighbour.inbox.reports.loss for neighbour in self._neighbours.all.values() if neighbour.proven),
        ]
        return len(losses) > 1 and max(losses) < self._tuning.report_calm_loss

    def entries(self, room: int, now: float) -> list[Control]:
        """The entries of a hello; also sets the time of the next one.

        What proves to other robots that they were heard goes into the next packet, alone, where it does not fit.

        :param room: bytes free for it
        """
        window, neighbours = self._window, self._neighbours
        wants = neighbours.unproven
        self._answering, self._yields = False, self._tuning.hello_rests
        if self._apart:
            apart, self._apart = self._apart, []
            self.due = self._next(now, wants=wants)
            return apart
        free = room - HELLO_LEN
        lone = self.lone and not self._starting
        period = self._tuning.hello_seldom_s * self._settings.slower if self._calm else self._period
        self._pause = min(2 * self._pause, max(self._tuning.hello_lone_s, self._period)) if lone else period
        marks, heard = self._messages.kept.marks(now), neighbours.heard(window.packets.newest)
        proofs, self._heard = _in_turn(heard, self._heard, max(free // HEARD_LEN - bool(marks), 1))
        if free < HEARD_LEN:
            self._apart, proofs = [*proofs], []
        free -= len(proofs) * HEARD_LEN
        named, self._mark = _in_turn(marks, self._mark, free // MARK_LEN)
        self._answering = bool(self._apart)
        self.due = now if self._apart else self._next(now, wants=wants)
        reported = bool(window.peers) and self._settings.repair != "off"
        capabilities = self._capabilities | reported * REPORTED | wants * WANTS_PROOF
        return [
            Hello(self._boot, window.packets.newest >> 16, capabilities, self._messages.kept.digest, tuple(named)),
            *proofs,
        ]

    def _next(self, now: float, *, wants: bool) -> float:
        """When the next hello is due, s."""
        while self._settings.turns_are_rare and self._starting and self._starting[0] <= now:
            self._starting.popleft()  # messages went first for so long that this hello stands for several
        due = self._starting.popleft() if self._starting else now + self.early(self._pause)
        if not wants or not self._eager:
            return due
        self._eager -= 1
        return min(due, now + self._tuning.hello_eager_s * self._settings.slower)


def _in_turn(items: Sequence[_T], turn: int, most: int) -> tuple[list[_T], int]:
    """So many of the items from a place on, and the place after them."""
    count = min(len(items), most)
    return [*items, *items][turn : turn + count], (turn + count) % max(len(items), 1)
