"""Two ends that do not match hear energy, damaged packets or refusals, never "nothing"; two that match say so."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from gr_ros2.cli.link import _live
from gr_ros2.cli.status import peer_table
from gr_ros2.core.errors import ConfigError
from gr_ros2.dashboard.monitor import RunMonitor
from gr_ros2.radio.config import LinkConfig, link_from
from gr_ros2.radio.findings import about, compared, differences, heard_nobody, in_words
from gr_ros2.state.keys import new_key_file
from tests.radio.cables import SerialCable
from tests.radio.robots import RATE, Robot, config
from tests.waiting import wait_for

Wrong = Callable[[Path], dict[str, Any]]


def pair(folder: Path, wrong: dict[str, Any], **values: Any) -> tuple[Robot, Robot]:
    """Two robots over ZeroMQ; ``wrong`` is what the second one has otherwise."""
    addresses = [f"ipc://{folder}/{number}" for number in (1, 2)]

    def robot(number: int, **own: Any) -> Robot:
        front_end = {"name": "zmq", "bind": addresses[number - 1], "connect": [addresses[2 - number]]}
        own = {"state": str(folder / f"state-{number}"), **values, **own}
        return Robot(number, front_end, hears=(3 - number,), **own)

    return robot(1), robot(2, **wrong)


def key(folder: Path, name: str) -> str:
    new_key_file(folder / name)
    return str(folder / name)


def test_ends_that_match_say_so_with_figures(tmp_path: Path) -> None:
    one, two = pair(tmp_path, {}, key=key(tmp_path, "fleet"), channel={"snr_db": 20})
    with one, two:
        wait_for(lambda: one.link.stats()["peers"], "a hello")
        wait_for(lambda: one.link.ping(2)["answered"] >= 3, "answers")
        told = one.link.ping(2)
        (peer,) = one.link.stats()["peers"]
        assert in_words(one.link.ping(7)).endswith(" asked, none answered; it is not heard, heard are 2")
        with pytest.raises(ConfigError, match="robot 1: asks here"):
            one.link.ping(1)
    assert differences(about(one.link.config, [one.link.phy]), told["about"]) == []
    assert abs(told["clock_s"]) < 1.0
    assert (peer["robot"], peer["sealed"], peer["silent"]) == (2, True, False)
    assert "answered" in in_words(told)
    assert "SNR" in in_words(told)


def test_another_packet_len_is_named(tmp_path: Path) -> None:
    one, two = pair(tmp_path, {"packet_len": 128}, phy={"name": "psk", "sample_rate": RATE})
    with one, two:
        wait_for(lambda: (one.link.ping(2)["about"] or {}).get("packet_len") == 128, "what the other end is")
        (line,) = differences(about(one.link.config, [one.link.phy]), one.link.ping(2)["about"])
    assert "packet_len is 128 there and 64 here" in line


def test_both_ends_say_that_packet_len_differs_without_being_asked(tmp_path: Path) -> None:
    """The longer packets come to an end whose own are a third as long."""
    psk = {"name": "psk", "sample_rate": RATE}
    one, two = pair(tmp_path, {"packet_len": 64}, packet_len=220, phy=psk)
    said: set[str] = set()
    with one, two:

        def told() -> bool:
            one.say(*range(5))
            two.say(*range(5))
            said.update(*(robot.link.findings.lines() for robot in (one, two)))
            return len([line for line in said if "packet_len is" in line and "set the same at both ends" in line]) == 2

        wait_for(told, "a line at each end", longest_s=0.25)
        assert two.link.stats()["packets"]["damaged"]


def test_frequencies_that_do_not_meet_are_named() -> None:
    def end(text: str) -> dict[str, Any]:
        return {"packet_len": 64, "phy": 1, "key": 0, "text": f"0.1.0 psk 1e+06, {text}"}

    here = end("sends at 433200000.0 Hz, receives at 434400000.0 Hz")
    assert differences(here, end("sends at 434400000 Hz, receives at 433200100.0 Hz")) == []
    assert differences(here, end("")) == []
    both = differences(here, here)
    assert both[0].startswith("the other end sends at 433200000.0 Hz, and this end receives at 434400000.0 Hz; set")
    assert both[1].startswith("this end sends at 433200000.0 Hz, and the other end receives at 434400000.0 Hz; set")


def test_files_are_compared_without_hearing_the_other_end(tmp_path: Path) -> None:
    uhd = {"name": "uhd", "frequency": 433.2e6, "frequency_rx": 434.4e6}
    here = config(1, uhd)
    swapped = {**uhd, "frequency": 434.4e6, "frequency_rx": 433.2e6}
    assert compared(here, config(2, swapped)) == []
    assert "sends at 433200000.0 Hz" in compared(here, config(2, uhd))[0]
    wrong = config(1, swapped, packet_len=80, key=key(tmp_path, "other"), phy={"name": "psk", "sample_rate": 1e6})
    found = " ".join(compared(here, wrong))
    for said in ("packet_len is 80 there", "phy has other settings", "key ", "both are robot 1"):
        assert said in found


def test_of_several_radios_those_of_one_name_are_compared() -> None:
    def robot(number: int, **rates: int) -> LinkConfig:
        radios = [
            {
                "name": name,
                "phy": {"name": "modem", "options": {"bit_rate": rate}},
                "front_end": {"name": "udp", "listen": "1"},
                **({"packet_len": 128} if name == "far away" else {}),
            }
            for name, rate in rates.items()
        ]
        values = {"radios": radios} if radios[1:] else {**radios[0], "name": "link"}
        return link_from({"robot": number, "packet_len": 96, **values})

    three = robot(1, near=1000, **{"far away": 2000}, third=3000)
    assert compared(three, robot(2, near=1000, third=3000)) == []
    assert compared(three, robot(2, third=3000, other=1000)) == []
    assert compared(three, robot(2, third=3000)) == compared(robot(2, third=3000), three) == []
    assert compared(three, robot(2, **{"far away": 2000})) == [], "with the packet_len of that radio"
    assert compared(three, robot(2, near=500, third=3000)) == [
        "phy of radio near has other settings there; set the same name, sample_rate and options at both ends"
    ]
    assert "no radio has the phy of the other end" in compared(three, robot(2, near=500))[0]
    long = replace(robot(2, near=1000, third=3000), packet_len=220)
    assert compared(three, long)[0].startswith("packet_len is 220 there and 96 here")


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (lambda folder: {"key": key(folder, "other")}, "sealed with a key that is not accepted here"),
        (lambda _: {"phy": {"name": "gfsk", "sample_rate": 2e6}}, "another phy"),
        (lambda _: {"phy": {"name": "psk", "sample_rate": 1e6}}, "another sample rate"),
        (lambda _: {"phy": {"name": "psk", "sample_rate": 2e6, "options": {"modulation": "bpsk"}}}, "another phy"),
    ],
    ids=["key", "phy", "rate", "options"],
)
def test_ends_that_do_not_match_hear_something(wrong: Wrong, said: str, tmp_path: Path) -> None:
    other = wrong(tmp_path)
    one, two = pair(tmp_path, other, **({"key": key(tmp_path, "fleet")} if "key" in other else {}))
    with one, two:

        def found() -> bool:
            return any(said in line for line in heard_nobody(one.link.stats()))

        wait_for(found, f"{said!r}")
        assert one.link.stats()["peers"] == []


def test_a_lone_end_says_nothing_is_there(tmp_path: Path) -> None:
    one, two = pair(tmp_path, {})
    two.link.stop()
    with one:
        wait_for(lambda: one.link.stats()["packets"]["out"] > 3, "some hellos")
        assert heard_nobody(one.link.stats())[0].startswith("nothing")


def test_bytes_that_are_no_packets_are_named(tmp_path: Path) -> None:
    with SerialCable(tmp_path) as cable:
        ends = [
            {"name": "serial", "device": str(end), "framing": framing}
            for end, framing in zip(cable.ends, ("cobs", "slip"), strict=True)
        ]
        phy = {"name": "modem", "options": {"bit_rate": 1e6}}
        common = {"phy": phy}
        with (
            Robot(1, ends[0], state=str(tmp_path / "1"), **common) as one,
            Robot(2, ends[1], state=str(tmp_path / "2"), **common),
        ):
            wait_for(lambda: "no packets" in " ".join(heard_nobody(one.link.stats())), "frames that are no packets")


def test_two_robots_of_one_number_are_named_in_status_log_and_on_the_dashboard(tmp_path: Path) -> None:
    """Robots 1 and 1 are out of each other's reach, and robot 2 hears both."""
    monitor = RunMonitor()
    addresses = [f"ipc://{tmp_path}/{place}" for place in range(3)]

    def robot(place: int, number: int, connect: list[str], **values: Any) -> Robot:
        front_end = {"name": "zmq", "bind": addresses[place], "connect": connect}
        return Robot(number, front_end, state=str(tmp_path / f"state-{place}"), **values)

    third = robot(2, 2, addresses[:2], observer=monitor)
    with third, robot(0, 1, addresses[2:]), robot(1, 1, addresses[2:]):
        monitor.run_started(_live(third.link))
        wait_for(lambda: any(peer["doubled"] for peer in third.link.stats()["peers"]), "both robots")
        (line,) = third.link.findings.lines()
        assert line.startswith("two robots send as robot 1")
        third.say(0)
        wait_for(lambda: line in monitor.tick().alarms, "the alarm")
        assert monitor.tick().state in ("degraded", "late")
        assert "two robots" in rendered(peer_table(third.link.stats()["peers"]))
    monitor.run_ended(None)


def rendered(table: Any) -> str:
    console = Console(width=200)
    with console.capture() as shown:
        console.print(table)
    return shown.get()
