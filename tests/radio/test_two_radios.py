"""Two robots with two radios each: a device that is pulled out, a radio that nobody hears, and a slow one beside."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.radio.config import link_from
from gr_ros2.radio.robot_link import RobotLink
from tests.radio.robots import config
from tests.radio.team import FAST, SLOW, Team, modem
from tests.waiting import wait_for


@pytest.fixture
def closing() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.mark.real_time  # of what is said faster than a slow computer takes it, some is dropped
def test_two_like_radios_share_the_load_and_every_message_comes_once(tmp_path: Path, closing: ExitStack) -> None:
    team = Team(tmp_path, (FAST, FAST), closing)
    team.talk(0, 100)
    radios = team.robots[0].link.stats()["radios"]
    sent = [radios[name]["sent"] for name in ("left", "right")]
    assert min(sent) > 0.3 * sum(sent)
    assert team.radio(2, "left")["copies"] + team.radio(2, "right")["copies"] > 0
    assert team.robots[1].link.stats()["sink"]["rejected"] == {}


@pytest.mark.slow
@pytest.mark.parametrize("rates", [(FAST, FAST), (FAST, SLOW), (SLOW, FAST)])
def test_a_radio_that_is_pulled_out_loses_no_message(
    tmp_path: Path, closing: ExitStack, rates: tuple[int, int]
) -> None:
    team = Team(tmp_path, rates, closing)
    team.talk(0)
    team.cables[0].pull()
    team.talk(100)
    team.talk(200)
    team.cables[0].plug()
    wait_for(lambda: team.radio(2, "left")["heard"].get(1, 0.0) > 0.5, "the radio to be heard again")
    team.cables[1].pull()
    team.talk(300)


@pytest.mark.parametrize("via", ["all", "best"])
def test_via_says_what_leaves_over_all_radios(tmp_path: Path, closing: ExitStack, via: str) -> None:
    team = Team(tmp_path, (SLOW, FAST), closing, topics={"auto": {"via": via}})
    before = team.radio(1, "left")["copied"]
    team.talk(0, 2)
    messages = 2 * 4  # of several packets each
    assert (team.radio(1, "left")["copied"] + team.radio(1, "left")["skipped"] - before > messages) is (via == "all")


def test_a_slow_radio_stands_by_with_copies_alone(tmp_path: Path, closing: ExitStack) -> None:
    team = Team(tmp_path, (SLOW, FAST), closing)
    team.talk(0)
    wait_for(lambda: team.radio(1, "left")["copied"] > 0, "a copy over the slow radio")
    assert team.radio(1, "left")["carries"] is False
    assert team.radio(1, "right")["carries"] is True


def test_each_radio_has_a_name_a_phy_a_front_end_and_airtime_of_its_own(tmp_path: Path) -> None:
    sim, modem_of = {"name": "sim"}, modem(SLOW)
    radios = [{"name": "one", "front_end": sim, "airtime": "eu868"}, {"name": "two", "front_end": sim, "phy": modem_of}]
    state = str(tmp_path / "state")
    limit = {"duty_cycle": 0.5}
    link = RobotLink(config(1, {"name": "sim"}, radios=radios, state=state, phy=modem(FAST), airtime=limit))
    try:
        found = link.stats()["radios"]
    finally:
        link.stop()
    assert list(found) == ["one", "two"]
    assert found["two"]["phy"]["airtime_s"] > 10 * found["one"]["phy"]["airtime_s"]
    allowed = [found[name]["airtime"]["allowed_s"] for name in ("one", "two")]
    assert allowed == [pytest.approx(36.0), pytest.approx(1800.0)]


def test_a_radio_that_is_pulled_and_plugged_in_carries_again(tmp_path: Path, closing: ExitStack) -> None:
    team = Team(tmp_path, (FAST, FAST), closing)
    team.cables[0].pull()
    team.cables[0].plug()
    wait_for(lambda: team.radio(1, "left")["carries"] and team.radio(1, "right")["carries"], "both to be heard")
    team.talk(0)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"radios": [{"front_end": {"name": "sim"}}]}, "1 of 2 to 4; one alone is front_end"),
        ({"radios": [{"front_end": {"name": "sim"}}] * 2}, "two are called 'sim'; give each a name of its own"),
        ({"front_end": {"name": "udp"}}, "front_end = {'name': 'udp'}: with radios, each has its own"),
        ({"medium": "slots"}, "radios: all have medium slots"),
        ({"radios": [], "topics": {"odom": {"via": "all"}}}, "topics.odom.via = 'all': a robot with one radio"),
        ({"record": "samples"}, "several radios have no signal in common"),
        ({"radios": [{"name": "a", "front_end": {}}, {"name": "b", "front_end": {}}]}, "front_end.name is missing"),
        (
            {
                "phy": {"name": "direct"},
                "radios": [{"name": "a", "front_end": {"name": "sim"}}, {"name": "b", "front_end": {"name": "nope"}}],
            },
            "radios.1.front_end.name = 'nope'",
        ),
        (
            {
                "radios": [
                    {"name": n, "front_end": {"name": "sim"}, "phy": {"name": "ofdm", "options": {}}} for n in "ab"
                ]
            },
            "radios.0.phy.sample_rate = auto",
        ),
    ],
)
def test_what_several_radios_cannot_have_is_said(change: dict[str, Any], problem: str) -> None:
    radios = [{"name": name, "front_end": {"name": "sim"}, "phy": {"name": "direct"}} for name in ("a", "b")]
    with pytest.raises(ConfigError) as refused:
        link_from({"robot": 1, "radios": radios, **change})
    assert problem in str(refused.value)
