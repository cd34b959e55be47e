"""What a YAML file may cost."""

from __future__ import annotations

from pathlib import Path

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.settings.config import read_yaml
from gr_ros2.settings.files import parse_override
from gr_ros2.settings.yaml_bounds import MOST_CHARACTERS, MOST_LEVELS, check_bounds
from gr_ros2_lab.run.builtin import SCENARIO_DIR
from tests.work import calls

CALLS_PER_CHARACTER, CALLS = 100, 10_000
"""What reading a text may cost, twice, and what reading and refusing anything costs beside that."""
BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]\n" for n in range(1, 30)
)
NESTED = "registry: " + "[" * 100_000
MAPS = "a: " + "{b: " * 50_000
DASHES = "- " * 100_000
MERGED = "a0: &a0 {x: 1}\n" + "".join(
    f"a{n}: &a{n} {{k: {{<<: *a{n - 1}}}, l: *a{n - 1}, m: *a{n - 1}}}\n" for n in range(1, 40)
)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (NESTED, "more than 50 levels"),
        (MAPS, "more than 50 levels"),
        (DASHES, "more than 50 levels"),
        (BOMB, r"line 5: more than 20,000 values with every alias written out"),
        (MERGED, "more than 20,000 values"),
        ("a: &a [1, {b: *a}]", r"line 1: \*a stands within &a itself"),
        ("a: " + "x" * (MOST_CHARACTERS + 1), "longer than 262,144 characters"),
    ],
    ids=["nested", "maps", "dashes", "aliases", "merged", "self", "long"],
)
def test_a_bomb_is_refused_at_once_and_named(text: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "bomb.yaml"
    path.write_text(text)

    def read() -> None:
        with pytest.raises(ConfigError, match=says) as refused:
            read_yaml(path)
        assert str(refused.value).startswith(f"{path}: ")
        with pytest.raises(ConfigError, match=says):
            parse_override(f"x={text.removeprefix('a: ')}")

    assert calls(read) < CALLS_PER_CHARACTER * len(text) + CALLS, "without bounds it takes for ever"


def test_a_file_without_end_is_not_read_to_it() -> None:
    with pytest.raises(ConfigError, match="longer than"):
        read_yaml("/dev/zero")


def test_what_people_write_passes(tmp_path: Path) -> None:
    scenarios = list(SCENARIO_DIR.rglob("*.yaml"))
    assert scenarios
    for path in scenarios:
        check_bounds(path.read_text(encoding="utf-8"))
    path = tmp_path / "anchors.yaml"
    path.write_text("base: &base {x: 1, y: [1, 2]}\none: {<<: *base, z: 3}\nother: *base\n")
    base = {"x": 1, "y": [1, 2]}
    assert read_yaml(path) == {"base": base, "one": {**base, "z": 3}, "other": base}
    check_bounds("[" * (MOST_LEVELS - 1) + "]" * (MOST_LEVELS - 1))
