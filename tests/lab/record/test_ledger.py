"""The loss ledger: fates add up whatever happens, and say what happened where that is known."""

from __future__ import annotations

import random
from array import array
from collections import Counter
from math import isnan

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gr_ros2.compression import LinkCodec
from gr_ros2.core.errors import CrcError, PadError, RunError
from gr_ros2.link import AirPacket
from gr_ros2.link.events import (
    Accepted,
    Delivered,
    Lost,
    Missed,
    PacketId,
    Received,
    Refused,
    Rejected,
    SenderEvent,
    SentEntry,
    SentPacket,
)
from gr_ros2.paper.receiver import Receiver
from gr_ros2.paper.sender import Sender
from gr_ros2.paper.settings import paper_from
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry, Topic
from gr_ros2.wire.v0 import PacketV0
from gr_ros2_lab.record.ledger import REORDER_WINDOW, Ledger, TopicLedger
from tests.compression.support import Writer
from tests.packets import data_of

SRC = 1


def packet(number: int, *entries: SentEntry) -> SentPacket:
    return sent(number, entries, float(number))


def sent(number: int, entries: tuple[SentEntry, ...], now: float) -> SentPacket:
    return SentPacket(b"", PacketV0(SRC, 255, 0, 1, ()), *named(number), entries, now)


def named(number: int) -> PacketId:
    return PacketId(SRC, 0, number, 0)


def entry(serial: int, key: int, index: int = 0, total: int = 1, topic_id: int = 0) -> SentEntry:
    return SentEntry(serial, topic_id, key, index, total)


def repeated(serial: int, key: int, topic_id: int = 0) -> SentEntry:
    return SentEntry(serial, topic_id, key, 0, 1, repeat=True)


def feed(*events: SenderEvent) -> Ledger:
    ledger = Ledger()
    for event in events:
        ledger.sender_event(SRC, event)
    return ledger


def only(books: list[TopicLedger]) -> TopicLedger:
    assert len(books) == 1
    return books[0]


def accepted(serial: int, payload: bytes | None = None, topic_id: int = 0) -> Accepted:
    return Accepted(serial, topic_id, b"message %d" % serial if payload is None else payload, float(serial))


def test_a_delivered_message_keeps_its_times_and_size() -> None:
    ledger = feed(accepted(0, b"hello"), packet(0, entry(0, 7)))
    ledger.packet_received(named(0))
    ledger.receiver_event(Delivered(SRC, 0, b"hello", 0, 7), 2.5)
    book = only(ledger.finish())
    assert book.fates == {"delivered": 1}
    assert (book.t_sent, book.t_delivered, book.size) == (array("d", [0.0]), array("d", [2.5]), array("L", [5]))


def test_refusals_before_and_after_queueing() -> None:
    ledger = feed(Refused(0, 0, "too_large"), accepted(1), Refused(1, 0, "queue_bound"), accepted(2))
    book = only(ledger.finish())
    assert (book.sent, book.fates) == (3, {"too_large": 1, "queue_bound": 1, "in_flight": 1})
    assert isnan(book.t_sent[0])


def test_what_the_sources_graph_lost_is_sent_and_has_a_fate() -> None:
    ledger = feed(Missed(0, 2), accepted(0), Missed(0, 3), Refused(1, 0, "too_large"))
    assert ledger.totals() == (7, 0)
    assert ledger.fates() == {(SRC, 0): {"lost_on_graph": 5, "too_large": 1, "in_flight": 1}}
    book = only(ledger.finish())
    assert (book.sent, book.fates) == (7, {"lost_on_graph": 5, "too_large": 1, "in_flight": 1})
    assert list(book.serial) == [0, 1]


def test_what_lies_behind_the_last_packet_received_is_in_flight() -> None:
    ledger = feed(
        *(accepted(serial) for serial in range(4)),
        packet(0, entry(0, 0)),
        packet(1, entry(1, 1)),
        packet(2, entry(2, 2, 0, 2)),
    )
    ledger.packet_received(named(1))
    ledger.receiver_event(Delivered(SRC, 0, b"message 1", 0, 1), 9.0)
    # 0 was overtaken; 2 is half sent; 3 still waits
    assert only(ledger.finish()).fates == {"delivered": 1, "lost_fragments": 1, "in_flight": 2}


def test_an_empty_phy_turns_in_flight_into_lost() -> None:
    ledger = feed(accepted(0), accepted(1), packet(0, entry(0, 0)))
    assert only(ledger.finish(drained=True)).fates == {"lost_fragments": 1, "in_flight": 1}


def test_everything_arrived_and_nothing_came_out() -> None:
    ledger = feed(accepted(0), packet(0, entry(0, 0)))
    ledger.packet_received(named(0))
    assert only(ledger.finish()).fates == {"not_taken": 1}


def test_the_receivers_reason_stands() -> None:
    ledger = feed(accepted(0), packet(0, entry(0, 9, 0, 2)), packet(1, entry(0, 9, 1, 2)))
    ledger.packet_received(named(0))
    ledger.receiver_event(Lost(SRC, 0, "expired", 9), 5.0)
    assert ledger.unresolved() == 0
    assert only(ledger.finish()).fates == {"expired": 1}


def test_a_delivery_proves_an_earlier_loss_wrong() -> None:
    ledger = feed(accepted(0), packet(0, entry(0, 9)))
    ledger.receiver_event(Lost(SRC, 0, "expired", 9), 5.0)
    ledger.receiver_event(Delivered(SRC, 0, b"message 0", 0, 9), 6.0)
    assert only(ledger.finish()).fates == {"delivered": 1}


def test_equal_payloads_are_told_apart_by_their_entry_ids() -> None:
    ledger = feed(*(accepted(serial, b"same") for serial in range(3)), *(packet(n, entry(n, n)) for n in range(3)))
    ledger.receiver_event(Delivered(SRC, 0, b"same", 0, 2), 5.0)
    book = only(ledger.finish(drained=True))
    assert [isnan(t) for t in book.t_delivered] == [True, True, False]


def test_a_delivery_that_matches_nothing_is_corrupt() -> None:
    ledger = feed(accepted(0, b"abc"), packet(0, entry(0, 0)))
    ledger.receiver_event(Delivered(SRC, 0, b"abd", 0, 0), 1.0)
    ledger.receiver_event(Delivered(99, 3, b"whose?", 0, 0), 1.0)
    books = ledger.finish(drained=True)
    assert [(book.src_id, book.sent, book.corrupt) for book in books] == [(SRC, 1, 1), (99, 0, 1)]
    assert books[0].fates == {"lost_fragments": 1}


def test_a_second_delivery_of_one_message_is_no_delivery() -> None:
    ledger = feed(accepted(0), packet(0, entry(0, 0)))
    for _ in range(2):
        ledger.receiver_event(Delivered(SRC, 0, b"message 0", 0, 0), 1.0)
    book = only(ledger.finish())
    assert (book.fates["delivered"], book.corrupt) == (1, 1)


def test_repeats_count_neither_as_sent_nor_as_delivered() -> None:
    ledger = feed(accepted(0, b"map"), packet(0, entry(0, 4)), packet(1, repeated(0, 5)))
    ledger.receiver_event(Delivered(SRC, 0, b"map", 0, 4), 2.0)
    ledger.receiver_event(Delivered(SRC, 0, b"map", 0, 5), 20.0)
    ledger.receiver_event(Lost(SRC, 0, "expired", 5), 20.0)
    book = only(ledger.finish(drained=True))
    assert (book.sent, book.fates, book.repeats_delivered, book.corrupt) == (1, {"delivered": 1}, 1, 0)
    assert list(book.t_delivered) == [2.0]


@pytest.mark.parametrize("told", [True, False], ids=["given up", "never heard"])
def test_a_message_that_only_a_repeat_carries_across_is_delivered(told: bool) -> None:
    """A latched message that was lost: its repeat is the same message, and on the graph of the other robot."""
    ledger = feed(accepted(0, b"map"), packet(0, entry(0, 4)), packet(1, repeated(0, 5)), packet(2, repeated(0, 6)))
    if told:
        ledger.receiver_event(Lost(SRC, 0, "expired", 4), 1.0)
    assert ledger.receiver_event(Delivered(SRC, 0, b"map", 0, 5), 20.0) == 0.0
    assert ledger.receiver_event(Delivered(SRC, 0, b"map", 0, 6), 30.0) is None
    book = only(ledger.finish(drained=True))
    assert (book.sent, book.fates, book.repeats_delivered, book.corrupt) == (1, {"delivered": 1}, 1, 0)
    assert list(book.t_delivered) == [20.0]


def test_a_repeat_that_comes_out_altered_is_corrupt() -> None:
    ledger = feed(accepted(0, b"map"), packet(0, entry(0, 4)), packet(1, repeated(0, 5)))
    ledger.receiver_event(Delivered(SRC, 0, b"mop", 0, 5), 20.0)
    book = only(ledger.finish(drained=True))
    assert (book.fates, book.repeats_delivered, book.corrupt) == ({"lost_fragments": 1}, 0, 1)


def test_a_message_that_takes_a_repeats_id_is_itself_again() -> None:
    ledger = feed(
        accepted(0, b"map"), packet(0, entry(0, 4)), packet(1, repeated(0, 5)), accepted(1), packet(2, entry(1, 5))
    )
    ledger.receiver_event(Delivered(SRC, 0, b"message 1", 0, 5), 20.0)
    assert only(ledger.finish(drained=True)).fates == {"lost_fragments": 1, "delivered": 1}


def test_a_delivery_told_before_its_packet_is_matched_in_the_end() -> None:
    ledger = Ledger()
    ledger.receiver_event(Delivered(SRC, 0, b"message 0", 0, 0), 1.0)
    ledger.sender_event(SRC, accepted(0))
    book = only(ledger.finish())
    assert (book.fates, book.corrupt) == ({"delivered": 1}, 0)


def test_packets_are_counted_by_fate() -> None:
    ledger = feed(packet(0), packet(1))
    assert ledger.packet_received(named(0)) == 0
    assert ledger.packet_received(named(2)) is None, "of another run"
    ledger.receiver_event(Rejected(b"noise", CrcError("no")), 0.0)
    ledger.receiver_event(Rejected(b"noise", PadError("no")), 0.0)
    counts = {"sent": 2, "received": 2, "crc_failed": 1, "malformed": 1, "rejected_crc": 1, "rejected_pad": 1}
    assert ledger.packets() == counts


def test_contradictory_events_are_a_run_error() -> None:
    with pytest.raises(RunError, match="serial 0 was reported twice"):
        feed(accepted(0), accepted(0)).finish()
    with pytest.raises(RunError, match="reported twice"):
        feed(accepted(0), Refused(0, 0, "queue_bound"), Refused(0, 0, "queue_bound")).finish()


def test_packets_of_one_number_are_counted_one_by_one() -> None:
    """A packet that is sent again; and with version 0 packets n and n + 256."""
    ledger = Ledger()
    for serial in range(3):
        ledger.sender_event(SRC, accepted(serial, b"x"))
        ledger.sender_event(SRC, sent(7, (entry(serial, 0),), 0.0))
    ledger.packet_received(named(7))
    ledger.packet_received(named(7))
    assert only(ledger.finish()).fates == {"not_taken": 2, "in_flight": 1}


@pytest.mark.parametrize("total", [1, 15])
def test_memory_of_open_messages_is_bounded(total: int) -> None:
    """Only every 11th message arrives; digests of what cannot come any more are given up."""
    ledger = Ledger()
    count = 11_000
    for serial in range(count):
        ledger.sender_event(SRC, accepted(serial))
        for index in range(total):
            number = serial * total + index
            ledger.sender_event(SRC, packet(number, entry(serial, serial % 256, index, total)))
            if serial % 11 == 0:
                ledger.packet_received(named(number))
        if serial % 11 == 0:
            ledger.receiver_event(Delivered(SRC, 0, b"message %d" % serial, 0, serial % 256), float(serial))
    assert ledger.unresolved() <= REORDER_WINDOW + 2 * 256
    book = only(ledger.finish(drained=True))
    assert book.fates == {"delivered": count // 11, "lost_fragments": count - count // 11}


_NONE: st.SearchStrategy[list[int]] = st.just([])
_SERIALS = st.lists(st.integers(0, 20), max_size=3)
_EVENTS = st.lists(
    st.one_of(
        st.tuples(
            st.sampled_from(["accept", "refuse", "deliver", "lose"]), st.integers(0, 2), st.integers(0, 3), _NONE
        ),
        st.tuples(st.just("miss"), st.integers(0, 2), st.integers(1, 3), _NONE),
        st.tuples(st.sampled_from(["drop", "arrive", "noise"]), st.integers(0, 20), st.just(0), _NONE),
        st.tuples(st.sampled_from(["send", "repeat"]), st.just(0), st.integers(0, 3), _SERIALS),
    ),
    max_size=60,
)


@settings(max_examples=100, deadline=None)
@given(_EVENTS, st.booleans())
def test_fates_add_up_whatever_happens(events: list[tuple[str, int, int, list[int]]], drained: bool) -> None:
    """Any order of events that names each serial once: every message has exactly one fate."""
    ledger = Ledger()
    topics: list[int] = []  # by serial
    gone: set[int] = set()  # serials that were refused or have started, and so cannot be dropped
    refused: set[int] = set()
    packets: list[int] = []
    missed: Counter[int] = Counter()
    for now, (kind, first, second, many) in enumerate(events):
        if kind == "accept":
            ledger.sender_event(SRC, Accepted(len(topics), first, b"payload %d" % second, now))
            topics.append(first)
        elif kind == "refuse":
            gone.add(len(topics))
            refused.add(len(topics))
            ledger.sender_event(SRC, Refused(len(topics), first, "too_large"))
            topics.append(first)
        elif kind == "miss":
            missed[first] += second
            ledger.sender_event(SRC, Missed(first, second))
        elif kind == "drop" and first < len(topics) and first not in gone:
            gone.add(first)
            refused.add(first)
            ledger.sender_event(SRC, Refused(first, topics[first], "queue_bound"))
        elif kind in ("send", "repeat"):
            serials = [serial for serial in many if serial < len(topics) and serial not in refused]
            gone.update(serials)
            entries = tuple(SentEntry(s, topics[s], second, 0, 2, repeat=kind == "repeat") for s in serials)
            packets.append(len(packets) % 5)
            ledger.sender_event(SRC, sent(packets[-1], entries, now))
        elif kind == "arrive" and packets:
            ledger.packet_received(named(packets[first % len(packets)]))
        elif kind == "noise":
            ledger.packet_received(named(5))
        elif kind == "deliver":
            ledger.receiver_event(Delivered(SRC, first, b"payload %d" % second, 0, second), now)
        elif kind == "lose":
            ledger.receiver_event(Lost(SRC, first, "expired", second), now)
    books = {book.topic_id: book for book in ledger.finish(drained)}
    for topic_id in {*topics, *missed}:
        assert books[topic_id].sent == topics.count(topic_id) + missed[topic_id] == books[topic_id].fates.total()
        assert books[topic_id].fates["lost_on_graph"] == missed[topic_id]
        assert len(books[topic_id].serial) == topics.count(topic_id)
    assert all(book.fates["delivered"] == sum(not isnan(t) for t in book.t_delivered) for book in books.values())
    assert ledger.unresolved() == 0


class Erring(LinkCodec):
    """Gives every third message back with one bit of its last eight bytes wrong."""

    count = 0

    def decode(self, topic_id: int, coded: bytes) -> bytes:
        payload = super().decode(topic_id, coded)
        self.count += 1
        return payload[:-8] + bytes([payload[-8] ^ 1]) + payload[-7:] if self.count % 3 == 0 else payload


@pytest.mark.parametrize(("decoder", "wrong"), [(LinkCodec, 0), (Erring, 20)])
def test_what_a_codec_changes_on_purpose_is_delivered_and_nothing_else_is(decoder: type[LinkCodec], wrong: int) -> None:
    """Fields quantised, garbage in the alignment gaps: as sent, unless the codec errs."""
    options = SendOptions(quantize="pose.pose=0.001 twist.twist.linear=0.01")
    registry = Registry([Topic(0, "odom", "nav_msgs/msg/Odometry", options)])
    ledger = Ledger()
    config = paper_from(robot=SRC, packet_len=220, compression=True)
    sender = Sender(
        registry, *config, codec=LinkCodec(registry), observer=lambda event: ledger.sender_event(SRC, event)
    )
    receiver = Receiver(registry, *paper_from(robot=0, packet_len=220), codec=decoder(registry))
    delivered: list[bytes] = []
    written = [Writer(random.Random(seed)).message("nav_msgs/msg/Odometry")[0] for seed in range(60)]
    for now, payload in enumerate(written):
        sender.submit(0, payload, now)
        while (data := data_of(sender.next_packet(now))) is not None:
            for event in receiver.receive(AirPacket(data), now):
                if isinstance(event, Received):
                    assert ledger.packet_received(event.identity) is not None
                ledger.receiver_event(event, now)
                if isinstance(event, Delivered):
                    delivered.append(event.payload)
    book = only(ledger.finish())
    assert not set(written) & set(delivered), "every message was changed on the way"
    assert (book.fates["delivered"], book.corrupt) == (60 - wrong, wrong)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    loss=st.sampled_from([0.0, 0.02, 0.2, 0.6]),
    damage=st.sampled_from([0.0, 0.1]),
    delay=st.integers(0, 30),
    queue_depth=st.sampled_from([0, 1, 3]),
    sizes=st.sampled_from([(1, 40), (200, 900), (0, 70_000)]),
)
def test_the_engines_over_a_bad_link(
    *, seed: int, loss: float, damage: float, delay: int, queue_depth: int, sizes: tuple[int, int]
) -> None:
    """A real sender and receiver; packets are delayed, lost and damaged: no fate is missing, no message corrupt."""
    rng = random.Random(seed)
    registry = Registry.from_rows({"odom": "nav_msgs/Odometry", "map": "nav_msgs/OccupancyGrid"})
    ledger = Ledger()
    source = paper_from(robot=SRC, packet_len=64, queue_depth=queue_depth, repeat_s=0.5)
    sender = Sender(registry, *source, rng=rng, observer=lambda event: ledger.sender_event(SRC, event))
    receiver = Receiver(registry, *paper_from(robot=0, packet_len=64, reassembly_timeout_s=0.2))
    air: list[bytes] = []
    submitted = [0, 0]
    outcome = [0, 0]
    for step in range(400):
        now = step / 100
        if step < 300 and step % 3 == 0:
            topic_id = rng.randrange(2)
            submitted[topic_id] += 1
            sender.submit(topic_id, rng.randbytes(rng.randint(*sizes)), now)
        for _ in range(rng.randrange(6)):
            data = data_of(sender.next_packet(now))
            if data is not None and rng.random() >= loss:
                spoilt = rng.random() < damage
                air.append(bytes([data[0] ^ 1]) + data[1:] if spoilt else data)
        events = receiver.handle_timeout(now)
        while len(air) > delay:
            data = air.pop(0)
            events += receiver.receive(AirPacket(data), now)
        for event in events:
            if isinstance(event, Received):
                assert ledger.packet_received(event.identity) is not None
            ledger.receiver_event(event, now)
            if isinstance(event, Delivered):
                outcome[event.topic_id] += 1
    books = ledger.finish()
    assert sum(book.sent for book in books) == sum(submitted)
    for book in books:
        assert book.sent == submitted[book.topic_id] == book.fates.total()
        assert book.corrupt == 0
        assert book.fates["delivered"] + book.repeats_delivered == outcome[book.topic_id]
        if not (loss or damage or queue_depth) and sizes[1] < 1000:
            assert set(+book.fates) <= {"delivered", "in_flight"}
        assert not book.fates["not_taken"]
    assert ledger.packets()["crc_failed"] == receiver.stats.rejected["crc"]
