"""Topics that many things share: what a message speaks of, and which messages newer ones replace.

DDS calls such a thing an *instance*: one frame of ``/tf``, one device of ``/diagnostics``. Where a latched topic has
several publishers, each of them is one.

Invariant: of each instance the newest message is replaced by none.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, Protocol, TypeVar

from gr_ros2.settings.registry import Topic

Keys = frozenset[Hashable]
"""The instances that a message speaks of. Without any, every later message of its topic replaces it."""
ALL: Keys = frozenset()


class InstanceKeys(Protocol):
    """The instances of one topic.

    :ivar separate: whether messages can differ in more than their instances, so that they cannot always be merged
    """

    separate: bool

    def keys(self, message: bytes) -> Sequence[Hashable]:
        """The instances that a message speaks of.

        :raises CodecError: not a message of the type
        """

    def merged(self, waiting: Sequence[bytes], message: bytes) -> bytes:
        """A message with all that it and those before it say, the newest of each instance, as far as they differ in
        nothing else.

        :raises CodecError: not messages of the type
        """


InstancesOf = Callable[[Topic, "Mapping[str, Any] | None"], "InstanceKeys | None"]
"""Makes the instances of a topic, None where it has none, from the definitions of its type if they were not known."""


def no_instances(topic: Topic, definitions: Mapping[str, Any] | None = None) -> InstanceKeys | None:  # noqa: ARG001
    """All messages of a topic speak of the same."""
    return None


class Speaking(Protocol):
    """:ivar keys: the instances that it speaks of"""

    keys: Keys


S = TypeVar("S", bound=Speaking)


def replaced(earlier: Sequence[S], keys: Keys) -> list[S]:
    """Those of some messages, the oldest first, of whose instances each has a newer one.

    :param keys: the instances of the newest message
    """
    gone = []
    for message in reversed(earlier):
        if message.keys <= keys:
            gone.append(message)
        keys |= message.keys
    return gone[::-1]
