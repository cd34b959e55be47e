"""Rows of a registry that stand for services: a single one, an action, or the parameters or the lifecycle of a node.

In ROS 2 an action is three services and two topics, and nodes have services of their own. So such a row stands for
several rows, and the services that a graph shows are put together to rows again.

Invariant: ``rows_of`` finds every row whose services, as ``parts`` names them, are all on the graph.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

_SERVICE = re.compile(
    r"[A-Za-z][A-Za-z0-9_]*/(srv/[A-Za-z][A-Za-z0-9_]*|action/[A-Za-z][A-Za-z0-9]*_(SendGoal|GetResult))"
)
_ACTION = re.compile(r"[A-Za-z][A-Za-z0-9_]*/action/[A-Za-z][A-Za-z0-9]*")
_SEND_GOAL = "_SendGoal"
OF_ACTION = "/_action/"
"""Between the name of an action and the names of its services and topics."""
STATUS = "_action/status"
"""End of the name of an action's latched topic."""
_OF_NODES = {
    "parameters": {
        "describe_parameters": "rcl_interfaces/srv/DescribeParameters",
        "get_parameter_types": "rcl_interfaces/srv/GetParameterTypes",
        "get_parameters": "rcl_interfaces/srv/GetParameters",
        "list_parameters": "rcl_interfaces/srv/ListParameters",
        "set_parameters": "rcl_interfaces/srv/SetParameters",
        "set_parameters_atomically": "rcl_interfaces/srv/SetParametersAtomically",
    },
    "lifecycle": {
        "change_state": "lifecycle_msgs/srv/ChangeState",
        "get_available_states": "lifecycle_msgs/srv/GetAvailableStates",
        "get_available_transitions": "lifecycle_msgs/srv/GetAvailableTransitions",
        "get_state": "lifecycle_msgs/srv/GetState",
        "get_transition_graph": "lifecycle_msgs/srv/GetAvailableTransitions",
    },
}
"""The services of a node, by a word that stands in place of a type."""
_OTHERS_OF_NODES = {
    "get_logger_levels": "rcl_interfaces/srv/GetLoggerLevels",
    "get_type_description": "type_description_interfaces/srv/GetTypeDescription",
    "set_logger_levels": "rcl_interfaces/srv/SetLoggerLevels",
}
"""Further services that ROS itself gives to nodes. No word stands for them."""


@dataclass(frozen=True, slots=True)
class ServiceRow:
    """A row whose services a graph has.

    :param name: absolute name of the service, the action or the node
    :param kind: what stands in the second column: a type, or a word
    :param of_node: whether ROS itself gives these services to nodes
    """

    name: str
    kind: str
    of_node: bool = False


def is_service(type_name: str) -> bool:
    """Whether this is the type of a service: ``package/srv/Type``, or one of those that make an action."""
    return _SERVICE.fullmatch(type_name) is not None


def is_of_node(name: str, type_name: str) -> bool:
    """Whether this is a service that ROS itself gives to nodes, below the name of its node."""
    word = name.rpartition("/")[2]
    return any(services.get(word) == type_name for services in (*_OF_NODES.values(), _OTHERS_OF_NODES))


def parts(name: str, kind: str) -> dict[str, str]:
    """Types, by name, of the topics and services for which a row stands."""
    if kind in _OF_NODES:
        return {f"{name}/{service}": type_name for service, type_name in _OF_NODES[kind].items()}
    if not _ACTION.fullmatch(kind):
        return {name: kind}
    return {
        f"{name}{OF_ACTION}send_goal": f"{kind}{_SEND_GOAL}",
        f"{name}{OF_ACTION}cancel_goal": "action_msgs/srv/CancelGoal",
        f"{name}{OF_ACTION}get_result": f"{kind}_GetResult",
        f"{name}{OF_ACTION}feedback": f"{kind}_FeedbackMessage",
        f"{name}/{STATUS}": "action_msgs/msg/GoalStatusArray",
    }


def rows_of(services: Mapping[str, str]) -> list[ServiceRow]:
    """The rows for the services of a graph, sorted by name. An action is one row.

    A service of a node has a row of its own, and one together with the others of its kind.

    :param services: types by absolute name
    """
    rows = set()
    for name, type_name in services.items():
        action, of_action, _ = name.rpartition(OF_ACTION)
        node, _, word = name.rpartition("/")
        if of_action:
            if type_name.endswith(_SEND_GOAL) and name == f"{action}{OF_ACTION}send_goal":
                rows.add(ServiceRow(action, type_name.removesuffix(_SEND_GOAL)))
            continue
        of_node = is_of_node(name, type_name)
        if is_service(type_name):
            rows.add(ServiceRow(name, type_name, of_node))
        if node:
            words = [kind for kind, known in _OF_NODES.items() if known.get(word) == type_name]
            rows.update(ServiceRow(node, kind, of_node) for kind in words)
    return sorted(rows, key=lambda row: (row.name, row.kind))
