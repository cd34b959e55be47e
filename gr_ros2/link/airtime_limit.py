"""How much one transmitter may send: a share of any window of time, and a longest burst, over restarts too.

*Window.* Airtime is added up in ``BINS`` bins per window. A bin counts as a whole until all of it has left the window,
so the sum is never too small. A packet waits until it fits.

*Pace.* A robot that spent an hour's airtime at once would then be silent for the rest of the hour. So ``BURST`` of it
may be spent at once, and the rest evenly. At full load a robot sends 1 - ``BURST`` of what is allowed.

*Restarts.* Airtime is reserved in a file before it is used, in parts of ``1 / CHUNKS`` of what is allowed, and each
part for a tenth of the window. After a restart, what was reserved counts as sent at the end of that time. So there is a
write now and then, not one per packet.

Invariants: the packets that begin when ``earliest`` says so, in order of time, never take more than ``duty_cycle *
window_s`` of any ``window_s`` seconds, and no burst is longer than ``max_burst_s``; nothing is sent that the file could
not take. There is no clock and no IO: the account is handed in.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from math import inf

from gr_ros2.core.errors import ConfigError
from gr_ros2.settings.airtime import AirtimeRule

BINS = 60
CHUNKS = 50
LEAST_CHUNK_S = 0.1
"""s of airtime that are reserved at least, where the packets of a short window would need a write each."""
KEPT = 0.1
"""Part of the window for which a reservation is good."""
BURST = 0.1
PAUSE_S = 0.1
"""s of silence that end a burst: the shortest off-time of EN 300 220-1 for what listens before it talks."""
AGAIN_S = 1.0
"""s after which a file that could not be written is tried again."""

Spent = Sequence[tuple[float, float]]
"""Airtime and until when it counts as being sent: (s after the present moment, may be negative; s of airtime)."""
SaveSpent = Callable[[Spent], None]
"""Stores what was spent before it returns. It raises ConfigError where it cannot."""


class AirtimeLimit:
    """The account of one transmitter.

    :param longest: s that its longest packet takes
    :param now: s, monotonic
    :param spent: what earlier starts have sent or reserved
    :param save: stores what is reserved; None: nothing outlives this object
    :raises ConfigError: for a packet that can never be sent
    :ivar unsaved: how often the account could not be stored
    :ivar stored: whether it was stored when that was tried last
    """

    def __init__(
        self, rule: AirtimeRule, longest: float, *, now: float = 0.0, spent: Spent = (), save: SaveSpent | None = None
    ) -> None:
        self.rule = rule
        self._budget = rule.duty_cycle * rule.window_s
        for allowed, name in ((self._budget, f"{rule.window_s:g} s"), (rule.max_burst_s or inf, "one burst")):
            if longest > allowed:
                raise ConfigError(
                    f"airtime: the longest packet takes {longest:.3g} s, and {allowed:.3g} s are allowed in {name}; "
                    "set a smaller packet_len, or a faster rate"
                )
        self._longest = longest
        self._save = save
        self._width = rule.window_s / BINS
        self._bins: deque[tuple[float, float]] = deque()
        """When airtime was over at the latest, and how much."""
        since = -inf
        for until, airtime in sorted((now + until, airtime) for until, airtime in spent if until > -rule.window_s):
            joined = 0.0
            if until <= since + self._width / 2:  # many restarts do not make many bins
                joined = self._bins.pop()[1]
            else:
                since = until
            self._bins.append((until, airtime + joined))
        self._sum = sum(airtime for _, airtime in self._bins)
        self._paced = -inf
        """When the pace alone lets the next packet leave, without its burst."""
        self._burst_since, self._over = -inf, now
        """When the burst began, and when the newest packet was over. An earlier start may have sent until now."""
        self._reserved, self._reserved_until, self._again = 0.0, -inf, -inf
        self.unsaved, self.stored = 0, True

    @property
    def budget(self) -> float:
        """s of airtime allowed in a window."""
        return self._budget

    def spent(self, now: float) -> float:
        """s of airtime that count in the window that ends now."""
        self._forget(now)
        return self._sum

    def earliest(self, at: float, airtime: float) -> float:
        """When a packet may begin, not before ``at``."""
        rule = self.rule
        begin = at
        if rule.duty_cycle < 1:
            begin = max(at, self._paced - BURST / (1 - BURST) * rule.window_s)
            begin = max(begin, self._fits(begin + airtime, airtime) - airtime)
        if rule.max_burst_s and begin < self._over + PAUSE_S and begin + airtime > self._burst_since + rule.max_burst_s:
            begin = self._over + PAUSE_S
        return begin

    def reserve(self, now: float, airtime: float) -> bool:
        """Whether so much may be spent as far as the file is concerned; stores a reservation where it is needed."""
        if self._save is None or self.rule.duty_cycle == 1:
            return True
        if airtime <= self._reserved and now + airtime <= self._reserved_until:
            return True
        if now < self._again:
            return False
        chunk = max(self._budget / CHUNKS, min(LEAST_CHUNK_S, self._budget / 4), self._longest, airtime)
        until = now + KEPT * self.rule.window_s + airtime
        self._forget(now)
        try:
            self._save([*((end - now, spent) for end, spent in self._bins), (until - now, chunk)])
        except ConfigError:
            self.unsaved, self.stored = self.unsaved + 1, False
            self._again = now + AGAIN_S
            return False
        self._reserved, self._reserved_until, self.stored = chunk, until, True
        return True

    def again(self, now: float) -> float | None:
        """When ``reserve`` tries again after a failure, None if it did not fail."""
        return self._again if self._again > now else None

    def spend(self, begin: float, airtime: float) -> None:
        """A packet begins. The time is what ``earliest`` said, or later."""
        rule, end = self.rule, begin + airtime
        if begin >= self._over + PAUSE_S:
            self._burst_since = begin
        self._over = end
        if rule.duty_cycle == 1:
            return
        self._forget(begin)
        self._paced = max(self._paced, begin) + airtime / (rule.duty_cycle * (1 - BURST))
        self._reserved -= airtime
        until = (end // self._width + 1) * self._width
        if self._bins and self._bins[-1][0] >= end:
            until, before = self._bins.pop()
            airtime += before
            self._sum -= before
        self._bins.append((until, airtime))
        self._sum += airtime

    def put_off(self, later: float) -> None:
        """The newest packet begins so many s later. What shares its bin counts longer, never too short."""
        self._over += later
        if self._bins:
            until, spent = self._bins.pop()
            self._bins.append((until + later, spent))

    def _fits(self, end: float, airtime: float) -> float:
        """When a packet may end, not before ``end``."""
        left = self._sum
        for until, spent in self._bins:
            if until + self.rule.window_s > end:
                if left + airtime <= self._budget:
                    break
                end = until + self.rule.window_s
            left -= spent
        return end

    def _forget(self, now: float) -> None:
        while self._bins and self._bins[0][0] + self.rule.window_s <= now:
            self._sum -= self._bins.popleft()[1]
        if not self._bins:
            self._sum = 0.0


def sustained(rule: AirtimeRule | None) -> float:
    """The share of the time that a transmitter with more to send than it may is on the air, 0..1; None = no limit."""
    return rule.duty_cycle * (1 - BURST) if rule is not None and rule.duty_cycle < 1 else 1.0


def at_full_load(rule: AirtimeRule, longest: float) -> AirtimeLimit:
    """The account at 0 s of a transmitter that has had more to send than it may, for longer than a window."""
    width = rule.window_s / BINS
    share = rule.duty_cycle * width * (1 - BURST)
    limit = AirtimeLimit(rule, longest, spent=[(-n * width, share) for n in range(BINS)])
    limit._paced = BURST / (1 - BURST) * rule.window_s
    return limit
