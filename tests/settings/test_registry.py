"""The registry CSV: the paper's form, all its rules, and errors that say file, line and what is wrong."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.core.errors import ConfigError, RegistryError
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import MAX_TOPICS, Registry, Topic, check_outputs, normalize_type
from gr_ros2.settings.robot import PublishConfig, PublishOptions

ODOM = "nav_msgs/msg/Odometry"


def read(tmp_path: Path, text: str | bytes) -> Registry:
    path = tmp_path / "topics.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return Registry.from_csv(path)


def refused(tmp_path: Path, text: str | bytes, line: int | None) -> str:
    """The error a CSV causes, without its place, which is checked."""
    with pytest.raises(RegistryError) as caught:
        read(tmp_path, text)
    error = caught.value
    assert isinstance(error, ConfigError)
    assert error.line == line
    place = f"{tmp_path / 'topics.csv'}" + (f":{line}" if line is not None else "")
    assert str(error).startswith(f"{place}: ")
    assert "\n" not in str(error)
    return str(error).removeprefix(f"{place}: ")


def test_the_papers_form(tmp_path: Path) -> None:
    registry = read(tmp_path, "odom,nav_msgs/Odometry\nscan,sensor_msgs/LaserScan\n")
    assert [(topic.topic_id, topic.name, topic.type_name) for topic in registry] == [
        (0, "odom", ODOM),
        (1, "scan", "sensor_msgs/msg/LaserScan"),
    ]


@pytest.mark.parametrize("form", ["nav_msgs/Odometry", ODOM])
def test_both_forms_of_a_type_mean_the_same(form: str) -> None:
    assert normalize_type(form) == ODOM


@pytest.mark.parametrize(
    "text",
    [
        "topic,type\nodom,nav_msgs/Odometry\n",
        "name,type\nodom,nav_msgs/Odometry\n",
        "TOPIC,Type\nodom,nav_msgs/Odometry\n",
        "# all of them\n\ntopic,type\n\n# one\nodom,nav_msgs/Odometry\n\n",
        "odom,nav_msgs/Odometry",
        " odom , nav_msgs/Odometry \r\n",
        '"odom","nav_msgs/Odometry"\n',
        b"\xef\xbb\xbfodom,nav_msgs/Odometry\n",
    ],
)
def test_headers_comments_blanks_and_spaces(tmp_path: Path, text: str | bytes) -> None:
    registry = read(tmp_path, text)
    assert [(topic.name, topic.type_name) for topic in registry] == [("odom", ODOM)]


def test_a_topic_called_topic_is_no_header(tmp_path: Path) -> None:
    assert [topic.name for topic in read(tmp_path, "topic,std_msgs/String\n")] == ["topic"]


def test_as_many_topics_fit_as_version_1_has_numbers_for(tmp_path: Path) -> None:
    rows = [f"t{number},std_msgs/String\n" for number in range(MAX_TOPICS + 1)]
    assert len(read(tmp_path, "".join(rows[:-1]))) == MAX_TOPICS == 240
    assert "topic 241, 't240'" in refused(tmp_path, "# comment\n" + "".join(rows), 242)


def test_comments_and_blank_lines_do_not_count_as_topics(tmp_path: Path) -> None:
    rows = [f"# {number}\n\nt{number},std_msgs/String\n" for number in range(MAX_TOPICS)]
    assert [topic.topic_id for topic in read(tmp_path, "".join(rows))] == list(range(MAX_TOPICS))


@pytest.mark.parametrize("again", ["odom", "/odom"])
def test_a_duplicate_says_both_lines(tmp_path: Path, again: str) -> None:
    text = f"odom,nav_msgs/Odometry\nscan,sensor_msgs/LaserScan\n{again},nav_msgs/Odometry\n"
    assert refused(tmp_path, text, 3) == f"duplicate topic {again!r}; it stands first in line 1"


@pytest.mark.parametrize(
    "kind",
    [
        "Odometry",
        "nav_msgs/svc/Odometry",
        "nav_msgs/srv/",
        "nav_msgs/action/Go_Somewhere",
        "nav_msgs/msg/",
        "/Odometry",
        "nav msgs/Odometry",
        "a/b/c/d",
        "nav_msgs::Odometry",
    ],
)
def test_a_malformed_type(tmp_path: Path, kind: str) -> None:
    assert f"topic 'odom': malformed type {kind!r}" in refused(tmp_path, f"scan,a_msgs/B\nodom,{kind}\n", 2)


@pytest.mark.parametrize("name", ["1odom", "odom/", "a//b", "odom!", "/", "a b", "ödom", "~/odom"])
def test_a_malformed_name(tmp_path: Path, name: str) -> None:
    assert f"malformed topic name {name!r}" in refused(tmp_path, f"{name},nav_msgs/Odometry\n", 1)


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ("odom", "1 columns where 2 were expected: 'odom'"),
        ("odom,nav_msgs/Odometry,latency", "3 columns where 2 were expected"),
        (",nav_msgs/Odometry", "malformed topic name ''"),
        ("odom,", "malformed type ''"),
    ],
)
def test_a_bad_row(tmp_path: Path, row: str, says: str) -> None:
    assert says in refused(tmp_path, f"scan,sensor_msgs/LaserScan\n{row}\n", 2)


@pytest.mark.parametrize("text", ["", "\n\n", "# nothing\n", "topic,type\n"])
def test_an_empty_registry(tmp_path: Path, text: str) -> None:
    assert refused(tmp_path, text, None) == "no topics; add rows of the form name,type"


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(RegistryError, match=r"nowhere\.csv: cannot be read"):
        Registry.from_csv(tmp_path / "nowhere.csv")


@pytest.mark.parametrize("data", [b"\xff\xfe\x00odom", b'odom,"nav_msgs/Odometry\n', b"od\x00om,a/B\n"])
def test_what_is_no_csv(tmp_path: Path, data: bytes) -> None:
    with pytest.raises(RegistryError, match=r"topics\.csv"):
        read(tmp_path, data)


@given(st.binary(max_size=200))
def test_no_bytes_raise_anything_but_a_registry_error(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "any.csv"
    path.write_bytes(data)
    try:
        registry = Registry.from_csv(path)
    except RegistryError as error:
        assert str(path) in str(error)
    else:
        assert 1 <= len(registry) <= MAX_TOPICS


def test_named_columns_are_options_and_empty_cells_defaults(tmp_path: Path) -> None:
    text = (
        "topic,type,qos,queue_depth,publish_as,depth,durability,reliability\n"
        "odom,nav_msgs/Odometry,latency,1,/fleet/r{robot}/odom,,,best_effort\n"
        "map,nav_msgs/OccupancyGrid,bulk,,,1,volatile\n"
        "scan,sensor_msgs/LaserScan\n"
    )
    odom, map_, scan = read(tmp_path, text)
    assert odom.options == SendOptions(qos="latency", queue_depth=1, reliability="best_effort")
    assert map_.options == SendOptions(qos="bulk", depth=1, durability="volatile")
    assert scan.options == SendOptions()


@pytest.mark.parametrize(
    ("header", "row", "line", "says"),
    [
        (
            "topic,type,colour",
            "odom,a/B,red",
            1,
            "unknown column 'colour'; known are qos, reliability, durability, depth",
        ),
        ("topic,type,qos,qos", "odom,a/B,bulk,bulk", 1, "column 'qos' stands twice"),
        ("topic,type,qos", "odom,a/B,urgent", 2, "topic 'odom': qos = 'urgent'"),
        ("topic,type,depth", "odom,a/B,-1", 2, "topic 'odom': depth = '-1'"),
        ("topic,type,depth", "odom,a/B,many", 2, "topic 'odom': depth = 'many'"),
        ("topic,type,publish_as", "odom,a/B,/x/{who}", 2, "publish_as = '/x/{who}': only {robot} may stand"),
        ("topic,type,publish_as", "odom,a/B,/x/{", 2, "publish_as = '/x/{': only {robot} may stand"),
        ("topic,type,publish_as", "odom,a/B,/robot-1/odom", 2, "publish_as = '/robot-1/odom': '-' may not stand"),
        ("topic,type,publish_as", "odom,a/B,/fleet/{robot}/odom", 2, "part '255' must not begin with a digit"),
        ("topic,type,qos", "odom,a/B,bulk,4", 2, "4 columns where 3 were expected"),
    ],
)
def test_wrong_columns(tmp_path: Path, header: str, row: str, line: int, says: str) -> None:
    assert says in refused(tmp_path, f"{header}\n{row}\n", line)


def test_names_on_both_graphs() -> None:
    odom, clock = Registry.from_rows({"odom": "nav_msgs/Odometry", "/clock": "rosgraph_msgs/Clock"})
    assert [odom.on_graph(namespace) for namespace in ("/robot_1", "robot_1/", "")] == [
        "/robot_1/odom",
        "/robot_1/odom",
        "/odom",
    ]
    assert clock.on_graph("/robot_1") == "/clock"
    assert odom.republished("/rx_robot_{robot}", 7) == "/rx_robot_7/odom"
    assert clock.republished("rx_{robot}/", 7) == "/rx_7/clock"
    assert Topic(0, "odom", ODOM, publish_as="r{robot}/pose").republished("/any", 3) == "/r3/pose"


@pytest.mark.parametrize(
    ("name", "durability", "latched"),
    [
        ("map", "auto", True),
        ("/tf_static", "auto", True),
        ("robot/robot_description", "auto", True),
        ("odom", "auto", False),
        ("map_updates", "auto", False),
        ("map", "volatile", False),
        ("odom", "transient_local", True),
    ],
)
def test_latched_by_convention_or_as_registered(name: str, durability: str, latched: bool) -> None:
    options = SendOptions(durability=durability)  # type: ignore[arg-type]
    assert Topic(0, name, ODOM, options).latched is latched


def test_a_row_is_found_with_and_without_slash() -> None:
    registry = Registry.from_rows({"odom": "nav_msgs/Odometry", "/clock": "rosgraph_msgs/Clock"})
    assert registry.named("/odom") is registry.named("odom") is registry[0]
    assert registry.named("clock") is registry[1]
    with pytest.raises(ConfigError, match=r"topic 'scan' is not in the registry; it has odom, /clock"):
        registry.named("scan")


def test_configured_options_go_over_the_registrys(tmp_path: Path) -> None:
    registry = read(tmp_path, "topic,type,qos,depth\nodom,nav_msgs/Odometry,latency,5\nscan,a/B,bulk,\n")
    changed = registry.with_options({"/odom": SendOptions(depth=7)})
    assert changed[0].options == SendOptions(qos="latency", depth=7)
    assert changed[1] == registry[1]
    assert registry[0].options.depth == 5
    assert changed.digest == registry.digest
    with pytest.raises(ConfigError, match="topic 'map' is not in the registry"):
        registry.with_options({"map": SendOptions()})


def test_the_digest_tells_what_both_ends_must_agree_on(tmp_path: Path) -> None:
    rows = "odom,nav_msgs/Odometry\nscan,sensor_msgs/LaserScan\n"
    digest = read(tmp_path, rows).digest
    assert len(digest) == 16
    assert int(digest, 16) >= 0
    same = (
        "# comment\n" + rows,
        "topic,type,qos\nodom,nav_msgs/msg/Odometry,bulk\n/scan,sensor_msgs/LaserScan,\n",
    )
    assert {read(tmp_path, text).digest for text in same} == {digest}
    other = (
        "scan,sensor_msgs/LaserScan\nodom,nav_msgs/Odometry\n",
        "odom,nav_msgs/Odometry\n",
        "odom,nav_msgs/Odometry\nscan,sensor_msgs/PointCloud2\n",
        "odom,nav_msgs/Odometry\nscan2,sensor_msgs/LaserScan\n",
    )
    digests = {read(tmp_path, text).digest for text in other}
    assert len(digests) == len(other)
    assert digest not in digests


@pytest.mark.parametrize(
    "rows", [{"1": "a/B"}, {"a": "B"}, {}, [("a", "a/B"), ("a", "a/B")], [("/a", "a/B"), ("a", "a/B")]]
)
def test_rows_written_in_code_are_checked_too(rows: object) -> None:
    with pytest.raises(RegistryError, match="registry: "):
        Registry.from_rows(rows)  # type: ignore[arg-type]


def test_a_registry_is_a_sequence() -> None:
    registry = Registry.from_rows([("a", "a/B"), ("b", "a/B")])
    assert list(registry) == [registry[0], registry[1]]
    assert registry[0:2] == (registry[0], registry[1])
    assert registry[0] in registry


def test_a_row_may_name_a_service(tmp_path: Path) -> None:
    registry = read(tmp_path, "add,example_interfaces/srv/AddTwoInts\nodom,nav_msgs/Odometry\n")
    assert [(topic.type_name, topic.is_service, topic.is_topic) for topic in registry] == [
        ("example_interfaces/srv/AddTwoInts", True, False),
        (ODOM, False, True),
    ]
    assert [topic.name for topic in registry.services] == ["add"]


def test_an_action_is_three_services_and_two_topics(tmp_path: Path) -> None:
    registry = read(tmp_path, "topic,type,publish_as\ngo,nav2_msgs/action/NavigateToPose,drive\nscan,a_msgs/B\n")
    rows = [(topic.name, topic.type_name, topic.is_service, topic.latched) for topic in registry]
    assert rows == [
        ("go/_action/send_goal", "nav2_msgs/action/NavigateToPose_SendGoal", True, False),
        ("go/_action/cancel_goal", "action_msgs/srv/CancelGoal", True, False),
        ("go/_action/get_result", "nav2_msgs/action/NavigateToPose_GetResult", True, False),
        ("go/_action/feedback", "nav2_msgs/action/NavigateToPose_FeedbackMessage", False, False),
        ("go/_action/status", "action_msgs/msg/GoalStatusArray", False, True),
        ("scan", "a_msgs/msg/B", False, False),
    ]
    assert registry[3].republished("/rx_robot_{robot}", 2) == "/drive/_action/feedback"
    assert [topic.topic_id for topic in registry] == list(range(6))


@pytest.mark.parametrize(
    ("word", "count", "service", "kind"),
    [("parameters", 6, "set_parameters", "SetParameters"), ("lifecycle", 5, "change_state", "ChangeState")],
)
def test_a_row_may_name_what_nodes_have(tmp_path: Path, word: str, count: int, service: str, kind: str) -> None:
    registry = read(tmp_path, f"planner,{word}\n")
    assert len(registry) == len(registry.services) == count
    assert registry.named(f"planner/{service}").type_name.endswith(
        f"_{'interfaces' if count == 6 else 'msgs'}/srv/{kind}"
    )


def test_calls_have_a_row_of_their_own_behind_the_others(tmp_path: Path) -> None:
    registry = read(tmp_path, "add,example_interfaces/srv/AddTwoInts\n")
    row = registry.with_calls()[-1]
    assert (row.topic_id, row.is_topic, row.is_service) == (1, False, False)
    full = Registry.from_rows({f"t{number}": "std_msgs/String" for number in range(MAX_TOPICS)})
    with pytest.raises(RegistryError, match="241 topics"):
        full.with_calls()


def test_options_may_be_of_topics_that_others_announce() -> None:
    registry = Registry.from_rows({"odom": "nav_msgs/Odometry"})
    options = {"odom": PublishOptions(depth=3), "/scan": PublishOptions(depth=4)}
    assert [topic.options.depth for topic in registry.with_options(options, announced=True)] == [3]
    with pytest.raises(ConfigError, match="topic '/scan' is not in the registry"):
        registry.with_options(options)
    check_outputs(registry, PublishConfig(topics=options))
    with pytest.raises(ConfigError, match="topic '/scan' is not in the registry"):
        check_outputs(registry, PublishConfig(topics=options), announced=False)
