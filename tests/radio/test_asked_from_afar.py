"""Topics, services and actions that one robot asks of another, over a live link that loses packets."""

from __future__ import annotations

import random
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("zmq", reason="needs pyzmq")

from gr_ros2.core.errors import ConfigError
from gr_ros2.gr.offers import OpenTopic
from gr_ros2.middleware import Qos
from gr_ros2.middleware.services import ServiceClient
from gr_ros2.radio.config import link_from
from gr_ros2.radio.wish_service import WANT_TYPE, messages
from tests.middleware.calling import Adder, Caller
from tests.middleware.support import CUSTOM
from tests.radio.calling_robots import Robots
from tests.radio.fibonacci import FibonacciClient, FibonacciServer
from tests.waiting import wait_for

QOS = Qos("reliable", "volatile", 0)
SCAN, ODOM = "/robot_2/scan", "/robot_2/odom"


class Talker:
    """Publishes a topic again and again."""

    def __init__(self, robots: Robots, topic: str, period_s: float = 0.02, size: int = 100) -> None:
        self._publisher = robots.graphs[1].advertise(topic, CUSTOM, QOS)
        self._period_s, self._size = period_s, size
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._ended.wait(self._period_s):
            self._publisher.publish(b"\0\1\0\0" + random.randbytes(self._size))

    def close(self) -> None:
        self._ended.set()
        self._thread.join()


@contextmanager
def talking(robots: Robots, *topics: str, **how: Any) -> Iterator[None]:
    talkers = [Talker(robots, topic, **how) for topic in topics]
    try:
        yield
    finally:
        for talker in talkers:
            talker.close()


def sent(robots: Robots, number: int = 2) -> dict[str, Any]:
    found: dict[str, Any] = robots.links[number].stats()["source"]["topics"]
    return found


def meet(robots: Robots) -> None:
    """Wait until robot 1 hears robot 2 and robot 2 has looked at its graph."""
    wait_for(lambda: robots.links[1].calls is not None and robots.links[1].calls.heard() == [2], "robot 2 to be heard")


def offered(robots: Robots, *names: str) -> None:
    found = robots.links[2].source.found
    wait_for(lambda: set(names) <= found.offers.keys(), "what is offered to be found")


def want(robots: Robots, topic: str, rate: float = 0.0, for_s: float = 600.0) -> dict[str, Any]:
    """Ask robot 2; what has become of it."""
    wishes = robots.links[1].wishes
    wishes.want(2, topic, rate, for_s)
    wait_for(lambda: wishes.wish(2, topic)["state"] != "asked", "the answer")
    return wishes.wish(2, topic)


def listed(robots: Robots) -> list[dict[str, Any]]:
    wishes = robots.links[1].wishes
    wishes.offers(2, anew=True)
    wait_for(lambda: wishes.offers(2)["age_s"] is not None, "the list")
    rows: list[dict[str, Any]] = wishes.offers(2)["rows"]
    return rows


@pytest.fixture
def robots(tmp_path: Path) -> Iterator[Robots]:
    robots = Robots(tmp_path, "", topics=["odom"], offer=["auto", "-secret"], packet_loss=0.2)
    with robots.stack:
        yield robots


@pytest.mark.slow
@pytest.mark.real_time
def test_a_topic_is_sent_while_somebody_wants_it(robots: Robots) -> None:
    heard: list[bytes] = []
    robots.graphs[0].subscribe("/rx_robot_2/scan", CUSTOM, QOS, heard.append)
    with talking(robots, SCAN, ODOM, "/robot_2/secret"):
        meet(robots)
        offered(robots, "scan")
        rows = {row["name"]: row for row in listed(robots)}
        assert rows.keys() == {"scan"}  # odom is sent anyway
        assert rows["scan"]["type_name"] == CUSTOM
        assert 10 < rows["scan"]["rate"] < 51
        assert 100 < rows["scan"]["size"] < 110
        assert not rows["scan"]["wanted"]
        assert sent(robots).keys() == {ODOM}
        told = want(robots, "/scan", rate=20.0)
        assert told["state"] == "sent", told
        assert told["words"].startswith("robot 2 sends scan at 20/s at most, for ")
        assert told["cost_Bps"] > 0
        wait_for(lambda: len(heard) > 5, "messages")
        assert sent(robots).keys() == {ODOM, SCAN}
        assert sent(robots)[SCAN]["queue"] == "latest"
        assert [row["wanted"] for row in listed(robots)] == [True]
        (held,) = robots.links[2].stats()["wishes"]["wanted"]
        assert (held["robot"], held["topic"], held["rate"]) == (1, "scan", 20.0)
        robots.links[1].wishes.give_up(2, "scan")
        wait_for(lambda: sent(robots).keys() == {ODOM}, "it to end")
        heard.clear()
        assert want(robots, "scan")["state"] == "sent"  # as often as it comes, under the same number
        wait_for(lambda: len(heard) > 5, "messages again")
        assert robots.links[2].stats()["wishes"]["counters"] == {"sent": 2}


@pytest.mark.slow
@pytest.mark.real_time
def test_a_wish_ends_by_itself(robots: Robots) -> None:
    with talking(robots, SCAN):
        meet(robots)
        offered(robots, "scan")
        assert want(robots, "scan", for_s=5.0)["state"] == "sent"
        wait_for(lambda: SCAN not in sent(robots), "it to end")
        assert robots.links[1].wishes.wish(2, "scan")["state"] == "over"


@pytest.mark.slow
@pytest.mark.real_time
def test_what_is_not_offered_is_refused_in_a_line(robots: Robots) -> None:
    with talking(robots, SCAN, ODOM, "/robot_2/secret"):
        meet(robots)
        offered(robots, "scan")
        wait_for(lambda: ODOM in sent(robots), "odom to be sent")
        assert want(robots, "odom")["words"] == "robot 2 sends odom whether somebody asks or not"
        for name in ("secret", "nothing"):
            told = want(robots, name)
            assert told["state"] == "refused"
            assert told["words"] == f"robot 2 does not offer {name}; what it offers: gr-ros2 topics 2"
        assert sent(robots).keys() == {ODOM}
    with pytest.raises(ConfigError, match="robot 3 is not heard; heard are 2"):
        robots.links[1].wishes.want(3, "scan")
    with pytest.raises(ConfigError, match="write it as gr-ros2 topics 2 does"):
        robots.links[1].wishes.want(2, "a b")
    wishes = robots.links[2].wishes  # robot 1 offers nothing, and says so
    wait_for(lambda: robots.links[2].calls is not None and robots.links[2].calls.heard() == [1], "robot 1 to be heard")
    wishes.want(1, "scan")
    wait_for(lambda: wishes.wish(1, "scan")["state"] == "refused", "the answer")


@pytest.mark.slow
@pytest.mark.real_time
def test_the_sender_stops_when_the_robot_that_asked_starts_again(robots: Robots) -> None:
    with talking(robots, SCAN):
        meet(robots)
        offered(robots, "scan")
        assert want(robots, "scan")["state"] == "sent"
        robots.restart(1)
        wait_for(lambda: SCAN not in sent(robots), "it to end")
        meet(robots)
        assert want(robots, "scan")["state"] == "sent"
        wait_for(lambda: SCAN in sent(robots), "it to begin again")


@pytest.mark.slow
@pytest.mark.real_time
def test_a_sender_that_starts_again_is_asked_again(robots: Robots) -> None:
    heard: list[bytes] = []
    robots.graphs[0].subscribe("/rx_robot_2/scan", CUSTOM, QOS, heard.append)
    with talking(robots, SCAN):
        meet(robots)
        offered(robots, "scan")
        assert want(robots, "scan")["state"] == "sent"
        wait_for(lambda: heard, "messages")
        robots.restart(2)
        heard.clear()
        wait_for(lambda: len(heard) > 3, "messages of the new start")
        assert robots.links[1].wishes.wish(2, "scan")["state"] == "sent"


@pytest.mark.slow
@pytest.mark.real_time
def test_an_air_that_is_too_full_says_what_it_would_cost(robots: Robots) -> None:
    with talking(robots, "/robot_2/large", period_s=0.02, size=20_000), talking(robots, SCAN):
        meet(robots)
        offered(robots, "large", "scan")
        told = want(robots, "large")
        assert told["state"] == "refused"
        assert told["cost_Bps"] > told["free_Bps"] > 0
        words = told["words"]
        assert words.startswith("the air is too full for large of robot 2: it takes ")
        assert "that are free; --rate " in words
        rate = float(words.rpartition("--rate ")[2].split()[0])
        assert "/robot_2/large" not in sent(robots)
        assert want(robots, "large", rate=rate / 2)["state"] == "sent"
        wait_for(lambda: sent(robots)["/robot_2/large"]["sent"] > 0, "the first message")


@pytest.mark.slow
@pytest.mark.real_time
def test_services_and_actions_are_offered_while_somebody_wants_them(tmp_path: Path) -> None:
    robots = Robots(tmp_path, "", offer=["auto"], packet_loss=0.1)
    with robots.stack:
        Adder(robots.graphs[1], "/robot_2/add")
        FibonacciServer(robots.graphs[1], "/robot_2/count")
        caller, client = (
            Caller(robots.graphs[0], "/rx_robot_2/add"),
            FibonacciClient(robots.graphs[0], "/rx_robot_2/count"),
        )
        meet(robots)
        offered(robots, "add", "count")
        assert {row["name"] for row in listed(robots)} == {"add", "count"}
        assert robots.links[2].stats()["calls"]["offered"] == []
        for again in range(2):
            assert want(robots, "add")["state"] == "sent"
            wait_for(lambda: caller.there, "the service")
            caller.call(again)
            wait_for(lambda: caller.got.get(again) == [again + 1000], "the reply")  # noqa: B023 - called at once
            assert not client.there
            robots.links[1].wishes.give_up(2, "add")
            wait_for(lambda: not caller.there, "the service to vanish")
        for _ in range(2):
            assert want(robots, "count")["state"] == "sent"
            wait_for(lambda: client.there, "the action")
            robots.links[1].wishes.give_up(2, "count")
            wait_for(lambda: not client.there, "the action to vanish")
        assert robots.links[2].stats()["calls"]["offered"] == []
        assert not sent(robots)


@pytest.mark.slow
@pytest.mark.real_time
def test_who_may_ask_and_how_often_is_up_to_the_sender(tmp_path: Path) -> None:
    offer = {"scan": {"max_rate": 5.0}, "odom": {"to": 9}}
    robots = Robots(tmp_path, "", offer=offer)
    with robots.stack, talking(robots, SCAN, ODOM):
        meet(robots)
        offered(robots, "scan", "odom")
        told = want(robots, "odom")
        assert told["words"] == "robot 2 offers odom to another robot alone"
        assert want(robots, "scan", rate=50.0)["words"].startswith("robot 2 sends scan at 5/s at most, for ")


@pytest.mark.slow
@pytest.mark.real_time
def test_a_ros_service_asks_and_gives_up(robots: Robots) -> None:
    store, replies = messages(), {}
    there: list[bool] = []

    def taken(number: int, reply: bytes) -> None:
        results = store.deserialize_cdr(reply, "gr_ros2/msg/SetParameters_Response").results
        replies[number] = [(result.successful, result.reason) for result in results]

    client: ServiceClient = robots.graphs[0].client("/gr_ros2_link_1/want", WANT_TYPE, taken, there.append)

    def ask(number: int, **values: dict[str, Any]) -> list[tuple[bool, str]]:
        client.call(number, request_of({name.replace("__", "/"): value for name, value in values.items()}))
        wait_for(lambda: number in replies, "the response")
        found: list[tuple[bool, str]] = replies[number]
        return found

    with talking(robots, SCAN):
        wait_for(lambda: there, "the service")
        meet(robots)
        offered(robots, "scan")
        (done,) = ask(1, **{"2__scan": {"type": 3, "double_value": 2.0}})
        assert done[0] and done[1].startswith("robot 2 sends scan at 2/s at most, for ")
        wait_for(lambda: SCAN in sent(robots), "it to begin")
        assert ask(2, **{"2__scan": {}}) == [(True, "scan of robot 2 is given up")]
        wait_for(lambda: SCAN not in sent(robots), "it to end")
        long = f"{'7' * 5000}__scan"
        fast = {"2__scan": {"type": 8, "double_array_value": [0.0, 30.0]}}
        wrong = ask(3, **fast, **{"scan": {}, long: {}, "7__scan": {}})
        assert [result[0] for result in wrong] == [True, False, False, False]
        for result in wrong[1:3]:
            assert "write the number of a robot and a topic of it, such as 2/scan" in result[1]
        assert wrong[3][1].startswith("robot 7 is not heard")
        client.call(4, b"\0\1\0\0\xff\xff\xff\xff junk")
        assert ask(5) == []


def request_of(values: dict[str, dict[str, Any]]) -> bytes:
    """A request to set these parameters."""
    store = messages()
    value_type, parameter = (store.types[f"rcl_interfaces/msg/{name}"] for name in ("ParameterValue", "Parameter"))
    empty: dict[str, Any] = {
        **{"type": 0, "bool_value": False, "integer_value": 0, "double_value": 0.0, "string_value": ""},
        **{"byte_array_value": np.zeros(0, np.uint8), "bool_array_value": np.zeros(0, bool)},
        **{"integer_array_value": np.zeros(0, np.int64), "string_array_value": []},
    }

    def made(value: dict[str, Any]) -> Any:
        doubles = np.array(value.get("double_array_value", []), np.float64)
        return value_type(**{**empty, **value, "double_array_value": doubles})

    request = store.types["gr_ros2/msg/SetParameters_Request"]
    parameters = [parameter(name=name, value=made(value)) for name, value in values.items()]
    return bytes(store.serialize_cdr(request(parameters=parameters), "gr_ros2/msg/SetParameters_Request"))


@pytest.mark.slow
@pytest.mark.real_time
def test_many_wishes_at_a_time_are_measured_at_once(robots: Robots, monkeypatch: pytest.MonkeyPatch) -> None:
    names = [f"scan_{number}" for number in range(6)]
    wishes, sender = robots.links[1].wishes, robots.links[2]._ros.link.wishes
    assert sender is not None
    measured: list[int] = []
    measure = sender._measurements.measure

    def counted(offers: Iterable[OpenTopic]) -> Any:
        topics = list(offers)
        if topics and not measured:  # others come while the first is looked at
            wait_for(lambda: len(sender._inbox) + len(topics) == len(names), "the wishes to arrive")
        before = len(sender._measurements._measured)
        found = measure(topics)
        measured.append(len(sender._measurements._measured) - before)
        return found

    monkeypatch.setattr(sender._measurements, "measure", counted)
    with talking(robots, *(f"/robot_2/{name}" for name in names)):
        meet(robots)
        offered(robots, *names)
        for name in names:
            wishes.want(2, name, 1.0)
        wait_for(lambda: all(wishes.wish(2, name)["state"] == "sent" for name in names), "the answers")
    assert sum(measured) == len(names)
    assert sum(map(bool, measured)) <= 2


@pytest.mark.slow
@pytest.mark.real_time
def test_whatever_others_ask_the_link_goes_on(robots: Robots) -> None:
    calls = robots.links[1].calls
    assert calls is not None
    answers: list[bytes] = []
    with talking(robots, SCAN):
        meet(robots)
        offered(robots, "scan")
        for junk in (b"", b"\7", b"\1\x7f\xc0\0\0\0\1a", b"\2\xff\xfe", b"\1" + bytes(6) + b"x" * 300, bytes(2000)):
            assert calls.ask(2, junk, answers.append, 5.0)
        for number in range(200):
            calls.ask(2, b"\2" + f"topic_{number}".encode(), answers.append, 30.0)
        assert want(robots, "scan")["state"] == "sent"
        wait_for(lambda: len(answers) == 200, "answers")
        wait_for(lambda: robots.links[2].stats()["wishes"]["counters"].get("malformed") == 6, "junk to be counted")


def test_a_link_that_goes_one_way_offers_and_asks_nothing() -> None:
    psk = {"name": "psk", "sample_rate": 1e6}
    common: dict[str, Any] = {"robot": 1, "graph": {"middleware": "memory"}, "phy": psk, "front_end": {"name": "sim"}}
    with pytest.raises(ConfigError, match=r"offer.*nobody can ask over a link that goes one way"):
        link_from({**common, "direction": "send", "offer": "auto"})
