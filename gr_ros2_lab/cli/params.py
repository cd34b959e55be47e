"""Arguments and options of several commands of the laboratory."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import click
from click.shell_completion import CompletionItem

from gr_ros2.cli.params import Completed
from gr_ros2_lab.run.builtin import builtin_scenarios


class ScenarioName(Completed):
    """The name of a built-in scenario or the path of a YAML file. ``load_scenario`` finds out which of them it is."""

    name = "scenario"

    def candidates(self) -> Iterable[CompletionItem]:
        return map(CompletionItem, builtin_scenarios())

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        return super().shell_complete(ctx, param, incomplete) or [CompletionItem(incomplete, type="file")]


SCENARIO = ScenarioName()


pictures_option = click.option(
    "--pictures", is_flag=True, help="Also the figures as PNG and SVG, and every number as CSV and Parquet."
)


def written_line(files: Sequence[Path]) -> str:
    """What was written: the page, and how much beside it."""
    return f"Written: {files[0]}" + (f" and {len(files) - 1} files beside it" if files[1:] else "")
