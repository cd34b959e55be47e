"""The table of middlewares, and joining a ROS graph by name.

Invariant: the table says of a middleware everything that the rest of the program needs to know before it is loaded; no
other module mentions a middleware by name.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal
from weakref import finalize

from gr_ros2.core.backends import Backend, BackendTable
from gr_ros2.core.errors import ConfigError
from gr_ros2.middleware.base import Middleware
from gr_ros2.settings.fields import AUTO, Auto

if TYPE_CHECKING:
    from gr_ros2.settings.robot import GraphConfig


@dataclass(frozen=True)
class GraphBackend(Backend):
    """One middleware of the table.

    :param scope: who can join its graph: ``shared``, other processes and machines; ``process``, only this process;
        ``none``, nobody: it is opened by a path instead of a domain
    :param meets: others whose participants in the same domain it may receive from; a source and a sink on such
        graphs must not carry the same topics
    :param localhost_only: whether its constructor takes ``localhost_only``
    """

    scope: Literal["shared", "process", "none"] = "shared"
    meets: tuple[str, ...] = ()
    localhost_only: bool = False


MIDDLEWARE = BackendTable(
    "middleware",
    {
        "dds": GraphBackend(
            "gr_ros2.middleware.dds",
            "DdsMiddleware",
            "embedded DDS, no ROS install",
            "Cyclone DDS 11.0, which the installation of gr-ros2 brings (not on Linux on ARM: there use rclpy)",
            title="DDS (embedded)",
            localhost_only=True,
        ),
        "rclpy": GraphBackend(
            "gr_ros2.middleware.rclpy",
            "RclpyMiddleware",
            "a sourced ROS 2 (Humble or later)",
            "a sourced ROS 2 setup",
            title="rclpy (ROS 2)",
            meets=("dds", "zenoh"),  # depending on its RMW
            localhost_only=True,
        ),
        "zenoh": GraphBackend(
            "gr_ros2.middleware.zenoh",
            "ZenohMiddleware",
            "rmw_zenoh's conventions, experimental",
            "pip install eclipse-zenoh==1.10.2",
            title="Zenoh (rmw_zenoh, experimental)",
        ),
        "bag": GraphBackend("gr_ros2.middleware.bag", "BagMiddleware", "a ROS 2 bag, MCAP or sqlite3", scope="none"),
        "memory": GraphBackend(
            "gr_ros2.middleware.memory",
            "MemoryMiddleware",
            "one process, for tests",
            title="memory (tests)",
            scope="process",
        ),
    },
    GraphBackend,
)


def join_graph(
    name: str, *, domain_id: int | Auto = AUTO, node_name: str, localhost_only: bool | Auto = AUTO
) -> Middleware:
    """A new participant on a graph; the caller closes it.

    :param name: of the table
    :param domain_id: 0..232, auto takes ROS_DOMAIN_ID
    :param node_name: its name on the graph
    :param localhost_only: whether it uses only the loopback interface, where the middleware supports that; auto takes
        the environment's setting
    :raises ConfigError: for a name that is not in the table or stands for a file; for a setting that the middleware
        refuses
    :raises BackendMissingError: when its package is not installed
    :raises MiddlewareError: when the graph cannot be joined
    """
    cls = MIDDLEWARE.load(name)
    backend = MIDDLEWARE[name]
    if backend.scope == "none":
        raise ConfigError(
            f"middleware = {name!r}: a file, which has a path and no graph to join; open it in Python and hand it "
            "over, or play it on a graph"
        )
    settings: dict[str, Any] = {"domain_id": domain_id, "node_name": node_name}
    if backend.localhost_only and localhost_only != AUTO:
        settings["localhost_only"] = localhost_only
    graph: Middleware = cls(**settings)
    return graph


def join(graph: GraphConfig, node_name: str) -> Middleware:
    """A new participant on the graph of a robot; see :func:`join_graph`."""
    return join_graph(
        graph.middleware, domain_id=graph.domain_id, node_name=node_name, localhost_only=graph.localhost_only
    )


def joined(
    owner: object, given: Middleware | None, graph: GraphConfig, node_name: str
) -> tuple[Middleware, Callable[[], object]]:
    """A participant for an owner, and what lets go of it: one that is given stays open, and one that is opened here is
    closed, with its owner at the latest.

    :param given: an open participant; None: opened on the graph
    """
    participant = given or join(graph, node_name)
    return participant, finalize(owner, participant.close if given is None else lambda: None)


def meet(one: Middleware, other: Middleware) -> bool:
    """Whether one participant can receive messages of the other."""
    if one is other:
        return True
    return one.domain_id is not None and one.domain_id == other.domain_id and bool(_networks(one) & _networks(other))


def _networks(graph: Middleware) -> set[str]:
    backend = MIDDLEWARE.get(graph.name)  # a middleware passed as an object need not be in the table
    return {graph.name, *(backend.meets if backend else ())}
