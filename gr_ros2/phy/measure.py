"""Packets through a simulated channel, without a source, a sink or a clock: the share that arrives.

Laws: what a PHY's own transmitter sends is recorded once and played to its own receiver through any number of channels;
equal seeds give equal packets and equal noise.
"""

from __future__ import annotations

import random
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pmt
from gnuradio import blocks, gr

from gr_ros2.config import ChannelConfig
from gr_ros2.errors import PhyError
from gr_ros2.phy.base import Phy
from gr_ros2.phy.channel import Channel

_PDUS = pmt.intern("pdus")
_PATIENCE_S = 60.0
_POLL_S = 0.002
_TAIL = 2048
"""Zero samples behind the last packet, for what channel and receiver hold back."""


class _Outlet(gr.basic_block):  # type: ignore[misc]
    """A message port to send from."""

    def __init__(self) -> None:
        super().__init__("gr_ros2_outlet", None, None)
        self.message_port_register_out(_PDUS)


@dataclass(frozen=True)
class Recording:
    """Packets and the samples they became.

    :param packets: in the order they were sent
    :param samples: of all packets, gaps included
    """

    packets: list[bytes]
    samples: npt.NDArray[np.complex64]


def record(phy: Phy, count: int, seed: int = 0) -> Recording:
    """Send random packets into the void.

    :param count: packets
    :raises PhyError: for a PHY without samples, or when the samples do not come
    """
    source = random.Random(seed)
    packets = [bytes(source.getrandbits(8) for _ in range(phy.packet_len)) for _ in range(count)]
    top, transmitter, sink = gr.top_block(), phy.transmitter(), blocks.vector_sink_c()
    top.connect(transmitter, sink)
    outlet = _Outlet()
    top.msg_connect(outlet, "pdus", transmitter, "pdus")
    top.start()
    try:
        for packet in packets:
            vector = pmt.init_u8vector(len(packet), list(packet))
            outlet.message_port_pub(_PDUS, pmt.cons(pmt.make_dict(), vector))
        wanted = count * phy.airtime_samples()
        deadline = time.monotonic() + _PATIENCE_S
        while sink.nitems_read(0) < wanted:
            if time.monotonic() > deadline:
                raise PhyError(f"phy {phy.name}: {sink.nitems_read(0)} of {wanted} samples came in {_PATIENCE_S} s")
            time.sleep(_POLL_S)
    finally:
        top.stop()
        top.wait()
        release(transmitter)
    return Recording(packets, np.array(sink.data(), np.complex64))


def deliver(phy: Phy, recording: Recording, channel: ChannelConfig) -> list[bytes]:
    """The packets a receiver makes of a recording behind a channel (``packet_loss`` is not applied)."""
    top, receiver, log = gr.top_block(), phy.receiver(), blocks.message_debug()
    samples = np.concatenate((np.zeros(_TAIL, np.complex64), recording.samples, np.zeros(_TAIL, np.complex64)))
    top.connect(blocks.vector_source_c(samples), Channel(channel, phy), receiver)
    top.msg_connect(receiver, "pdus", log, "store")
    top.run()
    release(receiver)
    vectors = (pmt.cdr(log.get_message(place)) for place in range(log.num_messages()))
    return [bytes(pmt.u8vector_elements(vector)) for vector in vectors]


def release(hier_block: Any) -> None:
    """Let GNU Radio free a hier block after its last run.

    One with message ports holds itself, and with it every buffer of its flowgraph: 60 shared memory segments for an
    OFDM receiver, of 4096 a system has.
    """
    hier_block.disconnect_all()


def pdr(phy: Phy, recording: Recording, channel: ChannelConfig) -> float:
    """Share of a recording's packets that arrive unaltered, 0..1."""
    arrived = set(deliver(phy, recording, channel))
    return sum(packet in arrived for packet in recording.packets) / len(recording.packets)
