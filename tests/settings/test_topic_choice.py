"""Which topics the words of the setting choose, of a graph and of a registry."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.core.errors import ConfigError
from gr_ros2.settings.config import build
from gr_ros2.settings.registry import Registry
from gr_ros2.settings.robot import RobotConfig
from gr_ros2.settings.topic_choice import TopicChoice

GRAPH = (
    *("/robot_1/odom", "/robot_1/map", "/robot_1/camera/image", "/robot_1/camera/info", "/robot_1/_action/status"),
    *("/robot_2/odom", "/tf", "/rosout", "/parameter_events", "/gr_ros2_link_1/statistics"),
)
NAMES = st.from_regex(r"[a-z]{1,3}(/[a-z]{1,3})?", fullmatch=True)


def chosen(words: str, namespace: str = "/robot_1") -> dict[str, str]:
    """What is sent of GRAPH, and under which names."""
    choice = TopicChoice(build(RobotConfig, {"robot": 1, "topics": words}).words, namespace)
    return {name: row for name in GRAPH if (row := choice.row_name(name)) is not None}


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("", []),
        ("auto", ["odom", "map", "camera/image", "camera/info"]),
        ("*", ["odom", "map", "camera/image", "camera/info"]),
        ("auto, -camera/*", ["odom", "map"]),
        ("-camera/*", ["odom", "map"]),
        ("auto -map -camera/i?fo", ["odom", "camera/image"]),
        ("auto, /tf", ["odom", "map", "camera/image", "camera/info", "/tf"]),
        ("odom /robot_2/odom", ["odom", "/robot_2/odom"]),
        ("/robot_1/odom", ["/robot_1/odom"]),
        ("odom, -odom", []),
        ("_action/status", ["_action/status"]),
        ("nothing", []),
    ],
)
def test_words_choose_topics_of_the_graph(words: str, expected: list[str]) -> None:
    assert list(chosen(words).values()) == expected


def test_in_the_root_namespace_what_every_node_has_is_not_meant() -> None:
    found = chosen("auto", "")
    assert "/tf" in found
    assert found["/robot_1/odom"] == "robot_1/odom"
    assert not found.keys() & {"/rosout", "/parameter_events", "/robot_1/_action/status", "/gr_ros2_link_1/statistics"}
    assert "/rosout" in chosen("auto, rosout", "")


def test_a_list_and_a_text_are_the_same_setting() -> None:
    for value in (["auto", "-camera/*"], "auto,-camera/*", "auto -camera/*"):
        assert build(RobotConfig, {"robot": 1, "topics": value}).words == ("auto", "-camera/*")


@pytest.mark.parametrize("word", ["od om!", "1st", "a//b", "-", "a/", "ä"])
def test_a_word_that_can_be_no_topic_is_refused(word: str) -> None:
    with pytest.raises(ConfigError, match="topics = "):
        build(RobotConfig, {"robot": 1, "topics": [word]})


def test_of_a_registry() -> None:
    registry = Registry.from_rows(dict.fromkeys(("odom", "/tf", "camera/image", "map"), "std_msgs/String"))

    def rows(*words: str) -> list[str]:
        return [topic.name for topic in registry.chosen(words)]

    assert rows() == rows("auto") == ["odom", "/tf", "camera/image", "map"]
    assert rows("/odom", "tf") == ["odom", "/tf"]
    assert rows("-camera/*", "-/tf") == ["odom", "map"]
    with pytest.raises(ConfigError, match="'scan' is not in the registry"):
        rows("auto", "scan")


def test_an_action_of_a_registry_is_chosen_as_one() -> None:
    registry = Registry.from_rows(
        {"odom": "std_msgs/String", "/go": "a/action/Go", "clear": "b/srv/Clear", "planner": "parameters"}
    )

    def rows(*words: str) -> list[str]:
        return [topic.name for topic in registry.chosen(words)]

    parts = [f"/go/_action/{name}" for name in ("send_goal", "cancel_goal", "get_result", "feedback", "status")]
    assert rows() == rows("auto")
    assert rows("go") == rows("*o", "-odom") == parts
    assert rows("/go", "-go/_action/feedback") == [name for name in parts if not name.endswith("feedback")]
    assert rows("go/_action/status") == parts[-1:]
    assert rows("auto", "-/go", "-planner/*") == ["odom", "clear"]


def test_what_is_hidden_is_chosen_only_by_its_name() -> None:
    choice = TopicChoice(["auto", "planner", "-*/left_out"], "/robot_1")
    assert choice.row_name("/robot_1/planner", hidden=True) == "planner"
    assert choice.row_name("/robot_1/other") == "other"
    assert choice.row_name("/robot_1/other", hidden=True) is None
    assert choice.leaves_out("/robot_1/a/left_out")
    assert not choice.leaves_out("/robot_1/planner")


@given(st.lists(NAMES, max_size=6), st.lists(NAMES, min_size=1, max_size=6))
def test_what_is_left_out_is_never_chosen_and_what_is_named_always(out: list[str], named: list[str]) -> None:
    choice = TopicChoice([*named, *(f"-{name}" for name in out)], "/r")
    for name in (*named, *out):
        assert choice.row_name(f"/r/{name}") == (name if name not in out else None)
