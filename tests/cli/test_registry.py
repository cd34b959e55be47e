"""`registry check`, `registry from-graph` and `registry from-bag`."""

from __future__ import annotations

from pathlib import Path

import pytest
from rosbags.interfaces import Qos as BagQos
from rosbags.interfaces import QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer

from gr_ros2.cli.main import run
from gr_ros2.cli.registry import registry_csv, unfit
from gr_ros2.core.errors import ConfigError
from gr_ros2.middleware import Qos, TopicInfo
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry
from gr_ros2.settings.service_rows import rows_of
from tests.domains import domain
from tests.middleware.foreign_bags import Foreign, make_mcap
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


def test_services_and_actions_are_rows_too(tmp_path: Path) -> None:
    services = rows_of(
        {
            "/robot_1/add": "example_interfaces/srv/AddTwoInts",
            "/robot_1/go/_action/send_goal": "nav2_msgs/action/Spin_SendGoal",
            "/robot_1/go/_action/get_result": "nav2_msgs/action/Spin_GetResult",
            "/robot_1/planner/set_parameters": "rcl_interfaces/srv/SetParameters",
            "/robot_1/_hidden": "std_srvs/srv/Empty",
            "/robot_1/odom": "std_srvs/srv/Empty",  # the topic of this name is in the registry already
            "/robot_2/add": "example_interfaces/srv/AddTwoInts",
        }
    )
    text = registry_csv(FOUND, "robot_1", services=services)
    assert text.splitlines()[3:] == ["add,example_interfaces/srv/AddTwoInts,", "go,nav2_msgs/action/Spin,"]
    path = tmp_path / "r.csv"
    path.write_text(text)
    assert len(Registry.from_csv(path)) == 2 + 1 + 5
    assert registry_csv(FOUND, "robot_1", ["go"], services=services) == "topic,type\ngo,nav2_msgs/action/Spin\n"


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
    many = [TopicInfo(f"/t{n:02}", "std_msgs/msg/String", (Qos(),)) for n in range(241)]
    with pytest.raises(ConfigError, match="241 topics, a registry has at most 240; choose with"):
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


@pytest.mark.parametrize("name", ["memory", "bag", "nothing"])
def test_a_middleware_that_no_robot_is_on_is_refused(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["registry", "from-graph", "--middleware", name]) == 2
    assert f"'{name}' has no graph that a robot could be on; take dds, rclpy, zenoh" in capsys.readouterr().err


SERVICE = TopicInfo("/add/_service_event", "example_interfaces/srv/AddTwoInts_Event", (Qos(),))
FEEDBACK = TopicInfo("/fib/_action/feedback", "example_interfaces/action/Fibonacci_FeedbackMessage", (Qos(),))
STATUS = TopicInfo("/fib/_action/status", "action_msgs/msg/GoalStatusArray", (LATCHED,))
TWO = [TopicInfo("/n", f"std_msgs/msg/{name}", (Qos("reliable"),)) for name in ("String", "Int32")]


def test_what_no_registry_can_have_is_left_out_with_the_reason() -> None:
    found = [*FOUND, SERVICE, FEEDBACK, STATUS, *TWO, TopicInfo("/robot-1/odom", "nav_msgs/msg/Odometry", (Qos(),))]
    assert unfit(FOUND) == {}
    assert unfit(found) == {
        SERVICE.topic: "it belongs to a service, for which this registry has no row (docs/how-to/services.md)",
        FEEDBACK.topic: "it belongs to an action, for which this registry has no row (docs/how-to/services.md)",
        STATUS.topic: "it belongs to an action, for which this registry has no row (docs/how-to/services.md)",
        "/n": "it has several types, std_msgs/msg/Int32 and std_msgs/msg/String",
        "/robot-1/odom": "ROS allows no such name, '-' may not stand in a ROS name; letters, digits, _ and / may",
    }
    assert registry_csv(found, "") == registry_csv(FOUND, "")
    with pytest.raises(ConfigError, match="topic 'n' cannot be registered: it has several types"):
        registry_csv(found, "", ["n"])
    with pytest.raises(ConfigError, match="--namespace '/robot-1': '-' may not stand"):
        registry_csv(found, "/robot-1")


def test_the_qos_of_a_bag_is_what_all_its_publishers_offer() -> None:
    some = [
        TopicInfo(
            "/odom", "nav_msgs/msg/Odometry", (Qos("reliable", "volatile", 10), Qos("reliable", "volatile", 100))
        ),
        TopicInfo("/scan", "sensor_msgs/msg/LaserScan", (Qos("best_effort", "volatile", 5), LATCHED)),
        TopicInfo("/map", "nav_msgs/msg/OccupancyGrid", (Qos("reliable", "transient_local", 0), LATCHED)),
    ]
    assert registry_csv(some, "", ["odom", "scan", "map"], Path("b")).splitlines() == [
        "topic,type,reliability,durability,depth",
        "odom,nav_msgs/msg/Odometry,reliable,volatile,100",
        "scan,sensor_msgs/msg/LaserScan,best_effort,volatile,10",
        "map,nav_msgs/msg/OccupancyGrid,reliable,transient_local,0",
    ]


def write_bag(path: Path, storage: StoragePlugin) -> Path:
    """A recording as ROS makes it, of which a service and an action were recorded too."""

    def profile(reliability: QosReliability, durability: QosDurability, depth: int) -> BagQos:
        never = QosTime(0, 0)
        liveliness = QosLiveliness.AUTOMATIC
        return BagQos(QosHistory.KEEP_LAST, depth, reliability, durability, never, never, liveliness, never, False)

    best_effort = profile(QosReliability.BEST_EFFORT, QosDurability.VOLATILE, 5)
    latched = profile(QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, 1)
    with Writer(path, version=8, storage_plugin=storage) as writer:
        for topic, type_name, qos in (
            ("/robot_1/scan", "sensor_msgs/msg/LaserScan", best_effort),
            ("/robot_1/tf_static", "tf2_msgs/msg/TFMessage", latched),
            ("/rosout", "rcl_interfaces/msg/Log", latched),
            (SERVICE.topic, SERVICE.type_name, best_effort),
            (FEEDBACK.topic, FEEDBACK.type_name, best_effort),
        ):
            connection = writer.add_connection(
                topic, type_name, msgdef="int32 x\n", rihs01="RIHS01_" + 64 * "0", offered_qos_profiles=[qos]
            )
            writer.write(connection, 1, b"\0\1\0\0" + bytes(4))
    return path


@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_from_a_bag(storage: StoragePlugin, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag, out = write_bag(tmp_path / "bag", storage), tmp_path / "r.csv"
    text = (
        "topic,type,reliability,durability,depth\n"
        "scan,sensor_msgs/msg/LaserScan,best_effort,volatile,5\n"
        "tf_static,tf2_msgs/msg/TFMessage,reliable,transient_local,1\n"
    )
    assert run(["registry", "from-bag", str(bag), "--namespace", "robot_1"]) == 0
    said = capsys.readouterr()
    assert said.out == text
    for topic in (SERVICE.topic, FEEDBACK.topic):
        assert f"{topic} is left out: " in said.err
    bare = next(path for path in bag.iterdir() if path.suffix in (".mcap", ".db3"))
    assert run(["registry", "from-bag", str(bare), "--topics", "robot_1/tf_static", "--out", str(out)]) == 0
    assert capsys.readouterr().out == f"{out}: 1 topics, digest {Registry.from_csv(out).digest}\n"
    assert Registry.from_csv(out)[0].options == SendOptions(
        reliability="reliable", durability="transient_local", depth=1
    )


def test_a_bag_that_gives_no_registry(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = str(write_bag(tmp_path / "bag", StoragePlugin.MCAP))
    for arguments, says in (
        ([str(tmp_path / "none")], "there is no such file or folder"),
        ([bag, "--namespace", "robot_7"], f"are no topics; choose another namespace of {bag}"),
        ([bag, "--topics", "odom"], f"topic 'odom' is not in {bag}; published below / are robot_1/scan"),
        ([bag, "--out", str(tmp_path / "none" / "r.csv")], "cannot be written"),
    ):
        assert run(["registry", "from-bag", *arguments]) == 2
        assert says in capsys.readouterr().err


def test_a_bag_of_many_topics_is_told_in_a_few_lines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    topics = [Foreign(f"/t{number}", count=1) for number in range(1000)]
    topics += [Foreign(f"/s{number}", SERVICE.type_name, count=1) for number in range(1000)]
    bag = str(make_mcap(tmp_path / "in.mcap", topics))
    for arguments in ([], ["--topics", "odom"]):
        assert run(["registry", "from-bag", bag, *arguments]) == 2
        said = capsys.readouterr().err
        assert "and 990 more" in said and len(said) < 1000
    assert run(["registry", "from-bag", bag, "--topics", "t1"]) == 0
    assert len(capsys.readouterr().err.splitlines()) == 11
