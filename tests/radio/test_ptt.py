"""Keys of transmitters: a serial line that loops back, a server that stands for rigctld, a file for a sound chip."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

pytest.importorskip("serial", reason="needs pyserial")

from gr_ros2.core.errors import RadioError
from gr_ros2.radio import ptt
from gr_ros2.radio.audio_bursts import Played
from gr_ros2.radio.ptt import DtrLine, Keyer, RtsLine
from tests.waiting import PATIENCE_S, wait_for


class Rigctld:
    """Answers as rigctld does, and notes when it was keyed."""

    def __init__(self, answer: bytes = b"RPRT 0\n") -> None:
        self.told: list[tuple[float, bytes]] = []
        self._answer = answer
        self._server = socket.create_server(("127.0.0.1", 0))
        self.where = f"127.0.0.1:{self._server.getsockname()[1]}"
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        connection, _ = self._server.accept()
        with connection, connection.makefile("rb") as lines:
            for number, line in enumerate(lines):
                if number:  # it is let go when it is opened
                    self.told.append((time.monotonic(), line))
                connection.sendall(self._answer if number else b"RPRT 0\n")

    def close(self) -> None:
        self._server.close()


@pytest.fixture
def rigctld() -> Iterator[Rigctld]:
    server = Rigctld()
    yield server
    server.close()


def test_the_key_is_pressed_from_the_begin_of_a_burst_to_its_end(rigctld: Rigctld) -> None:
    keyer = Keyer("rigctld", rigctld.where)
    now = time.monotonic()
    played = Played(now + 0.2, now + 1.0)  # a busy computer is late, though not by so much
    keyer.key(played)
    wait_for(lambda: len(rigctld.told) == 2)
    keyer.close()
    (on_at, on), (off_at, off), *last = rigctld.told
    assert (on, off, [line for _, line in last]) == (b"T 1\n", b"T 0\n", [b"T 0\n"])
    assert on_at >= played.begin
    assert off_at >= played.end


def test_bursts_that_follow_each_other_are_keyed_once(rigctld: Rigctld) -> None:
    keyer = Keyer("rigctld", rigctld.where)
    now = time.monotonic()
    keyer.key(Played(now, now + 1.0))
    keyer.key(Played(now + 1.02, now + 1.2))
    wait_for(lambda: len(rigctld.told) == 2)
    keyer.close()
    assert rigctld.told[1][0] >= now + 1.2


def test_the_key_is_let_go_when_the_link_stops_within_a_burst(rigctld: Rigctld) -> None:
    keyer = Keyer("rigctld", rigctld.where)
    keyer.key(Played(time.monotonic(), time.monotonic() + 1000))
    wait_for(lambda: rigctld.told)
    keyer.close()
    assert rigctld.told[-1][1] == b"T 0\n"


def test_a_radio_that_refuses_is_one_line() -> None:
    server = Rigctld(b"RPRT -1\n")
    keyer = Keyer("rigctld", server.where)
    keyer.key(Played(time.monotonic(), time.monotonic() + 1))

    def fails() -> bool:
        try:
            keyer.check()
        except RadioError as error:
            return "RPRT -1" in str(error) and server.where in str(error)
        return False

    wait_for(fails)
    keyer.close()
    server.close()


def test_a_key_that_cannot_be_opened_is_one_line_with_an_example(tmp_path: Path) -> None:
    for kind, where, example in (
        ("rts", str(tmp_path / "none"), "/dev/ttyUSB0"),
        ("rigctld", "127.0.0.1:1", "localhost:4532"),
        ("cm108", str(tmp_path / "no" / "none"), "/dev/hidraw0"),
    ):
        with pytest.raises(RadioError, match=example) as raised:
            Keyer(kind, where)
        assert "\n" not in str(raised.value)


@pytest.mark.parametrize(("key", "line", "other"), [(RtsLine, "rts", "cts"), (DtrLine, "dtr", "dsr")])
def test_a_serial_line_is_not_keyed_while_it_opens(key: type[RtsLine | DtrLine], line: str, other: str) -> None:
    opened = key("loop://")
    assert not getattr(opened._port, other)
    opened.press(on=True)
    assert getattr(opened._port, other), line
    opened.press(on=False)
    assert not getattr(opened._port, other)
    opened.close()


def test_a_sound_chip_gets_reports_of_its_pin(tmp_path: Path) -> None:
    device = tmp_path / "hidraw0"
    keyer = Keyer("cm108", str(device))
    now = time.monotonic()
    keyer.key(Played(now, now + 0.5))
    wait_for(lambda: device.stat().st_size == 15)
    keyer.close()
    off = [0, 0, 0, 4, 0]
    assert device.read_bytes() == bytes([*off, 0, 0, 4, 4, 0, *off, *off])


def test_no_thread_of_a_card_waits_for_a_key_that_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    hangs, pressed = threading.Event(), threading.Event()

    def press(*, on: bool) -> None:
        if on:
            pressed.set()
            hangs.wait(PATIENCE_S)

    monkeypatch.setitem(ptt.KEYS, "rts", lambda _: SimpleNamespace(press=press, close=lambda: None, example=""))
    keyer = Keyer("rts", "x")
    now = time.monotonic()
    keyer.key(Played(now, now + 1))
    assert pressed.wait(PATIENCE_S)
    keyer.key(Played(now + 2, now + 3))  # returns while the key hangs
    assert not hangs.is_set()
    hangs.set()
    keyer.close()


def test_a_program_that_ends_without_closing_lets_go(tmp_path: Path) -> None:
    program = (
        "import sys, time\n"
        "from gr_ros2.radio.audio_bursts import Played\n"
        "from gr_ros2.radio.ptt import Keyer\n"
        "now = time.monotonic()\n"
        "Keyer('cm108', sys.argv[1]).key(Played(now, now + 1000))\n"
        "while len(open(sys.argv[1], 'rb').read()) < 10: time.sleep(0.01)\n"
    )
    device = tmp_path / "hidraw0"
    subprocess.run([sys.executable, "-c", program, str(device)], check=True, timeout=PATIENCE_S)
    assert device.read_bytes()[-5:] == bytes([0, 0, 0, 4, 0])
