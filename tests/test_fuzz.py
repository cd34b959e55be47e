"""The fuzz harnesses: a short run of each, the same every time, and a proof that they would notice."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from contextlib import suppress
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from runpy import run_module
from typing import Any

import pytest

import fuzz.calls
import fuzz.compression
import fuzz.control_socket
import fuzz.endpoint
import fuzz.framing
import fuzz.insider
import fuzz.kernels
import fuzz.loop
import fuzz.mac
import fuzz.medium
import fuzz.pings
import fuzz.receiver
import fuzz.relay
import fuzz.sigmf
import fuzz.structure
import fuzz.type_description
import fuzz.wifi
import fuzz.wire
import fuzz.wire_v1
from fuzz.loop import Harness, inputs, run, within, work

ROOT = Path(__file__).parents[1]
HARNESSES = {
    "wire": (fuzz.wire.wire, fuzz.wire.corpus),
    "wire_v1": (fuzz.wire_v1.wire_v1, fuzz.wire_v1.corpus),
    "endpoint": (fuzz.endpoint.endpoint, fuzz.endpoint.corpus),
    "insider": (fuzz.insider.insider, fuzz.insider.corpus),
    "receiver": (fuzz.receiver.receiver, fuzz.receiver.corpus),
    "mac": (fuzz.mac.mac, fuzz.mac.corpus),
    "relay": (fuzz.relay.relay, fuzz.relay.corpus),
    "calls": (fuzz.calls.calls, fuzz.calls.corpus),
    "compression": (fuzz.compression.compression, fuzz.compression.corpus),
    "structure": (fuzz.structure.structure, fuzz.structure.corpus),
    "type_description": (fuzz.type_description.type_description, fuzz.type_description.corpus),
    "control_socket": (fuzz.control_socket.control_socket, fuzz.control_socket.corpus),
    "framing": (fuzz.framing.framing, fuzz.framing.corpus),
    "kernels": (fuzz.kernels.kernels, fuzz.kernels.corpus),
    "medium": (fuzz.medium.medium, fuzz.medium.corpus),
    "pings": (fuzz.pings.pings, fuzz.pings.corpus),
    "sigmf": (fuzz.sigmf.sigmf, fuzz.sigmf.corpus),
    "wifi": (fuzz.wifi.wifi, fuzz.wifi.corpus),
}
COUNTS = {
    "wire": 5_000,
    "wire_v1": 5_000,
    "endpoint": 60,
    "insider": 60,
    "receiver": 300,
    "mac": 400,
    "relay": 400,
    "calls": 1_500,
    "compression": 1_000,
    "codecs": 400,
    "frames": 10,
    "structure": 400,
    "type_description": 500,
    "control_socket": 500,
    "dashboard": 100,
    "framing": 250,
    "kernels": 300,
    "medium": 500,
    "pings": 200,
    "sigmf": 2_000,
    "wifi": 200,
}
"""Inputs of a short run; `python -m fuzz.NAME` goes on for as long as it is let."""
if find_spec("av") is not None:
    import fuzz.codecs
    import fuzz.frames

    HARNESSES["frames"] = (fuzz.frames.frames, fuzz.frames.corpus)
    HARNESSES["codecs"] = (fuzz.codecs.codecs, fuzz.codecs.corpus)
if find_spec("bokeh") is not None:
    import fuzz.dashboard

    HARNESSES["dashboard"] = (fuzz.dashboard.dashboard, fuzz.dashboard.corpus)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "count"), COUNTS.items())
def test_a_short_run_finds_nothing(name: str, count: int) -> None:
    if name not in HARNESSES:
        pytest.skip("needs GNU Radio 3.10, and bokeh or PyAV: pip install 'gr-ros2[dashboard,video]'")
    harness, corpus = HARNESSES[name]
    tried = 0

    def counted(data: bytes) -> None:
        nonlocal tried
        harness(data)
        tried += 1

    run(counted, corpus(), seed=1, count=count)
    assert tried == count


@pytest.mark.parametrize("name", HARNESSES)
def test_equal_seeds_give_equal_inputs(name: str) -> None:
    corpus = HARNESSES[name][1]()

    def first(seed: int) -> list[bytes]:
        return [data for _, data in zip(range(len(corpus) + 100), inputs(corpus, seed), strict=False)]

    assert first(3) == first(3)
    assert first(3) != first(4)


def test_the_corpus_reaches_delivery(monkeypatch: pytest.MonkeyPatch) -> None:
    delivered = []
    monkeypatch.setattr(fuzz.receiver, "Delivered", type("Never", (), {}))
    for script in fuzz.receiver.corpus():
        try:
            fuzz.receiver.receiver(script)
        except AssertionError:  # the engine delivered, and the harness saw no event of that type
            delivered.append(script)
    assert len(delivered) >= 4


def test_scripts_of_an_insider_reach_delivery(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its packets have right trailers: with the key as without, some of what they say is used."""
    found: set[str] = set()
    monkeypatch.setattr(fuzz.insider, "check", lambda _, events, __: found.update(type(e).__name__ for e in events))
    run(fuzz.insider.insider, fuzz.insider.corpus(), seed=1, count=60)
    assert {"Met", "Received", "Announced", "Delivered", "Lost", "Gone", "Rejected"} <= found


@pytest.mark.slow
def test_scripts_of_frames_reach_the_decoders(monkeypatch: pytest.MonkeyPatch) -> None:
    """Some are decoded, some are not, and our own camera goes on."""
    pytest.importorskip("av", reason="needs PyAV")
    became: Counter[str] = Counter()
    decode, check = fuzz.frames.FrameReceiver.decode, fuzz.frames.Victim.check

    def decoded(self: fuzz.frames.FrameReceiver, key: tuple[int, int], *args: Any) -> bytes:
        framed = key in self._topics
        became["failed"] += framed
        message = decode(self, key, *args)
        became["decoded"] += framed
        became["failed"] -= framed
        return message

    def checked(self: fuzz.frames.Victim, now: float) -> None:
        check(self, now)
        became["sent"] = max(became["sent"], len(self.events))

    monkeypatch.setattr(fuzz.frames.FrameReceiver, "decode", decoded)
    monkeypatch.setattr(fuzz.frames.Victim, "check", checked)
    run(fuzz.frames.frames, fuzz.frames.corpus(), seed=1, count=20)
    assert min(became["failed"], became["decoded"], became["sent"]) > 10, became


def test_a_failing_input_is_named() -> None:
    def fails(data: bytes) -> None:
        if len(data) > 3:
            raise ValueError("too long")

    harness: Harness = fails
    with pytest.raises(AssertionError, match="ValueError: too long; replay with --replay 61"):
        run(harness, [b"abc"], seed=0, count=10_000)


def test_what_works_too_much_is_noticed() -> None:
    def loop(count: int) -> None:
        for _ in range(count):
            with suppress(Exception):
                pass

    before = sys.gettrace()
    within(1000, partial(loop, 100))
    with pytest.raises(AssertionError, match=r"more than 1000 lines of Python, at .*:\d+"):
        within(1000, partial(loop, 1 << 60))
    assert sys.gettrace() is before


def test_work_is_counted_not_timed() -> None:
    few, many = (work(lambda count=count: sum(1 for _ in range(count)))[0] for count in (10, 1000))
    assert many - few >= 990
    assert work(lambda: "result")[1] == "result"


@pytest.mark.parametrize("name", HARNESSES)
@pytest.mark.filterwarnings("ignore:.*found in sys.modules:RuntimeWarning")
def test_the_command_runs(name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", [f"fuzz.{name}", "--seconds", "0.05"])
    monkeypatch.setattr(fuzz.loop, "find_spec", lambda _: None)  # a guided search ends its process
    run_module(f"fuzz.{name}", run_name="__main__")
    assert "inputs" in capsys.readouterr().out


def test_a_shell_runs_it() -> None:
    command = [sys.executable, "-m", "fuzz.wire", "--seconds", "0.05"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
