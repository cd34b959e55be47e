"""Bursts as sound: complex baseband to a real passband and in time to a sound card. No card is opened here.

Invariants: a burst begins at the frame that sounds at its time, or as soon as the one before has ended; it is never cut
and never mixed with another; between bursts there is silence. A burst that is too late for its time is left out, since
it would sound in somebody else's.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

CARD_RATE = 48_000
"""Frames/s of every sound card."""
LATE_S = 0.01
"""s by which a burst may begin later than asked. Medium access keeps as much silence between two robots."""
MOST_WAITING = 16
"""Bursts that wait for their time. The gate hands over one or two ahead of time; with more, the card stands still."""
_JUMP_S = 0.02
"""A stream whose next block is off by more, s, has lost or repeated frames. What a sound server says of its times
jitters by up to half of this."""
_FOLLOW = 0.01
"""Share of a smaller error by which the times of a block are corrected: with 10 ms a block, 1 s until it is gone."""
_HALF = 10
"""Samples of the baseband on each side of a frame of which the interpolating filter makes it."""
_KAISER = 7.0
"""Window of that filter: images 70 dB below the signal."""

Sound = NDArray[np.float32]


class StreamClock:
    """When the frames of a stream are at the converter. Servers tell the times of whole blocks, with jitter."""

    def __init__(self) -> None:
        self._next: float | None = None

    def begin(self, told: float, frames: int) -> tuple[float, bool]:
        """The time of the first frame of the next block, s, and whether it follows the block before without a gap.

        :param told: s, as the server says it
        :param frames: length of the block
        """
        follows = self._next is not None and abs(told - self._next) < _JUMP_S
        at = self._next + _FOLLOW * (told - self._next) if self._next is not None and follows else told
        self._next = at + frames / CARD_RATE
        return at, follows


class Upconverter:
    """Makes sound of complex samples, with the same root mean square.

    :param sample_rate: samples/s; ``CARD_RATE`` is a multiple of it
    :param centre_hz: frequency that 0 Hz becomes
    """

    def __init__(self, sample_rate: float, centre_hz: float) -> None:
        self._step = round(CARD_RATE / sample_rate)
        at = np.arange(-_HALF * self._step, _HALF * self._step + 1)
        self._taps = np.sinc(at / self._step) * np.kaiser(len(at), _KAISER) if self._step > 1 else np.ones(1)
        self._turn = 2j * np.pi * centre_hz / CARD_RATE

    def __call__(self, samples: NDArray[np.complex64]) -> Sound:
        wide = np.zeros(len(samples) * self._step, np.complex64)
        wide[:: self._step] = samples
        band = np.convolve(wide, self._taps, "same")[: len(wide)] if self._step > 1 else wide
        sound: Sound = (np.sqrt(2) * band * np.exp(self._turn * np.arange(len(wide)))).real.astype(np.float32)
        return sound


class Played(NamedTuple):
    """When a burst sounds, silence before and after it included, s, monotonic."""

    begin: float
    end: float


class BurstQueue:
    """The bursts that wait to be played. One thread adds, another one fills the card's blocks.

    :ivar counted: ``bursts_out``: played to the end; ``late``: left out because their time was over; ``unsent``: left
        out because too many waited
    """

    def __init__(self) -> None:
        self._waiting: deque[tuple[float | None, Sound]] = deque()
        self._playing: Sound | None = None
        self._done = 0
        self._lock = threading.Lock()
        self.counted = Counter({"bursts_out": 0, "late": 0, "unsent": 0})

    def add(self, sound: Sound, at: float | None) -> None:
        """:param at: s, when its first frame sounds; None for as soon as possible"""
        with self._lock:
            if len(self._waiting) < MOST_WAITING:
                self._waiting.append((at, sound))
            else:
                self.counted["unsent"] += 1

    @property
    def idle(self) -> bool:
        """Whether nothing waits or plays."""
        with self._lock:
            return not self._waiting and self._playing is None

    def fill(self, block: Sound, begins_at: float) -> list[Played]:
        """Fill a block of the card.

        :param block: shape (frames,)
        :param begins_at: s, when its first frame sounds
        :return: the bursts that begin in it
        """
        block[:] = 0
        place, begun = 0, list[Played]()
        with self._lock:
            while place < len(block):
                if self._playing is None:
                    if not self._waiting:
                        break
                    at, sound = self._waiting[0]
                    begin = place if at is None else round((at - begins_at) * CARD_RATE)
                    if begin >= len(block):
                        break
                    self._waiting.popleft()
                    if begin < place - LATE_S * CARD_RATE:
                        self.counted["late"] += 1
                        continue
                    place = max(place, begin)
                    sounds_at = begins_at + place / CARD_RATE
                    begun.append(Played(sounds_at, sounds_at + len(sound) / CARD_RATE))
                    self._playing, self._done = sound, 0
                part = self._playing[self._done : self._done + len(block) - place]
                block[place : place + len(part)] = part
                place += len(part)
                self._done += len(part)
                if self._done == len(self._playing):
                    self._playing = None
                    self.counted["bursts_out"] += 1
        return begun
