"""What an endpoint has to know of its robot's radio."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from gr_ros2.link.access import Access
from gr_ros2.link.rate import Mcs


@dataclass(frozen=True, kw_only=True)
class Air:
    """What an endpoint has to know of its robot's radio.

    :param hears: whether the robots that it may hear can hear it, so that it reports to them
    :param half_duplex: whether sending and receiving share the airtime
    :param any_length: whether the PHY carries shorter packets in less time, see :attr:`gr_ros2.phy.Phy.any_length`
    :param relay: whether messages of other robots are sent on
    :param radios: over how many radios packets leave and come
    :param airtime_share: part of the time that this robot may send, above 0..1
    :param airtime_s: of the longest packet, s; 0 = not known
    :param mcs_table: the rates of an adaptive rate, see :attr:`gr_ros2.phy.Phy.mcs_table`; () for a fixed rate
    :param access: makes what decides when the robot with an id may send; None from it: whenever there is a credit
    """

    hears: bool = True
    half_duplex: bool = False
    any_length: bool = False
    relay: bool = False
    radios: int = 1
    airtime_share: float = 1.0
    airtime_s: float = 0.0
    mcs_table: Sequence[Mcs] = ()
    access: Callable[[int], Access | None] = lambda _: None
