"""Stamps and durations: seconds and nanoseconds in as few bits as their range needs.

Invariant: exact for all pairs of 32-bit numbers, valid or not.
"""

from __future__ import annotations

from gr_ros2.compression.ans import Table

_FULL_STAMP, _ZERO_STAMP, _MS_STAMP, _YOUNG, _YOUNG_MS, _ANY_STAMP = range(6)
_STAMPS = Table([3000, 200, 200, 350, 250, 90])
_ERA = 1_200_000_000
"""Stamps 2008 .. 2042 need 30 bits for the second, simulated ones below 2**20 need 20."""
_ERA_BITS, _YOUNG_BITS = 30, 20
_SECOND, _MS = 1_000_000_000, 1_000_000


def push_stamp(x: int, sec: int, nanosec: int) -> int:
    """Push a stamp or a duration.

    :param sec, nanosec: 0..2**32 - 1, the bits of the fields whatever their sign
    """
    if not sec and not nanosec:
        return _STAMPS.push(x, _ZERO_STAMP)
    if nanosec < _SECOND:
        era = sec - _ERA
        if 0 <= era < 1 << _ERA_BITS:
            if nanosec % _MS == 0:
                return _STAMPS.push((x << _ERA_BITS | era) * 1000 + nanosec // _MS, _MS_STAMP)
            return _STAMPS.push((x << _ERA_BITS | era) * _SECOND + nanosec, _FULL_STAMP)
        if sec < 1 << _YOUNG_BITS:
            if nanosec % _MS == 0:
                return _STAMPS.push((x << _YOUNG_BITS | sec) * 1000 + nanosec // _MS, _YOUNG_MS)
            return _STAMPS.push((x << _YOUNG_BITS | sec) * _SECOND + nanosec, _YOUNG)
    return _STAMPS.push(x << 64 | sec << 32 | nanosec, _ANY_STAMP)


def pop_stamp(x: int) -> tuple[int, int, int]:
    """(x, sec, nanosec)"""
    x, symbol = _STAMPS.pop(x)
    if symbol == _ZERO_STAMP:
        return x, 0, 0
    if symbol == _ANY_STAMP:
        return x >> 64, x >> 32 & 0xFFFF_FFFF, x & 0xFFFF_FFFF
    if symbol in (_MS_STAMP, _YOUNG_MS):
        x, nanosec = divmod(x, 1000)
        nanosec *= _MS
    else:
        x, nanosec = divmod(x, _SECOND)
    if symbol in (_FULL_STAMP, _MS_STAMP):
        return x >> _ERA_BITS, (x & ((1 << _ERA_BITS) - 1)) + _ERA, nanosec
    return x >> _YOUNG_BITS, x & ((1 << _YOUNG_BITS) - 1), nanosec
