"""Senders that are not ours and break the rules of docs/reference/wire-format.md: messages may be lost, never mixed."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from itertools import chain, zip_longest
from typing import NamedTuple

import pytest

from gr_ros2.link import AirPacket, Delivered
from gr_ros2.paper.receiver import Receiver
from gr_ros2.paper.settings import paper_from
from gr_ros2.wire.v0 import V0, EntryV0, PacketV0
from tests.link.engines import delivered, receiver, registry
from tests.paper.test_receiver import packet

MESSAGES = 500
PACKET_RATE = 100.0


class Piece(NamedTuple):
    """A fragment on its way: of which message, under which id."""

    message: int
    entry_id: int
    index: int
    total: int


Sending = Callable[[random.Random], Iterator[Piece]]


def pieces(message: int, entry_id: int, total: int) -> list[Piece]:
    return [Piece(message, entry_id & 255, index, total) for index in range(total)]


def in_turn(first: list[Piece], second: list[Piece]) -> Iterator[Piece]:
    """A fragment of each after the other."""
    return (piece for piece in chain(*zip_longest(first, second)) if piece is not None)


def side_by_side(total: int, ids: Callable[[random.Random, int], tuple[int, int]]) -> Sending:
    """Two messages of the topic at a time."""

    def send(rng: random.Random) -> Iterator[Piece]:
        for pair in range(MESSAGES // 2):
            one, other = ids(rng, pair)
            yield from in_turn(pieces(2 * pair, one, total), pieces(2 * pair + 1, other, total))

    return send


def staggered(total: int) -> Sending:
    """Two messages of the topic at a time, each beginning in the middle of the other; random ids."""

    def send(rng: random.Random) -> Iterator[Piece]:
        streams = [
            [piece for m in range(side, MESSAGES, 2) for piece in pieces(m, rng.randrange(256), total)]
            for side in (0, 1)
        ]
        yield from streams[0][: total // 2]
        yield from in_turn(streams[0][total // 2 :], streams[1])

    return send


def backwards(total: int, *, sequential: bool) -> Sending:
    """Each message's last fragment first."""

    def send(rng: random.Random) -> Iterator[Piece]:
        for message in range(MESSAGES):
            yield from pieces(message, message if sequential else rng.randrange(256), total)[::-1]

    return send


def carry(send: Sending, loss: float, seed: int) -> tuple[int, set[int]]:
    """Deliveries that are mixed, or the second of their message, and the messages that were delivered."""
    rng = random.Random(seed)
    sink = Receiver(registry(1), *paper_from(robot=0, packet_len=64))
    got: set[int] = set()
    corrupt = 0
    for number, piece in enumerate(send(rng)):
        entry = EntryV0(0, piece.entry_id, piece.index, piece.total, piece.message.to_bytes(4, "big") * 10)
        data = V0.encode(PacketV0(1, 255, number & 255, 1, (entry,)), 64)
        if rng.random() < loss:
            continue
        for event in sink.receive(AirPacket(data), number / PACKET_RATE):
            if isinstance(event, Delivered):
                message = int.from_bytes(event.payload[:4], "big")
                whole = event.payload == event.payload[:4] * (10 * piece.total)
                corrupt += not whole or message in got
                got.add(message)
    return corrupt, got


@pytest.mark.parametrize("loss", [0.01, 0.05, 0.2])
@pytest.mark.parametrize("total", [2, 3, 8])
@pytest.mark.parametrize(
    "sending",
    [
        pytest.param(lambda total: side_by_side(total, lambda _, pair: (2 * pair, 2 * pair + 1)), id="one count"),
        pytest.param(lambda total: side_by_side(total, lambda _, pair: (pair, pair + 1)), id="a count each"),
        pytest.param(lambda total: side_by_side(total, lambda _, pair: (pair, pair + 128)), id="counts far apart"),
        pytest.param(lambda total: side_by_side(total, lambda *_: (0, 1)), id="always the same two"),
        pytest.param(
            lambda total: side_by_side(total, lambda rng, _: (rng.randrange(256), rng.randrange(256))), id="random"
        ),
        pytest.param(staggered, id="staggered, random"),
        pytest.param(lambda total: backwards(total, sequential=True), id="backwards"),
    ],
)
def test_what_a_sender_may_not_do_is_lost_and_never_mixed(
    sending: Callable[[int], Sending], total: int, loss: float
) -> None:
    corrupt, _ = carry(sending(total), loss, seed=1)
    assert corrupt == 0


@pytest.mark.parametrize("loss", [0.01, 0.05, 0.2])
def test_random_ids_and_fragments_in_reverse_are_mixed_where_they_look_like_one_message(loss: float) -> None:
    """The first of one message, sent last, and the last of the next, sent first, under the same id by chance."""
    corrupt, _ = carry(backwards(2, sequential=False), loss, seed=1)
    assert corrupt <= MESSAGES / 256 * 2 * loss + 1


def test_two_messages_under_one_id_at_the_same_time_are_both_lost() -> None:
    sink = receiver(packet_len=64)
    events = []
    for seq, (index, payload) in enumerate([(0, b"A0"), (0, b"B0"), (1, b"A1"), (1, b"B1")]):
        events += sink.receive(AirPacket(packet(seq, EntryV0(0, 7, index, 2, payload))), 0.0)
    assert delivered(events) == []
    events += sink.receive(AirPacket(packet(4, EntryV0(0, 8, 0, 2, b"C0"))), 0.0)
    events += sink.receive(AirPacket(packet(5, EntryV0(0, 8, 1, 2, b"C1"))), 0.0)
    assert delivered(events) == [b"C0C1"]


def test_fragments_in_reverse_are_refused_from_the_second_message_on() -> None:
    sink = receiver(packet_len=64)
    events = []
    for seq, (entry_id, index) in enumerate([(1, 1), (1, 0), (2, 1), (2, 0), (3, 1), (3, 0)]):
        events += sink.receive(AirPacket(packet(seq, EntryV0(0, entry_id, index, 2, bytes([entry_id])))), 0.0)
    assert delivered(events) == [b"\x01\x01"]
    assert sink.stats.lost[1, 0, "lost_fragments"] == 2


def test_a_sender_that_keeps_to_the_rules_after_a_restart_is_trusted_again() -> None:
    sink = receiver(packet_len=64)
    for number in range(100):
        for index in (1, 0):
            sink.receive(AirPacket(packet(2 * number + index & 255, EntryV0(0, number, index, 2, b"x"))), number * 0.1)
    later = [EntryV0(0, 200, index, 3, bytes([index])) for index in range(3)]
    events = sink.receive(AirPacket(packet(50, later[0])), 60.0)
    events += sink.receive(AirPacket(packet(52, later[2])), 60.2)  # the two change places on the way
    events += sink.receive(AirPacket(packet(51, later[1])), 60.3)
    assert delivered(events) == [b"\x00\x01\x02"]
