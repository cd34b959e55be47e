"""Types that only a node knows, asked of a server in another process."""

from __future__ import annotations

import sys
from contextlib import closing

import pytest

from gr_ros2.middleware.dds import DdsMiddleware
from gr_ros2.middleware.services import DESCRIPTION, Witness
from gr_ros2.middleware.type_descriptions import Described
from gr_ros2.middleware.type_search import TRIES, TypeSearch
from tests.middleware.describing import CUSTOM, CUSTOM_TEXT, hash_of_text, message
from tests.middleware.support import RELIABLE, Peer
from tests.waiting import wait_for

TOPIC = "/robot_1/wheels"
DIGEST = hash_of_text(CUSTOM_TEXT)


def node(domain: int, role: str, how: str) -> Peer:
    """``describing_peer.py`` in a process; see there."""
    words = [sys.executable, "-m", "tests.middleware.describing_peer", str(domain), TOPIC, role, how]
    return Peer(words, {"ROS_LOCALHOST_ONLY": "1"})


class Learner:
    """A search, and what it has learned."""

    def __init__(self, graph: DdsMiddleware) -> None:
        self.learned: list[Described] = []
        self.search = TypeSearch(
            graph, lambda: [(TOPIC, CUSTOM), ("/chatter", "std_msgs/msg/String")], self.learned.append
        )


@pytest.mark.parametrize("role", ["pub", "sub"])
def test_a_type_is_learned_from_whoever_uses_it(graph: DdsMiddleware, domain: int, role: str) -> None:
    learner = Learner(graph)
    with closing(node(domain, role, "right")) as peer, closing(learner.search):
        wait_for(lambda: learner.learned, "the description")
        (described,) = learner.learned
        assert (described.type_name, described.digest) == (CUSTOM, DIGEST)
        assert described.store().deserialize_cdr(message(3), CUSTOM).mode == 3
        (witness,) = graph.witnesses(TOPIC, CUSTOM)
        assert witness == Witness(DIGEST, (f"/wheels/{DESCRIPTION}",))
        wait_for(lambda: peer.asked, "what the node says")
        assert peer.asked == 1
    assert not graph.counters


@pytest.mark.parametrize("how", ["refuse", "other", "damaged"])
def test_a_node_that_does_not_describe_it_is_asked_a_few_times_and_not_believed(
    graph: DdsMiddleware, domain: int, how: str
) -> None:
    learner = Learner(graph)
    with closing(node(domain, "pub", how)) as peer, closing(learner.search):
        wait_for(lambda: peer.asked == TRIES, "the last request")
        with closing(Learner(graph).search):
            wait_for(lambda: peer.asked == 2 * TRIES, "the requests of another search")
        assert not learner.learned


def test_a_search_ends_at_once_while_a_node_is_silent(graph: DdsMiddleware, domain: int) -> None:
    learner = Learner(graph)
    with closing(node(domain, "pub", "silent")) as peer:
        wait_for(lambda: peer.asked, "the request")
        learner.search.close()
    assert not learner.learned and not graph.counters


def test_a_graph_that_is_closed_ends_a_search(domain: int) -> None:
    with DdsMiddleware(domain_id=domain, localhost_only=True) as graph:
        learner = Learner(graph)
        graph.subscribe(TOPIC, CUSTOM, RELIABLE, lambda _: None)
    learner.search.close()
    assert not learner.learned
