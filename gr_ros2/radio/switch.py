"""The ROS service that switches sending off and on: std_srvs/SetBool on ``/NODE/transmit``.

Invariant: the answer comes after the switch, so who has it knows that no further packet reaches the device.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from struct import pack

from gr_ros2.middleware.services import ServiceGraph

SWITCH_TYPE = "std_srvs/srv/SetBool"
_CDR = b"\0\1\0\0"


class TransmitSwitch:
    """The server.

    :param transmit: switches sending
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
        self._transmit(on)
        self._server.reply(client, _CDR + pack("<B3xI", 1, 1 + len(_TOLD[on])) + _TOLD[on] + b"\0")


_TOLD = {True: b"sending is on", False: b"sending is off"}
