"""Links that speak version 1, live over ZeroMQ: repair, keys, and robots that know nothing of each other's topics."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("zmq", reason="needs pyzmq")

from gr_ros2.gr.health import LinkHealth
from gr_ros2.middleware import Qos
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.radio.config import load_link
from gr_ros2.state.keys import new_key_file
from tests.domains import domain
from tests.middleware.support import CUSTOM, LATCHED, message
from tests.radio.robots import QOS, Robot
from tests.waiting import wait_for

SLOW = 2e5
"""samples/s: some hundred packets a second, so that idle air costs little."""


@pytest.fixture
def ends(tmp_path: Path) -> list[dict[str, Any]]:
    """Front end settings of robots 1 and 2."""
    addresses = [f"ipc://{tmp_path}/{number}" for number in (1, 2)]
    return [{"name": "zmq", "bind": own, "connect": [other]} for own, other in (addresses, reversed(addresses))]


def robot(number: int, front_end: dict[str, Any], tmp_path: Path, **values: Any) -> Robot:
    """One that speaks version 1; the second has no registry."""
    other = 3 - number
    own: dict[str, Any] = {
        "phy": {"name": "psk", "sample_rate": SLOW},
        "state": str(tmp_path / f"state-{number}"),
        **({} if number == 1 else {"registry": "", "topics": []}),
    }
    return Robot(number, front_end, hears=(other,), **{**own, **values})


def rejected(one: Robot) -> dict[str, int]:
    found: dict[str, int] = one.link.stats()["sink"]["rejected"]
    return found


def test_a_receiver_without_a_registry_gets_every_message_though_packets_are_lost(
    ends: list[dict[str, Any]], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "gr_ros2.radio")
    with (
        robot(1, ends[0], tmp_path) as one,
        robot(2, ends[1], tmp_path, channel={"packet_loss": 0.3, "seed": 1}) as two,
    ):
        said: list[bytes] = []
        for number in range(20):
            said += one.say(number)
            wait_for(lambda: two.heard[-1:] == said[-1:], "the newest message")  # noqa: B023 - called at once
        assert two.heard == said
        assert two.link.stats()["sink"]["repaired"] > 0
        air = one.link.stats()["source"]["air"]
        assert air["repair"] > 0
        assert air["hello"] > 0
        assert two.link.stats()["source"]["air"]["report"] > 0
        wait_for(lambda: one.link.source.idle, "the last report")
    assert caplog.text.count("no key, so anybody can read") == 2


def test_topics_are_taken_from_the_graph_and_what_was_received_is_not_sent_back(
    ends: list[dict[str, Any]], tmp_path: Path
) -> None:
    """Both robots send all that they have. Types, QoS, and topics that come later are known from the graph alone."""
    words = {"topics": {"auto": None, "-*/secret/*": None, "robot_1/early": {"codec": "none"}}}
    with (
        robot(1, ends[0], tmp_path, registry="", **words, graph={"namespace": ""}) as one,
        robot(2, ends[1], tmp_path, registry="", **words, graph={"namespace": ""}) as two,
        MemoryMiddleware(domain_id=domain(1)) as near,
        MemoryMiddleware(domain_id=domain(2)) as far,
    ):
        said = message(1, 300)
        arrived: dict[str, list[bytes]] = {name: [] for name in ("kept", "early", "later", "secret/key", "_hidden")}
        for name, heard in arrived.items():
            far.subscribe(f"/rx_robot_1/robot_1/{name}", CUSTOM, Qos(None, None, 0), heard.append)
        near.advertise("/robot_1/kept", CUSTOM, LATCHED).publish(said)
        near.advertise("/rx_robot_9/chat", CUSTOM, QOS)  # from another link on this graph
        publishers = {name: near.advertise(f"/robot_1/{name}", CUSTOM, QOS) for name in arrived if name != "kept"}
        wait_for(lambda: arrived["kept"], "the message that its publisher keeps")
        assert [end.durability for end in republished(far, "/rx_robot_1/robot_1/kept")] == ["transient_local"]

        def arrives(name: str) -> bool:
            publishers[name].publish(said)
            return bool(arrived[name])

        wait_for(lambda: arrives("early"), "a topic of the graph")
        added = near.advertise("/added", CUSTOM, QOS)
        wait_for(lambda: "/added" in one.link.source.subscriptions.subscribed, "a topic that comes later")
        added.close()
        wait_for(lambda: "/added" in one.link.source.found.unmatched(), "its publisher to go")
        wait_for(lambda: "/robot_2/chat" in two.link.source.subscriptions.subscribed, "what robot 2 itself has")
        answer = two.say(5)
        wait_for(lambda: arrives("later") and republished(near, "/rx_robot_2/robot_2/chat"), "both directions")
        assert answer
        assert set(one.link.source.subscriptions.subscribed) == {
            *("/robot_1/chat", "/robot_1/kept", "/robot_1/early", "/robot_1/later", "/added")
        }
        assert set(two.link.source.subscriptions.subscribed) == {"/robot_2/chat"}
        assert not arrived["secret/key"]
        assert not arrived["_hidden"]
        names = [topic.name for topic in one.link.registry if topic.is_topic]
        assert [f"/{name}" for name in names] == list(one.link.source.subscriptions.subscribed)


def republished(graph: MemoryMiddleware, topic: str) -> list[Qos]:
    """The publishers of a topic on a graph."""
    return [offer for info in graph.discover() if info.topic == topic for offer in info.publishers]


def test_either_end_may_start_again(ends: list[dict[str, Any]], tmp_path: Path) -> None:
    with robot(1, ends[0], tmp_path) as one:
        for first in (10, 20):
            with robot(2, ends[1], tmp_path) as two:
                # It has heard this start of robot 1 before, so it takes messages from the first hello on.
                wait_for(lambda: two.link.sink._end.knows(1), "a hello")
                said = one.say(first)
                wait_for(lambda: two.heard[-1:] == said, "a message to a robot that has come")  # noqa: B023
                said = one.say(first + 1)
                wait_for(lambda: two.heard[-1:] == said, "another one")  # noqa: B023
    with robot(2, ends[1], tmp_path) as two:
        for number in (30, 40):
            with robot(1, ends[0], tmp_path) as one:
                said = one.say(number)
                wait_for(lambda: two.heard[-1:] == said, "a message of a robot that has come again")  # noqa: B023
        assert len(two.heard) == len(set(two.heard)) == 2


def test_with_a_key_only_those_who_have_it_are_heard(
    ends: list[dict[str, Any]], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    fleet, other = (str(tmp_path / name) for name in ("fleet.key", "other.key"))
    for path in (fleet, other):
        new_key_file(path)
    with robot(1, ends[0], tmp_path, key=fleet) as one:
        with robot(2, ends[1], tmp_path, key=fleet) as two:
            said = one.say(1)
            wait_for(lambda: two.heard == said, "the message")
            assert not rejected(two)
        for key, kind in ((other, "wrong_key"), ("", "no_key")):
            with robot(2, ends[1], tmp_path, key=key) as two:
                one.say(2)
                wait_for(lambda: rejected(two).get(kind, 0) > 0, kind)  # noqa: B023 - called at once
                receiver, *_ = LinkHealth(two.link.config.diagnostics, "link").judge(two.link.stats(), 0.0)
                assert any("packets refused: sealed" in problem for problem in receiver.problems)
                assert not two.heard
                wait_for(lambda: f"({kind})" in caplog.text, "a line about it")  # noqa: B023 - called at once
    with robot(1, ends[0], tmp_path) as one, robot(2, ends[1], tmp_path, key=fleet) as two:
        one.say(3)
        wait_for(lambda: rejected(two).get("not_sealed", 0) > 0, "a packet that is not sealed")
        assert not two.heard


def test_a_file_of_three_lines_is_a_link(tmp_path: Path) -> None:
    path = tmp_path / "link.yaml"
    path.write_text("robot: 1\nphy: {name: psk, sample_rate: 1e6}\nkey: fleet.key\n")
    config = load_link(path)
    assert (config.robot_id, config.namespace, list(config.topics)) == (1, "/robot_1", ["auto"])
    assert config.compression
    assert config.key == str(tmp_path / "fleet.key")
