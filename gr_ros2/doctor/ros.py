"""Checks of ROS 2: the sourced distribution, its environment variables, and the nodes and topics on the graph."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

from gr_ros2.core.errors import ConfigError, GrRos2Error
from gr_ros2.core.names import INFRASTRUCTURE
from gr_ros2.doctor.finding import Finding
from gr_ros2.middleware import join_graph
from gr_ros2.middleware.ros_graph import discovery_options, resolve_domain_id
from gr_ros2.settings.config import DEFAULT_MIDDLEWARE
from gr_ros2.settings.fields import AUTO

ROS_ROOT = Path("/opt/ros")
_LOOK_S = 3.0
"""s of discovery. Discovery does not report when it is complete."""
_SHOWN = 12
_KNOWN_RMW = ("rmw_cyclonedds_cpp", "rmw_fastrtps_cpp", "rmw_fastrtps_dynamic_cpp", "rmw_zenoh_cpp")


def distribution(root: Path = ROS_ROOT) -> Finding:
    """The ROS 2 distribution that is sourced."""
    name = os.environ.get("ROS_DISTRO", "")
    there = sorted(path.parent.name for path in root.glob("*/setup.bash"))
    source = f"source {root}/{there[-1]}/setup.bash" if there else ""
    if name:
        if find_spec("rclpy") is not None:
            return Finding("distribution", "ok", f"{name}, with rclpy")
        text = f"ROS_DISTRO = {name}, but this Python finds no rclpy"
        return Finding("distribution", "warning", text, source or "use the Python that ROS was built for")
    if there:
        return Finding("distribution", "note", f"not sourced; installed are {', '.join(there)}", source)
    return Finding("distribution", "note", f"none in {root}; the embedded DDS needs none")


def rmw() -> Finding:
    """The middleware that ROS nodes started here use."""
    name = os.environ.get("RMW_IMPLEMENTATION", "")
    if not name:
        return Finding("RMW", "ok", "RMW_IMPLEMENTATION is not set: the distribution's own")
    if name not in _KNOWN_RMW:
        remedy = f"export RMW_IMPLEMENTATION={_KNOWN_RMW[0]}"
        return Finding("RMW", "warning", f"{name}; this was not tried with it", remedy)
    if "zenoh" in name:
        return Finding("RMW", "note", f"{name}: its nodes are not on DDS", "set middleware: zenoh in both blocks")
    return Finding("RMW", "ok", name)


def domain() -> Finding:
    """The domain and the range of discovery."""
    try:
        number, options = resolve_domain_id(AUTO), discovery_options()
    except ConfigError as error:
        remedy = "unset ROS_DOMAIN_ID ROS_AUTOMATIC_DISCOVERY_RANGE ROS_STATIC_PEERS ROS_LOCALHOST_ONLY"
        return Finding("domain", "failed", str(error), remedy)
    peers = f", peers {', '.join(options.peers)}" if options.peers else ""
    return Finding("domain", "ok", f"{number}, discovery range {options.range}{peers}")


def graph() -> Iterator[Finding]:
    """The topics that are published in this domain."""
    try:
        with join_graph(DEFAULT_MIDDLEWARE, domain_id=AUTO, node_name="gr_ros2_doctor") as joined:
            time.sleep(_LOOK_S)
            found = joined.discover()
    except GrRos2Error as error:
        yield Finding("graph", "failed", str(error), "see the lines above")
        return
    topics = [f"{info.topic} [{info.type_name}]" for info in found if info.publishers]
    named = [topic for topic in topics if topic.partition(" ")[0] not in INFRASTRUCTURE]
    if not topics:
        text = f"nothing is published in {_LOOK_S:g} s"
        yield Finding("graph", "note", text, "start the robot in this ROS_DOMAIN_ID, or set that of the robot")
        return
    more = f" and {len(named) - _SHOWN} more" if len(named) > _SHOWN else ""
    listed = ", ".join(named[:_SHOWN]) + more or "none but those of every node"
    nodes = sum(len(info.publishers) for info in found if info.topic == INFRASTRUCTURE[0])
    yield Finding("graph", "ok", f"{nodes} nodes that log, {len(topics)} topics: {listed}")
