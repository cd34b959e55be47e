"""Gaps of an outage filled later: what was superseded, or left while nobody heard it, crosses when the air has room.

It crosses as messages of class bulk, oldest first, which wait for all others and have no turn of their own, and goes to
those who record, not onto their graphs.

Invariants: without ``backfill`` there is no thread, no topic and no work per message; what is kept is bounded; at most
``WAITING`` messages of it wait to leave, and while nobody is known to hear, one ever more seldom; where airtime is
limited, no more is offered than the limit allows in the long run, beside the topics. What leaves while nobody hears it
is kept on.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence, Set
from functools import partial
from math import inf
from typing import Any

from gr_ros2.calls.backfill import ACCOUNT_LEN, PIECE, Account, Later, MessagesForLater, began_at, write_later
from gr_ros2.core.clocks import wall_ahead
from gr_ros2.gr.bulk_topic import add_bulk_topic
from gr_ros2.gr.live_end import LiveEnd
from gr_ros2.gr.sending import SendingBlock
from gr_ros2.link.endpoint import OpenEndpoint
from gr_ros2.link.events import Accepted, Refused, SenderEvent, SentPacket
from gr_ros2.link.fates import Fate
from gr_ros2.link.key import Key
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import BACKFILL_TYPE
from gr_ros2.settings.robot import BackfillConfig, RobotConfig
from gr_ros2.settings.topic_choice import TopicChoice

WAITING = 2
ACCOUNTS_PART = 64
"""Accounts take one byte at most for so many of the messages of which they tell."""
SELDOM_S = 60.0
"""s from one try to the next at most, while nobody hears."""
_LOOK_S, _BUSY_S = 0.2, 0.02
"""s between two looks at what has become of messages, and while some wait for room and somebody hears."""


class _Accounts:
    """When the robots that hear this one are told how many messages there were.

    :param kept: counts them
    """

    def __init__(self, kept: MessagesForLater) -> None:
        self._kept = kept
        self._from: dict[int, Account] = {}
        """Accounts from which robots count that have started in a silence."""
        self._told: set[int] = set()
        """Topics of which an account was told."""
        self._due = False
        """Whether somebody lacks an account."""
        self._untold, self._lost = 0, 0
        """Bytes of messages since the last account, and ``kept.lost`` then."""

    def accepted(self, size: int) -> None:
        """There is a further message of so many bytes."""
        self._untold += size

    def begin_anew(self) -> None:
        """Robots have started in a silence: they count from what was heard before it."""
        self._from = self._kept.accounts_heard()

    def lacked(self) -> None:
        """Somebody is there who lacks an account."""
        self._due = True

    def owed(self) -> list[Account]:
        """What is to be told now: to who is there anew, when something was given up, and beside so many bytes of
        messages that accounts take a small part of them."""
        least = max(PIECE, ACCOUNTS_PART * ACCOUNT_LEN * len(self._told))
        over = not len(self._kept) and self._kept.lost != self._lost
        if not (self._due or self._untold >= least or over):
            return []
        found: list[Account] = []
        for topic_id, account in self._kept.accounts().items():
            if topic_id not in self._told:
                found.append(Account(topic_id, 0, 0))
            elif topic_id in self._from:
                found.append(self._from[topic_id])
            found.append(account)
            self._told.add(topic_id)
        if found:
            self._due, self._from, self._untold, self._lost = False, {}, 0, self._kept.lost
        return found


class Backfill:
    """What one endpoint keeps and fills later.

    :param endpoint: its observer calls :meth:`note`
    :param share: part of the time that its transmitter may send
    :param chosen: whether what was lost of a topic is filled later
    :param wall_ahead: s by which the clock of the wall is ahead of that of the link
    :ivar kept: what is kept
    """

    def __init__(
        self,
        config: BackfillConfig,
        endpoint: OpenEndpoint,
        *,
        share: float,
        chosen: Callable[[int], bool],
        wall_ahead: Callable[[], float],
    ) -> None:
        self._receipts, self._robots = endpoint.receipts_of(config.robots), config.robots
        self._endpoint, self._share, self._chosen, self._wall_ahead = endpoint, share, chosen, wall_ahead
        self.kept = MessagesForLater(config.for_s, round(config.memory_mb * 1e6), endpoint.messages.overtakes)
        self._allowed, self._looked = 0.0, inf
        self._tried, self._pause_s = -inf, 0.0
        self._starts: dict[int, int] = {}
        """The newest start of each robot that was heard."""
        self._here: Set[tuple[int, int]] = frozenset()
        """Those that are, each with its start."""
        self._accounts = _Accounts(self.kept)
        self._topic_id = add_bulk_topic(endpoint, "_backfill", BACKFILL_TYPE, waiting=WAITING, reliability="reliable")

    def note(self, event: SenderEvent) -> None:
        """An event of the sending half."""
        if isinstance(event, Accepted):
            if event.topic_id == self._topic_id:
                self.kept.taken(event.serial)
            elif self._chosen(event.topic_id):
                self.kept.accepted(event.topic_id, event.serial, event.payload, event.now)
                self._accounts.accepted(len(event.payload))
        elif isinstance(event, Refused):
            self.kept.refused(event.serial, ever=event.reason != Fate.TOO_LARGE)
        elif isinstance(event, SentPacket):
            for entry in event.entries:
                if not entry.repeat and isinstance(entry.key, Key):
                    began = began_at(entry.key.number, entry.key.place)
                    self.kept.left(entry.serial, began, event.number, event.now, last=entry.total > 0)

    def look(self, now: float) -> None:
        """Let messages wait for what is left of the air."""
        here = {
            peer.robot: peer.start
            for peer in self._endpoint.peers(now)
            if not (peer.silent or peer.hops) and (not self._robots or peer.robot in self._robots)
        }
        if any(self._starts.get(robot, start) != start for robot, start in here.items()):
            self.kept.doubt()
        unheard = self.kept.unheard
        if unheard and not self._starts.items() >= here.items():
            self._accounts.begin_anew()
        self._starts |= here
        self.kept.heard(self._receipts, now)
        if here.items() - self._here or unheard > self.kept.unheard:
            self._accounts.lacked()
        self._here = here.items()
        if here:
            self._fill(now)
        self._looked = now

    def _fill(self, now: float) -> None:
        if self._share < 1:
            free = self._endpoint.used_air.free(now) * max(now - self._looked, 0.0)
            self._allowed = min(self._allowed + free, 1e9)
        if not self.kept.unheard:
            self._pause_s = 0.0
            if self._may_submit and (accounts := self._accounts.owed()):
                self._submit(accounts, now)  # before what takes longer to cross
            while self._may_submit and (found := self.kept.take(self._wall_ahead())):
                self._submit(found, now)
        elif self.kept.tries or now < self._tried + self._pause_s or not self._may_submit:
            return
        elif found := self.kept.take(self._wall_ahead(), most=0):
            # One message tells whether somebody hears again, where nothing else leaves that would.
            self._tried, self._pause_s = now, min(max(1.0, 2 * self._pause_s), SELDOM_S)
            self._submit([*found, *self._accounts.owed()], now)

    @property
    def _may_submit(self) -> bool:
        return self._endpoint.messages.has_space(self._topic_id) and (self._share >= 1 or self._allowed > 0)

    def _submit(self, messages: Sequence[Later | Account], now: float) -> None:
        payload = write_later(messages)
        self._allowed -= len(payload)
        self._endpoint.messages.submit(self._topic_id, payload, now)


class LiveBackfill:
    """The same of one robot's link.

    :param share: see :class:`Backfill`
    """

    def __init__(self, config: RobotConfig, end: LiveEnd[OpenEndpoint], source: SendingBlock, *, share: float) -> None:
        self._end, self._source, self._clock = end, source, source.clock
        self._choice = TopicChoice(config.backfill.topics, config.namespace)
        self._chosen: dict[int, bool] = {}
        with end.lock:
            self._backfill = source.keeper = Backfill(
                config.backfill,
                end.endpoint,
                share=share,
                chosen=self._is_chosen,
                wall_ahead=partial(wall_ahead, self._clock),
            )
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="gr-ros2-backfill", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Fill nothing any more. Idempotent."""
        self._closed.set()
        self._thread.join()

    def stats(self) -> dict[str, Any]:
        """Messages that are kept for later, that have filled gaps, and that were given up."""
        with self._end.lock:
            kept = self._backfill.kept
            return {"kept": len(kept), "filled": kept.filled, "given_up": kept.lost}

    def _is_chosen(self, topic_id: int) -> bool:
        chosen = self._chosen.get(topic_id)
        if chosen is None:
            named = {topic.topic_id: (name, topic) for name, topic in self._source.subscriptions.named()}
            name, topic = named.get(topic_id, ("", None))
            plain = topic is not None and not topic.as_frames and topic.options.to == AUTO
            chosen = self._chosen[topic_id] = plain and bool(self._choice.of([name]))
        return chosen

    def _run(self) -> None:
        kept = self._backfill.kept
        while not self._closed.wait(_BUSY_S if len(kept) and not kept.unheard else _LOOK_S):
            with self._end.lock:
                self._backfill.look(self._clock())
                self._end.wake()
