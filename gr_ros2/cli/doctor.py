"""`gr-ros2 doctor`: what this machine has and lacks for a link, and the commands that repair it."""

from __future__ import annotations

import json
from dataclasses import asdict

import click
from rich.markup import escape

from gr_ros2.cli.console import console as make_console
from gr_ros2.cli.ending import FAILED
from gr_ros2.cli.params import set_option
from gr_ros2.doctor.airtime import airtime_checks
from gr_ros2.doctor.checks import examine
from gr_ros2.doctor.self_test import SELF_TEST
from gr_ros2.radio.config import LinkConfig

_MARKS = {
    "ok": "[green]ok     [/]",
    "note": "[dim]note   [/]",
    "warning": "[yellow]warning[/]",
    "failed": "[red]FAILED [/]",
}


@click.command()
@click.option("--json", "as_json", is_flag=True, help="One JSON document, for programs.")
@click.argument("what", required=False, metavar="[LINK | BAND]")
@set_option(LinkConfig)
@click.option("--self-test", is_flag=True, help="Instead: every PHY's loopback, the examples; some seconds.")
def doctor(*, what: str | None, overrides: tuple[str, ...], as_json: bool, self_test: bool) -> int:
    """Look at what is installed, at radios, ROS, clock and limits, and say what mends what is missing.

    With LINK, a link's YAML file, or BAND, such as eu868: instead, what its airtime limit means, in seconds and in
    packets.

    Exit status 1 where a link would not run or the self-test failed, else 0, warnings or not.
    """
    if (overrides and what is None) or (self_test and what is not None):
        raise click.UsageError("--set needs LINK, and --self-test takes none")
    chosen = SELF_TEST if self_test else None if what is None else airtime_checks(what, overrides)
    findings, heading = [], ""
    console = make_console()
    for group, finding in examine(chosen):
        findings.append((group, finding))
        if as_json:
            continue
        if group != heading:
            console.print(f"\n[bold]{escape(group)}[/]")
            heading = group
        console.print(f"{_MARKS[finding.state]} {escape(finding.what)}: {escape(finding.text)}", soft_wrap=True)
        if finding.remedy:
            console.print(f"          mend: {escape(finding.remedy)}", soft_wrap=True)
    failed = [finding.what for _, finding in findings if finding.state == "failed"]
    warned = [finding.what for _, finding in findings if finding.state == "warning"]
    if as_json:
        rows = [{"group": group, **asdict(finding)} for group, finding in findings]
        click.echo(json.dumps({"ok": not failed, "findings": rows}, indent=2))
    elif what is None:
        console.print(f"\n{_passed(failed) if self_test else _summary(failed, warned)}", soft_wrap=True)
    return FAILED if failed else 0


def _passed(failed: list[str]) -> str:
    return f"The self-test failed: {', '.join(failed)}." if failed else "The self-test passed."


def _summary(failed: list[str], warned: list[str]) -> str:
    if failed:
        return f"A link does not run here: {', '.join(failed)}."
    return f"A link runs here; it would run better with: {', '.join(warned)}." if warned else "A link runs here."
