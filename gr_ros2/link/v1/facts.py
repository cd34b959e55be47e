"""What arrives and matters to what this robot sends. The receiving half notes it, and the endpoint hands it on."""

from __future__ import annotations

from typing import NamedTuple

from gr_ros2.wire.control import About, Ping, Report


class Taken(NamedTuple):
    """A packet was taken.

    :param trusted: it shows that its sender is there
    :param urgent: an answer to it may leave at once
    """

    trusted: bool
    urgent: bool


TAKEN = {(trusted, urgent): Taken(trusted, urgent) for trusted in (False, True) for urgent in (False, True)}
"""All of them: there is one for every packet."""


class Early(NamedTuple):
    """Packets that could not be opened before can be now.

    :param packets: when each came, s, and its bytes
    """

    packets: list[tuple[float, bytes]]


class Appeared(NamedTuple):
    """Something of a robot came for the first time, or again after long.

    :param knows: it has said that it has heard this start of this robot
    """

    knows: bool = False


class PeerMet(NamedTuple):
    """A robot counts as heard that will say what it has of this robot's packets.

    :param proven: packets above this number were sealed after its start, as it is told; None where it is told nothing
    :param wanted: it says that it lacks such a proof
    """

    src_id: int
    proven: int | None = None
    wanted: bool = False


class PeerLeft(NamedTuple):
    """A robot has been silent for long, or its start has ended.

    :param ended: it has nothing of what it had
    """

    src_id: int
    ended: bool


class Reported(NamedTuple):
    """A robot says which packets it has.

    :param number: the newest packet that the report covers
    """

    src_id: int
    number: int
    report: Report


class Has(NamedTuple):
    """A robot has all messages of a topic up to one, whoever brought them.

    :param order: the packet in which that one began, and its place there
    """

    src_id: int
    topic_id: int
    order: tuple[int, int]


class Asked(NamedTuple):
    """A robot lacks messages that are kept for such robots."""

    robot: int
    topic_ids: tuple[int, ...]


class Questioned(NamedTuple):
    """A robot asks something, or answers."""

    src_id: int
    entry: Ping | About


class Reached(NamedTuple):
    """A robot is reached over others for the first time."""

    robot: int


class ProofWanted(NamedTuple):
    """A robot lacks the proof that this one hears it."""


Fact = Taken | Early | Appeared | PeerMet | PeerLeft | Reported | Has | Asked | Questioned | Reached | ProofWanted
