"""The PHY `wifi`: frames and airtime everywhere, and gr-ieee802-11 behind them where it is installed."""

from __future__ import annotations

import random
import sys
import zlib
from typing import Any

import numpy as np
import pmt
import pytest
from gnuradio import blocks, gr
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.core.errors import BackendMissingError, ConfigError
from gr_ros2.link import AirPacket, Delivered
from gr_ros2.paper.receiver import Receiver
from gr_ros2.paper.sender import Sender
from gr_ros2.paper.settings import paper_from
from gr_ros2.phy import PHY
from gr_ros2.phy.measure import SampleRecording, deliver, modulated, record
from gr_ros2.phy.theory import half_point
from gr_ros2.phy.threads import run_flowgraph
from gr_ros2.phy.wifi import WifiOptions, WifiPhy, band_snr_db
from gr_ros2.phy.wifi_frames import ENCODINGS, MAX_PACKET, DataFrames, Encoding, FrameDecoder, scrambler, training
from gr_ros2.settings.config import ChannelConfig
from gr_ros2.settings.registry import Registry
from gr_ros2_lab.sim.fleet import Fleet
from gr_ros2_lab.sim.sim_settings import SimSettings
from tests.gr.probe import Probe
from tests.packets import data_of
from tests.phy.loopback import Loopback
from tests.waiting import wait_for

try:
    import ieee802_11
except ImportError:
    ieee802_11 = None
with_the_module = pytest.mark.skipif(ieee802_11 is None, reason="gr-ieee802-11 is not installed")
RATE = 10e6
"""samples/s of IEEE 802.11p."""
NETWORK, ADDRESS = WifiOptions().network, WifiOptions().address


def make(packet_len: int = 64, **options: Any) -> WifiPhy:
    phy: WifiPhy = PHY.load("wifi")(packet_len, RATE, **options)
    return phy


def received(phy: WifiPhy, samples: Any) -> tuple[list[bytes], int, int]:
    """The packets that a receiver finds, and how many frames were foreign and damaged."""
    top, receiver, log = gr.top_block(), phy.receiver(), blocks.message_debug()
    top.connect(blocks.vector_source_c(np.concatenate((samples, np.zeros(2048, np.complex64)))), receiver)
    top.msg_connect(receiver, "pdus", log, "store")
    run_flowgraph(top)
    vectors = (pmt.cdr(log.get_message(place)) for place in range(log.num_messages()))
    found = [bytes(pmt.u8vector_elements(vector)) for vector in vectors]
    counts = receiver.foreign, receiver.damaged
    receiver.release()
    return found, *counts


def test_without_the_module_the_remedy_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ieee802_11", None)
    with pytest.raises(BackendMissingError, match=r"^phy 'wifi' needs .*github.com/bastibl/gr-ieee802-11.*") as caught:
        make()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("packet_len", "options", "named"),
    [
        (1493, {}, r"packet_len = 1493: at most 1492"),
        (64, {"encoding": "256qam"}, "encoding = '256qam'"),
        (64, {"equalizer": "zf"}, "equalizer = 'zf'"),
        (64, {"gap": 359}, "gap = 359"),
        (64, {"network": "02:67:72"}, "network = '02:67:72': must be six octets"),
        (64, {"address": "zz:67:72:00:00:01"}, "address = 'zz:67:72:00:00:01': must be six octets"),
        (64, {"channel_hz": 0}, "channel_hz"),
        (64, {"fec": "cc"}, "unknown key fec"),
    ],
)
def test_a_setting_out_of_range_is_named(packet_len: int, options: dict[str, Any], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        make(packet_len, **options)


@given(packet=st.binary(max_size=200), number=st.integers(0, 2**20))
def test_a_frame_is_a_broadcast_data_frame_of_its_network(packet: bytes, number: int) -> None:
    frames = DataFrames("02:00:00:00:00:0A", "02:00:00:00:00:0b")
    frame = frames.wrap(packet, number)
    # Type data, no flags, no duration; to all, from us, in our network; sequence number, fragment 0.
    assert frame[:4] == bytes((8, 0, 0, 0))
    assert frame[4:22].hex() == "ffffffffffff02000000000b02000000000a"
    assert int.from_bytes(frame[22:24], "little") == number % 4096 * 16
    assert frame[24:32].hex() == "aaaa0300000088b5"
    assert len(frame) == len(packet) + 36
    assert zlib.crc32(frame) == 0x2144DF1C, "the residue of a CRC-32 behind its data"
    assert frames.unwrap(frame[:-4]) == packet
    assert DataFrames(NETWORK, ADDRESS).unwrap(frame[:-4]) is None


@given(st.binary(max_size=64))
def test_any_other_frame_is_none_of_ours(frame: bytes) -> None:
    assert DataFrames(NETWORK, ADDRESS).unwrap(frame) is None
    assert DataFrames(NETWORK, ADDRESS).unwrap(b"\x08\x00\x00\x00" + frame) is None


def test_airtimes_are_those_of_the_standard() -> None:
    for name, encoding in ENCODINGS.items():
        number, rate = {"bpsk": 1, "qpsk": 2, "16qam": 4, "64qam": 6}[name.split("-")[0]], name.split("-")[1]
        parts = [int(part) for part in rate.split("/")]
        assert encoding.symbol_bits * parts[1] == 48 * number * parts[0]
        for packet_len in (1, 13, 64, 760, MAX_PACKET):
            # IEEE 802.11-2020, 17.4.3, in samples: preamble 320, signal field 80, 80 for each symbol.
            symbols = -(-(16 + 8 * (packet_len + 36) + 6) // encoding.symbol_bits)
            assert encoding.samples(packet_len) == 320 + 80 + 80 * symbols + 1
    assert ENCODINGS["bpsk-1/2"].samples(64) == 3201, "320.1 us at 10 MS/s"


def test_the_preamble_is_that_of_the_standard() -> None:
    short, again, early, late = (np.fft.ifft(np.fft.ifftshift(symbol)) * 64 / 52**0.5 for symbol in training())
    assert np.array_equal(short, again)
    assert short[16:] == pytest.approx(short[:-16], abs=1e-9), "it repeats every 16 samples"
    assert np.roll(late, 16) == pytest.approx(early, abs=1e-9), "one long symbol of 32 + 64 + 64 samples"
    for symbol in (short, early, late):
        assert np.mean(np.abs(symbol) ** 2) == pytest.approx(1)
    # Annex I of IEEE 802.11-2020, tables I-3 and I-5: samples of the two, there with magnitudes of an IFFT over 64.
    scale = 52**0.5 / 64
    assert short[:4] * scale == pytest.approx(
        [0.046 + 0.046j, -0.132 + 0.002j, -0.013 - 0.079j, 0.143 - 0.013j], abs=1e-3
    )
    assert late[:3] * scale == pytest.approx([0.156, -0.005 - 0.120j, 0.040 - 0.111j], abs=1e-3)
    # Section 17.3.5.10: the pilots' signs, + for 0.
    assert "".join("+-"[bit] for bit in scrambler())[:24] == "++++---+----++-+--++-++-"
    assert len(scrambler()) == 127


def test_the_snr_is_that_of_the_band() -> None:
    draw = np.random.default_rng(1)
    for snr_db in (0, 5, 20):
        carrier = 10 ** (snr_db / 10) * 64 / 52
        noise = draw.standard_normal((2, 200_000)) + 1j * draw.standard_normal((2, 200_000))
        first, second = 1 + noise * (0.5 / carrier) ** 0.5
        told = np.sum(np.abs(first + second) ** 2) / np.sum(np.abs(first - second) ** 2) / 2
        assert band_snr_db(10 * np.log10(told)) == pytest.approx(snr_db, abs=0.1)


def encoded(encoding: Encoding, frame: bytes, start: int) -> Any:
    """The symbols of a frame, FCS included, step by step as the standard has it (section 17.3.5).

    :param start: of the scrambler, 1..127
    """
    size = encoding.symbol_bits * -(-(16 + 8 * len(frame) + 6) // encoding.symbol_bits)
    clear = [0] * 16 + [byte >> bit & 1 for byte in frame for bit in range(8)]
    bits, state = [], start
    for place in range(size):
        feedback = (state >> 6 ^ state >> 3) & 1
        state = (state << 1 & 0x7F) | feedback
        tail = len(clear) <= place < len(clear) + 6
        bits.append(0 if tail else feedback ^ (clear[place] if place < len(clear) else 0))
    coded, past = [], [0] * 6
    for bit in bits:
        window = [bit, *past]
        coded += [sum(window[n] for n in taps) % 2 for taps in ((0, 2, 3, 5, 6), (0, 1, 2, 3, 6))]  # 133 and 171 octal
        past = window[:6]
    dropped = {(1, 2): (), (2, 3): (3,), (3, 4): (3, 4)}[encoding.rate]
    period = {(1, 2): 2, (2, 3): 4, (3, 4): 6}[encoding.rate]
    sent = [bit for place, bit in enumerate(coded) if place % period not in dropped]
    count, each = 48 * encoding.carrier_bits, encoding.carrier_bits
    symbols = []
    for first in range(0, len(sent), count):
        mixed = [0] * count
        for k in range(count):
            i = count // 16 * (k % 16) + k // 16
            s = max(each // 2, 1)
            mixed[s * (i // s) + (i + count - 16 * i // count) % s] = sent[first + k]
        symbols.append([sum(mixed[each * c + n] << n for n in range(each)) for c in range(48)])
    return np.array(symbols, np.uint8)


@pytest.mark.parametrize("encoding", ENCODINGS.values(), ids=list(ENCODINGS))
def test_a_frame_is_decoded_as_the_standard_encodes_it(encoding: Encoding) -> None:
    draw, frames = random.Random(1), DataFrames(NETWORK, ADDRESS)
    for packet_len, start in ((0, 1), (13, 93), (14, 127), (64, 64), (200, 5)):
        frame = frames.wrap(draw.randbytes(packet_len), 7)
        symbols = encoded(encoding, frame, start)
        assert len(symbols) == encoding.symbols(packet_len)
        assert FrameDecoder().decode(encoding, len(frame), symbols) == frame[:-4]
        symbols[len(symbols) // 2, 20] ^= 1
        assert FrameDecoder().decode(encoding, len(frame), symbols) == frame[:-4], "the code corrects a bit"
        symbols[:, ::2] ^= 1
        assert FrameDecoder().decode(encoding, len(frame), symbols) is None


@given(data=st.data(), name=st.sampled_from(sorted(ENCODINGS)), length=st.integers(0, 120))
def test_symbols_of_anything_else_are_no_frame(data: st.DataObject, name: str, length: int) -> None:
    encoding = ENCODINGS[name]
    count = 48 * encoding.symbols(length - 36)
    symbols = np.frombuffer(data.draw(st.binary(min_size=count, max_size=count)), np.uint8).reshape(-1, 48)
    assert FrameDecoder().decode(encoding, length, symbols) is None


@with_the_module
@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("packet_len", [14, 760, MAX_PACKET])
def test_every_encoding_carries_every_length(encoding: str, packet_len: int) -> None:
    phy = make(packet_len, encoding=encoding)
    draw = random.Random(1)
    packets = [draw.randbytes(length) for length in (packet_len, 1, packet_len // 2, packet_len, packet_len)]
    recording = modulated(phy, packets)
    assert len(recording.samples) == sum(phy.airtime_samples(len(packet)) for packet in packets)
    assert received(phy, recording.samples) == (packets, 0, 0)


@with_the_module
def test_a_receiver_hears_any_encoding() -> None:
    packets = [bytes([number]) * 64 for number in range(len(ENCODINGS))]
    parts = [modulated(make(encoding=name), [packet]).samples for name, packet in zip(ENCODINGS, packets, strict=True)]
    assert received(make(), np.concatenate(parts)) == (packets, 0, 0)


@with_the_module
@pytest.mark.parametrize("equalizer", ["ls", "lms", "comb", "sta"])
def test_every_estimate_of_the_channel_receives(equalizer: str) -> None:
    phy = make(equalizer=equalizer)
    recording = record(phy, 20)
    assert deliver(phy, recording, ChannelConfig(snr_db=20, frequency_offset=0.002, seed=1)) == recording.packets


@with_the_module
def test_frames_of_others_are_counted_and_dropped() -> None:
    ours, others = make(), make(network="02:00:00:00:00:01")
    longer = make(65)
    mine = record(ours, 3)
    parts = np.split(mine.samples, 3)
    samples = [parts[0], record(others, 1).samples, parts[1], record(longer, 1).samples, parts[2]]
    assert received(ours, np.concatenate(samples)) == (mine.packets, 2, 0)


@with_the_module
def test_a_damaged_frame_is_counted_and_the_next_one_passes() -> None:
    phy = make()
    recording = record(phy, 3)
    samples = recording.samples.copy()
    hit = phy.airtime_samples() + 1600
    samples[hit : hit + 400] = 0
    assert received(phy, samples) == ([recording.packets[0], recording.packets[2]], 0, 1)


@with_the_module
@pytest.mark.slow
@pytest.mark.parametrize(("snr_db", "late"), [(None, 0.0), (20.0, 0.0), (20.0, 0.5)])
def test_no_packet_is_lost_wherever_it_falls(snr_db: float | None, late: float) -> None:
    """Any silence between frames, and between two samples."""
    phy = make(14, encoding="qpsk-1/2")
    recording = record(phy, 60)
    draw = np.random.default_rng(1)
    parts: list[Any] = []
    for burst in recording.samples.reshape(60, -1):
        parts += [np.zeros(draw.integers(0, 3000), np.complex64), burst]
    samples = np.concatenate(parts)
    if late:
        turn = np.exp(-2j * np.pi * np.fft.fftfreq(len(samples)) * late)
        samples = np.fft.ifft(np.fft.fft(samples) * turn).astype(np.complex64)
    channel = ChannelConfig(snr_db=snr_db, seed=1)
    assert deliver(phy, SampleRecording(recording.packets, samples), channel) == recording.packets


@with_the_module
@pytest.mark.parametrize("ppm", [-40, 40])
def test_with_the_channel_known_clocks_may_differ(ppm: int) -> None:
    """One oscillator makes carrier and samples."""
    told = make(760, encoding="qpsk-1/2", channel_hz=5.89e9)
    recording = record(told, 10)
    offset = ppm * 1e-6 * 5.89e9 / RATE
    channel = ChannelConfig(snr_db=20, epsilon=1 + ppm * 1e-6, frequency_offset=offset, seed=1)
    assert deliver(told, recording, channel) == recording.packets
    assert len(deliver(make(760, encoding="qpsk-1/2"), recording, channel)) < 5


@with_the_module
@pytest.mark.parametrize("equalizer", ["ls", "lms", "sta"])
@pytest.mark.parametrize("snr_db", [8.0, 20.0])
def test_the_snr_told_is_that_of_the_channel(equalizer: str, snr_db: float) -> None:
    phy = make(equalizer=equalizer)
    source, sink = Probe(), Probe()
    with Loopback(phy, source, sink, channel=ChannelConfig(snr_db=snr_db, seed=1)) as link:
        assert link.radio.snr_db is None
        for number in range(40):
            source.post(bytes(64))
            wait_for(lambda number=number: link.radio.counts().transmitted > number, "the burst")
        wait_for(lambda: sink.handled >= 30, "most packets")
        assert link.radio.snr_db == pytest.approx(snr_db, abs=1.0)


@with_the_module
@pytest.mark.slow
@pytest.mark.parametrize("encoding", ["bpsk-1/2", "qpsk-3/4", "16qam-1/2", "64qam-2/3"])
def test_half_of_the_packets_arrive_near_the_computed_point(encoding: str) -> None:
    phy = make(encoding=encoding)
    recording = record(phy, 100)
    middle = half_point(phy.computed_pdr)

    def share(snr_db: float) -> float:
        return len(deliver(phy, recording, ChannelConfig(snr_db=snr_db, seed=2))) / 100

    assert share(middle - 2) < 0.5 < share(middle + 2)


@with_the_module
def test_nothing_is_printed(capfd: pytest.CaptureFixture[str]) -> None:
    phy = make()
    recording = record(phy, 3)
    assert deliver(phy, recording, ChannelConfig()) == recording.packets
    assert capfd.readouterr() == ("", "")


@with_the_module
@pytest.mark.slow
def test_messages_of_odometry_arrive_at_20_db() -> None:
    """Each message in one packet of 760 B, unchanged and in order."""
    registry = Registry.from_rows({"odom": "nav_msgs/Odometry"})
    sender = Sender(registry, *paper_from(packet_len=760, robot=1, queue_depth=0))
    fleet = Fleet(SimSettings(robots=1, odom_rate=100))
    messages = [message.payload for message in fleet.messages(2.0, topics={"/robot_1/odom"})]
    packets = []
    for number, message in enumerate(messages):
        sender.submit(0, message, number * 0.01)
        while (packet := data_of(sender.next_packet(number * 0.01))) is not None:
            packets.append(packet)
    assert len(packets) == len(messages) == 200
    phy = make(760)
    arrived = deliver(phy, modulated(phy, packets), ChannelConfig(snr_db=20, seed=1))
    receiver = Receiver(registry, *paper_from(robot=0, packet_len=760))
    events = [event for packet in arrived for event in receiver.receive(AirPacket(packet), 0.0)]
    delivered = [event.payload for event in events if isinstance(event, Delivered)]
    assert delivered == messages
