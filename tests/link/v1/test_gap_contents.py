"""A gap is known to hold nothing but fragments only if their bytes fill it exactly."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.core.tuning import Tuning
from gr_ros2.link.v1.decoder import RepairDecoder
from gr_ros2.link.v1.gap_contents import GapContents
from gr_ros2.wire.v1 import Part, fit, write_body

TUNING = Tuning()

ROOM = 100
SHORT, LONG = 0, 1
PACKETS = st.lists(st.tuples(st.integers(0, 3), st.booleans()), min_size=2, max_size=60)


@given(PACKETS, st.integers(1, 5))
def test_only_gaps_filled_by_a_message_are_noted(packets: list[tuple[int, bool]], begin: int) -> None:
    """Packets of a long message, with some short ones before its fragments; some packets are lost."""
    decoder = RepairDecoder(ROOM, lambda _: True, 1000)
    contents = GapContents(decoder, ROOM, TUNING)
    offset = 0
    for index, (count, lost) in enumerate(packets):
        short = [Part(SHORT, b"short", last=True)] * count
        used = count * fit(ROOM, 5, 0, 0)[1]
        size = fit(ROOM - used, 10**6, index, offset)[0]
        body = write_body([*short, Part(LONG, bytes(size), index if offset else 0, offset, last=False)], ROOM)
        offset += size
        if not lost:
            decoder.source(begin + index, body)
            contents.learn(begin + index)
    first = next((index for index, (_, lost) in enumerate(packets) if not lost), len(packets))
    gap: list[int] = []
    for index, (_, lost) in enumerate(packets):
        if lost:
            gap.append(index)
            continue
        pure = bool(gap) and not any(packets[member][0] for member in gap)
        for member in gap:
            assert contents.may_carry(begin + member, LONG)
            assert contents.may_carry(begin + member, SHORT) is (not pure or index == first)
        gap = []
    assert all(contents.may_carry(begin + member, SHORT) for member in gap)
