"""What rcl reads from its environment, and what becomes of its errors."""

from __future__ import annotations

import os
from types import SimpleNamespace

import pytest

from gr_ros2.core.errors import MiddlewareError
from gr_ros2.middleware.rcl import node_of, ros_localhost_only, translated
from gr_ros2.settings.fields import Auto

NAME = "ROS_LOCALHOST_ONLY"


@pytest.mark.parametrize("before", [None, "0", "1"])
@pytest.mark.parametrize("localhost_only", [True, False, "auto"])
def test_the_environment_says_it_for_a_moment_only(
    monkeypatch: pytest.MonkeyPatch, before: str | None, localhost_only: bool | Auto
) -> None:
    monkeypatch.delenv(NAME, raising=False)
    if before is not None:
        monkeypatch.setenv(NAME, before)
    with pytest.raises(ValueError, match="inside"), ros_localhost_only(localhost_only):
        assert os.environ.get(NAME) == {True: "1", False: "0", "auto": before}[localhost_only]
        raise ValueError("inside")
    assert os.environ.get(NAME) == before


@pytest.mark.parametrize(
    ("namespace", "name", "node"),
    [
        ("/", "turtle", "/turtle"),
        ("/robot_2", "turtle", "/robot_2/turtle"),
        ("_NODE_NAMESPACE_UNKNOWN_", "_NODE_NAME_UNKNOWN_", ""),
    ],
)
def test_an_endpoint_has_no_node_before_it_is_known(namespace: str, name: str, node: str) -> None:
    assert node_of(SimpleNamespace(node_namespace=namespace, node_name=name)) == node


def test_errors_of_rcl_are_errors_of_the_middleware() -> None:
    with pytest.raises(MiddlewareError, match="/odom is closed: invalid handle"), translated("/odom is closed"):
        raise RuntimeError("invalid handle")
    with pytest.raises(KeyError), translated("/odom"):
        raise KeyError("another")
