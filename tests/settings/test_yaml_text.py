"""YAML: every key once, in whatever is read."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

import gr_ros2
from gr_ros2.core.errors import ConfigError
from gr_ros2.radio.config import load_link
from gr_ros2.settings.files import parse_override
from gr_ros2.settings.yaml_text import parse_yaml
from gr_ros2_lab.run.scenario import load_scenario
from gr_ros2_lab.study.sweep.definition import load_sweep

PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=5), inner, max_size=5),
    max_leaves=30,
)


@given(PLAIN)
def test_what_has_every_key_once_is_read_as_it_was_written(value: Any) -> None:
    assert parse_yaml(yaml.safe_dump(value), "here") == value


@pytest.mark.parametrize(
    ("text", "key", "lines"),
    [
        ("a: 1\nb: 2\na: 3", "a", (1, 3)),
        ("a: 1\na: 1", "a", (1, 2)),
        ("outer:\n  b: 1\n  'b': 2", "b", (2, 3)),
        ("- {c: 1,\n   d: 2,\n   c: 3}", "c", (1, 3)),
        ("x: &x {a: 1}\ny:\n  <<: *x\n  b: 1\n  b: 2", "b", (4, 5)),
        ("x: &x {a: 1}\ny: &y {b: 1}\nz:\n  <<: *x\n  <<: *y", "<<", (4, 5)),
        ("1: a\n1: b", "1", (1, 2)),
    ],
)
def test_a_key_that_stands_twice_is_named_with_its_lines(text: str, key: str, lines: tuple[int, int]) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_yaml(text, "here")
    assert str(caught.value) == f"here: key {key!r} stands twice, in line {lines[0]} and line {lines[1]}; keep one"


def test_what_a_merge_brings_may_be_overridden() -> None:
    text = "x: &x {a: 1, b: 1}\ny: &y {<<: *x, a: 2}\nz: {<<: *y, b: 3}"
    assert parse_yaml(text, "here")["z"] == {"a": 2, "b": 3}


def test_equal_keys_of_two_mappings_or_two_types_are_no_duplicates() -> None:
    assert parse_yaml("a: {k: 1}\nb: {k: 1}\n1: x\n'1': y", "here")["1"] == "y"


@pytest.mark.parametrize("load", [load_scenario, load_sweep, load_link])
def test_every_kind_of_file_is_checked(tmp_path: Path, load: Any) -> None:
    path = tmp_path / "x.yaml"
    path.write_text("name: x\nname: y\n")
    with pytest.raises(ConfigError, match="'name' stands twice, in line 1 and line 2"):
        load(path)


def test_a_value_on_the_command_line_is_checked() -> None:
    with pytest.raises(ConfigError, match=r"--set phy=\{name: ofdm, name: psk\}: key 'name' stands twice, in line 1"):
        parse_override("phy={name: ofdm, name: psk}")


def test_nothing_else_reads_yaml() -> None:
    root = Path(gr_ros2.__file__).parents[1]
    reads = re.compile(r"\byaml\.(\w+_)?load")
    files = root.glob("gr_ros2*/**/*.py")
    users = [path.relative_to(root).as_posix() for path in files if reads.search(path.read_text("utf-8"))]
    assert users == ["gr_ros2/settings/yaml_text.py"]
