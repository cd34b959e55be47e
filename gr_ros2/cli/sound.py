"""`gr-ros2 sound check`: which sound devices there are, and what they and the room between them are like."""

from __future__ import annotations

import time

import click
import numpy as np
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table

from gr_ros2.cli.console import console as make_console
from gr_ros2.cli.ending import FAILED
from gr_ros2.cli.params import Number
from gr_ros2.core.backends import uninterrupted
from gr_ros2.core.errors import RadioError
from gr_ros2.phy import PHY
from gr_ros2.radio import FRONT_ENDS, PRESETS
from gr_ros2.radio.sound_check import SoundMeasured, measured, sweep
from gr_ros2.settings.fields import AUTO

_METER_S = 3.0
_TRIES = 2
"""A busy computer may lose what it plays once."""
_QUIETEST_DB = -80.0
_LOUD_DB, _WEAK_DB = -3.0, -50.0
"""dB of full scale at the microphone: above the first peaks are cut off, below the second a card's noise shows."""
_DRY_S = 0.6
"""RT60 up to which OFDM with the prefix of preset `sound` passes (docs/how-to/sound.md)."""
_AHEAD_S = 0.5
"""s from composing a packet to its sound, and from its end to its message. Before that a message waits for half of the
three slots of two robots: 2.4 s in all with preset `sound` (simulated)."""


@click.group("sound")
def sound() -> None:
    """Sound cards as radios: two laptops in a room, a cable, or a voice radio."""


@sound.command("check")
@click.option("--device", default=AUTO, metavar="NAME", help="Device that plays; default: the system's choice.")
@click.option("--device-rx", default=AUTO, metavar="NAME", help="Device that records; default: as --device.")
@click.option("--level", default=0.2, type=Number(0, 1, min_open=True), help="Of what is played, 1 = full.")
@click.option("--listen-only", is_flag=True, help="Play nothing: list the devices and show the level.")
def check(*, device: str, device_rx: str, level: float, listen_only: bool) -> int:
    """List the devices, show the level of the microphone, play a tone that rises, and say what came of it."""
    with uninterrupted():
        FRONT_ENDS.load("audio")
        from gr_ros2.radio.audio import device_of
        from gr_ros2.radio.audio_card import PortAudioError, devices, levels, look_again, play_and_record

    console = make_console()
    try:
        look_again()
        table = Table("Number", "Device", "Plays", "Records", box=None)
        for number, row in enumerate(devices()):
            yes = ["yes" if row[f"max_{way}_channels"] else "" for way in ("output", "input")]
            table.add_row(str(number), row["name"], *yes)
        console.print(table)
        plays, records = device_of(device), device_of(device if device_rx == AUTO else device_rx)
        end = time.monotonic() + _METER_S
        with Live(console=console, transient=True) as live:
            for peak in levels(records):
                shown = max(0.0, 20 * np.log10(max(peak, 1e-9)) - _QUIETEST_DB)
                live.update(ProgressBar(total=-_QUIETEST_DB, completed=shown))
                if time.monotonic() > end:
                    break
        if listen_only:
            return 0
        played = sweep(level)
        for _ in range(_TRIES):
            found = measured(played, play_and_record(played, plays, records))
            if found.heard:
                break
    except (PortAudioError, ValueError) as error:
        raise RadioError(f"sound: {' '.join(str(error).split())}") from error
    for line in said(found):
        console.print(line, soft_wrap=True)
    return 0 if found.heard else FAILED


def said(found: SoundMeasured) -> list[str]:
    """What was found, and what to do."""
    lines = [f"noise {found.noise_db:.0f} dB, sound {found.level_db:.0f} dB of full scale"]
    if not found.heard:
        why = (
            "the microphone gives digital silence: it is muted, or not the one meant"
            if found.silent
            else "is the loudspeaker muted, or its volume low? over a cable to another computer this is as it should be"
        )
        return [*lines, f"its own sound was not heard: {why}"]
    lines.append(f"round trip {(found.round_trip_s or 0) * 1e3:.0f} ms")
    if found.clipped or found.level_db > _LOUD_DB:
        lines.append(f"{found.clipped:.1%} of the samples are clipped: lower the microphone's gain, or the volume")
    elif found.level_db < _WEAK_DB:
        lines.append("weak: raise the volume, or the microphone's gain")
    if found.echo_s is not None and found.direct_db is not None:
        lines.append(f"echo time (RT60) {found.echo_s:.2f} s, direct sound over echoes {found.direct_db:.0f} dB")
    dry = found.echo_s is None or found.echo_s < _DRY_S
    if not dry:
        lines.append("this room echoes longer than preset sound is made for")
    lines.append(_expected("sound" if dry else "hall"))
    return lines


def _expected(name: str) -> str:
    preset = PRESETS[name]
    row, front_end = FRONT_ENDS[preset.front_end], FRONT_ENDS.load(preset.front_end)
    phy = PHY.load(preset.phy or row.phy)(
        preset.packet_len, preset.sample_rate or row.sample_rate, **preset.phy_options
    )
    airtime = front_end.airtime_with(phy, front_end.Options(**preset.settings))
    return (
        f"--radio {name} fits: packets of {preset.packet_len} B in {airtime:.2f} s, about {1 / airtime:.1f} small "
        f"messages/s for all robots together, {2.5 * airtime + _AHEAD_S:.1f} s old with two robots"
    )
