"""The topics of ROS Links as a table in the window of a flowgraph made by GRC.

Invariant: only Qt's thread touches the table; the links are asked for their counters once in ``PERIOD_S``.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any, NamedTuple

from PyQt5 import Qt

PERIOD_S = 1.0
WINDOW = 1100, 860
"""Pixels that the window gets where nobody has resized it before: GRC opens it with 634 by 430."""
COLUMNS = ("Robot", "", "Topic", "Messages", "Per second", "Latency (ms)")


class TopicRow(NamedTuple):
    """One topic of one link.

    :param way: ``sends`` or ``receives``
    :param messages: taken from the graph, or published on it
    :param latency_s: median of the newest ones; None where it is not known
    """

    robot: int
    way: str
    topic: str
    messages: int
    latency_s: float | None


def rows_of(link: Any) -> Iterator[TopicRow]:
    """The topics of a :class:`gr_ros2.gr.RosLink`, those it sends first."""
    robot = link.source.src_id
    for name, topic in link.source.stats()["topics"].items():
        yield TopicRow(robot, "sends", name, topic["submitted"], None)
    for name, topic in link.sink.stats()["topics"].items():
        latency = topic["recent_latency_s"]
        yield TopicRow(robot, "receives", name, topic["delivered"], latency and latency["p50"])


class TopicTable(Qt.QTableWidget):  # type: ignore[misc]
    """The table, which renews itself.

    :param flowgraph: has the links as attributes; they may be made later than this table
    :param links: names of these attributes, separated by commas or spaces
    """

    def __init__(self, flowgraph: Any, links: str) -> None:
        super().__init__(0, len(COLUMNS))
        self._flowgraph, self._links = flowgraph, links.replace(",", " ").split()
        self._shown = False
        self._before: dict[tuple[int, str, str], tuple[float, int]] = {}
        self.setHorizontalHeaderLabels(COLUMNS)
        self.verticalHeader().hide()
        self.verticalHeader().setDefaultSectionSize(self.fontMetrics().height() + 6)
        self.setEditTriggers(Qt.QAbstractItemView.NoEditTriggers)
        self.horizontalHeader().setSectionResizeMode(Qt.QHeaderView.ResizeToContents)
        self.horizontalHeader().setSectionResizeMode(2, Qt.QHeaderView.Stretch)
        self._timer = Qt.QTimer(self)
        self._timer.timeout.connect(self.refresh)
        self._timer.start(round(PERIOD_S * 1000))

    def showEvent(self, event: Any) -> None:
        """The window has all its parts when the table is first shown in it."""
        super().showEvent(event)
        window = self.window()
        kept = getattr(window, "settings", None)  # GRC's, which have the size at which the window was last closed
        if not self._shown and not (kept and kept.value("geometry")):
            screen = Qt.QApplication.primaryScreen().availableGeometry().size()
            window.resize(window.size().expandedTo(Qt.QSize(*WINDOW)).boundedTo(screen))
        self._shown = True

    def refresh(self) -> None:
        """Show what the links count now."""
        cells = [row for name in self._links for row in self._rows(name)]
        self.setRowCount(len(cells))
        for number, texts in enumerate(cells):
            for column, text in enumerate(texts):
                item = Qt.QTableWidgetItem(text)
                if column > 2:
                    item.setTextAlignment(int(Qt.Qt.AlignRight | Qt.Qt.AlignVCenter))
                self.setItem(number, column, item)

    def _rows(self, name: str) -> Iterator[tuple[str, ...]]:
        link = getattr(self._flowgraph, name, None)
        if link is None:
            yield ("", "", f"no block {name} in this flowgraph: see Links of the table", "", "", "")
            return
        now = time.monotonic()
        for row in rows_of(link):
            since, counted = self._before.get(row[:3], (now, row.messages))
            self._before[row[:3]] = now, row.messages
            rate = f"{(row.messages - counted) / (now - since):.1f}" if now > since else ""
            latency = "" if row.latency_s is None else f"{row.latency_s * 1000:.1f}"
            yield (str(row.robot), row.way, row.topic, f"{row.messages:,}", rate, latency)
