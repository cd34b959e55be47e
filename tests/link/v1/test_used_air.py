"""How much of the air a sender says that it uses, and that is free for more."""

from __future__ import annotations

from math import inf
from typing import Any, cast

import pytest

from gr_ros2.link.events import AirKind, SentPacket
from gr_ros2.link.pace import Pace
from gr_ros2.link.v1.packing import ENTRY
from gr_ros2.link.v1.used_air import UsedAir
from gr_ros2.settings.fields import AUTO
from gr_ros2.wire.v1 import Part

ROOM, TURN_S = 100, 0.01


def air(pace: Pace | None = None, *, turn_s: float = TURN_S, share: float = 1.0, packet_len: int = 0) -> UsedAir:
    return UsedAir(pace or Pace(AUTO), room=ROOM, turn_s=lambda: turn_s, packet_len=packet_len, share=share)


def packet(kind: AirKind, *parts: tuple[int, int], size: int = 120) -> SentPacket:
    """One with so many bytes of each topic.

    :param size: bytes of all of it
    """

    class Body:
        entries = tuple(Part(topic_id, bytes(size)) for topic_id, size in parts)

    return SentPacket(bytes(size), cast("Any", Body()), 1, 7, 1, 0, (), 0.0, kind)


def test_messages_take_of_what_is_free_and_repairs_fill_the_rest() -> None:
    used = air()
    assert used.free(0.0) == 10_000.0
    for number in range(100):
        used.left(packet("new", (3, 37)), number * 0.1)
        used.left(packet("repair"), number * 0.1 + 0.01)
    assert used.free(10.0) == pytest.approx(10_000.0 - 10 * (37 + ENTRY), rel=0.1)
    assert used.rate(10.0) == pytest.approx(10 * (37 + ENTRY + ROOM), rel=0.1)


def test_what_is_made_to_fit_takes_nothing_from_others() -> None:
    used = air()
    used.leave_out(3)
    for number in range(100):
        used.left(packet("new", (3, 90)), number * 0.01)
    assert used.free(1.0) == 10_000.0


def test_a_short_packet_takes_the_air_of_its_header_and_what_fits_rides_with_it() -> None:
    used = air(packet_len=120)
    used.leave_out(3)
    for number in range(100):
        used.left(packet("new", (1, 28), (3, 14), size=60), number * 0.01)
    assert used.rate(1.0) == pytest.approx((60 * ROOM / 120 - 14 - ENTRY) / 0.01, rel=0.05)


def test_an_airtime_limit_and_a_packet_rate_bound_what_is_free() -> None:
    assert air(share=0.01).free(0.0) == pytest.approx(100.0)
    assert air(Pace(5.0)).free(0.0) == 500.0
    assert air(Pace(5.0), turn_s=0.0).free(0.0) == 500.0
    assert air(turn_s=0.0).free(0.0) == inf


def test_pauses_of_a_link_with_little_to_send_are_not_its_rate() -> None:
    pace = Pace(AUTO)
    pace.use_credit()
    for number in range(20):
        now = number * 0.1
        pace.credit()
        assert pace.may_leave(now)
        pace.left(now, waiting=True)
    assert pace.sure_interval(2.0) == pytest.approx(0.1)
    assert air(pace).free(2.0) == 10_000.0


def test_each_fragment_of_a_message_has_a_head() -> None:
    assert air().cost(250.0) == 250 + 3 * ENTRY
    assert air().cost(0.0) == 0
