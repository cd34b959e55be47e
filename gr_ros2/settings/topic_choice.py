"""The setting `topics`: words that choose which topics of a robot are sent, and which services it offers.

A word is a topic name, relative to the robot's namespace or absolute with leading slash. It may contain ``*`` (any
characters) and ``?`` (one character). ``auto`` stands for ``*``, every topic of the namespace. A word that begins with
``-`` leaves out what it names, in whatever order the words stand; if all words leave out, everything else is chosen.
Services and actions are chosen by the same words.

Invariants: a topic that a word names exactly is chosen even if it is hidden; ``*`` does not choose hidden topics, nor
those that every ROS node or a link itself has. Nothing here asks a graph.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any

from gr_ros2.core.names import INFRASTRUCTURE, OWN_NODES, topic_fault
from gr_ros2.settings.fields import AUTO

LEAVES_OUT = "-"
"""Before a word that leaves out what it names."""
_ALL, _WILD = "*", "*?"


def words_of(text: str) -> tuple[str, ...]:
    """The words in one text, separated by commas or spaces."""
    return tuple(text.replace(",", " ").split())


def checked_words(words: tuple[str, ...]) -> tuple[str, ...]:
    """:raises ValueError: for a word that can be no topic name"""
    for word in words:
        name = word.removeprefix(LEAVES_OUT)
        plain = "".join("x" if letter in _WILD else letter for letter in name)
        if fault := topic_fault(plain if plain.startswith("/") else f"/{plain}"):
            raise ValueError(f"{word!r} {fault}" if plain else "a word is empty")
    return words


def topics_of(given: Any) -> Any:
    """What a robot sends, as a mapping of words to options: ``auto, -camera/*``, a list of words, or the mapping."""
    if isinstance(given, str):
        given = words_of(given)
    if isinstance(given, Sequence):
        return {word: {} for word in given} if all(isinstance(word, str) for word in given) else given
    if isinstance(given, Mapping):
        return {word: {} if options in (None, "") else options for word, options in given.items()}
    return given


class TopicChoice:
    """What the words of the setting choose.

    :param words: as in the setting; none chooses nothing
    :param namespace: of the robot; '' is the root
    """

    def __init__(self, words: Sequence[str], namespace: str) -> None:
        self._namespace = f"/{namespace.strip('/')}/" if namespace.strip("/") else "/"
        self._left_out = [self._absolute(word[1:]) for word in words if word.startswith(LEAVES_OUT)]
        wanted = [word for word in words if not word.startswith(LEAVES_OUT)] or [_ALL] * bool(words)
        wanted = [_ALL if word == AUTO else word for word in wanted]
        self.named = {self._absolute(word): word for word in wanted if not is_wild(word)}
        """Topics that are named exactly: the word by its absolute name on the graph."""
        self.patterns = [word for word in wanted if is_wild(word)]
        """The words that may choose topics which are not named exactly."""
        self.open = bool(self.patterns)
        """Whether topics may be chosen that are not named exactly."""
        self.everything = ", ".join(map(self._absolute, self.patterns))
        """What these topics are, for a person: ``/robot_1/*``."""

    def __bool__(self) -> bool:
        return self.open or bool(self.named)

    def row_name(self, name: str, *, hidden: bool = False) -> str | None:
        """The name by which a topic of the graph is sent, or None if it is not chosen.

        A topic that was chosen by a relative word has a relative name.

        :param name: absolute name on the graph; that of a service, an action or a node for what these have
        :param hidden: whether only a word that names it exactly chooses it
        """
        if self.leaves_out(name):
            return None
        if name in self.named:
            return self.named[name]
        hidden = hidden or name in INFRASTRUCTURE or name.startswith(OWN_NODES)
        if hidden or "/_" in name:  # ROS hides what begins with _
            return None
        for pattern in self.patterns:
            if fnmatchcase(name, self._absolute(pattern)):
                return name if pattern.startswith("/") else name.removeprefix(self._namespace)
        return None

    def leaves_out(self, name: str) -> bool:
        """Whether a word leaves this out, by its absolute name on the graph."""
        return any(fnmatchcase(name, pattern) for pattern in self._left_out)

    def of(self, names: Iterable[str]) -> list[str]:
        """Those of some names, relative or absolute, that are chosen."""
        return [name for name in names if self.row_name(self._absolute(name)) is not None]

    def _absolute(self, name: str) -> str:
        return name if name.startswith("/") else self._namespace + name


def is_wild(word: str) -> bool:
    """Whether other characters may stand for some of a word."""
    return any(letter in word for letter in _WILD)
