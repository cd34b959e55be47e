"""`implementation: lora_sdr`: LoRa's frames, what is refused, and the traps of gr-lora_sdr where it is installed."""

from __future__ import annotations

import random
import sys
from math import ceil
from typing import Any

import numpy as np
import pmt
import pytest
from gnuradio import blocks, gr

from gr_ros2.core.errors import BackendMissingError, ConfigError
from gr_ros2.phy import PHY
from gr_ros2.phy.lora import LoraPhy
from gr_ros2.phy.lora_sdr import PER_CHIP, SdrFrame, whitening
from gr_ros2.phy.measure import SampleRecording, deliver, record
from gr_ros2.phy.pdus import pdu_of
from gr_ros2.phy.threads import start_flowgraph
from gr_ros2.settings.config import ChannelConfig
from tests.gr.probe import Probe
from tests.phy.loopback import Loopback
from tests.waiting import wait_for

try:
    from gnuradio import lora_sdr
except ImportError:
    lora_sdr = None
with_the_module = pytest.mark.skipif(lora_sdr is None, reason="gr-lora_sdr is not installed")


def make(packet_len: int = 64, sample_rate: float = 1e6, **options: Any) -> LoraPhy:
    phy: LoraPhy = PHY.load("lora")(packet_len, sample_rate, implementation="lora_sdr", **options)
    return phy


def frame(packet_len: int = 64, **settings: Any) -> SdrFrame:
    known = {"spreading_factor": 7, "coding_rate": 4, "sync_word": 0x12, "ldro": False, "gap": 64}
    return SdrFrame(packet_len, **(known | settings))


def test_symbols_are_counted_as_in_lora_modems_data_sheets() -> None:
    for factor in range(7, 13):
        for rate in range(1, 5):
            for ldro in (False, True):
                for packet_len in range(14, 252):
                    # Semtech SX1276, section 4.1.1.7, with header and CRC; of the payload 4 bytes are a CRC-32.
                    bits = 8 * (packet_len + 4) - 4 * factor + 28 + 16
                    symbols = 8 + max(ceil(bits / (4 * (factor - 2 * ldro))) * (rate + 4), 0)
                    one = frame(packet_len, spreading_factor=factor, coding_rate=rate, ldro=ldro)
                    assert one.symbols == symbols
                    assert one.airtime_samples == int((12.25 + symbols) * 2 * 2**factor) + 64


def test_whitening_is_that_of_lora() -> None:
    # The first bytes of the sequence that LoRa modems are known to use.
    assert bytes(whitening(12)) == bytes.fromhex("fffefcf8f0e1c2850b172f5e")


def test_a_payload_with_any_bit_wrong_is_no_packet() -> None:
    one = frame(14)
    nibbles = one.wrap(bytes(range(14)))[5:-4]
    payload = bytes(low | high << 4 for low, high in zip(nibbles[::2], nibbles[1::2], strict=True))
    clear = bytes(a ^ b for a, b in zip(payload, whitening(18).tolist(), strict=True))
    assert one.unwrap(clear) == bytes(range(14))
    for bit in range(8 * 18):
        wrong = bytearray(clear)
        wrong[bit // 8] ^= 1 << bit % 8
        assert one.unwrap(bytes(wrong)) is None
    assert one.unwrap(clear[:-1]) is None


@pytest.mark.parametrize(
    ("packet_len", "options", "named"),
    [
        (252, {}, r"packet_len = 252: at most 251 with lora_sdr"),
        (64, {"fec": "cc"}, "fec = 'cc'"),
        (64, {"gap": 47}, "gap = 47: below 48"),
        (64, {"spreading_factor": 11}, "spreading_factor = 11: gr-lora_sdr crashes"),
        (64, {"sync_word": 0x20}, "sync_word = 0x20"),
        (64, {"sync_word": 0x02}, "sync_word = 2"),
        (64, {"carrier_hz": 1e10}, "carrier_hz"),
    ],
)
def test_what_the_module_cannot_do_is_refused(packet_len: int, options: dict[str, Any], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        make(packet_len, **options)


@pytest.mark.parametrize("setting", [{"sync_word": 18}, {"ldro": False}, {"carrier_hz": 868.1e6}])
def test_a_setting_of_the_module_means_nothing_to_our_own(setting: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=f"{next(iter(setting))} = .*: only with implementation = lora_sdr"):
        LoraPhy(64, 1e6, **setting)


def test_without_the_module_the_remedy_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gnuradio.lora_sdr", None)
    with pytest.raises(
        BackendMissingError, match=r"implementation 'lora_sdr' needs .*gr-lora_sdr.*take 'own', at both"
    ):
        make()
    assert LoraPhy(64, 1e6).airtime_samples() == 22560


@with_the_module
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"spreading_factor": 8, "coding_rate": 1, "sync_word": 0x34},
        {"spreading_factor": 8, "coding_rate": 2, "ldro": True},
        {"spreading_factor": 10, "coding_rate": 3, "gap": 4096},
    ],
    ids=str,
)
def test_the_samples_are_those_of_the_modules_own_transmitter(options: dict[str, Any]) -> None:
    phy = make(**options)
    recording = record(phy, 2)
    one = phy._sdr
    assert one is not None
    theirs = lora_sdr.lora_sdr_lora_tx(
        1, one.coding_rate, True, False, PER_CHIP, one.spreading_factor, int(one.ldro), one.gap, [one.sync_word]
    )
    top, source, sink = gr.top_block(), Probe(), blocks.vector_sink_c()
    top.msg_connect(source, "pdus", theirs, "in")
    top.connect(theirs, sink)
    start_flowgraph(top.start)
    for packet in recording.packets:
        nibbles = np.frombuffer(one.wrap(packet), np.uint8)[5:-4]
        payload = (nibbles[::2] | nibbles[1::2] << 4) ^ whitening(68)
        # As bytes: a str would go through as UTF-8.
        source.message_port_pub(pmt.intern("pdus"), pmt.intern(payload.tobytes()))
    wait_for(lambda: sink.nitems_read(0) == len(recording.samples), "their samples")
    top.stop()
    top.wait()
    assert np.array_equal(np.array(sink.data(), np.complex64), recording.samples)


@with_the_module
def test_no_packet_is_lost_wherever_it_falls_between_samples() -> None:
    phy = make(14, coding_rate=1)
    recording = record(phy, 30)
    draw = np.random.default_rng(1)
    for late in (0.0, 0.5, 1.0):
        samples = _spread(phy, recording.samples, draw)
        turn = np.exp(-2j * np.pi * np.fft.fftfreq(len(samples)) * late)
        moved = np.fft.ifft(np.fft.fft(samples) * turn).astype(np.complex64)
        for snr_db in (None, 20):
            channel = ChannelConfig(snr_db=snr_db, seed=1)
            assert deliver(phy, SampleRecording(recording.packets, moved), channel) == recording.packets


def _spread(phy: LoraPhy, samples: Any, draw: np.random.Generator) -> Any:
    """The same bursts with silences of any length between them."""
    parts: list[Any] = []
    for burst in samples.reshape(-1, phy.airtime_samples()):
        parts += [np.zeros(draw.integers(0, 3000), np.complex64), burst]
    return np.concatenate(parts)


@with_the_module
@pytest.mark.parametrize("options", [{}, {"coding_rate": 1}], ids=str)
def test_with_the_least_gap_single_packets_come_out_at_once(options: dict[str, Any]) -> None:
    phy = make(14, gap=24 * PER_CHIP, **options)
    source, sink, draw = Probe(), Probe(), random.Random(1)
    channel = ChannelConfig(snr_db=20, frequency_offset=0.004, epsilon=1.00001, seed=1)
    with Loopback(phy, source, sink, channel=channel):
        for number in range(1, 11):
            source.post(draw.randbytes(14))
            wait_for(lambda number=number: sink.handled == number, "the packet just sent")


@with_the_module
@pytest.mark.parametrize("frequency_offset", [0.0, 0.0025, -0.005])
def test_at_20_db_nothing_is_lost_at_default_settings(frequency_offset: float) -> None:
    phy = make()
    recording = record(phy, 30)
    channel = ChannelConfig(snr_db=20, frequency_offset=frequency_offset, epsilon=1.00001, seed=1)
    assert deliver(phy, recording, channel) == recording.packets


@with_the_module
def test_the_largest_symbols_find_room_in_the_buffers() -> None:
    phy = make(14, spreading_factor=10, ldro=True)
    recording = record(phy, 5)
    assert deliver(phy, recording, ChannelConfig(snr_db=0, seed=1)) == recording.packets


@with_the_module
def test_every_byte_value_passes() -> None:
    phy = make(128)
    source, sink = Probe(), Probe()
    sent = [bytes(range(128)), bytes(range(128, 256)), bytes(128), b"\xff" * 128]
    with Loopback(phy, source, sink):
        for packet in sent:
            source.post(packet)
        wait_for(lambda: sink.handled == len(sent), "every packet")
    assert sink.packets == sent


@with_the_module
def test_a_frame_of_another_length_is_counted_and_the_next_one_passes() -> None:
    phy = make(64)
    ours, foreign = record(phy, 3), record(make(100), 2)
    bursts = ours.samples.reshape(3, -1)
    parts = np.array_split(foreign.samples, 2)
    mixed = np.concatenate((bursts[0], parts[0], bursts[1], parts[1], bursts[2]))
    top, receiver, log = gr.top_block(), phy.receiver(), blocks.message_debug()
    top.connect(blocks.vector_source_c(np.concatenate((mixed, np.zeros(2048, np.complex64)))), receiver)
    top.msg_connect(receiver, "pdus", log, "store")
    start_flowgraph(top.start)
    top.wait()
    got = [bytes(pmt.u8vector_elements(pmt.cdr(log.get_message(place)))) for place in range(log.num_messages())]
    receiver.release()
    assert got == ours.packets
    assert receiver.damaged == 2


@with_the_module
def test_another_networks_frames_are_not_heard() -> None:
    recording = record(make(sync_word=0x34), 5)
    assert deliver(make(), recording, ChannelConfig()) == []
    assert deliver(make(sync_word=0x34), recording, ChannelConfig()) == recording.packets


@with_the_module
@pytest.mark.parametrize("ppm", [-30, 30])
def test_with_the_carrier_known_clocks_may_differ(ppm: int) -> None:
    rate, carrier = 250e3, 868.1e6
    told = make(sample_rate=rate, carrier_hz=carrier)
    recording = record(told, 20)
    offset = ppm * 1e-6 * carrier / rate
    channel = ChannelConfig(snr_db=20, epsilon=1 + ppm * 1e-6, frequency_offset=offset, seed=1)
    assert deliver(told, recording, channel) == recording.packets
    assert len(deliver(make(sample_rate=rate), recording, channel)) < 20


@with_the_module
def test_a_pdu_that_is_no_packet_is_counted_and_not_sent() -> None:
    source, sink = Probe(), Probe()
    with Loopback(make(), source, sink) as link:
        source.post(bytes(63))
        source.post(bytes(64))
        wait_for(lambda: sink.handled == 1, "the right one")
        assert link.radio.counts().transmitted == 1
        assert link.radio._transmitter.refused == 1


@with_the_module
def test_a_flowgraph_outlives_the_names_of_its_parts() -> None:
    top, source, log = gr.top_block(), Probe(), blocks.message_debug()
    phy = make(14)
    transmitter, receiver = phy.transmitter(), phy.receiver()
    top.msg_connect(source, "pdus", transmitter, "pdus")
    top.connect(transmitter, receiver)
    top.msg_connect(receiver, "pdus", log, "store")
    del transmitter, receiver, phy
    start_flowgraph(top.start)
    source.message_port_pub(pmt.intern("pdus"), pdu_of(bytes(14)))
    wait_for(lambda: log.num_messages() == 1, "the packet")
    top.stop()
    top.wait()
