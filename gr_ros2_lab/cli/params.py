"""Arguments and options of several commands of the laboratory."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import partial
from itertools import chain, count
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

from gr_ros2.cli.params import Completed
from gr_ros2.core.files import check_folder, make_folder
from gr_ros2_lab.run.builtin import builtin_scenarios


class ScenarioName(Completed):
    """The name of a built-in scenario or the path of a YAML file. ``load_scenario`` finds out which of them it is."""

    name = "scenario"

    def candidates(self) -> Iterable[CompletionItem]:
        return map(CompletionItem, builtin_scenarios())

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        return super().shell_complete(ctx, param, incomplete) or [CompletionItem(incomplete, type="file")]


SCENARIO = ScenarioName()


class OutFolder(click.Path):
    """A folder that is written to at the end of what may take hours, so it is tried at once."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        path = Path(os.fsdecode(super().convert(value, param, ctx)))
        check_folder(path)
        return path


OUT_FOLDER = OutFolder(path_type=Path)


def new_results(what: str) -> Path:
    """A new folder for what a command writes: `results/WHAT-TIME`, with a number behind it where there is one already,
    as runs may begin in the same second. It goes if it is empty when the command ends, as after a typing error.

    :raises ConfigError: when it cannot be made
    """
    first = Path("results") / f"{what}-{time.strftime('%Y%m%d-%H%M%S')}"
    names = chain([first.name], (f"{first.name}-{number}" for number in count(2)))
    make_folder(first.parent)
    check_folder(first.parent)
    folder = next(folder for folder in map(first.with_name, names) if _made(folder))
    if (context := click.get_current_context(silent=True)) is not None:
        context.call_on_close(partial(_remove_empty, folder))
    return folder


def _made(folder: Path) -> bool:
    """Make a folder; whether there was none before."""
    try:
        folder.mkdir()
    except FileExistsError:
        return False
    return True


def _remove_empty(folder: Path) -> None:
    with suppress(OSError):  # there is something in it
        folder.rmdir()


pictures_option = click.option(
    "--pictures", is_flag=True, help="Also the figures as PNG and SVG, and every number as CSV and Parquet."
)


def written_line(files: Sequence[Path]) -> str:
    """What was written: the page, and how much beside it."""
    return f"Written: {files[0]}" + (f" and {len(files) - 1} files beside it" if files[1:] else "")
