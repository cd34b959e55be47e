"""The gate: nothing passes early, credits keep the source just in time, and it stops at once."""

from __future__ import annotations

import time
from collections.abc import Iterator
from math import inf

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.phy.airtime import AirtimeGate
from gr_ros2.phy.flowgraph import Flowgraph
from gr_ros2.phy.pdus import credited, pdu_of
from tests.gr.probe import Probe
from tests.waiting import wait_for


@pytest.fixture
def top() -> Iterator[Flowgraph]:
    top = Flowgraph("test", "test")
    yield top
    top.stop()


def wire(top: Flowgraph, gate: AirtimeGate) -> Probe:
    probe = Probe()
    top.msg_connect((probe, "pdus"), (gate, "pdus"))
    top.msg_connect((gate, "pdus"), (probe, "pdus"))
    top.msg_connect((gate, "credit"), (probe, "credit"))
    top.start()
    return probe


def test_packets_pass_one_airtime_apart_and_never_sooner(top: Flowgraph) -> None:
    gate = AirtimeGate(0.02)
    probe = wire(top, gate)
    for number in range(10):
        probe.post(bytes([number]))
    wait_for(lambda: gate.backlog, "the queue")
    wait_for(lambda: probe.handled == 10, "every packet")
    assert probe.packets == [bytes([number]) for number in range(10)]
    # A late wake-up may bring two packets closer together, but never n of them in less than n - 1 airtimes less that.
    assert probe.times[-1] - probe.times[0] > 0.02 * 8
    assert (gate.passed, gate.backlog) == (10, 0)


def test_one_credit_first_then_one_per_packet(top: Flowgraph) -> None:
    probe = wire(top, AirtimeGate(0.02))
    for number in range(5):
        wait_for(lambda number=number: probe.credits == number + 1, "a credit")
        probe.post(bytes(1))
    wait_for(lambda: probe.handled == 5, "every packet")
    wait_for(lambda: probe.credits == 6, "the last credit")


def test_a_credit_says_since_when_the_air_is_free(top: Flowgraph) -> None:
    """A source that has messages all the same knows that it is the computer that they wait for."""
    gate = AirtimeGate(0.02)
    probe = wire(top, gate)
    wait_for(lambda: probe.credits == 1, "a credit")
    begin = time.monotonic()
    probe.post(b"x")
    wait_for(lambda: probe.credits == 2, "the next credit")
    first, second = (credited(message)[1] for message in probe.granted)
    assert first == -inf
    assert second >= begin + 0.02


def test_without_airtime_packets_pass_at_once_and_credits_go_on(top: Flowgraph) -> None:
    probe = wire(top, AirtimeGate(0.0))
    for number in range(5):
        probe.post(bytes([number]))
    wait_for(lambda: probe.handled == 5, "every packet")
    wait_for(lambda: probe.credits >= 4, "credits for more")


def test_a_packet_that_passes_late_is_measured(top: Flowgraph) -> None:
    gate = AirtimeGate(0.01)
    gate._clock.offer(pdu_of(b"x"), time.monotonic() - 1.0)  # was due 0.99 s ago
    probe = wire(top, gate)
    wait_for(lambda: probe.handled == 1, "the packet")
    ((due, happened),) = gate.lateness.moments
    assert happened - due == gate.lateness.worst >= 0.99


def test_on_a_clock_that_stands_still_its_thread_does_not_count_as_stuck(top: Flowgraph) -> None:
    gate = AirtimeGate(0.5, clock=lambda: 0.0)
    wire(top, gate).post(bytes(1))
    wait_for(lambda: gate.backlog, "a packet on the air")
    assert gate.stalled_s() == 0.0


def test_whoever_drives_it_lets_packets_pass_and_learns_when_to_look_again(top: Flowgraph) -> None:
    now, woken = 0.0, list[float]()
    gate = AirtimeGate(0.02, clock=lambda: now)
    gate.looks = lambda: woken.append(gate.looks_at)
    probe = wire(top, gate)
    wait_for(lambda: woken == [0.0], "its start")
    gate.step()
    assert gate.looks_at == inf  # until a packet comes for the credit
    probe.post(b"x")
    wait_for(lambda: woken == [0.0, 0.0], "the packet")
    gate.step()
    assert gate.passed == 0
    assert 0.0 < gate.looks_at < 0.02, "the next credit comes before the air is free"
    now = gate.looks_at
    gate.step()
    assert (gate.passed, gate.looks_at, gate.stalled_s()) == (0, 0.02, 0.0)
    now = 0.02
    gate.step()
    assert gate.passed == 1
    wait_for(lambda: (probe.packets, probe.credits) == ([b"x"], 2), "the packet, and both credits")
    gate.transmit(on=False)
    assert woken == [0.0, 0.0, 0.02]


def test_it_stops_with_packets_on_the_air(top: Flowgraph) -> None:
    gate = AirtimeGate(3600.0)
    probe = wire(top, gate)
    probe.post(b"x")
    wait_for(lambda: gate.backlog == 1)
    top.stop()
    assert probe.handled == 0


@pytest.mark.parametrize("settings", [{"airtime": -1.0}, {"airtime": 1.0, "ahead": -1.0}])
def test_senseless_settings_are_refused(settings: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        AirtimeGate(**settings)
