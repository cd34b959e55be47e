"""What other participants of a DDS domain have on it, as far as discovery has told.

Invariants: a lock of its own protects the table, and is never held during a call of anything else; what belongs to the
own participant is here too, and no question about others counts it.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator

from gr_ros2.middleware import ros_graph
from gr_ros2.middleware.base import Qos, TopicInfo, grouped
from gr_ros2.middleware.cdr_dds import DiscoveredEndpoint
from gr_ros2.middleware.services import DESCRIPTION_TYPE, Witness


class FoundEndpoints:
    """Writers and readers of a domain.

    :param own: GUID of the own participant
    """

    def __init__(self, own: bytes) -> None:
        self._own = own
        self._lock = threading.Lock()
        self._writers: dict[bytes, DiscoveredEndpoint] = {}
        self._readers: dict[bytes, DiscoveredEndpoint] = {}

    def change(self, changes: Iterable[tuple[bytes, DiscoveredEndpoint | None]], *, publishers: bool) -> frozenset[str]:
        """Take what discovery says: endpoints by their keys, None for one that has gone. Returns the DDS topics
        concerned.

        :param publishers: whether they are writers
        """
        found, topics = self._writers if publishers else self._readers, set()
        for key, endpoint in changes:
            with self._lock:
                before = found.pop(key, None)
                if endpoint is not None:
                    found[key] = endpoint
            topics |= {one.topic for one in (before, endpoint) if one is not None}
        return frozenset(topics)

    def topics(self) -> list[TopicInfo]:
        """The ROS topics of others."""
        writers, readers = self._tables()
        return grouped(self._ros_topics(writers), self._ros_topics(readers))

    def servers(self) -> Iterator[tuple[str, str, bool]]:
        """Name, type, and whether it can be called from here, of each server: a reader of requests and a writer of
        replies in one participant."""
        writers, readers = self._tables()
        replying = {(writer.participant, writer.topic) for writer in writers if writer.participant != self._own}
        for reader in readers:
            service = ros_graph.ros_service(reader.topic, reader.type_name)
            if service is not None:
                (_, _), (replies, _) = ros_graph.dds_service(*service)
                if (reader.participant, replies) in replying:
                    yield (*service, reader.is_cyclone)

    def witnesses(self, topic: str, type_name: str) -> list[Witness]:
        """The nodes of Cyclone DDS that can describe a type."""
        name, kind = ros_graph.dds_topic(topic), ros_graph.dds_type(type_name)
        hashes: dict[str, set[bytes]] = {}
        services: dict[bytes, list[str]] = {}
        for endpoint in self._others():
            if not endpoint.is_cyclone:
                continue  # services of Fast DDS cannot be called from here
            if (endpoint.topic, endpoint.type_name) == (name, kind):
                hashes.setdefault(ros_graph.announced_hash(endpoint.user_data), set()).add(endpoint.participant)
            service = ros_graph.ros_service(endpoint.topic, endpoint.type_name)
            if service is not None and service[1] == DESCRIPTION_TYPE:
                services.setdefault(endpoint.participant, []).append(service[0])
        found = []
        for digest in sorted(hashes.keys() - {""}):
            named = sorted({service for owner in hashes[digest] for service in services.get(owner, ())})
            found.append(Witness(digest, tuple(named)))
        return found

    def publishers(self, topic: str) -> list[DiscoveredEndpoint]:
        """Those of a ROS topic, our own too."""
        name = ros_graph.dds_topic(topic)
        return [writer for writer in self._tables()[0] if writer.topic == name]

    def hash_of(self, name: str) -> str:
        """The hash that others announce for a type on DDS; '' if none does."""
        told = (ros_graph.announced_hash(other.user_data) for other in self._others() if other.type_name == name)
        return next(filter(None, told), "")

    def has_short_gids(self) -> bool:
        """Whether anybody writes the numbers of endpoints with 16 bytes."""
        return any(ros_graph.has_short_gids(one.topic, one.user_data) for table in self._tables() for one in table)

    def takes_replies(self) -> bool:
        """Whether clients of services may be here that understand replies: where all nodes have another RMW, none
        does."""
        nodes = [one for one in self._others() if ros_graph.is_node(one.topic, one.user_data)]
        return not nodes or any(node.is_cyclone for node in nodes)

    def _tables(self) -> tuple[list[DiscoveredEndpoint], list[DiscoveredEndpoint]]:
        with self._lock:
            return list(self._writers.values()), list(self._readers.values())

    def _others(self) -> Iterator[DiscoveredEndpoint]:
        return (one for table in self._tables() for one in table if one.participant != self._own)

    def _ros_topics(self, endpoints: Iterable[DiscoveredEndpoint]) -> Iterator[tuple[str, str, Qos]]:
        """Topic, type and QoS of the endpoints of others that belong to ROS topics."""
        for endpoint in endpoints:
            topic = ros_graph.ros_topic(endpoint.topic)
            if topic is not None and endpoint.participant != self._own:
                yield topic, ros_graph.ros_type(endpoint.type_name), endpoint.qos
