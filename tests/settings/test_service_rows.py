"""Which rows stand for the services of a graph."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.settings.service_rows import ServiceRow, is_of_node, is_service, parts, rows_of

NAMES = st.from_regex(r"(/[a-z]{1,3}){1,3}", fullmatch=True)
KINDS = st.sampled_from(["parameters", "lifecycle", "nav2_msgs/action/Spin", "std_srvs/srv/Empty"])


def services_of(name: str, kind: str) -> dict[str, str]:
    return {part: type_name for part, type_name in parts(name, kind).items() if is_service(type_name)}


@given(st.dictionaries(NAMES, KINDS, max_size=6))
def test_a_row_is_found_again_by_its_services(rows: dict[str, str]) -> None:
    graph: dict[str, str] = {}
    for name, kind in rows.items():
        graph.update(services_of(name, kind))
    found = rows_of(graph)
    assert {(row.name, row.kind) for row in found} >= set(rows.items())
    assert {row.name for row in found if not row.of_node} == {
        name for name, kind in rows.items() if kind not in ("parameters", "lifecycle")
    }
    assert len(found) == len({(row.name, row.kind) for row in found})


def test_an_action_is_one_row_and_a_node_is_hidden() -> None:
    spin = "nav2_msgs/action/Spin"
    graph = {
        **services_of("/r/spin", spin),
        "/r/planner/set_parameters": "rcl_interfaces/srv/SetParameters",
        "/r/planner/get_type_description": "type_description_interfaces/srv/GetTypeDescription",
        "/r/clear": "std_srvs/srv/Empty",
        "/r/no_ros": "something else",
        "/r/half/_action/get_result": f"{spin}_GetResult",
    }
    assert rows_of(graph) == [
        ServiceRow("/r/clear", "std_srvs/srv/Empty"),
        ServiceRow("/r/planner", "parameters", of_node=True),
        ServiceRow(
            "/r/planner/get_type_description", "type_description_interfaces/srv/GetTypeDescription", of_node=True
        ),
        ServiceRow("/r/planner/set_parameters", "rcl_interfaces/srv/SetParameters", of_node=True),
        ServiceRow("/r/spin", spin),
    ]


@pytest.mark.parametrize(
    ("name", "type_name", "expected"),
    [
        ("/planner/set_parameters", "rcl_interfaces/srv/SetParameters", True),
        ("planner/change_state", "lifecycle_msgs/srv/ChangeState", True),
        ("/planner/set_logger_levels", "rcl_interfaces/srv/SetLoggerLevels", True),
        ("/planner/set_parameters", "mine/srv/SetParameters", False),
        ("/planner/clear", "std_srvs/srv/Empty", False),
    ],
)
def test_what_ros_gives_to_nodes(name: str, type_name: str, expected: bool) -> None:
    assert is_of_node(name, type_name) == expected
