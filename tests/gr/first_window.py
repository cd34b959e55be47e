"""The window of GRC's first example, without a screen: constellation, spectrum, a slider and the table of topics.

A test runs it as a program, with the example and a folder.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from PyQt5 import Qt

from tests.gr.probe import Probe
from tests.gr.test_grc import in_memory, make_platform
from tests.waiting import wait_for


def main(path: Path, folder: Path) -> None:
    """Asserts what the window shows while the slider is moved."""
    application = Qt.QApplication([])
    top = in_memory(make_platform(), path, folder)
    points = Probe()
    try:
        assert {name for name in vars(top) if name.startswith("_") and name.endswith("_win")} == {
            "_snr_db_win", "_qtgui_const_sink_0_win", "_qtgui_freq_sink_0_win", "_topic_table_0_win",
        }  # fmt: skip
        top.msg_connect((top.radio_1, "points"), (points, "pdus"))
        top.start()

        def cells() -> dict[tuple[str, ...], tuple[str, ...]]:
            """Robot, way and topic of each row of the table, with its messages, rate and latency."""
            application.processEvents()
            table = top.topic_table_0
            rows = [[table.item(row, column).text() for column in range(6)] for row in range(table.rowCount())]
            return {tuple(row[:3]): tuple(row[3:]) for row in rows}

        def rate(robot: str, way: str, topic: str) -> float:
            return float(cells().get((robot, way, topic), ("", "0", ""))[1] or 0)

        odometry = "2", "receives", "/rx_robot_1/odom"
        wait_for(lambda: rate(*odometry) > 20, "odometry of the simulated robot, 30 a second")
        assert float(cells()[odometry][2]) > 0
        assert rate("1", "sends", "/robot_1/odom") > 20
        assert points.handled > 10
        top.set_snr_db(0)
        wait_for(lambda: rate(*odometry) == 0 < rate("1", "sends", "/robot_1/odom"), "everything to drown in noise")
        top.set_snr_db(20)
        wait_for(lambda: rate(*odometry) > 20, "odometry without noise")
        top.topic_table_0._links.append("ros2_link_9")
        wait_for(
            lambda: ("", "", "no block ros2_link_9 in this flowgraph: see Links of the table") in cells(), "a line"
        )
    finally:
        top.robot.close()
        top.stop()
        top.wait()
        top.ros2_link_1.close()
        top.ros2_link_2.close()
        top.radio_1.close()
        top.radio_2.close()
        top.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
    os._exit(0)  # Qt takes its windows apart in an order that may crash
