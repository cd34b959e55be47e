"""Topics that a link waits for because there is no publisher, and the topics that are published instead.

Invariant: a line is returned only if it has changed. A look changes nothing on the graph.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Sequence
from math import inf
from typing import TYPE_CHECKING

from gr_ros2.core.names import INFRASTRUCTURE, link_node
from gr_ros2.middleware import TopicInfo

if TYPE_CHECKING:
    from gr_ros2.gr.link_sending import LinkSendingBlock

_FIRST_S, _EVERY_S = 3.0, 10.0
"""s after which the graph has told most of what is on it, and s from one look at it to the next."""
ALL_THERE = "every topic has a publisher"
_SHOWN = 6
"""Largest number of topics that a line names. Further topics are only counted."""


_OF_A_LINK = re.compile(r"/gr_ros2_link_([0-9]+)/(?:statistics|transmit)")
"""A topic that every link with ``diagnostics`` publishes, and a service that every link has."""
_SHARED = ("/tf", "/tf_static")
"""Topics that many nodes publish together."""


def shortcut(names: Iterable[str], own: int, heard: Iterable[int]) -> str | None:
    """One line if another robot's link is on this robot's ROS graph: something other than the radio connects the two.

    :param names: topics that are published on the graph, and services
    :param own: this robot
    :param heard: the robots that are heard by radio
    """
    found = [match for name in names if (match := _OF_A_LINK.fullmatch(name)) is not None]
    others = sorted({int(match[1]) for match in found} - {own})
    if not others:
        return None
    nodes = ", ".join(map(link_node, others))
    also = ", which is heard by radio too" if set(others) & set(heard) else ""
    return (
        f"{nodes} is on this robot's ROS graph{also}: something other than the radio connects the robots, such as a "
        "cable or Wi-Fi; set another ROS_DOMAIN_ID at each, or ROS_LOCALHOST_ONLY=1"
    )


def foreign(published: Iterable[str], outputs: Iterable[str]) -> str | None:
    """One line if somebody else publishes where this link does: what is received there did not all come by radio.

    :param published: topics with a publisher other than this link
    :param outputs: topics under which this link publishes what it hears
    """
    both = sorted(set(published) & set(outputs) - set(_SHARED))
    if not both:
        return None
    return (
        f"{_listed(both)}: another program on this robot's ROS graph publishes there too, so not everything there came "
        "over this link; end it, or set publish.as"
    )


class NewFindings:
    """Tells what a person should know about a link, each line once.

    :param look: returns all lines that are true now
    """

    def __init__(self, look: Callable[[], Sequence[str]]) -> None:
        self._look = look
        self._told: set[str] = set()
        self._at = -inf

    def new(self, now: float) -> list[str]:
        """The lines that were not told before; now and then it looks.

        :param now: s, monotonic
        """
        if self._at == -inf:
            self._at = now + _FIRST_S
        if now < self._at:
            return []
        self._at = now + _EVERY_S
        lines = [line for line in self._look() if line not in self._told]
        self._told.update(lines)
        return lines


class Waiting:
    """Checks whether the topics of a link have publishers.

    :param source: source of an open link
    """

    def __init__(self, source: LinkSendingBlock) -> None:
        self._source = source
        self._last = ALL_THERE
        self._had: set[str] = set()
        """Topics that had a publisher at an earlier look."""

    def look(self) -> str | None:
        """One line for the user; None if the last line is still true. At first, every topic is assumed to have a
        publisher.

        :raises MiddlewareError: when the graph cannot be asked
        """
        missing = [name for block in self._source.together for name in block.found.unmatched()]
        types = {name: topic.type_name for name, topic in self._source.sent.items()}
        self._had |= types.keys() - set(missing)
        line = waiting_line(missing, types, self._others(), left=self._had) if missing else self._sent()
        if line == self._last:
            return None
        self._last = line
        return line

    def _others(self) -> list[TopicInfo]:
        """What is on the graph, except for what will be sent at once."""
        infos, choice = self._source.middleware.discover(), self._source.found.choice
        return [info for info in infos if choice.row_name(info.topic) is None]

    def _sent(self) -> str:
        """That every topic has a publisher; with the topics and services, where the user did not name them."""
        if not self._source.found.choice.open:
            return ALL_THERE
        topics = [name for name, topic in self._source.sent.items() if not topic.action]
        found = self._source.found.offered
        offered = f"; services and actions: {_listed(sorted(found))}" if found else ""
        return f"{ALL_THERE}: {_listed(topics)}{offered}"


def waiting_line(
    missing: Sequence[str], types: dict[str, str], found: Sequence[TopicInfo], *, left: Collection[str] = ()
) -> str:
    """The topics that a link waits for, and the topics that are published instead. Similar topics come first.

    :param missing: topics without a publisher, at least one
    :param types: type of every topic of the link, by name
    :param found: topics on the graph
    :param left: topics that had a publisher: where one is missing, it has left
    """
    published = [info for info in found if info.publishers and info.topic not in INFRASTRUCTURE]
    wrong = [info for info in published if types.get(info.topic, info.type_name) != info.type_name]
    others = [info for info in published if info.topic not in types]
    last_names, wanted_types = {name.rpartition("/")[2] for name in missing}, {types.get(name) for name in missing}

    def meant(info: TopicInfo) -> tuple[bool, bool, str]:
        return info.topic.rpartition("/")[2] not in last_names, info.type_name not in wanted_types, info.topic

    never, gone = [name for name in missing if name not in left], [name for name in missing if name in left]
    parts = [
        f"no publisher on {_listed(names)} {when}" for names, when in ((never, "yet"), (gone, "any more")) if names
    ]
    line = "; ".join(parts)
    if wrong:
        line += "".join(f"; {info.topic} has another type, {info.type_name}" for info in wrong)
    if others:
        return f"{line}; seen on the graph: {_listed([info.topic for info in sorted(others, key=meant)])}"
    return line if wrong else f"{line}; nothing else is published on the graph"


def _listed(names: Sequence[str]) -> str:
    more = len(names) - _SHOWN
    return ", ".join(names[:_SHOWN]) + (f" and {more} more" if more > 0 else "")
