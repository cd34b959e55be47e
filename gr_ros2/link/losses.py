"""Loss of whole packets in the channel: at random, in bursts, and during outages.

Invariants: equal seeds give equal losses for the same order of packets; every packet draws the same number of random
values, so that a change of one setting does not change the later random values; each loss is counted under the name
of the setting that caused it.
"""

from __future__ import annotations

import random
from collections import Counter

from gr_ros2.settings.config import BurstLoss, ChannelConfig


class PduLosses:
    """Decides for each packet whether it passes.

    :param config: its ``packet_loss``, ``burst_loss``, ``outages`` and ``seed`` are used
    """

    def __init__(self, config: ChannelConfig) -> None:
        self.packet_loss = config.packet_loss
        self.dropped: Counter[str] = Counter()
        """Packets lost so far, by setting."""
        self._outages = config.outages
        self._bursts = None if config.burst_loss is None else GilbertElliott(config.burst_loss, config.seed)
        self._random = random.Random(config.seed)

    def passes(self, now: float) -> bool:
        """Whether the next packet comes through.

        :param now: s since the run began
        """
        by_chance = self._random.random() < self.packet_loss
        in_burst = self._bursts is not None and self._bursts.loses()
        unplugged = any(begin <= now < end for begin, end in self._outages)
        for name, lost in (("outages", unplugged), ("burst_loss", in_burst), ("packet_loss", by_chance)):
            if lost:
                self.dropped[name] += 1
                return False
        return True


class GilbertElliott:
    """The two-state channel of Gilbert (1960) and Elliott (1963), stationary from its first packet on."""

    def __init__(self, config: BurstLoss, seed: int = 0) -> None:
        self._config = config
        self._random = random.Random(f"burst_loss {seed}")  # a sequence different from that of packet_loss
        self.bad = self._random.random() < config.share_bad

    def loses(self) -> bool:
        """Whether the next packet is lost; the state moves on after it."""
        config = self._config
        lost = self._random.random() < (config.loss_bad if self.bad else config.loss_good)
        if self._random.random() < (config.p_bad_to_good if self.bad else config.p_good_to_bad):
            self.bad = not self.bad
        return lost
