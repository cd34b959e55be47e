"""The card with which a viewer asks other robots for topics."""

from __future__ import annotations

from typing import Any

from bokeh.events import ButtonClick
from bokeh.models import Button, Div, InlineStyleSheet, Select, Spinner

from gr_ros2.core.errors import ConfigError
from gr_ros2.dashboard.asked_card import AskedCard
from gr_ros2.dashboard.monitor import AskedView, RunMonitor

SCAN = {"name": "scan", "type_name": "t", "rate": 10.0, "size": 192.0, "wanted": False, "fits": False}
MAP = {**SCAN, "name": "map", "rate": 0.0, "size": 0.0, "wanted": True}


class Asked:
    """Notes what is asked; robot 3 refuses everything."""

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []

    def _note(self, *call: Any) -> None:
        if call[1] == 3:
            raise ConfigError("robot 3 is not heard; <nobody> is")
        self.calls.append(call)

    def offers(self, robot: int, *, anew: bool = False) -> None:
        self._note("offers", robot, anew)

    def want(self, robot: int, name: str, rate: float, for_s: float) -> None:
        self._note("want", robot, name, rate, for_s)

    def give_up(self, robot: int, name: str) -> None:
        self._note("give up", robot, name)


class Monitor(RunMonitor):
    wishes = Asked()  # type: ignore[assignment]


def part(card: AskedCard, kind: type[Any], name: str) -> Any:
    (found,) = card.root.select({"type": kind, "name": name})
    return found


def press(card: AskedCard, name: str) -> None:
    button = part(card, Button, name)
    button._trigger_event(ButtonClick(button))


def test_a_viewer_asks_and_gives_up_and_sees_what_became_of_it() -> None:
    monitor = Monitor()
    asked = monitor.wishes = Asked()  # type: ignore[misc]
    card = AskedCard(monitor, InlineStyleSheet())
    card.draw(None)
    press(card, "asked_want")
    assert asked.calls == []
    monitor.asked = AskedView({2: [], 3: [SCAN]}, ())
    card.draw(monitor.asked)
    assert part(card, Select, "asked_robot").options == ["2", "3"]
    assert part(card, Button, "asked_want").disabled
    press(card, "asked_list")
    monitor.asked = AskedView({2: [SCAN, MAP], 3: [SCAN]}, ("robot 2 sends <scan>",))
    card.draw(monitor.asked)
    topic = part(card, Select, "asked_topic")
    assert topic.options == [("scan", "scan, 10/s, 192 bytes"), ("map", "map, sent now")]
    part(card, Spinner, "asked_rate").value = 2
    press(card, "asked_want")
    topic.value = "map"
    card.draw(monitor.asked)
    assert topic.value == "map"
    press(card, "asked_give_up")
    assert asked.calls == [("offers", 2, True), ("want", 2, "scan", 2.0, 600.0), ("give up", 2, "map")]
    assert part(card, Div, "asked_said").text == '<div class="note">robot 2 sends &lt;scan&gt;</div>'
    part(card, Select, "asked_robot").value = "3"
    press(card, "asked_list")
    assert "robot 3 is not heard; &lt;nobody&gt; is" in part(card, Div, "asked_said").text
