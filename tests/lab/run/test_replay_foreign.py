"""Recordings of other programs through a link: all of it arrives as it was, or what does not is said."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from gr_ros2.cli.main import run as command
from gr_ros2.core.errors import BagError, ConfigError
from gr_ros2.middleware.bag_files import bag_definitions, bag_topics, read_bag
from gr_ros2.middleware.type_definitions import UNKNOWN, definition
from gr_ros2_lab.run.replay import Replayed, replay
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import load_scenario
from tests.middleware import foreign_bags
from tests.middleware.foreign_bags import (
    Foreign,
    crashed,
    make_folder,
    make_mcap,
    make_sqlite,
    profile,
    qos,
    without_qos,
)

RANGE = "sensor_msgs/msg/Range"
NEWER_RANGE = definition(RANGE).text.replace("float32 range\n", "float32 range\nfloat32 variance\n")
"""As it is since Iron, where Humble's ends with the range."""
OTHER = "std_msgs/msg/Int32"
SERVICE = Foreign("/add/_service_event", "example_interfaces/srv/AddTwoInts_Event")
FEEDBACK = Foreign("/fib/_action/feedback", "example_interfaces/action/Fibonacci_FeedbackMessage")


def run(source: Path, target: Path, topics: Sequence[str] = ()) -> Replayed:
    return replay(source, target, load_scenario("paper-direct", duration_s=0.0, source="bag:none"), topics)


def counts(path: Path) -> dict[str, int]:
    return dict(Counter(message.topic for message in read_bag(path)))


def make(storage: str, path: Path, topics: Sequence[Foreign]) -> Path:
    if storage == "mcap":
        return make_mcap(path.with_suffix(".mcap"), topics)
    return make_sqlite(path.with_suffix(".db3"), topics, version=4)


def recorded_profiles(folder: Path) -> dict[str, Any]:
    """The QoS of every topic as metadata.yaml has it."""
    information = yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    topics = [row["topic_metadata"] for row in information["topics_with_message_count"]]
    return {topic["name"]: yaml.safe_load(topic["offered_qos_profiles"]) for topic in topics}


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_bags_own_definition_of_a_type_counts(tmp_path: Path, storage: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert definition(RANGE).text != NEWER_RANGE
    source = make(storage, tmp_path / "in", [Foreign("/sonar", RANGE, text=NEWER_RANGE)])
    pauses: list[float] = []
    monkeypatch.setattr(time, "sleep", pauses.append)
    run(source, tmp_path / "out")
    assert pauses == [], "nothing waits for two ends that differ in the type"
    assert bag_definitions(tmp_path / "out") == {RANGE: NEWER_RANGE}
    assert counts(tmp_path / "out") == {"/sonar": 10}
    digest = definition(RANGE, NEWER_RANGE).digest
    assert digest in (tmp_path / "out" / "metadata.yaml").read_text()
    assert digest != definition(RANGE).digest


def test_a_definition_that_cannot_be_read_here_is_copied_as_it_is(tmp_path: Path) -> None:
    topics = [
        Foreign("/wide", "my_msgs/msg/Wide", text="wstring text\n"),
        Foreign("/self", "my_msgs/msg/Self", text="my_msgs/Self self\n"),
        Foreign("/known_to_nobody", "my_msgs/msg/Lost", encoding="unknown"),
    ]
    run(make_mcap(tmp_path / "in.mcap", topics), tmp_path / "out")
    texts = {
        "my_msgs/msg/Wide": "wstring text\n",
        "my_msgs/msg/Self": "my_msgs/Self self\n",
        "my_msgs/msg/Lost": UNKNOWN,
    }
    assert bag_definitions(tmp_path / "out") == texts


def test_an_idl_definition_stays_one(tmp_path: Path) -> None:
    text = f"{'=' * 80}\nIDL: my_msgs/msg/Blob\nmodule my_msgs {{ module msg {{ struct Blob {{ long x; }}; }}; }};\n"
    source = make_mcap(tmp_path / "in.mcap", [Foreign("/blob", "my_msgs/msg/Blob", text=text, encoding="ros2idl")])
    run(source, tmp_path / "out")
    data = next((tmp_path / "out").glob("*.mcap")).read_bytes()
    assert text.encode() in data
    assert b"ros2idl" in data


def test_a_bag_without_definitions_gets_ros_definition_only_where_its_hash_agrees(tmp_path: Path) -> None:
    nobodys = NEWER_RANGE.replace("float32 variance\n", "float32 variance\nfloat32 drift\n")
    digest = definition(RANGE, nobodys).digest
    older = make_sqlite(tmp_path / "older.db3", [Foreign("/sonar", RANGE)])
    run(older, tmp_path / "out_older")
    assert bag_definitions(tmp_path / "out_older") == {RANGE: definition(RANGE).text}
    newer = make_sqlite(tmp_path / "newer.db3", [Foreign("/sonar", RANGE, digest=digest)], version=4)
    run(newer, tmp_path / "out_newer")
    assert bag_definitions(tmp_path / "out_newer") == {RANGE: UNKNOWN}
    assert digest in (tmp_path / "out_newer" / "metadata.yaml").read_text()


def test_a_run_writes_the_recordings_definitions_too(tmp_path: Path) -> None:
    source = make_mcap(tmp_path / "in.mcap", [Foreign("/sonar", RANGE, text=NEWER_RANGE)])
    registry = tmp_path / "registry.csv"
    registry.write_text(f"/sonar,{RANGE}\n")
    for time_ in ("packets", "real"):
        overrides = [
            f"registry={registry}",
            f"time={time_}",
            "graph.middleware=memory",
        ]
        run_scenario(load_scenario("paper-direct", overrides, duration_s=0.0, source=f"bag:{source}"), tmp_path / time_)
        assert bag_definitions(tmp_path / time_ / "delivered")[RANGE] == NEWER_RANGE


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("where", ["metadata.yaml alone", "storage alone", "both, differently"])
def test_no_topic_is_lost_to_a_qos_that_stands_twice(tmp_path: Path, storage: str, where: str) -> None:
    """rosbag2's own talker bags are of the first kind: 20 messages of which none were found."""
    unknown = qos(profile(history=3, depth=0))
    topics = [Foreign("/scan", count=357, qos=unknown), Foreign("/odom", count=20, qos=unknown)]
    file = make(storage, tmp_path / "talker", without_qos(topics) if where == "metadata.yaml alone" else topics)
    other = [replace(topic, qos=qos(profile(depth=7))) for topic in topics]
    claimed = {"metadata.yaml alone": topics, "storage alone": without_qos(topics), "both, differently": other}[where]
    source = make_folder(tmp_path / "in", [file], claimed)
    done = run(source, tmp_path / "out")
    assert done.carried == ("/odom", "/scan")
    assert counts(tmp_path / "out") == {"/scan": 357, "/odom": 20}
    expected = [profile(history=3, depth=0)]
    assert recorded_profiles(tmp_path / "out") == {"/odom": expected, "/scan": expected}


@pytest.mark.parametrize("name", ["out", "out.mcap", "out.db3"])
def test_a_recording_from_before_1970_begins_then(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setattr(foreign_bags, "START_NS", -(10**18))
    source = make_sqlite(tmp_path / "in.db3", [Foreign("/a", count=20)])
    run(source, tmp_path / name)
    sent, received = list(read_bag(source)), list(read_bag(tmp_path / name))
    assert [one.payload for one in received] == [one.payload for one in sent]
    assert received[0].stamp_ns >= 0
    assert received[-1].stamp_ns - received[0].stamp_ns == pytest.approx(sent[-1].stamp_ns - sent[0].stamp_ns, abs=1e6)


def test_counts_that_differ_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    topics = [Foreign("/a", count=20), Foreign("/b", count=10)]
    claimed = [Foreign("/a", count=12), Foreign("/b", count=10), Foreign("/c", count=5)]
    source = make_folder(tmp_path / "in", [make_sqlite(tmp_path / "file.db3", topics)], claimed)
    assert command(["replay", str(source), str(tmp_path / "out"), "--scenario", "paper-direct"]) == 0
    printed = capsys.readouterr().out
    assert "metadata.yaml counts 12 messages of /a, the files have 20" in printed
    assert "metadata.yaml counts 5 messages of /c, the files have 0" in printed
    assert "messages of /b" not in printed
    assert counts(tmp_path / "out") == {"/a": 20, "/b": 10}


def test_a_wrong_total_is_said_in_a_run_too(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    topics = [Foreign("/a", count=20)]
    source = make_folder(tmp_path / "in", [make_sqlite(tmp_path / "file.db3", topics)], topics, message_count=33)
    registry = tmp_path / "registry.csv"
    registry.write_text("/a,std_msgs/msg/String\n")
    for time_ in ("packets", "real"):
        caplog.clear()
        overrides = [
            f"registry={registry}",
            f"time={time_}",
            "graph.middleware=memory",
        ]
        with caplog.at_level(logging.WARNING):
            scenario = load_scenario("paper-direct", overrides, duration_s=0.0, source=f"bag:{source}")
            run_scenario(scenario, tmp_path / time_)
        assert "metadata.yaml counts 33 messages, the files have 20" in caplog.text


def test_fewer_messages_than_the_index_counts_are_an_error(tmp_path: Path) -> None:
    source = make_mcap(tmp_path / "in.mcap", [Foreign("/a", count=20)], miscounted=7)
    with pytest.raises(BagError, match=r"in.mcap: 20 messages of /a were read, and its index counts 27"):
        run(source, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_a_crash_left_in_the_write_ahead_log_is_carried(tmp_path: Path) -> None:
    source = crashed(tmp_path / "in.db3", [Foreign("/a", count=100, start=100)], [Foreign("/a", count=100)])
    run(source, tmp_path / "out")
    assert counts(tmp_path / "out") == {"/a": 200}


@pytest.mark.parametrize("chosen", [(), ("/chatter",)])
def test_a_relative_topic_name_works_and_stays(tmp_path: Path, chosen: tuple[str, ...]) -> None:
    source = make_sqlite(tmp_path / "in.db3", [Foreign("chatter"), Foreign("/a")])
    done = run(source, tmp_path / "out", chosen)
    assert "/chatter" in done.carried
    assert counts(tmp_path / "out")["/chatter"] == 10
    assert "chatter" in recorded_profiles(tmp_path / "out")
    assert "/chatter" not in recorded_profiles(tmp_path / "out")


@pytest.mark.parametrize("name", ["chatter", "/chatter"])
def test_topics_of_the_command_line_find_a_relative_name(tmp_path: Path, name: str) -> None:
    source = make_sqlite(tmp_path / "in.db3", [Foreign("chatter"), Foreign("/a")])
    arguments = ["replay", str(source), str(tmp_path / "out"), "--scenario", "paper-direct", "--topics", name]
    assert command(arguments) == 0
    assert counts(tmp_path / "out") == {"/chatter": 10}


MIXED: dict[str, tuple[list[Foreign], str]] = {
    "two types": ([Foreign("/x"), Foreign("/x", OTHER, count=50)], "types std_msgs/msg/String and std_msgs/msg/Int32"),
    "two definitions": (
        [
            Foreign("/a_sonar", RANGE, text=NEWER_RANGE, digest="RIHS01_newer"),
            Foreign("/x", RANGE, text=definition(RANGE).text, digest="RIHS01_older"),
        ],
        "several definitions of sensor_msgs/msg/Range, and the one of /a_sonar counts",
    ),
    "two names": ([Foreign("x"), Foreign("/x")], "names x and /x"),
    "a name ROS does not know": ([Foreign("/ro-bot/x")], "'/ro-bot/x' is no name of a ROS topic"),
    "a service": ([SERVICE], "example_interfaces/srv/AddTwoInts_Event belongs to a service or an action"),
    "an action": ([FEEDBACK], "belongs to a service or an action"),
    "another serialization": ([Foreign("/x", serialization="json")], "serialized as 'json'"),
    "no type": ([Foreign("/x", "Thing")], "'Thing' is no type of a ROS message"),
}


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("kind", MIXED)
def test_one_topic_that_cannot_be_carried_is_left_out_and_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], storage: str, kind: str
) -> None:
    topics, why = MIXED[kind]
    source = make(storage, tmp_path / "in", [Foreign("/odom"), *topics])
    assert command(["replay", str(source), str(tmp_path / "out"), "--scenario", "paper-direct"]) == 0
    printed = capsys.readouterr().out
    name = f"/{topics[-1].name.lstrip('/')}"
    assert f"{name} is left out: " in printed
    assert why in printed
    assert set(counts(tmp_path / "out")) == {"/odom", *(topic.name for topic in topics if topic.name == "/a_sonar")}
    assert {info.topic: info.type_name for info in bag_topics(tmp_path / "out")}["/odom"] == "std_msgs/msg/String"
    with pytest.raises(ConfigError, match="cannot be carried"):
        run(source, tmp_path / "chosen", (name,))


def test_a_bag_of_services_alone_is_refused_with_the_reason(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no topics that a link can carry; /add/_service_event is left out"):
        run(make_mcap(tmp_path / "in.mcap", [SERVICE]), tmp_path / "out")


@pytest.mark.parametrize("time_", ["packets", "samples", "real"])
def test_a_run_refuses_a_recorded_topic_of_another_type(tmp_path: Path, time_: str) -> None:
    registry = tmp_path / "registry.csv"
    registry.write_text("/x,std_msgs/msg/String\n")
    for name, topics in (("other", [Foreign("/x", OTHER)]), ("both", [Foreign("/x"), Foreign("/x", OTHER)])):
        source = make_mcap(tmp_path / f"{name}.mcap", topics)
        overrides = [
            f"registry={registry}",
            f"time={time_}",
            "graph.middleware=memory",
        ]
        scenario = load_scenario("paper-direct", overrides, duration_s=0.0, source=f"bag:{source}")
        with pytest.raises(ConfigError, match="Int32"):
            run_scenario(scenario)


@pytest.mark.parametrize("target", ["out", "out.mcap", "out.db3"])
def test_the_qos_of_every_publisher_survives(tmp_path: Path, target: str) -> None:
    three = [profile(depth=10), profile(depth=100, durability=1), profile(depth=100, durability=1)]
    unknown = [profile(history=3, depth=0, reliability=3)]
    topics = [Foreign("/tf", qos=qos(*three)), Foreign("/odom", qos=qos(*unknown)), Foreign("/none")]
    files = [
        make_sqlite(tmp_path / f"part_{number}.db3", [replace(topic, start=10 * number) for topic in topics])
        for number in range(3)
    ]
    claimed = [replace(topic, count=30) for topic in topics]
    source = make_folder(tmp_path / "in", files, claimed)
    run(source, tmp_path / target)
    assert bag_topics(tmp_path / target) == bag_topics(source)
    assert [offer.depth for offer in bag_topics(tmp_path / target)[2].publishers] == [10, 100, 100]
    if target == "out":
        assert recorded_profiles(tmp_path / target) == {"/tf": three, "/odom": unknown, "/none": None}
