"""Names, environment and ros_discovery_info."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from gr_ros2.core.errors import ConfigError
from gr_ros2.middleware import ros_graph
from gr_ros2.middleware.type_definitions import (
    UNKNOWN,
    definition,
    recorded_definition,
    text_hash,
    type_hash,
    typestores,
)
from gr_ros2.settings.fields import AUTO, Auto

NAME = st.from_regex(r"[a-z_][a-z0-9_]{0,8}", fullmatch=True)

# rmw_dds_common of Humble, in its message definition language: an independent reading of our bytes.
HUMBLE_MSGS = {
    "rmw_dds_common/msg/Gid": "char[24] data\n",
    "rmw_dds_common/msg/NodeEntitiesInfo": (
        "string<=256 node_namespace\nstring<=256 node_name\nGid[] reader_gid_seq\nGid[] writer_gid_seq\n"
    ),
    "rmw_dds_common/msg/ParticipantEntitiesInfo": "Gid gid\nNodeEntitiesInfo[] node_entities_info_seq\n",
}


@given(st.lists(NAME, min_size=1, max_size=4))
def test_topic_names_map_there_and_back(parts: list[str]) -> None:
    topic = "/" + "/".join(parts)
    assert ros_graph.ros_topic(ros_graph.dds_topic(ros_graph.check_topic(topic))) == topic


@given(NAME, st.sampled_from(["msg", "srv"]), st.from_regex(r"[A-Z][A-Za-z0-9]{0,8}(_Request)?", fullmatch=True))
def test_type_names_map_there_and_back(package: str, kind: str, name: str) -> None:
    type_name = f"{package}/{kind}/{name}"
    assert ros_graph.ros_type(ros_graph.dds_type(type_name)) == type_name


def test_names_as_ros_has_them() -> None:
    assert ros_graph.dds_topic("/robot_1/odom") == "rt/robot_1/odom"
    assert ros_graph.dds_type("nav_msgs/msg/Odometry") == "nav_msgs::msg::dds_::Odometry_"
    assert ros_graph.ros_topic("rq/add_two_ints") is None
    assert ros_graph.ros_topic("ros_discovery_info") is None
    assert ros_graph.ros_type("HelloWorld") == "HelloWorld"


def test_domain_from_argument_and_environment() -> None:
    assert ros_graph.resolve_domain_id("auto", {}) == 0
    assert ros_graph.resolve_domain_id("auto", {"ROS_DOMAIN_ID": ""}) == 0
    assert ros_graph.resolve_domain_id("auto", {"ROS_DOMAIN_ID": "42"}) == 42
    assert ros_graph.resolve_domain_id(7, {"ROS_DOMAIN_ID": "42"}) == 7
    for text in ("233", "-1", "1.0", "four"):
        with pytest.raises(ConfigError, match="ROS_DOMAIN_ID"):
            ros_graph.resolve_domain_id("auto", {"ROS_DOMAIN_ID": text})


def test_discovery_options_are_those_of_rcl() -> None:
    def options(localhost_only: bool | Auto = AUTO, **environment: str) -> tuple[str, tuple[str, ...]]:
        found = ros_graph.discovery_options(localhost_only, environment)
        return found.range, found.peers

    assert options() == options(ROS_LOCALHOST_ONLY="0") == options(ROS_AUTOMATIC_DISCOVERY_RANGE="") == ("SUBNET", ())
    assert options(ROS_STATIC_PEERS="192.0.2.1; robot.local;") == ("SUBNET", ("192.0.2.1", "robot.local"))
    for name, peers in (("SUBNET", ("a",)), ("LOCALHOST", ("a",)), ("OFF", ()), ("SYSTEM_DEFAULT", ())):
        chosen = {"ROS_AUTOMATIC_DISCOVERY_RANGE": name, "ROS_STATIC_PEERS": "a"}
        assert options(**chosen) == options(False, ROS_LOCALHOST_ONLY="1", **chosen) == (name, peers)
        assert options(True, **chosen) == options(ROS_LOCALHOST_ONLY="1", **chosen) == ("LOCALHOST", ())
    with pytest.raises(ConfigError, match="ROS_LOCALHOST_ONLY"):
        options(ROS_LOCALHOST_ONLY="true")
    with pytest.raises(ConfigError, match="ROS_AUTOMATIC_DISCOVERY_RANGE = 'local': write SUBNET, LOCALHOST"):
        options(ROS_AUTOMATIC_DISCOVERY_RANGE="local")


@pytest.mark.parametrize(("distro", "size"), [("", 24), ("humble", 24), ("iron", 16), ("jazzy", 16), ("rolling", 16)])
def test_gid_follows_the_distribution(distro: str, size: int) -> None:
    assert ros_graph.gid_size({"ROS_DISTRO": distro} if distro else {}) == size


@pytest.mark.parametrize("gid_bytes", [24, 16])
@pytest.mark.parametrize("node_name", ["n", "radio", "four", "gr_ros2"])
def test_discovery_info_reads_as_the_message_it_is(gid_bytes: int, node_name: str) -> None:
    guids = [bytes([i] * 16) for i in range(4)]
    nodes = [
        ros_graph.NodeEntities(node_name, "/robot_1", guids[1:2], guids[2:]),
        ros_graph.NodeEntities("planner", "/rx_robot_2", guids[:1], []),
    ]
    data = ros_graph.participant_entities_info(guids[0], nodes, gid_bytes=gid_bytes)
    store = get_typestore(Stores.EMPTY)
    for name, text in HUMBLE_MSGS.items():
        store.register(get_types_from_msg(text.replace("24", str(gid_bytes)).replace("char", "uint8"), name))
    info = store.deserialize_cdr(data, "rmw_dds_common/msg/ParticipantEntitiesInfo")
    node, other = info.node_entities_info_seq  # type: ignore[attr-defined]
    assert (other.node_namespace, other.node_name, len(other.reader_gid_seq)) == ("/rx_robot_2", "planner", 1)
    assert (node.node_namespace, node.node_name) == ("/robot_1", node_name)
    assert [bytes(gid.data)[:16] for gid in node.reader_gid_seq] == guids[1:2]
    assert [bytes(gid.data)[:16] for gid in node.writer_gid_seq] == guids[2:]
    assert bytes(info.gid.data) == guids[0].ljust(gid_bytes, b"\0")  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("type_name", "digest"),
    [
        ("std_msgs/msg/Char", "3ad2d04dd29ba19d04b16659afa3ccaedd691914b02a64e82e252f2fa6a586a9"),
        ("sensor_msgs/msg/BatteryState", "4bee5dfce981c98faa6828b868307a0a73f992ed0789f374ee96c8f840e69741"),
        ("std_msgs/msg/String", "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"),
    ],
)
def test_hashes_of_ros(type_name: str, digest: str) -> None:
    """A char of a .msg is a uint8 to rosidl."""
    assert type_hash(type_name) == f"RIHS01_{digest}"


def test_char_is_a_uint8_in_arrays_too() -> None:
    one, other = (text_hash("a_msgs/msg/A", f"{k}[3] a\n{k}[] b\n{k}[<=4] c\n") for k in ("char", "uint8"))
    assert one == other != text_hash("a_msgs/msg/A", "byte[3] a\nbyte[] b\nbyte[<=4] c\n")


def test_the_discovery_endpoint_tells_the_hash_of_its_type() -> None:
    store = get_typestore(Stores.EMPTY)
    for name, text in HUMBLE_MSGS.items():
        store.register(get_types_from_msg(text.replace("char[24]", "uint8[16]"), name))
    digest = store.hash_rihs01("rmw_dds_common/msg/ParticipantEntitiesInfo")
    assert ros_graph.announced_hash(ros_graph.DISCOVERY_USER_DATA) == digest


def test_who_has_short_gids() -> None:
    told = ros_graph.endpoint_user_data("RIHS01_" + 64 * "a")
    assert ros_graph.has_short_gids(ros_graph.DISCOVERY_TOPIC, told)
    assert ros_graph.has_short_gids(ros_graph.DISCOVERY_TOPIC, b"qos=x;" + told)
    assert not ros_graph.has_short_gids(ros_graph.DISCOVERY_TOPIC, b"")  # Humble
    assert not ros_graph.has_short_gids(ros_graph.DISCOVERY_TOPIC, ros_graph.DISCOVERY_USER_DATA)  # another gr-ros2
    assert not ros_graph.has_short_gids("rt/chatter", told)
    unknown = ros_graph.endpoint_user_data("")
    assert unknown and ros_graph.announced_hash(unknown) == ""  # rmw_cyclonedds warns about endpoints without user data
    assert ros_graph.announced_hash(b"xtypehash=RIHS01_;") == ""


def test_a_hash_without_a_text_is_that_of_the_distribution_that_has_it() -> None:
    """sensor_msgs/Range has a variance since Iron; a bag may have the hash alone."""
    jazzy = get_typestore(Stores.ROS2_JAZZY)
    digest = jazzy.hash_rihs01("sensor_msgs/msg/Range")
    assert digest != type_hash("sensor_msgs/msg/Range")
    found = recorded_definition("sensor_msgs/msg/Range", "", digest)
    assert "float32 variance" in found.text and found.digest == digest
    assert text_hash("sensor_msgs/msg/Range", found.text) == digest
    strange = "RIHS01_" + 64 * "5"
    assert recorded_definition("sensor_msgs/msg/Range", "", strange) == (UNKNOWN, strange)


@pytest.mark.parametrize(
    "type_name", ["diagnostic_msgs/msg/DiagnosticArray", "std_msgs/msg/String", "tf2_msgs/msg/TFMessage"]
)
def test_what_the_link_itself_writes_is_the_same_type_in_every_distribution(type_name: str) -> None:
    """Diagnostics, counters, merged transforms: any node reads them, whatever is sourced where."""
    assert len(typestores(type_name)) == 1


def test_a_type_has_a_definition_for_each_hash_that_distributions_give_it() -> None:
    humble, newer = typestores("sensor_msgs/msg/Range")
    assert [len(store.fielddefs["sensor_msgs/msg/Range"][1]) for store in (humble, newer)] == [6, 7]
    assert type_hash("sensor_msgs/msg/Range") == humble.hash_rihs01("sensor_msgs/msg/Range")
    assert typestores("robot_msgs/msg/WheelState") == ()


def test_a_type_that_is_newer_than_humble_is_known() -> None:
    text, digest = definition("geometry_msgs/msg/VelocityStamped")
    assert "string body_frame_id" in text
    assert digest == type_hash("geometry_msgs/msg/VelocityStamped")
    assert digest == get_typestore(Stores.ROS2_JAZZY).hash_rihs01("geometry_msgs/msg/VelocityStamped")


def test_definitions() -> None:
    text, digest = definition("nav_msgs/msg/Odometry")
    assert "MSG: geometry_msgs/PoseWithCovariance" in text and digest.startswith("RIHS01_")
    assert type_hash("nav_msgs/msg/Odometry") == digest
    assert type_hash("robot_msgs/msg/WheelState") == ""
    assert definition("robot_msgs/msg/WheelState")[0] == UNKNOWN
    assert definition("robot_msgs/msg/WheelState", "float32 speed\n").text != UNKNOWN
