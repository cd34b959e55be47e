"""What the link sees: the first byte, ledger fates, bounds, options."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.interfaces.typing import Typesdict
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from gr_ros2.compression import LinkCodec
from gr_ros2.compression.link_codec import ANNOUNCED, FIELDS, FIELDS_AND_MORE, MAX_LEARNED, MAX_SHARED, STORED, ZSTD
from gr_ros2.compression.zstd_frames import Zstd
from gr_ros2.core.errors import CodecError, ConfigError, DamagedError, UnknownDictionaryError
from gr_ros2.settings.registry import Registry, Topic
from gr_ros2.wire import varint
from tests.compression.support import STORE, Writer, codec_for, simulated

ODOMETRY = "nav_msgs/msg/Odometry"
TYPES = (ODOMETRY, "sensor_msgs/msg/LaserScan", "tf2_msgs/msg/TFMessage", "std_msgs/msg/String", "my_msgs/msg/Thing",
         "visualization_msgs/msg/MarkerArray")  # fmt: skip


@given(st.sampled_from(TYPES), st.binary(max_size=400))
@settings(max_examples=200, deadline=None)
def test_arbitrary_bytes_end_in_a_message_or_a_codec_error(type_name: str, coded: bytes) -> None:
    codec = codec_for(type_name, max_size=5000)
    for first in (coded[:1], b"\x01", b"\x11", b"\x12", b"\x13"):
        try:
            assert len(codec.decode(0, first + coded[1:])) <= 5000
        except CodecError as error:
            assert error.fate in ("damaged", "unsupported", "unknown_dictionary")


@given(st.sampled_from(TYPES[:4]), st.integers(0, 1 << 32), st.data())
@settings(max_examples=80, deadline=None)
def test_damaged_messages_end_in_a_message_or_a_codec_error(type_name: str, seed: int, data: st.DataObject) -> None:
    payload, _ = Writer(random.Random(seed)).message(type_name)
    codec = codec_for(type_name)
    coded = bytearray(codec.encode(0, payload))
    for _ in range(data.draw(st.integers(1, 4))):
        coded[data.draw(st.integers(0, len(coded) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    try:
        assert len(codec.decode(0, bytes(coded))) <= 1 << 20
    except CodecError as error:
        assert error.fate in ("damaged", "unsupported", "unknown_dictionary")


@given(
    st.sampled_from([ODOMETRY, "sensor_msgs/msg/LaserScan", "tf2_msgs/msg/TFMessage", "std_msgs/msg/String"]),
    st.integers(0, 1 << 32),
    st.sampled_from(["auto", "none", "fields", "zstd"]),
    st.booleans(),
    st.sampled_from("<>"),
)
@settings(max_examples=100, deadline=None)
def test_what_comes_out_is_the_canonical_form(type_name: str, seed: int, codec: str, rounded: bool, order: str) -> None:
    steps = {ODOMETRY: "pose.pose=0.001", "sensor_msgs/msg/LaserScan": "ranges=0.01"}.get(type_name, "")
    link = codec_for(type_name, codec=codec, quantize=steps * rounded)
    payload, clean = Writer(random.Random(seed), order).message(type_name)
    canonical = link.canonical(0, payload)
    assert link.decode(0, link.encode(0, payload)) == canonical
    assert link.canonical(0, canonical) == canonical
    if not (steps and rounded):
        assert canonical == (payload if codec == "none" else clean)


def test_nothing_larger_than_the_bound_comes_out() -> None:
    large = bytes(100_000)
    for coded in (
        b"\x01" + Zstd().compress(large),
        b"\x01" + varint(1 << 34 | 1) + b"x" * 20,
        b"\x00" + large,
        codec_for("std_msgs/ByteMultiArray").encode(
            0, b"\0\1\0\0" + bytes(8) + (99_000).to_bytes(4, "little") + bytes(99_000)
        ),
    ):
        with pytest.raises(DamagedError, match="damaged message"):
            codec_for("std_msgs/ByteMultiArray", max_size=50_000).decode(0, coded)


def test_a_size_that_lies_is_found_out() -> None:
    coded = Zstd().compress(b"abc" * 1000)
    with pytest.raises(DamagedError, match="damaged"):
        Zstd().decompress(varint(2 * 2000 | coded[0] & 1) + coded[2:], 10_000)


def test_what_does_not_shrink_is_stored() -> None:
    noise = random.Random(1).randbytes(700)
    for type_name in TYPES:
        assert codec_for(type_name).encode(0, noise) == b"\0" + noise


def test_the_codec_of_a_topic_is_its_option() -> None:
    payload = simulated("odom", 0.2)[0]
    first = {
        mode: codec_for(ODOMETRY, codec=mode).encode(0, payload)[0] & 15 for mode in ("none", "zstd", "fields", "auto")
    }
    assert first == {"none": STORED, "zstd": ZSTD, "fields": FIELDS, "auto": FIELDS}
    assert codec_for("sensor_msgs/LaserScan").encode(0, simulated("scan", 0.5)[0])[0] & 15 == FIELDS_AND_MORE
    assert codec_for("my_msgs/Thing").encode(0, payload)[0] == ZSTD


def test_a_wrong_codec_is_an_error_that_names_it() -> None:
    with pytest.raises(ConfigError, match=r"codec = 'gzip'.*'topic'.*auto, none, fields, zstd"):
        codec_for(ODOMETRY, codec="gzip")


@pytest.mark.parametrize("first", [0xD2, 0xD1, 0xF2])
def test_a_dictionary_that_is_not_held_is_its_own_fate(first: int) -> None:
    with pytest.raises(UnknownDictionaryError, match=f"shipped dictionaries {first >> 4}") as error:
        codec_for(ODOMETRY).decode(0, bytes([first]) + b"abc")
    assert error.value.fate == "unknown_dictionary"


def test_others_that_announce_ever_new_types_cost_bounded_memory() -> None:
    known, odom = LinkCodec(()), Topic(0, "odom", ODOMETRY)
    payload = simulated("odom", 0.2)[0]
    first = known.of([odom])
    for number in range(0, 3 * MAX_SHARED, 30):
        known.of([Topic(row, f"t{row}", f"my_msgs/msg/Thing{number + row}") for row in range(30)])
        assert len(known._made) <= MAX_SHARED
    for codec in (first, known.of([odom])):
        assert codec.decode(0, codec.encode(0, payload)) == payload


@pytest.mark.parametrize("first", [0x02, 0x04, 0x15, 0x1F, 0x0F])
def test_an_unknown_codec_is_unsupported(first: int) -> None:
    with pytest.raises(CodecError, match="unknown codec") as error:
        codec_for(ODOMETRY).decode(0, bytes([first]) + b"abc")
    assert error.value.fate == "unsupported"


def test_topics_have_their_types() -> None:
    registry = Registry.from_rows({"odom": ODOMETRY, "cmd_vel": "geometry_msgs/Twist"})
    codec = LinkCodec(registry)
    odom, twist = simulated("odom", 0.2)[0], simulated("cmd_vel", 0.2)[0]
    assert codec.decode(0, codec.encode(0, odom)) == odom
    assert codec.decode(1, codec.encode(1, twist)) == twist
    assert len(codec.encode(1, twist)) < 20


def _definition(text: str) -> Typesdict:
    return {**STORE.fielddefs, **get_types_from_msg(text, "my_msgs/msg/Thing")}


def _thing(text: str, seed: int) -> tuple[bytes, bytes]:
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(text, "my_msgs/msg/Thing"))
    return Writer(random.Random(seed), store=store).message("my_msgs/msg/Thing")


THING = "std_msgs/Header header\nuint8 mode\nfloat64[4] speeds\nstring[] names\n"


def test_a_learned_type_is_coded_by_its_structure_and_decoded_by_what_was_announced() -> None:
    sender, receiver = codec_for("my_msgs/msg/Thing"), codec_for("my_msgs/msg/Thing")
    payload, clean = _thing(THING, 1)
    before = sender.encode(0, payload)
    assert sender.announcement(0) == "auto" and before[0] >> 4 == 0 and not receiver.lacks(0, before)
    sender.learn("my_msgs/msg/Thing", _definition(THING))
    after = sender.encode(0, payload)
    assert sender.announcement(0) == "auto TsB4d*s" and after[0] == ANNOUNCED << 4 | FIELDS and len(after) < len(before)
    assert receiver.lacks(0, after)
    with pytest.raises(UnknownDictionaryError, match="structure"):
        receiver.decode(0, after)
    (topic,) = Registry.from_rows({"topic": "my_msgs/msg/Thing"})
    told = receiver.of([topic], {0: sender.announcement(0)})
    assert not told.lacks(0, after) and told.decode(0, after) == clean == sender.canonical(0, payload)
    assert told.decode(0, before) == payload
    assert receiver.lacks(0, after)  # others that share its dictionaries have not learned it
    assert sender.decode(0, after) == clean


def test_a_type_that_changes_is_announced_again() -> None:
    sender = codec_for("my_msgs/msg/Thing")
    (topic,) = Registry.from_rows({"topic": "my_msgs/msg/Thing"})
    for text in (THING, THING + "int32 more\n"):
        sender.learn("my_msgs/msg/Thing", _definition(text))
        payload, clean = _thing(text, 2)
        assert sender.of([topic], {0: sender.announcement(0)}).decode(0, sender.encode(0, payload)) == clean
    for number in range(2 * MAX_LEARNED):
        sender.learn("my_msgs/msg/Thing", _definition(f"int32[{number + 1}] x\n"))
    assert sender.announcement(0) == f"auto {MAX_LEARNED - 2}i"


def test_a_definition_that_a_dictionary_has_is_not_announced_but_preferred() -> None:
    sender = codec_for("sensor_msgs/msg/Range")
    sender.learn("sensor_msgs/msg/Range", get_typestore(Stores.ROS2_JAZZY).fielddefs)
    assert sender.announcement(0) == "auto"
    payload, clean = Writer(random.Random(3), store=get_typestore(Stores.ROS2_JAZZY)).message("sensor_msgs/msg/Range")
    coded = sender.encode(0, payload)
    assert coded[0] >> 4 == 2 and codec_for("sensor_msgs/msg/Range").decode(0, coded) == clean


@pytest.mark.parametrize("mode", ["none", "zstd"])
def test_a_topic_that_is_not_split_announces_no_structure(mode: str) -> None:
    sender = codec_for("my_msgs/msg/Thing", codec=mode)
    sender.learn("my_msgs/msg/Thing", _definition(THING))
    assert sender.announcement(0) == mode


def test_a_structure_that_is_too_long_or_not_understood_is_not_used() -> None:
    sender = codec_for("my_msgs/msg/Thing")
    sender.learn("my_msgs/msg/Thing", _definition("".join(f"int32 x{n}\nint16 y{n}\n" for n in range(200))))
    assert sender.announcement(0) == "auto"
    (topic,) = Registry.from_rows({"topic": "my_msgs/msg/Thing"})
    payload, _ = _thing(THING, 4)
    for text in ("auto x?", "", "auto", "auto ", "later words"):
        assert sender.of([topic], {0: text}).decode(0, sender.encode(0, payload)) == payload
