"""A receiver in a process of its own: the same packets, and no more trouble than one without."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.phy import PHY, receiver_process
from gr_ros2.phy.burst import BurstReceiver, Samples
from gr_ros2.phy.burst_blocks import BurstPhy
from gr_ros2.phy.receiver_process import ReceiverProcess
from tests.phy.test_burst import data_of
from tests.waiting import wait_for

PACKETS = [bytes([number]) * 64 for number in range(20)]


def make(name: str = "psk", **options: object) -> BurstPhy:
    phy: BurstPhy = PHY.load(name)(64, 1e6, **options)
    return phy


def samples_of(phy: BurstPhy, packets: list[bytes] = PACKETS) -> Samples:
    """What the receiver's filter, where there is one, makes of bursts."""
    gap = np.zeros(500, np.complex64)
    sent = np.concatenate([part for packet in packets for part in (gap, phy.modem.modulate(packet))] + [gap, gap])
    return sent if phy.receiver_taps is None else np.convolve(sent, phy.receiver_taps).astype(np.complex64)


class Elsewhere:
    """A receiver process and what it delivers."""

    def __init__(self, phy: BurstPhy) -> None:
        self.packets: list[bytes] = []
        self.receiver = ReceiverProcess(phy.modem, lambda heard: self.packets.extend(data_of(heard)))

    def kill(self) -> None:
        self.receiver._process.kill()
        self.receiver._process.wait()


@pytest.fixture
def elsewhere() -> Iterator[Elsewhere]:
    one = Elsewhere(make())
    yield one
    one.receiver.close()


@pytest.mark.parametrize(
    ("name", "options"),
    [("psk", {}), ("gfsk", {"fec": "cc"}), ("ofdm", {"fec": "polar"}), ("psk", {"fec": "ldpc"}), ("lora", {})],
)
def test_it_says_what_a_receiver_here_says(name: str, options: dict[str, object]) -> None:
    phy = make(name, **options)
    samples, here = samples_of(phy), BurstReceiver(phy.modem)
    assert data_of(here.feed(samples)) == PACKETS
    there = Elsewhere(phy)
    try:
        for part in np.array_split(samples, 37):
            assert there.receiver.feed(part) == []
    finally:
        there.receiver.close()
    assert there.packets == PACKETS
    assert there.receiver.damaged == here.damaged
    assert there.receiver.snr_db == here.snr_db
    assert np.array_equal(there.receiver.points, here.points)


def test_a_packet_is_delivered_while_no_more_samples_come(elsewhere: Elsewhere) -> None:
    elsewhere.receiver.feed(samples_of(make(), PACKETS[:1]))
    wait_for(lambda: elsewhere.packets == PACKETS[:1], "the packet")


def test_damaged_bursts_are_counted(elsewhere: Elsewhere) -> None:
    samples = samples_of(make(), PACKETS[:1])
    samples[1200:1400] *= -1
    elsewhere.receiver.feed(samples)
    wait_for(lambda: elsewhere.receiver.damaged == 1, "the damaged burst")
    assert elsewhere.packets == []


def test_where_the_process_dies_receiving_goes_on(elsewhere: Elsewhere, caplog: pytest.LogCaptureFixture) -> None:
    samples = samples_of(make())
    elsewhere.receiver.feed(samples)
    wait_for(lambda: elsewhere.packets == PACKETS, "the packets")
    elsewhere.kill()
    assert data_of(elsewhere.receiver.feed(samples)) == PACKETS
    assert data_of(elsewhere.receiver.feed(samples)) == PACKETS
    assert elsewhere.receiver.points.size
    assert caplog.text.count("reception continues in this one") == 1


def test_where_it_does_not_start_receiving_is_here(monkeypatch: pytest.MonkeyPatch) -> None:
    for executable in ("/nowhere/python", "/bin/true"):
        monkeypatch.setattr(sys, "executable", executable)
        one = Elsewhere(make())
        assert data_of(one.receiver.feed(samples_of(make()))) == PACKETS
        one.receiver.close()


def test_a_process_that_never_gets_ready_is_given_up(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    sleeper = tmp_path / "sleeper"
    sleeper.write_text("#!/bin/sh\nexec sleep 1000\n")
    sleeper.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(sleeper))
    monkeypatch.setattr(receiver_process, "_START_S", 0.01)
    one = Elsewhere(make())
    assert data_of(one.receiver.feed(samples_of(make()))) == PACKETS
    one.receiver.close()


def test_the_interrupt_of_a_terminal_does_not_reach_it(elsewhere: Elsewhere) -> None:
    assert os.getpgid(elsewhere.receiver._process.pid) != os.getpgid(0)


def test_it_ends_with_the_process_it_works_for() -> None:
    code = """
import signal
from gr_ros2.phy import PHY
from gr_ros2.phy.receiver_process import ReceiverProcess
receiver = ReceiverProcess(PHY.load("psk")(64, 1e6).modem, print)
print(receiver._process.pid, flush=True)
signal.pause()
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        child = Path("/proc") / parent.stdout.readline().strip()
        assert child.exists()
        parent.send_signal(signal.SIGKILL)
        wait_for(lambda: not child.exists() or "(zombie)" in (child / "status").read_text(), "its end")
