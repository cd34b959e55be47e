"""Links over radios that take packets: UDP, a serial line, KISS by TCP and by a real TNC."""

from __future__ import annotations

import shutil
import socket
from pathlib import Path
from typing import Any

import pytest

from gr_ros2.core.errors import ConfigError, RadioError
from gr_ros2.radio.radio import make_radio
from tests.domains import free_ports
from tests.radio.cables import Direwolves, SerialCable
from tests.radio.robots import Robot
from tests.waiting import wait_for

UDP = {"listen": "127.0.0.1:5001", "send_to": ["127.0.0.1:5002"]}
ZMQ = {"bind": "127.0.0.1:5001", "connect": ["127.0.0.1:5002"]}
FAST = {"name": "modem", "options": {"bit_rate": 1e6}}


def robot(number: int, front_end: dict[str, Any], tmp_path: Path, **values: Any) -> Robot:
    """A robot that speaks version 1."""
    own = {"phy": FAST, "state": str(tmp_path / f"state-{number}")}
    return Robot(number, front_end, hears=(3 - number,), **{**own, **values})


def talk(one: Robot, two: Robot, first: int, count: int = 5) -> None:
    """Both robots say something, and hear all that the other one says."""
    heard = [len(one.heard), len(two.heard)]
    said = [one.say(*range(first, first + count)), two.say(*range(first, first + count))]
    wait_for(lambda: two.heard[heard[1] :] == said[0], "the first robot's messages")
    wait_for(lambda: one.heard[heard[0] :] == said[1], "the second robot's messages")


def udp_ends() -> list[dict[str, Any]]:
    ports = free_ports(2)
    return [
        {"name": "udp", "listen": f"127.0.0.1:{own}", "send_to": [f"127.0.0.1:{other}"]}
        for own, other in (ports, reversed(ports))
    ]


def test_udp_with_losses(tmp_path: Path) -> None:
    ends = udp_ends()
    with (
        robot(1, ends[0], tmp_path, channel={"packet_loss": 0.2, "seed": 1}) as one,
        robot(2, ends[1], tmp_path, channel={"packet_loss": 0.2, "seed": 2}) as two,
    ):
        for link, other in ((one.link, 2), (two.link, 1)):
            wait_for(lambda: link.sink._end.knows(other), "a hello")  # noqa: B023 - called at once
        talk(one, two, 0, 20)
        assert one.link.stats()["sink"]["repaired"] + two.link.stats()["sink"]["repaired"] > 0
        assert one.counters()["frames_out"] > 0
        assert one.counters()["malformed"] == one.counters()["too_long"] == 0


def test_datagrams_that_are_no_packets_are_counted(tmp_path: Path) -> None:
    ends = udp_ends()
    host, port = ends[0]["listen"].split(":")
    with robot(1, ends[0], tmp_path) as one, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for datagram in (b"", bytes(5000), b"no packet"):
            stranger.sendto(datagram, (host, int(port)))
        wait_for(lambda: one.counters()["frames_in"] == 1, "the one that may be a packet")
        assert (one.counters()["malformed"], one.counters()["too_long"]) == (1, 1)
        wait_for(lambda: sum(one.link.stats()["sink"]["rejected"].values()) == 1, "its refusal")


@pytest.mark.parametrize("framing", ["cobs", "slip"])
def test_a_serial_line_that_is_pulled_out_and_plugged_in(framing: str, tmp_path: Path) -> None:
    with SerialCable(tmp_path) as cable:
        ends = [{"name": "serial", "device": str(end), "framing": framing, "half_duplex": False} for end in cable.ends]
        with robot(1, ends[0], tmp_path) as one, robot(2, ends[1], tmp_path) as two:
            talk(one, two, 0)
            cable.pull()
            wait_for(lambda: one.counters()["interruptions"] and two.counters()["interruptions"], "the interruption")
            cable.plug()
            talk(one, two, 10)
            assert cable.carried > 0


def test_a_device_that_takes_no_more_costs_packets_and_nobody_waits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    connect = socket.create_connection

    def with_little_room(*where: Any) -> socket.socket:
        """Linux would take megabytes before it takes no more."""
        connected = connect(*where)
        connected.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        return connected

    monkeypatch.setattr(socket, "create_connection", with_little_room)
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        end = {"name": "kiss", "device": f"tcp://127.0.0.1:{server.getsockname()[1]}"}
        phy = {"name": "modem", "options": {"bit_rate": 1e9}}
        with robot(1, end, tmp_path, phy=phy, packet_len=4095) as one:
            tnc, _ = server.accept()
            number = 0
            while not one.counters()["not_taken"]:
                one.say(*range(number, number + 100))
                number += 100
            tnc.close()
            wait_for(lambda: one.counters()["interruptions"], "the end of the connection")
            again, _ = server.accept()
            one.say(number)
            assert again.recv(1)
            again.close()


@pytest.mark.skipif(shutil.which("direwolf") is None, reason="direwolf is not installed")
def test_two_tnc_that_hear_each_other(tmp_path: Path) -> None:
    """Packets cross as 9600 baud audio, modulated and demodulated by direwolf."""
    with Direwolves(tmp_path) as tncs:
        ends = [
            {"name": "kiss", "device": f"tcp://localhost:{port}", "callsign": f"N0CALL-{number}"}
            for number, port in enumerate(tncs.kiss)
        ]
        phy = {"name": "modem", "options": {"bit_rate": 9600.0, "overhead_bytes": 19, "overhead_s": 0.12}}
        with robot(1, ends[0], tmp_path, phy=phy) as one, robot(2, ends[1], tmp_path, phy=phy) as two:
            said = one.say(1, 2, 3)
            wait_for(lambda: two.heard == said, f"the messages; {tncs.log()}")
            answers = two.say(4, 5, 6)
            wait_for(lambda: one.heard == answers, "the answers")
            assert two.counters()["foreign"] == 0
        assert "N0CALL" in tncs.log()


@pytest.mark.parametrize(
    ("front_end", "options", "said"),
    [
        ("serial", {"device": "/dev/nothing"}, "device = '/dev/nothing': .*No such file"),
        ("kiss", {"device": "ttyUSB0"}, "write a device as /dev/ttyUSB0, or tcp://HOST:PORT"),
        ("kiss", {"device": "tcp://localhost"}, "tcp://HOST:PORT"),
        ("kiss", {"device": "tcp://localhost:1"}, "Connection refused"),
        ("kiss", {"device": "tcp://localhost:1", "callsign": "me"}, "capital letters"),
        ("udp", {"listen": "192.0.2.1:5001", "send_to": ["127.0.0.1:5002"]}, "an own address"),
        ("udp", {"listen": "5001", "send_to": ["5002"]}, "write HOST:PORT"),
        ("udp", {"listen": "5001", "send_to": ["127.0.0.1:5002", "[::1]:5002"]}, "cannot be mixed"),
    ],
)
def test_a_wrong_setting_is_one_line(front_end: str, options: dict[str, Any], said: str) -> None:
    with pytest.raises((ConfigError, RadioError), match=said) as caught:
        make_radio("modem", 64, front_end=front_end, transmit=True, **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("phy", "front_end", "options", "said"),
    [
        ("psk", "udp", UDP, "set phy to {name: modem"),
        ("direct", "udp", UDP, "set phy to {name: modem"),
        ("modem", "zmq", ZMQ, "phy modem has no samples to carry"),
    ],
)
def test_samples_and_packets_do_not_go_together(phy: str, front_end: str, options: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        make_radio(phy, 64, 1e6, front_end, **options)
