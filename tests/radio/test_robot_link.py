"""A robot's link without a radio: what goes out comes back, events are told, nothing stays open."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

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
    with Robot(1, SIM, hears=(1,), phy={"name": phy, "sample_rate": 10e6 if phy == "lora" else RATE}) as robot:
        said = robot.say(*range(10))
        wait_for(lambda: len(robot.heard) == len(said), "every message")
        assert robot.heard == said
        stats = robot.link.stats()
    assert stats["packets"]["out"] == stats["packets"]["in"] == stats["source"]["packets"]
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
    with Robot(1, front_end, version=1, state=command[-1]):
        refused = subprocess.run(command, capture_output=True, check=False)
        assert b"a link of this robot runs already" in refused.stderr
    subprocess.run(command, check=True)


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
        wait_for(lambda: len(observed.received) == 2, "two messages")
    assert [event.payload for event in observed.sent if isinstance(event, Accepted)] == said
    assert [event.data for event in observed.sent if isinstance(event, SentPacket)] == observed.packets
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
    with Robot(1, SIM, ros_sink={"domain_id": domain(5)}) as robot:
        assert robot.link.source.middleware is not robot.link.sink.middleware


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"phy": {"name": "direct"}, "channel": {"snr_db": 3}}, "channel.snr_db"),
        ({"phy": {"name": "psk", "sample_rate": 1e6, "options": {"sp": 3}}}, "unknown key sp"),
        ({"front_end": {"name": "sim", "gain": 3}}, "front_end sim: unknown key gain; known are guard_s"),
        ({"front_end": {"name": "sim", "guard_s": -1}}, "guard_s = -1"),
        ({"ros_sink": {"middleware": "bag"}}, "middleware = 'bag'"),
        ({"ros_sink": {"namespace_format": "/robot_{src_id}"}}, "loop"),
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
