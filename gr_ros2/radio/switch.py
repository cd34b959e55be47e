"""The ROS service that switches sending off and on: std_srvs/SetBool on ``/NODE/transmit``.

Invariant: the answer comes after the switch, so who has it knows that no further packet reaches the device.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from struct import pack

from gr_ros2.core.errors import ConfigError
from gr_ros2.middleware.services import ServiceGraph

SWITCH_TYPE = "std_srvs/srv/SetBool"
_CDR = b"\0\1\0\0"


class TransmitSwitch:
    """The server.

    :param transmit: switches sending, or raises ConfigError where it cannot
    :raises MiddlewareError: when the service cannot be offered
    """

    def __init__(self, graph: ServiceGraph, node_name: str, transmit: Callable[[bool], None]) -> None:
        self._transmit = transmit
        self._server = graph.serve(f"/{node_name}/transmit", SWITCH_TYPE, self._request)

    def close(self) -> None:
        """Leave the graph. Idempotent."""
        self._server.close()

    def _request(self, client: Hashable, payload: bytes) -> None:
        on = len(payload) > len(_CDR) and payload[len(_CDR)] != 0
        done, told = True, f"sending is {'on' if on else 'off'}"
        try:
            self._transmit(on)
        except ConfigError as error:
            done, told = False, str(error)
        text = told.encode()
        self._server.reply(client, _CDR + pack("<B3xI", done, 1 + len(text)) + text + b"\0")
