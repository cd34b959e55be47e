"""Dictionaries are what their ids say; what is coded today decodes tomorrow."""

from __future__ import annotations

import json
import random
from pathlib import Path

import pytest
from rosbags.typesys import Stores, get_typestore

from gr_ros2.compression import dictionary, shipped
from gr_ros2.compression.dictionary import SHIPPED, read_dictionary
from gr_ros2.core.errors import ConfigError
from tests.compression.support import Writer, codec_for, learn, simulated

DIGESTS = {
    1: "45fc91a02a6078a5579a1f88b9029d2356ca7373de80560ffd8c98c485c605bb",
    2: "acef4dc4f55ec23d0eaf874089ad63021f9b67bd9beb90f6c6ee88d4b5c50437",
}
"""A shipped set never changes. A better one gets the next number, and the old one stays."""
VECTORS = json.loads((Path(__file__).parents[1] / "vectors" / "coding.json").read_text())["messages"]
ENCODED = [vector for vector in VECTORS if not vector["announced"]]


@pytest.mark.parametrize("number", SHIPPED)
def test_a_shipped_set_never_changes(number: int) -> None:
    assert shipped(number).digest == DIGESTS[number]


@pytest.mark.parametrize("vector", ENCODED, ids=lambda vector: vector["name"])
def test_coded_messages_keep_their_meaning(vector: dict[str, str]) -> None:
    codec = codec_for(vector["type"], codec=vector["codec"], quantize=vector["quantize"])
    assert codec.decode(0, bytes.fromhex(vector["coded"])).hex() == vector["decoded"]
    if vector["coded"][1] not in "13":  # another zstd may find another encoding
        assert codec.encode(0, bytes.fromhex(vector["payload"])).hex() == vector["coded"]


def test_a_damaged_file_is_one_line_that_names_it(tmp_path: Path) -> None:
    file = tmp_path / "shipped-1.json"
    text = (Path(dictionary.__file__).parent / "dictionaries" / file.name).read_bytes()
    rng, refused = random.Random(1), 0
    wrong = [
        b"",
        b"[]",
        b"{}",
        b"null",
        b'{"format": 2}',
        b"[" * 100_000,
        text.replace(b'"words": [', b'"words": [5, ['),
    ]
    wrong += [text[: rng.randrange(len(text))] for _ in range(5)]
    wrong += [text[:at] + rng.randbytes(20) + text[at + 20 :] for at in (rng.randrange(len(text)) for _ in range(30))]
    for data in wrong:
        file.write_bytes(data)
        try:
            read_dictionary(file, 1)
        except ConfigError as error:
            refused += 1
            assert str(error).startswith(f"{file}: no dictionary, or damaged (")
            assert "\n" not in str(error)
    assert refused > 30
    file.unlink()
    with pytest.raises(ConfigError, match="No such file"):
        read_dictionary(file, 1)


def test_the_common_packages_are_covered() -> None:
    packages = {name.split("/")[0] for name in shipped().types}
    assert packages >= {"std_msgs", "geometry_msgs", "nav_msgs", "sensor_msgs", "tf2_msgs"}


def test_learning_is_repeatable_and_pays() -> None:
    payloads = simulated("odom", 10.0, odom_noise=(0.0331, 0.01))
    samples = [("nav_msgs/msg/Odometry", payload) for payload in payloads[::2]]
    made = learn(samples, "mine", base=shipped())
    assert learn(samples, "yours", base=shipped()).digest == made.digest
    plain, trained = codec_for("nav_msgs/Odometry"), codec_for("nav_msgs/Odometry", made)
    assert sum(len(trained.encode(0, p)) for p in payloads) < sum(len(plain.encode(0, p)) for p in payloads)


def test_a_type_of_ones_own_is_taken_apart_by_the_dictionary() -> None:
    text = "std_msgs/Header header\nfloat64 level\nfloat32[] cells\n" + "=" * 80 + "\nMSG: std_msgs/Header\n"
    text += "builtin_interfaces/Time stamp\nstring frame_id\n"
    samples = [
        b"\0\1\0\0" + bytes([n]) + bytes(7) + b"\5\0\0\0tank\0" + bytes(7) + bytes([n] * 8) + b"\2\0\0\0" + bytes(8)
        for n in range(50)
    ]
    made = learn([("my_msgs/msg/Tank", sample) for sample in samples], "tank", definitions={"my_msgs/msg/Tank": text})
    codec = codec_for("my_msgs/Tank", made)
    for sample in samples:
        coded = codec.encode(0, sample)
        assert coded[0] & 15 == 2
        assert codec.decode(0, coded) == sample


RANGE = "sensor_msgs/msg/Range"
NEWER = [name for name in shipped(2).types if name != RANGE]


@pytest.mark.parametrize("distribution", [Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY, Stores.ROS2_LYRICAL])
def test_the_definition_chooses_the_dictionary_and_not_the_name(distribution: Stores) -> None:
    """A Range has a variance since Iron: the same topic carries it from robots of any distribution."""
    store = get_typestore(distribution)
    codec = codec_for(RANGE)
    for seed in range(50):
        payload, clean = Writer(random.Random(seed), store=store).message(RANGE)
        coded = codec.encode(0, payload)
        assert coded[0] >> 4 == (1 if distribution is Stores.ROS2_HUMBLE else 2)
        assert coded[0] & 15 in (2, 3), "taken apart by its definition"
        assert codec.decode(0, coded) == codec.canonical(0, payload) == clean


@pytest.mark.parametrize("type_name", NEWER)
def test_types_that_are_newer_than_humble_are_taken_apart(type_name: str) -> None:
    codec, store = codec_for(type_name), get_typestore(Stores.ROS2_LYRICAL)
    for seed in range(20):
        payload, clean = Writer(random.Random(seed), store=store).message(type_name)
        coded = codec.encode(0, payload)
        if len(payload) < 1000:  # longer ones may have more items than this codec takes
            assert coded[0] >> 4 == 2
        assert codec.decode(0, coded) == codec.canonical(0, payload)
        assert codec.canonical(0, payload) in (clean, payload)


def test_a_range_that_fits_no_definition_passes_unchanged() -> None:
    codec = codec_for(RANGE)
    payload = Writer(random.Random(1), store=get_typestore(Stores.ROS2_JAZZY)).message(RANGE)[0] + b"\1\2\3\4"
    assert codec.decode(0, codec.encode(0, payload)) == payload


def test_fields_are_quantised_in_the_definitions_that_have_them() -> None:
    codec = codec_for(RANGE, quantize="variance=0.01 range=0.01")
    for distribution in (Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY):
        payload, clean = Writer(random.Random(7), store=get_typestore(distribution)).message(RANGE)
        decoded = codec.decode(0, codec.encode(0, payload))
        assert decoded == codec.canonical(0, payload)
        assert (decoded == clean) == (distribution is Stores.ROS2_HUMBLE)
    with pytest.raises(ConfigError, match="no floating-point field"):
        codec_for(RANGE, quantize="depth=0.01")


def test_a_trained_dictionary_keeps_a_definition_that_differs_from_humbles() -> None:
    jazzy = get_typestore(Stores.ROS2_JAZZY)
    texts = {name: jazzy.generate_msgdef(name, ros_version=2)[0] for name in (RANGE, "sensor_msgs/msg/Imu")}
    writer = [Writer(random.Random(seed), store=jazzy).message(RANGE)[1] for seed in range(50)]
    made = learn([(RANGE, payload) for payload in writer], "mine", definitions=texts)
    assert {name: bool(entry.definition) for name, entry in made.types.items()} == {RANGE: True}
    codec = codec_for(RANGE, made)
    for payload in writer:
        coded = codec.encode(0, payload)
        assert coded[0] >> 4 == 13 and codec.decode(0, coded) == payload


def test_a_set_that_is_none_is_named() -> None:
    with pytest.raises(ConfigError, match="number 9; there are 1"):
        shipped(9)
