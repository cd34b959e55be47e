"""The variants of the library that this machine has, and streams that both implementations are fed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest

from gr_ros2.phy import PHY
from gr_ros2.phy.burst import BurstModem, Samples
from gr_ros2.phy.kernels import library as libraries
from gr_ros2.phy.kernels import modem as compiled

VARIANTS = ("_baseline", "_avx2")
SETTINGS: list[tuple[str, dict[str, Any]]] = [
    ("ofdm", {}),
    *(("ofdm", {"payload_modulation": name}) for name in ("qpsk", "8psk", "16qam", "64qam")),
    *(("ofdm", {"fec": name}) for name in ("cc", "ldpc", "polar")),
    ("ofdm", {"payload_modulation": "64qam", "fec": "cc"}),
    ("ofdm", {"rate": "adaptive"}),
    ("ofdm", {"rate": "adaptive", "rates": ("qpsk-cc", "64qam-cc"), "fft_len": 128, "scramble": True}),
    ("ofdm", {"fft_len": 256, "scramble": True}),
    ("ofdm", {"fft_len": 512, "cp_len": 256, "payload_modulation": "16qam"}),
    ("ofdm", {"carriers": 25, "pilots": (-24, -8, 8, 24), "detection_threshold": 0.5}),
    *(("psk", {"modulation": name}) for name in ("bpsk", "qpsk", "8psk")),
    ("psk", {"modulation": "bpsk", "sps": 2, "rolloff": 0.2}),
    *(("psk", {"fec": name}) for name in ("cc", "ldpc", "polar")),
    ("gfsk", {}),
    ("gfsk", {"sps": 2, "bt": 0.3}),
    *(("gfsk", {"fec": name}) for name in ("cc", "ldpc", "polar")),
    ("lora", {}),
    ("lora", {"spreading_factor": 9, "coding_rate": 3}),
    ("lora", {"coding_rate": 1, "fec": "cc"}),
]
IDS = ["-".join([name, *(f"{key}={value}" for key, value in options.items())]) for name, options in SETTINGS]


def variant(name: str) -> Any:
    """The functions of one variant; skips where it was not built or does not run here."""
    path = libraries._file(libraries._FOLDER, name)
    if path is None:
        pytest.skip(f"{name} was not built: no C++ compiler, or another architecture")
    functions = libraries._open(path)
    if name == "_avx2" and not functions.kernels_has_avx2():
        pytest.skip("this processor has no AVX2")
    return functions


def with_kernel(reference: BurstModem, functions: Any, monkeypatch: pytest.MonkeyPatch) -> BurstModem:
    """The compiled modem on a given variant."""
    monkeypatch.setattr(compiled, "loaded", lambda: libraries.Loaded(functions, "under test"))
    return compiled.CompiledModem(reference)


def make(name: str, options: dict[str, Any], packet_len: int = 64) -> Any:
    return PHY.load(name)(packet_len, 1e6, kernels="numpy", **options)


@dataclass(frozen=True)
class Heard:
    """What a receiver made of a stream.

    :param packets: each with the number of samples given when it left
    :param damaged: bursts
    """

    packets: list[tuple[int, bytes]]
    damaged: int


def hear(modem: BurstModem, samples: Samples, cuts: list[int]) -> Heard:
    """Feed a stream in pieces of these lengths, in turn."""
    engine, at, number, packets = modem.receiver(), 0, 0, []
    while at < len(samples):
        piece = samples[at : at + cuts[number % len(cuts)]]
        at += len(piece)
        number += 1
        packets += [(at, heard.data) for heard in engine.feed(piece)]
    return Heard(packets, engine.damaged)
