from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.middleware import Qos
from gr_ros2.middleware.bag import BagMiddleware
from gr_ros2.settings.config import build
from gr_ros2_lab.race.race_settings import RaceSettings, check, conditions, read_recordings


def write_bag(path: Path, topics: dict[str, list[bytes]], step_s: float = 0.1) -> str:
    with BagMiddleware(path=path, mode="write") as bag:
        for topic, payloads in topics.items():
            publisher = bag.advertise(topic, "std_msgs/msg/String", Qos())
            for number, payload in enumerate(payloads):
                publisher.publish_at(payload, 1_000_000_000 + round(number * step_s * 1e9))
    return f"bag:{path}"


def text(number: int, size: int = 40) -> bytes:
    body = f"{number:>{size}}".encode()
    return b"\0\1\0\0" + (size + 1).to_bytes(4, "little") + body + b"\0"


def test_the_simulated_recording_is_odometry_at_35_hz_and_the_same_each_time(tmp_path: Path) -> None:
    settings = RaceSettings(duration_s=2)
    (recording,) = read_recordings(settings, tmp_path / "a")
    assert recording.topic == "/robot_1/odom"
    assert recording.type_name == "nav_msgs/msg/Odometry"
    assert len(recording.payloads) == 70
    assert recording.hz == pytest.approx(35, rel=1e-3)
    assert {len(payload) for payload in recording.payloads} == {recording.largest} == {724}
    assert read_recordings(settings, tmp_path / "b") == [replace(recording, path=tmp_path / "b/recording")]


def test_the_sample_rate_follows_from_the_load_and_the_load_from_the_sample_rate(tmp_path: Path) -> None:
    (recording,) = read_recordings(RaceSettings(duration_s=1), tmp_path)
    heavy, light = 2.0, 0.5
    found = conditions(RaceSettings(load=(heavy, light), loss=(0.2, 0.0)), [recording])
    assert [(each.load, each.loss) for each in found] == [(light, 0.0), (light, 0.2), (heavy, 0.0), (heavy, 0.2)]
    # 741 bytes with CRC-32 in 48 BPSK carriers are 124 symbols; 3 more, of 80 samples each, and a gap of 32.
    assert found[0].sample_rate * light == pytest.approx(35 * (127 * 80 + 32), rel=1e-3)
    assert found[2].sample_rate * heavy == pytest.approx(found[0].sample_rate * light)
    (fixed,) = conditions(RaceSettings(sample_rate=found[2].sample_rate, loss=(0.0,)), [recording])
    assert fixed.load == pytest.approx(heavy)


def test_robots_of_a_team_have_recordings_of_their_own_and_share_the_air(tmp_path: Path) -> None:
    settings = RaceSettings(robots=3, duration_s=1, loss=(0.0,), load=(1.0,))
    team = read_recordings(settings, tmp_path / "a")
    assert [recording.topic for recording in team] == ["/robot_1/odom", "/robot_2/odom", "/robot_3/odom"]
    assert min(recording.phase_s for recording in team) == 0
    assert len({recording.phase_s for recording in team}) == 3
    (all_of_them,), (one,) = conditions(settings, team), conditions(settings, team[:1])
    assert all_of_them.sample_rate == pytest.approx(3 * one.sample_rate, rel=1e-2)
    source = write_bag(tmp_path / "bag", {"/a": [text(n) for n in range(50)]})
    same = read_recordings(RaceSettings(robots=4, source=source), tmp_path)
    assert [recording.phase_s for recording in same] == pytest.approx([0, 0.025, 0.05, 0.075])


def test_of_a_bag_the_named_topic_is_taken_for_as_long_as_asked(tmp_path: Path) -> None:
    source = write_bag(tmp_path / "bag", {"/a": [text(n) for n in range(50)], "/b": [text(n) for n in range(9)]})
    (recording,) = read_recordings(RaceSettings(source=source, bag_topic="/a", duration_s=2), tmp_path)
    assert (recording.topic, recording.type_name) == ("/a", "std_msgs/msg/String")
    assert recording.payloads == tuple(text(n) for n in range(20))
    assert recording.hz == pytest.approx(10)


@pytest.mark.parametrize(
    ("topics", "topic", "problem"),
    [
        ({"/a": [text(1), text(2)], "/b": [text(1)]}, "auto", r"topic = 'auto': name one that .* has: /a, /b"),
        ({"/a": [text(1), text(2)]}, "/c", r"topic = '/c': name one that .* has: /a"),
        ({"/a": [text(1)]}, "/a", "/a has 1 messages in 15 s; 2 are needed"),
        ({"/a": [text(1, 2000), text(2, 2000)]}, "/a", "messages of 2009 B; the race takes up to 1300 B"),
    ],
)
def test_a_bag_that_cannot_race_is_refused(
    tmp_path: Path, topics: dict[str, list[bytes]], topic: str, problem: str
) -> None:
    source = write_bag(tmp_path / "bag", topics)
    with pytest.raises(ConfigError, match=problem):
        read_recordings(RaceSettings(source=source, bag_topic=topic), tmp_path)


@pytest.mark.parametrize(
    ("values", "problem"),
    [
        ({"peers": ("nobody",)}, "peers = 'nobody': no such contender"),
        ({"source": "bag:"}, "the path of the bag is missing"),
        ({"source": "x.mcap"}, "source = 'x.mcap': write sim or bag:PATH"),
        ({"loss": (1.5,)}, "loss.0 = 1.5: must be less than or equal to 1"),
        ({"load": ()}, "load"),
        ({"robots": 11}, "robots = 11: must be less than or equal to 10"),
        ({"robots": 3, "peers": ("gr-ros2-v0",)}, "peers = 'gr-ros2-v0': no such contender"),
        ({"packet_len": 3}, "packet_len = 3"),
        ({"laps": 3}, "unknown key laps"),
    ],
)
def test_wrong_settings_are_named(values: dict[str, object], problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        check(build(RaceSettings, values, "race"))
