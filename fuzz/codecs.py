"""Frames of pictures, depth, clouds and maps: any bytes give a message or a CodecError, with bounded work.

The decoder is new for every input and has decoded a key frame of the topic first, so that frames that need another are
reached, too.
"""

from __future__ import annotations

import random
from functools import cache, partial

from fuzz.loop import main, within
from gr_ros2.codecs import Decoder
from gr_ros2.core.errors import CodecError
from tests.codecs.samples import SAMPLES

MOST_LINES = 60_000
"""Lines of Python that two frames may take; FFmpeg, zstd and numpy do their work within the sizes that are checked."""
_MAX_SIZE = 1 << 20
_NAMES = tuple(SAMPLES)


def codecs(data: bytes) -> None:
    """The first byte chooses the topic, the second whether the frame follows a key frame, the rest is the frame."""
    name = _NAMES[(data[0] if data else 0) % len(_NAMES)]
    decoder = SAMPLES[name].topic().decoder(_MAX_SIZE)
    within(MOST_LINES, partial(_decode, decoder, _frames(name)[0], data[1:2] < b"\x80", data[2:]))


def _decode(decoder: Decoder, key: bytes, after_key: bool, data: bytes) -> None:
    if after_key:
        decoder.decode(key)
    try:
        assert len(decoder.decode(data)) <= _MAX_SIZE
    except CodecError as error:
        assert error.fate in ("damaged", "unsupported")
    assert decoder.decode(key)


@cache
def _frames(name: str) -> tuple[bytes, ...]:
    """A key frame of a sample, and frames that follow it."""
    sample = SAMPLES[name]
    encoder, found = sample.topic().encoder(), []
    for message in sample.messages()[:3]:
        coded = encoder.encode(message, sample.budget and min(sample.budget, 400))
        encoder.confirmed(coded.name)
        found.append(coded.data)
    return tuple(found)


def corpus() -> list[bytes]:
    """Frames of every sample, after a key frame and alone; and claims of large pictures and maps."""
    rng = random.Random(3)
    found = [b"", b"\0"]
    for number, name in enumerate(SAMPLES):
        for frame in _frames(name):
            found += [bytes([number, 0]) + frame[:3000], bytes([number, 0xFF]) + frame[:3000]]
        head = _frames(name)[0][:2]
        found += [bytes([number, 0]) + head + b"\xff\xff\x03" * 4 + rng.randbytes(30)]
    return found


if __name__ == "__main__":
    main(codecs, corpus())
