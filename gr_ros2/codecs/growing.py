"""The codec of latched messages that grow, such as a path or an octree: exact, as what zstd makes of them where it may
refer to one that was confirmed. A cloud that is sent whole is coded as other clouds are.

Invariants: exact to the byte; changes refer to a message that all receivers have decoded, as far as the encoder was
told; a decoder keeps at most ``KEPT`` messages, and an encoder refers to no other.
"""

from __future__ import annotations

from collections import OrderedDict
from contextlib import suppress
from dataclasses import dataclass

from gr_ros2.codecs.base import MAX_SIZE, Coded, frame, keep, name_of, opened
from gr_ros2.codecs.cloud import CloudCodec
from gr_ros2.codecs.messages import CLOUD
from gr_ros2.codecs.pack import Packer
from gr_ros2.compression import bounds
from gr_ros2.compression.zstd_frames import Zstd
from gr_ros2.core.errors import CodecError, DamagedError, MissingFrameError

_WHOLE, _CHANGES, _CLOUD = range(3)
_LEVEL = 6
"""Of zstd: 1 MB takes some 20 ms."""
_SMALL = 0.25
"""Part of a message below which its changes are sent without a look at how long all of it would be."""


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


class GrowingEncoder:
    """Messages to frames."""

    def __init__(self, type_name: str) -> None:
        self._packer = Packer(_LEVEL)
        self._cloud = CloudCodec(CLOUD).encoder() if type_name == CLOUD else None
        self._sent: OrderedDict[int, bytes] = OrderedDict()
        self._base: int | None = None
        """The newest message that was confirmed, by the name of its frame."""

    def encode(self, message: bytes, budget: int | None = None, key: bool = False) -> Coded:  # noqa: ARG002
        if key:
            self._sent.clear()
            self._base = None
        changes = self._changes(message)
        if changes is not None and len(changes.data) < _SMALL * len(message):
            coded = changes
        else:
            whole = self._whole(message)
            coded = whole if changes is None or len(whole.data) <= len(changes.data) else changes
        keep(self._sent, coded.name, message)
        return coded

    def _changes(self, message: bytes) -> Coded | None:
        """The frame of what has changed since the newest message that was confirmed; None without one."""
        if self._base is None or self._base not in self._sent:
            return None
        packed = Zstd(self._sent[self._base], _LEVEL).compress(message, least=bounds.least(len(message)))
        return frame(_CHANGES, packed, self._base)

    def _whole(self, message: bytes) -> Coded:
        """The frame of a message by itself."""
        found = [frame(_WHOLE, self._packer.pack(message))]
        if self._cloud is not None:
            with suppress(CodecError, ValueError, OverflowError):  # it contradicts itself
                found.append(frame(_CLOUD, self._cloud.encode(message).data))
        return min(found, key=lambda made: len(made.data))

    def confirmed(self, name: int) -> None:
        if name in self._sent:
            self._base = name
            while next(iter(self._sent)) != name:
                self._sent.popitem(last=False)


class GrowingDecoder:
    """Frames back to messages."""

    def __init__(self, max_size: int) -> None:
        self._packer, self._max_size = Packer(), max_size
        self._cloud = CloudCodec(CLOUD).decoder(max_size)
        self._kept: OrderedDict[int, bytes] = OrderedDict()

    @property
    def held(self) -> int:
        """Bytes in use."""
        return sum(map(len, self._kept.values()))

    def decode(self, data: bytes) -> bytes:
        form, before, body = opened(data)
        if form > _CLOUD or (form == _CHANGES) != (before is not None):
            raise DamagedError(f"damaged frame: no form {form}")
        if before is None:
            message = self._cloud.decode(body) if form == _CLOUD else self._packer.unpack(body, self._max_size)
        else:
            base = self._kept.get(before)
            if base is None:
                raise MissingFrameError("the message that this one changes was not decoded here")
            self._kept.move_to_end(before)
            message = Zstd(base).decompress(body, min(self._max_size, bounds.largest(len(body))))
        keep(self._kept, name_of(data), message)
        return message
