"""Both halves of a robot's end behind one surface."""

from __future__ import annotations

import random
from math import inf

import pytest

from gr_ros2.link import AirPacket, Delivered, Endpoint, Lost, SenderEvent, SentPacket
from gr_ros2.paper.endpoint import EndpointV0
from gr_ros2.paper.settings import paper_from
from tests.link.engines import registry
from tests.packets import data_of


def end(robot: int, *, sends: bool = True, hears: bool = True, told: list[SenderEvent] | None = None) -> EndpointV0:
    direction = "both" if sends and hears else "send" if sends else "receive"
    settings = paper_from(robot=robot, packet_len=64, packet_rate=100.0, reassembly_timeout_s=0.5, direction=direction)
    observer = None if told is None else told.append
    return EndpointV0(registry(), *settings, codec=None, rng=random.Random(robot), observer=observer)


def run(ends: list[Endpoint], until: float) -> list[list[bytes]]:
    """Each hears at once what the other sends; the messages that each delivered, in order."""
    got: list[list[bytes]] = [[], []]
    now = 0.0
    while now < until:
        for place, (one, other) in enumerate((ends, ends[::-1])):
            events = one.handle_timeout(now)
            while (data := data_of(one.next_packet(now))) is not None:
                got[1 - place] += [e.payload for e in other.receive(AirPacket(data), now) if isinstance(e, Delivered)]
            assert not any(isinstance(event, Delivered) for event in events)
        later = [at for e in ends for at in (e.next_timeout(), e.next_departure()) if at is not None]
        assert all(at > now for at in later), "what is due has been done"
        now = min(later, default=inf)
    return got


def test_two_ends_send_to_each_other() -> None:
    told: list[SenderEvent] = []
    ends: list[Endpoint] = [end(1, told=told), end(2)]
    messages = [[bytes([robot, number]) * 60 for number in range(5)] for robot in (1, 2)]
    for number in range(5):
        for place, one in enumerate(ends):
            one.messages.submit(number % 3, messages[place][number], 0.0)
    assert not ends[0].idle
    got = run(ends, 10.0)
    assert [sorted(payloads) for payloads in got] == [sorted(messages[1]), sorted(messages[0])]
    assert all(one.idle and one.next_timeout() is one.next_departure() is None for one in ends)
    assert ends[0].sent.packets == ends[1].received.packets == sum(isinstance(event, SentPacket) for event in told)


def test_an_end_that_only_sends_and_one_that_only_hears() -> None:
    source, sink = end(1, hears=False), end(2, sends=False)
    source.messages.submit(0, bytes(100), 0.0)
    packets = [data_of(source.next_packet(number / 100)) for number in range(4)]
    assert packets[2:] == [None] * 2, "two fragments"
    assert source.receive(AirPacket(packets[0] or b""), 0.0) == source.handle_timeout(9.0) == []
    events = [event for data in packets[:2] for event in sink.receive(AirPacket(data or b""), 0.0)]
    assert [event.payload for event in events if isinstance(event, Delivered)] == [bytes(100)]
    assert sink.next_packet(0.0) is None
    assert sink.idle


def test_each_half_says_when_it_has_something_to_do() -> None:
    one, other = end(1), end(2)
    other.messages.submit(0, bytes(160), 0.0)
    first, _ = data_of(other.next_packet(0.0)), data_of(other.next_packet(0.0))
    assert other.next_departure() == pytest.approx(0.01), "the next packet"
    one.receive(AirPacket(first or b""), 0.0)
    assert one.next_timeout() == pytest.approx(0.5), "the incomplete message"
    one.messages.submit(0, b"x", 0.1)
    assert one.next_departure() == pytest.approx(-inf)
    assert one.next_packet(0.1) is not None
    assert [type(event) for event in one.handle_timeout(0.5)] == [Lost]
    assert one.next_timeout() is None


def test_packets_wait_for_credit() -> None:
    one = end(1)
    one.pace.use_credit()
    one.messages.submit(0, b"x", 0.0)
    assert one.next_packet(0.0) is None
    one.pace.credit()
    assert one.next_packet(0.0) is not None
