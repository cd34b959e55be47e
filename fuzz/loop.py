"""Feeds a harness: by atheris (coverage-guided) where it is installed, otherwise by a seeded mutation loop of our own.

Invariant: the same seed gives the same inputs; an input that fails is named in hex, so that it can be replayed.
"""

from __future__ import annotations

import argparse
import math
import random
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from importlib import import_module
from importlib.util import find_spec
from itertools import islice
from types import FrameType
from typing import Any, TypeVar

Harness = Callable[[bytes], None]
TraceFunction = Callable[[FrameType, str, Any], Any]
_T = TypeVar("_T")
_INTERESTING = (0, 1, 15, 16, 64, 127, 128, 254, 255)
_MOST = 4096
KEPT = ExitStack()
"""What a harness opens at its first input and keeps until the last, such as a server."""


def inputs(corpus: Sequence[bytes], seed: int) -> Iterator[bytes]:
    """Endless mutations of a corpus, the corpus itself first."""
    yield from corpus
    rng = random.Random(seed)
    while True:
        data = bytearray(rng.choice(corpus))
        for _ in range(rng.choice((1, 1, 2, 4, 16))):
            _mutate(data, corpus, rng)
        yield bytes(data[:_MOST])


def run(harness: Harness, corpus: Sequence[bytes], seed: int, count: int) -> None:
    """So many inputs.

    :raises AssertionError: naming the input that failed
    """
    with KEPT:
        for data in islice(inputs(corpus, seed), count):
            _one(harness, data)


def within(most: int, call: Callable[[], object]) -> None:
    """Hold the work of one call to a limit.

    :param most: lines that may be executed in this thread
    :raises AssertionError: at the first line beyond
    """
    work(call, most)


class _TooMuch(BaseException):
    """Not an Exception, which the code that is counted may catch."""


def work(call: Callable[[], _T], most: float = math.inf) -> tuple[int, _T]:
    """The lines of Python that a call executes in this thread, a measure of work that does not depend on the computer;
    and its result.

    :param most: lines that may be executed
    :raises AssertionError: at the first line beyond
    """
    done = 0

    def count(frame: FrameType, event: str, _: object) -> TraceFunction:
        nonlocal done
        if event == "line":
            done += 1
            if done > most:
                raise _TooMuch(f"{frame.f_code.co_filename}:{frame.f_lineno}")
        return count

    before = sys.gettrace()
    sys.settrace(count)
    try:
        result = call()
    except _TooMuch as error:
        raise AssertionError(f"more than {most} lines of Python, at {error}") from None
    finally:
        sys.settrace(before)
    return done, result


def main(harness: Harness, corpus: Sequence[bytes]) -> None:
    """The command line of a harness."""
    parser = argparse.ArgumentParser(description=harness.__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="how long to go on")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--replay", metavar="HEX", help="run this one input")
    options = parser.parse_args()
    with KEPT:
        _go_on(harness, corpus, options)


def _go_on(harness: Harness, corpus: Sequence[bytes], options: argparse.Namespace) -> None:
    if options.replay is not None:
        harness(bytes.fromhex(options.replay))
    elif find_spec("atheris") is not None:
        _guided(harness, options.seconds, options.seed)
    else:
        end = time.monotonic() + options.seconds
        done = 0
        for data in inputs(corpus, options.seed):
            _one(harness, data)
            done += 1
            if time.monotonic() > end:
                break
        print(f"{done} inputs, seed {options.seed}: none failed")


def _one(harness: Harness, data: bytes) -> None:
    try:
        harness(data)
    except Exception as error:
        raise AssertionError(f"{type(error).__name__}: {error}; replay with --replay {data.hex()}") from error


def _guided(harness: Harness, seconds: float, seed: int) -> None:
    atheris: Any = import_module("atheris")
    arguments = [sys.argv[0], f"-max_total_time={max(1, round(seconds))}", f"-seed={seed or 1}", f"-max_len={_MOST}"]
    atheris.instrument_all()
    atheris.Setup(arguments, harness)
    atheris.Fuzz()


def _mutate(data: bytearray, corpus: Sequence[bytes], rng: random.Random) -> None:
    """One change in place: flip, set, insert, delete, repeat, or splice in a piece of another input."""
    at = rng.randrange(len(data) + 1)
    length = rng.choice((1, 1, 2, 5, 20, 64))
    kind = rng.randrange(6)
    if kind == 0 and at < len(data):
        data[at] ^= 1 << rng.randrange(8)
    elif kind == 1 and at < len(data):
        data[at] = rng.choice(_INTERESTING)
    elif kind == 2:
        data[at:at] = rng.randbytes(length)
    elif kind == 3:
        del data[at : at + length]
    elif kind == 4:
        data[at:at] = data[at : at + length]
    else:
        other = rng.choice(corpus)
        start = rng.randrange(len(other) + 1)
        data[at : at + length] = other[start : start + length]
