"""`ros2 run` and `ros2 launch` as a user types them: two robots, samples between them over a socket, Ctrl-C."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: source a ROS 2 setup (Humble or later) to run these tests")
pytest.importorskip("ros2run", reason="this ROS 2 has no ros2run")
pytest.importorskip("ros2launch", reason="this ROS 2 has no ros2launch")
pytest.importorskip("launch_ros.actions", reason="this ROS 2 cannot launch nodes: launch_ros is missing or incomplete")
pytest.importorskip("diagnostic_msgs", reason="this ROS 2 has no diagnostic_msgs")
pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
pytest.importorskip("zmq", reason="needs pyzmq")

from diagnostic_msgs.msg import DiagnosticArray
from std_msgs.msg import String

from tests.domains import free_domains
from tests.ros.graph import Graph
from tests.waiting import PATIENCE_S, wait_for

ROOT = Path(__file__).resolve().parents[2]
ROS2 = shutil.which("ros2")
pytestmark = pytest.mark.skipif(ROS2 is None, reason="the command ros2 is missing")
FIGURES = {
    "receiver": {"packet loss", "packets received (1/s)", "silence (s)"},
    "transmitter": {"packets sent (1/s)", "airtime used", "messages waiting"},
    "/rx_robot_1/chat": {"messages lost", "messages (1/s)", "age (s)"},
}


@pytest.fixture(scope="module")
def prefix(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `colcon build` would have installed for ROS to find the package."""
    folder = tmp_path_factory.mktemp("install")
    command = [sys.executable, "setup.py", "-q", "install_data", "--install-dir", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    return folder


@pytest.fixture(autouse=True)
def sourced(prefix: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The package is found, and runs in the Python that runs these tests."""
    for name, first in (("AMENT_PREFIX_PATH", prefix), ("PYTHONPATH", ROOT), ("PATH", Path(sys.executable).parent)):
        monkeypatch.setenv(name, os.pathsep.join(filter(None, (str(first), os.environ.get(name)))))
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "log"))
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def domains(tmp_path: Path) -> list[int]:
    """Those of robot_1.yaml and robot_2.yaml."""
    (tmp_path / "topics.csv").write_text("chat,std_msgs/String\n")
    domains = free_domains(2)
    addresses = [f"ipc://{tmp_path}/samples_{number}" for number in (1, 2)]
    for number, domain in enumerate(domains, start=1):
        (tmp_path / f"robot_{number}.yaml").write_text(
            f"""
            registry: topics.csv
            robot: /robot_{number}
            graph: {{domain_id: {domain}}}
            phy: {{name: psk, sample_rate: 1e6}}
            front_end: {{name: zmq, bind: "{addresses[number - 1]}", connect: ["{addresses[2 - number]}"]}}
            diagnostics: {{period_s: 0.2}}
            """
        )
    return domains


def ros2(words: Sequence[str], domain: int) -> subprocess.Popen[str]:
    """Begun in a process group of its own, as a terminal does it."""
    assert ROS2 is not None
    return subprocess.Popen(
        [sys.executable, ROS2, *words],
        env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
        stderr=subprocess.STDOUT,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


@pytest.fixture
def robots(domains: list[int]) -> Iterator[list[subprocess.Popen[str]]]:
    """One begun by each command."""
    processes = [
        ros2(["run", "gr_ros2", "link", "--ros-args", "-p", "config:=robot_1.yaml"], domains[0]),
        ros2(["launch", "gr_ros2", "link_launch.py", "config:=robot_2.yaml"], domains[1]),
    ]
    yield processes
    for process in processes:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def test_two_robots_until_ctrl_c(robots: list[subprocess.Popen[str]], domains: list[int]) -> None:
    with ExitStack() as stack:
        one, two = (Graph(domain) for domain in domains)
        stack.callback(one.close)
        stack.callback(two.close)
        heard: list[str] = []
        statuses: dict[str, set[str]] = {}

        def diagnose(array: DiagnosticArray) -> None:
            for status in array.status:
                statuses[status.name.partition(": ")[2]] = {pair.key for pair in status.values}

        for graph, topic in ((one, "/rx_robot_2/chat"), (two, "/rx_robot_1/chat")):
            graph.node.create_subscription(String, topic, lambda message: heard.append(message.data), 10)
        two.node.create_subscription(DiagnosticArray, "/diagnostics", diagnose, 10)
        publishers = [
            (graph.node.create_publisher(String, f"/robot_{number}/chat", 10), String(data=f"from robot {number}"))
            for number, graph in enumerate((one, two), start=1)
        ]

        def talk() -> bool:
            for publisher, message in publishers:
                publisher.publish(message)
            return {"from robot 1", "from robot 2"} <= set(heard)

        wait_for(talk, "both directions")
        wait_for(lambda: all(keys <= statuses.get(name, set()) for name, keys in FIGURES.items()), f"{FIGURES}")
    for process in robots:
        os.killpg(process.pid, signal.SIGINT)
    for process in robots:
        output, _ = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0, output
        assert "Traceback" not in output
    assert "process has finished cleanly" in output


def test_wrong_settings_through_both_commands(domains: list[int]) -> None:
    del domains
    said = "gr_ros2 link: link 'nowhere.yaml': no such file"
    run = ros2(["run", "gr_ros2", "link", "--ros-args", "-p", "config:=nowhere.yaml"], 0)
    launch = ros2(["launch", "gr_ros2", "link_launch.py", "config:=nowhere.yaml"], 0)
    output, _ = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 2
    assert output.count(said) == 1 and "Traceback" not in output
    output, _ = launch.communicate(timeout=PATIENCE_S)
    assert output.count(said) == 1 and "exit code 2" in output
