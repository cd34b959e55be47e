"""The adaptive rate of `ofdm` beside each of its rates alone, in simulated time: at constant SNRs, and where it fades.

Messages fill one packet of 220 B each. The receiver reports on a channel of its own, whose reports come 5 ms after
their airtime. An MCS alone is the same link with a table of this one MCS.
"""

from __future__ import annotations

from bisect import bisect
from collections.abc import Iterator
from itertools import count
from pathlib import Path

from bench.rows import Row
from gr_ros2.link.events import Delivered
from gr_ros2.phy.ofdm import RATES
from gr_ros2.settings.files import find_registry
from gr_ros2_lab.run.load import make_phy
from gr_ros2_lab.run.scenario import scenario_from
from gr_ros2_lab.run.simulate import Offered, Simulation

PACKET_LEN, MESSAGE_LEN = 220, 205
SNRS_DB = range(31)
FASTEST = 1400.0
"""messages/s, more than the fastest MCS carries."""
WARM_UP_S, MEASURED_S = 1.0, 3.0
MEANS_DB, DOPPLER_HZ, FADING_S = (10.0, 15.0), 2.0, 20.0
LATE_S = 2.0
"""s after which a message in the fading channel does not count as delivered: a backlog must not hide an overload."""
HOLD_S = 0.2
"""s that a message waits for an earlier one that may yet be repaired."""
LOADS = tuple(round(50 * 1.05**step) for step in range(70))
"""messages/s that are tried in the fading channel."""
PDR = 0.99
NEAR, GAIN = 0.9, 1.5


def carried(rates: tuple[str, ...], channel: dict[str, float], load: float, seconds: float) -> tuple[float, float]:
    """Messages delivered per second after the warm-up, and share of the messages delivered within ``LATE_S``.

    :param rates: names of the rates from which the rate is chosen
    :param load: messages/s offered
    """
    scenario = scenario_from(
        {
            "name": "rate",
            "registry": find_registry("odom", Path()),
            "time": "packets",
            "packet_len": PACKET_LEN,
            "robots": [{}, {"topics": []}],
            "topics": {"odom": {"queue": "fifo"}},
            "compression": False,
            "queue_depth": 1000,
            "phy": {"name": "ofdm", "sample_rate": 1e6, "options": {"rate": "adaptive", "rates": rates}},
            "channel": channel,
            "hold_s": HOLD_S if not channel.get("doppler_hz") else 1.0,
            "paths": [{"from": 2, "delay_s": 0.005}],
            "duration_s": seconds,
            "drain_s": LATE_S,
        }
    )
    registry = scenario.load_registry()
    run = Simulation(scenario, registry, make_phy(scenario, registry), messages=[messages(load, seconds)])
    whole = [(now, event.payload) for now, _, event in run.events() if isinstance(event, Delivered)]
    settled = sum(WARM_UP_S <= now < seconds for now, _ in whole)
    in_time = sum(now - int.from_bytes(payload[:4], "big") / load <= LATE_S for now, payload in whole)
    return settled / (seconds - WARM_UP_S), in_time / int(load * seconds)


def messages(load: float, seconds: float) -> Iterator[Offered]:
    """Messages at equal distances."""
    for number in count():
        if (at := number / load) >= seconds:
            return
        yield Offered(at, 0, number.to_bytes(4, "big") + bytes(MESSAGE_LEN - 4))


def constant() -> list[tuple[int, float, dict[str, float]]]:
    """For each SNR in dB: messages/s delivered with the adaptive rate, and with each MCS alone."""
    seconds = WARM_UP_S + MEASURED_S
    found = []
    for snr_db in SNRS_DB:
        alone = {name: carried((name,), {"snr_db": snr_db}, FASTEST, seconds)[0] for name in RATES}
        found.append((snr_db, carried(tuple(RATES), {"snr_db": snr_db}, FASTEST, seconds)[0], alone))
    return found


def most(rates: tuple[str, ...], mean_db: float) -> float:
    """The highest load, messages/s, of which at least ``PDR`` is delivered in the fading channel."""

    def too_much(load: float) -> bool:
        fading = [{"snr_db": mean_db, "doppler_hz": DOPPLER_HZ, "seed": seed} for seed in (1, 2)]
        return min(carried(rates, channel, load, FADING_S)[1] for channel in fading) < PDR

    return (0.0, *LOADS)[bisect(LOADS, False, key=too_much)]


def rate() -> list[Row]:
    """The adaptive rate against the best of its rates."""
    rows = []
    for snr_db, adaptive, alone in constant():
        best = max(alone, key=alone.__getitem__)
        if alone[best]:
            note = f"{adaptive:.0f} messages/s; best {best}, {alone[best]:.0f}"
            rows.append(
                Row(f"rate at {snr_db} dB, of the best MCS's", adaptive / alone[best], "", "≥", NEAR, "{:.2f}", note)
            )
    for mean_db in MEANS_DB:
        loads = {name: most((name,), mean_db) for name in RATES}
        best = max(loads, key=loads.__getitem__)
        adaptive = most(tuple(RATES), mean_db)
        note = f"{adaptive:.0f} messages/s at PDR ≥ {PDR}; best {best}, {loads[best]:.0f}"
        what = f"rate, Rayleigh {DOPPLER_HZ:g} Hz, {mean_db:g} dB, of the best MCS's"
        gain = adaptive / loads[best] if loads[best] else float("inf")
        rows.append(Row(what, gain, "", "≥", GAIN, "{:.2f}", note))
    return rows
