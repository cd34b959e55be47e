"""The constants that were found by measurement: one value, passed in to every part that uses one."""

from __future__ import annotations

import random
import re
from collections import deque
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest

import gr_ros2
from gr_ros2.core.tuning import Tuning
from gr_ros2.link.rate import Mcs
from gr_ros2.mac import Slots
from tests.link.v1.air import SLOT_S, Air, Robot, registry

MCS_TABLE = (Mcs("slow", 0.02, 0.0, 0.4), Mcs("fast", 0.01, 5.0, 0.4))


def holders(start: object) -> Iterator[tuple[object, Tuning]]:
    """Every part of something that holds a tuning, and that tuning."""
    seen, waiting = set[int](), [start]
    while waiting:
        one: Any = waiting.pop()
        if id(one) in seen:
            continue
        seen.add(id(one))
        if isinstance(one, dict):
            inside = [*one.keys(), *one.values()]
        elif isinstance(one, list | tuple | set | frozenset | deque):
            inside = list(one)
        elif type(one).__module__.startswith("gr_ros2."):
            slots = [name for cls in type(one).__mro__ for name in getattr(cls, "__slots__", ())]
            inside = [getattr(one, name) for name in slots if hasattr(one, name)]
            inside += getattr(one, "__dict__", {}).values()
            yield from ((one, each) for each in inside if isinstance(each, Tuning))
        else:
            continue
        waiting += inside


@pytest.mark.parametrize("shared", [False, True])
def test_every_part_of_an_endpoint_has_the_tuning_of_its_settings(shared: bool) -> None:
    tuning = replace(Tuning(), report_every=6)
    robots = [
        Robot(
            src_id,
            registry(),
            access=Slots(src_id, SLOT_S, random.Random(src_id), period_s=0.0, tuning=tuning) if shared else None,
            relay=shared,
            tuning=tuning,
        )
        for src_id in (1, 2)
    ]
    for robot in robots:
        robot.mcs_table = MCS_TABLE
        robot.start()
    air = Air(*robots)
    for n in range(400):
        robots[0].end.messages.submit(0, b"%d" % n, air.now)
        air.step()
    assert robots[1].delivered(1)
    found = list(holders(robots[0].end))
    assert {type(part).__name__ for part, _ in found} >= {"Settings", "Hellos", "Peer", "Order", "RateController"}
    assert [type(part).__name__ for part, held in found if held is not tuning] == []


def test_every_constant_is_used() -> None:
    root = Path(gr_ros2.__file__).parent
    text = "".join(path.read_text("utf-8") for path in root.rglob("*.py") if path.name != "tuning.py")
    used = set(re.findall(r"tuning\.(\w+)", text))
    assert {field.name for field in fields(Tuning)} == used - {"Tuning"}
