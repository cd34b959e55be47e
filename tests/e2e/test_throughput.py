"""`gr-ros2 throughput` between links in processes of their own: what is said, and what topics and limits feel of it."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.domains import free_ports
from tests.e2e.links import LinkProcess, Links
from tests.waiting import wait_for

PEER = (sys.executable, "-m", "tests.e2e.clock_peer")
BIT_RATE = 200_000
FAR = 50_000
TOPICS = {"topics": {"place": {}}}


def started(links: Links, *numbers: int) -> list[LinkProcess]:
    """Links whose robots publish their place ten times a second, and hear those of each other."""
    running = [links.start(number, str(number), "0", command=PEER) for number in numbers]
    links.meet()
    for link in running:
        wait_for(lambda: any(line.startswith("got") for line in link.said), "topics to cross")  # noqa: B023
    return running


def measured(link: LinkProcess, *words: str) -> Any:
    status, said = link.ask("throughput", *words, "--json")
    assert status == 0, said
    return json.loads(said)


@pytest.mark.slow
def test_a_link_is_filled_each_way_and_its_topics_go_first(tmp_path: Path) -> None:
    with Links(tmp_path, TOPICS, TOPICS, bit_rate=BIT_RATE) as links:
        one, two = started(links, 1, 2)
        told = measured(one, "2", "--for", "3")
        assert (told["robot"], told["state"]) == (2, "done")
        for way in (told["there"], told["back"]):
            assert 0 < way["Bps"] < BIT_RATE / 8, "no more than the modem carries"
            assert way["messages"] > 10
            assert way["lost"] < 0.5
            assert way["topics_per_s"] > 0, "the topics go on"
            assert None not in (way["age_s"], way["worst_age_s"], way["quiet_age_s"])
        again = measured(two, "1", "--for", "1")
        assert again["there"]["messages"] > 0, "the other end may ask too"
        names = [name for link in (one, two) for name in link.status()["sink"]["topics"]]
        assert names == ["/rx_robot_2/place", "/rx_robot_1/place"], "what is sent for it is no topic"
        assert one.status()["sink"]["publish_failed"] == 0


def test_a_robot_without_topics_measures_too(tmp_path: Path) -> None:
    with Links(tmp_path, {"topics": []}, TOPICS, bit_rate=BIT_RATE) as links:
        one, two = (links.start(number, str(number), "0", command=PEER) for number in (1, 2))
        links.meet()
        for link, other in ((one, "2"), (two, "1")):
            told = measured(link, other, "--for", "1")
            assert told["state"] == "done"
            assert told["there"]["messages"] > 0
            assert told["back"]["messages"] > 0


@pytest.mark.slow
def test_no_more_leaves_than_the_airtime_limit_allows(tmp_path: Path) -> None:
    limited = {**TOPICS, "airtime": {"duty_cycle": 0.1, "window_s": 10}}
    with Links(tmp_path, limited, limited, bit_rate=BIT_RATE) as links:
        one, two = started(links, 1, 2)
        told = measured(one, "2", "--for", "5")
        for link, way in ((one, told["there"]), (two, told["back"])):
            assert way["Bps"] < 0.1 * BIT_RATE / 8
            account = link.status()["airtime"]
            assert account["spent_s"] <= account["allowed_s"]
        assert told["there"]["messages"] > 0


@pytest.mark.slow
def test_each_radio_is_measured_also_in_slots_and_within_its_own_limit(tmp_path: Path) -> None:
    near, far = free_ports(2), free_ports(2)

    def radio(ports: list[int], number: int, bit_rate: int, **more: Any) -> dict[str, Any]:
        front_end = {
            "name": "udp",
            "listen": f"127.0.0.1:{ports[number]}",
            "send_to": [f"127.0.0.1:{ports[1 - number]}"],
        }
        return {"phy": {"name": "modem", "options": {"bit_rate": bit_rate}}, "front_end": front_end, **more}

    limited = {"duty_cycle": 0.3, "window_s": 10}
    robots = [
        {
            **TOPICS,
            "radios": [
                radio(near, number, BIT_RATE, name="near"),
                radio(far, number, FAR, name="far", medium="slots", airtime=limited),
            ],
        }
        for number in (0, 1)
    ]
    with Links(tmp_path, *robots) as links:
        one, two = started(links, 1, 2)
        wait_for(lambda: [x.status()["radios"]["far"]["bound"]["heard"] for x in (one, two)] == [[2], [1]], "slots")
        told = measured(one, "2", "--for", "5")
        assert told["state"] == "done"
        alone = told["radios"]["far"]
        for way in ("there", "back"):
            assert 0 < alone[way]["Bps"] < 0.3 * FAR / 8
            assert FAR / 8 < told[way]["Bps"] < BIT_RATE / 8
        for link in (one, two):
            account = link.status()["radios"]["far"]["airtime"]
            assert account["spent_s"] <= account["allowed_s"]
        assert "from robot 2 over far" in one.ask("throughput", "2", "--for", "1")[1]


@pytest.mark.slow
def test_who_does_not_answer_is_named(tmp_path: Path) -> None:
    with Links(tmp_path, TOPICS, TOPICS) as links:
        one, two = started(links, 1, 2)
        status, said = one.ask("throughput", "7")
        assert (status, "robot 7 is not heard" in said) == (1, True)
        assert one.ask("throughput", "2", "--for", "99")[0] == 2
        two.close()
        status, said = one.ask("throughput", "2", "--for", "1")
        assert (status, "robot 2 is not heard" in said) == (1, True)
