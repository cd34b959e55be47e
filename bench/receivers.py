"""Burst receivers: processor time beside that of FFTs over as many samples, and whether compiled ones hear as far.

An FFT is what costs on every machine about as much per sample: rows of 64 by numpy, in the same run. Beside them stand
receivers by others, GNU Radio's own.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from gnuradio import blocks, digital, gr

from bench.rows import Row
from gr_ros2.phy import PHY
from gr_ros2.phy.burst import BurstModem, Samples
from gr_ros2.phy.kernels import which
from gr_ros2.phy.theory import half_point
from gr_ros2.phy.threads import run_flowgraph

SNR_DB = 30.0
PACKETS, LONG_PACKETS = 60, 12
PIECE = 8192
"""Samples given at a time, as GNU Radio's scheduler does."""
REPEATS = 15
Setting = tuple[str, dict[str, Any], int]
TARGETS: list[tuple[Setting, float]] = [
    (("ofdm", {}, 64), 5),
    (("ofdm", {}, 1500), 3),
    (("ofdm", {"payload_modulation": "64qam"}, 1500), 9.5),
    (("psk", {}, 64), 5),
    (("gfsk", {}, 64), 4.5),
    (("lora", {}, 64), 4.5),
]
NOISE_TARGET = 1.8
CODES = ("none", "cc", "ldpc", "polar")
MODULATIONS: Mapping[str, Sequence[dict[str, Any]]] = {
    "ofdm": [{"payload_modulation": name} for name in ("bpsk", "qpsk", "8psk", "16qam", "64qam")],
    "psk": [{"modulation": name} for name in ("bpsk", "qpsk", "8psk")],
    "gfsk": [{}],
    "lora": [{}],
}
NEAR_DB = 0.1
"""By how much the half points of both may differ."""
_STEPS_DB = (-0.6, 0.0, 0.6)
_HALF_PACKETS, _HALF_PACKETS_LORA = 100, 30


def receivers() -> list[Row]:
    """Processor time of every receiver over that of the FFTs."""
    rows = [Row(f"receivers: {which('auto')}", 0.0, form="")]
    for (name, options, packet_len), target in TARGETS:
        phy = PHY.load(name)(packet_len, 1e6, **options)
        count = LONG_PACKETS if phy.airtime_samples() > 10_000 else PACKETS
        samples = heard(phy, count, SNR_DB)
        rows.append(_row(phy, f"{_label(name, options)}, {packet_len} B", samples, count, target))
    ofdm = PHY.load("ofdm")(64, 1e6)
    noise = _noise(PACKETS * ofdm.airtime_samples(), 1)
    return [*rows, _row(ofdm, "ofdm, noise only", noise, 0, NOISE_TARGET), *_others()]


def _row(phy: Any, what: str, samples: Samples, packets: int, target: float) -> Row:
    """Of the modem as it runs, with numpy's beside it."""
    fft, compiled, plain = float("inf"), float("inf"), float("inf")
    for number in range(REPEATS):
        fft = min(fft, _ffts(samples))
        compiled = min(compiled, _time(lambda: _receive(phy.running_modem, samples)))
        if number < 4:
            plain = min(plain, _time(lambda: _receive(phy.modem, samples)))
    scale, unit = (1e6 / packets, "µs a packet") if packets else (1e9 / len(samples), "ns a sample")
    note = f"{compiled * scale:.3g} {unit}, numpy {plain * scale:.3g} ({plain / fft:.0f}), FFT {fft * scale:.2g}"
    if packets:
        assert len(_receive(phy.running_modem, samples)) == packets
    return Row(f"{what}: receiver over FFT", compiled / fft, "", "≤", target, "{:.1f}", note)


def _others() -> Iterator[Row]:
    """GNU Radio's OFDM receiver, and its GFSK demodulator, which gives bits and no packets."""
    stock = PHY.load("ofdm")(64, 1e6, detection_threshold="stock")
    own = PHY.load("ofdm")(64, 1e6, gap=stock.gap)
    yield _other("GNU Radio's OFDM blocks, 64 B", heard(own, PACKETS, SNR_DB), lambda: [stock.receiver()])
    gfsk = PHY.load("gfsk")(64, 1e6)
    bits = lambda: [digital.gfsk_demod(samples_per_symbol=4), blocks.null_sink(1)]  # noqa: E731
    yield _other("GNU Radio's gfsk_demod, 64 B", heard(gfsk, PACKETS, SNR_DB, filtered=False), bits)


def _other(what: str, samples: Samples, made: Callable[[], list[Any]]) -> Row:
    """Of a flowgraph, less one that only moves the samples."""
    fft = min(_ffts(samples) for _ in range(REPEATS))
    took = min(_flowgraph(samples, made()) for _ in range(5))
    idle = min(_flowgraph(samples, [blocks.null_sink(gr.sizeof_gr_complex)]) for _ in range(5))
    each = (took - idle) / PACKETS
    return Row(f"{what}: receiver over FFT", (took - idle) / fft, form="{:.1f}", note=f"{each * 1e6:.3g} µs a packet")


def _flowgraph(samples: Samples, parts: Sequence[Any]) -> float:
    """Processor time of the whole process, s."""
    top = gr.top_block()
    top.connect(blocks.vector_source_c(samples), *parts)
    begin = time.process_time()
    run_flowgraph(top)
    took = time.process_time() - begin
    for part in parts:
        if hasattr(part, "release"):
            part.release()
    return took


def half_points() -> list[Row]:
    """Every PHY, modulation and code: how far the compiled half point lies from numpy's, on equal samples."""
    rows = []
    for name, modulations in MODULATIONS.items():
        for options in modulations:
            for code in CODES:
                phy = PHY.load(name)(64, 1e6, fec=code, **options)
                rows.append(_half_point(phy, f"{_label(name, options)} {code}"))
    return rows


def _half_point(phy: Any, what: str) -> Row:
    """Both half points from the shares at three SNRs around it, on lines between them."""
    count = _HALF_PACKETS_LORA if phy.name == "lora" else _HALF_PACKETS
    middle, ours, plain = half_point(phy.computed_pdr), {}, {}
    at = middle
    for _ in range(8):  # the receiver's own half point, from the computed one on
        if (share := len(_receive(phy.running_modem, heard(phy, 30, at))) / 30) and 0.2 < share < 0.8:
            break
        at += 0.5 if share < 0.5 else -0.5
    different = 0
    for step in _STEPS_DB:
        samples = heard(phy, count, at + step)
        found, wanted = (_receive(modem, samples) for modem in (phy.running_modem, phy.modem))
        different += len(set(found) ^ set(wanted))
        ours[step], plain[step] = len(found) / count, len(wanted) / count
    slope = max((plain[_STEPS_DB[-1]] - plain[_STEPS_DB[0]]) / (_STEPS_DB[-1] - _STEPS_DB[0]), 0.1)
    off = abs(sum(ours.values()) - sum(plain.values())) / len(_STEPS_DB) / slope
    shares = ", ".join(f"{share:.2f}" for share in plain.values())
    note = f"numpy {shares} at {at:.1f} dB and {_STEPS_DB[-1]} beside; {different} of {3 * count} packets differ"
    return Row(f"{what}: half point off numpy's", off, "dB", "≤", NEAR_DB, "{:.2f}", note)


def heard(phy: Any, count: int, snr_db: float, *, filtered: bool = True) -> Samples:
    """Bursts of random packets with a carrier offset in noise, as the modem gets them."""
    draw = random.Random(count)
    parts = [np.zeros(400)]
    for _ in range(count):
        parts += [phy.modem.modulate(draw.randbytes(phy.packet_len)), np.zeros(phy.gap)]
    samples = np.concatenate([*parts, np.zeros(400)])
    samples = samples * np.exp(2j * np.pi * 0.002 * np.arange(len(samples)))
    samples = samples + _noise(len(samples), 2) * (phy.burst_power() / 10 ** (snr_db / 10)) ** 0.5
    if filtered and phy.receiver_taps is not None:
        samples = np.convolve(samples, phy.receiver_taps)
    return np.asarray(samples, np.complex64)


def _noise(count: int, seed: int) -> Samples:
    draw = np.random.default_rng(seed)
    return np.asarray((draw.standard_normal(count) + 1j * draw.standard_normal(count)) * 0.5**0.5, np.complex64)


def _receive(modem: BurstModem, samples: Samples) -> list[bytes]:
    engine = modem.receiver()
    return [heard.data for at in range(0, len(samples), PIECE) for heard in engine.feed(samples[at : at + PIECE])]


def _ffts(samples: Samples) -> float:
    rows = samples[: len(samples) // 64 * 64].reshape(-1, 64)
    return _time(lambda: np.fft.fft(rows))


def _time(work: Callable[[], Any]) -> float:
    """Processor time of this thread, s."""
    begin = time.thread_time()
    work()
    return time.thread_time() - begin


def _label(name: str, options: dict[str, Any]) -> str:
    return " ".join([name, *map(str, options.values())])
