from __future__ import annotations

import json
import re
from xml.etree import ElementTree

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2_lab.race.contenders import ADDRESSES, CONTENDERS, MTU, chosen, cyclone_uri, zenoh_config


def test_contenders_are_chosen_by_name_in_the_order_of_the_table() -> None:
    assert list(chosen(["zenoh-tcp", "gr-ros2"])) == ["gr-ros2", "zenoh-tcp"]
    assert list(chosen([])) == [name for name in CONTENDERS if name not in ("gr-ros2-latest", "zenoh-multicast")]
    assert set(chosen([], "team")) ^ set(CONTENDERS) == {"gr-ros2-v0", "gr-ros2-plain"}


def test_an_unknown_contender_is_named_with_those_there_are() -> None:
    with pytest.raises(ConfigError, match=r"peers = 'fastdds': no such contender; known are gr-ros2, .*zenoh-tcp"):
        chosen(["gr-ros2", "fastdds"])


def test_each_peer_races_best_effort_and_reliable() -> None:
    for stack in ("dds", "zenoh"):
        assert {one.reliable for one in CONTENDERS.values() if one.stack == stack} == {False, True}


def test_cyclone_talks_to_its_peer_only_in_messages_that_fit_an_ip_packet() -> None:
    root = ElementTree.fromstring(cyclone_uri("air0", ADDRESSES[1]))
    assert [peer.get("Address") for peer in root.iter("Peer")] == [ADDRESSES[1]]
    assert [item.get("name") for item in root.iter("NetworkInterface")] == ["air0"]
    for name in ("MaxMessageSize", "MaxRexmitMessageSize", "FragmentSize"):
        (size,) = (re.sub("B$", "", item.text or "") for item in root.iter(name))
        assert 1024 < int(size) <= MTU - 28


def test_cyclone_reaches_a_team_by_multicast() -> None:
    root = ElementTree.fromstring(cyclone_uri("air0"))
    assert [item.text for item in root.iter("AllowMulticast")] == ["true"]
    assert not list(root.iter("Peer"))


@pytest.mark.parametrize("transport", ["udp", "tcp", "multicast"])
def test_zenoh_takes_its_configuration(transport: str) -> None:
    zenoh = pytest.importorskip("zenoh")
    for number, later in enumerate((2, 1, 0)):
        config = zenoh.Config.from_json5(json.dumps(zenoh_config(transport, number, 3, "air0")))
        endpoints = json.loads(config.get_json("connect/endpoints"))
        assert len(endpoints) == (0 if transport == "multicast" else later)
        assert json.loads(config.get_json("transport/unicast/compression/enabled")) is True
        assert json.loads(config.get_json("transport/link/tx/batch_size")) <= MTU
        assert json.loads(config.get_json("scouting/multicast/enabled")) is False
