"""What is closed at the end of a ``with`` statement."""

from __future__ import annotations

from abc import abstractmethod
from typing import TypeVar

_Self = TypeVar("_Self", bound="Closing")


class Closing:
    """Mix-in: a ``with`` statement calls :meth:`close` at its end, whatever happens in it."""

    @abstractmethod
    def close(self) -> None: ...

    def __enter__(self: _Self) -> _Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()
