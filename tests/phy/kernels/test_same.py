"""Compiled kernels and numpy are fed the same samples: same packets, same moments, same damage, same soft bits."""

from __future__ import annotations

import pickle
import random
import threading
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np
import pytest

from gr_ros2.phy.burst import BurstModem, Samples
from gr_ros2.phy.theory import half_point
from tests.phy.kernels.support import IDS, SETTINGS, VARIANTS, hear, make, variant, with_kernel
from tests.phy.test_burst import bursts, delayed, noise
from tests.phy.test_burst import received_by as received

NAMES: list[tuple[str, dict[str, Any]]] = [("ofdm", {}), ("psk", {}), ("gfsk", {}), ("lora", {})]
EXACT = 1e-3
"""By how much a soft bit may differ, of the typical one of its burst: single precision and another order of sums."""


@pytest.fixture(params=VARIANTS)
def functions(request: pytest.FixtureRequest) -> Any:
    return variant(request.param)


@pytest.fixture
def every() -> list[Any]:
    """The functions of all variants that this machine has."""
    found = []
    for name in VARIANTS:
        with suppress(pytest.skip.Exception):
            found.append(variant(name))
    return found or pytest.skip("no variant was built")


def all_of(
    name: str, options: dict[str, Any], every: list[Any], monkeypatch: pytest.MonkeyPatch
) -> tuple[Any, list[BurstModem]]:
    """A PHY in numpy, and its modem on each variant."""
    phy = make(name, options)
    return phy, [with_kernel(phy.modem, functions, monkeypatch) for functions in every]


def both(name: str, options: dict[str, Any], functions: Any, monkeypatch: pytest.MonkeyPatch) -> tuple[Any, BurstModem]:
    phy = make(name, options)
    return phy, with_kernel(phy.modem, functions, monkeypatch)


def impaired(phy: Any, count: int, snr_db: float, seed: int) -> tuple[list[bytes], np.ndarray]:
    """Bursts between samples, with carrier offset and noise, before the receiver's filter."""
    packets, samples = bursts(phy, count, seed)
    moved = delayed(samples, 0.3) * np.exp(2j * np.pi * 0.003 * np.arange(len(samples)))
    return packets, moved + noise(len(moved), snr_db, seed) * phy.burst_power() ** 0.5


def each_burst(modem: BurstModem, samples: Samples) -> Iterator[int]:
    """Reference samples of bursts, one behind the other."""
    at = modem.margin
    while True:
        stretch = samples[at : at + modem.preamble_samples + modem.stretch]
        found = modem.find(stretch)
        if found.start is not None:
            yield at + found.start
            at += found.start + modem.peak_samples
        elif not found.searched:
            return
        at += found.searched if found.start is None else 0


@pytest.mark.parametrize(("name", "options"), SETTINGS, ids=IDS)
def test_same_packets_at_the_same_sample_and_the_same_damage(
    name: str, options: dict[str, Any], every: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    phy, modems = all_of(name, options, every, monkeypatch)
    count = 4 if name == "lora" else 6
    middle = half_point(phy.computed_pdr)
    draw = random.Random(5)
    for seed, snr_db in enumerate((middle + 0.7, middle + 3, middle + 20)):
        packets, samples = impaired(phy, count, snr_db, seed)
        cuts = [draw.randrange(1, 5000) for _ in range(20)]
        stream = received(phy, samples)
        heard = hear(phy.modem, stream, cuts)
        assert [hear(fast, stream, cuts) for fast in modems] == [heard] * len(modems)
    assert [packet for _, packet in heard.packets] == packets


@pytest.mark.parametrize(("name", "options"), SETTINGS, ids=IDS)
def test_same_soft_bits_within_rounding(
    name: str, options: dict[str, Any], functions: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    phy, fast = both(name, options, functions, monkeypatch)
    read = 0
    for snr_db in (half_point(phy.computed_pdr) + 1, 20):
        _, samples = impaired(phy, 3, snr_db, 1)
        stream = received(phy, samples)
        for start in each_burst(phy.modem, stream):
            if start + phy.modem.burst_samples > len(stream):
                break
            head = stream[: start + phy.modem.span]
            cut = [modem.read(head, start) for modem in (phy.modem, fast)]
            wanted, found = phy.modem.read(stream, start), fast.read(stream, start)
            if wanted is None:
                assert found is None
                continue
            assert found is not None
            assert wanted.soft is not None
            assert found.soft is not None
            for reading in cut if len(head) < wanted.end else ():
                assert reading is not None
                assert reading.soft is None
                assert (reading.length, reading.mcs, reading.end) == (wanted.length, wanted.mcs, wanted.end)
            typical = float(np.abs(wanted.soft).mean())
            assert np.abs(found.soft - wanted.soft).max() <= EXACT * typical
            assert np.abs(found.points - wanted.points).max() <= EXACT * np.abs(wanted.points).max()
            assert found.snr == pytest.approx(wanted.snr, rel=EXACT)
            read += 1
    assert read >= 3


def close(samples: Samples, wanted: Samples) -> bool:
    """Whether samples are the same but for rounding."""
    return len(samples) == len(wanted) and bool(np.abs(samples - wanted).max() <= 1e-5 * np.abs(wanted).max())


@pytest.mark.parametrize(("name", "options"), SETTINGS, ids=IDS)
def test_same_with_packets_of_all_lengths(
    name: str, options: dict[str, Any], every: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    phy, modems = all_of(name, options, every, monkeypatch)
    draw = random.Random(8)
    rates = list(zip(phy.modem.rates, *(fast.rates for fast in modems), strict=True))
    packets = [draw.randbytes(length) for length in (1, 64, 13, 40, 2, 33, 7, 58)]
    parts = []
    for number, packet in enumerate(packets):
        mcs, *fast_ones = rates[number % len(rates)]
        wanted = mcs.modulate(packet)
        for fast_mcs in fast_ones:
            assert close(fast_mcs.modulate(packet), wanted)
        parts += [wanted, np.zeros(phy.gap)]
    samples = delayed(np.concatenate((np.zeros(400), *parts, np.zeros(400))), 0.3)
    for snr_db in (half_point(phy.computed_pdr), 40):
        stream = received(phy, samples + noise(len(samples), snr_db, 3) * phy.burst_power() ** 0.5)
        cuts = [draw.randrange(1, 3000) for _ in range(20)]
        heard = hear(phy.modem, stream, cuts)
        assert [hear(fast, stream, cuts) for fast in modems] == [heard] * len(modems)
    assert [packet for _, packet in heard.packets] == packets


@pytest.mark.parametrize(("name", "options"), SETTINGS, ids=IDS)
def test_same_samples_are_sent(
    name: str, options: dict[str, Any], functions: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    phy, fast = both(name, options, functions, monkeypatch)
    packet = random.Random(1).randbytes(64)
    wanted = phy.modem.modulate(packet)
    assert close(fast.modulate(packet), wanted)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
@pytest.mark.parametrize(("name", "options"), NAMES, ids=str)
def test_same_with_a_sample_that_is_no_number(
    name: str, options: dict[str, Any], value: float, every: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    phy, modems = all_of(name, options, every, monkeypatch)
    packets, samples = bursts(phy, 12)
    clean = received(phy, samples)
    length, draw = phy.airtime_samples(), random.Random(3)
    for at in (10, length // 2, length - 20):
        stream = clean.copy()
        for burst in (2, 5):
            stream[400 + burst * length + at] = value
        cuts = [draw.randrange(1, 5000) for _ in range(20)]
        with np.errstate(all="ignore"):
            heard = hear(phy.modem, stream, cuts)
            assert [hear(fast, stream, cuts) for fast in modems] == [heard] * len(modems)
        assert [packet for _, packet in heard.packets][-3:] == packets[-3:]


@pytest.mark.parametrize(("name", "options"), NAMES, ids=str)
def test_same_with_bursts_that_are_cut(
    name: str, options: dict[str, Any], functions: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    phy, fast = both(name, options, functions, monkeypatch)
    packets, samples = impaired(phy, 12, 25, 4)
    length, draw = phy.airtime_samples(), random.Random(4)
    for burst in (1, 4, 7):  # the middle, the beginning, a piece that is not there at all
        first, last = {1: (0.4, 0.8), 4: (0.0, 0.1), 7: (0.3, 0.5)}[burst]
        samples[400 + burst * length + int(first * length) : 400 + burst * length + int(last * length)] = 0
    gone = 400 + 9 * length + length // 3
    stream = received(phy, np.delete(samples, slice(gone, gone + length // 4)))[: -length // 2]
    cuts = [draw.randrange(1, 5000) for _ in range(20)]
    heard = hear(phy.modem, stream, cuts)
    assert hear(fast, stream, cuts) == heard
    assert packets[2] in [packet for _, packet in heard.packets]
    assert packets[-1] not in [packet for _, packet in heard.packets]


@pytest.mark.parametrize(("name", "options"), NAMES, ids=str)
def test_same_with_a_burst_whose_beginning_was_missed(
    name: str, options: dict[str, Any], functions: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So the place where it began may lie before the first sample there is."""
    phy, fast = both(name, options, functions, monkeypatch)
    _, samples = impaired(phy, 2, 25, 2)
    for missed in range(400, 480, 4):
        stream = received(phy, samples[missed:])
        found = phy.modem.find(stream)
        assert fast.find(stream) == found
        if found.start is not None and name == "ofdm":
            wanted, got = phy.modem.read(stream, found.start), fast.read(stream, found.start)
            assert np.abs(got.soft - wanted.soft).max() <= EXACT * np.abs(wanted.soft).mean()
        assert hear(fast, stream, [700]) == hear(phy.modem, stream, [700])
    if name == "ofdm":
        assert any((phy.modem.find(received(phy, samples[missed:])).start or 0) < 0 for missed in range(400, 480, 4))


@pytest.mark.parametrize(("name", "options"), NAMES, ids=str)
def test_same_in_noise_alone(
    name: str, options: dict[str, Any], functions: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    phy, fast = both(name, options, functions, monkeypatch)
    stream = noise(300_000, 0, seed=9).astype(np.complex64)
    assert hear(fast, stream, [8192]) == hear(phy.modem, stream, [8192])


@pytest.mark.parametrize(("name", "options"), NAMES, ids=str)
def test_threads_do_not_meet_in_one_kernel(
    name: str, options: dict[str, Any], functions: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    phy, fast = both(name, options, functions, monkeypatch)
    streams = [received(phy, impaired(phy, 6, 25, seed)[1]) for seed in range(4)]
    wanted = [hear(fast, stream, [3000]) for stream in streams]
    assert all(len(heard.packets) == 6 for heard in wanted)
    found: list[Any] = [None] * len(streams)

    def run(number: int) -> None:
        found[number] = [hear(fast, streams[number], [3000]) for _ in range(5)]

    threads = [threading.Thread(target=run, args=(number,)) for number in range(len(streams))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [[heard] * 5 for heard in wanted]


@pytest.mark.parametrize(("name", "options"), SETTINGS, ids=IDS)
def test_bursts_made_in_one_call_are_those_made_one_by_one(
    name: str, options: dict[str, Any], functions: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    phy, fast = both(name, options, functions, monkeypatch)
    draw, gap = random.Random(1), 5
    packets = [draw.randbytes(length) for length in (64, 1, 13, 64)]
    one_by_one = [np.append(phy.modem.modulate(packet), np.zeros(gap)) for packet in packets]
    for modem in (phy.modem, fast):
        out = np.full(sum(map(len, one_by_one)) + 3, 7, np.complex64)
        modem.modulate_into(packets, gap, out)
        assert np.abs(out - np.concatenate((*one_by_one, [7, 7, 7]))).max() < EXACT


@pytest.mark.parametrize("options", [{}, {"fec": "cc"}], ids=str)
def test_all_packets_of_one_piece_come_out_whatever_their_number(
    options: dict[str, Any], functions: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    phy, fast = both("ofdm", options, functions, monkeypatch)
    packets, samples = impaired(phy, 100, 25, 3)
    begin = 400 + 50 * phy.airtime_samples()
    samples[begin + 600 : begin + phy.airtime_samples()] = 0  # the second half of a burst
    engine, reference = fast.receiver(), phy.modem.receiver()
    piece = received(phy, samples)
    found, wanted = engine.feed(piece), reference.feed(piece)
    assert [heard.data for heard in found] == [heard.data for heard in wanted] == packets[:50] + packets[51:]
    assert [heard.snr for heard in found] == pytest.approx([heard.snr for heard in wanted], rel=EXACT)
    assert engine.damaged == reference.damaged
    assert engine.snr_db == pytest.approx(reference.snr_db, abs=0.01)
    assert np.abs(engine.points - reference.points).max() < EXACT


def test_a_compiled_modem_reaches_another_process_by_its_constants(
    functions: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    phy, fast = both("ofdm", {}, functions, monkeypatch)
    stream = received(phy, impaired(phy, 3, 25, 0)[1])
    heard = hear(fast, stream, [900])
    assert len(heard.packets) == 3
    assert hear(pickle.loads(pickle.dumps(fast)), stream, [900]) == heard


def test_parameters_of_another_version_are_refused(functions: Any) -> None:
    assert functions.modem_new(0, 0, 1) is None
    assert functions.modem_new(99, 0, 1) is None
