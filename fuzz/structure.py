"""What a robot announces about the coding of a topic, and a message coded that way: a message or a CodecError, in time.

A table of topics comes from another robot, so its texts may be anything.
"""

from __future__ import annotations

import random
from functools import partial

from fuzz.loop import main, within
from gr_ros2.compression import LinkCodec
from gr_ros2.core.errors import CodecError
from gr_ros2.settings.registry import Topic

BASE, PER_BYTE = 500_000, 500
"""Lines of Python for an announcement and a message, and more for each byte of the message. A structure is prepared
once, when its table arrives."""
_MAX_SIZE = 1 << 20
_TOPIC = Topic(0, "topic", "my_msgs/msg/Thing")
_STRUCTURES = (
    "TssdddR36ddddddd36d", "Ts*s*d*d*d", "*(TssiiidddRdddffffTB*(ddd)*(ffff)sTss*B*(ff)sss*BB)", "*(*(*(s)))",
    "9999999d", "99(99(99(d)))", "9999(*d)", "*" + "(*" * 8 + "d" + ")" * 8, "640i", "16000000B",
)  # fmt: skip


def structure(data: bytes) -> None:
    """The first byte is the length of the structure, then the structure, then the coded message."""
    length = data[0] if data else 0
    text, coded = data[1 : 1 + length].decode("latin-1"), data[1 + length :]
    within(BASE + PER_BYTE * len(coded), partial(_decode, LinkCodec((), max_size=_MAX_SIZE), text, coded))


def _decode(codec: LinkCodec, text: str, coded: bytes) -> None:
    told = codec.of([_TOPIC], {0: f"auto {text}"})
    held = told._topics[0]._held  # to reach the structure whatever its mark
    for key in [key for key in held if key[0] == 14]:
        held[b"\x0e\0\0"] = held[key]
    try:
        message = told.decode(0, coded)
    except CodecError as error:
        assert error.fate in ("damaged", "unsupported", "unknown_dictionary")
        return
    assert len(message) <= _MAX_SIZE


def corpus() -> list[bytes]:
    """Structures of ROS types, and such as claim to be large, with messages of any content."""
    rng = random.Random(7)
    found = [b"", b"\0"]
    for text in _STRUCTURES:
        head = bytes([len(text)]) + text.encode()
        for first in (0xE2, 0xE2, 0xE3):
            found.append(head + bytes([first, 0, 0]) + rng.randbytes(40))
        found.append(head + b"\xe2\0\0" + b"\xff" * 60)
    return found


if __name__ == "__main__":
    main(structure, corpus())
