"""Who may send: a radio asks for a word, and for a key; a link that only receives sends nothing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.core.errors import ConfigError
from gr_ros2.radio import FRONT_ENDS
from gr_ros2.radio.robot_link import permitted
from gr_ros2.state.keys import new_key_file
from tests.radio.cables import SerialCable
from tests.radio.robots import Robot, config
from tests.waiting import wait_for

SERIAL = {"name": "serial", "device": "/dev/ttyUSB0"}
UDP = {"name": "udp", "listen": "127.0.0.1:5001", "send_to": ["127.0.0.1:5002"]}
MODEM = {"name": "modem", "options": {"bit_rate": 1e6}}


def may_send(front_end: dict[str, Any], **values: Any) -> bool:
    link = config(1, front_end, **{"version": 1, "phy": MODEM, **values})
    return permitted(link, FRONT_ENDS.load(link.front_end_name))


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (
            {"transmit": "auto"},
            "serial sends at the frequency and power that the radio is set to: say once that it may",
        ),
        ({"transmit": True, "open": False}, "there is no key: anybody could read, forge and replay"),
    ],
)
def test_a_radio_asks_first(values: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        may_send(SERIAL, **values)


def test_a_word_and_a_key_are_enough_and_what_is_no_radio_asks_for_neither(tmp_path: Path) -> None:
    new_key_file(tmp_path / "fleet.key")
    assert may_send(SERIAL, transmit=True, key=str(tmp_path / "fleet.key"))
    assert may_send(SERIAL, transmit=True, open=True)
    assert may_send(UDP, transmit="auto", open=False)
    assert not may_send(SERIAL, transmit=False, open=False)
    assert not may_send(UDP, transmit=False)


def test_the_power_is_said_where_it_is_known() -> None:
    pytest.importorskip("gnuradio.iio")
    told = FRONT_ENDS.load("pluto").on_air({"frequency": 433.2e6, "gain_tx": -10, "level": 0.1})
    assert told == "at 433,200,000 Hz with gain_tx -10 dB, level 0.1, about -23 dBm"


def test_a_link_that_only_receives_hears_and_sends_nothing(tmp_path: Path) -> None:
    with SerialCable(tmp_path) as cable:
        ends = [{"name": "serial", "device": str(end), "half_duplex": False} for end in cable.ends]
        common = {"version": 1, "phy": MODEM}
        with (
            Robot(1, ends[0], state=str(tmp_path / "1"), **common) as one,
            Robot(2, ends[1], hears=(1,), state=str(tmp_path / "2"), transmit=False, **common) as two,
        ):
            wait_for(lambda: two.link.stats()["peers"], "a hello")
            said = one.say(1, 2, 3)
            wait_for(lambda: two.heard == said, "the messages")
            assert two.link.stats()["packets"]["out"] == 0
            assert two.link.source.stats()["topics"] == {}
            assert one.link.stats()["peers"] == []
