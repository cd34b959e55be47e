"""Bytes from a serial line or a TNC: whatever they are, bounded memory, and the next packet is read."""

from __future__ import annotations

import random
from functools import partial

from fuzz.loop import main, within
from gr_ros2.radio.framing import Cobs, Framing, Kiss, Slip
from gr_ros2.radio.kiss import Ax25Kiss, KissOptions

BASE, PER_BYTE = 300, 16
"""Lines of Python that a piece of the stream may take, and more for each byte of it: every byte may end a frame, which
takes ten to fourteen lines, however long the piece is."""
LONGEST = 300
_TNC = KissOptions(device="tcp://localhost:8001", callsign="N0CALL")
_PACKET = b"\0\xc0\xdb" + bytes(range(61))


def framings() -> list[Framing]:
    """One of each kind."""
    return [Slip(LONGEST), Cobs(LONGEST), Kiss(LONGEST), Ax25Kiss(LONGEST, None, _TNC)]


def framing(data: bytes) -> None:
    """Feed the bytes in two pieces, end the frame that they have begun, and send a packet."""
    for one in framings():
        half = len(data) // 2
        for part in (data[:half], data[half:]):
            within(BASE + PER_BYTE * len(part), partial(list, one.feed(part)))
        assert one.held <= 2 * LONGEST + 64
        assert all(len(packet) <= LONGEST for packet in one.feed(one.delimiter))
        assert list(one.feed(one.frame(_PACKET))) == [_PACKET]


def corpus() -> list[bytes]:
    """Frames of all kinds, alone and one after the other."""
    rng = random.Random(1)
    frames = [one.frame(rng.randbytes(length)) for one in framings() for length in (1, 64, 254, 255, LONGEST)]
    ends = [pattern * 2000 for pattern in (b"\0", b"\xc0", b"\xc0\0", b"\0\1", b"\xc0\xdb")]
    return [b"", bytes(8), b"\xc0" * 8, b"\xdb" * 8, *frames, b"".join(frames), *ends]


if __name__ == "__main__":
    main(framing, corpus())
