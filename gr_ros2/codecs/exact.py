"""The codec of what no other codec takes: the message itself, by zstd.

Invariant: exact to the byte.
"""

from __future__ import annotations

from dataclasses import dataclass

from gr_ros2.codecs.base import MAX_SIZE, Coded, frame, opened
from gr_ros2.codecs.pack import Packer
from gr_ros2.core.errors import DamagedError

_LEVEL = 6
"""Of zstd; an image of 1 MB takes some 20 ms."""


@dataclass(frozen=True)
class ExactCodec:
    """Any message as zstd. It has no options."""

    type_name: str

    def encoder(self) -> ExactEncoder:
        return ExactEncoder()

    def decoder(self, max_size: int = MAX_SIZE) -> ExactDecoder:
        return ExactDecoder(max_size)

    @property
    def output(self) -> str:
        return self.type_name


class ExactEncoder:
    """Any message to frames."""

    def __init__(self) -> None:
        self._packer = Packer(_LEVEL)

    def encode(self, message: bytes, budget: int | None = None, key: bool = False) -> Coded:  # noqa: ARG002
        return frame(0, self._packer.pack(message))

    def confirmed(self, name: int) -> None:
        """Do nothing: no frame needs a confirmed one."""


class ExactDecoder:
    """Frames back to messages."""

    def __init__(self, max_size: int) -> None:
        self._packer, self._max_size = Packer(), max_size

    def decode(self, data: bytes) -> bytes:
        form, before, body = opened(data)
        if form or before is not None:
            raise DamagedError(f"damaged frame: no exact message has form {form}")
        return self._packer.unpack(body, self._max_size)
