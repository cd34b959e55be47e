"""The table of checks, in the order in which they are reported."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from gr_ros2.doctor import computer, installed, radios, ros
from gr_ros2.doctor.finding import Check, Finding

CHECKS: tuple[Check, ...] = (
    Check("Installed", "Python", installed.python),
    Check("Installed", "GNU Radio", installed.gnu_radio),
    Check("Installed", "compiled kernels", installed.kernels),
    Check("Installed", "middleware", installed.middleware),
    Check("Installed", "phy", installed.phys),
    Check("Installed", "front ends", installed.front_ends),
    Check("Installed", "GRC", installed.companion),
    Check("Installed", "optional parts", installed.parts),
    Check("Radios", "USB", radios.usb),
    Check("Radios", "drivers", radios.programs),
    Check("Radios", "sound", radios.sound),
    Check("ROS 2", "distribution", ros.distribution),
    Check("ROS 2", "RMW", ros.rmw),
    Check("ROS 2", "domain", ros.domain),
    Check("ROS 2", "graph", ros.graph),
    Check("Clock", "date", computer.date),
    Check("Clock", "NTP", computer.synchronised),
    Check("Clock", "drift", computer.drift),
    Check("Real time", "limits", computer.limits),
    Check("Real time", "shared memory", computer.shared_memory),
    Check("Real time", "CPU governor", computer.governor),
    Check("Real time", "processors", computer.load),
    Check("Real time", "socket buffers", computer.buffers),
    Check("Real time", "message ports", computer.message_ports),
)


def examine(checks: Sequence[Check] | None = None) -> Iterator[tuple[str, Finding]]:
    """Run checks. Yield each finding with its heading as soon as it is made.

    :param checks: None = those of the computer
    """
    for check in CHECKS if checks is None else checks:
        for finding in check.findings():
            yield check.group, finding
