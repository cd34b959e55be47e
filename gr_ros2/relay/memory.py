"""The memory that several kinds of things share: a part is sure to each kind, the rest is for what comes first.

Invariant: as long as each kind drops something while its share is full, all together take ``most`` bytes.
"""

from __future__ import annotations


class Memory:
    """Bytes that are divided into shares.

    :param most: of all shares
    :param kinds: number of shares; half of the bytes are sure to them
    """

    def __init__(self, most: int, kinds: int = 1) -> None:
        self.most = most
        self.sure = most // (2 * kinds)
        self._free = most - self.sure * kinds
        self._shares = [Share(self) for _ in range(kinds)]
        self._given = iter(self._shares)

    def share(self) -> Share:
        """The share of the next kind."""
        return next(self._given)

    @property
    def crowded(self) -> bool:
        """Whether the shares take more of what is sure to none than there is."""
        return sum(max(share.held - self.sure, 0) for share in self._shares) > self._free


class Share:
    """What one kind of things takes.

    :ivar held: its bytes
    """

    def __init__(self, memory: Memory) -> None:
        self.memory, self.held = memory, 0

    @property
    def full(self) -> bool:
        """Whether it takes too much."""
        return self.held > self.memory.sure and self.memory.crowded
