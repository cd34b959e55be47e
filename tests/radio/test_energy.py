"""Signals above the noise are counted, and noise is not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from gnuradio import blocks, gr
from numpy.typing import NDArray

from gr_ros2.radio.burst_device import EnergyCounter


def counted(samples: NDArray[np.complex64], blanked: Sequence[tuple[int, int]] = ()) -> int:
    """How many signals a flowgraph counts in them."""
    graph, counter = gr.top_block(), EnergyCounter(1e6, lambda first, end: blanked)  # noqa: ARG005
    graph.connect(blocks.vector_source_c(samples), counter)
    graph.run()
    return counter.bursts


def noise(count: int, power: float, seed: int = 1) -> NDArray[np.complex64]:
    rng = np.random.default_rng(seed)
    parts = rng.standard_normal((count, 2)) * np.sqrt(power / 2)
    return (parts[:, 0] + 1j * parts[:, 1]).astype(np.complex64)


def test_noise_of_any_level_is_no_signal() -> None:
    assert counted(noise(1_000_000, 1e-6)) == 0
    assert counted(np.concatenate([noise(400_000, 1e-6), noise(400_000, 2e-6, 2)])) == 0


@pytest.mark.parametrize("snr_db", [8, 20, 60])
def test_bursts_are_counted(snr_db: float) -> None:
    samples = noise(1_000_000, 1e-6)
    for at in range(100_000, 1_000_000, 100_000):
        samples[at : at + 4096] += noise(4096, 1e-6 * 10 ** (snr_db / 10), at)
    assert counted(samples) == 9


def test_what_was_blanked_is_no_noise() -> None:
    samples = noise(200_000, 1e-6)
    samples[50_100:60_000] = 0
    assert counted(samples, [(50_100, 60_000)]) == 0


def listened(samples: NDArray[np.complex64], sample_rate: float = 1e6) -> EnergyCounter:
    """A counter that has taken them a few at a time."""
    graph, counter = gr.top_block(), EnergyCounter(sample_rate)
    graph.connect(blocks.vector_source_c(samples), counter)
    graph.run(512)
    return counter


@pytest.mark.parametrize("power", [1e-12, 1e-3, 1.0])
def test_silence_of_exact_zeros_is_a_level_above_which_others_are_heard(power: float) -> None:
    samples = np.zeros(1_000_000, np.complex64)
    for at in range(100_000, 1_000_000, 100_000):
        samples[at : at + 20_000] = noise(20_000, power, at)
        assert listened(samples[: at + 10_000]).is_above()
        assert not listened(samples[: at + 30_000]).is_above()
    assert counted(samples) == 9


def test_noise_that_begins_after_zeros_is_noise_after_a_while() -> None:
    """A driver may give zeros at its start: who listens before sending would be silent for ever."""
    samples = np.concatenate([np.zeros(20_000, np.complex64), noise(200_000, 1e-6)])
    assert listened(samples[:30_000], 2e4).is_above()
    assert not listened(samples, 2e4).is_above()


def test_noise_that_begins_after_bursts_with_soft_edges_is_noise_after_a_while() -> None:
    """As behind a squelch, or where a computer takes the noise out of its microphone."""
    edge = 10 ** np.linspace(-8, 0, 2000)
    burst = 0.3 * np.concatenate([edge, np.ones(10_000), edge[::-1]])
    samples = np.concatenate([np.zeros(20_000), burst, np.zeros(20_000)]).astype(np.complex64)
    assert listened(samples[:30_000], 2e4).is_above()
    assert not listened(samples, 2e4).is_above()
    opened = np.concatenate([samples, noise(600_000, 1e-8)])
    assert listened(opened[:80_000], 2e4).is_above()
    assert not listened(opened, 2e4).is_above()


def test_silence_and_samples_that_are_no_numbers_do_no_harm() -> None:
    samples = np.zeros(100_000, np.complex64)
    samples[50_000:60_000] = np.nan
    assert counted(samples) == 0


def test_the_newest_samples_say_whether_somebody_sends() -> None:
    samples = noise(200_000, 1e-6)
    samples[150_000:] += noise(50_000, 1e-4, 2)
    graph, counter = gr.top_block(), EnergyCounter(1e6)
    graph.connect(blocks.vector_source_c(samples), counter)
    graph.run()
    assert counter.is_above()


def test_a_carrier_counts_as_noise_after_a_while() -> None:
    """Otherwise whoever listens before sending would be silent for ever."""
    samples = np.concatenate([noise(20_000, 1e-6), noise(400_000, 1e-4, 2)])
    for sample_rate, above in ((1e6, True), (1e4, False)):
        graph, counter = gr.top_block(), EnergyCounter(sample_rate)
        graph.connect(blocks.vector_source_c(samples), counter)
        graph.run()
        assert counter.is_above() == above
