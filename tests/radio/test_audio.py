"""The front end `audio` over real sound servers, whose loudspeakers are their microphones."""

from __future__ import annotations

import logging
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
pytest.importorskip("gr_ros2.radio.audio_card", reason="needs sounddevice and libportaudio2", exc_type=ImportError)

from gr_ros2.core.errors import ConfigError, RadioError
from gr_ros2.phy.psk import PskPhy
from gr_ros2.radio import PRESETS, audio_card
from gr_ros2.radio.audio import AudioFrontEnd
from gr_ros2.radio.audio_card import look_again
from gr_ros2.radio.permission import permitted
from tests.middleware.support import message
from tests.radio.robots import Robot
from tests.radio.sound_server import PipeWire, PulseAudio, SoundServer, sound_server_or_skip
from tests.radio.test_ptt import Rigctld
from tests.waiting import wait_for

PHY = {"name": "psk", "sample_rate": 24_000, "options": {"fec": "cc"}}
"""Fast, so that the tests are short; null sinks are cables."""
SOUND = {"name": "audio", "device": "pulse", "centre_hz": 11_000}


@pytest.fixture(params=[PulseAudio, PipeWire])
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Iterator[SoundServer]:
    started = sound_server_or_skip(tmp_path, request.param)
    for name, value in started.env.items():
        monkeypatch.setenv(name, value)
    look_again()
    yield started
    started.stop()


def at(monkeypatch: pytest.MonkeyPatch, sink: str, source: str) -> None:
    """What is opened next plays to one sink and hears another."""
    monkeypatch.setenv("PULSE_SINK", sink)
    monkeypatch.setenv("PULSE_SOURCE", f"{source}.monitor")


def robot(number: int, front_end: dict[str, Any] | None = None, **values: Any) -> Robot:
    return Robot(number, {**SOUND, **(front_end or {})}, (3 - number,), phy=PHY, **values)


def serve(*robots: Robot) -> bool:
    """Let links look after their cards, as the command does."""
    for each in robots:
        each.link.check()
    return True


def says_until(alone: Robot, number: int, condition: Callable[[], object]) -> None:
    """Wait until what a robot says has come back. A computer that is late loses packets, which nobody repairs here:
    once all have sounded, the robot says it again."""
    alone.say(number)

    def look() -> object:
        serve(alone)
        if not condition() and alone.silent:
            alone.say(number)
        return condition()

    wait_for(look)


@pytest.mark.real_time
@pytest.mark.usefixtures("server")
def test_messages_cross_both_ways_and_every_burst_sounds(monkeypatch: pytest.MonkeyPatch) -> None:
    at(monkeypatch, "a", "b")
    with robot(1) as one:
        at(monkeypatch, "b", "a")
        with robot(2) as two:
            said = one.say(1, 2, 3), two.say(4, 5, 6)
            wait_for(lambda: serve(one, two) and len(one.heard) == len(two.heard) == 3, "all messages")
            assert (two.heard, one.heard) == said
            for each in (one, two):
                # A computer that is late loses frames, and says so; nothing else may be lost.
                counted = each.counters()
                assert counted["unsent"] == counted["clipped"] == counted["unread"] == 0
                wait_for(lambda each=each: each.counters()["bursts_out"] == each.link.stats()["packets"]["out"])


@pytest.mark.real_time
def test_a_server_that_ends_and_comes_back_is_waited_for(
    server: SoundServer, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    at(monkeypatch, "a", "a")
    monkeypatch.setattr(AudioFrontEnd, "loops_back", True)
    front_end = {**SOUND}
    with Robot(1, front_end, hears=(1,), repair="off", phy=PHY) as alone:
        says_until(alone, 1, lambda: alone.heard)
        server.stop()
        with caplog.at_level(logging.WARNING):
            wait_for(lambda: serve(alone) and "waiting for it" in caplog.text)
            server.start()
            wait_for(lambda: serve(alone) and "is back" in caplog.text)
        before = len(alone.heard)
        says_until(alone, 2, lambda: len(alone.heard) > before)
        assert all("\n" not in record.message for record in caplog.records)


@pytest.mark.slow
@pytest.mark.real_time
@pytest.mark.usefixtures("server")
def test_robots_that_all_hear_each_other_take_turns_and_lose_no_message(monkeypatch: pytest.MonkeyPatch) -> None:
    """One null sink for all, with the packets of half a second of preset ``sound``."""
    at(monkeypatch, "a", "a")
    front_end, phy = (
        {**SOUND, "half_duplex": True},
        {"name": "ofdm", "sample_rate": 8e3, "options": dict(PRESETS["sound"].phy_options)},
    )
    front_end.pop("centre_hz")
    numbers = {1, 2, 3}
    with ExitStack() as stack:
        robots = [
            stack.enter_context(
                Robot(number, front_end, tuple(numbers - {number}), phy=phy, packet_len=64, medium="slots")
            )
            for number in sorted(numbers)
        ]
        said = []
        for number, each in enumerate(robots):
            said.append(message(number, 8))
            each.publish(said[-1])
        packets = lambda: [each.link.stats()["packets"]["out"] for each in robots]  # noqa: E731
        wait_for(lambda: serve(*robots) and any(each.heard for each in robots), "a message", packets)
        assert max(packets()) <= 20, "a message does not wait for hellos"
        everybody = [sorted({*said} - {own}) for own in said]
        wait_for(lambda: serve(*robots) and [sorted(each.heard) for each in robots] == everybody, "all", packets)


@pytest.mark.real_time
@pytest.mark.usefixtures("server")
def test_silence_of_zeros_is_named_once_and_so_is_its_end(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    at(monkeypatch, "a", "a")
    monkeypatch.setattr(AudioFrontEnd, "loops_back", True)
    with Robot(1, dict(SOUND), hears=(1,), repair="off", phy=PHY) as alone:
        assert alone.link.radio.front_end.receive_frequency == SOUND["centre_hz"]
        with caplog.at_level(logging.WARNING):
            alone.link.transmit(on=False)
            wait_for(lambda: serve(alone) and "digital silence" in caplog.text)
            alone.link.transmit(on=True)
            says_until(alone, 1, lambda: "comes in again" in caplog.text)
        assert caplog.text.count("digital silence") == 1


@pytest.mark.real_time
@pytest.mark.usefixtures("server")
def test_a_link_that_was_frozen_accuses_no_microphone(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    at(monkeypatch, "a", "a")
    monkeypatch.setattr(AudioFrontEnd, "loops_back", True)
    with Robot(1, dict(SOUND), hears=(1,), repair="off", phy=PHY) as alone:
        says_until(alone, 1, lambda: alone.heard)
        alone.link.check()
        alone.link.front_end.check(time.monotonic() + 12.0)
        assert "digital silence" not in caplog.text


@pytest.mark.real_time
@pytest.mark.usefixtures("server")
def test_a_transmitter_is_keyed_while_a_packet_sounds(monkeypatch: pytest.MonkeyPatch) -> None:
    rigctld = Rigctld()
    at(monkeypatch, "a", "a")
    monkeypatch.setattr(AudioFrontEnd, "loops_back", True)
    front_end = {**SOUND, "ptt": "rigctld", "ptt_device": rigctld.where}
    with Robot(1, front_end, hears=(1,), repair="off", phy=PHY) as alone:
        says_until(alone, 1, lambda: alone.heard)
        wait_for(lambda: alone.silent and len(rigctld.told) >= 2 and rigctld.told[-1][1] == b"T 0\n")
    keyed = [line for _, line in rigctld.told]
    assert keyed[0::2][: len(keyed) // 2] == [b"T 1\n"] * (len(keyed) // 2)
    assert keyed[-1] == b"T 0\n"
    rigctld.close()


@pytest.mark.usefixtures("server")
def test_no_signal_stays_blocked() -> None:
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    AudioFrontEnd(PskPhy(64, 24_000), device="pulse").close()
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == before == set()


def test_a_sound_system_that_hangs_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C would not end a program whose main thread waits in PortAudio."""
    answers = threading.Event()
    monkeypatch.setattr(audio_card, "_ANSWER_S", 0.05)
    monkeypatch.setattr(audio_card.sounddevice, "_terminate", lambda: None)
    monkeypatch.setattr(audio_card.sounddevice, "_initialize", answers.wait)
    with pytest.raises(audio_card.PortAudioError, match="hangs"):
        audio_card.look_again()
    answers.set()


@pytest.mark.usefixtures("server")
def test_a_device_that_is_not_there_is_one_line_with_those_that_are() -> None:
    with pytest.raises(RadioError, match=r"device = 'nowhere'.*devices found: .*pulse") as raised:
        AudioFrontEnd(PskPhy(64, 24_000), device="nowhere")
    assert "\n" not in str(raised.value)


def test_no_sound_server_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PULSE_SERVER", f"unix:{tmp_path}/none")
    with pytest.raises(RadioError, match="front_end audio: device = ") as raised:
        AudioFrontEnd(PskPhy(64, 24_000), device="pulse")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("rate", [7000, 1e6, 96_000])
def test_a_rate_that_no_card_divides_into_is_named(rate: float) -> None:
    with pytest.raises(ConfigError, match=r"phy\.sample_rate"):
        AudioFrontEnd(PskPhy(64, rate))


def test_a_key_needs_its_device() -> None:
    with pytest.raises(ConfigError, match="ptt_device, such as /dev/ttyUSB0"):
        AudioFrontEnd(PskPhy(64, 24_000), ptt="rts")


def test_sound_in_a_room_asks_for_nothing_and_a_transmitter_for_a_word_and_a_key() -> None:
    assert permitted("auto", AudioFrontEnd, {}, guarded=False)
    with pytest.raises(ConfigError, match="--transmit"):
        permitted("auto", AudioFrontEnd, {"ptt": "vox"})
    with pytest.raises(ConfigError, match="no key"):
        permitted(True, AudioFrontEnd, {"ptt": "vox"}, guarded=False)


def test_a_packet_is_keyed_from_its_lead_to_its_tail() -> None:
    phy = PskPhy(64, 8000)
    plain, keyed = AudioFrontEnd.Options(), AudioFrontEnd.Options(ptt="vox")
    longer = AudioFrontEnd.airtime_with(phy, keyed) - AudioFrontEnd.airtime_with(phy, plain)
    assert longer == pytest.approx(0.36)
