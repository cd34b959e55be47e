"""Received packets, field by field, for people.

Law: whatever the bytes, there is a view of them; what is no packet says why.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import lru_cache

from gr_ros2.dashboard.views import EntryView, PacketView
from gr_ros2.registry import Registry
from gr_ros2.wire import Packet, WireError, decode, pad_len

NO_COLOUR = -1
"""Of a topic that is not ours."""

_QOS = ("default", "latency", "bulk", "default")
_SEQ_MODULUS = 256


def packet_views(
    packets: Iterable[tuple[float, bytes]],
    packet_len: int,
    registry: Registry,
    colours: Mapping[tuple[int, int], int],
    start: float,
) -> tuple[PacketView, ...]:
    """Packets as they came, each with how many of its source went missing since the one before.

    :param packets: time, s, and bytes
    :param colours: place in the palette by source id and topic id
    :param start: s on the same clock, when the run began
    """
    views, last_seq = [], dict[int, int]()
    for t, data in packets:
        try:
            packet = _decode(data, packet_len)
        except WireError as error:
            views.append(PacketView(t - start, len(data), refused=f"{error.kind}: {error}"))
            continue
        before = last_seq.get(packet.src_id)
        missing = 0 if before is None else (packet.seq - before - 1) % _SEQ_MODULUS
        last_seq[packet.src_id] = packet.seq
        entries = tuple(
            EntryView(
                registry[entry.topic_id].name if entry.topic_id < len(registry) else f"topic {entry.topic_id}",
                colours.get((packet.src_id, entry.topic_id), NO_COLOUR),
                entry.entry_id,
                entry.index,
                entry.total,
                len(entry.payload),
            )
            for entry in packet.entries
        )
        views.append(
            PacketView(
                t - start,
                len(data),
                version=packet.version,
                qos=_QOS[packet.qos],
                compressed=packet.compressed,
                encrypted=packet.encrypted,
                src_id=packet.src_id,
                dst_id=packet.dst_id,
                seq=packet.seq,
                hop=packet.hop,
                entries=entries,
                pad=pad_len(packet_len, [len(entry.payload) for entry in packet.entries]),
                missing=missing,
            )
        )
    return tuple(views)


@lru_cache(maxsize=64)
def _decode(data: bytes, packet_len: int) -> Packet:
    return decode(data, packet_len)
