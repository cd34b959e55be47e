from __future__ import annotations

import json
import re
from xml.etree import ElementTree

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.middleware import Qos
from gr_ros2_lab.race.contenders import (
    ADDRESSES,
    CONTENDERS,
    CYCLONE,
    FAST,
    MTU,
    ZENOH,
    chosen,
    cyclone_uri,
    fast_profiles,
    zenoh_config,
)
from gr_ros2_lab.race.endpoints import RaceTopic
from gr_ros2_lab.race.fast import FastDds, has_fast_dds
from tests.domains import domain
from tests.waiting import wait_for


def test_contenders_are_chosen_by_name_in_the_order_of_the_table() -> None:
    assert list(chosen(["zenoh-tcp", "gr-ros2"])) == ["gr-ros2", "zenoh-tcp"]
    assert list(chosen([])) == [name for name in CONTENDERS if name not in ("gr-ros2-latest", "zenoh-multicast")]
    stock = {name for name, one in CONTENDERS.items() if "stock" in name or one.stack == "fast"}
    assert set(chosen([], "team")) ^ set(CONTENDERS) == {"gr-ros2-v0", "gr-ros2-plain", *stock}


def test_an_unknown_contender_is_named_with_those_there_are() -> None:
    with pytest.raises(ConfigError, match=r"peers = 'fastdds': no such contender; known are gr-ros2, .*zenoh-tcp"):
        chosen(["gr-ros2", "fastdds"])


def test_each_peer_races_best_effort_and_reliable() -> None:
    for stack in ("dds", "fast", "zenoh"):
        assert {one.reliable for one in CONTENDERS.values() if one.stack == stack} == {False, True}


def test_cyclone_talks_to_its_peer_only_in_messages_that_fit_an_ip_packet() -> None:
    root = ElementTree.fromstring(cyclone_uri("air0", ADDRESSES[1], CYCLONE))
    assert [peer.get("Address") for peer in root.iter("Peer")] == [ADDRESSES[1]]
    assert [item.get("name") for item in root.iter("NetworkInterface")] == ["air0"]
    for name in ("MaxMessageSize", "MaxRexmitMessageSize", "FragmentSize"):
        (size,) = (re.sub("B$", "", item.text or "") for item in root.iter(name))
        assert 1024 < int(size) <= MTU - 28


def test_cyclone_reaches_a_team_by_multicast() -> None:
    root = ElementTree.fromstring(cyclone_uri("air0", "", CYCLONE))
    assert [item.text for item in root.iter("AllowMulticast")] == ["true"]
    assert not list(root.iter("Peer"))


@pytest.mark.parametrize("transport", ["udp", "tcp", "multicast"])
def test_zenoh_takes_its_configuration(transport: str) -> None:
    zenoh = pytest.importorskip("zenoh")
    for number, later in enumerate((2, 1, 0)):
        begun, changes = zenoh_config(transport, number, 3, "air0", ZENOH)
        config = zenoh.Config.from_json5(json.dumps(begun))
        for path, value in changes.items():
            config.insert_json5(path, json.dumps(value))
        endpoints = json.loads(config.get_json("connect/endpoints"))
        assert len(endpoints) == (0 if transport == "multicast" else later)
        assert json.loads(config.get_json("transport/unicast/compression/enabled")) is True
        assert json.loads(config.get_json("transport/link/tx/batch_size")) <= MTU
        assert json.loads(config.get_json("scouting/multicast/enabled")) is False


def test_a_peer_as_it_comes_has_only_its_address() -> None:
    root = ElementTree.fromstring(cyclone_uri("air0", ADDRESSES[1], {}))
    assert not list(root.iter("MaxMessageSize"))
    assert [peer.get("PruneDelay") for peer in root.iter("Peer")] == [None]
    _, changes = zenoh_config("tcp", 0, 2, "air0", {})
    assert "transport/unicast/compression/enabled" not in changes
    profiles = ElementTree.fromstring(fast_profiles(*ADDRESSES, {}))
    assert not [item for item in profiles.iter() if item.tag.endswith(("maxMessageSize", "heartbeatPeriod"))]


@pytest.mark.skipif(not has_fast_dds(), reason="needs g++ and Fast DDS's headers")
def test_fast_dds_takes_its_profiles_and_carries_large_messages_whole() -> None:
    topic, heard = RaceTopic("/talk", "std_msgs/msg/String"), []
    payload = b"\0\1\0\0" + bytes(range(256)) * 400
    with FastDds(domain(0), fast_profiles("127.0.0.1", "127.0.0.1", FAST)) as graph:
        qos = Qos("reliable", "transient_local", 1)
        subscription = graph.subscribe(topic.name, topic.type_name, qos, heard.append)
        publisher = graph.advertise(topic.name, topic.type_name, qos)
        wait_for(lambda: publisher.matched() == subscription.matched() == 1, "a match")
        publisher.publish(payload)
        wait_for(lambda: heard == [payload], "the message")
