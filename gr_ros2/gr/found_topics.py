"""What a robot finds on its ROS graph: topics and services that no registry names, and types of what it sends.

Invariants: what cannot be sent or offered is said once; what is only to be sent when somebody asks for it (``offer`` of
the settings) is not subscribed before. One thread at a time changes what is sent. The thread that looks ends when it
is closed, when its graph is closed, or with the process.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from gr_ros2.core.errors import ConfigError, GrRos2Error, MiddlewareError
from gr_ros2.gr.offers import OpenTopic
from gr_ros2.gr.subscriptions import OpenSubscriptions
from gr_ros2.middleware import Middleware, TopicInfo
from gr_ros2.middleware.graph_search import GraphSearch
from gr_ros2.middleware.services import OTHER_RMW, ServiceGraph
from gr_ros2.middleware.type_search import TypeSearch
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import DEFAULT_OPTIONS, MAX_TOPICS, NewTopic, Topic, normalize_type, options_of
from gr_ros2.settings.robot import RobotConfig
from gr_ros2.settings.service_rows import ServiceRow, is_service, parts, rows_of
from gr_ros2.settings.topic_choice import TopicChoice

LOOK_S = 0.2
"""s between two looks, at least. Messages that are published before the next look are missed, unless their publisher
keeps them."""
_SHARE = 0.05
"""Largest share of time that may be spent looking."""
_log = logging.getLogger(__name__)


class TopicSearch(GraphSearch):
    """Calls a function with what is on a graph, at once and then every ``LOOK_S`` seconds.

    :param found: called with all topics that are there, and with the types of all services by name, without those of
        this participant; must not raise
    :param services: whether to look for services too. On a graph that has topics only, there are none
    """

    def __init__(
        self,
        middleware: Middleware,
        found: Callable[[Sequence[TopicInfo], Mapping[str, str]], None],
        *,
        services: bool = False,
    ) -> None:
        self._middleware = middleware
        self._services = middleware if services and isinstance(middleware, ServiceGraph) else None
        self._found = found
        super().__init__("gr-ros2-topic-search", LOOK_S, _SHARE)

    def _look(self) -> float:
        infos = self._middleware.discover()
        services = {} if self._services is None else self._services.discover_services()
        begin = time.monotonic()
        self._found(infos, services)
        return time.monotonic() - begin

    def _failed(self, error: MiddlewareError) -> None:
        _log.warning("no further topics are looked for: %s", error)


class FoundTopics:
    """The search of one robot.

    :param subscriptions: takes what is found
    :ivar choice: the topics and services that are looked for
    :ivar offers: what may be asked for, by its name without leading slash. The mapping is replaced as a whole
    :ivar asked: absolute names of what is sent or offered because somebody has asked for it
    :ivar offered: absolute names of the services, actions and nodes that were found and chosen
    :ivar left_out: what cannot be sent or offered
    :ivar not_offered: services that cannot be called because of the RMW of their nodes; only the first one is logged
    """

    def __init__(
        self, config: RobotConfig, middleware: Middleware, subscriptions: OpenSubscriptions, log: logging.Logger
    ) -> None:
        self.choice = TopicChoice(() if subscriptions.registry else config.words, config.namespace)
        self.offers: dict[str, OpenTopic] = {}
        self.asked: set[str] = set()
        self.offered: set[str] = set()
        self.left_out: set[str] = set()
        self.not_offered: set[str] = set()
        self._config, self._middleware, self._subscriptions, self._log = config, middleware, subscriptions, log
        self._open_to = TopicChoice(tuple(config.offer), config.namespace)
        self._offer: Callable[[str, Topic], None] | None = None
        self._withdraw: Callable[[str], None] = lambda _: None
        self._changing = threading.Lock()
        self._full = False
        """Whether a topic was not sent because there are too many. Only the first one is logged."""
        self._searches: list[TopicSearch | TypeSearch] = []

    def offer_with(self, offer: Callable[[str, Topic], None], withdraw: Callable[[str], None]) -> None:
        """Look for services too, from the next start on, unless ``services`` of the settings is false.

        :param offer: called with the name of each service on the ROS graph and its row, from a thread of the search
        :param withdraw: called with the name of a service that is offered no more, from the thread that ends it
        """
        self._offer, self._withdraw = offer if self._config.services else None, withdraw

    def start(self) -> None:
        """Look periodically."""
        if self.choice or self._open_to:
            self._searches.append(TopicSearch(self._middleware, self._found, services=self._offer is not None))
        if self._config.compression and isinstance(self._middleware, ServiceGraph):
            subscriptions = self._subscriptions
            self._searches.append(TypeSearch(self._middleware, subscriptions.types, subscriptions.learn))

    def stop(self) -> None:
        """Look no more. Idempotent."""
        for search in self._searches:
            search.close()
        self._searches.clear()

    def unmatched(self) -> list[str]:
        """Names, on the ROS graph, of the topics without a publisher; the patterns, if no name is known yet."""
        subscribed, choice = self._subscriptions.subscribed, self.choice
        named = [name for name, word in choice.named.items() if self._takes(word)]
        unseen = [name for name in named if name not in subscribed and name not in self.offered]
        if any(map(self._takes, choice.patterns)) and not subscribed and not unseen:
            return [choice.everything]
        return unseen + self._subscriptions.unmatched()

    def sends(self, name: str, robot: int) -> bool:
        """Whether something is sent to a robot, or may be called by it, that nobody need ask for.

        :param name: without leading slash
        """
        to = [topic.options.to for _, topic in self._subscriptions.named() if topic.name.lstrip("/") == name]
        called = [self.choice.row_name(service) or "" for service in self.offered.copy()]
        return AUTO in to or robot in to or name in [service.lstrip("/") for service in called]

    def begin(self, offered: OpenTopic, rate: float, options: Mapping[str, SendOptions]) -> None:
        """Send something that is offered, or send it with another rate.

        :param rate: messages/s at most; 0 = as they come
        :param options: of what is offered
        :raises GrRos2Error: when it cannot be sent
        """
        with self._changing:
            subscriptions, name = self._subscriptions, offered.on_graph
            sent = subscriptions.subscribed.get(name)
            if offered.info is None:
                for row in offered.rows:
                    if not self._is_offered(row):
                        self._add_services(offered.name, row, options)
            elif sent is not None and sent.type_name == normalize_type(offered.type_name):
                subscriptions.use(name, offered.at(rate))
            else:
                subscriptions.add(offered.name, offered.info, offered.at(rate))
            self.asked.add(name)

    def end(self, offered: OpenTopic) -> None:
        """Send it no more."""
        with self._changing:
            names = [name for row in offered.rows for name in parts(row.name, row.kind)] or [offered.on_graph]
            services = [name for name in names if name in self._subscriptions.services]
            self._subscriptions.remove(names)
            self.offered.difference_update(row.name for row in offered.rows)
            self.asked.discard(offered.on_graph)
            for name in services:
                self._withdraw(name)

    def _found(self, infos: Sequence[TopicInfo], services: Mapping[str, str]) -> None:
        """Send the topics of the graph that are chosen and not sent yet, or have another type now; likewise the
        services."""
        uncallable = (
            self._middleware.uncallable() if services and isinstance(self._middleware, ServiceGraph) else frozenset()
        )
        rows = rows_of(services)
        with self._changing:
            self._send(infos)
            self._offer_services(rows, uncallable)
            if self._open_to:
                self.offers = self._open(
                    infos, [row for row in rows if uncallable.isdisjoint(parts(row.name, row.kind))]
                )

    def _send(self, infos: Sequence[TopicInfo]) -> None:
        published = {(info.topic, info.type_name) for info in infos if info.publishers}
        for info in infos:
            sent = self._subscriptions.subscribed.get(info.topic)
            if not info.publishers or (sent is not None and (info.topic, sent.type_name) in published):
                continue
            row_name = self.choice.row_name(info.topic)
            if row_name is None or info.topic in self.left_out or self._subscriptions.returns([info.topic]):
                continue
            if not self._takes(row_name):
                continue
            try:
                self._subscriptions.add(row_name, info)
            except GrRos2Error as error:
                self._leave_out(info.topic, f"topic {info.topic} is not sent", error)

    def _takes(self, row_name: str) -> bool:
        """Whether a topic or service is sent here, and not by another endpoint of the robot."""
        subscriptions = self._subscriptions
        return subscriptions.takes(options_of(row_name, subscriptions.options, DEFAULT_OPTIONS))

    def _offer_services(self, rows: Sequence[ServiceRow], uncallable: frozenset[str]) -> None:
        for row in rows:
            row_name = self.choice.row_name(row.name, hidden=row.of_node)
            if row_name is None or self._is_offered(row) or f"{row.name} {row.kind}" in self.left_out:
                continue
            if not self._takes(row_name):
                continue
            if not uncallable.isdisjoint(parts(row.name, row.kind)):
                if not self.not_offered:
                    self._log.warning("%s (%s) is not offered: its node %s", row.name, row.kind, OTHER_RMW)
                self.not_offered.add(row.name)
                continue
            try:
                self._add_services(row_name, row, self._subscriptions.options)
            except GrRos2Error as error:
                self._leave_out(f"{row.name} {row.kind}", f"{row.name} ({row.kind}) is not offered", error)

    def _open(self, infos: Sequence[TopicInfo], rows: Sequence[ServiceRow]) -> dict[str, OpenTopic]:
        """What may be asked for: what ``offer`` chooses and is not sent anyway."""
        found: dict[str, OpenTopic] = {}
        sent, subscriptions = self.asked, self._subscriptions
        for info in infos:
            name = self._open_to.row_name(info.topic)
            anyway = self.choice.row_name(info.topic) or (
                info.topic in subscriptions.subscribed and info.topic not in sent
            )
            if name and info.publishers and not anyway and not subscriptions.returns([info.topic]):
                options = options_of(name, self._config.offer, DEFAULT_OPTIONS)
                found[name.lstrip("/")] = OpenTopic(name, info.topic, info, options=options)
        for row in rows:
            name = self._open_to.row_name(row.name, hidden=row.of_node)
            anyway = self.choice.row_name(row.name, hidden=row.of_node) or (
                self._is_offered(row) and row.name not in sent
            )
            if name and not anyway and row.name not in {info.topic for info in infos}:
                options = options_of(name, self._config.offer, DEFAULT_OPTIONS)
                before = found.get(name.lstrip("/"), OpenTopic(name, row.name, options=options))
                found[name.lstrip("/")] = replace(before, rows=(*before.rows, row))
        return found

    def _leave_out(self, key: str, what: str, error: GrRos2Error) -> None:
        """Say once what cannot be sent; of what finds no room, only the first."""
        self.left_out.add(key)
        full = len(self._subscriptions.registry) == MAX_TOPICS
        level = logging.DEBUG if full and self._full else logging.WARNING
        self._full = full
        self._log.log(level, "%s: %s", what, error)

    def _is_offered(self, row: ServiceRow) -> bool:
        """Whether the services of a row are offered already, or have come by radio."""
        names = parts(row.name, row.kind)
        services = self._subscriptions.services
        return any(name in services for name in names) or self._subscriptions.returns(names)

    def _add_services(self, row_name: str, row: ServiceRow, options: Mapping[str, SendOptions]) -> None:
        """Offer the services of a row to other robots. The topics of an action are sent.

        :param options: of single topics
        :raises ConfigError: for a row that cannot be offered, such as one more than a link carries
        """
        assert self._offer is not None
        rows: dict[str, NewTopic] = {}
        for name, type_name in parts(row.name, row.kind).items():
            if not self.choice.leaves_out(name):
                part = row_name + name.removeprefix(row.name)
                rows[name] = part, type_name, options_of(part, options, DEFAULT_OPTIONS)
        if not any(is_service(type_name) for _, type_name, _ in rows.values()):
            raise ConfigError("topics leaves out all its services")
        services = self._subscriptions.add_services(rows)
        self.offered.add(row.name)
        self._log.info("%s (%s) of the ROS graph is offered to other robots", row.name, row.kind)
        for name, topic in services.items():
            self._offer(name, topic)
