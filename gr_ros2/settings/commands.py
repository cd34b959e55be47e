"""Which topics are commands: messages that move something, and must come in time or not at all.

A word of the setting ``commands`` is a message type or the name of a topic, in which ``*`` and ``?`` stand for others.
"""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase

COMMAND_TYPES = ("geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped", "sensor_msgs/msg/Joy")
COMMAND_DEADLINE_S = 0.3
"""s after which a command is not delivered any more, unless its topic's ``deadline_s`` says otherwise. A robot at 1 m/s
has gone 0.3 m since."""


def checked_commands(words: tuple[str, ...]) -> tuple[str, ...]:
    """:raises ValueError: for a word that is neither a type nor the name of a topic"""
    for word in words:
        if not word or any(letter.isspace() or letter == "," for letter in word):
            raise ValueError(f"{word!r} is neither a type such as {COMMAND_TYPES[0]} nor the name of a topic")
    return words


def is_command(name: str, type_name: str, words: Sequence[str]) -> bool:
    """Whether a topic is one of commands.

    :param name: as registered or announced, with or without leading slash
    """
    plain = name.lstrip("/")
    return any(word == type_name or fnmatchcase(plain, word.lstrip("/")) for word in words)
