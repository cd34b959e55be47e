"""The presets behind recordings: responses of rooms that were measured, and a busy band under a voice radio.

The folder named by the environment variable ``SOUND_RECORDINGS`` has them: ``*rir*.wav``, such as ``data/rir_clap.wav``
(CC0) and, in its history, ``data/brir_clap.wav`` of the repository
github.com/spatialaudio/selected-topics-in-audio-signal-processing-exercises; and ``test_*.wav``, such as those in
``test/wav/20m_busy`` of github.com/kgoba/ft8_lib (MIT).
"""

from __future__ import annotations

import os
from functools import partial
from math import gcd
from pathlib import Path

import numpy as np
from scipy import signal
from scipy.io import wavfile

from bench.rows import Row
from bench.sound import SNR_DB, Cell, cell_row, peer_row
from bench.sound_channels import Wave, faster, loudspeaker, power, through, voice_band, with_noise
from bench.sound_peers import peers
from gr_ros2.radio.audio_bursts import CARD_RATE

BELOW_DB = (10, 5)
"""dB by which the band is weaker than the bursts, both in 300 to 2700 Hz."""
_PPM = 50.0
_BEFORE_S, _DIRECT_S, _LASTS_S = 0.005, 0.0025, 1.0


def sound_recorded() -> list[Row]:
    """Packets that arrive, and messages of others' modems."""
    folder = Path(os.environ["SOUND_RECORDINGS"])
    rooms = [response for path in sorted(folder.glob("*rir*.wav")) for response in _responses(path)]
    bands = [_channels(path)[0] for path in sorted(folder.glob("test_*.wav"))]
    direct = ", ".join(f"{_direct_db(response):.0f}" for response in rooms)
    heard = partial(_in_room, rooms=rooms)
    cells = [Cell(name, f"{len(rooms)} measured responses, DRR {direct} dB", heard) for name in ("sound", "hall")]
    cells += [Cell("voice", f"busy band {db} dB below", partial(_busy, bands=bands, db=db)) for db in BELOW_DB]
    rows = [cell_row(cell) for cell in cells]
    return [*rows, *(peer_row(cell, peer) for cell in cells[1:] for peer in peers())]


def _channels(path: Path) -> list[Wave]:
    rate, samples = wavfile.read(path)
    common = gcd(rate, CARD_RATE)
    whole = samples.reshape(len(samples), -1).T.astype(float)
    return [np.asarray(signal.resample_poly(one, CARD_RATE // common, rate // common)) for one in whole]


def _responses(path: Path) -> list[Wave]:
    found = []
    for whole in _channels(path):
        peak = int(np.argmax(np.abs(whole)))
        cut = whole[max(peak - int(_BEFORE_S * CARD_RATE), 0) : peak + int(_LASTS_S * CARD_RATE)]
        found.append(np.asarray(cut / np.sqrt((cut**2).sum())))
    return found


def _direct_db(response: Wave) -> float:
    peak, around = int(np.argmax(np.abs(response))), int(_DIRECT_S * CARD_RATE)
    near = float((response[max(peak - around, 0) : peak + around] ** 2).sum())
    return float(10 * np.log10(near / (1 - near)))


def _in_room(sound: Wave, band_hz: float, seed: int, *, rooms: list[Wave]) -> Wave:
    heard = through(loudspeaker(sound), rooms[seed % len(rooms)])
    return with_noise(faster(heard, _PPM), SNR_DB, band_hz, seed)


def _busy(sound: Wave, _band_hz: float, seed: int, *, bands: list[Wave], db: float) -> Wave:
    """What other stations send, over bursts from a clock that is faster."""
    voice = voice_band(300, 2700)
    bursts = signal.sosfilt(voice, faster(sound, _PPM))
    place = np.random.default_rng(seed).integers(len(bands[0]))
    others = signal.sosfilt(voice, np.resize(np.roll(bands[seed % len(bands)], place), len(bursts)))
    return np.asarray(bursts + others * np.sqrt(power(bursts) / 10 ** (db / 10) / np.mean(others**2)))
