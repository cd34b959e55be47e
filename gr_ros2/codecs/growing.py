"""The codec of latched messages that grow, such as a path or an octree: exact, as what zstd makes of them where it may
refer to one that was confirmed. A cloud that is sent whole is coded as other clouds are.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

from gr_ros2.codecs.base import MAX_SIZE, Coded, frame
from gr_ros2.codecs.changes import CHANGES, ChangesDecoder, ChangesEncoder
from gr_ros2.codecs.cloud import CloudCodec
from gr_ros2.codecs.messages import CLOUD
from gr_ros2.codecs.pack import Packer
from gr_ros2.compression import bounds
from gr_ros2.compression.zstd_frames import Zstd
from gr_ros2.core.errors import CodecError, DamagedError

_CLOUD = CHANGES + 1
"""Form of a cloud that is sent whole."""
_LEVEL = 6
"""Of zstd: 1 MB takes some 20 ms."""
_SHORTEST = 8
"""Bytes of the shortest message, and of the shortest that zstd refers to."""


@dataclass(frozen=True)
class GrowingCodec:
    """Messages as what has changed. It has no options."""

    type_name: str

    def encoder(self) -> GrowingEncoder:
        return GrowingEncoder(self.type_name)

    def decoder(self, max_size: int = MAX_SIZE) -> GrowingDecoder:
        return GrowingDecoder(max_size)

    @property
    def output(self) -> str:
        return self.type_name


class GrowingEncoder(ChangesEncoder[bytes]):
    """Messages to frames."""

    small = 0.25

    def __init__(self, type_name: str) -> None:
        super().__init__(Packer(_LEVEL))
        self._cloud = CloudCodec(CLOUD).encoder() if type_name == CLOUD else None

    def _read(self, message: bytes) -> bytes:
        return _begun(message)

    def _changes(self, base: bytes, read: bytes) -> bytes:
        return Zstd(base, _LEVEL).compress(read, least=bounds.least(len(read)))

    def _whole(self, message: bytes) -> Coded:
        found = [super()._whole(message)]
        if self._cloud is not None:
            with suppress(CodecError, ValueError, OverflowError):  # it contradicts itself
                found.append(frame(_CLOUD, self._cloud.encode(message).data))
        return min(found, key=lambda made: len(made.data))


class GrowingDecoder(ChangesDecoder[bytes]):
    """Frames back to messages."""

    last = _CLOUD

    def __init__(self, max_size: int) -> None:
        super().__init__(max_size)
        self._cloud = CloudCodec(CLOUD).decoder(max_size)

    def _read(self, message: bytes) -> bytes:
        return _begun(message)

    def _size(self, read: bytes) -> int:
        return len(read)

    def _unpacked(self, form: int, body: bytes) -> bytes:
        return self._cloud.decode(body) if form == _CLOUD else super()._unpacked(form, body)

    def _changed(self, body: bytes, base: bytes) -> bytes:
        return Zstd(base).decompress(body, min(self._max_size, bounds.largest(len(body))))


def _begun(message: bytes) -> bytes:
    """The message, which begins as DDS writes one: later ones refer to it.

    :raises DamagedError: for other bytes, some of which zstd would take for a dictionary with tables of its own
    """
    if len(message) < _SHORTEST or message[0]:
        raise DamagedError(f"damaged message: {len(message)} bytes that do not begin as a message")
    return message
