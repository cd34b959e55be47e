"""Radios without hardware: a SoapySDR device of our own that loops back, and what is said where there is no device."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from gnuradio import gr

from gr_ros2.core.errors import ConfigError, RadioError
from gr_ros2.phy.psk import PskPhy
from gr_ros2.radio.device import LEAD
from gr_ros2.radio.robot_link import RobotLink
from gr_ros2.radio.soapy import SoapyFrontEnd
from tests.compiled import compiled
from tests.radio.robots import RATE, ROOT, config, link_command

SOURCE = ROOT / "tests" / "peers" / "soapy_loopback.cpp"
HEADER = Path("/usr/include/SoapySDR/Device.hpp")
MESSAGES = 20
SLOW = 2.5e5
"""samples/s that a receiver keeps up with on a busy machine; this device gives them by the clock, come what may."""
TALK = """
import json, sys
from tests.waiting import wait_for
from gr_ros2.radio.soapy import SoapyFrontEnd
from tests.radio.robots import Robot

SoapyFrontEnd.loops_back = True
front_end, values, count, wanted, unsent, whole = map(json.loads, sys.argv[1:])
with Robot(1, front_end, hears=(1,), repair="off", **values) as robot:
    said = robot.say(*range(count))
    wait_for(lambda: robot.silent and len(robot.heard) >= wanted, "every message")
    wait_for(lambda: robot.counters()["unsent"] >= unsent, "what the device does not take")
    packets = {}
    def came():
        packets.update(robot.link.stats()["packets"])
        return not whole or packets["in"] == packets["out"]
    wait_for(came, "the last packet to come back")
    print(json.dumps({"altered": [m for m in robot.heard if m not in said], "heard": len(robot.heard),
                      "packets": packets, **robot.counters(),
                      "layout": robot.link.front_end.layout.total}, default=str))
"""
"""A robot that takes its own packets, as if they were another's, in a process where the driver can be found."""


@pytest.fixture(scope="module")
def driver(pytestconfig: pytest.Config) -> Path:
    """The folder of the driver `loopback`."""
    if not HEADER.exists() or not shutil.which("g++"):
        pytest.skip("needs g++ and SoapySDR's headers: apt install g++ libsoapysdr-dev")
    return compiled(pytestconfig, SOURCE, "libloopback.so", ("-std=c++17", "-shared", "-fPIC", "-lSoapySDR")).parent


def with_driver(driver: Path) -> dict[str, str]:
    """The environment of a process that finds it."""
    return {**os.environ, "SOAPY_SDR_PLUGIN_PATH": str(driver)}


def python(driver: Path, code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A program that finds it, run to its end."""
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], env=with_driver(driver), capture_output=True, text=True, cwd=ROOT
    )


def talk(
    driver: Path,
    front_end: dict[str, Any],
    values: dict[str, Any],
    *,
    count: int = MESSAGES,
    wanted: int = MESSAGES,
    unsent: int = 0,
    whole: bool = False,
) -> dict[str, Any]:
    """What became of messages over the loopback device, once so many came back and so many samples were not taken.

    :param whole: once every packet came back, too
    """
    done = python(driver, TALK, *map(json.dumps, (front_end, values, count, wanted, unsent, whole)))
    assert done.returncode == 0, done.stderr
    result: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return result


@pytest.mark.parametrize("phy", ["psk", "gfsk", "ofdm"])
def test_every_packet_goes_out_as_one_ended_burst_and_comes_back(driver: Path, tmp_path: Path, phy: str) -> None:
    log = tmp_path / "log"
    front_end = {
        "name": "soapy",
        "args": f"driver=loopback,log={log}",
        "frequency": 433e6,
        "frequency_rx": 434e6,
        "gain_tx": 10,
        "gain_rx": 20,
        "antenna_tx": "RIGHT",
        "bandwidth": 5e5,
        "multiple": 500,
    }
    result = talk(
        driver, front_end, {"phy": {"name": phy, "sample_rate": SLOW, "options": {"lengths": "fixed"}}}, whole=True
    )
    assert (result["heard"], result["altered"], result["clipped"]) == (MESSAGES, [], 0)
    assert result["packets"]["in"] == result["packets"]["out"] >= 4 * MESSAGES

    said = Counter(tuple(line.split()[:3]) for line in log.read_text().splitlines())
    for setting in ("tx frequency 433000000.000000", "rx frequency 434000000.000000", "tx gain 10.000000",
                    "rx gain 20.000000", "tx antenna RIGHT", f"tx rate {SLOW:f}", f"rx rate {SLOW:f}",
                    "tx bandwidth 500000.000000", "rx bandwidth 500000.000000"):  # fmt: skip
        assert said[tuple(setting.split())] == 1, setting
    assert ("rx", "antenna", "LEFT") not in said
    writes = [line.split() for line in log.read_text().splitlines() if line.startswith("tx write")]
    # Each call brings one whole burst and ends it.
    assert {(int(size), end) for _, _, size, end, _ in writes} == {(result["layout"], "end")}
    loud = [float(peak) for *_, peak in writes]
    assert len(loud) == result["packets"]["out"]
    assert min(loud) > 0 == result["unsent"]
    assert result["layout"] % 500 == 0
    assert max(loud) <= 1
    # This device tells nothing of its bursts, so nothing is known.
    assert not {"bursts_out", "underflows", "late", "corrupted"} & set(result)


def test_a_link_that_only_receives_opens_no_transmitter(driver: Path, tmp_path: Path) -> None:
    log = tmp_path / "log"
    front_end = {"name": "soapy", "args": f"driver=loopback,log={log}", "frequency": 433e6, "half_duplex": True}
    code = (
        "import json\n"
        "from tests.radio.robots import *\n"
        f"state = {str(tmp_path / 'state')!r}\n"
        f"with RobotLink(config(1, {front_end!r}, transmit=False, state=state)) as link:\n"
        "    wait_for(lambda: link.front_end._gaps.nitems_read(0), 'samples')\n"
        "    link.check()\n"
        "    print(json.dumps(link.stats()))\n"
    )
    done = python(driver, code)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout.splitlines()[-1])
    assert told["packets"]["out"] == 0
    assert not told["airtime"]["transmits"]
    lines = log.read_text().splitlines()
    assert f"rx rate {RATE:f}" in lines
    assert [line for line in lines if line.startswith("tx") and line != "tx closed"] == []


def test_what_a_device_tells_is_counted_by_name(driver: Path) -> None:
    front_end = {"name": "soapy", "args": "driver=loopback,tells=2,loses=3", "frequency": 433e6}
    result = talk(driver, front_end, {"phy": {"name": "psk", "sample_rate": SLOW, "options": {"lengths": "fixed"}}})
    sent = result["packets"]["out"]
    assert result["bursts_out"] == sent
    assert result["underflows"] == result["late"] == result["corrupted"] == sent // 2
    # Before, GNU Radio's source marked no gap.
    marks_gaps = tuple(map(int, re.findall(r"\d+", gr.version())[:3])) >= (3, 10, 5)
    assert result.get("overflows") == (3 if marks_gaps else None)


TIMED = """
import json, sys, time
from gr_ros2.phy import PHY
from gr_ros2.phy.flowgraph import Flowgraph
from gr_ros2.link.events import AirPacket
from gr_ros2.phy.pdus import packets_of, pdu_to_send
from gr_ros2.radio.radio import make_radio
from tests.gr.probe import Probe
from tests.waiting import wait_for
radio = make_radio("psk", 64, 1e6, "soapy", args=sys.argv[1], frequency=433e6, transmit=True, open=True)
probe, top = Probe(), Flowgraph("t", "t")
top.msg_connect(probe, "pdus", radio, "pdus")
top.msg_connect(radio, "pdus", probe, "pdus")
posted, late = 0, True
got = lambda: [packet for message in probe.messages for packet in packets_of(message)[0]][posted - 5 :]
with top:
    while late:  # on a busy machine they may come to the gate after their time
        asked = [time.monotonic() + 0.5 + 0.1 * number for number in range(5)]
        for number, at in enumerate(asked):
            probe.post_message(pdu_to_send(AirPacket(bytes([number]) * 64, leave_at=at)))
        posted += len(asked)
        wait_for(lambda: radio.gate.arrived == posted, "the gate to know of every packet")
        late = time.monotonic() >= asked[0]
    wait_for(lambda: len(got()) == len(asked), "every packet")
print(json.dumps([radio.front_end.timing_error_s, [packet.at - at for packet, at in zip(got(), asked)]]))
radio.close()
"""


@pytest.mark.parametrize("args", ["driver=loopback,clock=1000000", "driver=loopback"])
def test_a_device_with_a_clock_sends_at_the_time_asked_for_and_tells_when_it_received(driver: Path, args: str) -> None:
    done = python(driver, TIMED, args)
    assert done.returncode == 0, done.stderr
    stated_s, errors_s = json.loads(done.stdout.splitlines()[-1])
    clocked = "clock" in args
    assert stated_s == (0.001 if clocked else 0.01)
    if clocked:
        assert max(map(abs, errors_s)) < stated_s
    else:  # a busy machine may be late by more than a device without a clock states, but nothing is early
        assert min(errors_s) > -stated_s


def test_what_a_device_does_not_take_is_dropped_and_counted(driver: Path) -> None:
    phy = PskPhy(64, SLOW)
    front_end = {"name": "soapy", "args": "driver=loopback,refuses=3", "frequency": 433e6}
    values = {"phy": {"name": "psk", "sample_rate": SLOW, "options": {"lengths": "fixed"}}}
    result = talk(driver, front_end, values, count=1, wanted=0, unsent=phy.airtime_samples())
    assert result["unsent"] % result["layout"] == 0
    assert 0 < result["unsent"] <= (result["packets"]["out"] - 3) * result["layout"]


@pytest.mark.slow
def test_a_half_duplex_robot_hardly_hears_itself(driver: Path) -> None:
    front_end = {
        "name": "soapy",
        "args": "driver=loopback",
        "frequency": 433e6,
        "half_duplex": True,
        "turnaround_s": 0.2,
    }
    result = talk(
        driver,
        front_end,
        {"phy": {"name": "psk", "sample_rate": SLOW, "options": {"lengths": "fixed"}}},
        count=4,
        wanted=0,
    )
    assert result["packets"]["out"] >= 16
    # Exact times are tested with the blanker alone; here a busy machine may hold samples up beyond the turnaround.
    assert result["packets"]["in"] < result["packets"]["out"] / 2
    assert result["blanked"] > result["packets"]["out"] * result["layout"] / 2


CANNOT: list[tuple[dict[str, Any], str]] = [
    ({"args": "driver=loopback,rate=7e5"}, r"the device runs at 700,000 samples/s, not at 2,000,000; set phy"),
    ({"args": "driver=loopback", "antenna_tx": "UP"}, r"antenna_tx = 'UP': the device has LEFT, RIGHT"),
    ({"args": "driver=loopback", "antenna_rx": "UP"}, r"antenna_rx = 'UP': the device has LEFT, RIGHT"),
    (
        {"args": "driver=loopback,tuned=99e6"},
        r"the device is tuned to 99,000,000 Hz, not to 100,000,000; set frequency to one it has",
    ),
    (
        {"args": "driver=loopback,tuned=1e8", "frequency_rx": 1.0002e8},
        r"the device is tuned to 100,000,000 Hz, not to 100,020,000; set frequency_rx to one it has",
    ),
    ({"args": "driver=loopback", "gain_tx": 61}, r"gain_tx = 61 dB: the device has 0 to 60 dB"),
    ({"args": "driver=loopback", "gain_rx": -1}, r"gain_rx = -1 dB: the device has 0 to 60 dB"),
    (
        {"args": "driver=loopback,most=12", "gain_tx": 13},
        r"the device has a gain of 12 dB, not of 13; set gain_tx to one it has",
    ),
    (
        {"args": "driver=loopback,most=12"},
        r"the device has a gain of 12 dB, not of 30; set gain_rx to one it has",
    ),
    ({"args": "driver=loopback,breaks=rate"}, r"no such rate; is the device plugged in, and free\?"),
]
"""What is asked of the device, and the end of the line that says why not."""


def test_what_a_device_cannot_do_is_said_in_a_line(driver: Path, tmp_path: Path) -> None:
    logs = [tmp_path / f"log-{number}" for number in range(len(CANNOT))]
    front_ends = [
        {"name": "soapy", "frequency": 1e8, **change, "args": f"{change['args']},log={log}"}
        for (change, _), log in zip(CANNOT, logs, strict=True)
    ]
    code = (
        "import json\n"
        "from gr_ros2.core.errors import RadioError\n"
        "from tests.radio.robots import *\n"
        f"for front_end in {front_ends!r}:\n"
        "    try:\n"
        "        RobotLink(config(1, front_end))\n"
        "    except RadioError as error:\n"
        "        print(json.dumps(str(error)))\n"
    )
    done = python(driver, code)
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith('"')]
    for line, (_, said), log in zip(lines, CANNOT, logs, strict=True):
        assert line.startswith("front_end soapy: ")
        assert re.search(said, line)
        assert log.read_text().splitlines()[-1] == "tx closed"


def test_a_device_is_not_dead_because_the_link_was_frozen(driver: Path) -> None:
    code = (
        "from gr_ros2.radio.soapy import SoapyFrontEnd\n"
        "from gr_ros2.phy.psk import PskPhy\n"
        "one = SoapyFrontEnd(PskPhy(64, 2e6), args='driver=loopback', frequency=1e8, transmits=True)\n"
        "for now in (0.0, 0.5, 12.5, 13.0, 14.0):\n"
        "    one.check(now)\n"
        "try:\n"
        "    one.check(15.0)\n"
        "    one.check(16.0)\n"
        "except Exception as error:\n"
        "    print(error)\n"
    )
    assert "no samples for 3 s" in python(driver, code).stdout


@pytest.mark.slow
def test_a_device_that_falls_silent_is_waited_for_and_opened_again(driver: Path, tmp_path: Path) -> None:
    """Each time it is opened, it dies after 1 s. In between, the robot hears its own packets."""
    code = (
        "import json\n"
        "from tests.radio.robots import *\n"
        "front_end = {'name': 'soapy', 'args': 'driver=loopback,dies=1', 'frequency': 1e8}\n"
        f"link = RobotLink(config(1, front_end, state={str(tmp_path / 'state')!r}))\n"
        "link.start()\n"
        "def again():\n"
        "    link.check()\n"
        "    return link.stats()['front_end']['lost'].get('interruptions', 0) == 2\n"
        "wait_for(again, 'the second time that it vanishes')\n"
        "print(json.dumps(link.stats()))\n"
        "link.stop()\n"
    )
    done = python(driver, code)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout.splitlines()[-1])
    assert done.stderr.count("no samples for 3 s") == 2
    assert "front end soapy is back" in done.stderr
    assert told["sink"]["dropped"]["own"] > 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("args", "said"),
    [
        ("driver=loopback,breaks=start", "the device does not begin to send (STREAM_ERROR)"),
    ],
)
def test_a_device_that_falls_silent_ends_the_link(driver: Path, tmp_path: Path, args: str, said: str) -> None:
    front_end = {"name": "soapy", "args": args, "frequency": 1e8}
    done = link_command(tmp_path / "robot.yaml", front_end, SLOW, "--duration", "60", env=with_driver(driver))
    assert done.returncode == 1, done.stderr
    assert f"front_end soapy: args = {args!r}: {said}" in done.stderr.splitlines()[-1]


@pytest.mark.parametrize(
    ("name", "args", "hint"),
    [
        ("soapy", "driver=nothing", "SoapySDRUtil --find"),
        ("soapy", "driver=null", "SoapySDRUtil --find"),
        ("uhd", "type=b200,serial=none", "uhd_find_devices"),
        ("pluto", "ip:127.0.0.1", "iio_info -S"),
    ],
)
def test_a_device_that_is_not_there_is_named_with_a_remedy(name: str, args: str, hint: str) -> None:
    with pytest.raises(RadioError) as caught:
        RobotLink(config(1, {"name": name, "args": args, "frequency": 433e6}, phy={"name": "psk", "sample_rate": 1e6}))
    told = str(caught.value)
    assert told.startswith(f"front_end {name}: args = {args!r}: ")
    assert hint in told
    assert "\n" not in told


@pytest.mark.parametrize("name", ["soapy", "uhd", "pluto"])
@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"frequency": 0}, "frequency = 0"),
        ({"frequency": None}, "frequency"),
        ({"gain": 3}, "unknown key gain; known are .*gain_tx"),
        ({"level": 2}, "level = 2"),
        ({"multiple": 0}, "multiple = 0"),
    ],
)
def test_wrong_settings_are_found_before_the_device(name: str, change: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=f"front_end {name}: .*{said}"):
        RobotLink(config(1, {"name": name, "frequency": 433e6, **change}))


def test_a_pluto_refuses_what_it_cannot_do() -> None:
    for change, said in (({"gain_tx": 10}, "gain_tx = 10"), ({"antenna_tx": "A"}, "one port")):
        with pytest.raises((ConfigError, RadioError), match=said):
            RobotLink(config(1, {"name": "pluto", "frequency": 433e6, **change}))
    with pytest.raises(RadioError, match="100,000: a Pluto has 521,000 to 61,440,000"):
        RobotLink(config(1, {"name": "pluto", "frequency": 433e6}, phy={"name": "psk", "sample_rate": 1e5}))


def test_a_radio_has_a_channel_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    # Only the device itself stands in the way of this check, and there is none here.
    for half in ("_open_transmitter", "_open_receiver"):
        monkeypatch.setattr(SoapyFrontEnd, half, lambda _self: None)
    with pytest.raises(ConfigError, match="channel: front_end soapy has a real one"):
        RobotLink(config(1, {"name": "soapy", "frequency": 433e6}, channel={"snr_db": 3}))


def test_a_device_listens_where_it_sends_and_does_not_hear_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    for half in ("_open_transmitter", "_open_receiver"):
        monkeypatch.setattr(SoapyFrontEnd, half, lambda _self: None)
    phy = PskPhy(64, RATE)
    listening = SoapyFrontEnd(phy, frequency=433e6, half_duplex=True).busy
    assert listening is not None
    assert not listening()
    assert SoapyFrontEnd(phy, frequency=433e6).busy is None
    assert SoapyFrontEnd(phy, frequency=433e6, frequency_rx=434e6, half_duplex=True).busy is None
    with pytest.raises(ConfigError, match=r"airtime\.listen_before_send: front_end soapy measures no power where it"):
        RobotLink(config(1, {"name": "soapy", "frequency": 433e6}, airtime={"listen_before_send": True}))
    with pytest.raises(ConfigError, match="medium = 'slots' has times of its own; leave it out"):
        config(1, {"name": "udp"}, medium="slots", airtime={"listen_before_send": True})


def test_airtime_counts_padding_guard_and_turnaround(monkeypatch: pytest.MonkeyPatch) -> None:
    for half in ("_open_transmitter", "_open_receiver"):
        monkeypatch.setattr(SoapyFrontEnd, half, lambda _self: None)
    phy = PskPhy(64, RATE)
    common = {"frequency": 433e6, "tail": 20, "multiple": 1000, "guard_s": 0.003}
    full = SoapyFrontEnd(phy, **common)
    padded = -(-(phy.airtime_samples() + LEAD + 20) // 1000) * 1000
    assert full.airtime() == pytest.approx(padded / RATE + 0.003)
    # A packet comes before the one before it is over, but not in the silence that is to follow that.
    assert full.ahead() == 0
    unguarded = SoapyFrontEnd(phy, **{**common, "guard_s": 0.0})
    assert unguarded.ahead() > 0
    assert unguarded.airtime() == pytest.approx(padded / RATE)
    half_duplex = SoapyFrontEnd(phy, half_duplex=True, turnaround_s=0.01, **common)
    assert half_duplex.ahead() == 0
    assert half_duplex.airtime() == pytest.approx(full.airtime() + 0.01)
    short = -(-(phy.airtime_samples(14) + 30) // 1000) * 1000
    assert full.airtime(14) == pytest.approx(short / RATE + 0.003)
    assert short < padded
