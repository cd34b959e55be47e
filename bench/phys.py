"""Every PHY: a recorded drive at 20 dB, and what source and sink cost beside its bare flowgraph.

The drive goes through the PHY's own transmitter, channel and receiver as fast as these run. The bare flowgraph is the
same three between two Python blocks; it and the whole link are measured in turn, so that a slow moment of the machine
hits both.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from statistics import median
from typing import Any

import pmt
from gnuradio import blocks, gr

from bench.port import _OUT, PACKET_LEN, _Graph, _Poster, _Taker, _wait, checked_count, one_way
from bench.rows import Row
from bench.runs import DRIVE
from gr_ros2.core.errors import BackendMissingError
from gr_ros2.middleware.bag_files import read_bag
from gr_ros2.paper.sender import Sender
from gr_ros2.paper.settings import paper_from
from gr_ros2.phy import PHY, Phy
from gr_ros2.phy.flowgraph import Flowgraph
from gr_ros2.phy.measure import deliver, modulated
from gr_ros2.phy.threads import shorten_switch_interval
from gr_ros2.settings.config import ChannelConfig
from gr_ros2.settings.registry import Registry

SNR_DB = 20.0
LEAST = 0.5
"""Share of the bare flowgraph's packets/s that is left with source and sink."""
SHORT, DENSE = 4, 10
"""Packets/s on compiled kernels over those with numpy: 64 B, and 1,500 B in 64-QAM."""
BATCH_SAMPLES = 2_000_000
REPEATS = 3
_HEADERS = 16
"""Bytes of a packet that are no message, when it holds one."""
_COUNTS = {"lora": (1500, 20)}
_COUNT = (4000, 200)
"""Packets for a rate, and for a latency."""
_WINDOW = 32
"""Packets under way."""


def drive() -> list[Row]:
    """The recorded drive over every PHY with samples at its default settings, 64 B packets in noise."""
    packets = drive_packets()
    return [_drive(_phy(name), packets) for name in _usable()]


def drive_packets() -> list[bytes]:
    """What the sending engine makes of the recording: every message, uncompressed."""
    registry = Registry.from_rows(DRIVE.topics)
    sender = Sender(registry, *paper_from(packet_len=PACKET_LEN, robot=1, queue_depth=0))
    ids = {f"/robot_1/{topic.name}": topic.topic_id for topic in registry}
    packets = []
    for message in read_bag(DRIVE.path, list(ids)):
        now = message.stamp_ns * 1e-9
        sender.submit(ids[message.topic], message.payload, now)
        while (sent := sender.next_packet(now)) is not None:
            packets.append(sent.data)
    return packets


def _drive(phy: Phy, packets: list[bytes]) -> Row:
    """In batches, each with noise of its own."""
    begin, batch = time.monotonic(), max(1, BATCH_SAMPLES // phy.airtime_samples())
    lost = 0
    for first in range(0, len(packets), batch):
        sent = packets[first : first + batch]
        arrived = deliver(phy, modulated(phy, sent), ChannelConfig(snr_db=SNR_DB, seed=first))
        lost += len(sent) - sum(packet in set(arrived) for packet in sent) if arrived != sent else 0
    took = time.monotonic() - begin
    note = f"{len(packets)} packets of {PACKET_LEN} B, {phy.airtime_samples()} samples each; {took:.0f} s"
    return Row(f"recorded drive over {phy.name} at {SNR_DB:g} dB: packets lost", lost, "", "=", 0, note=note)


def beside() -> list[Row]:
    """Packets/s and latency with source and sink, beside the bare flowgraph."""
    return [row for name in _usable() for row in _beside(name)]


def _usable() -> list[str]:
    """The PHYs with samples whose modules are installed."""
    found = []
    for name in PHY:
        with suppress(BackendMissingError):
            PHY.modules(name)
            found += [name] * PHY.load(name).has_samples
    return found


def _beside(name: str) -> list[Row]:
    many, few = _COUNTS.get(name, _COUNT)
    bare, ours = [], []
    for _ in range(REPEATS):
        bare.append(_bare(_phy(name), many, few))
        ours.append(_ours(_phy(name), many, few))
    rate, own_rate = (median(one[0] for one in runs) for runs in (bare, ours))
    wait, own_wait = (1e3 * median(one[1] for one in runs) for runs in (bare, ours))
    note = f"{own_rate:,.0f} of {rate:,.0f} packets/s"
    return [
        Row(f"{name}: packets/s beside the bare flowgraph", own_rate / rate, "", "≥", LEAST, "{:.2f}", note),
        Row(f"{name}: latency added by source and sink, p50", own_wait - wait, "ms", form="{:.2f}",
            note=f"{own_wait:.2f} ms, bare {wait:.2f} ms"),
    ]  # fmt: skip


def kernels() -> list[Row]:
    """Links with source and sink: OFDM on compiled kernels beside numpy and GNU Radio's blocks, in turn."""
    short = {kernels: _phy("ofdm", kernels=kernels) for kernels in ("auto", "numpy")}
    dense = [_phy("ofdm", 1500, kernels=kernels, payload_modulation="64qam") for kernels in ("auto", "numpy")]
    stock = _phy("ofdm", detection_threshold="stock")
    runs: dict[Phy, list[tuple[float, float]]] = {}
    for _ in range(REPEATS):
        for phy in (*short.values(), *dense, stock):
            runs.setdefault(phy, []).append(_ours(phy, *_COUNT))
    rate, wait = ({phy: median(one[place] for one in all_) for phy, all_ in runs.items()} for place in (0, 1))
    ours, plain = short.values()
    bits = 8e-6 * (dense[0].packet_len - _HEADERS)
    speed = f"{rate[ours]:,.0f} instead of {rate[plain]:,.0f}; GNU Radio's blocks {rate[stock]:,.0f}"
    times = f"{wait[ours] * 1e3:.2f} instead of {wait[plain] * 1e3:.2f} ms; GNU Radio's blocks {wait[stock] * 1e3:.2f}"
    return [
        Row("ofdm, 64 B: packets/s over those with numpy", rate[ours] / rate[plain], "", "≥", SHORT, "{:.1f}", speed),
        Row("ofdm, 64 B: latency of one over that with numpy", wait[ours] / wait[plain], "", "≤", 0.5, "{:.2f}", times),
        Row("ofdm 64qam, 1,500 B: packets/s over those with numpy", rate[dense[0]] / rate[dense[1]], "", "≥", DENSE,
            "{:.1f}", f"{bits * rate[dense[0]]:.1f} Mbit/s instead of {bits * rate[dense[1]]:.1f}"),
    ]  # fmt: skip


def _phy(name: str, packet_len: int = PACKET_LEN, **settings: Any) -> Phy:
    phy: Phy = PHY.load(name)(packet_len, 1e6, **settings)
    return phy


def _bare(phy: Phy, many: int, few: int) -> tuple[float, float]:
    """Packets/s, and s for a single one, from Python block to Python block."""
    shorten_switch_interval()
    poster, taker, graph = _Poster(), _Taker(), gr.top_block()
    transmitter, receiver = phy.transmitter(), phy.receiver()
    graph.msg_connect(poster, "out", transmitter, "pdus")
    graph.connect(transmitter, receiver)
    graph.msg_connect(receiver, "pdus", taker, "in")
    graph.start()
    phy.prefer_latency()
    packet = pmt.cons(pmt.make_dict(), pmt.init_u8vector(PACKET_LEN, [7] * PACKET_LEN))
    single = _latency(lambda: poster.message_port_pub(_OUT, packet), lambda: taker.taken, few)
    begin = time.perf_counter()
    for number in range(few, few + many):
        # As many at once as the link lets under way; without a limit everything waits behind the modulator.
        _wait(transmitter.packets_sent, number - _WINDOW)
        poster.message_port_pub(_OUT, packet)
    _wait(lambda: taker.taken, few + many)
    rate = many / (time.perf_counter() - begin)
    graph.stop()
    graph.wait()
    for part in (transmitter, receiver):
        part.release()
    return rate, single


def _ours(phy: Phy, many: int, few: int) -> tuple[float, float]:
    """The same from a message at the source to the message at the sink."""
    robot, base = _Graph(1), _Graph(2)
    sends, takes = one_way(robot, base, phy.packet_len)
    source, sink = sends.source, takes.sink
    message = b"\0\1\0\0" + bytes(phy.packet_len - _HEADERS - 4)
    transmitter, receiver, graph = phy.transmitter(), phy.receiver(), Flowgraph("gr_ros2_bench", phy.name)
    untagged = blocks.copy(gr.sizeof_gr_complex)  # tags of GNU Radio's modulator would tell the receiver too much
    untagged.set_tag_propagation_policy(gr.TPP_DONT)
    graph.connect(transmitter, untagged, receiver)
    graph.msg_connect(source, "pdus", transmitter, "pdus")
    graph.msg_connect(receiver, "pdus", sink, "pdus")
    with graph:
        phy.prefer_latency()
        single = _latency(lambda: robot.callback(message), lambda: base.counter.published, few)
        begin = time.perf_counter()
        for number in range(few, few + many):
            _wait(transmitter.packets_sent, number - _WINDOW)
            robot.callback(message)
        _wait(lambda: base.counter.published, few + many)
        rate = many / (time.perf_counter() - begin)
        checked_count(phy.name, sink.stats()["packets"], few + many, 1)
    for part in (transmitter, receiver):
        part.release()
    sends.close()
    takes.close()
    return rate, single


def _latency(send: Callable[[], Any], arrived: Callable[[], int], count: int) -> float:
    """Median of single packets, each sent when the one before has arrived."""
    waits = []
    for number in range(count):
        begin = time.perf_counter()
        send()
        while arrived() <= number:
            time.sleep(2e-5)
        waits.append(time.perf_counter() - begin)
    return median(waits)
