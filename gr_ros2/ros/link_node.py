"""`ros2 run gr_ros2 link`: one robot's end of a link as a node whose parameters are the link's settings.

Invariants: the configuration file describes the link. Parameters given at the start replace single settings of it, and
the result is checked as a whole. Settings that the running blocks can change may be set while they run. All other
settings are read-only. An error is one line on stderr. The exit status is 2 for wrong settings and 1 for a failed run,
as for `gr-ros2 link`. The log of the library goes where the node's own log goes: to the console and to /rosout.
"""

from __future__ import annotations

import logging
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import rclpy
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from gr_ros2.core.errors import ConfigError, GrRos2Error
from gr_ros2.core.systemd import notify
from gr_ros2.radio.config import load_link
from gr_ros2.radio.live_settings import LiveSettings
from gr_ros2.radio.robot_link import RobotLink
from gr_ros2.radio.waiting import NewFindings, Waiting
from gr_ros2.ros.parameters import Parameter, overrides, parameters

CONFIG = "config"
_USAGE = f"--ros-args -p {CONFIG}:=my_link.yaml"
_OF_ROS = ("use_sim_time", "start_type_description_service")
_LARGEST_INT, _LARGEST_FLOAT = 2**63 - 1, sys.float_info.max
_LOOK_S = 0.5
_LIBRARY_LOG = logging.getLogger("gr_ros2")


class LinkNode(Node):  # type: ignore[misc]
    """A link as a node with parameters.

    :raises ConfigError: for a missing file, an unknown parameter or a wrong value
    :raises MiddlewareError: when the ROS graph cannot be joined
    :raises RadioError: when the front end cannot be opened
    """

    def __init__(self) -> None:
        # The options of a topic are declared when they are set first: topics may come at any time.
        super().__init__(
            "gr_ros2_link", allow_undeclared_parameters=True, automatically_declare_parameters_from_overrides=True
        )
        self._log = _NodeLog(self)
        _LIBRARY_LOG.setLevel(logging.INFO)
        _LIBRARY_LOG.addHandler(self._log)
        given = {name: item.value for name, item in self.get_parameters_by_prefix("").items()}
        path = given.pop(CONFIG, None)
        if not path:
            raise ConfigError(f"parameter {CONFIG} is missing; give the YAML file: {_USAGE}")
        chosen = {name: value for name, value in given.items() if not name.startswith((*_OF_ROS, "qos_overrides."))}
        if given.get("use_sim_time"):
            chosen.setdefault("graph.use_sim_time", True)
        self.link = RobotLink(load_link(Path(str(path)).expanduser(), overrides(chosen)))
        self._live = LiveSettings(self.link.source, self.link.sink)
        for parameter in _settings(self.link):
            self._show(parameter)
        self.add_on_set_parameters_callback(self._set)

    def destroy_node(self) -> None:
        """Leave the graph."""
        _LIBRARY_LOG.removeHandler(self._log)
        super().destroy_node()

    def _show(self, parameter: Parameter) -> None:
        """Declare a parameter with the value in the link. At the start it may have been given as another type."""
        if self.has_parameter(parameter.name):
            self.undeclare_parameter(parameter.name)
        descriptor = _descriptor(parameter, read_only=not self._live.can_change(parameter.name))
        self.declare_parameter(parameter.name, parameter.value, descriptor, ignore_override=True)

    def _set(self, changed: Sequence[Any]) -> SetParametersResult:
        for parameter in changed:
            try:
                if self._live.can_change(parameter.name) or not self.has_parameter(parameter.name):
                    self._live.change(parameter.name, parameter.value)
            except ConfigError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)


class _NodeLog(logging.Handler):
    """Passes log records on to a node's logger. Those of ``debug`` become information, because the user asked for
    them."""

    def __init__(self, node: Node) -> None:
        super().__init__()
        self._logger = node.get_logger()

    def emit(self, record: logging.LogRecord) -> None:
        # One call for each severity: rclpy requires that a line of code always logs with the same one.
        if record.levelno >= logging.ERROR:
            self._logger.error(self.format(record))
        elif record.levelno >= logging.WARNING:
            self._logger.warning(self.format(record))
        else:
            self._logger.info(self.format(record))


def _settings(link: RobotLink) -> list[Parameter]:
    """The settings of the configuration, and all settings of the PHY and the front end, each once."""
    found = list(parameters(link.config))
    for prefix, part in (("phy.options.", link.phy), ("front_end.", link.front_end)):
        found += parameters(part.options, prefix)
    return list({parameter.name: parameter for parameter in found}.values())


def _descriptor(parameter: Parameter, *, read_only: bool) -> ParameterDescriptor:
    made = ParameterDescriptor(
        name=parameter.name,
        description=parameter.meaning,
        additional_constraints=parameter.rule,
        read_only=read_only,
        dynamic_typing=not parameter.strict,
    )
    least, most = parameter.minimum, parameter.maximum
    if (least, most) == (None, None):
        return made
    if isinstance(parameter.value, float):
        least, most = -_LARGEST_FLOAT if least is None else least, _LARGEST_FLOAT if most is None else most
        made.floating_point_range = [FloatingPointRange(from_value=least, to_value=most)]
    elif isinstance(parameter.value, int):
        bounds = -_LARGEST_INT if least is None else int(least), _LARGEST_INT if most is None else int(most)
        made.integer_range = [IntegerRange(from_value=bounds[0], to_value=bounds[1])]
    return made


def _join(words: Sequence[str]) -> None:
    """Start rclpy with the arguments of the command line, the program's name first.

    :raises ConfigError: for arguments that ROS cannot read, or that are not for ROS
    """
    try:
        # We use our own handlers. Those of rclpy would end every context at once, also one that the link still uses.
        rclpy.init(args=list(words), signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        raise ConfigError(f"{error}; write {_USAGE}") from error
    others = remove_ros_args(list(words))[1:]
    if others:
        raise ConfigError(f"argument {others[0]!r}: every setting is a ROS parameter; write {_USAGE}")


def main(args: Sequence[str] | None = None) -> None:
    """Run the node until it is interrupted or its link has finished.

    :param args: the command line, the program's name first
    """
    asked: list[int] = []
    # Not KeyboardInterrupt: if it is raised in an import or a C callback during the start, it is lost. And one
    # Ctrl-C may come twice, from the terminal and from `ros2 launch`.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, lambda number, _: asked.append(number))
    node = None
    status: int | str = 0
    try:
        _join(sys.argv if args is None else args)
        node = LinkNode()
        node.link.start()
        phy = node.link.phy
        runs_on = f", runs on {phy.runs_on()}" if phy.runs_on() else ""
        node.get_logger().info(f"robot {node.link.source.src_id} on {node.link.front_end.name}, {phy.name}{runs_on}")
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        waiting, findings = Waiting(node.link.source), NewFindings(node.link.findings.lines)
        notify("READY=1")
        while not (asked or node.link.finished):
            executor.spin_once(timeout_sec=_LOOK_S)
            node.link.check()
            notify("WATCHDOG=1")
            if (waits_for := waiting.look()) is not None:
                node.get_logger().info(waits_for)
            for line in findings.new(time.monotonic()):
                node.get_logger().warning(line)
    except ExternalShutdownException:
        pass
    except GrRos2Error as error:
        print(f"gr_ros2 link: {error}", file=sys.stderr)
        status = 2 if isinstance(error, ConfigError) else 1
    finally:
        if node is not None:
            node.link.stop()
            node.destroy_node()
        rclpy.try_shutdown()
    sys.exit(status)
