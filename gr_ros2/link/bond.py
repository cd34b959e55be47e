"""Several radios under one endpoint: over which of them each packet leaves, and which copy of a packet counts.

*The rule.* The radio that asked first carries the next packet, so radios of one speed share what there is to send. A
slower one stands by, since what it carried would arrive after the next packets of the faster one. Packets that must not
be lost with a radio (commands, reports, hellos) leave over every radio, with the same bytes, and the first that arrives
counts. These copies also tell over which radios a robot is heard: a radio over which fewer than half of them come
carries nothing else until they come again.

Invariants: as everywhere in ``link``, nothing happens outside a call. What is not authentic changes nothing: only
packets that the endpoint has taken count as heard. A radio has at most ``OUTSTANDING`` packets that it did not ask for.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

from gr_ros2.core.tuning import Tuning
from gr_ros2.link.airtime import OUTSTANDING
from gr_ros2.link.events import Gone, Received, ReceiverEvent

_REMEMBERED = 1024
"""Packets of which copies are recognized."""


@dataclass(slots=True, eq=False)
class _Came:
    """A packet that has come: over which radios, as bits; and of which robot it is, if all radios were to carry it."""

    radios: int
    src_id: int | None = None


class Bond:
    """The radios of one robot, by their numbers from 0 on.

    :param airtimes: s that the longest packet occupies on each
    :param apart: those that carry nothing here
    :ivar apart: the same
    :ivar present: whether the device of each is there
    :ivar carries: whether each carries packets that leave only once
    :ivar sent, copied, skipped, came, copies: packets that each has carried alone, and as a copy; copies for which it
        had no room; packets that came over it first, and as a copy
    """

    def __init__(self, airtimes: Sequence[float], apart: Collection[int] = (), tuning: Tuning = Tuning()) -> None:
        self._tuning = tuning
        self._airtimes, self.apart = tuple(airtimes), frozenset(apart)
        every = range(len(self._airtimes))
        self.sent, self.copied, self.skipped, self.came, self.copies = ([0 for _ in every] for _ in range(5))
        self.present = [True for _ in every]
        self._held = [0 for _ in every]
        """Packets for which each has asked while it stands by."""
        self._owed = [0 for _ in every]
        """Packets that took the place of one for which each had asked, and which still waits: the next is none more."""
        self._lacked = [False for _ in every]
        """Whether each had no room for the last copy that it was to carry."""
        self._extra = [0 for _ in every]
        """Packets for which each has not asked, since it asked last."""
        self._asked: deque[int] = deque()
        """The radios that wait for the next packets, in order."""
        self._heard: dict[int, list[float]] = {}
        """Share of the packets of each robot that were to come over all radios and did come over each, 0..1."""
        self._known: dict[bytes, _Came] = {}
        self.carries = [False for _ in every]
        self._choose()

    def ask(self, radio: int, packets: int) -> int:
        """A radio asks for so many further packets; returns for how many the endpoint is to be asked."""
        self._extra[radio] = 0 if packets else self._extra[radio]
        paid = min(packets, self._owed[radio])
        self._owed[radio] -= paid
        self._held[radio] += packets - paid
        return self.asks()

    def asks(self) -> int:
        """For how many further packets the endpoint is to be asked: a radio has begun to carry packets."""
        asked = 0
        for radio, held in enumerate(self._held):
            if held and self.carries[radio]:
                self._asked += [radio] * held
                self._held[radio] = 0
                asked += held
        return asked

    def leave(self, *, everywhere: bool) -> list[int]:
        """The radios over which the next packet leaves.

        :param everywhere: it must not be lost with a radio
        """
        first = self._next()
        self.sent[first] += 1
        if not everywhere:
            return [first]
        radios = [first]
        for radio, present in enumerate(self.present):
            if radio == first or not present or radio in self.apart:
                continue
            if self._takes(radio):
                self.copied[radio] += 1
                radios.append(radio)
            else:
                self.skipped[radio] += 1
                self._lacked[radio] = True
        return radios

    def unused(self, radio: int) -> int:
        """For how many packets a radio has asked that have not come."""
        return self._held[radio] + max(self._promised(radio), 0)

    def wants(self, radio: int, *, waiting: bool) -> bool:
        """Whether there is something to send over a radio.

        :param waiting: whether the endpoint has a packet for those that carry
        """
        return self._lacked[radio] or (waiting and self.carries[radio])

    def arrive(self, radio: int, data: bytes) -> bool:
        """A packet comes over a radio. False for a copy of one that came over another: the endpoint does not see it."""
        known, bit = self._known.get(data), 1 << radio
        if known is None or known.radios & bit:
            self.came[radio] += 1
            if known is None:
                self._known[data] = _Came(bit)
                if len(self._known) > _REMEMBERED:
                    del self._known[next(iter(self._known))]
            return True
        known.radios |= bit
        self.copies[radio] += 1
        if known.src_id in self._heard:
            self._heard[known.src_id][radio] += self._tuning.bond_weight
            self._choose()
        return False

    def note(self, events: Iterable[ReceiverEvent]) -> None:
        """What the endpoint made of packets that came."""
        for event in events:
            if isinstance(event, Received):
                repair = getattr(event.packet, "repair", None)
                if repair is not None and not repair.mask:  # control packets leave over every radio
                    self._taken(event.src_id, event.data)
            elif isinstance(event, Gone):
                self._heard.pop(event.src_id, None)
                self._choose()

    def vanish(self, radio: int) -> None:
        """The device of a radio is gone."""
        self.present[radio] = False
        self._choose()

    def come_back(self, radio: int, *, anew: bool = False) -> None:
        """The device of a radio is there again.

        :param anew: it was opened again, and what it had asked for is forgotten
        """
        self.present[radio] = True
        if anew:
            self._held[radio] = self._owed[radio] = 0
            self._asked = deque(other for other in self._asked if other != radio)
        self._choose()

    def heard(self, radio: int) -> dict[int, float]:
        """Share of the packets of each robot that were to come over every radio and came over this one, 0..1."""
        if radio in self.apart:
            return {}
        return {src_id: min(shares[radio], 1.0) for src_id, shares in self._heard.items()}

    def _taken(self, src_id: int, data: bytes) -> None:
        known = self._known.get(data)
        if known is None or known.src_id is not None:
            return
        known.src_id = src_id
        shares = self._heard.get(src_id, [1.0 for _ in self._airtimes])
        came = [bool(known.radios >> radio & 1) for radio in range(len(shares))]
        weight = self._tuning.bond_weight
        self._heard[src_id] = [share + (here - share) * weight for share, here in zip(shares, came, strict=True)]
        self._choose()

    def _choose(self) -> None:
        """Find the radios that carry packets: those that every robot is heard over, and not much slower ones."""
        good = [all(2 * shares[r] >= max(shares) for shares in self._heard.values()) for r in range(len(self.present))]
        ours = [radio not in self.apart for radio in range(len(self.present))]
        here = [own and present for own, present in zip(ours, self.present, strict=True)]
        usable = [there and fine for there, fine in zip(here, good, strict=True)]
        if not any(usable):
            usable = here if any(here) else ours
        most = self._tuning.bond_like * min(takes for takes, use in zip(self._airtimes, usable, strict=True) if use)
        self.carries = [use and takes <= most for takes, use in zip(self._airtimes, usable, strict=True)]

    def _next(self) -> int:
        """The radio that asked first; another one, if that one carries nothing any more."""
        first = self._asked[0] if self._asked else -1
        if first >= 0:
            waits = self._promised(first) > 0
            self._asked.popleft()
            if not waits:  # a copy has taken its place
                self._owed[first] -= 1
                self._extra[first] += 1
            if self.carries[first]:
                return first
            if waits:
                self._held[first] += 1
        carriers = [radio for radio, carries in enumerate(self.carries) if carries]
        chosen = min(carriers, key=lambda radio: (-self._held[radio] - self._promised(radio), self._extra[radio]))
        self.spend(chosen)
        return chosen

    def _promised(self, radio: int) -> int:
        """For how many packets a radio has asked that have not come, beside those that are held."""
        return self._asked.count(radio) - self._owed[radio]

    def spend(self, radio: int) -> None:
        """A radio takes a packet that is not the next one for which it asked: a copy, or one of another endpoint."""
        self._lacked[radio] = False
        if self._held[radio]:
            self._held[radio] -= 1
        elif self._promised(radio) > 0:
            self._owed[radio] += 1
        else:
            self._extra[radio] += 1

    def _takes(self, radio: int) -> bool:
        """Whether a radio has room for a copy; it then takes one."""
        waits = self._held[radio] + self._promised(radio) > 0
        room = waits or (self.carries[radio] and self._extra[radio] < OUTSTANDING)
        if self._airtimes[radio] and not room:  # without airtime, it never asks
            return False
        self.spend(radio)
        return True
