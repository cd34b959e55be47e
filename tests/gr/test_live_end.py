"""The thread that sends, and who asks whether it goes on."""

from __future__ import annotations

import threading
from math import inf

from gr_ros2.gr.live_end import LiveEnd
from gr_ros2.link.pace import Pace
from gr_ros2.settings.fields import AUTO
from tests.waiting import wait_for


def test_a_thread_that_has_slept_for_long_is_never_taken_for_stalled() -> None:
    """Whoever asks takes no lock, so it is asked after each step of a thread that awakes after 12 s."""
    clock = [0.0]
    said: list[float] = []

    class Asked(LiveEnd):
        def __setattr__(self, name: str, value: object) -> None:
            super().__setattr__(name, value)
            if hasattr(self, "endpoint"):
                said.append(self.stalled_s(clock[0]))

    class Idle:
        def next_departure(self, **_: bool) -> None:
            pass

    end = Asked(lambda _: Idle())  # type: ignore[arg-type, return-value]
    end.looked = 0.0
    said.clear()

    def wake() -> None:
        with end.work:  # free once the other thread sleeps
            clock[0] = 12.0
            end.work.notify()

    with end.lock:
        other = threading.Thread(target=wake)
        other.start()
        end.sleep(lambda: clock[0])
    other.join()
    assert len(said) >= 3
    assert max(said) == 0
    assert end.stalled_s(23.0) == 11.0


class Later:
    """An endpoint that has a packet at a time, s."""

    def __init__(self, at: float, *, urgent: bool = True) -> None:
        self.at, self.urgent = at, urgent
        self.pace = Pace(AUTO)

    def next_departure(self, **_: bool) -> float:
        return self.at


def test_an_endpoint_is_asked_after_each_event_and_when_a_packet_is_due() -> None:
    endpoint = Later(5.0)
    end = LiveEnd(lambda _: endpoint)  # type: ignore[arg-type, return-value]
    with end.lock:
        assert end.due(0.0), "at first"
        end.nothing()
        assert not end.due(0.0)
        end.wake(credited=True)
        assert not end.due(0.0)
        end.wake()
        assert end.due(0.0), "although its thread is awake"
        end.nothing()
        assert end.due(5.0)
        endpoint.pace.use_credit()
        assert not end.due(5.0), "no packet may leave"
        end.rouse()
        assert end.due(0.0)


def test_what_happens_while_it_sleeps_is_looked_at_also_where_it_wakes_up_by_itself() -> None:
    """Where that was forgotten, messages waited until something else happened."""
    end = LiveEnd(lambda _: Later(1e300, urgent=False))  # type: ignore[arg-type, return-value]

    def submit() -> None:
        wait_for(lambda: end.sleeps_until > -inf, "it sleeps")
        with end.lock:
            end.wake()  # a packet will be due, but not before it looks anyway

    with end.lock:
        end.nothing()
        other = threading.Thread(target=submit)
        other.start()
        while not end.changed and other.is_alive():
            end.sleep(lambda: 0.0, until=0.02)
        assert end.due(0.0)
    other.join()


def test_it_sleeps_however_much_later_the_next_packet_is_due() -> None:
    end = LiveEnd(lambda _: Later(1e300))  # type: ignore[arg-type, return-value]

    def wake() -> None:
        with end.lock:
            end.wake()

    with end.lock:
        other = threading.Thread(target=wake)
        other.start()
        end.nothing()
        end.sleep(lambda: 0.0)
    other.join()
    assert end.looked == 0.0
