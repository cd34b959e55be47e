"""The presets of the front end `audio` in simulated channels, and other programs' modems in the same.

Premise: every cell carries packets of random bytes, as long as the preset's longest, each after .3 to .6 s of silence,
in 20 channels drawn at random; clocks are 50 ppm apart where nothing else is said, and loudspeaker and microphone pass
200 to 8000 Hz. A rate is that of a packet's bytes over the airtime of its burst, silence and key not counted. Others'
modems pass the same channels, each with a text of 64 letters: some of theirs take seven seconds.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from scipy import signal

from bench.rows import Row
from bench.sound_channels import Wave, faster, loudspeaker, narrow_fm, room, single_sideband, through, with_noise
from bench.sound_peers import TEXT_LEN, Peer, peers
from gr_ros2.phy import PHY
from gr_ros2.radio import FRONT_ENDS, PRESETS
from gr_ros2.radio.audio_bursts import CARD_RATE, Upconverter

CHANNELS, PACKETS = 20, 5
SNR_DB = 20.0
CLOCK_PPM, DRIVING_PPM = 300.0, 2900.0
_PPM = 50.0
_PIECE = 4096
_LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789"
Channel = Callable[[Wave, float, int], Wave]
"""From sound, the PHY's sampled band in Hz, and the number of the channel, to sound."""


def _in_room(sound: Wave, band_hz: float, seed: int, *, echo_s: float, direct_db: float, ppm: float = _PPM) -> Wave:
    heard = through(loudspeaker(sound), _room(echo_s, direct_db, seed))
    return with_noise(faster(heard, ppm), SNR_DB, band_hz, seed)


_room = cache(room)


def _alone(sound: Wave, band_hz: float, seed: int, ppm: float) -> Wave:
    return with_noise(faster(sound, ppm if seed % 2 else -ppm), SNR_DB, band_hz, seed)


def _fm(sound: Wave, _band_hz: float, seed: int, cnr_db: float) -> Wave:
    return faster(narrow_fm(sound, cnr_db, seed), _PPM)


def _ssb(sound: Wave, band_hz: float, seed: int, snr_db: float) -> Wave:
    return faster(single_sideband(sound, snr_db, band_hz, seed), _PPM)


def _moderate(sound: Wave, band_hz: float, seed: int, snr_db: float) -> Wave:
    return faster(single_sideband(sound, snr_db, band_hz, seed, paths=(0.0, 0.001), spread_hz=0.5), _PPM)


@dataclass(frozen=True)
class Cell:
    """A preset in a channel, and what has to arrive at which rate; 0: a figure."""

    preset: str
    what: str
    channel: Channel
    share: float = 0.0
    bit_s: float = 0.0


BESIDE = [
    Cell("sound", "room, RT60 .4 s, DRR 0 dB", partial(_in_room, echo_s=0.4, direct_db=0.0), 0.98),
    Cell("hall", "room, RT60 .4 s, DRR -6 dB", partial(_in_room, echo_s=0.4, direct_db=-6.0), 0.9, 300),
    Cell("hall", "room, RT60 .6 s, DRR -6 dB", partial(_in_room, echo_s=0.6, direct_db=-6.0), 0.9, 300),
    Cell("voice", "narrow FM, CNR 10 dB", partial(_fm, cnr_db=10.0), 0.98, 1000),
    Cell("voice", "SSB 50 Hz off, 10 dB", partial(_ssb, snr_db=10.0), 0.98, 1000),
    Cell("voice", "the same, Watterson moderate", partial(_moderate, snr_db=10.0)),
]
"""Where others' modems are tried, too."""
_PACES = [(name, CLOCK_PPM) for name in ("sound", "hall", "voice", "cable")]
_PACES += [(name, DRIVING_PPM) for name in ("sound", "hall")]  # what comes by radio or cable does not drive through air
CELLS = [
    *BESIDE,
    *(Cell(name, f"{ppm:g} ppm faster or slower", partial(_alone, ppm=ppm), 0.98) for name, ppm in _PACES),
    *(
        Cell("sound", f"that room, {ppm:g} ppm faster", partial(_in_room, echo_s=0.4, direct_db=0.0, ppm=ppm), 0.95)
        for ppm in (CLOCK_PPM, DRIVING_PPM)
    ),
]


def sound() -> list[Row]:
    """Packets that arrive, by preset and channel."""
    return [cell_row(cell) for cell in CELLS]


def sound_beside() -> list[Row]:
    """What others' modems carry in the same channels."""
    return [peer_row(cell, peer) for cell in BESIDE for peer in peers()]


def peer_row(cell: Cell, peer: Peer) -> Row:
    arrived, seconds, band = 0, 0.0, preset_phy(cell.preset).sample_rate
    for seed in range(CHANNELS):
        draw = random.Random(seed)
        text = "".join(draw.choices(_LETTERS, k=TEXT_LEN))
        said = peer.spoken(text)
        seconds += len(said) / CARD_RATE
        played = np.concatenate([np.zeros(int(draw.uniform(0.3, 0.6) * CARD_RATE)), said, np.zeros(CARD_RATE)])
        arrived += text in peer.heard(cell.channel(played, band, seed))
    what, note = f"{peer.name} where {cell.preset} is: {cell.what}", f"{8 * TEXT_LEN * CHANNELS / seconds:.0f} bit/s"
    return Row(f"{what}: messages", arrived / CHANNELS, form="{:.2f}", note=note)


def preset_phy(name: str) -> Any:
    """The PHY of a preset, as a link has it."""
    preset = PRESETS[name]
    row = FRONT_ENDS[preset.front_end]
    rate = preset.sample_rate or row.sample_rate
    return PHY.load(preset.phy or row.phy)(preset.packet_len, rate, **preset.phy_options)


def cell_row(cell: Cell) -> Row:
    phy, centre = preset_phy(cell.preset), float(PRESETS[cell.preset].settings.get("centre_hz", 4500.0))
    rate, arrived = 8 * phy.packet_len / phy.airtime(), 0
    for seed in range(CHANNELS):
        played, packets = spoken(phy, centre, seed)
        arrived += len(heard(phy, cell.channel(played, phy.sample_rate, seed), centre) & set(packets))
    what, note = f"{cell.preset}: {cell.what}", f"{rate:.0f} bit/s"
    share = arrived / (CHANNELS * PACKETS)
    if rate < cell.bit_s:
        return Row(f"{what}: bit/s", rate, "", "≥", cell.bit_s, note=f"{share:.2f} of the packets")
    return Row(f"{what}: packets", share, "", "≥" if cell.share else None, cell.share, "{:.2f}", note)


def spoken(phy: Any, centre_hz: float, seed: int) -> tuple[Wave, list[bytes]]:
    """Sound of bursts, each after some silence, and their packets."""
    draw, parts, packets = random.Random(seed), [], []
    for _ in range(PACKETS):
        packets.append(draw.randbytes(phy.packet_len))
        parts += [np.zeros(phy.gap + int(draw.uniform(0.3, 0.6) * phy.sample_rate)), phy.modem.modulate(packets[-1])]
    whole = np.concatenate([*parts, np.zeros(int(0.7 * phy.sample_rate))]).astype(np.complex64)
    return Upconverter(phy.sample_rate, centre_hz)(whole), packets


def heard(phy: Any, sound: Wave, centre_hz: float) -> set[bytes]:
    """The packets that a receiver finds in a sound."""
    mixed = sound * np.exp(-2j * np.pi * centre_hz / CARD_RATE * np.arange(len(sound))) * 2**0.5
    samples = signal.resample_poly(mixed, 1, round(CARD_RATE / phy.sample_rate), window=("kaiser", 7.0))
    if phy.receiver_taps is not None:
        samples = np.convolve(samples, phy.receiver_taps)
    engine, samples = phy.running_modem.receiver(), samples.astype(np.complex64)
    return {got.data for at in range(0, len(samples), _PIECE) for got in engine.feed(samples[at : at + _PIECE])}
