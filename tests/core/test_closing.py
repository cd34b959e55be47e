"""What is closed at the end of a ``with`` statement."""

from __future__ import annotations

import pytest

from gr_ros2.core.closing import Closing


class Door(Closing):
    closed = 0

    def close(self) -> None:
        self.closed += 1


def test_it_is_closed_at_the_end_and_after_an_error_which_is_passed_on() -> None:
    door = Door()
    with door as same:
        assert same is door and not door.closed
    assert door.closed == 1
    with pytest.raises(ZeroDivisionError), door:
        raise ZeroDivisionError
    assert door.closed == 2
