"""The engine of calls: nothing is executed twice, and every call ends under one name."""

from __future__ import annotations

import random
from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.calls import Answer, Calls, Offer, OutgoingFrame, Request, Service
from gr_ros2.calls.engine import MAX_CALLS

FAR = Service(2, 20, 5, "/rx_robot_2/add")
OFFERS = {5: Offer("/robot_2/add")}
CALLER = (1, 10)


def pair() -> tuple[Calls, Calls]:
    return Calls(1, 10), Calls(2, 20)


def call(one: Calls, token: int = 0, *, deadline_s: float = 30.0, now: float = 0.0) -> bytes:
    sent = one.call(FAR, token, b"%d" % token, deadline_s=deadline_s, now=now)
    assert sent is not None
    return sent.data


def asked(two: Calls, data: bytes, *, now: float = 0.0, sender: tuple[int, int] = CALLER) -> Request:
    request = two.receive(sender, data, OFFERS, now)
    assert isinstance(request, Request)
    return request


def test_a_call_goes_over_and_its_reply_comes_back() -> None:
    one, two = pair()
    request = asked(two, call(one, 7))
    assert (request.service_id, request.payload) == (5, b"7")
    reply = two.reply(request.ticket, b"seven", 1.0)
    assert reply is not None and reply.lifespan_s == 29.0
    assert one.receive((2, 20), reply.data, {}, 1.5) == Answer(2, 5, 7, b"seven")
    assert one.counters == {"called:/rx_robot_2/add": 1, "answered:/rx_robot_2/add": 1}
    assert two.counters == {"served:/robot_2/add": 1, "replied:/robot_2/add": 1}
    assert one.waiting == two.waiting == (0, 0)


def test_a_call_without_a_reply_times_out_at_both_ends_by_name() -> None:
    one, two = pair()
    request = asked(two, call(one, deadline_s=2.0), now=0.5)
    one.expire(1.9)
    assert one.waiting == (1, 0)
    one.expire(2.0)
    assert one.counters["timed_out:/rx_robot_2/add"] == 1
    assert two.reply(request.ticket, b"late", 2.5) is None
    assert two.counters["unanswered:/robot_2/add"] == two.counters["late"] == 1
    assert one.waiting == two.waiting == (0, 0)


def test_a_server_may_have_less_time_than_the_caller_waits() -> None:
    one, two = pair()
    request = two.receive(CALLER, call(one, deadline_s=30.0), {5: Offer("/robot_2/add", 2.0)}, 0.0)
    assert isinstance(request, Request)
    assert two.reply(request.ticket, b"", 2.0) is None
    assert one.waiting == (1, 0)


def test_a_late_reply_reaches_nobody() -> None:
    one, two = pair()
    request = asked(two, call(one, deadline_s=2.0), now=0.5)
    reply = two.reply(request.ticket, b"!", 2.0)
    assert reply is not None
    assert one.receive((2, 20), reply.data, {}, 2.1) is None
    assert one.counters["late"] == one.counters["timed_out:/rx_robot_2/add"] == 1


def test_a_call_counts_from_its_caller() -> None:
    one, two = pair()
    late = call(one, deadline_s=5.0)
    assert two.receive(CALLER, late, OFFERS, 6.0, age_s=6.0) is None
    assert two.counters["late"] == 1
    found = two.receive(CALLER, call(one, deadline_s=5.0), OFFERS, 7.0, age_s=3.0)
    assert isinstance(found, Request)
    two.expire(9.1)
    assert two.waiting == (0, 0)


def test_a_call_without_a_deadline_waits() -> None:
    one, two = pair()
    sent = one.call(FAR, 0, b"", deadline_s=1e6, now=0.0)
    assert sent is not None
    request = asked(two, sent.data)
    reply = two.reply(request.ticket, b"", 1e6)
    assert reply is not None
    assert isinstance(one.receive((2, 20), reply.data, {}, 2e6), Answer)


def test_a_request_is_for_one_start_of_one_robot_and_taken_once() -> None:
    one, two = pair()
    first, second = call(one, 1), call(one, 2)
    asked(two, second)
    for data in (second, first):  # repeated, and out of order
        assert two.receive(CALLER, data, OFFERS, 0.0) is None
    assert two.counters["repeated"] == 2
    again, other = Calls(2, 21), Calls(3, 20)
    assert again.receive(CALLER, second, OFFERS, 0.0) is other.receive(CALLER, second, OFFERS, 0.0) is None
    assert (again.counters, other.counters) == ({"other_start": 1}, {"not_for_us": 1})


def test_a_caller_that_starts_again_numbers_its_calls_anew() -> None:
    one, two = pair()
    ticket = asked(two, call(one)).ticket
    two.started(1, 11)
    assert two.counters["caller_gone:/robot_2/add"] == 1
    assert two.reply(ticket, b"", 1.0) is None
    asked(two, call(Calls(1, 11)), sender=(1, 11))


def test_calls_end_with_the_service_and_with_the_robots_start() -> None:
    one, _ = pair()
    call(one, 1)
    one.withdrawn(2, [4])
    one.withdrawn(3, [5])
    one.started(2, 20)
    assert one.waiting == (1, 0)
    one.withdrawn(2, [5])
    call(one, 2)
    one.started(2, 21)
    assert one.counters["server_gone:/rx_robot_2/add"] == 2
    assert one.waiting == (0, 0)


def test_what_nobody_offers_and_what_is_no_frame_is_counted() -> None:
    one, two = pair()
    assert two.receive(CALLER, call(one), {}, 0.0) is None
    assert two.receive(CALLER, b"\2", OFFERS, 0.0) is None
    assert two.counters == {"no_server": 1, "malformed": 1}


def test_an_answer_of_another_robot_is_not_taken() -> None:
    one, two = pair()
    reply = two.reply(asked(two, call(one)).ticket, b"", 0.0)
    assert reply is not None
    assert one.receive((3, 20), reply.data, {}, 0.0) is one.receive((2, 21), reply.data, {}, 0.0) is None
    assert isinstance(one.receive((2, 20), reply.data, {}, 0.0), Answer)


def test_memory_is_bounded_at_both_ends() -> None:
    one, two = pair()
    frames = [call(one, number) for number in range(MAX_CALLS)]
    assert one.call(FAR, -1, b"", deadline_s=30.0, now=0.0) is None
    assert one.counters["too_many:/rx_robot_2/add"] == 1
    for data in frames:
        asked(two, data)
    one.expire(30.0)
    assert two.receive(CALLER, call(one, now=30.0, deadline_s=9.0), OFFERS, 29.0) is None
    assert two.counters["refused:/robot_2/add"] == 1
    assert asked(two, call(Calls(3, 30)), now=29.0, sender=(3, 30))


def test_of_too_many_calls_the_oldest_without_a_deadline_makes_room() -> None:
    one, two = pair()
    frames = [call(one, number, deadline_s=30.0 if number == 0 else 0.0) for number in range(MAX_CALLS)]
    tickets = [asked(two, data).ticket for data in frames]
    asked(two, call(one, 1000))
    assert one.counters["too_many:/rx_robot_2/add"] == two.counters["refused:/robot_2/add"] == 1
    assert two.reply(tickets[0], b"", 1.0) is not None
    assert two.reply(tickets[1], b"", 1.0) is None
    assert one.waiting == (MAX_CALLS, 0)


@given(st.integers(0, 2**32))
def test_whatever_is_lost_repeated_late_or_restarted_nothing_runs_twice_and_the_books_balance(seed: int) -> None:
    rng = random.Random(seed)
    starts = Counter({1: 10, 2: 20})
    one, two = pair()
    executed: Counter[tuple[int, bytes]] = Counter()
    answered: Counter[int] = Counter()
    ended: Counter[str] = Counter()
    air: list[tuple[int, tuple[int, int], bytes]] = []
    waiting: list[int] = []
    serial = calls = 0
    for step in range(120):
        now = step * 0.5
        what = rng.choice("cccccdddddddrrrb2")
        sent: OutgoingFrame | None = None
        if what == "c":
            serial += 1
            calls += 1
            service = Service(2, starts[2], 5, FAR.name)
            sent = one.call(service, serial, b"%d" % serial, deadline_s=rng.choice((0.0, 1.0, 10.0)), now=now)
            air += [(2, (1, starts[1]), sent.data)] if sent else []
        elif what == "d" and air:
            to, sender, data = rng.choice(air)
            if rng.random() < 0.7:
                air.remove((to, sender, data))
            if sender[1] != starts[sender[0]]:
                continue  # the link takes nothing of an earlier start
            found = (one if to == 1 else two).receive(sender, data, OFFERS if to == 2 else {}, now)
            if isinstance(found, Request):
                executed[starts[1], found.payload] += 1
                waiting.append(found.ticket)
            elif isinstance(found, Answer):
                assert isinstance(found.token, int)
                answered[found.token] += 1
        elif what == "r" and waiting:
            sent = two.reply(waiting.pop(rng.randrange(len(waiting))), b"done", now)
            air += [(1, (2, starts[2]), sent.data)] if sent else []
        elif what == "b" and rng.random() < 0.3:
            starts[2] += 1
            two, waiting = Calls(2, starts[2]), []
            two.started(1, starts[1])
            one.started(2, starts[2])
        elif what == "2" and rng.random() < 0.3:
            ended.update(one.counters)
            calls -= one.waiting[0]
            starts[1] += 1
            one = Calls(1, starts[1])
            two.started(1, starts[1])
    ended.update(one.counters)
    assert max(executed.values(), default=0) <= 1
    assert max(answered.values(), default=0) <= 1
    name = FAR.name
    ends = sum(ended[f"{end}:{name}"] for end in ("answered", "timed_out", "server_gone", "too_many"))
    assert calls == ends + one.waiting[0]
    here = two.counters
    assert here["served:/robot_2/add"] == two.waiting[1] + sum(
        here[f"{end}:/robot_2/add"] for end in ("replied", "unanswered", "caller_gone", "refused")
    )
