"""Limited ALOHA: every robot sends at random times, so rarely that all of them together start a packet in two airtimes.

That load carries most (Abramson 1970: 1 / 2e of the channel). The number of robots is that of those heard lately. Where
one hears less than those should bring in its own interval, there are more than are heard, and the interval grows.

Invariants: sans-IO; equal calls give equal times.
"""

from __future__ import annotations

import math
import random

from gr_ros2.core.tuning import Tuning
from gr_ros2.wire.mac_block import Block


class Aloha:
    """The random times at which a robot may send.

    :param airtime_s: s of the longest packet
    :param period_s: s from one message to the next; a robot sends no more often
    :param lead_s: s before its departure at which a packet is composed
    """

    def __init__(
        self,
        src_id: int,
        airtime_s: float,
        rng: random.Random,
        *,
        period_s: float,
        lead_s: float = 0.0,
        tuning: Tuning = Tuning(),
    ) -> None:
        self._tuning = tuning
        self.src_id, self.lead_s = src_id, lead_s
        self._airtime, self._period, self._rng = airtime_s, period_s, rng
        self._heard: dict[int, float] = {}
        self._packets = 0
        self._every = period_s
        self._next: float | None = None

    @property
    def turn_s(self) -> float:
        return max(self._every, self._airtime)

    @property
    def named(self) -> bool:
        return True

    def departure(self, now: float) -> float:
        if self._next is None:
            tuning, airtime = self._tuning, self._airtime
            robots = sum(at > now - tuning.aloha_heard * airtime for at in self._heard.values())
            missing = math.exp(-2 * tuning.aloha_load) - self._packets / robots if robots else 1.0
            least = max(self._period, airtime * (1 + robots) / tuning.aloha_load)
            longer = max(least, self._every * math.exp(tuning.aloha_step * missing))
            self._every = min(longer, max(tuning.aloha_longest * airtime, least))
            self._packets = 0
            self._next = now + self.lead_s + max(self._airtime, self._rng.expovariate(1 / self._every))
        return self._next

    def block(self, weight: int = 1, *, fills: bool = False) -> bytes | None:  # noqa: ARG002
        """No bytes: ALOHA says nothing to others."""
        self._next = None
        return b""

    def hear(
        self,
        src_id: int,
        block: Block | None,  # noqa: ARG002
        began: float,
        *,
        trusted: bool = True,
        checked: bool = False,  # noqa: ARG002
    ) -> None:
        if trusted and src_id != self.src_id:
            self._heard[src_id] = began
            self._packets += 1
