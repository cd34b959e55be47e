"""The thread that sends, and who asks whether it goes on."""

from __future__ import annotations

import threading

from gr_ros2.gr.live_end import LiveEnd


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


def test_it_sleeps_however_much_later_the_next_packet_is_due() -> None:
    class Slow:
        urgent = True

        def next_departure(self, **_: bool) -> float:
            return 1e300

    end = LiveEnd(lambda _: Slow())  # type: ignore[arg-type, return-value]

    def wake() -> None:
        with end.lock:
            end.wake()

    with end.lock:
        other = threading.Thread(target=wake)
        other.start()
        end.sleep(lambda: 0.0)
    other.join()
    assert end.looked == 0.0
