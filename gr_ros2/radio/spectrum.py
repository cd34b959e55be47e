"""What a front end hears while its robot is silent: power over frequency, and for which share of the time each part of
the band is above the noise.

Invariants: while it is measured, nothing is sent; afterwards the link sends again if it did before, unless somebody has
switched sending meanwhile. At most one measurement goes on; without one there is no thread. Samples that are no finite
numbers, and blocks of nothing but zeros (a driver that has not started), are left out and counted.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gr_ros2.core.errors import ConfigError, RadioError
from gr_ros2.phy import Phy
from gr_ros2.radio.front_end import FrontEnd
from gr_ros2.radio.one_radio import OneRadio

PARTS = 32
"""Parts of the band."""
_BINS = 512
"""Frequencies of a block: 16 of each part, so that noise alone stands out of the floor once in 10^4 blocks."""
_QUIET = 0.25
"""Share of the blocks that set the floor of each part: something may be on the air for three quarters of the time."""
STANDS_OUT = 4.0
"""Power over the floor from which on a part is busy: 6 dB."""
_LOOK_S, _SETTLE_S = 0.01, 0.2
"""s between two looks, and until what was under way to the device has been sent."""


class Occupancy:
    """Power of each part of a band in block after block.

    :ivar zeros, not_finite: blocks that were left out
    """

    def __init__(self) -> None:
        self._window = np.hanning(_BINS)
        self._scale = _BINS * float((self._window**2).sum())
        self._powers: list[NDArray[np.float64]] = []
        self.zeros = self.not_finite = 0

    def add(self, samples: NDArray[np.complex64]) -> None:
        """Consecutive samples; an incomplete block at their end is left out."""
        blocks = samples[: len(samples) // _BINS * _BINS].reshape(-1, _BINS).astype(np.complex128)
        finite = np.isfinite(blocks).all(axis=1)
        silent = finite & ~blocks.any(axis=1)
        self.not_finite += int((~finite).sum())
        self.zeros += int(silent.sum())
        power = np.abs(np.fft.fftshift(np.fft.fft(blocks[finite & ~silent] * self._window), axes=1)) ** 2
        self._powers.append(power.reshape(-1, PARTS, _BINS // PARTS).sum(axis=2) / self._scale)

    def found(self) -> Found | None:
        """What was heard; None before the first block.

        The floor is that of most parts: what fills more than half of the band all the time counts as noise.
        """
        powers = np.concatenate(self._powers) if self._powers else np.empty((0, PARTS))
        if not len(powers):
            return None
        floor = float(np.median(np.quantile(powers, _QUIET, axis=0)))
        busy = (powers > STANDS_OUT * floor).mean(axis=0)
        return Found(len(powers), floor, powers.mean(axis=0), powers.max(axis=0), busy)


class Found(NamedTuple):
    """What was heard.

    :ivar blocks: number of blocks
    :ivar floor: power of the noise in a part; 1 is that of a carrier of full scale
    :ivar mean, peak: power in each part, on average and in the block where it was highest
    :ivar busy: share of the blocks in which each part is above the noise
    """

    blocks: int
    floor: float
    mean: NDArray[np.float64]
    peak: NDArray[np.float64]
    busy: NDArray[np.float64]


def check_listens(front_end: type[FrontEnd], phy: type[Phy]) -> None:
    """:raises ConfigError: for a front end that gives no samples of what is on the air"""
    if front_end.carries_packets or not phy.has_samples:
        what = "gives packets, and no samples"
    elif not front_end.hears_always:
        what = "gives samples of what other robots send, and none of what else is on the air"
    else:
        return
    raise ConfigError(f"front_end {front_end.name}: {what}; gr-ros2 spectrum needs soapy, uhd, pluto, audio or file")


class Listening:
    """Measures what the radios of a link hear.

    :param radios: those of the link
    """

    def __init__(self, radios: Sequence[OneRadio]) -> None:
        self._radios = radios
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._thread: threading.Thread | None = None
        self._resumes = False
        self._told: dict[str, Any] = {"state": "none"}

    def measure(self, for_s: float) -> None:
        """Begin to listen, for so many s.

        :raises ConfigError: where no front end gives samples, or another measurement goes on
        """
        sampled, refusals = [], []
        for one in self._radios:
            try:
                check_listens(type(one.front_end), type(one.phy))
                sampled.append(one)
            except ConfigError as refusal:
                refusals.append(refusal)
        if not sampled:
            raise refusals[0]
        with self._lock:
            if self._thread is not None and self._thread.is_alive():
                raise ConfigError("spectrum: somebody else listens now; ask again when that is over")
            self._told = {"state": "listens", "for_s": for_s}
            self._thread = threading.Thread(
                target=self._run, args=(sampled, for_s), name="gr-ros2-spectrum", daemon=True
            )
            self._thread.start()

    def look(self) -> dict[str, Any]:
        """What has come of it: ``state`` is none, listens, done or failed."""
        return self._told

    def overruled(self) -> None:
        """Somebody has switched sending; that holds."""
        self._resumes = False

    def close(self) -> None:
        """End it. Idempotent."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join()

    def _run(self, radios: Sequence[OneRadio], for_s: float) -> None:
        sending = [one for one in self._radios if one.radio.transmits]
        self._resumes = True
        for one in sending:
            one.radio.transmit(on=False)
        try:
            self._ended.wait(_SETTLE_S if sending else 0.0)
            heard = {one.name: Occupancy() for one in radios}
            self._hear(radios, heard, time.monotonic() + for_s)
            told = [_in_parts(one, heard[one.name], for_s) for one in radios]
            self._told = {"state": "done", "for_s": for_s, "radios": told}
        except RadioError as error:
            self._told = {"state": "failed", "words": str(error)}
        finally:
            if self._resumes and not self._ended.is_set():
                for one in sending:
                    one.radio.transmit(on=True)

    def _hear(self, radios: Sequence[OneRadio], heard: Mapping[str, Occupancy], end: float) -> None:
        before: dict[str, NDArray[np.complex64]] = {}
        while time.monotonic() < end and not self._ended.wait(_LOOK_S):
            for one in radios:
                samples = one.radio.samples()
                if samples is None or np.array_equal(samples, before.get(one.name, samples[:0]), equal_nan=True):
                    continue  # nothing has come since
                before[one.name] = samples
                heard[one.name].add(samples)


def _in_parts(one: OneRadio, heard: Occupancy, for_s: float) -> dict[str, Any]:
    """What one radio has heard.

    :raises RadioError: when it gave nothing that could be used
    """
    found = heard.found()
    if found is None:
        what = f"no samples but {heard.not_finite} blocks of no numbers" if heard.not_finite else "no samples, or zeros"
        raise RadioError(
            f"front_end {one.front_end.name}: {what} in {for_s:g} s; is the device plugged in, and its receiver on?"
        )
    rate, middle = one.phy.sample_rate, one.front_end.receive_frequency
    width = rate / PARTS
    low = (middle or 0.0) - rate / 2
    decibels = {name: _decibels(getattr(found, name)) for name in ("mean", "peak", "floor")}
    return {
        "radio": one.name,
        "front_end": one.front_end.name,
        "sample_rate": rate,
        "frequency": middle,
        "blocks": found.blocks,
        "zeros": heard.zeros,
        "not_finite": heard.not_finite,
        "noise_db": float(decibels["floor"]),
        "parts": [
            {"from_hz": low + n * width, "to_hz": low + (n + 1) * width, "mean_db": mean, "peak_db": peak, "busy": busy}
            for n, (mean, peak, busy) in enumerate(
                zip(decibels["mean"].tolist(), decibels["peak"].tolist(), found.busy.tolist(), strict=True)
            )
        ],
    }


def _decibels(power: Any) -> NDArray[np.float64]:
    return np.asarray(10 * np.log10(np.maximum(power, 1e-30)))
