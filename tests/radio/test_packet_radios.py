"""The presets of packet radios against emulators of these radios, which lose what real ones lose."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from gr_ros2.radio import PRESETS
from gr_ros2.radio.one_line import one_line
from tests.radio.packet_radios import Channel, LoraUart, Radio, Sik, SlowTnc, Tnc
from tests.radio.robots import Robot
from tests.waiting import wait_for

RADIOS: dict[str, Callable[[Path, int], Radio]] = {
    "sik": Sik,
    "lora-uart": lambda line, _: LoraUart(line),
    "kiss": lambda line, number: SlowTnc(line, random.Random(number)),
    "kiss-9600": lambda line, number: Tnc(line, random.Random(number)),
}


OTHER = {"kiss-9600": {"bit_rate": 9600.0, "overhead_s": 0.6}}
"""What docs/how-to/packet-radios.md says of a TNC of 9,600 bits/s."""


def robot(number: int, radio: str, folder: Path, faster: float = 1.0, **front_end: Any) -> Robot:
    """A robot with the settings of a preset; its modem takes packets ``faster`` times as fast, as far as it knows."""
    preset = one_line(number, radio.partition("-9600")[0], None, {"device": str(folder / f"tty-{number}")})
    phy = dict(preset["phy"])
    phy["options"] = {**phy["options"], **OTHER.get(radio, {})}
    if faster > 1:
        phy["options"] |= {"bit_rate": phy["options"]["bit_rate"] * faster, "overhead_s": 0.0}
        front_end |= {"backoff_s": 0.0}
    return Robot(
        number,
        {**preset["front_end"], **front_end},
        hears=(3 - number,),
        phy=phy,
        packet_len=preset.get("packet_len", 220),
        state=str(folder / f"state-{number}"),
    )


@pytest.mark.parametrize(
    ("radio", "messages"),
    [("sik", 10), ("lora-uart", 2), ("kiss-9600", 1), pytest.param("kiss", 1, marks=pytest.mark.slow)],
)
def test_a_preset_fits_its_radio(radio: str, messages: int, tmp_path: Path) -> None:
    """Both robots speak at once: every message arrives, and no buffer overflows."""
    ends = [RADIOS[radio](tmp_path / f"tty-{number}", number - 1) for number in (1, 2)]
    with Channel(*ends), robot(1, radio, tmp_path) as one, robot(2, radio, tmp_path) as two:
        said = [one.say(*range(messages)), two.say(*range(100, 100 + messages))]
        wait_for(lambda: two.heard == said[0], "the first robot's messages")
        wait_for(lambda: one.heard == said[1], "the second robot's messages")
    assert [end.overflowed for end in ends] == [0, 0]


@pytest.mark.parametrize("radio", [*(name for name, row in PRESETS.items() if row.front_end != "audio"), "kiss-9600"])
def test_a_radio_that_gets_more_than_it_can_send_loses_it(radio: str, tmp_path: Path) -> None:
    """What the preset avoids: stated four times too fast."""
    ends = [RADIOS[radio](tmp_path / f"tty-{number}", number - 1) for number in (1, 2)]
    with Channel(*ends), robot(1, radio, tmp_path, faster=4.0) as one:
        number = 0
        while not ends[0].overflowed:
            one.say(*range(number, number + 10))
            number += 10
            wait_for(lambda: ends[0].overflowed or one.silent, "what was said to leave")
        assert ends[0].overflowed


def test_radios_that_talk_over_each_other_lose_packets_and_the_link_repairs_them(tmp_path: Path) -> None:
    ends = [LoraUart(tmp_path / f"tty-{number}") for number in (1, 2)]
    with Channel(*ends) as air, robot(1, "lora-uart", tmp_path) as one, robot(2, "lora-uart", tmp_path) as two:
        said: list[list[bytes]] = [[], []]
        while not air.collided:
            for number, end in enumerate((one, two)):
                said[number] += end.say(len(said[number]))
            wait_for(lambda: two.heard == said[0], "the first robot's messages")
            wait_for(lambda: one.heard == said[1], "the second robot's messages")


def test_the_byte_of_signal_strength_is_read_and_no_packet(tmp_path: Path) -> None:
    ends = [LoraUart(tmp_path / f"tty-{number}") for number in (1, 2)]
    with Channel(*ends), robot(1, "lora-uart", tmp_path) as one, robot(2, "lora-uart", tmp_path, rssi=True) as two:
        said = one.say(1)
        wait_for(lambda: two.heard == said, "the message")
        assert two.link.stats()["phy"]["rssi_dbm"] == -71
        assert two.counters()["malformed"] == 0
        wait_for(lambda: one.counters()["malformed"] > 0, "a byte that is no packet, where nobody expects it")
