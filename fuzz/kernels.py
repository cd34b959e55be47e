"""The compiled kernels: whatever samples come, cut as they may be, they stay inside of them and give what was sent."""

from __future__ import annotations

import random
from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import numpy as np

from fuzz.loop import main
from gr_ros2.phy import PHY
from gr_ros2.phy.burst import Samples

SETTINGS: list[tuple[str, dict[str, Any]]] = [
    ("ofdm", {}),
    ("ofdm", {"payload_modulation": "64qam"}),
    ("ofdm", {"payload_modulation": "8psk", "fft_len": 128, "cp_len": 64}),
    ("ofdm", {"rate": "adaptive"}),
    ("psk", {"modulation": "8psk"}),
    ("psk", {"modulation": "bpsk", "sps": 2}),
    ("gfsk", {}),
    ("lora", {"coding_rate": 3}),
    *(("psk", {"fec": name}) for name in ("cc", "ldpc", "polar")),
]
PACKET_LEN = 20
BURSTS = 3
_STEP = 6
_VALUES = (np.nan, np.inf, -np.inf, 0.0, 1e-42, 1e30, 3e38, complex(np.nan, np.inf))
_SCALES = (0.0, 1e-30, 1e-6, 0.1, -1.0, 1j, 1e6, 1e18)
_MOST_STEPS = 12


@lru_cache
def stream(setting: int) -> tuple[Any, frozenset[bytes], Samples]:
    """A PHY, packets, and their bursts with little between them."""
    name, options = SETTINGS[setting]
    phy: Any = PHY.load(name)(PACKET_LEN, 1e6, **options)
    draw = random.Random(setting)
    packets = [draw.randbytes(PACKET_LEN) for _ in range(BURSTS)]
    parts = [np.zeros(150, np.complex64)]
    rates = phy.running_modem.rates
    for number, packet in enumerate(packets):
        mcs = rates[2 * number % len(rates)]
        parts += [mcs.modulate(packet), np.zeros(phy.gap, np.complex64)]
    whole = np.concatenate([*parts, np.zeros(300, np.complex64)])
    if phy.receiver_taps is not None:
        whole = np.convolve(whole, phy.receiver_taps)
    return phy, frozenset(packets), whole.astype(np.complex64)


def kernels(data: bytes) -> None:
    """A script: which setting, then what becomes of its samples, step by step, and how they are cut."""
    if not data:
        return
    phy, sent, samples = stream(data[0] % len(SETTINGS))
    modem = phy.running_modem
    with np.errstate(all="ignore"):
        for kind, place, value in steps(data[1:]):
            samples = changed(samples, kind, place, value)
            begin = int((place * 1.2 - 0.1) * len(samples))
            if modem is not phy.modem:  # numpy checks every index by itself, and raises past the samples
                anywhere(modem, samples[: 1 + value * len(samples) // 255], begin)
        engine = modem.receiver()
        cut = 1 + data[-1] * 37
        for at in range(0, len(samples), cut):
            assert sent.issuperset(heard.data for heard in engine.feed(np.ascontiguousarray(samples[at : at + cut])))
        assert engine.damaged <= 1 + len(samples)


def anywhere(modem: Any, samples: Samples, start: int) -> None:
    """Every call on samples that need not hold a burst, at a place that need not be among them."""
    samples = samples.copy()  # of its own, so that what is behind it is not ours
    found = modem.find(samples)
    assert 0 <= found.searched <= len(samples)
    assert found.start is None or -2 * modem.preamble_samples < found.start < len(samples)
    for place in (start, found.start):
        if place is not None:
            reading = modem.read(samples, place)
            if reading is not None and reading.soft is None:
                assert reading.end > len(samples)
            elif reading is not None:
                assert len(reading.soft) >= modem.rates[reading.mcs].frames.bits(reading.length)


def steps(data: bytes) -> Iterator[tuple[int, float, int]]:
    for at in range(0, min(len(data), _MOST_STEPS * _STEP) - _STEP + 1, _STEP):
        yield data[at] % 7, int.from_bytes(data[at + 1 : at + 5], "little") / 2**32, data[at + 5]


def changed(samples: Samples, kind: int, place: float, value: int) -> Samples:
    """One change: a value, silence, another strength, a piece cut out or put in twice, noise, or another carrier."""
    at = int(place * len(samples))
    length = min(len(samples) - at, 1 + value * 8)
    samples = samples.copy()
    if kind == 0:
        samples[at : at + 1 + value % 3] = _VALUES[value % len(_VALUES)]
    elif kind == 1:
        samples[at : at + length] = 0
    elif kind == 2:
        samples[at:] *= np.complex64(_SCALES[value % len(_SCALES)])
    elif kind == 3:
        samples = np.delete(samples, slice(at, at + length))
    elif kind == 4:
        samples = np.insert(samples, at, samples[at : at + length])
    elif kind == 5:
        draw = np.random.default_rng(value)
        samples += (draw.standard_normal((len(samples), 2)) * value / 64).astype(np.float32).view(np.complex64)[:, 0]
    else:
        samples *= np.exp(1j * np.arange(len(samples)) * (value - 128) / 400).astype(np.complex64)
    return samples


def corpus() -> list[bytes]:
    """Every setting, untouched and with each kind of change."""
    draw = random.Random(5)
    scripts = []
    for setting in range(len(SETTINGS)):
        scripts.append(bytes([setting, 255]))
        for kind in range(7):
            for _ in range(2):
                step = [bytes([kind]) + draw.randbytes(_STEP - 1) for _ in range(draw.choice((1, 2, 4)))]
                scripts.append(bytes([setting]) + b"".join(step) + draw.randbytes(1))
    return scripts


if __name__ == "__main__":
    main(kernels, corpus())
