"""Simulated channels for sound: rooms by image sources, voice radios, and what moves or has another clock.

Sound is real, float, at ``CARD_RATE``. An SNR is mean power of the bursts over that of the noise in the PHY's sampled
band; a CNR is that of the carrier over the noise in the 11 kHz of a narrow FM receiver.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal

from gr_ros2.radio.audio_bursts import CARD_RATE

Wave = NDArray[np.floating[Any]]
SOUND_M_S = 343.0
_EARLIEST, _FM_BAND_HZ = 1e-3, 11_000
_SLOW_HZ = 50
"""Samples/s of a fading gain before it is interpolated."""


def power(sound: Wave) -> float:
    """Mean power of the bursts: where it is above a small share of the highest 10 ms."""
    parts = (sound[: len(sound) // 480 * 480].reshape(-1, 480) ** 2).mean(axis=1)
    return float(parts[parts > 0.03 * np.quantile(parts, 0.98)].mean())


def with_noise(sound: Wave, snr_db: float, band_hz: float, seed: int) -> Wave:
    """:param band_hz: the PHY's sampled band"""
    sigma = (power(sound) / 10 ** (snr_db / 10) * CARD_RATE / 2 / band_hz) ** 0.5
    return np.asarray(sound + sigma * np.random.default_rng(seed).standard_normal(len(sound)))


def room(echo_s: float, direct_db: float, seed: int) -> Wave:
    """The response of a random shoebox (Allen and Berkley, J. Acoust. Soc. Am. 65, 1979).

    Its walls absorb what makes the echo time by Eyring's formula. Echoes are scaled for the ratio that is asked for, as
    the place in the room would. Each image comes from a slightly other place, since no real wall is flat.

    :param echo_s: RT60
    :param direct_db: direct sound over echoes
    """
    draw = np.random.default_rng(seed)
    size = draw.uniform((3.0, 2.5, 2.4), (8.0, 6.0, 3.2))
    surface = 2 * (size[0] * size[1] + size[1] * size[2] + size[0] * size[2])
    reflects = np.exp(-0.161 * size.prod() / (surface * echo_s) / 2)  # amplitude at each wall
    source, ear = draw.uniform(0.2, 0.8, (2, 3)) * size
    reach = np.ceil(SOUND_M_S * echo_s / (2 * size)).astype(int)
    cells = np.stack(np.meshgrid(*(np.arange(-n, n + 1) for n in reach), indexing="ij"), -1).reshape(-1, 3)
    count = round(echo_s * CARD_RATE) + 1
    out = np.zeros(count)
    for odd in np.ndindex(2, 2, 2):
        flip = np.array(odd)
        images = (1 - 2 * flip) * source + 2 * cells * size
        bounces = (np.abs(cells - flip) + np.abs(cells)).sum(axis=1)
        images = images + draw.normal(scale=0.05, size=images.shape) * (bounces > 0)[:, None]
        away = np.maximum(np.linalg.norm(images - ear, axis=1), 0.1)
        at = np.rint(away / SOUND_M_S * CARD_RATE).astype(int)
        use = at < count
        np.add.at(out, at[use], (reflects**bounces / away)[use])
    first = int(np.argmax(np.abs(out) > 0))
    out = signal.sosfilt(signal.butter(2, 100, "high", fs=CARD_RATE, output="sos"), out[first:])
    direct, rest = out[:1].copy(), out.copy()
    rest[: round(_EARLIEST * CARD_RATE)] = 0
    rest *= (direct[0] ** 2 / 10 ** (direct_db / 10) / (rest**2).sum()) ** 0.5
    rest[0] = direct[0]
    return np.asarray(rest / np.sqrt((rest**2).sum()))


def through(sound: Wave, response: Wave) -> Wave:
    return np.asarray(signal.oaconvolve(sound, response))


def loudspeaker(sound: Wave) -> Wave:
    """A small one, and a small microphone: 200 to 8000 Hz."""
    for kind, order, edge in (("high", 2, 200), ("low", 4, 8000)):
        sound = signal.sosfilt(signal.butter(order, edge, kind, fs=CARD_RATE, output="sos"), sound)
    return sound


def faster(sound: Wave, ppm: float) -> Wave:
    """The same sound from a clock that is slower by so much, or from a robot that drives: 1 m/s are 2,900 ppm."""
    fine = signal.resample_poly(sound, 4, 1, window=("kaiser", 9.0))
    ratio = 1 + ppm * 1e-6
    at = 4 * ratio * np.arange(2, int(len(sound) / ratio) - 4)
    whole = at.astype(int)
    x = at - whole
    a, b, c, d = (fine[whole + k] for k in (-1, 0, 1, 2))  # cubic
    return np.asarray(b + 0.5 * x * (c - a + x * (2 * a - 5 * b + 4 * c - d + x * (3 * (b - c) + d - a))))


def voice_band(low: float, high: float) -> Wave:
    """The filter of a voice radio, as sections of second order."""
    return np.asarray(signal.butter(6, [low, high], "band", fs=CARD_RATE, output="sos"))


def narrow_fm(sound: Wave, cnr_db: float, seed: int, deviation_hz: float = 2500.0, use: float = 0.5) -> Wave:
    """A voice radio: 300 to 3000 Hz, pre-emphasis, limiter, FM, noise, discriminator, de-emphasis.

    :param use: root mean square of the deviation over its limit, before the limiter
    """
    tilt = np.diff(signal.sosfilt(voice_band(300, 3000), sound), prepend=0.0)
    tilt *= use / power(tilt) ** 0.5
    carrier = np.exp(2j * np.pi * deviation_hz / CARD_RATE * np.cumsum(np.clip(tilt, -1, 1)))
    draw = np.random.default_rng(seed)
    sigma = (10 ** (-cnr_db / 10) * CARD_RATE / _FM_BAND_HZ / 2) ** 0.5
    heard = carrier + sigma * (draw.standard_normal(len(sound)) + 1j * draw.standard_normal(len(sound)))
    heard = signal.sosfilt(signal.butter(4, _FM_BAND_HZ / 2, fs=CARD_RATE, output="sos"), heard)
    turn = np.angle(heard[1:] * heard[:-1].conj())
    return np.asarray(signal.sosfilt(voice_band(300, 3000), signal.lfilter([1], [1, -0.97], turn)))


def single_sideband(
    sound: Wave,
    snr_db: float,
    band_hz: float,
    seed: int,
    *,
    off_hz: float = 50.0,
    paths: Sequence[float] = (),
    spread_hz: float = 0.0,
) -> Wave:
    """300 to 2700 Hz, with an oscillator that is off.

    :param paths: s, by which each Rayleigh path is late (Watterson, ITU-R F.1487), with a Doppler spread of
        ``spread_hz``
    """
    draw = np.random.default_rng(seed)
    near = signal.hilbert(sound, fft.next_fast_len(len(sound)))[: len(sound)]
    if paths:
        heard = np.zeros_like(near)
        for delay in paths:
            gain = _fading(len(sound), spread_hz, draw) / len(paths) ** 0.5
            late = round(delay * CARD_RATE)
            heard[late:] += (gain * near)[: len(near) - late]
        near = heard
    shifted = (near * np.exp(2j * np.pi * off_hz / CARD_RATE * np.arange(len(sound)))).real
    return np.asarray(signal.sosfilt(voice_band(300, 2700), with_noise(shifted, snr_db, band_hz, seed)))


def _fading(count: int, spread_hz: float, draw: np.random.Generator) -> NDArray[np.complex128]:
    """A Rayleigh gain of power 1 with a Gaussian spectrum of twice this deviation."""
    slow_count = count * _SLOW_HZ // CARD_RATE + 400
    white = draw.standard_normal(slow_count) + 1j * draw.standard_normal(slow_count)
    shape = np.exp(-((np.pi * spread_hz * np.arange(-100, 101) / _SLOW_HZ) ** 2))
    slow = np.convolve(white, shape / np.sqrt(2 * (shape**2).sum()), "same")[200:-190]
    at, places = np.arange(count) / CARD_RATE * _SLOW_HZ, np.arange(len(slow))
    return np.asarray(np.interp(at, places, slow.real) + 1j * np.interp(at, places, slow.imag))
