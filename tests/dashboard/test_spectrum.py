"""The spectrum: a tone stands where it is."""

from __future__ import annotations

import numpy as np
import pytest

from gr_ros2.dashboard.monitor import BINS, Spectrum


def tone(frequency: float, rate: float, samples: int = 1024) -> np.ndarray:
    return np.exp(2j * np.pi * frequency / rate * np.arange(samples)).astype(np.complex64)


def test_a_tone_is_the_strongest_bin() -> None:
    spectrum = Spectrum(1e5)
    assert spectrum.decibels() is None
    spectrum.add(tone(-12_500, 1e5))
    decibels = spectrum.decibels()
    assert decibels is not None
    assert len(spectrum.frequencies) == len(decibels) == BINS
    assert spectrum.frequencies[decibels.argmax()] == pytest.approx(-12_500)
    assert decibels.max() == 0
    assert decibels[spectrum.frequencies > 0].max() < -40


def test_what_is_gone_fades() -> None:
    spectrum = Spectrum(1e5)
    spectrum.add(tone(0, 1e5))
    for _ in range(60):
        spectrum.add(tone(25_000, 1e5))
    decibels = spectrum.decibels()
    assert decibels is not None
    assert decibels[BINS // 2] < -40


def test_too_few_samples_and_silence_are_no_error() -> None:
    spectrum = Spectrum(1e5)
    spectrum.add(tone(0, 1e5, BINS - 1))
    assert spectrum.decibels() is None
    spectrum.add(np.zeros(BINS, np.complex64))
    decibels = spectrum.decibels()
    assert decibels is not None
    assert np.isfinite(decibels).all()


def test_what_is_no_number_does_not_stay() -> None:
    spectrum = Spectrum(1e5)
    broken = tone(-12_500, 1e5)
    broken[BINS + 3] = np.nan
    spectrum.add(broken)
    decibels = spectrum.decibels()
    assert decibels is not None
    assert np.isfinite(decibels).all()
