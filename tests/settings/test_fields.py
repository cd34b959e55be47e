"""What is read of settings classes, and what must be true of all of them."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import pytest
from pydantic import Field, TypeAdapter

from gr_ros2.phy import PHY
from gr_ros2.radio import FRONT_ENDS
from gr_ros2.radio.config import LinkConfig
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.fields import AUTO, REQUIRED, Auto, Setting, label, meanings, members, settings_of
from gr_ros2_lab.medium.process import MediumConfig
from gr_ros2_lab.race.race_settings import RaceSettings
from gr_ros2_lab.run.scenario import Scenario
from gr_ros2_lab.study.sweep.definition import Sweep

REPOSITORY = Path(__file__).resolve().parents[2]
ROOTS = (Scenario, LinkConfig, MediumConfig, Sweep, RaceSettings, SendOptions)
ANOTHER_TIME = {"max_rate", "packet_rate", "speed", "bag_speed", "time"}
"""Rates and clocks: no durations."""


@dataclass(frozen=True)
class Base:
    low: Annotated[int, Field(ge=0, lt=9, title="Lowest")] = 0
    """how low"""


@dataclass(frozen=True)
class Example(Base):
    """Something."""

    low: int = 3
    wait_s: Annotated[float, Field(gt=0)] | Auto = AUTO
    """how long it waits; auto = as long as it likes"""
    kind: Literal["a", "b"] = "a"
    """of which
    kind"""
    name: str = field(kw_only=True)
    """its name"""
    maybe: bool | None = None


def classes() -> list[type[Any]]:
    """Every settings class that a user writes, those inside others too."""
    options = [PHY.load(name).Options for name in PHY.own] + [FRONT_ENDS.load(name).Options for name in FRONT_ENDS.own]
    found: list[type[Any]] = []
    waiting: list[type[Any]] = [*ROOTS, *options]
    while waiting:
        cls = waiting.pop()
        if cls not in found:
            found.append(cls)
            waiting += [kind for setting in settings_of(cls) for kind in nested(setting.hint)]
    return found


def nested(hint: Any) -> Iterator[type[Any]]:
    for kind in members(hint):
        if is_dataclass(kind):
            yield kind  # type: ignore[misc]
        for inner in get_args(kind):
            yield from nested(inner)


def every() -> list[tuple[type[Any], Setting]]:
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    found = [(cls, setting) for cls in classes() for setting in settings_of(cls)]
    assert {cls for cls, _ in found} >= set(ROOTS)
    return found


def test_a_field_tells_all_there_is_to_say() -> None:
    low, wait, kind, name, maybe = settings_of(Example)
    assert (low.meaning, low.title, low.default, low.limits) == ("how low", "Lowest", 3, ("", ""))
    assert (wait.title, wait.default, wait.choices, wait.kinds) == ("Wait (s)", "auto", ("auto",), (float,))
    assert (wait.limits, wait.derives, wait.optional) == (("0 < ", ""), True, False)
    assert (kind.meaning, kind.choices, kind.kinds) == ("of which kind", ("a", "b"), ())
    assert name.default is REQUIRED
    assert (maybe.optional, maybe.kinds, maybe.meaning) == (True, (bool,), "")
    assert settings_of(Base)[0].limits == ("0 <= ", " < 9")


def test_a_label_is_the_name_in_words_with_its_unit() -> None:
    assert label("flush_timeout_s") == "Flush timeout (s)"
    assert label("carrier_hz") == "Carrier (Hz)"
    assert label("greedy") == "Greedy"


def test_no_text_is_written_twice() -> None:
    """A class has settings of others by inheriting from them; of the same name it may have another one."""
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    written: dict[tuple[str, str], set[str]] = {}
    for part in {part for cls in classes() for part in cls.__mro__}:
        above = [meanings(base) for base in part.__bases__]
        for name, text in meanings(part).items():
            if all(base.get(name) != text for base in above):
                written.setdefault((name, text), set()).add(part.__qualname__)
    assert len(written) > 200
    assert {name: found for name, found in written.items() if len(found) > 1} == {}


def test_every_whole_number_is_bounded() -> None:
    """One that no computer stores reaches DDS, GNU Radio or an array, and is refused there, with other words."""
    unbounded = [
        f"{cls.__name__}.{name}"
        for cls in classes()
        for name, schema in TypeAdapter(cls).json_schema().get("properties", {}).items()
        for kind in (schema, *schema.get("anyOf", ()))
        if kind.get("type") == "integer" and not {"maximum", "exclusiveMaximum", "enum", "const"} & kind.keys()
    ]
    assert unbounded == []


def test_every_setting_says_what_it_is() -> None:
    assert [f"{cls.__name__}.{setting.name}" for cls, setting in every() if not setting.meaning] == []


def test_what_is_derived_is_spelt_auto() -> None:
    """No -1, no '' and no null that means that the program finds out: null says that there is none."""
    words = re.compile(r"(-1|''|None|null) (takes|adapts|follows|chooses|= the device|= chosen|= as)")
    told = {f"{cls.__name__}.{setting.name}" for cls, setting in every() if words.search(setting.meaning)}
    assert told == set()
    for cls, setting in every():
        assert setting.default != -1, f"{cls.__name__}.{setting.name}"
        assert not setting.derives or re.search(r"\bauto\b", setting.meaning), f"{cls.__name__}.{setting.name}"


def test_durations_are_in_seconds_and_say_so() -> None:
    for cls, setting in every():
        name = f"{cls.__name__}.{setting.name}"
        assert not re.search(r"_(ms|us|ns|min|sec)$", setting.name), name
        if re.match(r"(s|seconds)\b[ ,]", setting.meaning):
            assert setting.name.endswith("_s") or setting.name == "outages", name
        if re.search(r"timeout|duration|deadline|period|turnaround|guard|silence|_time$", setting.name):
            assert setting.name.endswith("_s") or setting.kinds == (bool,), name


def test_the_page_of_parameters_is_up_to_date() -> None:
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    command = [sys.executable, str(REPOSITORY / "tools" / "write-parameters"), "--check"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_page_of_parameters_has_every_setting() -> None:
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    page = (REPOSITORY / "docs" / "reference" / "parameters.md").read_text(encoding="utf-8")
    for cls, setting in every():
        assert f"| `{setting.name}` |" in page, f"{cls.__name__}.{setting.name}"
