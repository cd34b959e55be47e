"""The symbols that a receiver of IEEE 802.11 frames decides: whatever they are, a packet or none, in bounded time."""

from __future__ import annotations

import random
from functools import partial

import numpy as np
from gnuradio import fec  # noqa: F401 - the decoder imports it at its first use, which is no work of a frame

from fuzz.loop import main, within
from gr_ros2.phy.wifi_frames import ENCODINGS, DataFrames, FrameDecoder

BASE, PER_BYTE = 1500, 1
"""Lines of Python that a frame may take, and more for each byte of it."""
_HEAD, _LONGEST = 3, 4096
_FRAMES = DataFrames("02:67:72:2d:72:32", "02:67:72:00:00:01")


def wifi(data: bytes) -> None:
    """An encoding, a length, and symbols, repeated as often as the frame needs; then the same bytes as a frame."""
    encoding = tuple(ENCODINGS.values())[data[0] % len(ENCODINGS)] if data else ENCODINGS["bpsk-1/2"]
    length = int.from_bytes(data[1:_HEAD], "big") % _LONGEST
    count = 48 * encoding.symbols(length - 36)
    symbols = np.resize(np.frombuffer(data[_HEAD:] or b"\0", np.uint8), count).reshape(-1, 48)
    within(BASE + PER_BYTE * length, partial(FrameDecoder().decode, encoding, length, symbols))
    frame = FrameDecoder().decode(encoding, length, symbols)
    assert frame is None or len(frame) == length - 4
    packet = _FRAMES.unwrap(data)
    assert packet is None or data.endswith(packet)
    assert _FRAMES.unwrap(_FRAMES.wrap(data, len(data))[:-4]) == data


def corpus() -> list[bytes]:
    """Short and long frames of every encoding, all zeros, all ones and noise; and frames of ours."""
    rng = random.Random(1)
    heads = [bytes([place]) + length.to_bytes(2, "big") for place in range(8) for length in (0, 4, 36, 100)]
    heads.append(b"\0" + (_LONGEST - 1).to_bytes(2, "big"))
    tails = (b"", b"\xff" * 48, rng.randbytes(480))
    return [*(head + tail for head in heads for tail in tails), _FRAMES.wrap(rng.randbytes(20), 1)[:-4]]


if __name__ == "__main__":
    main(wifi, corpus())
