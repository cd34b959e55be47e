"""What a codec of a topic is: messages in, frames of fewer bytes out, and back.

A frame is a byte with its form, bit 7 of which says that it needs another frame; then four bytes that name that frame
(the CRC-32 of its bytes), where it needs one; then what the form says. A frame that needs none is a *key frame*. Since
a name covers the name in its frame, a chain of frames cannot be joined to another chain.

Invariants: a codec has no clock, thread, ROS or GNU Radio, and draws no random numbers, so equal messages and budgets
give equal frames; a decoder shows no frame without the frame that it needs; arbitrary bytes give a message or a
CodecError, with memory and time that ``max_size`` bounds; after an error the next key frame is decoded.
"""

from __future__ import annotations

from binascii import crc32
from typing import NamedTuple, Protocol

from gr_ros2.core.errors import DamagedError

MAX_SIZE = 1 << 24
"""Bytes of the largest message that a decoder makes unless it is told otherwise."""
KEY_TIMES = 4
"""Budgets that a key frame of video has at most. With one, what is seen is coarse for a second."""
OF_CHAIN = 127
"""First byte of a frame of another chain than the first; the number of the chain and the frame follow. It is the
number of no codec."""
_FOLLOWS = 0x80
_NAME = 4
"""Bytes of a name."""


class Coded(NamedTuple):
    """One message as a frame.

    :param data: the frame
    :param name: by which later frames name this one
    :param before: name of the frame that it needs, None = none: a key frame
    :param said: what the frame leaves out, in words; '' = nothing
    """

    data: bytes
    name: int
    before: int | None = None
    said: str = ""


class Encoder(Protocol):
    """One topic at its sender."""

    def encode(self, message: bytes, budget: int | None = None, key: bool = False) -> Coded:
        """A message as a frame.

        :param message: as DDS carries it, encapsulation header first
        :param budget: bytes that the frame may have, a key frame of video ``KEY_TIMES`` as many; codecs of exact
            messages do not heed it; None = as many as the options of the codec need
        :param key: make a key frame
        :raises DamagedError: for a message that contradicts itself, such as an image with too few bytes
        :raises UnfitError: for a message that the codec does not code
        """

    def confirmed(self, name: int) -> None:
        """All receivers have decoded the frame of this name. Names that are not known any more are no error."""


class Decoder(Protocol):
    """One topic of one sender at a receiver."""

    def decode(self, data: bytes) -> bytes:
        """The message of a frame, as DDS carries it.

        :raises DamagedError: not a frame of this codec, or a message larger than ``max_size``
        :raises MissingFrameError: the frame that it needs was not decoded here, or is too old
        """


class Codec(Protocol):
    """How one topic is coded: a dataclass whose first field is ``type_name``, the type of the topic's messages as
    ``package/msg/Type``. The other fields are the codec's options; a wrong one is a ConfigError."""

    def encoder(self) -> Encoder:
        """For the sender."""

    def decoder(self, max_size: int = MAX_SIZE) -> Decoder:
        """For the frames of one sender.

        :param max_size: bytes of the largest message that it makes
        """

    @property
    def output(self) -> str:
        """The type of the messages that the decoder makes."""


def frame(form: int, body: bytes, before: int | None = None, said: str = "") -> Coded:
    """A frame.

    :param form: 0..127, what the codec makes of ``body``
    :param before: name of the frame that it needs
    """
    head = bytes([form]) if before is None else bytes([form | _FOLLOWS]) + before.to_bytes(_NAME, "little")
    return Coded(head + body, name_of(head + body), before, said)


def name_of(data: bytes) -> int:
    """The name of a frame."""
    return crc32(data)


def opened(data: bytes) -> tuple[int, int | None, bytes]:
    """(form, name of the frame that is needed or None, body) of a frame.

    :raises DamagedError: too short
    """
    if not data or (data[0] & _FOLLOWS and len(data) < 1 + _NAME):
        raise DamagedError("damaged frame: it is cut short")
    if data[0] & _FOLLOWS:
        return data[0] & ~_FOLLOWS, int.from_bytes(data[1 : 1 + _NAME], "little"), data[1 + _NAME :]
    return data[0], None, data[1:]
