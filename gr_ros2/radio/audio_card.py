"""A sound card through PortAudio, as GNU Radio blocks: bursts to the loudspeaker, and what the microphone hears.

GNU Radio's own blocks for sound have no times and count no losses. Here the card's thread calls back with the time of
each block.

Invariants: the callbacks neither wait nor raise; each received sample's time is known, and where samples are missing a
tag says so; everything lost is counted.
"""

from __future__ import annotations

import signal
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
import pmt
from gnuradio import filter as gr_filter
from gnuradio import gr
from gnuradio.fft import window
from numpy.typing import NDArray

from gr_ros2.phy.stream_times import RX_TIME, whole_and_rest
from gr_ros2.phy.threads import KeepsThreadState
from gr_ros2.radio.audio_bursts import CARD_RATE, BurstQueue, Played, Sound, StreamClock, Upconverter
from gr_ros2.radio.bursts import BurstCutter
from gr_ros2.radio.front_end import AGAIN_MS


@contextmanager
def _signals_kept() -> Iterator[None]:
    """PulseAudio's part of ALSA blocks SIGPIPE in a thread that calls it. What is started later would inherit that."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


try:
    with _signals_kept():
        import sounddevice
except ImportError:
    raise
except OSError as missing:  # the package is there, and the library that it loads is not
    raise ImportError(f"{missing}; apt install libportaudio2") from missing
except Exception as failed:  # PortAudio does not start; its own class of errors is not there yet
    raise ImportError(f"PortAudio does not start ({failed})") from failed

PortAudioError = sounddevice.PortAudioError
_BLOCK = 480
"""Frames of a block, 10 ms."""
_PASS_S = 0.15
"""s before a block is made in which a burst must come: its way through GNU Radio's buffers, and two blocks."""
_SETTLED = 20
"""Blocks after which a server has settled on how far ahead it asks for them."""
_OPEN_S = 10.0
"""s in which a card must ask for so many blocks: with a load of seven per core, some take longer than two."""
_FAR_S = 2.0
"""s that the time of a block at the converter is away from now at most; what is more is wrong."""
_MOST_BLOCKS = 1000
"""Blocks that may wait for the flowgraph, 10 s."""
_WAIT_S = 0.05
_FULL = 0.99
"""A sample beyond this share of full scale counts as clipped."""
_REMEMBERED = 64
_ANSWER_S = 20.0
"""s that PortAudio may take to look for devices."""
_opening = threading.Lock()
_streams: set[Any] = set()
"""Those of this process that are open."""
_RX_RATE = pmt.intern("rx_rate")


@_signals_kept()
def devices() -> list[dict[str, Any]]:
    """The sound devices that are there now: ``name``, ``max_input_channels``, ``max_output_channels``.

    :raises PortAudioError: when there is none
    """
    found = [dict(device) for device in sounddevice.query_devices()]
    if not found:
        raise PortAudioError("there is no sound device, or the sound server does not run")
    return found


def levels(device: str | int | None) -> Iterator[float]:
    """The peaks of what comes in, 1 = full scale, ten a second, until the iterator is closed.

    :raises PortAudioError, ValueError: when there is no such device, or it does not start
    """
    with _signals_kept(), sounddevice.InputStream(CARD_RATE, 0, device, 1, "float32") as stream:
        while True:
            heard, _ = stream.read(CARD_RATE // 10)
            yield float(np.abs(heard).max())


@_signals_kept()
def play_and_record(sound: Sound, plays: str | int | None, records: str | int | None) -> Sound:
    """Play, and return what came in from the first sample on, shape (frames,).

    :raises PortAudioError, ValueError: when there is no such device, or it does not start
    """
    heard = np.zeros((len(sound), 1), np.float32)
    sounddevice.playrec(sound[:, None], CARD_RATE, out=heard, device=(records, plays), latency="high", blocking=True)
    return np.asarray(np.nan_to_num(heard[:, 0]), np.float32)


@_signals_kept()
def look_again() -> None:
    """Forget the list of devices, which PortAudio makes once, unless a stream of this process is open.

    :raises PortAudioError: when the sound system does not answer
    """
    with _opening:
        if not _streams:
            _within(_ANSWER_S, _list_anew)


def _list_anew() -> None:
    with suppress(PortAudioError):  # the last time may have failed
        sounddevice._terminate()
    sounddevice._initialize()


def _within(seconds: float, work: Callable[[], None]) -> None:
    """Do what may hang, as libjack does now and then when no JACK server runs (``pthread_cond_destroy`` waits for ever
    in ``jack_client_open``): in a thread of its own, so that a signal still ends the program.

    :raises PortAudioError: when it takes longer, or from the work
    """
    failed: list[Exception] = []

    def run() -> None:
        try:
            work()
        except PortAudioError as error:
            failed.append(error)

    thread = threading.Thread(target=run, name="portaudio", daemon=True)
    thread.start()
    thread.join(seconds)
    if thread.is_alive():
        raise PortAudioError("PortAudio hangs while it looks for devices: start this program again")
    if failed:
        raise failed[0]


@_signals_kept()
def _opened(kind: type[Any], device: str | int | None, latency_s: float, callback: Callable[..., None]) -> Any:
    with _opening:
        devices()
        stream = kind(CARD_RATE, _BLOCK, device, 1, "float32", latency_s, callback=callback)
        _streams.add(stream)
    return stream


@_signals_kept()
def _close(stream: Any) -> None:
    stream.abort(ignore_errors=True)
    stream.close(ignore_errors=True)
    _streams.discard(stream)


def _from_now(told: float, now: float, otherwise: float) -> float:
    """s from the call to when a block is at the converter; some systems tell no times, and others wrong ones."""
    away = told - now
    return away if now > 0 and told > 0 and abs(away) < _FAR_S else otherwise


class Speaker(KeepsThreadState, gr.sync_block):  # type: ignore[misc]
    """Takes whole bursts and plays each at its time. It plays silence from when it is made until it is closed.

    :param device: name or number of the device, None for the system's own choice
    :param longest: samples of the longest burst
    :param sample_rate: samples/s of what it takes
    :param centre_hz: the middle of the band that sounds
    :param latency_s: s that the card is asked to be ahead
    :param tone: a sample with which to fill so many samples at the start of each burst, for a transmitter that only
        keys when it hears something
    :param begun: called with the times of each burst when its first block is made
    :raises PortAudioError: when there is no such device, or it does not start
    :ivar lead_s: s at the most, from when a block is made until it sounds
    """

    def __init__(
        self,
        device: str | int | None,
        longest: int,
        sample_rate: float,
        *,
        centre_hz: float,
        latency_s: float,
        tone: tuple[float, int] = (0.0, 0),
        begun: Callable[[Played], None] = lambda _: None,
    ) -> None:
        super().__init__("gr_ros2_speaker", [np.complex64], None)
        self._cutter = BurstCutter(longest, tagged=True)
        self._up, self._tone, self._begun = Upconverter(sample_rate, centre_hz), tone, begun
        self._queue, self._clock = BurstQueue(), StreamClock()
        self._counted = Counter({"underflows": 0, "clipped": 0})
        self._played: deque[Played] = deque(maxlen=_REMEMBERED)
        self.blocks = 0
        """Blocks made so far."""
        self.lead_s = 0.0
        self._stream = _opened(sounddevice.OutputStream, device, latency_s, self._fill)
        try:
            with _signals_kept():
                self._stream.start()
            end = time.monotonic() + _OPEN_S
            while self.blocks < _SETTLED:
                if time.monotonic() > end:
                    raise PortAudioError("the device takes no sound")
                time.sleep(_BLOCK / CARD_RATE)
        except BaseException:
            self.close()
            raise

    @property
    def ahead_s(self) -> float:
        """s before it sounds that a burst must come."""
        return self.lead_s + _PASS_S

    def played(self, begin: float, end: float) -> list[tuple[float, float]]:
        """Begin and end of the bursts that sound within an interval, s, monotonic. Any thread may ask."""
        return [played for played in tuple(self._played) if played.begin <= end and begin <= played.end]

    @property
    def idle(self) -> bool:
        """Whether no burst waits."""
        return self._queue.idle and not self.played(time.monotonic(), float("inf"))

    def counters(self) -> dict[str, int]:
        """Those of :class:`BurstQueue`; ``underflows``: blocks that came too late for the card; ``clipped``: frames
        beyond full scale."""
        return {**self._queue.counted, **self._counted}

    def close(self) -> None:
        """Stop and release the device. Idempotent."""
        _close(self._stream)

    def work(self, input_items: list[NDArray[np.complex64]], output_items: list[Any]) -> int:  # noqa: ARG002
        bursts, taken = self._cutter.cut(self, input_items[0])
        for burst in bursts:
            level, count = self._tone
            burst.samples[:count] = level
            sound = self._up(burst.samples)
            self._counted["clipped"] += int((np.abs(sound) > 1).sum())
            self._queue.add(np.clip(sound, -1, 1), burst.leave_at)
        return taken

    def _fill(self, out: Sound, frames: int, times: Any, status: Any) -> None:
        self._counted["underflows"] += bool(status.output_underflow) and self.blocks > _SETTLED
        lead_s = _from_now(times.outputBufferDacTime, times.currentTime, self._stream.latency)
        sounds_at, _ = self._clock.begin(time.monotonic() + lead_s, frames)
        self.lead_s = max(self.lead_s, lead_s)
        for played in self._queue.fill(out[:, 0], sounds_at):
            self._played.append(played)
            self._begun(played)
        self.blocks += 1


class _Recorder(KeepsThreadState, gr.sync_block):  # type: ignore[misc]
    """Gives the card's samples; the first of those that do not follow the one before has a tag with its time."""

    def __init__(self, device: str | int | None, latency_s: float, delay_s: float) -> None:
        super().__init__("gr_ros2_recorder", None, [np.float32])
        self.set_blkd_input_timer_value(AGAIN_MS)
        self._delay_s = delay_s
        self._blocks: deque[tuple[float, bool, Sound]] = deque()
        self._more = threading.Condition()
        self._clock, self._gap, self._asked = StreamClock(), True, False
        self.blocks = self.clipped = self.unread = 0
        self.heard_until = 0.0
        """s, monotonic, of the newest sample that was given to the flowgraph."""
        self.loud_at = time.monotonic()
        """s, monotonic, when a sample other than zero came last."""
        self._stream = _opened(sounddevice.InputStream, device, latency_s, self._take)
        try:
            with _signals_kept():
                self._stream.start()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        _close(self._stream)

    def _take(self, data: Sound, frames: int, times: Any, status: Any) -> None:
        self.blocks += 1
        peak = float(np.abs(data).max(initial=0.0))
        self.clipped += peak > _FULL
        now = time.monotonic()
        if peak > 0:
            self.loud_at = now
        told = now + _from_now(times.inputBufferAdcTime, times.currentTime, -self._stream.latency)
        at, follows = self._clock.begin(told, frames)
        with self._more:
            if not self._asked:
                return
            self._gap |= not follows or bool(status.input_overflow)
            if len(self._blocks) >= _MOST_BLOCKS:
                self._gap = True
                self.unread += 1
                return
            self._blocks.append((at, self._gap, data[:, 0].copy()))
            self._gap = False
            self._more.notify()

    def work(self, input_items: list[Any], output_items: list[Sound]) -> int:  # noqa: ARG002
        out = output_items[0]
        with self._more:
            self._asked = True
            if not self._more.wait_for(lambda: self._blocks, _WAIT_S):
                return 0
            at, gap, data = self._blocks.popleft()
            count = min(len(data), len(out))
            self.heard_until = at + count / CARD_RATE
            if count < len(data):
                self._blocks.appendleft((self.heard_until, False, data[count:]))
        if gap:
            place = self.nitems_written(0)
            self.add_item_tag(0, place, RX_TIME, whole_and_rest(at - self._delay_s))
            self.add_item_tag(0, place, _RX_RATE, pmt.from_double(CARD_RATE))
        out[:count] = data[:count]
        return count


class Microphone(gr.hier_block2):  # type: ignore[misc]
    """Gives what a card hears as complex baseband.

    :param device: name or number of the device, None for the system's own choice
    :param sample_rate: samples/s of what it gives; ``CARD_RATE`` is a multiple of it
    :param centre_hz: frequency that becomes 0 Hz
    :param latency_s: s that the card is asked to wait at the most
    :raises PortAudioError: when there is no such device, or it does not start
    """

    def __init__(self, device: str | int | None, sample_rate: float, centre_hz: float, latency_s: float) -> None:
        super().__init__("gr_ros2_microphone", gr.io_signature(0, 0, 0), gr.io_signature(1, 1, gr.sizeof_gr_complex))
        step = round(CARD_RATE / sample_rate)
        taps = gr_filter.firdes.low_pass(2**0.5, CARD_RATE, sample_rate * 0.5, sample_rate * 0.16, window.WIN_HAMMING)
        self._recorder = _Recorder(device, latency_s, (len(taps) - 1) / 2 / CARD_RATE)
        self._down = gr_filter.freq_xlating_fir_filter_fcc(step, taps, centre_hz, CARD_RATE)
        self.connect(self._recorder, self._down, self)

    def heard_until(self) -> float:
        """s, monotonic, of the newest sample given."""
        return self._recorder.heard_until

    @property
    def blocks(self) -> tuple[int, int]:
        """Blocks that came so far, and those of them with a sample at full scale."""
        return self._recorder.blocks, self._recorder.clipped

    def silent_s(self, now: float) -> float:
        """s for which nothing but zeros came."""
        return now - self._recorder.loud_at

    def counters(self) -> dict[str, int]:
        """``clipped_in``: blocks of 10 ms with samples at full scale; ``unread``: blocks that the flowgraph did not
        take in 10 s."""
        return {"clipped_in": self._recorder.clipped, "unread": self._recorder.unread}

    def close(self) -> None:
        """Stop and release the device. Idempotent."""
        self._recorder.close()
