"""Recordings through a link into recordings."""

from __future__ import annotations

import random
import struct
from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader

from gr_ros2.core.errors import BagError, ConfigError
from gr_ros2.middleware.bag_files import bag_definitions, bag_topics, read_bag
from gr_ros2.middleware.bag_recorder import BagRecorder
from gr_ros2.middleware.base import Qos
from gr_ros2.wire import FORMATS
from gr_ros2_lab.medium import loss_table
from gr_ros2_lab.run.replay import Replayed, replay
from gr_ros2_lab.run.scenario import Scenario, load_scenario
from tests.compression.support import Writer
from tests.e2e.support import check_books
from tests.recordings import Drive, every_drive

START_NS = 1_700_000_000_123_456_789
STEP_NS = 20_000_001
COUNT = 60
CUSTOM = "uint8[] data\nmy_msgs/Inner inner\n================\nMSG: my_msgs/Inner\nint32 x\n"
OFFERED = Qos("best_effort", "volatile", 5)


def make_bag(path: Path, topics: dict[str, str], storage: str = "mcap") -> Path:
    """One message of 40 B on each topic every 20 ms."""
    recorder = BagRecorder(path, storage, {"my_msgs/msg/Blob": CUSTOM}, lambda *_: None)
    channels = [recorder.channel(name, kind, OFFERED) for name, kind in topics.items()]
    for number in range(COUNT):
        for place, channel in enumerate(channels):
            payload = b"\0\1\0\0" + struct.pack("<II", number, place) + bytes(28)
            recorder.write(channel, START_NS + number * STEP_NS + place, payload)
    recorder.close()
    return path


def scenario(*overrides: str) -> Scenario:
    return load_scenario("paper-ofdm-paced", ["packet_len=64", *overrides], duration_s=0.0, source="bag:none")


def run(source: Path, target: Path, *overrides: str, topics: tuple[str, ...] = ()) -> Replayed:
    return replay(source, target, scenario(*overrides), topics)


@pytest.fixture
def blobs(tmp_path: Path) -> Path:
    return make_bag(tmp_path / "in", {"/robot_9/blob": "my_msgs/msg/Blob", "/status": "my_msgs/msg/Blob"})


@pytest.mark.parametrize("name", ["out.mcap", "out.db3", "out"])
def test_a_bag_comes_out_as_it_went_in_but_for_the_time(tmp_path: Path, blobs: Path, name: str) -> None:
    done = run(blobs, tmp_path / name)
    check_books(done.outcome.result)
    assert done.carried == ("/robot_9/blob", "/status")
    assert done.left_out == ()
    sent, received = list(read_bag(blobs)), list(read_bag(tmp_path / name))
    assert len(received) == 2 * COUNT
    for topic in done.carried:
        before, after = ([one for one in bag if one.topic == topic] for bag in (sent, received))
        assert [one.payload for one in before] == [one.payload for one in after]
        delays = [(b.stamp_ns - a.stamp_ns) * 1e-9 for a, b in zip(before, after, strict=True)]
        assert min(delays) > 0.99 * done.outcome.result.phy["airtime_s"]
    assert [one.stamp_ns for one in received] == sorted(one.stamp_ns for one in received)
    assert bag_topics(tmp_path / name) == bag_topics(blobs)
    assert bag_topics(tmp_path / name)[0].publishers == (OFFERED,)
    assert bag_definitions(tmp_path / name) == bag_definitions(blobs)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["in", name])


def test_mcap_keeps_the_original_time_as_publish_time(tmp_path: Path, blobs: Path) -> None:
    run(blobs, tmp_path / "out.mcap", "channel.packet_loss=0.3", "repair='off'")
    original = {one.payload: one.stamp_ns for one in read_bag(blobs)}
    received = list(read_bag(tmp_path / "out.mcap"))
    assert 0 < len(received) < 2 * COUNT
    data = (tmp_path / "out.mcap").read_bytes()
    for one in received:  # log_time and publish_time stand side by side before the payload
        assert data.count(struct.pack("<QQ", one.stamp_ns, original[one.payload]) + one.payload) == 1


def test_equal_seeds_give_the_same_file_and_others_another(tmp_path: Path, blobs: Path) -> None:
    noise = ("channel.snr_db=12.5",)
    first, again, other = (tmp_path / f"{name}.mcap" for name in ("first", "again", "other"))
    for target, seed in ((first, 1), (again, 1), (other, 2)):
        run(blobs, target, *noise, f"seed={seed}")
    assert list(read_bag(first)) == list(read_bag(again)) != list(read_bag(other))


def test_the_scenarios_registry_chooses_where_it_fits(tmp_path: Path, blobs: Path) -> None:
    registry = tmp_path / "mine.csv"
    registry.write_text("/status,my_msgs/msg/Blob\n/other,std_msgs/msg/String\n")
    done = run(blobs, tmp_path / "out.mcap", f"registry={registry}")
    assert (done.carried, done.left_out) == (("/status",), ("/robot_9/blob",))
    done = run(blobs, tmp_path / "named.mcap", f"registry={registry}", topics=("/robot_9/blob",))
    assert (done.carried, done.left_out) == (("/robot_9/blob",), ("/status",))
    registry.write_text("/status,std_msgs/msg/String\n")
    with pytest.raises(ConfigError, match=r"/status is my_msgs/msg/Blob, in the registry std_msgs/msg/String"):
        run(blobs, tmp_path / "wrong.mcap", f"registry={registry}")
    assert not (tmp_path / "wrong.mcap").exists()


def test_options_of_a_topic_go_with_it_into_a_registry_made_of_the_recording(tmp_path: Path) -> None:
    source = make_bag(tmp_path / "in", {"/robot_1/odom": "my_msgs/msg/Blob", "/status": "my_msgs/msg/Blob"})
    options = "topics={odom: {max_rate: 10}}"
    both = ("/robot_1/odom", "/status")
    done = run(source, tmp_path / "out.mcap", options, topics=both)
    sent = {topic.topic: topic.delivered for topic in done.outcome.result.topics}
    assert sent["/status"] == COUNT
    assert sent["/robot_1/odom"] < COUNT / 2


@pytest.mark.parametrize("version", [0, 1])
def test_more_topics_than_a_link_carries_have_to_be_chosen(tmp_path: Path, version: int) -> None:
    most, settings = FORMATS[version].max_topics, ("paper={}", "paper=null")[version]
    source = make_bag(tmp_path / "in", {f"/t{number}": "my_msgs/msg/Blob" for number in range(most + 1)})
    with pytest.raises(ConfigError, match=rf"has {most + 1} topics, and a link carries {most}; choose with --topics"):
        run(source, tmp_path / "out.mcap", settings)
    assert len(run(source, tmp_path / "out.mcap", settings, topics=("/t3", f"/t{most}")).carried) == 2


@pytest.mark.parametrize("compression", [False, True])
def test_compression_clears_alignment_gaps_and_nothing_else(tmp_path: Path, *, compression: bool) -> None:
    kind = "geometry_msgs/msg/PointStamped"
    messages = [Writer(random.Random(seed)).message(kind) for seed in range(COUNT)]
    messages = [one for one in messages if len(one[0]) < 100]
    assert any(payload != clean for payload, clean in messages)
    recorder = BagRecorder(tmp_path / "in", "mcap", {}, lambda *_: None)
    channel = recorder.channel("/point", kind, OFFERED)
    for number, (payload, _) in enumerate(messages):
        recorder.write(channel, START_NS + number * 10 * STEP_NS, payload)
    recorder.close()
    run(tmp_path / "in", tmp_path / "out.mcap", f"compression={str(compression).lower()}")
    assert [one.payload for one in read_bag(tmp_path / "out.mcap")] == [one[compression] for one in messages]


@pytest.mark.parametrize("size", [40, 1000])
def test_a_sparse_recording_arrives_at_the_rate_that_is_chosen_for_it(tmp_path: Path, size: int) -> None:
    """Two messages in a quarter of an hour: at their average rate a packet takes minutes, the last for ever."""
    recorder = BagRecorder(tmp_path / "in", "mcap", {"my_msgs/msg/Blob": CUSTOM}, lambda *_: None)
    channel = recorder.channel("/blob", "my_msgs/msg/Blob", OFFERED)
    for number in range(2):
        recorder.write(channel, START_NS + number * 900 * 10**9, b"\0\1\0\0" + (36).to_bytes(4, "little") + bytes(size))
    recorder.close()
    settings = load_scenario("paper-ofdm", ["phy.sample_rate=auto", "drain_s=2"], duration_s=0.0, source="bag:none")
    done = replay(tmp_path / "in", tmp_path / "out.mcap", settings, ("/blob",))
    check_books(done.outcome.result)
    sent, received = list(read_bag(tmp_path / "in")), list(read_bag(tmp_path / "out.mcap"))
    assert len(received) == 2
    assert all(after.stamp_ns - before.stamp_ns < 1e9 for before, after in zip(sent, received, strict=True))


def test_an_error_about_many_topics_is_short(tmp_path: Path) -> None:
    most = FORMATS[1].max_topics
    source = make_bag(tmp_path / "in", {f"/t{number}": "my_msgs/msg/Blob" for number in range(most + 1)})
    for topics in (("/nope",), ()):
        with pytest.raises(ConfigError, match=rf"/t0, /t1, /t10, .*, and {most - 9} more$"):
            run(source, tmp_path / "out.mcap", topics=topics)


def test_what_cannot_be_is_said_and_leaves_nothing(tmp_path: Path, blobs: Path) -> None:
    with pytest.raises(ConfigError, match=r"topics = '/nope': .* has /robot_9/blob, /status"):
        run(blobs, tmp_path / "out.mcap", topics=("/nope",))
    with pytest.raises(BagError, match="no such file"):
        run(tmp_path / "nothing", tmp_path / "out.mcap")
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(bytes(2000))
    with pytest.raises(BagError, match="neither an MCAP nor"):
        run(damaged, tmp_path / "out.mcap")
    with pytest.raises(BagError, match="exists already"):
        run(blobs, damaged)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["damaged.mcap", "in"]


@every_drive
def test_a_drive_opens_with_other_readers_and_keeps_its_stamps(
    drive: Drive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(loss_table, "PACKETS", 50)
    settings = load_scenario("demo", ["time=packets"], duration_s=10.0, source=f"bag:{drive.path}")
    done = replay(drive.path, tmp_path / "out.mcap", settings, drive.names)
    check_books(done.outcome.result)
    with AnyReader([tmp_path / "out.mcap"]) as reader:
        seen = dict.fromkeys(done.carried, 0)
        for connection, stamp_ns, payload in reader.messages():
            stamp = reader.deserialize(payload, connection.msgtype).header.stamp
            assert stamp.sec * 10**9 + stamp.nanosec < stamp_ns
            seen[connection.topic] += 1
    assert seen == {topic.topic: topic.delivered for topic in done.outcome.result.topics}
    assert all(seen.values())
