"""What a front end hears while its robot is silent: power over frequency, and for which share of the time each part of
the band is above the noise.

Invariants: while it is measured, nothing is sent; afterwards the link sends again if it did before, unless somebody has
switched sending meanwhile. At most one measurement goes on; without one there is no thread.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gr_ros2.core.errors import ConfigError, RadioError
from gr_ros2.core.watch import Watch
from gr_ros2.phy import Phy
from gr_ros2.radio.front_end import FrontEnd
from gr_ros2.radio.occupancy import Occupancy, decibels, in_parts
from gr_ros2.radio.one_radio import OneRadio

_LOOK_S, _SETTLE_S = 0.01, 0.2
"""s between two looks, and until what was under way to the device has been sent."""


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
            self._hear(radios, heard, for_s)
            told = [_told(one, heard[one.name], for_s) for one in radios]
            self._told = {"state": "done", "for_s": for_s, "radios": told}
        except RadioError as error:
            self._told = {"state": "failed", "words": str(error)}
        finally:
            if self._resumes and not self._ended.is_set():
                for one in sending:
                    one.radio.transmit(on=True)

    def _hear(self, radios: Sequence[OneRadio], heard: Mapping[str, Occupancy], for_s: float) -> None:
        before: dict[str, NDArray[np.complex64]] = {}
        listened = Watch()
        while listened.age(inf, time.monotonic()) < for_s and not self._ended.wait(_LOOK_S):
            for one in radios:
                samples = one.radio.samples()
                if samples is None or np.array_equal(samples, before.get(one.name, samples[:0]), equal_nan=True):
                    continue  # nothing has come since
                before[one.name] = samples
                heard[one.name].add(samples)


def _told(one: OneRadio, heard: Occupancy, for_s: float) -> dict[str, Any]:
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
    return {
        "radio": one.name,
        "front_end": one.front_end.name,
        "sample_rate": rate,
        "frequency": middle,
        "blocks": found.blocks,
        "zeros": heard.zeros,
        "not_finite": heard.not_finite,
        "noise_db": float(decibels(found.floor)),
        "parts": in_parts(found, rate, middle or 0.0),
    }
