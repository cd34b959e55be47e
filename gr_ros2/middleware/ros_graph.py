"""ROS 2 names on DDS, and the announcement with which a participant is listed as a ROS node.

Invariants: pure functions of their arguments and, where stated, of the environment; nothing here uses a DDS.
Sources: the ROS 2 design articles "Topic and Service name mapping to DDS" and "Node to Participant mapping";
rmw_dds_common/msg/ParticipantEntitiesInfo of Humble (24-byte Gid) and of Iron (16-byte Gid).
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal, NamedTuple, cast, get_args

import numpy as np
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from gr_ros2.core.errors import ConfigError
from gr_ros2.core.names import check_node, check_topic
from gr_ros2.settings.fields import AUTO, Auto

__all__ = ["check_node", "check_topic"]

MAX_DOMAIN_ID = 232
"""Highest domain whose UDP ports fit 16 bits (RTPS 2.2, section 9.6.1)."""

DISCOVERY_TOPIC = "ros_discovery_info"
DISCOVERY_TYPE = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_"
PARTICIPANT_USER_DATA = b"enclave=/;"

_DISCOVERY_MESSAGES = (
    "rmw_dds_common/msg/Gid",
    "rmw_dds_common/msg/NodeEntitiesInfo",
    "rmw_dds_common/msg/ParticipantEntitiesInfo",
)


_OURS = b"gr_ros2=;"
DISCOVERY_USER_DATA = b"typehash=RIHS01_91a0593bacdcc50ea9bdcf849a938b128412cc1ea821245c663bcd26f83c295e;" + _OURS
"""User data of this package's endpoint on ros_discovery_info: the hash of its type since Iron, and a mark of this
package."""

_DDS_TYPE = re.compile(r"([A-Za-z0-9_]+)::(msg|srv|action)::dds_::([A-Za-z0-9_]+)_")
_REQUESTS, _REQUEST_TYPE = re.compile(r"rq(/.+)Request"), re.compile(r"(.+/.+/.+)_Request")
_TYPE_HASH = re.compile(rb"(?:^|;)typehash=(RIHS01_[0-9a-f]{64});")
_24_BYTE_GID_DISTROS = frozenset({"", "foxy", "galactic", "humble"})


def dds_topic(topic: str) -> str:
    """``/robot_1/odom`` as ``rt/robot_1/odom``."""
    return "rt" + topic


def dds_service(service: str, type_name: str) -> tuple[tuple[str, str], tuple[str, str]]:
    """Topic and type of a service's requests, and of its replies.

    ``/robot_1/add`` of ``example_interfaces/srv/AddTwoInts`` has ``rq/robot_1/addRequest`` of
    ``example_interfaces::srv::dds_::AddTwoInts_Request_``, and ``rr/robot_1/addReply`` of ``…_Response_``.
    """
    request, response = (dds_type(f"{type_name}_{part}") for part in ("Request", "Response"))
    return (f"rq{service}Request", request), (f"rr{service}Reply", response)


def ros_service(name: str, type_name: str) -> tuple[str, str] | None:
    """Name and type of a service, from topic and type of its requests; None for any other topic."""
    service, kind = _REQUESTS.fullmatch(name), _REQUEST_TYPE.fullmatch(ros_type(type_name))
    return None if service is None or kind is None else (service[1], kind[1])


def ros_topic(name: str) -> str | None:
    """The inverse of :func:`dds_topic`; None for a name that is not a ROS topic (services, plain DDS)."""
    return name[2:] if name.startswith("rt/") else None


def dds_type(type_name: str) -> str:
    """``nav_msgs/msg/Odometry`` as ``nav_msgs::msg::dds_::Odometry_``."""
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def ros_type(name: str) -> str:
    """The inverse of :func:`dds_type`; a name that is not a ROS type is returned unchanged."""
    match = _DDS_TYPE.fullmatch(name)
    return f"{match[1]}/{match[2]}/{match[3]}" if match else name


def resolve_domain_id(domain_id: int | Auto, environment: Mapping[str, str] = os.environ) -> int:
    """The DDS domain, 0..232; auto takes ROS_DOMAIN_ID, default 0.

    :raises ConfigError: out of range, or ROS_DOMAIN_ID is not a number
    """
    origin, text = "domain_id", str(domain_id)
    if domain_id == AUTO:
        origin, text = "ROS_DOMAIN_ID", environment.get("ROS_DOMAIN_ID", "").strip() or "0"
    if not re.fullmatch(r"[0-9]{1,3}", text) or int(text) > MAX_DOMAIN_ID:
        raise ConfigError(f"{origin} = {text!r}: a DDS domain is 0..{MAX_DOMAIN_ID}")
    return int(text)


DiscoveryRange = Literal["SUBNET", "LOCALHOST", "OFF", "SYSTEM_DEFAULT"]


@dataclass(frozen=True)
class DiscoveryOptions:
    """The discovery range of a participant, as in ROS 2 since Iron (rmw_discovery_options_t).

    :param range: SUBNET, all that multicast reaches; LOCALHOST, this machine; OFF, only this process; SYSTEM_DEFAULT,
        the default of the DDS
    :param peers: addresses or names of further machines; only for the first two ranges
    """

    range: DiscoveryRange = "SUBNET"
    peers: tuple[str, ...] = ()

    def __str__(self) -> str:
        peers = f" and ROS_STATIC_PEERS={';'.join(self.peers)}" if self.peers else ""
        return f"ROS_AUTOMATIC_DISCOVERY_RANGE={self.range}{peers}"


def discovery_options(
    localhost_only: bool | Auto = AUTO, environment: Mapping[str, str] = os.environ
) -> DiscoveryOptions:
    """The options of ROS_LOCALHOST_ONLY, ROS_AUTOMATIC_DISCOVERY_RANGE and ROS_STATIC_PEERS; the first takes
    precedence, as in rcl.

    :param localhost_only: in place of ROS_LOCALHOST_ONLY, unless auto
    :raises ConfigError: for an invalid value (where rcl assumes a value and warns)
    """
    text = environment.get("ROS_LOCALHOST_ONLY", "").strip() or "0"
    if text not in ("0", "1"):
        raise ConfigError(f"ROS_LOCALHOST_ONLY = {text!r}: write 0 or 1")
    if localhost_only is True or (localhost_only == AUTO and text == "1"):
        return DiscoveryOptions("LOCALHOST")
    found = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").strip() or "SUBNET"
    if found not in get_args(DiscoveryRange):
        raise ConfigError(f"ROS_AUTOMATIC_DISCOVERY_RANGE = {found!r}: write {', '.join(get_args(DiscoveryRange))}")
    peers = (peer.strip() for peer in environment.get("ROS_STATIC_PEERS", "").split(";"))
    searching = found in ("SUBNET", "LOCALHOST")
    return DiscoveryOptions(cast("DiscoveryRange", found), tuple(peer for peer in peers if peer) if searching else ())


def gid_size(environment: Mapping[str, str] = os.environ) -> int:
    """Initial size in bytes of a Gid in ros_discovery_info: 24 up to Humble, 16 since Iron.

    Where ROS_DISTRO is not set, 24 is assumed until the graph shows otherwise (:func:`has_short_gids`).
    """
    return 24 if environment.get("ROS_DISTRO", "").strip().lower() in _24_BYTE_GID_DISTROS else 16


def has_short_gids(topic: str, user_data: bytes) -> bool:
    """Whether an endpoint belongs to a ROS node since Iron: an endpoint of another program on ros_discovery_info with a
    type hash.

    :param topic: its name on DDS
    """
    return is_node(topic, user_data) and bool(announced_hash(user_data))


def is_node(topic: str, user_data: bytes) -> bool:
    """Whether an endpoint belongs to nodes of ROS: one of another program on ros_discovery_info."""
    return topic == DISCOVERY_TOPIC and _OURS not in user_data


def endpoint_user_data(type_hash: str) -> bytes:
    """User data with which an endpoint announces its type since Iron (REP-2016); nodes up to Humble do not read it.

    It is never empty: rmw_cyclonedds warns about every endpoint without user data.

    :param type_hash: '' where the hash is not known
    """
    return f"typehash={type_hash};".encode() if type_hash else _OURS


def announced_hash(user_data: bytes) -> str:
    """The inverse of :func:`endpoint_user_data`, for an endpoint of any program."""
    match = _TYPE_HASH.search(user_data)
    return match[1].decode() if match else ""


class NodeEntities(NamedTuple):
    """A node and its endpoints on the DDS.

    :param namespace: absolute
    :param readers: GUIDs, 16 bytes each; likewise those of the writers
    """

    name: str
    namespace: str
    readers: Sequence[bytes]
    writers: Sequence[bytes]


def participant_entities_info(participant: bytes, nodes: Sequence[NodeEntities], *, gid_bytes: int = 24) -> bytes:
    """The message on ros_discovery_info for the nodes of one participant, CDR little endian.

    :param participant: GUID, 16 bytes
    """
    store = _discovery_types(gid_bytes)
    gid_class, node_class, info_class = (store.types[name] for name in _DISCOVERY_MESSAGES)

    def gids(guids: Sequence[bytes]) -> list[Any]:
        return [gid_class(np.frombuffer(guid.ljust(gid_bytes, b"\0"), np.uint8)) for guid in guids]

    told = [node_class(node.namespace, node.name, gids(node.readers), gids(node.writers)) for node in nodes]
    return bytes(store.serialize_cdr(info_class(*gids([participant]), told), _DISCOVERY_MESSAGES[-1]))


@cache
def _discovery_types(gid_bytes: int) -> Typestore:
    return get_typestore(Stores.ROS2_HUMBLE if gid_bytes == 24 else Stores.ROS2_JAZZY)
