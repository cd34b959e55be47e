"""Medium access: when a robot may send on a channel that it shares with others.

Sans-IO: an engine is told what was heard and when it began, and says when the next packet may leave.
"""

from __future__ import annotations

import random
from collections.abc import Callable

from gr_ros2.core.tuning import Tuning
from gr_ros2.link.access import Access
from gr_ros2.mac.aloha import Aloha
from gr_ros2.mac.slots import Slots
from gr_ros2.wire.mac_block import read_block

__all__ = ["GUARD_S", "Aloha", "Slots", "access_of", "read_block"]

GUARD_S = 0.001
"""s between two slots in a simulation: what a device keeps that sends at a time (``timing_error_s`` of a front end)."""


def access_of(
    medium: str,
    airtime_s: float,
    seed: int,
    *,
    guard_s: float = GUARD_S,
    lead_s: float = 0.0,
    tuning: Tuning = Tuning(),
) -> Callable[[int], Access | None]:
    """What makes the engine of a robot from its id.

    :param medium: ``exclusive``, ``slots`` or ``aloha``, see :class:`gr_ros2.settings.config.AnyLink`
    :param airtime_s: of the longest packet
    :param guard_s: silence between two slots, s
    :param lead_s: s before its burst begins at which a packet is composed
    """

    def make(src_id: int) -> Access | None:
        rng = random.Random(f"access {seed} {src_id}")
        if medium == "slots":
            return Slots(src_id, airtime_s + guard_s, rng, period_s=0.0, lead_s=lead_s, tuning=tuning)
        if medium == "aloha":
            return Aloha(src_id, airtime_s, rng, period_s=0.0, lead_s=lead_s, tuning=tuning)
        return None

    return make
