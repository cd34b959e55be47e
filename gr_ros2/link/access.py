"""What decides when a robot may send on a channel that it shares; the engines are in ``gr_ros2.mac``."""

from __future__ import annotations

from typing import Any, Protocol


class Access(Protocol):
    """Medium access of one robot. All times are s of the caller's clock.

    The caller asks for the departure after whatever it has told the engine, waits until ``lead_s`` before it, takes a
    block, and hands over a packet that carries it at once.
    """

    @property
    def lead_s(self) -> float:
        """s before its departure at which a packet is composed."""

    @property
    def turn_s(self) -> float:
        """s from one packet of this robot to its next, as it lately was."""

    @property
    def named(self) -> bool:
        """Whether somebody has heard this robot since it last entered, as far as it can know."""

    def departure(self, now: float) -> float:
        """When the next packet may begin."""

    def block(self, weight: int = 1, *, fills: bool = False) -> bytes | None:
        """The bytes behind the header of the packet that begins at the departure. None: nothing may begin there after
        all; ask for the departure again.

        :param weight: packets to send while others send one, 1 to 16: more where there is much to relay
        :param fills: whether it has video, which fills what others leave: more packets, within limits
        """

    def hear(self, src_id: int, block: Any, began: float, *, trusted: bool = True, checked: bool = False) -> None:
        """A packet of a robot was received.

        :param block: as read, None where packets carry none
        :param began: when its burst began
        :param trusted: its trailer has been checked, and it is no recording as far as its sender can prove that
        :param checked: its trailer has been checked, and its sender may prove soon that it is no recording
        """
