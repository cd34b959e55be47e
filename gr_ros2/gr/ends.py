"""Shared parts of the two blocks: settings, registry, participant on a ROS graph, and loop guard.

Invariant: a sink must not publish a topic that a source on the same graph subscribes to. Otherwise a message would
circulate without end. Each new block is checked against all other blocks of this process.
"""

from __future__ import annotations

import os
import random
import re
import secrets
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from gr_ros2.core.errors import ConfigError
from gr_ros2.link.access import Access
from gr_ros2.link.endpoint import Endpoint, EndpointV0
from gr_ros2.link.events import SenderEvent
from gr_ros2.link.message_codec import MessageCodec
from gr_ros2.link.rate import Mcs
from gr_ros2.link.v1.endpoint import EndpointV1
from gr_ros2.link.v1.endpoint_settings import settings_of
from gr_ros2.link.v1.replays import Save
from gr_ros2.link.v1.sealing import Keys
from gr_ros2.middleware import Middleware, join_graph, meet
from gr_ros2.settings.config import SinkConfig, SourceConfig, build, refuse_without_effect, robot_of
from gr_ros2.settings.fields import Auto
from gr_ros2.settings.registry import Registry, Topic
from gr_ros2.state.boots import RANDOM_BITS, BootFile
from gr_ros2.state.keys import read_key_file
from gr_ros2.wire import BROADCAST

if TYPE_CHECKING:
    from gr_ros2.compression import LinkCodec

_T = TypeVar("_T")

SHORTEST_WAIT_S = 2e-4
"""s for which the sending thread sleeps at least."""


def settings(
    cls: type[_T], values: Mapping[str, Any], registry: str | Registry, middleware: str | Middleware | None
) -> _T:
    """The configuration of a block from its keyword arguments.

    :raises ConfigError: for a wrong setting; the message names the key, the value and what is allowed
    """
    named = dict(values)
    if isinstance(registry, str):
        named["registry"] = registry
    if middleware is not None:
        named["middleware"] = middleware if isinstance(middleware, str) else middleware.name
    return build(cls, named)


def own_settings(config: SourceConfig | SinkConfig) -> dict[str, Any]:
    """The settings of a block as its keyword arguments, without ``registry`` and ``middleware``."""
    names = {item.name for item in fields(config)} - {"registry", "middleware"}
    return {name: getattr(config, name) for name in names}


def read_registry(registry: str | Registry, *, needed: bool = True) -> Registry:
    """Return a Registry as it is, or read it from a CSV file.

    :param needed: whether a registry is required. A receiver needs none if the senders announce their topics
    :raises ConfigError: when a required registry is missing, or the file is wrong
    """
    if isinstance(registry, Registry):
        return registry
    if not registry and not needed:
        return Registry.empty()
    if not registry:
        raise ConfigError("registry is missing; give the path of a CSV with rows of the form name,type")
    return Registry.from_csv(registry)


def message_codec(dictionaries: Sequence[str], registry: Sequence[Topic] = ()) -> LinkCodec:
    """The codec of a link.

    :param registry: with topic options applied
    :raises ConfigError: for a dictionary that cannot be read, or a wrong ``codec`` or ``quantize`` of a topic
    """
    from gr_ros2.compression import LinkCodec  # imported here: it takes longer than the rest of a block

    return LinkCodec(registry, dictionaries)


@dataclass(frozen=True)
class EndpointSetup:
    """What a version 1 endpoint must know about its robot's radio, and about the current start of its robot.

    :param boot: number of this start, greater than all earlier numbers
    :param heard: the last packet heard from each other robot before this start, by robot id: boot number and packet
        number
    :param save: stores ``heard``, see :class:`gr_ros2.state.boots.BootFile`
    :param reports: whether the robots from which it receives can also receive from it
    :param half_duplex: whether sending and receiving share the airtime
    :param any_length: whether the PHY carries shorter packets in less time, see :attr:`gr_ros2.phy.Phy.any_length`
    :param mcs_table: the rates of an adaptive rate, see :attr:`gr_ros2.phy.Phy.mcs_table`; () for a fixed rate
    :param access: makes what decides when the robot with an id may send; None from it: whenever there is a credit
    :param relay: whether messages of other robots are sent on
    :param lead_s: s before its burst begins at which a packet is composed that waits for its time
    :param airtime_share: part of the time that this robot may send, above 0..1
    :param close: lets another process start this robot; nothing is stored afterwards
    """

    boot: int = 1
    keys: Keys | None = None
    heard: Mapping[int, tuple[int, int]] = field(default_factory=dict)
    save: Save | None = None
    reports: bool = False
    half_duplex: bool = False
    any_length: bool = False
    mcs_table: Sequence[Mcs] = ()
    airtime_share: float = 1.0
    close: Callable[[], None] = lambda: None
    access: Callable[[int], Access | None] = lambda _: None
    relay: bool = False
    lead_s: float = 0.0


def make_endpoint(
    registry: Registry,
    source: SourceConfig | None,
    sink: SinkConfig | None,
    *,
    start: EndpointSetup | None = None,
    codec: MessageCodec | None = None,
    rng: random.Random | None = None,
    observer: Callable[[SenderEvent], None] | None = None,
    calls: bool = False,
) -> Endpoint:
    """Make one robot's end of a link, of the version in its settings.

    :param source: settings of the sending half; None: it sends nothing
    :param sink: settings of the receiving half; None: it receives nothing
    :param start: for version 1 only
    :param codec: codec of all messages; None: made here
    :param calls: whether services cross the link: the last topic of the endpoint's registry is for requests and replies
    :raises ConfigError: for settings that contradict each other
    """
    if registry.services and not calls:
        raise ConfigError(
            f"registry: {registry.services[0].name} is a service, which needs both directions of a link and version 1; "
            "take gr-ros2 link or RosLink"
        )
    topics = registry if source is None else registry.with_options(source.topic_options)
    end = source if source is not None else sink
    version = 1 if end is None else end.version
    for topic in topics:
        try:
            refuse_without_effect(topic.options, version, f"topic {topic.name}: ")
        except ValueError as error:
            raise ConfigError(f"registry: {error}") from None
    if calls:
        topics = topics.with_calls()
    to_air = None
    if source is not None and source.compresses:
        to_air = codec or message_codec(source.dictionaries, topics)
    dictionaries = () if sink is None else sink.dictionaries
    if not version:
        if start is not None and start.mcs_table:
            raise ConfigError("phy.options.rate = 'adaptive' with version 0, which has no reports; set version to 1")
        from_air = None if sink is None else codec or message_codec(dictionaries, registry)
        return EndpointV0(registry, source, sink, codecs=(to_air, from_air), rng=rng, observer=observer)
    start = start or EndpointSetup()
    known = message_codec(dictionaries)
    return EndpointV1(
        None if source is None or not topics else topics,
        settings_of(
            source,
            sink,
            hears=start.reports,
            half_duplex=start.half_duplex,
            fixed=not start.any_length,
            airtime_share=start.airtime_share,
            relay=start.relay,
        ),
        boot=start.boot,
        keys=start.keys,
        codec=to_air,
        decoder_for=lambda topics: (
            codec
            or known.of(
                [Topic(topic.topic_id, topic.name, topic.type_name) for topic in topics],
                {topic.topic_id: topic.codec for topic in topics},
            )
        ),
        heard=start.heard,
        save=start.save,
        observer=observer,
        mcs_table=start.mcs_table,
        access=start.access(robot_of(source, sink)),
        lead_s=start.lead_s,
    )


def start_of(config: SourceConfig | SinkConfig, src_id: int, setup: EndpointSetup) -> EndpointSetup:
    """Count this start of a robot in its state file, and read the robot's keys.

    :param src_id: id of the robot, -1 for a robot that sends nothing
    :param setup: what is known of its radio
    :raises ConfigError: for a key file or a state file that cannot be read or understood
    """
    keys = Keys(read_key_file(config.key), config.seal) if config.key else None
    if not config.version:
        return setup
    setup = replace(setup, keys=keys)
    if not config.state and not config.key and src_id < 0:
        return replace(setup, boot=int(time.time()) << RANDOM_BITS | secrets.randbits(RANDOM_BITS))
    file = BootFile(
        _state_file(config.state, src_id), time.time(), secrets.randbits(RANDOM_BITS), sealed=keys is not None
    )
    return replace(setup, boot=file.boot, heard=file.heard, save=file.save, close=file.close)


def account_of(state: str, robot_id: int) -> Path:
    """The file of a robot's airtime account, beside its state file.

    :param state: its state file, '' = the usual one
    """
    return _state_file(state, robot_id).with_suffix(".airtime")


def _state_file(state: str, robot_id: int) -> Path:
    return Path(state).expanduser() if state else state_folder() / f"robot_{robot_id}.json"


def state_folder() -> Path:
    """The folder for the state files of robots, inside the XDG folder for state."""
    base = os.environ.get("XDG_STATE_HOME") or "~/.local/state"
    return Path(base).expanduser() / "gr_ros2"


class LiveEnd:
    """An endpoint that the blocks of one flowgraph share, and the one lock that protects it.

    :param make: makes the endpoint, given its observer
    :ivar work: notified when a packet may leave; who sleeps there says so in ``sleeps_until``
    :ivar sleeps_until: time in s at which the sending thread looks again by itself; -inf while it is awake
    :ivar looked: time in s at which the sending thread last began to look for packets
    :ivar observer: called with each event of the sending half, while the lock is held
    """

    def __init__(self, make: Callable[[Callable[[SenderEvent], None]], Endpoint]) -> None:
        self.lock = threading.Lock()
        self.work = threading.Condition(self.lock)
        self.sleeps_until = self.looked = -inf
        self._foreseen = False
        """Whether the sending thread sleeps until the next packet may leave, a credit for it provided."""
        self.observer: Callable[[SenderEvent], None] | None = None
        self.endpoint = make(self._tell)

    def wake(self, *, credited: bool = False) -> None:
        """Wake the sending thread if a packet may leave before it looks again; the caller holds the lock.

        A needless wake-up takes as much time as several packets.

        :param credited: whether nothing has come but a credit
        """
        if self.sleeps_until == -inf or (credited and self._foreseen):
            return
        at = self.endpoint.next_departure()
        if at is None:
            self._foreseen = False
        elif at < self.sleeps_until or self.endpoint.urged:
            self.work.notify()

    def sleep(self, clock: Callable[[], float]) -> None:
        """Wait, as the sending thread, until a packet may leave; the caller holds the lock.

        :param clock: gives the time in s
        """
        now = clock()
        # What is due later is waited for also without a credit, so that one that comes before need not wake the thread.
        at = self.endpoint.next_departure(credited=True)
        self._foreseen = at is not None and at > now
        if not self._foreseen:
            at = self.endpoint.next_departure()
        self.sleeps_until = inf if at is None else at
        self.work.wait(None if at is None else max(SHORTEST_WAIT_S, at - now))
        self.looked = clock()  # before it counts as awake: `stalled_s` takes no lock
        self.sleeps_until = -inf

    def stalled_s(self, now: float) -> float:
        """s for which the sending thread has been at one thing, or asleep beyond the time at which it meant to look
        again. Takes no lock, which that thread may hold."""
        until = self.sleeps_until
        return max(0.0, now - (self.looked if until == -inf else until))

    def _tell(self, event: SenderEvent) -> None:
        if self.observer is not None:
            self.observer(event)


class Graph:
    """A block's participant on a ROS graph. The caller passes it in open, or this class opens it by name and closes it.

    :param middleware: an open Middleware; for anything else, ``name`` is opened
    :raises GrRos2Error: see :func:`gr_ros2.middleware.join_graph`
    """

    def __init__(self, middleware: str | Middleware | None, name: str, domain_id: int | Auto, node_name: str) -> None:
        if isinstance(middleware, Middleware):
            self.middleware = middleware
            self.owned = False
        else:
            self.middleware = join_graph(name, domain_id=domain_id, node_name=node_name)
            self.owned = True

    def same_as(self, other: Graph) -> bool:
        """Whether messages published on one of the two graphs reach the other."""
        return meet(self.middleware, other.middleware)

    def close(self) -> None:
        """Leave the graph, if this object has joined it."""
        if self.owned:
            self.middleware.close()


def check_loop(subscribed: Iterable[str], config: SinkConfig, registry: Registry) -> None:
    """Refuse a sink that publishes a topic to which a source on the same graph subscribes.

    :param subscribed: absolute names of the topics to which the source subscribes, and of the services that it offers
    :param registry: registry of the sink, with topic options applied
    :raises ConfigError: for a loop; the message names the topic
    """
    names = set(subscribed)
    for merged in config.merged_topics:
        if merged in names:
            raise ConfigError(
                f"loop: the sink publishes {merged} (merge_tf), which a source on the same graph subscribes; "
                "change merge_tf or domain_id"
            )
    for topic in registry:
        for src_id in range(BROADCAST + 1):
            name = topic.republished(config.namespace_format, src_id)
            if name in names:
                raise ConfigError(
                    f"loop: the sink publishes {name} (sender {src_id}), which a source on the same graph "
                    "subscribes; change namespace_format, publish_as or domain_id"
                )


class LoopGuard:
    """Keeps a list of all blocks of this process, to detect loops between them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._sources: weakref.WeakKeyDictionary[Any, tuple[Graph, frozenset[str]]] = weakref.WeakKeyDictionary()
        self._sinks: weakref.WeakKeyDictionary[Any, tuple[Graph, SinkConfig, Registry]] = weakref.WeakKeyDictionary()
        self._outputs: weakref.WeakKeyDictionary[Any, tuple[Graph, dict[tuple[int, int], str]]] = (
            weakref.WeakKeyDictionary()
        )
        """Topics that senders have announced, under the names that sinks give them, by sender and topic id."""

    def add_source(self, block: Any, graph: Graph, subscribed: Iterable[str]) -> None:
        """:raises ConfigError: for a loop with an existing sink"""
        names = frozenset(subscribed)
        with self._lock:
            for other, config, registry in self._sinks.values():
                if graph.same_as(other):
                    check_loop(names, config, registry)
            self._sources[block] = (graph, names)

    def add_sink(self, block: Any, graph: Graph, config: SinkConfig, registry: Registry) -> None:
        """:raises ConfigError: for a loop with an existing source"""
        with self._lock:
            for other, names in self._sources.values():
                if graph.same_as(other):
                    check_loop(names, config, registry)
            self._sinks[block] = (graph, config, registry)

    def add_output(self, block: Any, graph: Graph, key: tuple[int, int], name: str) -> None:
        """Note a topic that a sink is about to publish because a sender has announced it.

        :param key: sender and topic id, which have only one name at a time
        :raises ConfigError: for a loop: a source on the same graph subscribes to it
        """
        with self._lock:
            for other, names in self._sources.values():
                if name in names and graph.same_as(other):
                    raise ConfigError(
                        f"loop: the sink would publish {name}, which a source on the same graph subscribes; change "
                        "namespace_format, publish_as or domain_id"
                    )
            self._outputs.setdefault(block, (graph, {}))[1][key] = name

    def returns(self, graph: Graph, name: str) -> bool:
        """Whether a topic of a graph has come by radio: a sink publishes it, or one of another process may do so."""
        with self._lock:
            sinks = [(config, registry) for other, config, registry in self._sinks.values() if graph.same_as(other)]
            if any(name in names.values() for other, names in self._outputs.values() if graph.same_as(other)):
                return True
        formats = {config.namespace_format for config, _ in sinks} | {SinkConfig().namespace_format}
        if any(_made_by(form, name) for form in formats):
            return True
        try:
            for config, registry in sinks:
                check_loop((name,), config, registry)
        except ConfigError:
            return True
        return False

    def remove(self, block: Any) -> None:
        """Remove a block that has left its graph."""
        with self._lock:
            self._sources.pop(block, None)
            self._sinks.pop(block, None)
            self._outputs.pop(block, None)


def _made_by(namespace_format: str, name: str) -> bool:
    """Whether a topic is in the namespace that a sink gives to some sender. A format that all senders share does not
    tell."""
    parts = [re.escape(part) for part in namespace_format.strip("/").split("{src_id}")]
    return len(parts) > 1 and re.match(f"/{'[0-9]+'.join(parts)}/", name) is not None


LOOP_GUARD = LoopGuard()
