"""Names by ROS's rules: topics, namespaces, nodes, frames; and forms of them that hold the sender's id.

Invariants: a name that passes here passes in every ROS 2, since the rules are those its ``rmw`` package enforces
(``rmw_validate_full_topic_name``, ``rmw_validate_namespace``, ``rmw_validate_node_name``). They come from the ROS 2
design article "Topic and Service name mapping to DDS"; two underscores in a row, which only the article forbids, pass.
A form has one field, ``{robot}``, and nothing else in braces.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

from gr_ros2.core.errors import ConfigError

MAX_TOPIC_LEN = 247
"""Characters of an absolute topic name (``RMW_TOPIC_MAX_NAME_LENGTH``)."""
MAX_NAMESPACE_LEN = 245
"""Characters of a namespace (``RMW_NAMESPACE_MAX_LENGTH``)."""
MAX_NODE_LEN = 255
"""Characters of a node name (``RMW_NODE_NAME_MAX_NAME_LENGTH``)."""

INFRASTRUCTURE = ("/rosout", "/parameter_events")
"""Topics that every ROS node has and that are rarely meant to be sent by radio."""

OWN_NODES = ("/gr_ros2_", "/gr_ros2/")
"""Beginnings of the names of this package's nodes and topics, by which a link says how it is."""

_SHOWN = 10
_FIELD = "{robot}"
_LONGEST_ID = 255
_FOREIGN = re.compile(r"[^A-Za-z0-9_/]")


def link_node(robot: int) -> str:
    """The node name of a robot's link."""
    return f"gr_ros2_link_{robot}"


def first(names: Iterable[str]) -> list[str]:
    """The first names of many, for a message; then how many more there are."""
    found = list(names)
    return found if len(found) <= _SHOWN else [*found[:_SHOWN], f"and {len(found) - _SHOWN} more"]


def topic_fault(name: str, longest: int = MAX_TOPIC_LEN) -> str:
    """Why ROS refuses an absolute topic name, in words; '' for a valid name."""
    if not name.startswith("/"):
        return "must begin with /"
    if foreign := _FOREIGN.search(name):
        return f"{foreign[0]!r} may not stand in a ROS name; letters, digits, _ and / may"
    if name.endswith("/"):
        return "must not end with /"
    if "//" in name:
        return "must not have two / in a row"
    if begins := re.search(r"/([0-9]\w*)", name):
        return f"part {begins[1]!r} must not begin with a digit"
    return f"{len(name)} characters, ROS allows {longest}" if len(name) > longest else ""


def check_topic(topic: str) -> str:
    """An absolute ROS topic name, unchanged.

    :raises ConfigError: for an invalid name
    """
    if fault := topic_fault(topic):
        raise ConfigError(f"topic {topic!r}: not an absolute topic name of ROS, as /robot_1/odom is: {fault}")
    return topic


def check_node(node_name: str, namespace: str) -> tuple[str, str]:
    """Node name and absolute namespace ('' is the root).

    :raises ConfigError: when either is malformed
    """
    if "/" in node_name or topic_fault(f"/{node_name}", 1 + MAX_NODE_LEN):
        raise ConfigError(
            f"node_name {node_name!r}: letters, digits and _, not starting with a digit, at most {MAX_NODE_LEN}"
        )
    try:
        return node_name, "/" + checked_namespace(namespace).strip("/")
    except ValueError as error:
        raise ConfigError(f"namespace {namespace!r}: {error}") from error


def filled(form: str, src_id: int) -> str:
    """A form with the sender's id filled in."""
    return form.replace(_FIELD, str(src_id))


# Validators of settings: each returns the value unchanged, or raises a ValueError that says what is wrong.


def checked_namespace(namespace: str) -> str:
    """A namespace, with or without leading and trailing slash; '' is the root."""
    _refuse(_namespace_fault(namespace))
    return namespace


def checked_namespace_form(form: str) -> str:
    """A namespace in which ``{robot}`` may stand."""
    _refuse(_form_fault(form) or _of_form(form, _namespace_fault(filled(form, _LONGEST_ID))))
    return form


def checked_topic_form(form: str) -> str:
    """A topic name in which ``{robot}`` may stand, with or without leading slash; '' means no topic."""
    name = filled(form, _LONGEST_ID)
    fault = topic_fault(name if name.startswith("/") else f"/{name}")
    _refuse(form and (_form_fault(form) or _of_form(form, fault)))
    return form


def checked_merged_topic(topic: str) -> str:
    """An absolute topic name, short enough to append ``_static``; '' means no topic."""
    _refuse(topic and topic_fault(topic, MAX_TOPIC_LEN - len("_static")))
    return topic


def checked_frame_form(form: str) -> str:
    """The beginning of a frame name, in which ``{robot}`` may stand: tf2 takes no frame that begins with a slash."""
    fault = "must not begin with /, tf2 refuses such frames" if form.startswith("/") else ""
    unprintable = "" if form.isprintable() else "holds a character that cannot be printed"
    _refuse(_form_fault(form) or fault or unprintable)
    return form


def _namespace_fault(namespace: str) -> str:
    inner = namespace.removeprefix("/").removesuffix("/")
    return topic_fault(f"/{inner}", MAX_NAMESPACE_LEN) if inner else ""


def _form_fault(form: str) -> str:
    rest = form.replace(_FIELD, "")
    if "{src_id}" in rest:
        return "write {robot} for the sender, not {src_id}"
    return "only {robot} may stand in braces" if "{" in rest or "}" in rest else ""


def _of_form(form: str, fault: str) -> str:
    """A fault of a form; it names the sender's number that was filled in if the fault depends on it."""
    return f"{fault} (for sender {_LONGEST_ID})" if re.search(r"[0-9]", fault) and _FIELD in form else fault


def _refuse(fault: str) -> None:
    if fault:
        raise ValueError(fault)
