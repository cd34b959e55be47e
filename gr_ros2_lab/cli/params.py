"""Arguments and options of several commands of the laboratory."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

from gr_ros2.cli.params import Completed
from gr_ros2.core.files import check_folder
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


pictures_option = click.option(
    "--pictures", is_flag=True, help="Also the figures as PNG and SVG, and every number as CSV and Parquet."
)


def written_line(files: Sequence[Path]) -> str:
    """What was written: the page, and how much beside it."""
    return f"Written: {files[0]}" + (f" and {len(files) - 1} files beside it" if files[1:] else "")
