"""What is on the air while a robot is silent: signals stand where and for as long as they are, and nothing is sent."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.core.errors import ConfigError
from gr_ros2.radio import spectrum
from gr_ros2.radio.occupancy import PARTS, Occupancy
from gr_ros2.radio.spectrum import Listening
from tests.radio.robots import Robot
from tests.waiting import wait_for

RATE = 1e6
BLOCK = 512


def noise(blocks: int, rng: np.random.Generator, level: float = 1e-3) -> NDArray[np.complex64]:
    """White noise of a power of ``level`` squared."""
    parts = rng.normal(0, level / np.sqrt(2), (blocks * BLOCK, 2))
    return np.asarray(parts @ [1, 1j], np.complex64)


def carrier(blocks: int, part: int, level: float = 0.1) -> NDArray[np.complex64]:
    """In the middle of a part of the band."""
    at = ((part + 0.5) / PARTS - 0.5) * np.arange(blocks * BLOCK)
    return np.asarray(level * np.exp(2j * np.pi * at), np.complex64)


def heard(samples: NDArray[np.complex64]) -> Occupancy:
    occupancy = Occupancy()
    for start in range(0, len(samples), 2 * BLOCK):
        occupancy.add(samples[start : start + 2 * BLOCK])
    return occupancy


def test_noise_alone_is_not_busy_and_has_its_power() -> None:
    found = heard(noise(2000, np.random.default_rng(1))).found()
    assert found is not None
    assert (found.blocks, found.mean.shape) == (2000, (PARTS,))
    assert found.mean.sum() == pytest.approx(1e-6, rel=0.02)
    assert found.busy.mean() < 2e-4
    assert 0.6 < found.floor / found.mean.mean() < 1


@pytest.mark.parametrize("share", [0.1, 0.5, 1.0])
def test_a_carrier_is_busy_where_and_for_as_long_as_it_is(share: float) -> None:
    rng = np.random.default_rng(2)
    on = round(1000 * share)
    samples = noise(1000, rng)
    samples[: on * BLOCK] += carrier(on, 5)
    found = heard(samples).found()
    assert found is not None
    assert found.busy[5] == pytest.approx(share, abs=0.002)
    assert found.busy[[0, 1, 2, 9, 20, PARTS - 1]].max() < 0.005
    assert found.peak[5] == pytest.approx(0.01, rel=0.1)  # the square of its level, whatever the window
    assert found.mean[5] == pytest.approx(0.01 * share, rel=0.1)


def test_a_wide_signal_for_half_of_the_time_is_busy_all_over() -> None:
    rng = np.random.default_rng(3)
    samples = noise(1000, rng)
    samples[: 500 * BLOCK] += noise(500, rng, 0.1)
    found = heard(samples).found()
    assert found is not None
    assert found.busy == pytest.approx(np.full(PARTS, 0.5), abs=0.01)


def test_zeros_and_what_is_no_number_are_left_out_and_counted() -> None:
    samples = noise(400, np.random.default_rng(4))
    samples[: 100 * BLOCK] = 0
    samples[100 * BLOCK : 300 * BLOCK : BLOCK] = np.nan
    samples[101 * BLOCK] = np.inf
    occupancy = heard(samples)
    found = occupancy.found()
    assert (occupancy.zeros, occupancy.not_finite) == (100, 200)
    assert found is not None
    assert found.blocks == 100
    assert found.mean.sum() == pytest.approx(1e-6, rel=0.05)
    nothing = heard(np.zeros(10 * BLOCK, np.complex64))
    assert (nothing.found(), nothing.zeros) == (None, 10)


def test_an_incomplete_block_waits_for_nothing() -> None:
    occupancy = Occupancy()
    assert occupancy.found() is None
    occupancy.add(noise(1, np.random.default_rng(5))[:-1])
    assert occupancy.found() is None


def recording(path: Path, samples: NDArray[np.complex64], frequency: float | None = None) -> dict[str, Any]:
    """A front end that receives it again and again."""
    capture = {"core:sample_start": 0, **({} if frequency is None else {"core:frequency": frequency})}
    about = {"global": {"core:datatype": "cf32_le", "core:sample_rate": RATE, "core:version": "1.0.0"}}
    Path(f"{path}.sigmf-meta").write_text(json.dumps({**about, "captures": [capture], "annotations": []}))
    samples.tofile(f"{path}.sigmf-data")
    return {"name": "file", "read": f"{path}.sigmf-meta", "write": f"{path}-sent", "repeat": True}


def measured(robot: Robot) -> dict[str, Any]:
    """What its link hears."""
    robot.link.listening.measure(0.3)
    wait_for(lambda: robot.link.listening.look()["state"] != "listens", "the spectrum")
    return robot.link.listening.look()


def robot(path: Path, samples: NDArray[np.complex64], **values: Any) -> Robot:
    phy = {"name": "psk", "sample_rate": RATE}
    return Robot(1, recording(path, samples), phy=phy, instrumented=True, state=str(path / "state"), **values)


def test_a_link_is_silent_while_it_listens_and_sends_again(tmp_path: Path) -> None:
    samples = noise(400, np.random.default_rng(6))
    samples += carrier(400, 20, 0.05)
    with robot(tmp_path / "in", samples) as one:
        wait_for(lambda: one.link.stats()["packets"]["out"] > 2, "packets")
        one.link.listening.measure(0.5)
        wait_for(lambda: not one.link.radio.transmits, "silence")
        with pytest.raises(ConfigError, match="spectrum: somebody else listens now"):
            one.link.listening.measure(0.3)
        wait_for(lambda: one.link.listening.look()["state"] == "done", "the spectrum")
        (radio,) = one.link.listening.look()["radios"]
        assert radio["parts"][20]["busy"] > 0.9
        assert radio["parts"][20]["from_hz"] == pytest.approx(4 * RATE / PARTS)
        assert radio["parts"][20]["mean_db"] == pytest.approx(20 * np.log10(0.05), abs=0.5)
        assert radio["parts"][3]["busy"] < 0.05
        assert (radio["front_end"], radio["frequency"], radio["sample_rate"]) == ("file", None, RATE)
        wait_for(lambda: one.link.radio.transmits, "the end of the silence")
        before = one.link.stats()["packets"]["out"]
        wait_for(lambda: one.link.stats()["packets"]["out"] > before, "another packet")


def test_a_link_that_was_frozen_while_it_listened_listens_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    looks, monotonic = [0], time.monotonic

    def after_a_freeze() -> float:
        looks[0] += threading.current_thread().name == "gr-ros2-spectrum"
        return monotonic() + 12.0 * (looks[0] > 1)

    with robot(tmp_path / "in", noise(400, np.random.default_rng(7))) as one:
        monkeypatch.setattr(spectrum.time, "monotonic", after_a_freeze)
        assert measured(one)["state"] == "done"
        monkeypatch.undo()


def test_who_has_switched_sending_meanwhile_is_obeyed(tmp_path: Path) -> None:
    with robot(tmp_path / "in", noise(400, np.random.default_rng(7))) as one:
        one.link.listening.measure(0.3)
        wait_for(lambda: not one.link.radio.transmits, "silence")
        one.link.transmit(on=False)
        wait_for(lambda: one.link.listening.look()["state"] == "done", "the spectrum")
        one.link.listening.close()
        assert not one.link.radio.transmits


def test_nothing_but_zeros_and_no_numbers_is_said(tmp_path: Path) -> None:
    with robot(tmp_path / "in", np.zeros(400 * BLOCK, np.complex64)) as one:
        told = measured(one)
        assert told["state"] == "failed"
        assert told["words"].startswith("front_end file: no samples, or zeros in 0.3 s; is the device plugged in")
        assert len(told["words"].splitlines()) == 1


def test_a_link_that_ends_ends_listening(tmp_path: Path) -> None:
    with robot(tmp_path / "in", noise(400, np.random.default_rng(8))) as one:
        one.link.listening.measure(500.0)
        listening: Listening = one.link.listening
    assert listening._thread is not None
    assert not listening._thread.is_alive()


@pytest.mark.parametrize(
    ("front_end", "phy", "said"),
    [
        (
            {"name": "sim"},
            {"name": "psk", "sample_rate": RATE},
            "front_end sim: gives samples of what other robots send",
        ),
        ({"name": "sim"}, {"name": "direct"}, "front_end sim: gives packets, and no samples"),
    ],
)
def test_a_front_end_that_hears_nothing_else_says_so(
    front_end: dict[str, Any], phy: dict[str, Any], said: str, tmp_path: Path
) -> None:
    with (
        Robot(1, front_end, phy=phy, instrumented=True, state=str(tmp_path / "state")) as one,
        pytest.raises(ConfigError, match=said),
    ):
        one.link.listening.measure(0.3)
