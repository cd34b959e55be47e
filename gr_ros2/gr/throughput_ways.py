"""What the link to another robot carries over each way of a robot that has several radios.

What any radio may carry is one way, and each radio whose channel other robots share is another one with an endpoint of
its own (:mod:`gr_ros2.gr.bound`). No two ways have air in common, so they are measured at the same time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from gr_ros2.gr.throughput import LiveThroughput

MAIN = ""
"""Name of the way that any radio may carry."""
_OVER = ("done", "failed")


class ThroughputWays:
    """The measurements of one robot over each of its ways.

    :param ways: those that there are now, at least one, by the names of their radios
    """

    def __init__(self, ways: Callable[[], Mapping[str, LiveThroughput]]) -> None:
        self._ways = ways
        self._measured: Mapping[str, LiveThroughput] = {}

    def measure(self, robot: int, for_s: int) -> None:
        """As :meth:`LiveThroughput.measure`, over all ways over which the robot is heard, or over none."""
        ways = self._ways()
        heard = {name: way for name, way in ways.items() if way.hears(robot)} or dict([next(iter(ways.items()))])
        for way in heard.values():
            way.check(robot, for_s)
        for way in heard.values():
            way.measure(robot, for_s)
        self._measured = heard

    def look(self) -> dict[str, Any]:
        """As :meth:`LiveThroughput.look`, of what any radio may carry, with ``radios``: the same of each that has its
        channel for itself, by name. The state is that of the way that takes longest; failed, if none did not."""
        told = {name: way.look() for name, way in self._measured.items()}
        if not told:
            return {"state": "none"}
        first = next(iter(told.values()))
        ends = [each for each in told.values() if each["state"] == "done"] or [first]
        going = [each for each in told.values() if each["state"] not in _OVER]
        nothing = {"there": None, "back": None}
        return {
            **first,
            **{way: told.get(MAIN, nothing)[way] for way in nothing},
            "state": (going or ends)[0]["state"],
            "words": "; ".join(dict.fromkeys(each["words"] for each in told.values() if each["words"])),
            "radios": {name: each for name, each in told.items() if name != MAIN},
        }
