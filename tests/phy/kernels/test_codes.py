"""The compiled decoders: they decode what GNU Radio's encoders make, and leave Python's lock to other threads."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any, get_args

import numpy as np
import pytest

from gr_ros2.phy import PHY
from gr_ros2.phy.fec import CodeName, Codes
from gr_ros2.phy.kernels import codes, library
from gr_ros2.phy.kernels.codes import CompiledDecoders
from tests.phy.kernels.support import VARIANTS, variant
from tests.waiting import wait_for

CODES = [name for name in get_args(CodeName) if name != "none"]
SIZES = (144, 152, 153, 544, 902, 903, 1281)
NEVER_S = 1000.0


@pytest.fixture(params=VARIANTS)
def functions(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Any:
    found = variant(request.param)
    monkeypatch.setattr(codes, "loaded", lambda: library.Loaded(found, "under test"))
    return found


def heard(sent: np.ndarray, eb_n0_db: float, rate: float, seed: int) -> np.ndarray:
    """Log-likelihood ratios of bits that crossed white noise."""
    variance = 1 / (2 * rate * 10 ** (eb_n0_db / 10))
    noise = np.random.default_rng(seed).standard_normal(len(sent)) * variance**0.5
    return np.asarray(2 * (2.0 * sent - 1 + noise) / variance, np.float32)


@pytest.mark.usefixtures("functions")
@pytest.mark.parametrize("name", CODES)
def test_they_correct_at_least_what_the_decoders_of_gnu_radio_correct(name: Any) -> None:
    ours, theirs = Codes(name, CompiledDecoders()), Codes(name)
    right = {"ours": 0, "theirs": 0}
    for bits in SIZES:
        one, other = ours.of(bits), theirs.of(bits)
        for seed in range(10):
            data = np.random.default_rng(seed).integers(0, 2, bits).astype(np.uint8)
            sent = other.encode(data)
            soft = heard(sent, 3.0 if seed % 2 else 30.0, bits / len(sent), seed)
            right["ours"] += np.array_equal(one.decode(soft), data)
            right["theirs"] += np.array_equal(other.decode(soft), data)
    assert right["ours"] >= right["theirs"] >= 5 * len(SIZES)


@pytest.mark.usefixtures("functions")
@pytest.mark.parametrize("name", CODES)
@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, -np.inf, 1e30])
def test_whatever_the_soft_bits_there_is_a_result(name: Any, value: float) -> None:
    code = Codes(name, CompiledDecoders()).of(903)
    with np.errstate(all="ignore"):
        found = code.decode(np.full(code.coded_bits, value, np.float32))
    assert len(found) == 903
    assert set(found) <= {0, 1}


def test_another_number_of_soft_bits_is_refused() -> None:
    with pytest.raises(ValueError, match="7 soft values; this decoder takes 300"):
        CompiledDecoders().convolutional(144)(np.zeros(7, np.uint8))


def test_the_setting_chooses() -> None:
    variant("_baseline")
    frames = {name: PHY.load("psk")(64, 1e6, fec="cc", kernels=name).modem.frames for name in ("auto", "numpy")}
    data = np.random.default_rng(1).integers(0, 2, 544).astype(np.uint8)
    for made in frames.values():
        packet = bytes(data[:64])
        assert made.of(64).unwrap(8 * (2.0 * made.of(64).wrap(packet) - 1).astype(np.float32)) == packet
    assert isinstance(frames["auto"].decoders, CompiledDecoders)
    assert not isinstance(frames["numpy"].decoders, CompiledDecoders)


class Watched:
    """Functions of the library; counts the calls during which another thread got Python's lock."""

    def __init__(self, functions: Any) -> None:
        self._functions = functions
        self._begun = threading.Semaphore(0)
        self._inside = self._ended = False
        self.shared = 0

    def __getattr__(self, name: str) -> Any:
        def call(*arguments: Any) -> Any:
            self._inside = True
            self._begun.release()  # wakes the other thread, which then waits for Python's lock
            result = getattr(self._functions, name)(*arguments)
            self._inside = False
            return result

        return call

    def look(self) -> None:
        """What the other thread does."""
        while not self._ended:
            self._begun.acquire()
            self.shared += self._inside

    def end(self) -> None:
        self._ended = True
        self._begun.release()


@pytest.fixture
def watched(functions: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[Watched]:
    """With threads that hand Python's lock over only where a call releases it."""
    made = Watched(functions)
    monkeypatch.setattr(codes, "loaded", lambda: library.Loaded(made, "under test"))
    interval, thread = sys.getswitchinterval(), threading.Thread(target=made.look)
    sys.setswitchinterval(NEVER_S)
    thread.start()
    try:
        yield made
    finally:
        made.end()
        thread.join()
        sys.setswitchinterval(interval)


def long_call(name: str) -> Callable[[], object]:
    """A decoding that takes some milliseconds."""
    if name == "polar":
        decode = CompiledDecoders().polar(1 << 17, list(range(1 << 16)))
        return lambda: decode(np.ones(1 << 17, np.float32))
    code = Codes(name, CompiledDecoders()).of({"cc": 400_000, "ldpc": 902}[name])  # type: ignore[arg-type]
    return lambda: code.decode(heard(np.ones(code.coded_bits), -20.0, 0.5, 0))


@pytest.mark.parametrize("name", CODES)
def test_other_threads_run_while_they_decode(name: str, watched: Watched) -> None:
    decode = long_call(name)

    def shared() -> int:
        decode()
        return watched.shared

    wait_for(shared, f"another thread that gets Python's lock while {name} is decoded")
