"""Numbers and packets as HTML: nothing from outside is markup."""

from __future__ import annotations

from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from gr_ros2.dashboard.state import DashboardState
from gr_ros2.dashboard.tables import (
    colour,
    counters_html,
    heard_html,
    packets_html,
    paths_html,
    team_html,
    tiles_html,
    topics_html,
)
from gr_ros2.dashboard.views import AirView, RobotView, Snapshot
from gr_ros2.observe.team import PairView, TeamView
from tests.dashboard.feed import NAMES, REGISTRY, SRC, Feed, at


class Balanced(HTMLParser):
    """Fails on a tag that is not closed in its turn; collects ``data-value`` by ``data-field``."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.values: dict[str, str | None] = {}
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.open.append(tag)
        found = dict(attrs)
        if "data-field" in found:
            self.values[str(found["data-field"])] = found.get("data-value")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def snapshot(name: str = "/robot_4/at") -> Snapshot:
    state = DashboardState(REGISTRY, {**NAMES, (SRC, 0): name}, 64, name=name)
    feed = Feed(state, packet_len=64, lost=lambda number: number == 4)
    for step in range(20):
        feed.submit(0, at(step, 0), step / 10)
        feed.submit(1, bytes(200), step / 10)
        feed.fly(step / 10)
    feed.hear(b"<b>", 2.0)
    return state.tick(2.0, {(SRC, 0): 3})


def test_what_is_written_is_well_formed_with_data_and_without() -> None:
    for shown in (Snapshot(), snapshot(), snapshot("<script>alert(1)</script>&")):
        counters = counters_html(shown, 3, 12.3), counters_html(shown, None, None)
        for text in (tiles_html(shown), *counters, topics_html(shown), paths_html(shown)):
            assert "<script" not in text
            Balanced(text)
        Balanced(packets_html(shown))


def test_the_exact_value_stands_beside_the_rounded_one() -> None:
    shown = snapshot()
    tiles, counters = Balanced(tiles_html(shown)).values, Balanced(counters_html(shown, 3, 12.34)).values
    assert counters["sent"] == "40"
    assert tiles["pdr"] == repr(shown.pdr)
    assert (counters["backlog"], counters["snr"]) == ("3", "12.34")
    unknown = Balanced(counters_html(shown, None, None)).values
    assert unknown["backlog"] is unknown["snr"] is None
    assert Balanced(topics_html(shown)).values["sent"] == "20"


def test_a_bar_leaves_room_for_what_only_the_other_end_knows() -> None:
    shown = snapshot()
    topic = replace(shown.topics[0], sent=500, delivered=0, ledger={"stale": 1})
    assert 'style="flex:499"' in topics_html(replace(shown, topics=(topic,)))
    assert "flex:-" not in topics_html(shown)
    assert "waiting for the first message" in topics_html(Snapshot())


def test_a_packet_shows_its_fields_and_what_is_missing() -> None:
    text = packets_html(snapshot())
    assert "raw #" in text
    assert "4 → all" in text
    assert "length" in text


def test_colours_repeat_and_strangers_are_grey() -> None:
    assert colour(0) == colour(16)
    assert colour(-1) not in {colour(place) for place in range(16)}


def test_a_link_that_repairs_nothing_says_nothing_of_repair() -> None:
    assert "repair" not in counters_html(snapshot(), None, None)


def test_the_top_line_says_what_is_old_and_what_the_air_is_used_for() -> None:
    shown = snapshot()
    values = Balanced(tiles_html(shown)).values
    oldest = max((topic for topic in shown.topics if topic.age_now_s is not None), key=lambda one: one.age_now_s or 0)
    assert values["oldest"] == repr(oldest.age_now_s)
    assert f"age of {oldest.name}, the oldest" in tiles_html(shown)
    busy = {"new": np.array([0.5, 0.2]), "repair": np.array([0.0, 0.1])}
    air = AirView(np.array([1.0, 2.0]), busy, np.array([9.0, 9.0]), np.array([0.0, 0.0]))
    assert float(Balanced(tiles_html(Snapshot(air=air))).values["busy"] or 0) == pytest.approx(0.3)
    assert Balanced(tiles_html(Snapshot())).values["busy"] is None


def test_who_hears_whom_has_a_cell_for_each_pair() -> None:
    pairs = {(1, 2): PairView(0.5, 17.6), (2, 1): PairView(None, None)}
    html = team_html(Snapshot(team=TeamView(9.0, (1, 2), (), pairs, {}, {})))
    assert Balanced(html)
    assert '<td data-pair="1 2">50%, 18 dB</td>' in html
    assert '<td data-pair="2 1">–</td>' in html
    assert team_html(Snapshot()) == ""
    far = {(1, 7): PairView(0.0, None, 2, 3)}
    assert '<td data-pair="1 7">over 3, hop 2</td>' in team_html(Snapshot(team=TeamView(9.0, (1, 7), (), far, {}, {})))
    heard = heard_html(Snapshot(heard=(RobotView(3, 0.1, 50), RobotView(7, 0.4, 0, 2, 3))))
    assert '<td data-field="way"></td>' in heard
    assert '<td data-field="way">over 3, hop 2</td>' in heard
    assert "its clock is ahead" not in heard, "nobody has one"
    assert "messages come" not in heard_html(Snapshot(heard=(RobotView(3, 0.1, 50),)))
