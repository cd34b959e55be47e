"""Zenoh as rmw_zenoh uses it: the exact keys, attachments and tokens, and a peer that knows nothing of our adapter."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.core.errors import ConfigError
from gr_ros2.middleware import Qos
from gr_ros2.middleware.type_definitions import type_hash
from gr_ros2.middleware.zenoh_graph import (
    NO_HASH,
    Entity,
    attachment,
    read_attachment,
    read_token,
    tokens_of,
    topic_key,
)
from tests.domains import domain
from tests.middleware.support import ADAPT, CUSTOM, LATCHED, RELIABLE, STRING, message
from tests.waiting import wait_for

STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
TALKER = (
    "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MP/%/%/talker/%chatter/"
    f"std_msgs::msg::dds_::String_/{STRING_HASH}/::,10:,:,:,,"
)
"""The publisher of rmw_zenoh's documentation of its token format."""


def test_a_token_of_rmw_zenoh() -> None:
    expected = Entity(
        "aac3178e146ba6f1fc6e6a4085e77f21",
        10,
        "MP",
        "talker",
        "/",
        "/chatter",
        STRING,
        STRING_HASH,
        Qos("reliable", "volatile", 10),
    )
    assert read_token(TALKER) == expected
    assert expected.token(2) == TALKER.replace("::,10:,:,:,,", "1:2:1,10:,:,:,,")


def test_type_hashes_are_those_of_ros() -> None:
    assert type_hash(STRING) == STRING_HASH


def test_keys_and_attachments() -> None:
    assert topic_key(7, "/robot_1/odom", "nav_msgs/msg/Odometry", NO_HASH) == (
        "7/robot_1/odom/nav_msgs::msg::dds_::Odometry_/TypeHashNotSupported"
    )
    gid = bytes(range(16))
    assert attachment(5, 6, gid) == struct.pack("<qq", 5, 6) + b"\x10" + gid
    assert read_attachment(attachment(5, 6, gid)) == (5, gid)
    assert read_attachment(attachment(5, 6, gid)[:-1]) is None
    assert read_attachment(struct.pack("<qq", 5, 6) + b"\x0f" + gid) is None


names = st.from_regex(r"(/[A-Za-z_][A-Za-z0-9_]{0,5}){1,3}", fullmatch=True)
durations = st.one_of(st.just(0.0), st.integers(1, 10**8).map(lambda ms: ms / 1000))
qos = st.builds(
    Qos,
    st.sampled_from(["reliable", "best_effort"]),
    st.sampled_from(["volatile", "transient_local"]),
    st.integers(0, 10_000),
    durations,
    durations,
)


@given(names, names, qos, st.sampled_from(["MP", "MS"]), st.integers(0, 232))
def test_tokens_come_back(namespace: str, topic: str, profile: Qos, kind: Any, domain_id: int) -> None:
    entity = Entity("12ab", 3, kind, "node", namespace, topic, CUSTOM, NO_HASH, profile)
    found = read_token(entity.token(domain_id))
    assert found is not None
    assert found.qos.lifespan_s == pytest.approx(profile.lifespan_s)
    assert found.qos.deadline_s == pytest.approx(profile.deadline_s)
    assert (found.topic, found.namespace, found.kind, found.qos.depth) == (topic, namespace, kind, profile.depth)
    node = Entity("12ab", 0, "NN", "node", namespace)
    assert read_token(node.token(domain_id)) == node
    assert node.gid(domain_id) != entity.gid(domain_id)


@given(st.one_of(st.text(), st.lists(st.sampled_from(["@ros2_lv", "0", "MP", "NN", "%", "a:b", ""])).map("/".join)))
def test_strange_tokens_are_none(text: str) -> None:
    assert read_token(text) is None or text.startswith("@ros2_lv/")


zenoh = pytest.importorskip("zenoh", reason="zenoh is not installed: pip install eclipse-zenoh==1.10.2")

from gr_ros2.middleware.zenoh import ZenohMiddleware, session_config  # noqa: E402


@pytest.fixture
def ours(zenoh_router: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[ZenohMiddleware]:  # noqa: ARG001
    monkeypatch.setenv("ROS_DISTRO", "jazzy")
    with ZenohMiddleware(domain_id=domain()) as middleware:
        yield middleware


@pytest.fixture
def theirs(zenoh_router: str) -> Iterator[Any]:  # noqa: ARG001
    """A bare session that does by hand what rmw_zenoh does."""
    with zenoh.open(session_config()) as session:
        yield session


def test_a_bare_peer_is_heard(ours: ZenohMiddleware, theirs: Any) -> None:
    """Whatever hash its distribution gives the type, and messages that never came are counted."""
    heard: list[bytes] = []
    subscription = ours.subscribe("/chatter", STRING, RELIABLE, heard.append)
    other = Entity(str(theirs.zid()), 1, "MP", "talker", "/", "/chatter", STRING, NO_HASH, Qos("reliable", "volatile"))
    publisher = theirs.declare_publisher(topic_key(domain(), "/chatter", STRING, NO_HASH))
    token = theirs.liveliness().declare_token(other.token(domain()))
    wait_for(subscription.matched, "match")
    for number in (1, 2, 5):
        publisher.put(message(number), attachment=attachment(number, 1, bytes(16)))
    wait_for(lambda: len(heard) == 3, "three messages")
    assert heard == [message(number) for number in (1, 2, 5)]
    assert ours.counters["samples_lost:/chatter"] == subscription.lost == 2
    (info,) = ours.discover()
    assert (info.topic, info.type_name, info.publishers) == ("/chatter", STRING, (other.qos,))
    token.undeclare()
    wait_for(lambda: not subscription.matched(), "departure")


def test_a_bare_peer_hears_us(ours: ZenohMiddleware, theirs: Any) -> None:
    samples: list[Any] = []
    theirs.declare_subscriber(topic_key(domain(), "/chatter", STRING, STRING_HASH), samples.append)
    other = Entity(str(theirs.zid()), 1, "MS", "listener", "/", "/chatter", STRING, STRING_HASH, RELIABLE)
    kept = theirs.liveliness().declare_token(other.token(domain()))
    tokens: list[Any] = []
    theirs.liveliness().declare_subscriber(
        tokens_of(domain()), lambda sample: tokens.append(read_token(str(sample.key_expr))), history=True
    )
    publisher = ours.advertise("/chatter", STRING, LATCHED)
    wait_for(publisher.matched, "match")
    publisher.publish(message(1))
    publisher.publish(message(2))
    wait_for(lambda: len(samples) == 2, "two messages")
    assert [sample.payload.to_bytes() for sample in samples] == [message(1), message(2)]
    beside = [read_attachment(sample.attachment.to_bytes()) for sample in samples]
    wait_for(lambda: {"NN", "MP"} <= {token.kind for token in tokens}, "our tokens")
    (own,) = [token for token in tokens if token.kind == "MP"]
    assert (own.topic, own.type_hash, own.qos) == ("/chatter", STRING_HASH, LATCHED)
    assert beside == [(1, own.gid(domain())), (2, own.gid(domain()))]
    assert not ours.counters
    kept.undeclare()


def test_the_hash_of_a_foreign_type_is_learned(ours: ZenohMiddleware, theirs: Any) -> None:
    other = Entity(str(theirs.zid()), 1, "MS", "listener", "/", "/wheels", CUSTOM, "RIHS01_ab", RELIABLE)
    kept = theirs.liveliness().declare_token(other.token(domain()))
    wait_for(ours.discover, "discovery")
    samples: list[Any] = []
    theirs.declare_subscriber(topic_key(domain(), "/wheels", CUSTOM, "RIHS01_ab"), samples.append)
    publisher = ours.advertise("/wheels", CUSTOM, LATCHED)
    wait_for(publisher.matched, "match")
    wait_for(lambda: publisher.publish(message(1)) or samples, "a message")
    kept.undeclare()


def test_what_cannot_meet_is_counted(ours: ZenohMiddleware, theirs: Any) -> None:
    def token(topic: str, type_name: str, hashed: str) -> Any:
        other = Entity(str(theirs.zid()), 1, "MS", "listener", "/", topic, type_name, hashed, RELIABLE)
        return theirs.liveliness().declare_token(other.token(domain()))

    ours.advertise("/other_type", STRING, RELIABLE)
    ours.advertise("/other_hash", STRING, RELIABLE)
    kept = [token("/other_type", CUSTOM, NO_HASH), token("/other_hash", STRING, NO_HASH)]
    wait_for(lambda: len(ours.counters) == 2, "both counted")
    assert set(ours.counters) == {"incompatible_type:/other_type", "incompatible_type:/other_hash"}
    assert kept


def test_an_adapting_subscription_gets_what_is_kept(ours: ZenohMiddleware) -> None:
    with ZenohMiddleware(domain_id=domain(), node_name="other") as other:
        heard: list[bytes] = []
        ours.advertise("/map", STRING, LATCHED).publish(message(1))
        ours.advertise("/map", STRING, RELIABLE)
        other.subscribe("/map", STRING, ADAPT, heard.append)
        wait_for(lambda: heard == [message(1)], "the kept message")


def test_a_missing_router_is_said(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setenv("ZENOH_CONFIG_OVERRIDE", "connect/endpoints=[]")
    monkeypatch.setattr("gr_ros2.middleware.zenoh._ROUTER_S", 0.0)
    with ZenohMiddleware(domain_id=domain()):
        wait_for(lambda: "no router found" in caplog.text, "the warning")


@pytest.mark.parametrize(
    ("environment", "said"),
    [
        ({"ZENOH_CONFIG_OVERRIDE": "mode"}, "ZENOH_CONFIG_OVERRIDE: 'mode'"),
        ({"ZENOH_CONFIG_OVERRIDE": "nonsense/x=1"}, "'nonsense/x=1'"),
        ({"ZENOH_SESSION_CONFIG_URI": "/no/such/file"}, "ZENOH_SESSION_CONFIG_URI = '/no/such/file'"),
    ],
)
def test_wrong_settings_name_their_variable(environment: dict[str, str], said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        session_config(environment)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
