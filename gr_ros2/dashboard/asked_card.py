"""The card of the page with which a viewer asks other robots for topics.

Invariant: the card shows what robots have answered, and passes what a viewer asks for; what is refused is said on it.
"""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from typing import Any

from bokeh.layouts import column, row
from bokeh.models import Button, Div, InlineStyleSheet, Select, Spinner

from gr_ros2.core.errors import GrRos2Error
from gr_ros2.dashboard.monitor import AskedView, RunMonitor

FOR_S = 600.0
"""s for which a topic is wanted that a viewer asks for; who wants it for longer asks again."""
_WIDE: Any = {"sizing_mode": "stretch_width"}


class AskedCard:
    """The widgets.

    :ivar root: holds them all
    """

    def __init__(self, monitor: RunMonitor, style: InlineStyleSheet) -> None:
        self._monitor = monitor
        self._refused = ""
        self._robot = Select(title="robot", name="asked_robot", **_WIDE)
        self._list = Button(label="What does it offer?", name="asked_list", **_WIDE)
        self._topic = Select(title="topic", name="asked_topic", **_WIDE)
        self._rate = Spinner(title="messages/s at most, 0 = all", name="asked_rate", low=0, value=0, step=1, **_WIDE)
        self._want = Button(label="Send it for 10 min", name="asked_want", button_type="primary", **_WIDE)
        self._give_up = Button(label="Give up", name="asked_give_up", **_WIDE)
        self._said = Div(name="asked_said", stylesheets=[style], disable_math=True, **_WIDE)
        self._robot.on_change("value", lambda _attribute, _old, _new: self.draw(monitor.asked))
        self._listen(self._list, lambda wishes, robot, _: wishes.offers(robot, anew=True))
        self._listen(
            self._want, lambda wishes, robot, topic: wishes.want(robot, topic, float(self._rate.value or 0), FOR_S)
        )
        self._listen(self._give_up, lambda wishes, robot, topic: wishes.give_up(robot, topic))
        buttons = row(self._want, self._give_up, **_WIDE)
        parts = (self._robot, self._list, self._topic, self._rate, buttons, self._said)
        self.root = column(*parts, name="asked", spacing=8, **_WIDE)

    def draw(self, view: AskedView | None) -> None:
        """Show what is known now. What a viewer has chosen stays chosen."""
        robots = [] if view is None else [str(robot) for robot in view.offers]
        if self._robot.options != robots:
            self._robot.options = robots
        if robots and self._robot.value not in robots:
            self._robot.value = robots[0]
        rows = [] if view is None or not self._robot.value else view.offers.get(int(self._robot.value), [])
        topics = [(row["name"], _label(row)) for row in rows]
        if self._topic.options != topics:
            self._topic.options = topics
        if topics and self._topic.value not in [name for name, _ in topics]:
            self._topic.value = topics[0][0]
        self._topic.disabled = self._want.disabled = self._give_up.disabled = not topics
        lines = [] if view is None else view.lines
        refused = f'<div class="note bad">{escape(self._refused)}</div>' if self._refused else ""
        self._said.text = refused + "".join(f'<div class="note">{escape(line)}</div>' for line in lines)

    def _listen(self, button: Button, act: Callable[[Any, int, str], object]) -> None:
        def pressed() -> None:
            self._refused = ""
            wishes = self._monitor.wishes
            try:
                if wishes is not None and self._robot.value:
                    act(wishes, int(self._robot.value), self._topic.value or "")
            except GrRos2Error as error:
                self._refused = str(error)
            self.draw(self._monitor.asked)

        button.on_click(pressed)


def _label(offer: dict[str, Any]) -> str:
    """A topic with what is known of it."""
    rate = f", {offer['rate']:.3g}/s" if offer["rate"] else ""
    size = f", {offer['size']:,.0f} bytes" if offer["size"] else ""
    return f"{offer['name']}{rate}{size}" + (", sent now" if offer["wanted"] else "")
