"""Several observers of one link."""

from __future__ import annotations

from gr_ros2.core.errors import CrcError
from gr_ros2.link.events import Accepted, Delivered, ReceiverEvent, Rejected, SenderEvent
from gr_ros2.link.observe import LinkObserver, Observers, name_of


class Hears:
    """Keeps what it hears, and fails at one kind of event."""

    def __init__(self, name: str = "", fails_at: str = "") -> None:
        self.name = name or "hears"
        self.heard: list[str] = []
        self._fails_at = fails_at

    def sender_event(self, src_id: int, event: SenderEvent) -> None:  # noqa: ARG002
        self._hear("sender")

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:  # noqa: ARG002
        self._hear("packet" if isinstance(event, Rejected) else "message")

    def _hear(self, what: str) -> None:
        if what == self._fails_at:
            raise ValueError(what)
        self.heard.append(what)


def tell(observers: Observers[LinkObserver]) -> None:
    observers.sender_event(1, Accepted(0, 0, b"", 0.0))
    observers.receiver_event(Rejected(b"", CrcError("x")), 0.0)
    observers.receiver_event(Delivered(1, 0, b"", 0), 0.0)


def test_one_that_fails_costs_the_others_nothing() -> None:
    whole = ["sender", "packet", "message"]
    for place, kind in enumerate(whole):
        first, bad, last = Hears(), Hears("bad", kind), Hears()
        observers = Observers[LinkObserver]([first, bad, last])
        tell(observers)
        tell(observers)
        assert first.heard == last.heard == whole * 2
        assert bad.heard == whole[:place]
        assert observers.incomplete() == [f"bad: ended (ValueError: {kind}); {6 - place} events missed"]


def test_what_one_within_another_missed_is_told_too() -> None:
    inner = Observers[LinkObserver]([Hears("deep", "packet")])
    observers = Observers[LinkObserver]([inner])
    late = Hears()
    tell(observers)
    guard = observers.add(late, needed=True)
    tell(observers)
    assert late.heard == ["sender", "packet", "message"]
    assert guard.name == name_of(late) == "hears"
    assert observers.incomplete() == ["deep: ended (ValueError: packet); 5 events missed"]
    assert name_of(observers) == "Observers"
