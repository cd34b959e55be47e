"""Types of command-line arguments that shells can complete."""

from __future__ import annotations

import click
from click.shell_completion import CompletionItem

from gr_ros2.settings_file import BUILTIN_DIR


class ScenarioName(click.ParamType):
    """A built-in scenario's name or a YAML file's path; which of them it is, ``load_scenario`` finds out."""

    name = "scenario"

    def shell_complete(
        self,
        ctx: click.Context,  # noqa: ARG002 - click's signature
        param: click.Parameter,  # noqa: ARG002
        incomplete: str,
    ) -> list[CompletionItem]:
        names = sorted(path.stem for path in BUILTIN_DIR.glob("*.yaml") if path.stem.startswith(incomplete))
        return [CompletionItem(name) for name in names] or [CompletionItem(incomplete, type="file")]


SCENARIO = ScenarioName()
