"""The adaptive rate of `ofdm` on samples: headers name the MCS, and a damaged one lets nothing wrong through."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.core.errors import ConfigError
from gr_ros2.link.events import AirPacket
from gr_ros2.phy import PHY
from gr_ros2.phy.burst import DemodulatedPacket, Samples
from gr_ros2.phy.flowgraph import Flowgraph
from gr_ros2.phy.length_word import LENGTHS, RATES, WORD_BITS, LengthWord, header_bits, header_crc, mcs_mark
from gr_ros2.phy.ofdm import RATES as MCS_TABLE
from gr_ros2.phy.pdus import packets_of, pdu_to_send
from tests.gr.probe import Probe
from tests.phy.test_burst import noise
from tests.waiting import wait_for

LONGEST = 40
HEADER = 2
"""Number of the header's symbol."""


@lru_cache
def adaptive(kernels: str = "auto") -> Any:
    return PHY.load("ofdm")(LONGEST, 1e6, rate="adaptive", kernels=kernels)


def heard(phy: Any, *bursts: Samples) -> list[DemodulatedPacket]:
    silence = np.zeros(400, np.complex64)
    return phy.running_modem.receiver().feed(np.concatenate([silence, *bursts, silence, silence]))


def with_header(phy: Any, burst: Samples, change: Any) -> Samples:
    """A burst with other points on the data carriers of its header.

    :param change: factors on the points
    """
    layout, symbol = phy.layout, phy.layout.symbol_samples
    carriers = np.array(layout.data[0]) % layout.fft_len
    spectrum = np.fft.fft(burst[HEADER * symbol + layout.cp_len : (HEADER + 1) * symbol])
    spectrum[carriers] *= change
    body = np.fft.ifft(spectrum)
    changed = burst.copy()
    changed[HEADER * symbol : (HEADER + 1) * symbol] = np.concatenate((body[-layout.cp_len :], body))
    return changed


def test_with_all_lengths_and_rates_any_two_headers_differ_in_8_bits() -> None:
    fields = np.arange(LENGTHS)
    zero = header_bits([0], np.array([0]))[0]
    least = []
    for mcs in range(RATES):
        words = LengthWord(range(LENGTHS), fields.tolist(), mcs_mark(mcs)).bits ^ zero
        weights = words.sum(axis=1)
        least.append(int(weights[weights > 0].min()))
    # Words, without the constant of the CRC, are a linear code: the least weight is the least distance.
    assert min(least) == 8


def test_a_header_keeps_the_format_of_the_blocks_of_gnuradio() -> None:
    weights = 1 << np.arange(WORD_BITS, dtype=np.int64)
    for mcs, modem in enumerate(adaptive().modem.rates):
        for length in (1, 13, LONGEST):
            word = int(modem.headers[length - 1].astype(np.int64) @ weights)
            size, number, check = word & 0xFFF, word >> 12 & 0xFFF, word >> 24
            assert size == length + 4
            assert check == header_crc(size, number)
            assert mcs or modem.headers[length - 1].tolist() == fixed_word(length)


def fixed_word(length: int) -> list[int]:
    """The header of a link with a fixed rate, whose bursts hold no filling."""
    bits: list[int] = PHY.load("ofdm")(LONGEST, 1e6).modem.headers[length - 1].tolist()
    return bits


@pytest.mark.parametrize("kernels", ["auto", "numpy"])
def test_every_rate_and_length_is_read_in_one_stream(kernels: str) -> None:
    phy = adaptive(kernels)
    sent, bursts = [], []
    for number in range(3 * len(phy.mcs_table)):
        packet, mcs = bytes([number]) * (1 + number * 7 % LONGEST), number % len(phy.mcs_table)
        sent.append((packet, mcs))
        bursts += [phy.running_modem.rates[mcs].modulate(packet), np.zeros(phy.gap, np.complex64)]
    found = heard(phy, *bursts)
    assert [(packet.data, packet.mcs) for packet in found] == sent
    assert all(packet.snr_db > 40 for packet in found)


def test_the_header_of_another_rate_lets_no_packet_through() -> None:
    phy = adaptive()
    modems = phy.modem.rates
    packet = bytes(range(30))
    for mcs, modem in enumerate(modems):
        burst = modem.modulate(packet)
        for other, wrong in enumerate(modems):
            for length in (1, 29, 30, 31, LONGEST):
                differ = modem.headers[len(packet) - 1] ^ wrong.headers[length - 1]
                flips = np.ones(len(phy.layout.data[0]))
                flips[:WORD_BITS] -= 2.0 * differ
                found = heard(phy, with_header(phy, burst, flips))
                right = (other, length) == (mcs, len(packet))
                assert [(one.data, one.mcs) for one in found] == [(packet, mcs)] * right


@given(
    packet=st.binary(min_size=1, max_size=LONGEST),
    mcs=st.integers(0, len(MCS_TABLE) - 1),
    damage=st.tuples(st.sets(st.integers(0, 47)), st.floats(-1.5, 1.5)),
    snr_db=st.floats(0, 40),
    seed=st.integers(0, 1000),
)
def test_no_damage_to_a_header_lets_the_packet_of_another_rate_through(
    packet: bytes, mcs: int, damage: tuple[set[int], float], snr_db: float, seed: int
) -> None:
    phy, (flipped, scale) = adaptive(), damage
    change = np.ones(len(phy.layout.data[0]))
    change[sorted(flipped)] = scale
    burst = with_header(phy, phy.modem.rates[mcs].modulate(packet), change)
    burst = burst + noise(len(burst), snr_db, seed).astype(np.complex64) * phy.burst_power() ** 0.5
    assert [(one.data, one.mcs) for one in heard(phy, burst)] in ([], [(packet, mcs)])


def test_three_wrong_bits_of_a_header_are_corrected() -> None:
    phy, draw = adaptive(), np.random.default_rng(3)
    for number in range(60):
        mcs = number % len(phy.mcs_table)
        change = np.ones(len(phy.layout.data[0]))
        change[draw.choice(WORD_BITS, 3, replace=False)] = -1
        packet = draw.bytes(20)
        found = heard(phy, with_header(phy, phy.modem.rates[mcs].modulate(packet), change))
        assert [(one.data, one.mcs) for one in found] == [(packet, mcs)]


def test_the_rate_of_a_pdu_is_sent_and_comes_out_with_the_snr() -> None:
    phy, probe = adaptive(), Probe()
    transmitter, receiver = phy.transmitter(), phy.receiver()
    top = Flowgraph("test", "test")
    top.connect(transmitter, receiver)
    top.msg_connect(probe, "pdus", transmitter, "pdus")
    top.msg_connect(receiver, "pdus", probe, "pdus")
    rates = [0, 6, 3, 1, 5, 99]
    with top:
        for mcs in rates:
            probe.post_message(pdu_to_send(AirPacket(bytes([mcs]) * 20, mcs=mcs)))
        wait_for(lambda: len(probe.messages) == len(rates), "every packet")
    packets = [packet for message in probe.messages for packet in packets_of(message)[0]]
    assert [packet.mcs for packet in packets] == [0, 6, 3, 1, 5, 0]
    assert all(packet.snr_db is not None and packet.snr_db > 30 for packet in packets)


@pytest.mark.parametrize(
    "options",
    [{"rates": ("64qam", "bpsk-cc")}, {"rates": ("16qam", "16qam")}, {"lengths": "fixed"}],
    ids=str,
)
def test_what_rates_cannot_be_is_said_in_a_line(options: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=r"phy ofdm: (rates|lengths) = "):
        PHY.load("ofdm")(LONGEST, 1e6, rate="adaptive", **options)


def test_a_front_end_whose_bursts_are_all_of_one_length_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"rate = 'adaptive'.*front end"):
        adaptive().pad_all()
