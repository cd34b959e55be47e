"""What a robot would send if somebody asked for it, and what that would cost.

Invariants: what is offered is not subscribed unless somebody asks about it, and then for ``MEASURE_S`` at a time; what
was measured is good for ``GOOD_S``.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from threading import Event

from gr_ros2.core.errors import ConfigError, GrRos2Error
from gr_ros2.gr.factory import message_codec
from gr_ros2.middleware import Middleware, Qos, TopicInfo
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import DEFAULT_OPTIONS, Topic, normalize_type
from gr_ros2.settings.service_rows import ServiceRow

MEASURE_S, GOOD_S = 2.0, 60.0
_HISTORY_S = 0.5
"""s of a measurement in which publishers are found, and send what they keep for late subscribers."""
_SAMPLES = 3
"""Messages that are coded to find how long they are as they are sent."""


@dataclass(frozen=True, slots=True)
class OpenTopic:
    """A topic of the ROS graph, or a service, an action or a node, which is not sent.

    :param name: by which it is sent, and asked for
    :param on_graph: absolute name
    :param info: of a topic
    :param rows: of a service, an action or a node
    """

    name: str
    on_graph: str
    info: TopicInfo | None = None
    rows: tuple[ServiceRow, ...] = ()
    options: SendOptions = DEFAULT_OPTIONS

    @property
    def type_name(self) -> str:
        """Its type, or what stands in its place."""
        return ", ".join(row.kind for row in self.rows) if self.info is None else self.info.type_name

    @property
    def fits(self) -> bool:
        """Whether its messages are made to fit what the air has."""
        return self.info is not None and self._topic(0).as_frames

    def at(self, rate: float) -> SendOptions:
        """Its options, with so many messages/s at most; 0 = as its own options have it."""
        own = self.options.max_rate
        return replace(self.options, max_rate=min(rate, own) if rate and own else rate or own)

    def coded(self, messages: Iterable[bytes]) -> float:
        """Bytes of some messages as they are sent, on average.

        :raises ConfigError: for a type or an option that cannot be sent
        """
        codec = message_codec([self._topic(0)])
        sizes = [len(codec.encode(0, message)) for message in messages]
        return sum(sizes) / len(sizes)

    def _topic(self, topic_id: int) -> Topic:
        return Topic(topic_id, self.name, normalize_type(self.type_name), self.options)


@dataclass(slots=True)
class MeasuredTopic:
    """What came of a topic.

    :param at: when, s
    :param rate: messages/s; 0 = not known
    :param size: bytes of a message as it is sent; 0 = not known
    """

    at: float
    rate: float = 0.0
    size: float = 0.0


@dataclass(slots=True)
class _Probe:
    began: float = field(default_factory=time.monotonic)
    times: list[float] = field(default_factory=list)
    newest: list[bytes] = field(default_factory=list)

    def take(self, payload: bytes) -> None:
        self.times.append(time.monotonic())
        self.newest = [*self.newest[1 - _SAMPLES :], payload]


def rate_of(times: Sequence[float], began: float) -> float:
    """How often messages come, per s; 0 = not known.

    :param times: when they came, s
    :param began: when the subscription was made, s
    """
    new = [at for at in times if at - began > _HISTORY_S]
    if len(new) > 1 and (span_s := new[-1] - new[0]) > MEASURE_S / 4:
        return (len(new) - 1) / span_s
    return len(new) / (MEASURE_S - _HISTORY_S)


class Measurements:
    """How often messages of offered topics come, and how long they are.

    :param ended: set when nobody waits for a measurement any more
    """

    def __init__(self, graph: Middleware, clock: Callable[[], float], ended: Event, *, coded: bool) -> None:
        self._graph, self._clock, self._ended, self._coded = graph, clock, ended, coded
        self._measured: dict[tuple[str, str], MeasuredTopic] = {}

    def measure(self, offers: Iterable[OpenTopic]) -> dict[str, MeasuredTopic]:
        """What is known of some topics, by their names; where nothing is, they are measured now, all at once."""
        topics = [offered for offered in offers if offered.info is not None]
        keys = {offered.name: (offered.name, offered.type_name) for offered in topics}
        now = self._clock()
        self._measured = {key: was for key, was in self._measured.items() if now - was.at < GOOD_S}
        new = [offered for offered in topics if keys[offered.name] not in self._measured]
        probes = {offered.name: _Probe() for offered in new}
        subscriptions = []
        try:
            for offered in new:
                qos = Qos(None, None, 10)
                try:
                    subscriptions.append(
                        self._graph.subscribe(offered.on_graph, offered.type_name, qos, probes[offered.name].take)
                    )
                except GrRos2Error:
                    continue  # it cannot be sent either, which is said where it is tried
            if subscriptions:
                self._ended.wait(MEASURE_S)
        finally:
            for subscription in subscriptions:
                subscription.close()
        for offered in new:
            self._measured[keys[offered.name]] = self._found(offered, probes[offered.name])
        return {name: self._measured[key] for name, key in keys.items()}

    def _found(self, offered: OpenTopic, probe: _Probe) -> MeasuredTopic:
        found = MeasuredTopic(self._clock())
        found.rate = rate_of(probe.times, probe.began)
        if probe.newest:
            found.size = sum(map(len, probe.newest)) / len(probe.newest)
            if self._coded and not offered.fits:
                with suppress(ConfigError):  # as above
                    found.size = offered.coded(probe.newest)
        return found
