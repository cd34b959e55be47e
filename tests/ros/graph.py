"""A node of our own beside those that a test starts."""

from __future__ import annotations

import threading
from typing import Any

import rclpy
import rclpy.context
import rclpy.executors
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters

from tests.waiting import PATIENCE_S, wait_for


class Graph:
    """A node beside the link's."""

    def __init__(self, domain: int) -> None:
        self._context = rclpy.context.Context()
        self._context.init(args=[], domain_id=domain)
        self.node = rclpy.create_node("beside", context=self._context)
        self._executor = rclpy.executors.SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def ask(self, kind: Any, name: str, request: Any) -> Any:
        client = self.node.create_client(kind, f"/gr_ros2_link/{name}")
        wait_for(client.service_is_ready, name)
        future = client.call_async(request)
        wait_for(future.done, name)
        return future.result()

    def set(self, name: str, value: Any) -> tuple[bool, str]:
        kinds = {
            int: ("integer_value", ParameterType.PARAMETER_INTEGER),
            float: ("double_value", ParameterType.PARAMETER_DOUBLE),
            str: ("string_value", ParameterType.PARAMETER_STRING),
        }
        field, number = kinds[type(value)]
        parameter = Parameter(name=name, value=ParameterValue(type=number, **{field: value}))
        (result,) = self.ask(SetParameters, "set_parameters", SetParameters.Request(parameters=[parameter])).results
        return result.successful, result.reason

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()
        self._thread.join(PATIENCE_S)
