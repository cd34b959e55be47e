"""Bursts as sound, without a card."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.radio.audio_bursts import CARD_RATE, LATE_S, MOST_WAITING, BurstQueue, StreamClock, Upconverter

BLOCKS = st.lists(st.integers(1, 700), min_size=1, max_size=30)
WAITING = st.lists(st.tuples(st.one_of(st.none(), st.floats(0, 0.2)), st.integers(1, 2000)), max_size=MOST_WAITING)


def played(queue: BurstQueue, blocks: list[int], begins_at: float = 0.0) -> np.ndarray:
    """What sounds in blocks of so many frames, one after the other."""
    parts = []
    for frames in blocks:
        part = np.full(frames, np.nan, np.float32)
        queue.fill(part, begins_at)
        begins_at += frames / CARD_RATE
        parts.append(part)
    return np.concatenate(parts)


@given(BLOCKS, WAITING)
def test_each_burst_sounds_whole_once_and_in_order_or_is_counted(
    blocks: list[int], bursts: list[tuple[float | None, int]]
) -> None:
    queue = BurstQueue()
    for number, (at, length) in enumerate(bursts, start=1):
        queue.add(np.full(length, number, np.float32), at)
    sound = played(queue, [*blocks, CARD_RATE * 2])
    assert queue.idle
    runs = np.split(sound, np.flatnonzero(np.diff(sound)) + 1)
    heard = [(int(run[0]), len(run)) for run in runs if run[0]]
    assert heard == [(number, bursts[number - 1][1]) for number, _ in heard]
    assert sorted(number for number, _ in heard) == [number for number, _ in heard]
    assert len(heard) == queue.counted["bursts_out"] == len(bursts) - queue.counted["late"]


@given(BLOCKS, st.floats(0, 0.05), st.floats(-1, 1))
def test_a_burst_begins_at_the_frame_of_its_time(blocks: list[int], at: float, begins_at: float) -> None:
    queue = BurstQueue()
    queue.add(np.ones(10, np.float32), begins_at + at)
    sound = played(queue, [*blocks, CARD_RATE], begins_at)
    assert abs(int(np.flatnonzero(sound)[0]) / CARD_RATE - at) <= 1 / CARD_RATE


def test_a_burst_that_is_too_late_is_left_out_and_the_next_one_sounds() -> None:
    queue = BurstQueue()
    queue.add(np.ones(10, np.float32), -LATE_S - 0.001)
    queue.add(np.full(10, 2, np.float32), -LATE_S / 2)
    assert played(queue, [480])[0] == 2
    assert queue.counted == {"bursts_out": 1, "late": 1, "unsent": 0}


def test_a_card_that_stands_still_lets_no_memory_grow() -> None:
    queue = BurstQueue()
    for _ in range(MOST_WAITING + 3):
        queue.add(np.ones(10, np.float32), None)
    assert queue.counted["unsent"] == 3


@pytest.mark.parametrize(("sample_rate", "centre_hz"), [(6000, 1500), (8000, 4500), (24_000, 11_000), (48_000, 11_000)])
def test_sound_has_the_power_of_the_samples_around_the_centre(sample_rate: int, centre_hz: float) -> None:
    tone = 0.2 * np.exp(2j * np.pi * 0.1 * np.arange(sample_rate)).astype(np.complex64)
    sound = Upconverter(sample_rate, centre_hz)(tone)
    middle = sound[len(sound) // 4 : -len(sound) // 4]
    assert np.sqrt(np.mean(middle**2)) == pytest.approx(0.2, rel=0.02)
    spectrum = np.abs(np.fft.rfft(middle * np.hanning(len(middle)))) ** 2
    peak = int(np.argmax(spectrum))
    assert peak * CARD_RATE / len(middle) == pytest.approx(centre_hz + 0.1 * sample_rate, abs=3)
    beside = np.concatenate([spectrum[: peak - 5], spectrum[peak + 6 :]])
    assert beside.max() < 1e-6 * spectrum[peak], "an image of the band sounds"


def test_a_server_that_jitters_tells_steady_times() -> None:
    clock, rng = StreamClock(), np.random.default_rng(1)
    begins = [clock.begin(n * 0.01 + rng.uniform(-0.009, 0.009), 480) for n in range(2000)]
    assert [follows for _, follows in begins].count(False) == 1
    late = [at - n * 0.01 for n, (at, _) in enumerate(begins)]
    assert np.abs(late[500:]).max() < 0.002


def test_lost_frames_are_a_gap() -> None:
    clock = StreamClock()
    clock.begin(0.0, 480)
    assert clock.begin(0.01, 480)[1]
    assert clock.begin(0.06, 480) == (0.06, False)
