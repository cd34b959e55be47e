"""The `audio` front end: packets as sound, through a loudspeaker and a microphone, a cable, or a voice radio."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from gr_ros2.core.errors import ConfigError, RadioError
from gr_ros2.core.watch import Watch, wait_until
from gr_ros2.radio.audio_bursts import CARD_RATE, LATE_S
from gr_ros2.radio.audio_card import Microphone, PortAudioError, Speaker, devices, look_again
from gr_ros2.radio.burst_device import BurstDeviceOptions, BurstFrontEnd
from gr_ros2.radio.bursts import Blanker, BurstLayout
from gr_ros2.radio.ptt import KEYS, Keyer
from gr_ros2.settings.config import STRICT, Seconds, Text, build
from gr_ros2.settings.fields import AUTO, Auto

_MUTED_S = 5.0
"""s of nothing but zeros, which no microphone gives, after which it counts as muted."""
_LOOK_BLOCKS = 500
"""Blocks after which clipping is judged anew, 5 s."""
_CLIPPED = 0.02
"""Share of blocks at full scale that is too many."""
_DRAIN_S = 5.0
_KeyedS = Annotated[float, Field(ge=0, le=10)]
_Ptt = Literal["none", "vox", "rts", "dtr", "rigctld", "cm108"]
_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, config=STRICT)
class AudioOptions(BurstDeviceOptions):
    """Settings of this front end."""

    device: Annotated[Text, Field(title="Device")] = AUTO
    """sound device that plays: number or part of its name (``gr-ros2 sound check`` lists them); auto = the system's"""
    device_rx: Annotated[Text, Field(title="Device that records")] = AUTO
    """sound device that records; auto = ``device``"""
    centre_hz: Annotated[float, Field(gt=0, lt=CARD_RATE / 2, title="Middle of the band (Hz)")] = 4500.0
    """Hz, the middle of the band that sounds; at a radio in SSB, above its dial frequency"""
    ptt: Annotated[_Ptt, Field(title="What keys the radio")] = "none"
    """what keys a transmitter: a tone (vox), a serial line's rts or dtr, rigctld, or a sound chip's pin (cm108)"""
    ptt_device: Annotated[Text | Literal[""], Field(title="Device of the key")] = ""
    """``/dev/ttyUSB0`` for rts and dtr, ``HOST:PORT`` for rigctld, ``/dev/hidraw0`` for cm108"""
    lead_s: Annotated[_KeyedS | Auto, Field(title="Silence before a packet (s)")] = AUTO
    """s of silence, or with ``ptt: vox`` of a tone, before each packet; auto = .3 with a transmitter to key, otherwise
    .02"""
    latency_s: Annotated[float, Field(gt=0, le=2, title="Latency of the card (s)")] = 0.1
    """s that the card is asked to be ahead and behind"""
    turnaround_s: Annotated[Seconds, Field(title="Turn-around time (s)")] = 0.05

    @property
    def keys(self) -> bool:
        """Whether there is a transmitter to key."""
        return self.ptt != "none"

    @property
    def leads_s(self) -> float:
        """``lead_s``, s."""
        return (0.3 if self.keys else 0.02) if self.lead_s == AUTO else self.lead_s

    @property
    def tails_s(self) -> float:
        """How long it is silent behind each packet, while a key is still pressed, s."""
        return 0.1 if self.keys else 0.02

    def layout(self, samples: int, sample_rate: float) -> BurstLayout:
        return BurstLayout(samples, round(self.leads_s * sample_rate), round(self.tails_s * sample_rate))


class AudioFrontEnd(BurstFrontEnd):
    """A sound card that plays and records bursts.

    :raises ConfigError: for a sample rate of which the card's is no multiple, or a key without a device
    """

    name = "audio"
    Options: ClassVar[type[AudioOptions]] = AudioOptions
    timing_error_s = timed_error_s = LATE_S
    """s by which a burst may begin late, and by which a sound server's times are off."""

    @classmethod
    def asks(cls, options: Mapping[str, Any]) -> bool:
        return build(AudioOptions, options, "front_end audio").keys

    @classmethod
    def on_air(cls, options: Mapping[str, Any]) -> str:
        chosen = build(AudioOptions, options, "front_end audio")
        keyed = f", keying a transmitter by {chosen.ptt}" if chosen.keys else ""
        return f"sound around {chosen.centre_hz:g} Hz with level {chosen.level:g}{keyed}"

    @property
    def receive_frequency(self) -> float:
        return float(self.options.centre_hz)

    def _open(self) -> None:
        self._check_asked()
        self._keyer: Keyer | None = None
        self._silence, self._muted, self._too_loud = Watch(), False, False
        self._blocks = 0, 0
        self._counted: dict[str, int] = {}
        with self._one_line():
            look_again()
            super()._open()

    def _check_asked(self) -> None:
        chosen, rate = self.options, self.phy.sample_rate
        if CARD_RATE % rate:
            raise ConfigError(
                f"front_end audio: phy.sample_rate = {rate:g}: a sound card has {CARD_RATE:,} samples/s; "
                "set one of which that is a multiple, such as 6000, 8000 or 24000"
            )
        if chosen.ptt in KEYS and not chosen.ptt_device:
            raise ConfigError(
                f"front_end audio: ptt = {chosen.ptt!r} needs ptt_device, such as {KEYS[chosen.ptt].example}"
            )

    def _open_transmitter(self) -> Speaker:
        chosen, rate = self.options, self.phy.sample_rate
        if chosen.ptt in KEYS:
            self._keyer = Keyer(chosen.ptt, chosen.ptt_device)
        tone = (chosen.level, self.layout.lead) if chosen.ptt == "vox" else (0.0, 0)
        begun = (lambda _: None) if self._keyer is None else self._keyer.key
        return Speaker(
            device_of(chosen.device),
            self.layout.total,
            rate,
            centre_hz=chosen.centre_hz,
            latency_s=chosen.latency_s,
            tone=tone,
            begun=begun,
        )

    def _open_receiver(self) -> Microphone:
        chosen = self.options
        device = chosen.device if chosen.device_rx == AUTO else chosen.device_rx
        return Microphone(device_of(device), self.phy.sample_rate, chosen.centre_hz, chosen.latency_s)

    def _make_blanker(self) -> Blanker:
        # By when it sounds, not by when it is made or has come through the buffers.
        def sounded(begin: float, end: float) -> list[tuple[float, float]]:
            return self._transmitting.played(begin, end) if self._transmitting else []

        def heard_until() -> float:
            return float(self._receiving.heard_until())

        return Blanker(sounded, self.options.turnaround_s, self.phy.sample_rate, heard_until)

    def _device_time(self) -> float:
        return time.monotonic()

    def ahead(self) -> float:
        return float(self.options.leads_s + (self._transmitting.ahead_s if self.transmits else 0.0))

    def check(self, now: float) -> None:
        super().check(now)
        if self._keyer is not None:
            self._keyer.check()
        self._check_heard(now)

    def _sent(self) -> object:
        return self._transmitting.blocks  # a card asks for silence, too

    def _check_heard(self, now: float) -> None:
        """Say once what is wrong with what is heard, and once that it is over."""
        muted = self._silence.age(self._receiving.silent_s(now), now) > _MUTED_S
        if muted != self._muted:
            self._muted = muted
            _log.warning(
                "front_end audio: %s",
                "nothing but digital silence comes in: is the microphone muted, or another device the right one? "
                "`gr-ros2 sound check` shows its level"
                if muted
                else "sound comes in again",
            )
        blocks, clipped = self._receiving.blocks
        before, clipped_before = self._blocks
        if blocks - before >= _LOOK_BLOCKS:
            too_loud = clipped - clipped_before > _CLIPPED * (blocks - before)
            self._blocks = blocks, clipped
            if too_loud and not self._too_loud:
                _log.warning("front_end audio: what comes in is too loud and clipped: lower the microphone's gain")
            self._too_loud = too_loud

    def drain(self, packets: int) -> None:  # noqa: ARG002 - all that were handed over
        if self.transmits and self._transmitting is not None:
            wait_until(lambda: self._transmitting.idle, _DRAIN_S, look_s=0.01)

    def _device_said(self) -> str:
        chosen = self.options
        also = "" if chosen.device_rx == AUTO else f", device_rx = {chosen.device_rx!r}"
        return f"device = {chosen.device!r}{also}"

    def _device_counters(self) -> dict[str, int]:
        heard, sent = self._receiving, self._transmitting
        if heard is not None:  # closed, the last counts stay
            self._counted = dict(heard.counters())
            if sent is not None:
                self._counted |= sent.counters()
                self._counted["clipped"] += self._shaper.clipped
        return dict(self._counted)

    def close(self) -> None:
        self._device_counters()
        for part in (self._keyer, self._transmitting, self._receiving):
            if part is not None:
                part.close()
        self._keyer = None
        super().close()

    @contextmanager
    def _one_line(self) -> Iterator[None]:
        """Turns what PortAudio says into a RadioError of one line that lists the devices."""
        try:
            yield
        except (PortAudioError, ValueError, OSError) as error:
            if isinstance(error, RadioError):
                raise
            reason = " ".join(str(error).split()) or type(error).__name__
            try:
                found = f"; devices found: {', '.join(repr(device['name']) for device in devices())}"
            except PortAudioError:
                found = ""
            raise RadioError(f"front_end audio: {self._device_said()}: {reason}{found}") from error


def device_of(name: str) -> str | int | None:
    """A device as PortAudio takes it."""
    if name == AUTO:
        return None
    return int(name) if name.isdecimal() else name
