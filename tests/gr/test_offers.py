"""What a robot would send if somebody asked, and how often."""

from __future__ import annotations

from collections.abc import Iterator
from threading import Event

import pytest

from gr_ros2.gr.offers import MEASURE_S, Measurements, OpenTopic, rate_of
from gr_ros2.middleware import Qos, TopicInfo
from gr_ros2.middleware.dds import DdsMiddleware
from tests.domains import free_domains
from tests.waiting import wait_for

TYPE = "std_msgs/msg/String"


@pytest.mark.parametrize(
    ("times", "rate"),
    [
        ([], 0.0),
        ([0.01, 0.01], 0.0),  # what two publishers keep for late subscribers
        ([0.2 + 0.1 * n for n in range(18)], 10.0),
        ([0.3, 1.3], 1 / 1.5),
        ([0.6, 1.6], 1.0),
        ([1.0, 1.0001], 2 / 1.5),  # two publishers, at the same time
    ],
)
def test_the_rate_of_what_comes(times: list[float], rate: float) -> None:
    assert rate_of([5 + at for at in times], 5.0) == pytest.approx(rate)
    assert all(at < MEASURE_S for at in times)


@pytest.fixture
def graphs() -> Iterator[list[DdsMiddleware]]:
    domain = free_domains(1)[0]
    graphs = [DdsMiddleware(domain_id=domain, localhost_only=True) for _ in range(3)]
    yield graphs
    for graph in graphs:
        graph.close()


@pytest.mark.slow
def test_what_publishers_keep_is_no_rate(graphs: list[DdsMiddleware]) -> None:
    latched = Qos("reliable", "transient_local", 1)
    *publishing, here = graphs
    for graph in publishing:
        graph.advertise("/tf_static", TYPE, latched).publish(b"\0\1\0\0\2\0\0\0a\0")
    wait_for(
        lambda: any(len(info.publishers) == 2 for info in here.discover() if info.topic == "/tf_static"),
        "both to be found",
    )
    offered = OpenTopic("tf_static", "/tf_static", TopicInfo("/tf_static", TYPE, (latched, latched)))
    measured = Measurements(here, lambda: 0.0, Event(), coded=False).measure([offered])["tf_static"]
    assert measured.size
    assert measured.rate == 0.0
