"""What a sound card, its loudspeaker, its microphone and the room between them are like, from one sweep that was played
and recorded. No card is opened here.

The impulse response comes from an exponential sweep (Farina, AES 108, 2000), the echo time from its backward integral
(Schroeder, J. Acoust. Soc. Am. 37, 1965; ISO 3382-2, T20).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import log10

import numpy as np
from numpy.typing import NDArray

from gr_ros2.radio.audio_bursts import CARD_RATE, Sound

LOWEST_HZ, HIGHEST_HZ = 300.0, 12_000.0
QUIET_S, SWEEP_S, AFTER_S = 0.5, 1.5, 1.5
"""s of silence, of the sweep, and of silence in which its echoes come."""
HEARD_DB = 20.0
"""Peak of the impulse response above the rms of its noise, dB, from which on the sweep was heard; of noise alone it is
13 dB."""
_DIRECT_S = 0.0025
"""s around the peak that count as the direct sound, as the ratio of direct sound to reverberation is usually taken."""
_MEDIAN = 0.6745
"""Median of the magnitude of Gaussian noise over its root mean square. Echoes are a small part of the response."""
_FADE = 480
_FULL = 0.99


@dataclass(frozen=True)
class SoundMeasured:
    """What was found.

    :param heard: whether the sweep came in at all
    :param level_db: root mean square of what came in during the sweep, dB of full scale
    :param noise_db: the same before the sweep
    :param clipped: share of recorded samples at full scale during the sweep
    :param silent: whether nothing but zeros came before the sweep, as from a muted or simulated microphone
    :param round_trip_s: s from a sample that is played to when it is recorded
    :param echo_s: RT60, s; None where it decays into the noise too early
    :param direct_db: energy of the direct sound over that of the rest, dB
    """

    heard: bool
    level_db: float
    noise_db: float
    clipped: float
    silent: bool
    round_trip_s: float | None = None
    echo_s: float | None = None
    direct_db: float | None = None


def sweep(level: float) -> Sound:
    """What to play: silence, the sweep, silence; shape (frames,).

    :param level: peak, 1 = full scale
    """
    at = np.arange(round(SWEEP_S * CARD_RATE)) / CARD_RATE
    rise = np.log(HIGHEST_HZ / LOWEST_HZ)
    tone = np.sin(2 * np.pi * LOWEST_HZ * SWEEP_S / rise * (np.exp(at / SWEEP_S * rise) - 1))
    fade = np.ones_like(tone)
    fade[:_FADE] = np.linspace(0, 1, _FADE)
    fade[-_FADE:] = fade[:_FADE][::-1]
    quiet, after = np.zeros(round(QUIET_S * CARD_RATE)), np.zeros(round(AFTER_S * CARD_RATE))
    played: Sound = np.concatenate([quiet, level * tone * fade, after]).astype(np.float32)
    return played


def measured(played: Sound, recorded: Sound) -> SoundMeasured:
    """Compare what was played with what came in.

    :param played: from :func:`sweep`
    :param recorded: of the same length, from the same moment on
    """
    quiet, during = round(QUIET_S * CARD_RATE), round((QUIET_S + SWEEP_S) * CARD_RATE)
    noise, sound = recorded[:quiet], recorded[quiet:]
    response = _response(played, recorded)
    peak = int(np.argmax(np.abs(response)))
    floor = float(np.median(np.abs(response[: round((SWEEP_S + AFTER_S) * CARD_RATE)]))) / _MEDIAN + 1e-12
    heard = bool(20 * log10(np.abs(response[peak]) / floor + 1e-12) > HEARD_DB and np.any(sound))
    told = SoundMeasured(
        heard,
        _db(recorded[quiet:during]),
        _db(noise),
        float(np.mean(np.abs(sound) > _FULL)),
        not np.any(noise),
    )
    if not heard:
        return told
    direct = round(_DIRECT_S * CARD_RATE)
    near = float(np.sum(response[max(peak - direct, 0) : peak + direct] ** 2))
    rest = max(float(np.sum(response[peak + direct : peak + CARD_RATE] ** 2)) - floor**2 * CARD_RATE, 1e-12)
    echo_s, direct_db = _echo_s(response[peak:], floor), 10 * log10(near / rest)
    return replace(told, round_trip_s=peak / CARD_RATE, echo_s=echo_s, direct_db=direct_db)


def _response(played: Sound, recorded: Sound) -> NDArray[np.float64]:
    """The impulse response from loudspeaker to microphone, within the swept band."""
    size = len(played) + len(recorded)
    was, came = np.fft.rfft(played, size), np.fft.rfft(recorded, size)
    power = np.abs(was) ** 2
    return np.fft.irfft(came * was.conj() / (power + 1e-3 * power.max()), size)[: len(recorded)]


def _echo_s(response: NDArray[np.float64], floor: float) -> float | None:
    energy = np.cumsum((response[: 2 * CARD_RATE] ** 2)[::-1])[::-1]
    decay = 10 * np.log10(energy / energy[0] + 1e-12)
    first, last = int(np.argmax(decay < -5)), int(np.argmax(decay < -25))
    if not 0 < first < last or np.sqrt(np.mean(response[first:last] ** 2)) < floor:
        return None
    at = np.arange(first, last) / CARD_RATE
    slope = float(np.polyfit(at, decay[first:last], 1)[0])
    return -60 / slope if slope < 0 else None


def _db(samples: Sound) -> float:
    return 10 * log10(float(np.mean(samples.astype(np.float64) ** 2)) + 1e-12)
