"""`registry check` and `registry from-graph`."""

from __future__ import annotations

from pathlib import Path

import pytest

from gr_ros2.cli.main import run
from gr_ros2.cli.registry import registry_csv
from gr_ros2.errors import ConfigError
from gr_ros2.middleware import Qos, TopicInfo
from gr_ros2.registry import Registry
from tests.domains import domain
from tests.waiting import wait_for

LATCHED = Qos("reliable", "transient_local")
FOUND = [
    TopicInfo("/robot_1/odom", "nav_msgs/msg/Odometry", (Qos("reliable"),)),
    TopicInfo("/robot_1/tf_static", "tf2_msgs/msg/TFMessage", (LATCHED, LATCHED)),
    TopicInfo("/robot_1/cmd_vel", "geometry_msgs/msg/Twist", (), (Qos(),)),
    TopicInfo("/robot_2/odom", "nav_msgs/msg/Odometry", (Qos(), LATCHED)),
    TopicInfo("/rosout", "rcl_interfaces/msg/Log", (LATCHED,)),
]


def test_check_prints_rows_and_digest(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "r.csv"
    path.write_text("topic,type,qos\nodom,nav_msgs/Odometry,latency\nthing,my_msgs/Thing,\n")
    assert run(["registry", "check", str(path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert next(line for line in lines if "odom" in line).split() == [
        *("0", "odom", "nav_msgs/msg/Odometry", "Humble", "qos=latency"),
    ]
    assert next(line for line in lines if "thing" in line).split() == ["1", "thing", "my_msgs/msg/Thing", "unknown"]
    assert any("no known definition: my_msgs/msg/Thing" in line for line in lines)
    assert lines[-1] == f"digest {Registry.from_csv(path).digest}"


def test_check_names_file_and_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "r.csv"
    path.write_text("odom,nav_msgs/Odometry\nodom,nav_msgs/Odometry\n")
    assert run(["registry", "check", str(path)]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"gr-ros2: {path}")
    assert "'odom'" in error


def test_a_registry_of_a_namespace() -> None:
    text = "topic,type,durability\nodom,nav_msgs/msg/Odometry,\ntf_static,tf2_msgs/msg/TFMessage,transient_local\n"
    assert registry_csv(FOUND, "robot_1") == registry_csv(FOUND, "/robot_1/") == text


def test_a_registry_of_everything_published() -> None:
    rows = [line.split(",")[0] for line in registry_csv(FOUND, "").splitlines()]
    assert rows == ["topic", "robot_1/odom", "robot_1/tf_static", "robot_2/odom"]


def test_chosen_topics_keep_their_order() -> None:
    text = registry_csv(FOUND, "robot_1", ["tf_static", "/robot_1/odom"])
    assert [line.split(",")[0] for line in text.splitlines()[1:]] == ["tf_static", "odom"]
    assert registry_csv(FOUND, "", ["/robot_2/odom"]) == "topic,type\nrobot_2/odom,nav_msgs/msg/Odometry\n"


def test_what_is_written_can_be_read(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    path.write_text(registry_csv(FOUND, "robot_1"))
    odom, static = Registry.from_csv(path)
    assert odom.on_graph("robot_1") == "/robot_1/odom"
    assert (odom.latched, static.latched) == (False, True)


def test_what_cannot_become_a_registry() -> None:
    with pytest.raises(ConfigError, match="below /robot_7/ are no topics; is the robot running"):
        registry_csv(FOUND, "robot_7")
    with pytest.raises(ConfigError, match="topic 'scan' is not on the graph"):
        registry_csv(FOUND, "robot_1", ["scan"])
    many = [TopicInfo(f"/t{n:02}", "std_msgs/msg/String", (Qos(),)) for n in range(17)]
    with pytest.raises(ConfigError, match="17 topics, a registry has at most 16; choose with"):
        registry_csv(many, "")


def test_from_the_dds_graph(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    dds = pytest.importorskip("gr_ros2.middleware.dds")
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    out = tmp_path / "r.csv"
    arguments = ["registry", "from-graph", "--namespace", "robot_1", "--domain-id", str(domain()), "--wait", "0.5"]
    with dds.DdsMiddleware(domain_id=domain()) as robot:
        robot.advertise("/robot_1/odom", "nav_msgs/msg/Odometry", Qos())

        def written() -> bool:
            status = run([*arguments, "--out", str(out)])
            assert status == 0 or "is the robot running" in capsys.readouterr().err
            return status == 0

        wait_for(written, "the topic to be discovered")
    assert out.read_text() == "topic,type\nodom,nav_msgs/msg/Odometry\n"
    assert capsys.readouterr().out == f"{out}: 1 topics, digest {Registry.from_csv(out).digest}\n"
