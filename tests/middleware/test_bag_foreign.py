"""Files as other programs write and leave them: read to the last message, and not touched."""

from __future__ import annotations

import shutil
import sqlite3
from collections import Counter
from pathlib import Path

import pytest

from gr_ros2.core.errors import BagError, ConfigError
from gr_ros2.middleware import Qos
from gr_ros2.middleware.bag import BagMiddleware
from gr_ros2.middleware.bag_files import bag_contents, bag_topics, read_bag
from gr_ros2.middleware.type_definitions import definition, same_type, text_hash
from tests.middleware.foreign_bags import (
    Foreign,
    broken_off,
    crashed,
    listing,
    make_folder,
    make_mcap,
    make_sqlite,
    profile,
    qos,
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


def test_a_folder_without_metadata_names_its_files(tmp_path: Path) -> None:
    crashed(tmp_path / "in.db3", [Foreign("/a")], [Foreign("/a")])
    with pytest.raises(BagError, match=r"has no metadata\.yaml, .* \(in\.db3\)"):
        counts(tmp_path)


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
