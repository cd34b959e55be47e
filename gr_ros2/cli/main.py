"""The command `gr-ros2`: finds a sub-command, runs it, and turns errors into one line and an exit status.

Invariants: only this package prints, exits or reads argv. The module of a sub-command is imported only when the
sub-command is chosen, so `--help` is quick and works without GNU Radio, DDS and ROS. Exit status 2 means bad input, 1 a
failed run, 130 Ctrl-C or SIGTERM.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module

import click

from gr_ros2 import __version__
from gr_ros2.cli.ending import BAD_INPUT, FAILED, INTERRUPTED, on_signals
from gr_ros2.core.errors import BackendMissingError, BagError, ConfigError, GrRos2Error, WireError, shortened
from gr_ros2.core.preferences import check_home

_BAD_INPUT_ERRORS = (ConfigError, WireError, BagError, BackendMissingError)
_GNU_RADIO = ("gnuradio", "pmt")
_NO_GNU_RADIO = (
    "this needs GNU Radio 3.10, which this Python does not find: apt install gnuradio, and install gr-ros2 in an "
    "environment made by /usr/bin/python3 -m venv --system-site-packages; without it there are packet, registry, "
    "key and scenarios, and with `phy: modem` or `direct` also plan, and replay by packets (`time: packets`)"
)
_LABORATORY = ("gr_ros2_lab", "matplotlib", "plotext", "pyarrow", "jinja2")
"""What only experiments need: the second package, and those of the extra ``lab``. The dashboard, sweeps and Zenoh name
theirs where they import it."""

Commands = Mapping[str, tuple[str, str]]
"""name -> (``module:attribute``, the line that help shows), in the order in which help lists them."""

PACKET_COMMANDS: Commands = {
    "decode": ("gr_ros2.cli.packet:decode_packets", "Packets (hex, binary or pcap) to readable fields."),
}
REGISTRY_COMMANDS: Commands = {
    "check": ("gr_ros2.cli.registry:check", "Validate a registry CSV; print its rows and digest."),
    "from-bag": ("gr_ros2.cli.registry:from_bag", "Write a registry from the topics of a bag."),
    "from-graph": ("gr_ros2.cli.registry:from_graph", "Write a registry from the topics on the ROS graph."),
}
COMMANDS: Commands = {
    "demo": ("gr_ros2_lab.cli.run:demo", "Two simulated robots over an OFDM link, with tables and pictures."),
    "run": ("gr_ros2_lab.cli.run:run", "One experiment: a built-in scenario or a YAML file."),
    "link": ("gr_ros2.cli.link:link", "One robot's end of a link, live: its ROS topics to the air and back."),
    "status": ("gr_ros2.cli.status:status", "What a running link does: who is heard, what crosses, what is dropped."),
    "top": ("gr_ros2.cli.top:top", "All links that run on this machine, side by side, live."),
    "peers": ("gr_ros2.cli.status:peers", "The robots that a running link hears."),
    "set": ("gr_ros2.cli.status:set_live", "Change a setting of a running link, such as whom a topic is for."),
    "ping": ("gr_ros2.cli.ping:ping", "Ask another robot over the link: round trip, loss, SNR, clocks."),
    "topics": ("gr_ros2.cli.wishes:topics", "What another robot would send if somebody asked: rates and bytes."),
    "throughput": ("gr_ros2.cli.throughput:throughput", "What the link carries each way beside the topics that run."),
    "spectrum": ("gr_ros2.cli.spectrum:spectrum", "What the front end hears while nothing is sent: where it is busy."),
    "want": ("gr_ros2.cli.wishes:want", "Ask another robot to send a topic for a while, or give it up."),
    "sound": ("gr_ros2.cli.sound:sound", "Sound cards as radios: devices, levels, echoes, and what fits."),
    "medium": ("gr_ros2_lab.cli.medium:medium", "One simulated channel for several links with front end zmq."),
    "doctor": ("gr_ros2.cli.doctor:doctor", "What this machine has and lacks for a link, and what mends it."),
    "plan": ("gr_ros2_lab.cli.plan:plan", "Does this traffic fit this radio? A forecast, and what to change."),
    "survey": ("gr_ros2_lab.cli.survey:survey", "Where a running link is good: a table and a figure over place."),
    "replay": ("gr_ros2_lab.cli.replay:replay", "A bag through a link into a bag: what arrives, and when."),
    "losses": ("gr_ros2_lab.cli.losses:losses", "How many packets a radio loses at which SNR, measured."),
    "sweep": ("gr_ros2_lab.cli.sweep:sweep", "One scenario at many settings, on all cores or a Dask cluster."),
    "report": ("gr_ros2_lab.cli.report:report", "The HTML report of one or several runs, from their folders."),
    "compare": ("gr_ros2_lab.cli.compare:compare", "Runs side by side: a table, and their curves in one figure."),
    "race": ("gr_ros2_lab.cli.race:race", "gr-ros2, DDS and Zenoh over the same radio, side by side (root)."),
    "ablate": ("gr_ros2_lab.cli.ablate:ablate", "What each part is worth: a scenario with one part off at a time."),
    "dashboard": ("gr_ros2.cli.dashboard:dashboard", "Open the live page of a run or link that goes on now."),
    "scenarios": ("gr_ros2_lab.cli.scenarios:scenarios", "List the built-in scenarios."),
    "packet": ("gr_ros2.cli.main:packet", "Look into packets."),
    "registry": ("gr_ros2.cli.main:registry", "Check and write topic registries."),
    "key": ("gr_ros2.cli.key:group", "Keys of a fleet, which seal the packets of version 1."),
    "wireshark": ("gr_ros2.cli.wireshark:wireshark", "The Wireshark dissector for captures made with --pcap."),
    "completion": ("gr_ros2.cli.completion:completion", "Completion of commands for bash, zsh and fish."),
    "grc-path": ("gr_ros2.cli.grc:grc_path", "The folder of block descriptions for GRC."),
}


class LazyGroup(click.Group):
    """A group whose commands are imported when called."""

    def __init__(self, commands: Commands, name: str, help: str) -> None:
        super().__init__(name=name, help=help, context_settings={"help_option_names": ["-h", "--help"]})
        self._lazy = commands

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        return super().parse_args(ctx, args or ["--help"])

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 - click's signature
        return list(self._lazy)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        if cmd_name not in self._lazy:
            return None
        check_home()
        module, _, attribute = self._lazy[cmd_name][0].partition(":")
        command = getattr(import_module(module), attribute)
        assert isinstance(command, click.Command)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name, command, rest = super().resolve_command(ctx, args)
        if not isinstance(command, LazyGroup):
            # The modules of the command are loaded. From now on, Ctrl-C and the SIGTERM of a service manager raise
            # KeyboardInterrupt, so that the command closes what it has opened and keeps what it has counted.
            on_signals(signal.default_int_handler)
        return name, command, rest

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        with formatter.section("Commands"):
            formatter.write_dl([(name, line) for name, (_, line) in self._lazy.items()])


packet = LazyGroup(PACKET_COMMANDS, "packet", "Look into packets.")
registry = LazyGroup(REGISTRY_COMMANDS, "registry", "Check and write topic registries.")
cli = click.version_option(__version__, prog_name="gr-ros2")(
    LazyGroup(COMMANDS, "gr-ros2", "Native ROS 2 topics over any GNU Radio physical layer, without IP.")
)


def run(arguments: Sequence[str] | None = None) -> int:
    """Run one command line and return its exit status; errors go to stderr as one line.

    :param arguments: the command line without the program's name, None for the process's own
    """
    try:
        status = cli.main(args=arguments, prog_name="gr-ros2", standalone_mode=False)
        sys.stdout.flush()
    except click.UsageError as error:
        command = error.ctx.command_path if error.ctx is not None else "gr-ros2"
        return _fail(f"{error.format_message().rstrip('.')}; see {command} --help", BAD_INPUT)
    except click.ClickException as error:
        return _fail(error.format_message(), BAD_INPUT)
    except (click.Abort, KeyboardInterrupt):
        return _fail("interrupted", INTERRUPTED)
    except GrRos2Error as error:
        return _fail(str(error), BAD_INPUT if isinstance(error, _BAD_INPUT_ERRORS) else FAILED)
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing in _LABORATORY:
            how = "apt install gr-ros2-lab, or pip install 'gr-ros2[lab]'"
            return _fail(f"this needs {missing}, of the laboratory: {how}", BAD_INPUT)
        if missing not in _GNU_RADIO:
            raise
        return _fail(_NO_GNU_RADIO, BAD_INPUT)
    except BrokenPipeError:
        _drop_output()  # the reader of our output (such as `| head`) has ended, which is no error
        return 0
    except OSError as error:
        # Code that writes a file reports its errors with its name. Other errors come here, such as those of our output.
        try:
            sys.stdout.flush()
        except OSError:
            _drop_output()
        return _fail(f"{error.filename or 'a file or the output'}: {error.strerror or error}", FAILED)
    return status if isinstance(status, int) else 0


def _drop_output() -> None:
    """Python writes at exit what the output has not taken yet; where that fails, the exit status is its own, 120."""
    sys.stdout = open(os.devnull, "w")


def _fail(message: str, status: int) -> int:
    print(f"gr-ros2: {shortened(' '.join(message.split()))}", file=sys.stderr)
    return status
