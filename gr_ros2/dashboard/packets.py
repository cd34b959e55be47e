"""Views of received packets, field by field.

Invariant: there is a view of any bytes. The view of bytes that are not a packet gives the reason.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from gr_ros2.dashboard.topic_names import TopicNames
from gr_ros2.dashboard.views import PacketView, SpanView
from gr_ros2.link.events import Received, Rejected
from gr_ros2.wire import Packet, Span, format_of

NO_COLOUR = -1
"""Place in the palette of an unknown topic."""


def packet_views(
    events: Iterable[tuple[float, Received | Rejected]],
    packet_len: int,
    names: TopicNames,
    colours: Mapping[tuple[int, int], int],
    start: float,
) -> tuple[PacketView, ...]:
    """Packets in order of arrival, each with the number of packets of its source that are missing before it.

    :param events: time of arrival, s, and the packet
    :param colours: place in the palette by source id and topic id
    :param start: start of the run, s on the same clock
    """
    views, newest = [], dict[int, int]()
    for t, event in events:
        if isinstance(event, Rejected):
            views.append(PacketView(t - start, len(event.data), refused=f"{event.error.kind}: {event.error}"))
            continue
        packet = event.packet
        wire = format_of(packet.version)
        spans = tuple(
            _span(span, packet.src_id, names, colours)
            for span in wire.layout(packet, packet_len, len(event.data))
            if span.size
        )
        missing = missing_before(packet, newest)
        views.append(PacketView(t - start, len(event.data), packet, spans=spans, missing=missing))
    return tuple(views)


def missing_before(packet: Packet, newest: dict[int, int]) -> int:
    """Packets of the same source that are missing before this one.

    :param newest: newest number that is known of each source; brought up to date
    """
    ring = 1 << format_of(packet.version).number_bits
    ahead = (packet.seq - newest.get(packet.src_id, packet.seq)) % ring
    if ahead >= ring // 2:
        return 0  # an older packet, which came late or was sent again
    newest[packet.src_id] = packet.seq
    return max(ahead - packet.numbered, 0)


def _span(span: Span, src_id: int, names: TopicNames, colours: Mapping[tuple[int, int], int]) -> SpanView:
    entry = span.entry
    if entry is None:
        return SpanView(span.kind, span.size)
    text = f"{names.of((src_id, entry.topic_id))} {entry.label} {len(entry.payload)} B"
    return SpanView(span.kind, span.size, text, colours.get((src_id, entry.topic_id), NO_COLOUR))
