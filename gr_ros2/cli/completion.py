"""`gr-ros2 completion`: the script that lets a shell complete commands, options and scenario names."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

SHELLS = ("bash", "zsh", "fish")
COMPLETE_VARIABLE = "_GR_ROS2_COMPLETE"
"""Environment variable that click's scripts set when they call the program."""


@click.command()
@click.argument("shell", type=click.Choice(SHELLS))
@click.pass_context
def completion(context: click.Context, shell: str) -> None:
    """Print the completion script for SHELL.

    \b
    bash: gr-ros2 completion bash >> ~/.bashrc
    zsh:  gr-ros2 completion zsh >> ~/.zshrc
    fish: gr-ros2 completion fish > ~/.config/fish/completions/gr-ros2.fish
    """
    made = get_completion_class(shell)
    assert made is not None
    print(made(context.find_root().command, {}, "gr-ros2", COMPLETE_VARIABLE).source())
