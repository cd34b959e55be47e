"""Files as other programs write and leave them: read to the last message, and not touched."""

from __future__ import annotations

import shutil
import sqlite3
from collections import Counter
from contextlib import closing
from pathlib import Path

import pytest
import yaml
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer

from gr_ros2.core.errors import BagError, ConfigError
from gr_ros2.middleware import Qos, TopicInfo
from gr_ros2.middleware.bag import BagMiddleware
from gr_ros2.middleware.bag_files import RecordedTopic, bag_contents, bag_topics, read_bag
from gr_ros2.middleware.bag_recorder import BagRecorder
from gr_ros2.middleware.type_definitions import definition, same_type, text_hash
from tests.middleware import foreign_bags
from tests.middleware.foreign_bags import (
    Foreign,
    broken_off,
    chunks_of,
    crashed,
    listing,
    make_folder,
    make_mcap,
    make_sqlite,
    profile,
    qos,
    unclosed,
    without_qos,
)
from tests.waiting import wait_for


def counts(path: Path) -> dict[str, int]:
    return dict(Counter(message.topic for message in read_bag(path)))


@pytest.mark.parametrize("version", [1, 2, 4])
def test_sqlite_files_of_all_versions(tmp_path: Path, version: int) -> None:
    offered = qos(profile(depth=7), profile(history=2, depth=0, reliability=2))
    text = "int32 x\n"
    topics = [Foreign("/a", qos=offered, count=20), Foreign("/b", "my_msgs/msg/X", qos=offered, count=5, text=text)]
    path = make_sqlite(tmp_path / "bag.db3", topics, version)
    contents = bag_contents(path)
    offers = (Qos("reliable", "volatile", 7), Qos("best_effort", "volatile", 0))
    assert contents.topics["/a"].info.publishers == ((Qos("reliable", "volatile", 10),) if version == 1 else offers)
    assert contents.texts == ({"my_msgs/msg/X": text} if version == 4 else {})
    assert counts(path) == {"/a": 20, "/b": 5}
    assert [one.payload for one in read_bag(path, ["/b"])] == topics[1].payloads
    assert not contents.remarks


@pytest.mark.parametrize("folder", [True, False])
@pytest.mark.parametrize("name", ["in.db3", "in #1 50%.db3"])
def test_the_write_ahead_log_is_read_and_nothing_changes(tmp_path: Path, folder: bool, name: str) -> None:
    place = tmp_path / "place"
    place.mkdir()
    late = Foreign("/a", count=100, start=100)
    path = crashed(place / name, [late], [Foreign("/a", count=100)])
    if folder:
        path = make_folder(place / "bag", [path], [Foreign("/a", count=100)])
    before = listing(place)
    assert any(file.endswith("-wal") for file in before)
    for part in (*place.rglob("*"), place):
        part.chmod(0o555 if part.is_dir() else 0o444)
    try:
        assert counts(path) == {"/a": 200}
        assert [one.payload for one in read_bag(path)][100:] == late.payloads
        assert len(bag_contents(path).differences) == folder
        assert listing(place) == before
    finally:
        for part in (place, *place.rglob("*")):
            part.chmod(0o755)


def test_a_bag_whose_topics_stand_in_the_log_alone(tmp_path: Path) -> None:
    writer = sqlite3.connect(tmp_path / "alive.db3")
    writer.execute("PRAGMA journal_mode = WAL")
    writer.execute("PRAGMA wal_autocheckpoint = 0")
    made = sqlite3.connect(make_sqlite(tmp_path / "made.db3", [Foreign("/a")]))
    made.backup(writer)
    made.close()
    for suffix in ("", "-wal"):
        shutil.copy(tmp_path / f"alive.db3{suffix}", tmp_path / f"in.db3{suffix}")
    writer.close()
    assert counts(tmp_path / "in.db3") == {"/a": 10}


def test_a_folder_without_metadata_is_read(tmp_path: Path) -> None:
    late = Foreign("/a", count=5, start=10)
    make_sqlite(tmp_path / "in_9.db3", [Foreign("/a")])
    crashed(tmp_path / "in_10.db3", [late], [late])  # the tenth comes after the second
    assert [one.payload for one in read_bag(tmp_path)] == Foreign("/a").payloads + sorted(late.payloads * 2)
    assert ["there is no metadata.yaml" in line for line in bag_contents(tmp_path).remarks] == [True]


@pytest.mark.parametrize("storage", ["", "my_storage"])
def test_what_metadata_calls_the_storage_does_not_matter(tmp_path: Path, storage: str) -> None:
    path = make_folder(
        tmp_path / "in", [make_mcap(tmp_path / "a.mcap", [Foreign("/a")])], [Foreign("/a")], storage=storage
    )
    assert counts(path) == {"/a": 10} and not bag_contents(path).remarks


@pytest.mark.parametrize(
    "text", ["rosbag2_bagfile_information: [1, 2", "a: 1", "rosbag2_bagfile_information: {version: 4}"]
)
def test_metadata_that_cannot_be_used_is_a_remark(tmp_path: Path, text: str) -> None:
    path = make_folder(tmp_path / "in", [make_mcap(tmp_path / "a.mcap", [Foreign("/a")])], [Foreign("/a")])
    (path / "metadata.yaml").write_text(text)
    assert counts(path) == {"/a": 10}
    assert len(bag_contents(path).remarks) == 1 and "metadata.yaml cannot be used" in bag_contents(path).remarks[0]


@pytest.mark.parametrize(
    ("key", "value"),
    [("message_count", "ten"), ("name", None), ("type", 5), ("serialization_format", []), ("type_description_hash", 7)],
)
def test_what_metadata_says_of_one_topic_decides_over_no_file(tmp_path: Path, key: str, value: object) -> None:
    topics = [Foreign("/a"), Foreign("/b")]
    path = make_folder(tmp_path / "in", [make_mcap(tmp_path / "a.mcap", topics)], topics)
    metadata = yaml.safe_load((path / "metadata.yaml").read_text())
    row = metadata["rosbag2_bagfile_information"]["topics_with_message_count"][1]
    (row if key in row else row["topic_metadata"])[key] = value
    (path / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    assert counts(path) == {"/a": 10, "/b": 10}
    assert bag_contents(path).remarks == [
        f"{path}: metadata.yaml cannot be used ({key} = {value!r}): all files of the folder count"
    ]


@pytest.mark.parametrize("killed", [False, True])
def test_a_schema_of_bytes_beside_others_hinders_nothing(tmp_path: Path, killed: bool) -> None:
    binary = bytes(range(256)).decode(errors="surrogateescape")
    topics = [
        Foreign("/a"),
        Foreign("/p", type_name="foo.Bar", encoding="protobuf", text=binary, serialization="protobuf"),
        Foreign("/q", qos=binary),
    ]
    path = unclosed(tmp_path / "in.mcap", topics) if killed else make_mcap(tmp_path / "in.mcap", topics)
    assert counts(path) == {"/a": 10, "/q": 10}
    contents = bag_contents(path)
    assert contents.left_out == {"/p": "it is serialized as 'protobuf', and a link carries 'cdr'"}
    assert f"{path}: the QoS of /q cannot be read: reliable, volatile and 10 are taken instead" in contents.differences


@pytest.mark.parametrize(
    "row", [(None, "std_msgs/msg/String", "cdr"), ("/b", None, "cdr"), ("/b", 5, None), (b"\xff", b"\xfe", b"\xff")]
)
def test_a_topic_of_an_sqlite_file_that_is_none_is_left_out(tmp_path: Path, row: tuple[object, ...]) -> None:
    path = make_sqlite(tmp_path / "a.db3", [Foreign("/a"), Foreign("/b")])
    with closing(sqlite3.connect(path)) as database:
        texts = [f"CAST(x'{value.hex()}' AS TEXT)" if isinstance(value, bytes) else "?" for value in row]
        values = [value for value in row if not isinstance(value, bytes)]
        database.execute(
            f"UPDATE topics SET name = {texts[0]}, type = {texts[1]}, serialization_format = {texts[2]} WHERE id = 2",
            values,
        )
        database.commit()
    assert counts(path) == {"/a": 10}
    assert len(bag_contents(path).left_out) == 1


@pytest.mark.parametrize("damage", ["missing", "empty", "foreign"])
def test_a_file_that_cannot_be_read_is_a_remark(tmp_path: Path, damage: str) -> None:
    names = ["a_0.mcap", "a_1.mcap", "a_2.mcap"]
    files = [make_mcap(tmp_path / name, [Foreign("/a", start=10 * n)]) for n, name in enumerate(names)]
    path = make_folder(tmp_path / "in", files, [Foreign("/a", count=30)])
    if damage == "missing":
        (path / names[1]).unlink()
    else:
        (path / names[1]).write_bytes(b"" if damage == "empty" else b"text" * 99)
    assert counts(path) == {"/a": 20}
    said, differs = bag_contents(path).remarks
    assert names[1] in said and "counts 30 messages of /a, the files have 20" in differs


@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("folder", [True, False])
@pytest.mark.parametrize("tail", [b"", b"\x05", b"\x06" + (2000).to_bytes(8, "little") + b"abc", bytes(5000)])
def test_a_recorder_that_was_killed(tmp_path: Path, chunked: bool, folder: bool, tail: bytes) -> None:
    topics = [Foreign("/a", count=30), Foreign("/b", count=7)]
    path = unclosed(tmp_path / "in_0.mcap", topics, chunked=chunked, tail=tail)
    read = list(read_bag(tmp_path if folder else path))
    assert counts(path) == {"/a": 30, "/b": 7}
    assert [one.payload for one in read if one.topic == "/a"] == topics[0].payloads
    assert [one.stamp_ns for one in read] == sorted(one.stamp_ns for one in read)
    (said,) = bag_contents(path).remarks
    assert said.endswith(f"in_0.mcap has no end, as after a crash: {len(tail)} bytes of it cannot be read")


@pytest.mark.parametrize("compression", ["", "lz4", "zstd"])
@pytest.mark.parametrize("zeros", [0, 5000, 900_000])
def test_of_a_chunk_that_is_cut_off_all_is_read_that_can_be(tmp_path: Path, compression: str, zeros: int) -> None:
    """lz4 and zstd give out blocks of 64 and 128 kB. A computer that goes off may leave zeros."""
    topic = Foreign("/a", count=1500, random=250)
    path, payloads = tmp_path / "in.mcap", topic.payloads
    begins = chunks_of(path, topic, compression, 1000)
    whole = path.read_bytes()
    for place in (1000, *(begins[1] * n // 8 for n in range(1, 8)), *range(begins[1], begins[2], 33_333)):
        cut = place // 512 * 512 if zeros else place  # what a disk stores together
        path.write_bytes(whole[:cut] + bytes(zeros))
        begun = max(begin for begin in begins if begin <= cut)
        before, length = begins.index(begun) * 1000, (begins[begins.index(begun) + 1] - begun)
        least = before + int((cut - begun) / length * min(1000, 1500 - before) - (512 if compression else 2))
        if least <= 0:
            continue
        read = [one.payload for one in read_bag(path)]
        assert len(read) >= least
        assert read == payloads[: len(read)]
        if len(read) > before:
            (said,) = bag_contents(path).remarks
            assert f"{len(read) - before} messages of its last chunk are read (" in said


def test_a_recorder_that_was_killed_before_it_wrote_a_message(tmp_path: Path) -> None:
    with pytest.raises(BagError, match=r"in\.mcap: cannot be read \(has no end, as after a crash"):
        counts(unclosed(tmp_path / "in.mcap", []))


def test_the_profile_of_a_file_does_not_matter(tmp_path: Path) -> None:
    assert counts(unclosed(tmp_path / "in.mcap", [Foreign("/a")], profile="")) == {"/a": 10}


@pytest.mark.parametrize("kind", ["sqlite3", "mcap", "yaml", "yaml list"])
def test_a_qos_that_lacks_something_hinders_nothing(tmp_path: Path, kind: str) -> None:
    short = "- reliability: best_effort\n  durability: transient_local\n  history: keep_last\n  depth: 100\n"
    topics = [
        Foreign("/a"),
        Foreign("/b", qos=short),
        Foreign("/c", qos="- {depth: [1], deadline: {sec: x}, history: 2.5}"),
    ]
    if "yaml" in kind:
        path = make_folder(tmp_path / "in", [make_mcap(tmp_path / "a.mcap", without_qos(topics))], topics)
        if "list" in kind:
            metadata = yaml.safe_load((path / "metadata.yaml").read_text())
            for row in metadata["rosbag2_bagfile_information"]["topics_with_message_count"]:
                row["topic_metadata"]["offered_qos_profiles"] = yaml.safe_load(
                    row["topic_metadata"]["offered_qos_profiles"]
                )
            (path / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    else:
        path = make_sqlite(tmp_path / "a.db3", topics) if kind == "sqlite3" else make_mcap(tmp_path / "a.mcap", topics)
    assert counts(path) == {"/a": 10, "/b": 10, "/c": 10}
    plain = Qos("reliable", "volatile", 10)
    assert [info.publishers[0] for info in bag_topics(path)] == [
        plain,
        Qos("best_effort", "transient_local", 100),
        plain,
    ]
    assert not bag_contents(path).remarks


@pytest.mark.parametrize("text", ["[", "reliable", "- [1, 2]", "- {depth: -3}", pytest.param("[" * 2000, id="deep")])
def test_a_qos_that_cannot_be_read_is_a_remark(tmp_path: Path, text: str) -> None:
    path = make_sqlite(tmp_path / "a.db3", [Foreign("/a"), Foreign("/b", qos=text)])
    assert counts(path) == {"/a": 10, "/b": 10}
    assert bag_contents(path).remarks == [
        f"{path}: the QoS of /b cannot be read: reliable, volatile and 10 are taken instead"
    ]
    assert bag_contents(path).topics["/b"].info.publishers == (Qos("reliable", "volatile", 10),)


def test_a_depth_of_64_bits_is_the_greatest_that_a_registry_takes(tmp_path: Path) -> None:
    deep = f"- {{history: keep_last, depth: {2**64 - 1}}}"
    path = make_sqlite(tmp_path / "a.db3", [Foreign("/a"), Foreign("/b", qos=deep)])
    assert [info.publishers[0].depth for info in bag_topics(path)] == [10, 2**31 - 1]


def test_stamps_before_1970(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(foreign_bags, "START_NS", -(10**9))
    database = make_sqlite(tmp_path / "in.db3", [Foreign("/a", count=30)])
    stamps = [one.stamp_ns for one in read_bag(database)]
    assert stamps[0] < -(10**8) and len(stamps) == 30 and stamps == sorted(stamps)
    rows = foreign_bags.in_order([Foreign("/a", count=30)])
    monkeypatch.setattr(
        foreign_bags, "in_order", lambda _: [(place, stamp % 2**64, data) for place, stamp, data in rows]
    )
    for file in (
        make_mcap(tmp_path / "in.mcap", [Foreign("/a", count=30)]),
        unclosed(tmp_path / "k.mcap", [Foreign("/a")]),
    ):
        assert [one.stamp_ns for one in read_bag(file)] == stamps


def test_a_bare_file_has_the_hashes_of_its_types(tmp_path: Path) -> None:
    digest = "RIHS01_" + "ab" * 32
    text = MessageDefinition(MessageDefinitionFormat.MSG, "int32 data\n")
    info = TopicInfo("/a", "my_msgs/msg/X", (Qos(),))
    recorder = BagRecorder(tmp_path / "in", "mcap", {}, lambda *_: None)
    recorder.write(recorder.copy(RecordedTopic(info, "/a", text, digest, ())), 1, b"\0\1\0\0\1\0\0\0")
    recorder.close()
    (file,) = (tmp_path / "in").glob("*.mcap")
    assert bag_contents(tmp_path / "in").topics["/a"].digest == digest
    assert bag_contents(shutil.copy(file, tmp_path / "bare.mcap")).topics["/a"].digest == digest
    with Reader(tmp_path / "in") as reader:
        assert [bytes(data) for _, _, data in reader.messages()] == [b"\0\1\0\0\1\0\0\0"]


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_compressed_bags_with_and_without_metadata(tmp_path: Path, storage: str, mode: CompressionMode) -> None:
    writer = Writer(tmp_path / "in", version=8, storage_plugin=StoragePlugin[storage.upper()])
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        channel = writer.add_connection(
            "/a", "std_msgs/msg/String", msgdef="string data\n", rihs01="RIHS01_" + "0" * 64
        )
        for number, payload in enumerate(Foreign("/a").payloads):
            writer.write(channel, number, payload)
    (file,) = [file for file in (tmp_path / "in").iterdir() if file.suffix != ".yaml"]
    for path in (tmp_path / "in", file):
        assert [one.payload for one in read_bag(path)] == Foreign("/a").payloads
    (tmp_path / "in" / "metadata.yaml").unlink()
    assert [one.payload for one in read_bag(tmp_path / "in")] == Foreign("/a").payloads


def test_a_bag_of_ros_1_is_told_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "in.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(99))
    with pytest.raises(
        BagError, match=r"is of ROS 1; make one of ROS 2 of it: rosbags-convert --src .*in\.bag --dst in$"
    ):
        counts(tmp_path / "in.bag")


def test_an_empty_file_beside_a_log_is_refused_and_the_log_stays(tmp_path: Path) -> None:
    path = crashed(tmp_path / "in.db3", [Foreign("/a")], [Foreign("/a")])
    path.write_bytes(b"")
    before = listing(tmp_path)
    with pytest.raises(BagError, match=r"in\.db3"):
        counts(path)
    assert listing(tmp_path) == before


def test_a_write_that_was_broken_off_is_refused_by_name(tmp_path: Path) -> None:
    path = broken_off(tmp_path / "in.db3", [Foreign("/a", count=500)])
    before = listing(tmp_path)
    assert (tmp_path / "in.db3-journal").read_bytes().strip(b"\0")
    with pytest.raises(BagError, match=r"in\.db3: a write was broken off, and in\.db3-journal is needed"):
        counts(path)
    assert listing(tmp_path) == before


def test_messages_of_no_topic_are_said(tmp_path: Path) -> None:
    path = make_sqlite(tmp_path / "in.db3", [Foreign("/a"), Foreign("/b")])
    with sqlite3.connect(path) as database:
        database.execute("DELETE FROM topics WHERE name = '/b'")
    assert counts(path) == {"/a": 10}
    assert bag_contents(path).differences == (f"{path}: of 20 messages 10 are of a topic that it names",)


def test_a_chunk_without_a_message_index_is_read(tmp_path: Path) -> None:
    path = make_mcap(tmp_path / "in.mcap", [Foreign("/a", count=30), Foreign("/b", count=7)], message_index=False)
    assert counts(path) == {"/a": 30, "/b": 7}
    assert counts(make_folder(tmp_path / "in", [path], [Foreign("/a", count=30), Foreign("/b", count=7)])) == {
        "/a": 30,
        "/b": 7,
    }


@pytest.mark.parametrize(("miscounted", "message_index"), [(3, True), (3, False)])
def test_an_index_that_counts_more_is_an_error(tmp_path: Path, miscounted: int, message_index: bool) -> None:
    path = make_mcap(tmp_path / "in.mcap", [Foreign("/a")], miscounted=miscounted, message_index=message_index)
    with pytest.raises(BagError, match="10 messages of /a were read, and its index counts 13"):
        counts(path)
    bag = BagMiddleware(path=path, speed=0)
    bag.subscribe("/a", "std_msgs/msg/String", Qos(), lambda _: None)
    bag.start()
    wait_for(lambda: bag.finished, "end")
    bag.close()
    assert bag.counters["bag_failed"] == 1


def test_an_index_that_counts_fewer_is_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert counts(make_mcap(tmp_path / "in.mcap", [Foreign("/a")], miscounted=-4)) == {"/a": 10}
    assert "10 messages of /a were read, and its index counts 6" in caplog.text


def test_a_topic_of_metadata_yaml_without_messages_is_a_topic(tmp_path: Path) -> None:
    file = make_mcap(tmp_path / "in.mcap", [Foreign("/a")])
    path = make_folder(tmp_path / "in", [file], [Foreign("/a"), Foreign("/quiet", count=0, qos=qos(profile(depth=3)))])
    assert {info.topic: info.publishers[0].depth for info in bag_topics(path)} == {"/a": 10, "/quiet": 3}
    assert not bag_contents(path).remarks


def test_a_history_that_is_not_known_has_the_default_depth(tmp_path: Path) -> None:
    depths = {"/unknown": (3, 0, 10), "/all": (2, 0, 0), "/last": (1, 4, 4), "/default": (0, 0, 10), "/told": (3, 6, 6)}
    topics = [Foreign(name, qos=qos(profile(history, depth))) for name, (history, depth, _) in depths.items()]
    found = bag_topics(make_mcap(tmp_path / "in.mcap", topics))
    assert {info.topic: info.publishers[0].depth for info in found} == {name: row[2] for name, row in depths.items()}


def test_a_middleware_refuses_what_cannot_be_carried_and_plays_the_rest(tmp_path: Path) -> None:
    path = make_sqlite(tmp_path / "in.db3", [Foreign("/x"), Foreign("/x", "std_msgs/msg/Int32"), Foreign("chatter")])
    received: list[bytes] = []
    with BagMiddleware(path=path, speed=0) as bag:
        assert [info.topic for info in bag.discover()] == ["/chatter"]
        with pytest.raises(ConfigError, match=r"/x cannot be carried: it is recorded with the types"):
            bag.subscribe("/x", "std_msgs/msg/String", Qos(), received.append)
        bag.subscribe("/chatter", "std_msgs/msg/String", Qos(), received.append)
        bag.start()
        wait_for(lambda: bag.finished, "end")
    assert received == Foreign("chatter").payloads


def test_a_name_without_msg_is_the_same_type(tmp_path: Path) -> None:
    path = make_sqlite(tmp_path / "in.db3", [Foreign("/a", "std_msgs/String"), Foreign("/a", start=10)])
    assert [(info.topic, info.type_name) for info in bag_topics(path)] == [("/a", "std_msgs/msg/String")]
    assert counts(path) == {"/a": 20}


def test_definitions_are_compared_by_what_they_define() -> None:
    text = definition("sensor_msgs/msg/Range").text
    assert same_type("sensor_msgs/msg/Range", text, f"# newer comment\n{text}")
    assert not same_type("sensor_msgs/msg/Range", text, text.replace("float32 range", "float64 range"))
    assert same_type("a/msg/B", "wstring x\n", "wstring x\n")
    assert not same_type("a/msg/B", "wstring x\n", "wstring y\n")
    assert text_hash("a/msg/B", "B b\n") == ""
