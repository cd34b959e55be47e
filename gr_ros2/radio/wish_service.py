"""The ROS service that asks other robots for topics: rcl_interfaces/SetParameters on ``/NODE/want``.

ROS ships no service that takes a name and a number for it but this one. The name of a parameter is that of a robot and
a topic, ``2/scan``. Its value is the rate in messages/s, 0 for as many as come, or the rate and s; a parameter that is
not set is given up, as ROS has it for parameters.

Invariant: every request is answered, at the latest when the robot has had its time to answer.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Sequence
from contextlib import suppress
from functools import cache, partial
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from gr_ros2.core.errors import ConfigError, MiddlewareError
from gr_ros2.gr.wish_ways import WishWays
from gr_ros2.middleware.services import ServiceGraph, ServiceServer
from gr_ros2.middleware.type_definitions import DAMAGED

WANT_TYPE = "rcl_interfaces/srv/SetParameters"
FOR_S = 60.0
"""s for which a topic is wanted where the request does not say."""
_MOST = 64
"""Parameters of a request that are read."""
_REQUEST, _RESPONSE = "gr_ros2/msg/SetParameters_Request", "gr_ros2/msg/SetParameters_Response"
_DIGITS = 9
"""Digits of a number that are read; Python refuses those of thousands."""
_NOT_SET, _INTEGER, _DOUBLE, _DOUBLES = 0, 2, 3, 8


@cache
def messages() -> Typestore:
    """The types of request and response."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg("rcl_interfaces/Parameter[] parameters\n", _REQUEST))
    store.register(get_types_from_msg("rcl_interfaces/SetParametersResult[] results\n", _RESPONSE))
    return store


class WishService:
    """The server.

    :raises MiddlewareError: when the service cannot be offered
    """

    def __init__(self, graph: ServiceGraph, node_name: str, wishes: WishWays) -> None:
        self._wishes = wishes
        self._server: ServiceServer = graph.serve(f"/{node_name}/want", WANT_TYPE, self._request)

    def close(self) -> None:
        """Leave the graph. Idempotent."""
        self._server.close()

    def _request(self, client: Hashable, payload: bytes) -> None:
        try:
            request: Any = messages().deserialize_cdr(payload, _REQUEST)
        except DAMAGED:
            return  # as a ROS node does with bytes that are no request
        asked: Sequence[Any] = request.parameters[:_MOST]
        results: list[tuple[bool, str] | None] = [None] * len(asked)
        lock = threading.Lock()

        def told(place: int, done: bool, words: str) -> None:
            with lock:
                results[place] = done, words
                whole = [result for result in results if result is not None]
            if len(whole) == len(results):
                with suppress(MiddlewareError):  # the link has ended meanwhile
                    self._server.reply(client, _response(whole))

        if not asked:
            self._server.reply(client, _response([]))
        for place, parameter in enumerate(asked):
            self._ask(parameter, partial(told, place))

    def _ask(self, parameter: Any, told: Callable[[bool, str], None]) -> None:
        robot, _, topic = parameter.name.partition("/")
        value = parameter.value
        try:
            if not (robot.isdecimal() and len(robot) <= _DIGITS) or not topic:
                raise ConfigError(f"{parameter.name!r}: write the number of a robot and a topic of it, such as 2/scan")
            if value.type == _NOT_SET:
                self._wishes.give_up(int(robot), topic)
                told(True, f"{topic} of robot {robot} is given up")
                return
            figures = {
                _INTEGER: [float(value.integer_value)],
                _DOUBLE: [value.double_value],
                _DOUBLES: [float(figure) for figure in value.double_array_value],
            }.get(value.type, [])
            if len(figures) not in (1, 2):
                raise ConfigError(f"{parameter.name}: its value is messages/s, such as 2.0, or [messages/s, s]")
            rate, for_s = (*figures, FOR_S)[:2]
            self._wishes.want(int(robot), topic, rate, for_s, told)
        except ConfigError as error:
            told(False, str(error))


def _response(results: Sequence[tuple[bool, str]]) -> bytes:
    store = messages()
    result, response = store.types["rcl_interfaces/msg/SetParametersResult"], store.types[_RESPONSE]
    made = response(results=[result(successful=done, reason=words) for done, words in results])
    return bytes(store.serialize_cdr(made, _RESPONSE))
