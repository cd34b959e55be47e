"""What a sweep says of rooms whose response is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import fftconvolve

from gr_ros2.radio.audio_bursts import CARD_RATE
from gr_ros2.radio.sound_check import QUIET_S, measured, sweep


def room(echo_s: float, direct_db: float, delay_s: float, seed: int = 1) -> np.ndarray:
    """The response of a room: direct sound, then noise that decays by 60 dB in ``echo_s``."""
    rng, at = np.random.default_rng(seed), np.arange(CARD_RATE) / CARD_RATE
    tail = rng.normal(size=CARD_RATE) * 10 ** (-3 * at / echo_s)
    tail[: CARD_RATE // 400] = 0
    tail *= 10 ** (-direct_db / 20) / np.sqrt(np.sum(tail**2))
    tail[0] += 1
    return np.concatenate([np.zeros(round(delay_s * CARD_RATE)), tail])


@pytest.mark.parametrize("echo_s", [0.2, 0.4, 0.8])
@pytest.mark.parametrize("direct_db", [6.0, 0.0])
def test_echo_time_ratio_and_round_trip(echo_s: float, direct_db: float) -> None:
    played = sweep(0.2)
    noise = np.random.default_rng(2).normal(size=len(played)) * 1e-4
    heard = fftconvolve(played, room(echo_s, direct_db, 0.1))[: len(played)] + noise
    found = measured(played, heard.astype(np.float32))
    assert found.heard and not found.silent and found.clipped == 0
    assert found.round_trip_s == pytest.approx(0.1, abs=0.001)
    assert found.echo_s == pytest.approx(echo_s, rel=0.2)
    assert found.direct_db == pytest.approx(direct_db, abs=2.5)
    assert found.noise_db == pytest.approx(-80, abs=1)


def test_noise_alone_is_not_the_sweep() -> None:
    played = sweep(0.2)
    found = measured(played, np.random.default_rng(3).normal(size=len(played)).astype(np.float32) * 0.01)
    assert not found.heard and found.echo_s is None


def test_a_muted_microphone_gives_digital_silence() -> None:
    played = sweep(0.2)
    found = measured(played, np.zeros_like(played))
    assert (found.heard, found.silent) == (False, True)


def test_clipping_is_counted_and_the_sweep_stays_within_the_swept_level() -> None:
    played = sweep(0.5)
    assert np.abs(played).max() <= 0.5
    assert not played[: round(QUIET_S * CARD_RATE)].any()
    assert measured(played, np.clip(played * 4, -1, 1)).clipped > 0.1
