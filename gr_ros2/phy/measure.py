"""Packets through a simulated channel, without a source, a sink or a clock: the share that arrives.

Invariants: what a PHY's own transmitter sends is recorded once and played to its own receiver through any number of
channels; equal seeds give equal packets and equal noise.
"""

from __future__ import annotations

import random
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pmt
from gnuradio import blocks, gr

from gr_ros2.core.errors import PhyError
from gr_ros2.core.watch import Watch
from gr_ros2.phy.base import Phy
from gr_ros2.phy.channel import Channel
from gr_ros2.phy.flowgraph import Flowgraph
from gr_ros2.phy.pdus import PDUS, pdu_of
from gr_ros2.phy.threads import run_flowgraph
from gr_ros2.settings.config import ChannelConfig

_PATIENCE_S = 60.0
_POLL_S = 0.002
_BATCH_SAMPLES = 1 << 22
_TAIL = 2048
"""Zero samples after the last packet, so that channel and receiver release everything."""


class _PacketPort(gr.basic_block):  # type: ignore[misc]
    """A block with one message port, from which packets are sent."""

    def __init__(self) -> None:
        super().__init__("gr_ros2_outlet", None, None)
        self.message_port_register_out(PDUS)


@dataclass(frozen=True)
class SampleRecording:
    """Packets and their modulated samples.

    :param packets: in the order they were sent
    :param samples: of all packets, gaps included
    """

    packets: list[bytes]
    samples: npt.NDArray[np.complex64]


def record(phy: Phy, count: int, seed: int = 0) -> SampleRecording:
    """Modulate random packets.

    :param count: packets
    :raises PhyError: for a PHY without samples, or when the samples do not come
    """
    source = random.Random(seed)
    return modulated(phy, [source.randbytes(phy.packet_len) for _ in range(count)])


def modulated(phy: Phy, packets: Sequence[bytes]) -> SampleRecording:
    """The samples that a PHY's transmitter makes of packets, one after the other.

    :param packets: of lengths that the PHY allows
    :raises PhyError: for a PHY without samples, or when the samples do not come
    """
    top, transmitter, sink = Flowgraph("gr_ros2_measure", f"phy {phy.name}"), phy.transmitter(), blocks.vector_sink_c()
    top.connect(transmitter, sink)
    outlet = _PacketPort()
    top.msg_connect(outlet, "pdus", transmitter, "pdus")
    wanted = sum(phy.airtime_samples(len(packet)) for packet in packets)
    try:
        top.start()
        for packet in packets:
            outlet.message_port_pub(PDUS, pdu_of(packet))
        still = Watch()
        while (now := sink.nitems_read(0)) < wanted:
            if still.still_s(now, time.monotonic()) > _PATIENCE_S:
                raise PhyError(f"phy {phy.name}: {now} of {wanted} samples came, and no more for {_PATIENCE_S} s")
            time.sleep(_POLL_S)
    finally:
        top.stop()
        transmitter.release()
    return SampleRecording(list(packets), np.array(sink.data(), np.complex64))


def deliver(phy: Phy, recording: SampleRecording, channel: ChannelConfig) -> list[bytes]:
    """The packets that a receiver finds in a recording after a channel (``packet_loss`` is not applied)."""
    top, receiver, log = Flowgraph("gr_ros2_measure", f"phy {phy.name}"), phy.receiver(), blocks.message_debug()
    samples = np.concatenate((np.zeros(_TAIL, np.complex64), recording.samples, np.zeros(_TAIL, np.complex64)))
    top.connect(blocks.vector_source_c(samples), Channel(channel, phy), receiver)
    top.msg_connect(receiver, "pdus", log, "store")
    run_flowgraph(top)
    receiver.release()
    vectors = (pmt.cdr(log.get_message(place)) for place in range(log.num_messages()))
    return [bytes(pmt.u8vector_elements(vector)) for vector in vectors]


def pdr(phy: Phy, recording: SampleRecording, channel: ChannelConfig) -> float:
    """Share of a recording's packets that arrive unaltered, 0..1."""
    arrived = set(deliver(phy, recording, channel))
    return sum(packet in arrived for packet in recording.packets) / len(recording.packets)


def batch_of(phy: Phy) -> int:
    """Most packets that go through a flowgraph at a time, so that their samples fit in memory."""
    return max(1, _BATCH_SAMPLES // phy.airtime_samples())
