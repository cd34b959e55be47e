"""Definitions of the requests and replies of services that most robots have, for programs that have no ROS.

Invariant: a service whose definition is not known is no error; it has none.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

from rosbags.typesys import get_types_from_msg
from rosbags.typesys.store import Typestore

from gr_ros2.middleware.type_definitions import typestore

_NOTHING = "uint8 structure_needs_at_least_one_member\n"
"""What ROS puts into a request or a reply without members."""
_PARAMETERS, _LIFECYCLE = "rcl_interfaces/srv", "lifecycle_msgs/srv"
_SET = "rcl_interfaces/Parameter[] parameters\n---\nrcl_interfaces/SetParametersResult"
_TRANSITIONS = "---\nlifecycle_msgs/TransitionDescription[] available_transitions"
SHIPPED = {
    "std_srvs/srv/Empty": "---",
    "std_srvs/srv/SetBool": "bool data\n---\nbool success\nstring message",
    "std_srvs/srv/Trigger": "---\nbool success\nstring message",
    f"{_PARAMETERS}/DescribeParameters": "string[] names\n---\nrcl_interfaces/ParameterDescriptor[] descriptors",
    f"{_PARAMETERS}/GetParameters": "string[] names\n---\nrcl_interfaces/ParameterValue[] values",
    f"{_PARAMETERS}/GetParameterTypes": "string[] names\n---\nuint8[] types",
    f"{_PARAMETERS}/ListParameters": (
        "string[] prefixes\nuint64 depth\n---\nrcl_interfaces/ListParametersResult result"
    ),
    f"{_PARAMETERS}/SetParameters": f"{_SET}[] results",
    f"{_PARAMETERS}/SetParametersAtomically": f"{_SET} result",
    f"{_LIFECYCLE}/ChangeState": "lifecycle_msgs/Transition transition\n---\nbool success",
    f"{_LIFECYCLE}/GetState": "---\nlifecycle_msgs/State current_state",
    f"{_LIFECYCLE}/GetAvailableStates": "---\nlifecycle_msgs/State[] available_states",
    f"{_LIFECYCLE}/GetAvailableTransitions": _TRANSITIONS,
    f"{_LIFECYCLE}/GetTransitionGraph": _TRANSITIONS,
    "nav_msgs/srv/GetMap": "---\nnav_msgs/OccupancyGrid map",
}
"""As ROS ships them."""


class ServiceDefinition(NamedTuple):
    """The texts of a request and a reply, each with those of the types that it is made of."""

    request: str
    reply: str


@cache
def service_definition(type_name: str) -> ServiceDefinition | None:
    """What a service takes and gives; None where it is not known.

    :param type_name: ``package/srv/Type``
    """
    if type_name not in SHIPPED:
        return None
    request, _, reply = SHIPPED[type_name].partition("---")
    return ServiceDefinition(_whole(type_name, request), _whole(type_name, reply))


def _whole(type_name: str, text: str) -> str:
    """A text with those of the types that it is made of."""
    name = type_name.replace("/srv/", "/msg/")
    types = Typestore()
    types.register({**typestore().fielddefs, **get_types_from_msg(text, name)})
    return types.generate_msgdef(name, ros_version=2)[0] if text.strip() else _NOTHING
