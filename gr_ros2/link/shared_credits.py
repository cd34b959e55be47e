"""The credits of one radio that two endpoints of a robot use: the one that has all its radios, and the one that has
this radio alone.

Each credit is for both, and whoever sends a packet uses it. Where both want one, they get them in turn.

Invariant: the credits of either are never more than the radio has given and nobody has used.
"""

from __future__ import annotations

ALL, ALONE = 0, 1
"""The endpoint that has all radios, and the one that has this radio alone."""


class SharedCredits:
    """See the module.

    :param unused: credits that were given before
    """

    def __init__(self, unused: int = 0) -> None:
        self._unused = unused
        self._own = [0, 0]
        """Those of them that are for one of the two."""
        self._newest = ALONE
        """Who got the last one that both wanted, or has sent since."""

    def grant(self, packets: int, *, wanted_by: set[int]) -> list[int]:
        """The radio takes so many further packets; returns how many more either may send.

        :param wanted_by: who has something to send
        """
        more = [packets, packets]
        self._unused += packets
        if len(wanted_by) > 1:
            for _ in range(packets):
                self._newest = 1 - self._newest
                self._own[self._newest] += 1
                more[1 - self._newest] -= 1
        return more

    def left(self, which: int) -> bool:
        """One of the two has sent a packet; returns whether the other one may send one less."""
        before = self.of(1 - which)
        self._newest = which
        self._unused = max(self._unused - 1, 0)
        self._own[which] = max(self._own[which] - 1, 0)
        self._own = [min(own, self._unused) for own in self._own]
        return self.of(1 - which) < before

    def of(self, which: int) -> int:
        """How many packets one of the two may send."""
        return max(self._unused - self._own[1 - which], 0)

    def forget(self) -> None:
        """The device was opened again, and gives all credits anew."""
        self._unused, self._own = 0, [0, 0]
