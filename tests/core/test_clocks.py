"""Two clocks read at one time, by a thread that has to wait for the processor now and then."""

from __future__ import annotations

import pytest

from gr_ros2.core.clocks import wall_ahead


class Computer:
    """Two clocks; ``waits`` are s for which the thread waits before each reading of either."""

    def __init__(self, *waits: float) -> None:
        self.now, self._waits = 5.0, list(waits)

    def _pass(self) -> None:
        self.now += self._waits.pop(0) if self._waits else 1e-6

    def clock(self) -> float:
        self._pass()
        return self.now

    def wall(self) -> float:
        self._pass()
        return 1e9 + self.now


@pytest.mark.parametrize("waits", [(), (0.0, 0.1), (0.0, 0.0, 0.1), (0.0, 0.1, 0.1, 0.0, 0.2)])
def test_a_thread_that_waits_in_between_reads_them_again(waits: tuple[float, ...]) -> None:
    computer = Computer(*waits)
    assert wall_ahead(computer.clock, computer.wall) == pytest.approx(1e9, abs=1e-5)


def test_on_a_computer_that_is_always_late_the_best_of_some_readings_counts() -> None:
    computer = Computer(*[0.01, 0.01, 0.05] * 100)
    assert wall_ahead(computer.clock, computer.wall) == pytest.approx(1e9, abs=0.06)
    assert computer.now < 6.0
