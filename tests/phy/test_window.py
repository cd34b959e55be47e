"""Credits for as fast as possible: a window of packets under way, granted several at a time."""

from __future__ import annotations

import pytest
from gnuradio import gr

from gr_ros2.core.errors import ConfigError
from gr_ros2.phy.window import CreditWindow
from tests.gr.probe import Probe
from tests.waiting import wait_for


def test_a_window_of_packets_is_under_way_and_credits_come_in_groups() -> None:
    top, probe, through = gr.top_block(), Probe(), [0]
    window = CreditWindow(lambda: through[0], window=8)
    top.msg_connect((window, "credit"), (probe, "credit"))
    top.start()
    try:
        wait_for(lambda: probe.credits == 8, "the window")
        through[0] = 1
        through[0] = 2
        wait_for(lambda: probe.credits == 10, "a quarter of the window")
        through[0] = 20
        wait_for(lambda: probe.credits == 28, "all that is through")
    finally:
        top.stop()
        top.wait()


def test_a_window_of_one_asks_for_packets_one_by_one() -> None:
    top, probe, through = gr.top_block(), Probe(), [0]
    window = CreditWindow(lambda: through[0], window=1)
    top.msg_connect((window, "credit"), (probe, "credit"))
    top.start()
    try:
        for number in range(5):
            through[0] = number
            wait_for(lambda number=number: probe.credits == number + 1, "a credit")
    finally:
        top.stop()
        top.wait()


def test_no_window_is_refused() -> None:
    with pytest.raises(ConfigError, match="window = 0"):
        CreditWindow(lambda: 0, window=0)
