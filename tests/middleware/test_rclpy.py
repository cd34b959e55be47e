"""What is specific to the rclpy back-end, on a real ROS 2; the contract suite has what all back-ends share."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: source a ROS 2 setup (Humble or later) to run these tests")

import rclpy
import rclpy.context
import rclpy.executors
import rclpy.node
from rclpy.serialization import serialize_message
from std_msgs.msg import Header, String

from gr_ros2.core.errors import ConfigError, MiddlewareError
from gr_ros2.middleware.base import Qos
from gr_ros2.middleware.rclpy import RclpyMiddleware, message_class
from gr_ros2.middleware.services import Witness
from gr_ros2.middleware.type_definitions import type_hash
from gr_ros2.middleware.type_descriptions import Described
from gr_ros2.middleware.type_search import TypeSearch
from gr_ros2.settings.fields import Auto
from tests.domains import domain
from tests.waiting import PATIENCE_S, wait_for

STRING = "std_msgs/msg/String"
DOMAIN, ELSEWHERE = domain(4), domain(5)
RELIABLE = Qos("reliable", "volatile")
BEST_EFFORT = Qos("best_effort", "volatile")
LATCHED = Qos("reliable", "transient_local")

Start = Callable[..., RclpyMiddleware]


def text(message: str) -> bytes:
    return bytes(serialize_message(String(data=message)))


def unpadded(payload: bytes) -> bytes:
    return payload.rstrip(b"\0")


@pytest.fixture(autouse=True)
def loopback_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")


@pytest.fixture
def start() -> Iterator[Start]:
    with ExitStack() as stack:
        yield lambda **options: stack.enter_context(RclpyMiddleware(**{"domain_id": DOMAIN, **options}))


@pytest.fixture
def host() -> Iterator[rclpy.node.Node]:
    """A node of some other program on the same graph."""
    context = rclpy.context.Context()
    context.init(args=[], domain_id=DOMAIN)
    node = rclpy.node.Node("host", context=context)
    yield node
    node.destroy_node()
    context.try_shutdown()


def test_raw_messages_pass_unread_between_two_nodes(start: Start) -> None:
    one, two = start(node_name="one"), start(node_name="two")
    received: list[bytes] = []
    subscription = two.subscribe("/chatter", STRING, Qos(depth=100), received.append)
    publisher = one.advertise("/chatter", STRING, Qos(depth=100))
    wait_for(lambda: publisher.matched() and subscription.matched(), "for a match")
    sent = [text(f"message {i}") for i in range(50)]
    for payload in sent:
        publisher.publish(payload)
    wait_for(lambda: len(received) == len(sent))
    assert [unpadded(payload) for payload in received] == [unpadded(payload) for payload in sent]
    assert not one.counters
    assert not two.counters


def test_adaptive_subscription_takes_what_a_latched_publisher_has_sent_before(start: Start) -> None:
    publisher = start(node_name="one").advertise("/map", STRING, LATCHED)
    publisher.publish(text("the map"))
    two = start(node_name="two")
    received: list[bytes] = []
    two.subscribe("/map", STRING, Qos(), received.append)
    wait_for(lambda: received, "for the latched message")
    assert unpadded(received[0]) == unpadded(text("the map"))
    assert not two.counters


def test_adaptive_subscription_yields_to_a_later_lesser_publisher(start: Start) -> None:
    one, two = start(node_name="one"), start(node_name="two")
    received: list[bytes] = []
    two.subscribe("/scan", STRING, Qos(), received.append)
    good = one.advertise("/scan", STRING, RELIABLE)
    wait_for(good.matched, "for the reliable publisher")
    good.publish(text("good"))
    wait_for(lambda: unpadded(text("good")) in map(unpadded, received))
    lesser = one.advertise("/scan", STRING, BEST_EFFORT)
    wait_for(lesser.matched, "for the best-effort publisher")
    wait_for(good.matched, "for the reliable publisher again")
    for word, publisher in (("lesser", lesser), ("good again", good)):
        wanted = unpadded(text(word))

        def arrived(publisher: Any = publisher, word: str = word, wanted: bytes = wanted) -> bool:
            publisher.publish(text(word))
            return wanted in [unpadded(payload) for payload in received]

        wait_for(arrived, f"for {word}")
    assert not [key for key in two.counters if key.startswith("incompatible")]


def test_joining_anew_brings_the_past_of_new_publishers_only(start: Start) -> None:
    """A volatile publisher makes the subscription volatile for a while; then one more latched publisher comes."""
    one, two = start(node_name="one"), start(node_name="two")
    received: list[bytes] = []
    two.subscribe("/map", STRING, Qos(), received.append)
    expected = [unpadded(text(word)) for word in ("first", "second", "passing", "another's", "third")]

    def heard(number: int) -> bool:
        return [unpadded(payload) for payload in received][: number + 1] == expected[:number]

    map_1 = one.advertise("/map", STRING, LATCHED)
    map_1.publish(text("first"))
    map_1.publish(text("second"))
    wait_for(lambda: heard(2), "for the past")
    passing = one.advertise("/map", STRING, RELIABLE)
    wait_for(passing.matched, "for the volatile publisher")
    wait_for(map_1.matched, "for the latched publisher again")
    passing.publish(text("passing"))
    wait_for(lambda: heard(3), "for a volatile message")
    passing.close()
    wait_for(lambda: len(two.publishers_of("/map", STRING)) == 1, "for its departure")
    map_2 = one.advertise("/map", STRING, LATCHED)
    map_2.publish(text("another's"))
    wait_for(lambda: heard(4), "for the past of the new publisher alone")
    wait_for(map_1.matched, "for the first publisher once more")
    map_1.publish(text("third"))
    wait_for(lambda: heard(5), "for the newest")


def test_adaptive_subscription_appears_with_its_publisher(start: Start, host: rclpy.node.Node) -> None:
    one = start(node_name="one")
    subscription = one.subscribe("/later", STRING, Qos(), print)
    assert subscription.matched() == 0
    host.create_publisher(String, "/later", 10)
    wait_for(lambda: subscription.matched() == 1)
    wait_for(lambda: [info.node_name for info in host.get_subscriptions_info_by_topic("/later")] == ["one"])
    infos = host.get_subscriptions_info_by_topic("/later")
    assert infos[0].qos_profile.reliability == rclpy.qos.ReliabilityPolicy.RELIABLE


def test_incompatible_qos_is_counted_at_both_ends(start: Start) -> None:
    one, two = start(node_name="one"), start(node_name="two")
    subscription = two.subscribe("/scan", STRING, RELIABLE, print)
    publisher = one.advertise("/scan", STRING, BEST_EFFORT)
    wait_for(lambda: one.counters["incompatible_qos:/scan:reliability"], "for the publisher's count")
    wait_for(lambda: two.counters["incompatible_qos:/scan:reliability"], "for the subscription's count")
    assert publisher.matched() == 0
    assert subscription.matched() == 0


def test_publisher_of_another_type_is_counted(start: Start, host: rclpy.node.Node) -> None:
    one = start()
    host.create_publisher(Header, "/chatter", 10)
    one.subscribe("/chatter", STRING, RELIABLE, print)
    wait_for(lambda: one.counters["incompatible_type:/chatter"])


def test_failing_callback_is_counted_and_the_next_message_comes(start: Start, caplog: Any) -> None:
    one = start()
    received: list[bytes] = []

    def fail(payload: bytes) -> None:
        received.append(payload)
        raise ZeroDivisionError("of the test")

    one.subscribe("/chatter", STRING, RELIABLE, fail)
    publisher = one.advertise("/chatter", STRING, RELIABLE)
    wait_for(publisher.matched)
    for _ in range(3):
        publisher.publish(text("x"))
    wait_for(lambda: one.counters["callback_failed:/chatter"] == 3)
    assert len(received) == 3
    assert len([record for record in caplog.records if "callback of /chatter failed" in record.message]) == 1


def test_empty_message_of_a_peer_costs_nothing_but_itself(start: Start, host: rclpy.node.Node) -> None:
    one = start()
    received: list[bytes] = []
    subscription = one.subscribe("/chatter", STRING, RELIABLE, received.append)
    publisher = host.create_publisher(String, "/chatter", 10)
    wait_for(lambda: publisher.get_subscription_count() and subscription.matched())
    publisher.publish(b"")  # rclpy raises while it takes it, and by itself would never take again

    def arrived() -> bool:
        publisher.publish(text("next"))
        return bool(received)

    wait_for(arrived, "for the message after it")
    with pytest.raises(MiddlewareError, match="0 bytes are not a serialized message"):
        one.advertise("/chatter", STRING, RELIABLE).publish(b"")


def test_unbounded_depth_loses_nothing(start: Start) -> None:
    one, two = start(node_name="one"), start(node_name="two")
    everything = Qos("reliable", "volatile", depth=0)
    release = threading.Event()
    received: list[bytes] = []

    def take(payload: bytes) -> None:
        release.wait(PATIENCE_S)
        received.append(payload)

    two.subscribe("/chatter", STRING, everything, take)
    publisher = one.advertise("/chatter", STRING, everything)
    wait_for(publisher.matched)
    for i in range(200):
        publisher.publish(text(f"message {i}"))
    release.set()
    wait_for(lambda: len(received) == 200)


def test_what_the_rmw_says_it_lost_is_counted(start: Start) -> None:
    """The event as rclpy gives it: a loss cannot be had at will."""
    here = start()
    subscription = here.subscribe("/x", STRING, RELIABLE, print)
    subscription._on_lost(SimpleNamespace(total_count=3, total_count_change=3))
    subscription._on_lost(SimpleNamespace(total_count=5, total_count_change=2))
    assert subscription.lost == here.counters["samples_lost:/x"] == 5


def test_type_that_cannot_be_imported_names_type_and_remedy(start: Start) -> None:
    one = start()
    for use in (lambda: one.subscribe("/x", "no_such_msgs/msg/Nothing", Qos(), print),
                lambda: one.advertise("/x", "std_msgs/msg/Nothing", Qos())):  # fmt: skip
        with pytest.raises(ConfigError, match=r"_msgs/msg/Nothing cannot be imported .* source the workspace"):
            use()
    with pytest.raises(ConfigError, match="malformed type"):
        message_class("String")
    assert message_class("std_msgs/String") is String


def test_names_and_domains_that_ros_refuses(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="domain_id = '233'"):
        RclpyMiddleware(domain_id=233)
    monkeypatch.setenv("ROS_DOMAIN_ID", "many")
    with pytest.raises(ConfigError, match="ROS_DOMAIN_ID = 'many'"):
        RclpyMiddleware()
    with pytest.raises(ConfigError, match="node_name 'no-name'"):
        RclpyMiddleware(domain_id=DOMAIN, node_name="no-name")


def test_topic_name_that_ros_refuses(start: Start) -> None:
    with pytest.raises(ConfigError, match="topic '/a b'"):
        start().advertise("/a b", STRING, Qos())
    with pytest.raises(ConfigError, match="topic '/a b'"):
        start().subscribe("/a b", STRING, RELIABLE, print)


def test_host_application_keeps_its_signals_and_context(start: Start) -> None:
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    installed = rclpy.signals.get_current_signal_handlers_options()
    start()
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before
    assert rclpy.signals.get_current_signal_handlers_options() == installed
    assert not rclpy.ok(), "the default context belongs to the host"


def test_node_is_listed_on_its_domain_only(start: Start, host: rclpy.node.Node) -> None:
    start(node_name="here", namespace="/robot_1")
    start(node_name="elsewhere", domain_id=ELSEWHERE)
    wait_for(lambda: ("here", "/robot_1") in host.get_node_names_and_namespaces())
    assert "elsewhere" not in host.get_node_names()


def test_domain_from_the_environment(start: Start, host: rclpy.node.Node, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(DOMAIN))
    start(node_name="by_environment", domain_id="auto")
    wait_for(lambda: "by_environment" in host.get_node_names())


def test_discovery_tells_a_namesake_from_ourselves(start: Start) -> None:
    one, namesake = start(), start()
    one.advertise("/mine", STRING, RELIABLE)
    one.advertise("/shared", STRING, RELIABLE)
    namesake.advertise("/shared", STRING, RELIABLE)
    namesake.subscribe("/theirs", STRING, BEST_EFFORT, print)
    wait_for(lambda: {"/shared", "/theirs"} <= {info.topic for info in one.discover()})
    wait_for(lambda: {"/mine", "/shared"} <= {info.topic for info in namesake.discover()})
    found = {info.topic: info for info in one.discover()}
    assert "/mine" not in found
    assert found["/shared"].type_name == STRING
    assert [(offer.reliability, offer.durability) for offer in found["/shared"].publishers] == [
        ("reliable", "volatile")
    ]
    assert [request.reliability for request in found["/theirs"].subscribers] == ["best_effort"]
    assert list(found) == sorted(found)


def test_closed_endpoints_are_silent_and_leave_the_graph(start: Start, host: rclpy.node.Node) -> None:
    one = start()
    received: list[bytes] = []
    subscription = one.subscribe("/chatter", STRING, RELIABLE, received.append)
    publisher = one.advertise("/chatter", STRING, RELIABLE)
    wait_for(publisher.matched)
    wait_for(lambda: host.count_subscribers("/chatter") == 1)
    subscription.close()
    subscription.close()
    publisher.publish(text("to nobody"))
    wait_for(lambda: host.count_subscribers("/chatter") == 0)
    publisher.close()
    publisher.close()
    wait_for(lambda: host.count_publishers("/chatter") == 0)
    with pytest.raises(MiddlewareError, match="/chatter"):
        publisher.publish(text("closed"))
    assert received == []
    assert subscription.matched() == publisher.matched() == 0


@pytest.mark.parametrize("what", ["subscription", "middleware"])
def test_close_from_inside_a_callback(start: Start, what: str) -> None:
    one = start()
    received: list[bytes] = []

    def take(payload: bytes) -> None:
        received.append(payload)
        (subscription if what == "subscription" else one).close()

    subscription = one.subscribe("/chatter", STRING, RELIABLE, take)
    sender = start(node_name="sender")
    publisher = sender.advertise("/chatter", STRING, RELIABLE)
    wait_for(publisher.matched)
    for _ in range(5):
        publisher.publish(text("x"))
    wait_for(lambda: received and not publisher.matched())
    assert len(received) == 1
    assert not one.counters


def test_after_close_everything_says_so(start: Start) -> None:
    one = start()
    publisher = one.advertise("/chatter", STRING, RELIABLE)
    subscription = one.subscribe("/chatter", STRING, RELIABLE, print)
    one.close()
    one.close()
    assert not [thread for thread in threading.enumerate() if thread.name == "gr_ros2-rclpy"]
    for use in (
        lambda: publisher.publish(text("x")),
        one.discover,
        lambda: one.advertise("/y", STRING, Qos()),
        lambda: one.subscribe("/y", STRING, Qos(), print),
    ):
        with pytest.raises(MiddlewareError):
            use()
    publisher.close()
    subscription.close()
    assert publisher.matched() == subscription.matched() == 0


def test_context_shut_down_from_outside_ends_in_errors_not_in_a_hang(start: Start) -> None:
    one = start()
    subscription = one.subscribe("/chatter", STRING, RELIABLE, print)
    publisher = one.advertise("/chatter", STRING, RELIABLE)
    one._context.shutdown()  # as rclpy's handler of SIGINT in a host does to every context
    one._executor.thread.join(PATIENCE_S)
    assert not one._executor.thread.is_alive()
    with pytest.raises(MiddlewareError, match="the middleware is closed"):
        one.advertise("/chatter", STRING, RELIABLE)
    with pytest.raises(MiddlewareError, match="the middleware is closed"):
        publisher.publish(text("x"))
    subscription.close()
    one.close()


def test_close_does_not_wait_for_a_callback_that_never_returns(start: Start) -> None:
    one = start()
    entered, release = threading.Event(), threading.Event()

    def hang(_: bytes) -> None:
        entered.set()
        release.wait(PATIENCE_S)

    subscription = one.subscribe("/chatter", STRING, RELIABLE, hang)
    publisher = one.advertise("/chatter", STRING, RELIABLE)
    wait_for(publisher.matched)
    publisher.publish(text("x"))
    publisher.publish(text("y"))
    assert entered.wait(PATIENCE_S)
    subscription.close()
    one.close()
    assert not release.is_set()
    entered.clear()
    release.set()
    one._executor.thread.join(PATIENCE_S)
    assert not one._executor.thread.is_alive()
    assert not entered.is_set(), "a callback began after close"


def test_a_process_that_forgets_to_close_ends_cleanly() -> None:
    program = f"""
from gr_ros2.middleware import MIDDLEWARE, Qos
middleware = MIDDLEWARE.load("rclpy")(domain_id={DOMAIN})
middleware.subscribe("/chatter", "{STRING}", Qos(), print)
middleware.advertise("/chatter", "{STRING}", Qos()).publish(b"\\0\\1\\0\\0\\1\\0\\0\\0\\0")
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("localhost_only", [True, False, "auto"])
def test_localhost_only_is_what_a_context_begins_with_and_nobody_else(
    start: Start, monkeypatch: pytest.MonkeyPatch, localhost_only: bool | Auto
) -> None:
    found: list[str] = []
    begin = rclpy.context.Context.init

    def init(context: rclpy.context.Context, *args: Any, **options: Any) -> None:
        found.append(os.environ["ROS_LOCALHOST_ONLY"])
        begin(context, *args, **options)

    monkeypatch.setattr(rclpy.context.Context, "init", init)
    start(localhost_only=localhost_only)
    assert found == ["0" if localhost_only is False else "1"]
    assert os.environ["ROS_LOCALHOST_ONLY"] == "1"


def test_a_service_is_called_from_another_node_and_replies_later(start: Start) -> None:
    from rcl_interfaces.srv import ListParameters

    kind, one, two = "rcl_interfaces/srv/ListParameters", start(node_name="one"), start(node_name="two")
    asked: list[tuple[Any, bytes]] = []
    answers: list[tuple[int, bytes]] = []
    there: list[bool] = []
    server = one.serve("/list", kind, lambda client, payload: asked.append((client, payload)))
    client = two.client("/list", kind, lambda number, payload: answers.append((number, payload)), there.append)
    wait_for(lambda: there, "the server to be found")
    request = bytes(serialize_message(ListParameters.Request(prefixes=["planner"], depth=3)))
    client.call(1, request)
    client.call(2, request)
    wait_for(lambda: len(asked) == 2, "the requests")
    assert {unpadded(payload) for _, payload in asked} == {unpadded(request)}
    reply = bytes(serialize_message(ListParameters.Response()))
    for caller, _ in reversed(asked):
        server.reply(caller, reply)
    wait_for(lambda: len(answers) == 2, "the replies")
    assert {number for number, _ in answers} == {1, 2}
    server.close()
    wait_for(lambda: there == [True, False], "the server to be missed")
    assert not one.counters
    assert not two.counters


def test_a_service_of_a_far_node_is_shown_under_the_name_of_that_node(start: Start) -> None:
    """As ``ros2 param`` and ``ros2 lifecycle`` need it, which look for the node first."""
    kind, one, two = "rcl_interfaces/srv/ListParameters", start(node_name="one"), start(node_name="two")
    far = "/rx_robot_2/planner"

    def nodes() -> list[str]:
        return [f"{space.rstrip('/')}/{name}" for name, space in two._node.get_node_names_and_namespaces()]

    servers = [one.serve(f"{far}/{name}", kind, lambda *_: None, far) for name in ("list_parameters", "other")]
    wait_for(lambda: nodes().count(far) == 1, "the node to be shown")
    wait_for(lambda: len(two._node.get_service_names_and_types_by_node("planner", "/rx_robot_2")) >= 2, "its services")
    assert far not in {info.topic for info in one.discover()}
    servers[0].close()
    assert nodes().count(far) == 1
    servers[1].close()
    wait_for(lambda: far not in nodes(), "the node to leave with its last service")
    again = one.serve(f"{far}/list_parameters", kind, lambda *_: None, far)
    wait_for(lambda: far in nodes(), "the node to come back")
    (events,) = [info for info in one.discover() if info.topic == "/parameter_events"]
    assert len(events.publishers) == 1  # that of node two
    again.close()
    assert not one.counters


def test_nodes_that_use_a_type_can_be_asked_about_it(start: Start, host: rclpy.node.Node) -> None:
    """By the service that nodes have since Jazzy."""
    learned: list[Described] = []
    one = start(node_name="one")
    host.create_publisher(Header, "/custom", 1)
    wait_for(one.discover, "the publisher")
    witnesses = one.witnesses("/custom", "std_msgs/msg/Header")
    if not witnesses:
        pytest.skip("this ROS 2 gives no type hashes")
    asked = Witness(type_hash("std_msgs/msg/Header"), ("/host/get_type_description",))
    wait_for(lambda: one.witnesses("/custom", "std_msgs/msg/Header") == [asked], "the name of the node")
    executor = rclpy.executors.SingleThreadedExecutor(context=host.context)
    executor.add_node(host)
    spinning = threading.Thread(target=executor.spin, daemon=True)
    spinning.start()
    monkey = pytest.MonkeyPatch()
    with monkey.context() as patch:
        patch.setattr("gr_ros2.middleware.type_search.ships", lambda *_: False)
        search = TypeSearch(one, lambda: [("/custom", "std_msgs/msg/Header")], learned.append)
        wait_for(lambda: learned, "the description")
        search.close()
    executor.shutdown()
    assert learned[0].types.keys() == {"std_msgs/msg/Header", "builtin_interfaces/msg/Time"}
