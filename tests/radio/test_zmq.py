"""Samples over ZeroMQ: two robots, one that is killed, and messages that are none of ours."""

from __future__ import annotations

import gc
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import nan
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq

from gr_ros2.core.errors import ConfigError, RadioError
from gr_ros2.phy import PHY
from gr_ros2.phy.burst_blocks import BurstSink
from gr_ros2.radio.robot_link import RobotLink
from gr_ros2.radio.zmq import HEADER, MAGIC, MAX_SENDERS, WAITING, ZmqFrontEnd, ZmqOptions
from tests.radio.robots import RATE, Robot, config
from tests.waiting import wait_for


@pytest.fixture
def ends(tmp_path: Path) -> list[dict[str, Any]]:
    """Front end settings of robots 1 and 2."""
    addresses = [f"ipc://{tmp_path}/{number}" for number in (1, 2)]
    return [{"name": "zmq", "bind": own, "connect": [other]} for own, other in (addresses, reversed(addresses))]


@contextmanager
def strange_robot(address: str) -> Iterator[Any]:
    """A socket that publishes there."""
    with zmq.Context() as context, context.socket(zmq.PUB) as publisher:
        publisher.linger = 0
        publisher.bind(address)
        yield publisher


@pytest.fixture
def stranger(ends: list[dict[str, Any]]) -> Iterator[Any]:
    """A socket at the address of robot 2."""
    with strange_robot(ends[1]["bind"]) as publisher:
        yield publisher


def hear_each_other(robots: list[Robot]) -> None:
    """Wait until each hears what the other says from now on: a subscriber needs a moment to find its publisher."""
    for robot, other in (robots, reversed(robots)):
        before = len(other.heard)

        def heard(robot: Robot = robot, other: Robot = other, before: int = before) -> bool:
            robot.say(1000)
            return len(other.heard) > before

        wait_for(heard, f"robot {other.link.config.name} to hear")


def test_both_ways_at_once_and_nobody_takes_its_own(ends: list[dict[str, Any]]) -> None:
    with Robot(1, ends[0], hears=(1, 2)) as one, Robot(2, ends[1], hears=(1, 2)) as two:
        hear_each_other([one, two])
        for robot, other in ((one, two), (two, one)):
            wait_for(lambda: one.silent and two.silent, "silence")
            said = robot.say(*range(20))
            wait_for(lambda: other.heard[-20:] == said, "every message")  # noqa: B023 - called at once
        assert one.link.sink.config.robot_id == 1
        for robot in (one, two):
            assert robot.counters()["missed"] == robot.counters()["malformed"] == robot.counters()["restarts"] == 0
            wait_for(lambda: robot.counters()["bursts_out"] == robot.link.stats()["packets"]["out"])  # noqa: B023


@pytest.mark.slow
def test_a_robot_that_comes_again_is_heard_again(ends: list[dict[str, Any]]) -> None:
    with Robot(1, ends[0], hears=(2,)) as one:
        for times in range(3):
            with Robot(2, ends[1], hears=(1,)) as two:
                hear_each_other([one, two])
                wait_for(lambda: one.counters()["restarts"] == times, "the new sender")  # noqa: B023 - called at once


def test_messages_that_are_none_of_ours_are_counted_and_dropped(
    ends: list[dict[str, Any]], stranger: Any, caplog: pytest.LogCaptureFixture
) -> None:
    def header(number: int, rate: float = RATE, magic: bytes = MAGIC) -> bytes:
        return HEADER.pack(magic, 77, number, rate, nan)

    with Robot(1, ends[0]) as robot:

        def arrives(message: bytes, name: str, count: int) -> None:
            def seen() -> bool:
                stranger.send(message)
                return robot.counters()[name] >= count

            wait_for(seen, name)

        for number, junk in enumerate((b"", b"hello", header(0, magic=b"GRI9"), header(0) + b"odd")):
            arrives(junk, "malformed", robot.counters()["malformed"] + 1)
            assert robot.counters()["bursts_in"] == 0, number
        arrives(header(0, 3e6), "wrong_rate", 1)
        for number in (np.nan, np.inf, -np.inf):
            poison = np.array([0, number], "<f4").tobytes()
            arrives(header(0) + poison, "malformed", robot.counters()["malformed"] + 1)
        assert robot.counters()["bursts_in"] == 0
        noise = np.random.default_rng(1).normal(size=100).astype("<f4").tobytes()
        arrives(header(0) + noise, "bursts_in", 1)
        missed = robot.counters()["missed"]
        arrives(header(10**6) + noise, "missed", missed + 1)
        assert robot.counters()["restarts"] == 0
        assert robot.link.stats()["packets"]["in"] == 0
    assert "a peer sends 3e+06 samples/s, not 2e+06; set the same phy at both ends" in caplog.text


def test_what_a_slow_computer_does_not_take_is_dropped_and_counted(
    ends: list[dict[str, Any]], caplog: pytest.LogCaptureFixture
) -> None:
    """No flowgraph runs, while a peer sends much more than may wait, and starts again three times. With a limit in
    libzmq itself, this aborted the process."""
    restarts, sent = 3, 0
    address = ends[1]["bind"]
    front_end = ZmqFrontEnd(PHY.load("psk")(64, RATE), bind=ends[0]["bind"], connect=[address])
    arrivals = front_end.arrivals
    try:
        for sender in range(1 + restarts):
            with strange_robot(address) as publisher:

                def dropped(publisher: Any = publisher, sender: int = sender) -> bool:
                    nonlocal sent
                    for _ in range(50):
                        samples = np.full(1000, sent, "<c8").tobytes()
                        publisher.send(HEADER.pack(MAGIC, sender, sent, RATE, nan) + samples)
                        sent += 1
                    lost = front_end.counters().lost
                    return lost["restarts"] == sender and lost["overflows"] > 1000 * (sender + 1)

                wait_for(dropped, "bursts that are dropped")
        assert front_end.counters().passed["bursts_in"] == WAITING
        numbers = [
            int(burst[0][0].real) for burst in (arrivals.take(10.0) for _ in range(WAITING)) if burst is not None
        ]
        assert len(numbers) == WAITING
        assert numbers == sorted(set(numbers))
        with strange_robot(address) as publisher:

            def heard_again() -> bool:
                publisher.send(HEADER.pack(MAGIC, 77, 0, RATE, nan) + bytes(8))
                burst = arrivals.take(0.01)
                return burst is not None and not burst[0].any()

            wait_for(heard_again, "a new burst, now that there is room")
    finally:
        front_end.close()
    assert caplog.text.count("this computer is too slow; new ones are dropped") == 1


@pytest.mark.parametrize("record", [False, True])
def test_a_channel_changes_and_the_signal_is_seen_with_streams_and_without(
    ends: list[dict[str, Any]], tmp_path: Path, record: bool
) -> None:
    """A recording needs a stream."""
    values: dict[str, Any] = {"record": str(tmp_path / "heard")} if record else {}
    with Robot(1, ends[0]) as one, RobotLink(config(2, ends[1], **values), instrumented=True) as two:
        radio = two.radio
        assert isinstance(radio._receiver, BurstSink) == record

        def seen(what: Callable[[], bool]) -> None:
            def is_so() -> bool:
                one.say(1)
                return what()

            wait_for(is_so, "what was said")

        seen(lambda: radio.samples() is not None and radio.symbols() is not None)
        assert radio.changeable
        radio.set_snr_db(30.0)
        radio.set_frequency_offset(1e-4)
        seen(lambda: radio.snr_db is not None and radio.snr_db == pytest.approx(30.0, abs=3.0))
        radio.set_packet_loss(1.0)
        seen(lambda: radio.counts().losses["packet_loss"] > 0)


def test_while_a_burst_is_taken_those_that_come_wait_and_none_beyond(ends: list[dict[str, Any]], stranger: Any) -> None:
    address = ends[1]["bind"]
    front_end = ZmqFrontEnd(PHY.load("psk")(64, RATE), bind=ends[0]["bind"], connect=[address])
    taken: list[int] = []
    goes_on = threading.Event()

    def take(samples: Any, at: float | None) -> None:
        assert at is None
        taken.append(int(samples[0].real))
        goes_on.wait()

    try:
        front_end.listen(take)
        sent = 0

        def send(count: int) -> None:
            nonlocal sent
            for _ in range(count):
                stranger.send(HEADER.pack(MAGIC, 77, sent, RATE, nan) + np.full(8, sent, "<c8").tobytes())
                sent += 1

        wait_for(lambda: send(1) or taken, "a burst that is taken")
        send(100 * WAITING)
        goes_on.set()
        wait_for(lambda: front_end.counters().lost["overflows"] and not front_end.arrivals.behind, "all bursts")
        assert len(taken) >= WAITING
        assert taken == sorted(set(taken))
        front_end.listen(None)
        before = len(taken)
        wait_for(lambda: send(1) or front_end.arrivals.behind, "a burst that waits")
        assert len(taken) == before
        front_end.listen(take)
        assert len(taken) > before
    finally:
        goes_on.set()
        front_end.close()


def test_the_sender_forgotten_is_the_one_heard_longest_ago(ends: list[dict[str, Any]]) -> None:
    with Robot(1, ends[0]) as robot:
        arrivals = robot.link.front_end.arrivals

        def bursts(*numbers: tuple[int, int]) -> int:
            for sender, number in numbers:
                arrivals.arrived(HEADER.pack(MAGIC, sender, number, RATE, nan))
            return robot.counters()["missed"]

        bursts(*((sender, 0) for sender in range(MAX_SENDERS)))
        assert bursts((0, 1), (MAX_SENDERS, 0)) == 0
        # The first is still known, the second is new again.
        assert bursts((0, 3)) == 1
        assert bursts((1, 9)) == 1


def test_an_address_needs_no_transport_and_an_own_one_no_host() -> None:
    for text, meant in (("5551", "tcp://*:5551"), (":5551", "tcp://*:5551"), ("[::1]:5551", "tcp://[::1]:5551")):
        assert ZmqOptions(bind=text, connect=("10.0.0.2:5551",)).bind == meant
    options = ZmqOptions(bind="ipc:///tmp/a", connect=("robot-2.local:5551", "tcp://10.0.0.3:1"))
    assert (options.bind, options.connect) == ("ipc:///tmp/a", ("tcp://robot-2.local:5551", "tcp://10.0.0.3:1"))


def test_an_address_that_is_taken_or_wrong_is_said_in_a_line(ends: list[dict[str, Any]]) -> None:
    with Robot(1, {**ends[0], "bind": "tcp://127.0.0.1:*"}):
        pass
    for change, said in (
        ({"bind": "tcp://192.0.2.1:5555"}, "bind = 'tcp://192.0.2.1:5555': Cannot assign.*free port"),
        ({"bind": "5555x"}, "bind = 'tcp://5555x'.*tcp://HOST:PORT"),
        ({"connect": ["udp://1.2.3.4"]}, "connect = 'udp://1.2.3.4'.*another robot's address"),
    ):
        with pytest.raises(RadioError, match=said):
            RobotLink(config(1, {**ends[0], **change}))
    for key, address in (
        ("bind", "tcp://*:99999"),
        ("bind", "tcp://127.0.0.1:0"),
        ("bind", "tcp://127.0.0.1:-5"),
        ("bind", "tcp://127.0.0.1:55x"),
        ("connect", "tcp://[::1]:65536"),
    ):
        port = address.rpartition(":")[2]
        with pytest.raises(ConfigError, match=rf"front_end zmq: {key}.* = '.*': port {port}: must be 1 to 65535"):
            RobotLink(config(1, {**ends[0], key: address if key == "bind" else [address]}))
    with socket.create_server(("127.0.0.1", 0)) as held:
        taken = f"tcp://127.0.0.1:{held.getsockname()[1]}"
        with pytest.raises(RadioError, match="Address already in use"):
            RobotLink(config(2, {**ends[0], "bind": taken}))


def test_it_needs_samples_and_addresses(ends: list[dict[str, Any]]) -> None:
    with pytest.raises(ConfigError, match="phy direct has no samples"):
        RobotLink(config(1, ends[0], phy={"name": "direct"}))
    with pytest.raises(ConfigError, match=r"bind is missing .*; front_end zmq: connect is missing"):
        RobotLink(config(1, {"name": "zmq"}))


def test_one_that_is_forgotten_lets_go_of_its_address() -> None:
    phy = PHY.load("psk")(64, RATE)
    one = ZmqFrontEnd(phy, bind="tcp://127.0.0.1:*", connect=["tcp://127.0.0.1:9"])
    one.myself = one  # found by the collector only
    context = one._context
    del one
    gc.collect()
    assert context.closed
