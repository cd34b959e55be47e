"""Two robots with two radios each, which cables connect that can be pulled."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from tests.radio.cables import SerialCable
from tests.radio.robots import Robot
from tests.waiting import wait_for

FAST, SLOW = 200_000, 4_800
"""Bit/s of a modem."""


def modem(bit_rate: float) -> dict[str, Any]:
    return {"name": "modem", "options": {"bit_rate": bit_rate}}


class Team:
    """Two robots with a cable for each radio.

    :param rates: bit/s of each radio
    :param more: further settings of some radios
    :param second: further settings of robot 2
    """

    def __init__(
        self,
        folder: Path,
        rates: tuple[int, int],
        closing: ExitStack,
        more: Mapping[str, Any] | None = None,
        second: Mapping[str, Any] | None = None,
        **values: Any,
    ) -> None:
        more = more or {}
        names = ("left", "right")
        self.cables = []
        for name in names:
            (folder / name).mkdir()
            self.cables.append(closing.enter_context(SerialCable(folder / name)))
        self.robots: list[Robot] = []
        self._made: list[Callable[[], Robot]] = []
        self._closing = closing
        for number in (1, 2):
            radios = [
                {
                    **more.get(name, {}),
                    "name": name,
                    "phy": modem(rate),
                    "front_end": {"name": "serial", "device": str(cable.ends[number - 1]), "baud": 230400},
                }
                for name, rate, cable in zip(names, rates, self.cables, strict=True)
            ]
            state = str(folder / f"robot_{number}.json")
            own = {"radios": radios, "state": state, **values, **((second or {}) if number == 2 else {})}
            self._made.append(partial(Robot, number, {"name": "sim"}, (3 - number,), **own))
            self.robots.append(closing.enter_context(self._made[-1]()))
        for robot in self.robots:
            wait_for(lambda: robot.link.stats()["peers"], "the other robot to be heard")  # noqa: B023 - called at once

    def radio(self, number: int, name: str) -> dict[str, Any]:
        """What robot ``number`` says of a radio."""
        radio: dict[str, Any] = self.robots[number - 1].link.stats()["radios"][name]
        return radio

    def talk(self, first: int, count: int = 20) -> None:
        """Robot 1 says so many messages, all of which robot 2 hears in order."""
        before = len(self.robots[1].heard)
        said = self.robots[0].say(*range(first, first + count))
        wait_for(lambda: len(self.robots[1].heard) >= before + count, "all messages")
        assert self.robots[1].heard[before:] == said

    def restart(self, number: int) -> None:
        """A robot ends, and starts again."""
        self.robots[number - 1].__exit__(None, None, None)
        self.robots[number - 1] = self._closing.enter_context(self._made[number - 1]())
