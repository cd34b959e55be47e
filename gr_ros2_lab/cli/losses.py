"""`gr-ros2 losses`: the share of packets a PHY delivers at each SNR, measured on its flowgraph."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
from rich import box
from rich.table import Table

from gr_ros2.cli.console import console as make_console
from gr_ros2.cli.params import Number, set_option
from gr_ros2.core.errors import ConfigError
from gr_ros2_lab.cli.params import OUT_FOLDER, SCENARIO
from gr_ros2_lab.medium.loss_table import PACKETS, STEP_DB, table_for
from gr_ros2_lab.run.load import make_phy
from gr_ros2_lab.run.scenario import Scenario, load_scenario


@click.command()
@click.argument("scenario", type=SCENARIO)
@click.option("--from", "low", type=Number(), default=0.0, show_default=True, help="Lowest SNR, dB.")
@click.option("--to", "high", type=Number(), default=20.0, show_default=True, help="Highest SNR, dB.")
@click.option("--packets", type=click.IntRange(min=1), default=PACKETS, show_default=True, help="Sent at each SNR.")
@click.option("--out", type=OUT_FOLDER, help="Folder to keep the table in; default the cache.")
@set_option(Scenario)
def losses(
    scenario: str, *, low: float, high: float, packets: int, out: Path | None, overrides: tuple[str, ...]
) -> None:
    """Measure the packet loss of SCENARIO's radio, packet length and channel, for runs with time=packets.

    What is measured already is not measured again. Half a dB lies between two points.
    """
    chosen = load_scenario(scenario, overrides)
    phy = make_phy(chosen, chosen.load_registry())
    if not phy.has_samples:
        raise ConfigError(f"phy.name = {phy.name!r}: has no samples, so it loses nothing; set a radio")
    if not -50 <= low <= high <= 100:
        raise ConfigError(f"--from {low:g} --to {high:g}: write two SNRs of -50 to 100 dB, the lower one first")
    steps = np.arange(np.floor(low / STEP_DB), np.ceil(high / STEP_DB) + 1) * STEP_DB
    snrs: list[float | None] = [None, *steps.tolist()]
    table = table_for(phy, chosen.channel, set(snrs), packets=packets, folder=out)
    shown = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in ("SNR [dB]", "sent", "delivered", "PDR"):
        shown.add_column(heading.replace("[", r"\["), justify="right")
    for snr_db in snrs:
        point = table.points[snr_db]
        name = "no noise" if snr_db is None else f"{snr_db:g}"
        shown.add_row(name, str(point.sent), str(point.delivered), f"{point.pdr:.4f}")
    make_console().print(shown)
