"""The ROS graph on Zenoh: the key expressions, attachments and liveliness tokens of rmw_zenoh.

Invariants: pure functions of their arguments; data of another program that does not parse gives None, never an error.
Source: the design document and sources of rmw_zenoh_cpp, as of its releases for Humble, Jazzy and later.
"""

from __future__ import annotations

import hashlib
import re
import struct
from dataclasses import dataclass
from typing import Literal

from gr_ros2.middleware.base import FOR_EVER_S, Durability, Qos, Reliability
from gr_ros2.middleware.ros_graph import dds_type, ros_type

NO_HASH = "TypeHashNotSupported"
"""Placeholder of the type hash up to Humble, where types have none."""
DEFAULT_DEPTH = 42
"""rmw_zenoh's default history depth."""

Kind = Literal["NN", "MP", "MS"]
"""A node, a publisher, a subscription; services (SS, SC) are ignored."""

_LIVELINESS = "@ros2_lv"
_ENCLAVE = "/"
_NO_QOS = Qos()
_GID = 16
_ATTACHMENT = struct.Struct(f"<qqB{_GID}s")
_RELIABILITY: dict[str, Reliability] = {"": "reliable", "1": "reliable", "2": "best_effort"}
_DURABILITY: dict[str, Durability] = {"": "volatile", "1": "transient_local", "2": "volatile"}
_KEEP_LAST, _KEEP_ALL = "1", "2"
_QOS = re.compile(
    r"(?P<reliability>\d*):(?P<durability>\d*):(?P<history>\d*),(?P<depth>\d*):(?P<deadline>\d*,\d*):(?P<lifespan>\d*,\d*):.*"
)


def topic_key(domain_id: int, topic: str, type_name: str, type_hash: str) -> str:
    """Key expression of a topic: ``0/robot_1/odom/nav_msgs::msg::dds_::Odometry_/RIHS01_…``.

    :param type_hash: ``*`` to subscribe whatever the hash
    """
    return f"{domain_id}{topic}/{dds_type(type_name)}/{type_hash}"


def attachment(sequence: int, stamp_ns: int, gid: bytes) -> bytes:
    """The attachment of a message, 33 bytes: its number from 1, ns since the epoch, and its publisher."""
    return _ATTACHMENT.pack(sequence, stamp_ns, _GID, gid)


def read_attachment(data: bytes) -> tuple[int, bytes] | None:
    """The number of a message and the id of its publisher."""
    if len(data) != _ATTACHMENT.size:
        return None
    sequence, _, size, gid = _ATTACHMENT.unpack(data)
    return (sequence, gid) if size == _GID else None


@dataclass(frozen=True, slots=True)
class Entity:
    """A node, or one of its publishers or subscriptions; the latter two have a topic.

    :param session: id of the Zenoh session, hexadecimal
    :param number: of the entity within its session, 0 for our node
    """

    session: str
    number: int
    kind: Kind
    node_name: str
    namespace: str
    topic: str = ""
    type_name: str = ""
    type_hash: str = ""
    qos: Qos = _NO_QOS

    def token(self, domain_id: int) -> str:
        """Key expression of its liveliness token."""
        names = [_LIVELINESS, str(domain_id), self.session, "0", str(self.number), self.kind]
        names += [_mangled(name) for name in (_ENCLAVE, self.namespace, self.node_name)]
        if self.kind != "NN":
            names += [_mangled(self.topic), dds_type(self.type_name), self.type_hash, _qos_text(self.qos)]
        return "/".join(names)

    def gid(self, domain_id: int) -> bytes:
        """16 bytes that identify it in attachments, derived from its token; peers only compare them."""
        return hashlib.blake2b(self.token(domain_id).encode(), digest_size=_GID).digest()


def tokens_of(domain_id: int) -> str:
    """Key expression of all tokens of a graph."""
    return f"{_LIVELINESS}/{domain_id}/**"


def read_token(text: str) -> Entity | None:
    """The node, publisher or subscription of a token; None for anything else."""
    parts = text.split("/")
    if len(parts) < 9 or parts[0] != _LIVELINESS or not parts[4].isdecimal():
        return None
    _, _, session, _, number, kind, _, namespace, node_name = parts[:9]
    namespace, node_name = _demangled(namespace), _demangled(node_name)
    if kind == "NN":
        return Entity(session, int(number), "NN", node_name, namespace)
    if kind not in ("MP", "MS") or len(parts) < 13:
        return None
    qos = _read_qos(parts[12])
    if qos is None:
        return None
    topic, type_name = _demangled(parts[9]), ros_type(_demangled(parts[10]))
    return Entity(session, int(number), kind, node_name, namespace, topic, type_name, parts[11], qos)  # type: ignore[arg-type]


def _mangled(name: str) -> str:
    return name.replace("/", "%")


def _demangled(name: str) -> str:
    return name.replace("%", "/")


def _qos_text(qos: Qos) -> str:
    """Reliability, durability, history and depth, deadline, lifespan; a default value may be left empty."""
    reliability = "2" if qos.reliability == "best_effort" else "1"
    durability = "1" if qos.durability == "transient_local" else "2"
    history = f"{_KEEP_LAST},{qos.depth}" if qos.depth else f"{_KEEP_ALL},{DEFAULT_DEPTH}"
    return f"{reliability}:{durability}:{history}:{_duration(qos.deadline_s)}:{_duration(qos.lifespan_s)}:,,"


def _duration(seconds: float) -> str:
    """Seconds and nanoseconds, empty for no limit."""
    return f"{int(seconds)},{round(seconds % 1 * 1e9)}" if seconds else ","


def _read_qos(text: str) -> Qos | None:
    match = _QOS.fullmatch(text)
    if match is None or match["reliability"] not in _RELIABILITY or match["durability"] not in _DURABILITY:
        return None
    depth = 0 if match["history"] == _KEEP_ALL else int(match["depth"] or DEFAULT_DEPTH)
    lifespan, deadline = _seconds(match["lifespan"]), _seconds(match["deadline"])
    return Qos(_RELIABILITY[match["reliability"]], _DURABILITY[match["durability"]], depth, lifespan, deadline)


def _seconds(text: str) -> float:
    """The inverse of :func:`_duration`; a very long limit counts as no limit."""
    seconds, _, nanoseconds = text.partition(",")
    total = int(seconds or 0) + int(nanoseconds or 0) * 1e-9
    return total if total < FOR_EVER_S else 0.0
