"""Packets through a channel without a run: what Ctrl-C in the middle of it does."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gnuradio import gr

from gr_ros2.phy import measure
from gr_ros2.phy.gfsk import GfskPhy
from gr_ros2.phy.threads import KeptAlive
from gr_ros2.settings.config import ChannelConfig
from gr_ros2_lab.medium.loss_table import table_for


class Pressing(KeptAlive, gr.sync_block):  # type: ignore[misc]
    """A channel through which nothing passes, and during which Ctrl-C is pressed."""

    def __init__(self, *_: Any) -> None:
        super().__init__("pressing", [np.complex64], [np.complex64])
        self.pressed = False

    def work(self, input_items: list[Any], output_items: list[Any]) -> int:  # noqa: ARG002
        if not self.pressed:
            self.pressed = True
            os.kill(os.getpid(), signal.SIGINT)
        return 0


@pytest.fixture
def pressing(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(measure, "Channel", Pressing)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("pressing")
def test_ctrl_c_during_a_measurement_comes_through() -> None:
    phy = GfskPhy(20, 1e5)
    recording = measure.record(phy, 2)
    with pytest.raises(KeyboardInterrupt):
        measure.deliver(phy, recording, ChannelConfig())


@pytest.mark.usefixtures("pressing")
def test_an_interrupted_measurement_is_not_kept(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        table_for(GfskPhy(20, 1e5), ChannelConfig(), {None}, packets=2, folder=tmp_path)
    assert list(tmp_path.glob("*.json")) == []
