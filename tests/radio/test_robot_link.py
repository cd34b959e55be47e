"""A robot's link without a radio: what goes out comes back, events are told, nothing stays open."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from gr_ros2.cli.link import status_line
from gr_ros2.core.errors import BackendMissingError, ConfigError, RegistryError
from gr_ros2.link import Delivered
from gr_ros2.link.events import Accepted, Received, ReceiverEvent, SenderEvent, SentPacket
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.phy import PHY
from gr_ros2.radio.robot_link import RobotLink
from tests.domains import domain
from tests.radio.robots import RATE, Robot, config
from tests.waiting import wait_for

SIM = {"name": "sim"}


@pytest.mark.parametrize("phy", list(PHY))
def test_on_every_phy_what_goes_out_comes_back(phy: str) -> None:
    try:
        PHY.modules(phy)
    except BackendMissingError as error:
        pytest.skip(str(error))
    values = {"phy": {"name": phy, "sample_rate": 10e6 if phy == "lora" else RATE}, "repair": "off"}
    with Robot(1, SIM, hears=(1,), **values) as robot:
        said = robot.say(*range(10))
        wait_for(lambda: len(robot.heard) == len(said), "every message")
        assert robot.heard == said

        def through() -> bool:
            stats = robot.link.stats()
            return bool(stats["packets"]["out"] == stats["packets"]["in"] == stats["source"]["packets"])

        wait_for(through, "every packet")
        stats = robot.link.stats()
    assert stats["packets"]["backlog"] == stats["packets"]["refused"] == 0
    assert stats["phy"]["name"] == phy
    assert (stats["phy"]["snr_db"] is None) == (phy in ("direct", "modem"))
    assert stats["front_end"] == {"name": "sim", "passed": {}, "lost": {}}
    assert stats["uptime_s"] > 0


def test_the_channel_is_what_the_configuration_says() -> None:
    with Robot(1, SIM, hears=(1,), channel={"packet_loss": 1.0}) as robot:
        robot.say(0)
        wait_for(lambda: robot.link.stats()["packets"]["dropped"].get("packet_loss", 0) >= 4, "packets to be lost")
        assert robot.heard == []
    with Robot(1, SIM, hears=(1,), channel={"snr_db": -30}) as robot:
        robot.say(0)
        wait_for(lambda: robot.link.stats()["packets"]["out"] >= 4, "packets to be sent")
        assert robot.heard == []


@pytest.mark.parametrize("name", ["sim", "zmq"])
def test_a_link_that_was_stopped_keeps_no_other_process_from_its_state(name: str, tmp_path: Path) -> None:
    pytest.importorskip("zmq" if name == "zmq" else "gnuradio")
    front_end = (
        SIM if name == "sim" else {"name": "zmq", "bind": f"ipc://{tmp_path}/1", "connect": [f"ipc://{tmp_path}/2"]}
    )
    code = "import sys; from gr_ros2.state.boots import BootFile; BootFile(sys.argv[1], 1.0, 0, sealed=False)"
    command = [sys.executable, "-c", code, str(tmp_path / "state")]
    with Robot(1, front_end, state=command[-1]):
        refused = subprocess.run(command, capture_output=True, check=False)
        assert b"a link of this robot runs already" in refused.stderr
    subprocess.run(command, check=True)


@pytest.fixture
def full_disk(tmp_path: Path) -> Iterator[Path]:
    """A folder on a disk of its own on which not a byte is free."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=64k", "gr_ros2_test", str(folder)]
    try:
        made = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        pytest.skip(f"needs mount: {error}")
    if made.returncode:
        pytest.skip(f"needs the right to mount a disk: {made.stderr.strip()}")
    try:
        with suppress(OSError), (folder / "rest").open("wb", buffering=0) as rest:
            while True:
                rest.write(bytes(4096))
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def test_a_link_starts_on_a_full_disk_and_says_so(full_disk: Path, caplog: pytest.LogCaptureFixture) -> None:
    state = full_disk / "state"
    with Robot(1, SIM, hears=(1,), state=str(state)) as robot:
        said = robot.say(*range(5))
        wait_for(lambda: robot.heard == said, "every message")
        assert any(f"{state}: cannot be written (No space left on device)" in text for text in caplog.messages)
        assert not state.exists()
        (full_disk / "rest").unlink()
    with Robot(1, SIM, state=str(state)):
        assert state.exists()


def test_packets_leave_at_the_pace_of_the_air() -> None:
    with Robot(1, {"name": "sim", "guard_s": 0.01}) as robot:
        airtime = robot.link.stats()["phy"]["airtime_s"]
        assert airtime == pytest.approx(robot.link.phy.airtime() + 0.01)
        robot.say(*range(4))
        wait_for(lambda: robot.silent, "all to be sent")
        stats = robot.link.stats()
    assert stats["uptime_s"] > stats["packets"]["out"] * airtime


class Observed:
    """Notes all it is told."""

    def __init__(self) -> None:
        self.sent: list[SenderEvent] = []
        self.packets: list[bytes] = []
        self.received: list[ReceiverEvent] = []
        self.times: list[float] = []

    def sender_event(self, src_id: int, event: SenderEvent) -> None:
        assert src_id == 1
        self.sent.append(event)

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:
        self.times.append(now)
        if isinstance(event, Received):
            self.packets.append(event.data)
        else:
            self.received.append(event)


def test_an_observer_is_told_everything() -> None:
    observed = Observed()
    with Robot(1, SIM, hears=(1,), observer=observed) as robot:
        said = robot.say(5, 6)
        wait_for(lambda: len([one for one in observed.received if isinstance(one, Delivered)]) == 2, "two messages")
    assert [event.payload for event in observed.sent if isinstance(event, Accepted)] == said
    left = [event.data for event in observed.sent if isinstance(event, SentPacket)]
    assert left[: len(observed.packets)] == observed.packets, "the last ones may be on the air"
    assert [event.payload for event in observed.received if isinstance(event, Delivered)] == said
    assert observed.times == sorted(observed.times)


def test_both_blocks_take_a_middleware_that_is_handed_over() -> None:
    graph = MemoryMiddleware(domain_id=domain(1))
    link = RobotLink(config(1, SIM), middleware=graph)
    assert link.source.middleware is link.sink.middleware is graph
    link.stop()
    graph.discover()  # still open: it is not the link's
    graph.close()


def test_one_participant_serves_both_blocks_of_one_graph() -> None:
    with Robot(1, SIM) as robot:
        assert robot.link.source.middleware is robot.link.sink.middleware


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"phy": {"name": "direct"}, "channel": {"snr_db": 3}}, "channel.snr_db"),
        ({"phy": {"name": "psk", "sample_rate": 1e6, "options": {"sp": 3}}}, "unknown key sp"),
        ({"front_end": {"name": "sim", "gain": 3}}, "front_end sim: unknown key gain; known are guard_s"),
        ({"front_end": {"name": "sim", "guard_s": -1}}, "guard_s = -1"),
        ({"graph": {"middleware": "bag"}}, "middleware = 'bag'"),
        ({"publish": {"as": "/robot_{robot}"}}, "loop"),
    ],
)
def test_parts_that_do_not_fit_are_refused_and_nothing_stays_open(values: dict[str, Any], said: str) -> None:
    front_end = values.pop("front_end", SIM)
    with pytest.raises(ConfigError, match=said):
        RobotLink(config(1, front_end, **values))
    # A source left behind would still be in the way of a sink that publishes its topic.
    RobotLink(config(1, SIM)).stop()


def test_a_registry_that_is_not_there_is_named() -> None:
    with pytest.raises(RegistryError, match=r"nothing\.csv"):
        RobotLink(config(1, SIM, registry="nothing.csv"))


def test_it_stops_at_any_moment_and_leaves_no_thread() -> None:
    link = RobotLink(config(1, SIM))
    link.stop()
    for _ in range(3):
        with Robot(1, SIM, hears=(1,)) as robot:
            robot.say(*range(20))
        robot.link.stop()
    assert not [thread.name for thread in threading.enumerate() if thread.name.startswith("gr-ros2")]


def test_a_limit_of_airtime_holds_and_is_told_and_a_restart_knows_it(tmp_path: Path) -> None:
    slow = {"name": "sim", "guard_s": 0.02}
    limited: dict[str, Any] = {
        "airtime": {"duty_cycle": 0.01, "window_s": 100},
        "state": str(tmp_path / "robot.json"),
    }
    with Robot(1, slow, **limited) as robot:
        robot.say(*range(5))
        wait_for(lambda: robot.link.stats()["airtime"]["waits_s"] > 0, "the burst to be spent")
        first = robot.link.stats()
    account = first["airtime"]
    assert account["allowed_s"] == pytest.approx(1.0)
    assert 0 < account["spent_s"] < 1.0
    assert account["spent_s"] == pytest.approx(account["sent_s"])
    assert account["refused"] == {}
    assert "of 1 s allowed in 100 s" in status_line(first)
    with Robot(1, slow, **limited) as robot:
        again = robot.link.stats()["airtime"]
    assert again["spent_s"] >= account["spent_s"] * 0.99, "what was sent before counts"


def test_sending_is_switched_off_at_once_and_on_again() -> None:
    with Robot(1, SIM, hears=(1,)) as robot:
        said = robot.say(*range(3))
        wait_for(lambda: len(robot.heard) == len(said), "every message")
        robot.link.transmit(on=False)
        before = robot.link.stats()
        assert "sending is off" in status_line(before)
        robot.say(*range(3, 6))
        wait_for(lambda: robot.link.stats()["source"]["topics"], "the messages to be taken")
        assert robot.link.stats()["packets"]["out"] == before["packets"]["out"]
        robot.link.transmit(on=True)
        wait_for(lambda: len(robot.heard) > len(said), "messages after it is on again")


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"airtime": "eu86"}, "airtime: band = 'eu86': no such band; known are eu433, eu863"),
        ({"airtime": {"duty_cycle": 0}}, "airtime.duty_cycle = 0"),
        ({"airtime": {"band": "eu868", "duty_cycle": 0.1}}, "band eu868 allows 0.01 of 3600 s; leave it out"),
        ({"airtime": {"band": "us915", "max_burst_s": 0}}, "band us915 allows 0.4 s"),
        ({"airtime": "amateur"}, "a station says its callsign in clear"),
        ({"airtime": {"window_s": 60}}, "window_s = 60.0: has no effect without a share; set duty_cycle"),
        ({"airtime": {"duty_cycle": 0.1}, "packet_rate": 0}, "sends whatever airtime allows; set auto"),
        (
            {"airtime": "eu868", "front_end": {"name": "uhd", "frequency": 433.2e6}},
            r"not within the 868 to 868.6 MHz of airtime.band = 'eu868'; set another frequency or band",
        ),
    ],
)
def test_a_limit_that_cannot_be_is_refused_in_one_line_with_the_remedy(settings: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError) as raised:
        config(1, **{"front_end": SIM, **settings})
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)
