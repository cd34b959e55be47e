"""The fuzz harnesses: a short run of each, the same every time, and a proof that they would notice."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import fuzz.endpoint
import fuzz.receiver
import fuzz.wire
import fuzz.wire_v1
from fuzz.loop import Harness, inputs, run

ROOT = Path(__file__).parents[1]
HARNESSES = {
    "wire": (fuzz.wire.wire, fuzz.wire.corpus),
    "wire_v1": (fuzz.wire_v1.wire_v1, fuzz.wire_v1.corpus),
    "endpoint": (fuzz.endpoint.endpoint, fuzz.endpoint.corpus),
    "receiver": (fuzz.receiver.receiver, fuzz.receiver.corpus),
}


@pytest.mark.parametrize(
    ("name", "count"), [("wire", 20_000), ("wire_v1", 20_000), ("endpoint", 400), ("receiver", 1_500)]
)
def test_a_short_run_finds_nothing(name: str, count: int) -> None:
    harness, corpus = HARNESSES[name]
    run(harness, corpus(), seed=1, count=count)


@pytest.mark.parametrize("name", HARNESSES)
def test_equal_seeds_give_equal_inputs(name: str) -> None:
    corpus = HARNESSES[name][1]()

    def first(seed: int) -> list[bytes]:
        return [data for _, data in zip(range(100), inputs(corpus, seed), strict=False)]

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


def test_a_failing_input_is_named() -> None:
    def fails(data: bytes) -> None:
        if len(data) > 3:
            raise ValueError("too long")

    harness: Harness = fails
    with pytest.raises(AssertionError, match="ValueError: too long; replay with --replay 61"):
        run(harness, [b"abc"], seed=0, count=10_000)


@pytest.mark.parametrize("name", HARNESSES)
def test_the_command_runs(name: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", f"fuzz.{name}", "--seconds", "0.2"], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
