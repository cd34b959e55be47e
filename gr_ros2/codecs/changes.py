"""What codecs have in common whose frames say what has changed since a message that all receivers have confirmed.

Invariants: exact to the byte; changes refer to a message that all receivers have decoded, as far as the encoder was
told, and are sent only where they are short, or shorter than the whole message; both ends keep the newest ``KEPT``
messages, and an encoder refers to no other.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import OrderedDict
from typing import ClassVar, Generic, TypeVar

from gr_ros2.codecs.base import Coded, frame, name_of, opened
from gr_ros2.codecs.pack import Packer
from gr_ros2.core.errors import DamagedError, MissingFrameError

WHOLE, CHANGES = range(2)
"""Forms of frames."""
KEPT = 4
_Read = TypeVar("_Read")
"""A message as its codec keeps it."""


def _keep(messages: OrderedDict[int, _Read], name: int, message: _Read) -> None:
    """Keep a message as the newest, by the name of its frame. Equal ones have one name."""
    messages[name] = message
    messages.move_to_end(name)
    while len(messages) > KEPT:
        messages.popitem(last=False)


class ChangesEncoder(ABC, Generic[_Read]):
    """Messages to frames.

    :param packer: packs whole messages
    """

    small: ClassVar[float] = 0.0
    """Part of a message below which its changes are sent without a look at how long all of it would be."""

    def __init__(self, packer: Packer) -> None:
        self._packer = packer
        self._sent: OrderedDict[int, _Read] = OrderedDict()
        self._base: int | None = None
        """The newest message that was confirmed, by the name of its frame."""

    @abstractmethod
    def _read(self, message: bytes) -> _Read:
        """:raises DamagedError: for a message that contradicts itself"""

    @abstractmethod
    def _changes(self, base: _Read, read: _Read) -> bytes:
        """What has changed since an earlier message."""

    def encode(self, message: bytes, budget: int | None = None, key: bool = False) -> Coded:  # noqa: ARG002
        read, changes = self._read(message), None
        if key:
            self._sent.clear()
            self._base = None
        elif self._base is not None and self._base in self._sent:
            changes = frame(CHANGES, self._changes(self._sent[self._base], read), self._base)
        if changes is not None and len(changes.data) < self.small * len(message):
            coded = changes
        else:
            whole = self._whole(message)
            coded = whole if changes is None or len(whole.data) <= len(changes.data) else changes
        _keep(self._sent, coded.name, read)
        return coded

    def _whole(self, message: bytes) -> Coded:
        return frame(WHOLE, self._packer.pack(message))

    def confirmed(self, name: int) -> None:
        if name in self._sent:
            self._base = name
            while next(iter(self._sent)) != name:
                self._sent.popitem(last=False)


class ChangesDecoder(ABC, Generic[_Read]):
    """Frames back to messages.

    :param max_size: bytes of the largest message that it makes
    """

    last: ClassVar[int] = CHANGES
    """The last form of frames."""

    def __init__(self, max_size: int) -> None:
        self._packer, self._max_size = Packer(), max_size
        self._kept: OrderedDict[int, _Read] = OrderedDict()

    @abstractmethod
    def _read(self, message: bytes) -> _Read:
        """:raises DamagedError: not a message of this codec"""

    def _unpacked(self, form: int, body: bytes) -> bytes:  # noqa: ARG002 - there is one
        return self._packer.unpack(body, self._max_size)

    @property
    def held(self) -> int:
        """Bytes in use."""
        return sum(map(self._size, self._kept.values()))

    @abstractmethod
    def _size(self, read: _Read) -> int:
        """Bytes of a message that is kept."""

    @abstractmethod
    def _changed(self, body: bytes, base: _Read) -> bytes:
        """A message, from what has changed since an earlier one.

        :raises DamagedError: it does not fit that one
        """

    def decode(self, data: bytes) -> bytes:
        form, before, body = opened(data)
        if form > self.last or (form == CHANGES) != (before is not None):
            raise DamagedError(f"damaged frame: no form {form}")
        if before is None:
            message = self._unpacked(form, body)
        else:
            base = self._kept.get(before)
            if base is None:
                raise MissingFrameError("the message that this one changes was not decoded here")
            message = self._changed(body, base)
        _keep(self._kept, name_of(data), self._read(message))
        return message
