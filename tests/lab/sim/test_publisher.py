"""Playing the fleet in real time: schedule kept, everything published once, prompt stop, errors not lost."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import pytest

from gr_ros2.core.errors import MiddlewareError
from gr_ros2.middleware.base import Middleware, Publisher, Qos, Subscription, TopicInfo
from gr_ros2_lab.sim.fleet import Fleet
from gr_ros2_lab.sim.publisher import SimPublisher
from gr_ros2_lab.sim.sim_settings import SimSettings
from tests.waiting import PATIENCE_S, wait_for


class Recorder(Middleware):
    """A graph that only writes down what is published on it, and when."""

    name = "recorder"

    def __init__(self, refuse_after: int | None = None) -> None:
        super().__init__()
        self.qos: dict[str, Qos] = {}
        self.got: list[tuple[float, str, bytes]] = []
        self.open: set[str] = set()
        self.refuse_after = refuse_after

    def advertise(self, topic: str, type_name: str, qos: Qos) -> Publisher:  # noqa: ARG002
        self.qos[topic] = qos
        self.open.add(topic)
        return _Publisher(self, topic)

    def subscribe(self, topic: str, type_name: str, qos: Qos, callback: Callable[[bytes], None]) -> Subscription:
        raise NotImplementedError

    def discover(self) -> list[TopicInfo]:
        return []

    def close(self) -> None:
        self.open.clear()


class _Publisher(Publisher):
    def __init__(self, graph: Recorder, topic: str) -> None:
        self._graph, self._topic = graph, topic

    def publish(self, payload: bytes) -> None:
        if self._graph.refuse_after is not None and len(self._graph.got) >= self._graph.refuse_after:
            raise MiddlewareError(f"{self._topic}: closed")
        self._graph.got.append((time.monotonic(), self._topic, payload))

    def matched(self) -> int:
        return 1

    def close(self) -> None:
        self._graph.open.discard(self._topic)


@pytest.fixture
def fleet() -> Fleet:
    return Fleet(SimSettings(seed=2))


@pytest.fixture
def graph() -> Iterator[Recorder]:
    recorder = Recorder()
    yield recorder
    recorder.close()


def test_everything_goes_out_once_and_not_before_its_time(fleet: Fleet, graph: Recorder) -> None:
    play = SimPublisher(fleet, graph, 1.0, start_time=None)
    assert not play.finished
    begin = time.monotonic()
    play.start()
    assert play.wait(PATIENCE_S)
    play.close()
    expected = list(fleet.messages(1.0))
    assert [(topic, payload) for _, topic, payload in graph.got] == [(m.topic, m.payload) for m in expected]
    assert all(at >= begin + m.t for (at, _, _), m in zip(graph.got, expected, strict=True))
    assert play.published["/robot_1/odom"] == 30
    assert play.published.total() == len(expected)
    assert not graph.open


def test_qos(fleet: Fleet, graph: Recorder) -> None:
    SimPublisher(fleet, graph, 1.0)
    assert graph.qos["/robot_1/map"] == Qos("reliable", "transient_local", 100)
    assert graph.qos["/robot_2/odom"] == Qos("reliable", "volatile", 100)
    assert len(graph.qos) == 12


def test_a_graph_per_robot(fleet: Fleet, graph: Recorder) -> None:
    play = SimPublisher(fleet, {2: graph}, 0.2)
    play.start()
    assert play.wait(PATIENCE_S)
    assert graph.got
    assert all(topic.startswith("/robot_2/") for _, topic, _ in graph.got)
    assert set(play.published) <= set(graph.qos) == set(play.publishers)


def test_a_late_play_catches_up_without_losing_anything(fleet: Fleet, graph: Recorder) -> None:
    readings = iter([0.0])
    play = SimPublisher(fleet, graph, 0.5, clock=lambda: next(readings, 100.0))  # late from the first message on
    play.start()
    assert play.wait(PATIENCE_S)
    assert play.published.total() == len(list(fleet.messages(0.5)))
    assert play.worst_lag_s == 100.0


def test_stop_ends_an_endless_play(fleet: Fleet, graph: Recorder) -> None:
    play = SimPublisher(fleet, graph, float("inf"))
    play.start()
    wait_for(lambda: len(graph.got) >= 10, "ten messages")
    play.stop()
    play.stop()
    assert play.finished
    count = len(graph.got)
    assert count == play.published.total() >= 10
    assert "sim-publisher" not in {thread.name for thread in threading.enumerate()}
    assert graph.open, "publishers stay for late joiners until close"


def test_close_before_start(fleet: Fleet, graph: Recorder) -> None:
    play = SimPublisher(fleet, graph, 1.0)
    play.close()
    assert not play.finished
    assert not graph.open


def test_an_error_of_the_graph_is_raised_by_stop(fleet: Fleet) -> None:
    graph = Recorder(refuse_after=5)
    play = SimPublisher(fleet, graph, 5.0)
    play.start()
    assert play.wait(PATIENCE_S)
    with pytest.raises(MiddlewareError, match="closed"):
        play.stop()
    assert play.published.total() == 6  # it counts a message before it publishes it
