"""Topics whose messages are coded when the air is about to be free for them: what a coder has to know and to tell.

Each coded message is a *frame*. Most frames need the one before, so the frames of a topic are a chain: they leave in
order, and are repaired until all who report have them, or until a key frame has left, which needs none. A topic of
several publishers has a chain of each.

Invariant: a frame that is submitted leaves; a message that is not coded ends in a Refused.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

from gr_ros2.link.fates import Fate

LONG_S = 0.3
MARK = "frames"
"""What the table of topics says about the coding of such a topic. A blank and the type that comes out may follow."""


class FrameState(NamedTuple):
    """How it stands with the frames of one topic.

    :param rate: bytes/s that other topics leave free; infinite where the rate of the channel is not known
    :param waiting: bytes that have not left
    :param lacked: s for which the robot that follows best has lacked a frame, as far as its reports tell; 0 if none
        reports
    :param behind: the same, of the robot that follows worst
    :param silent: whether some robot reports, and none has for long
    :param age: s from the coming of the newest message that all who report have, until that was known; where nobody
        reports, until it had left
    :param joined: how often a robot that may report has come, or has come back, or has asked for a key frame
    :param reports: whether any robot reports
    """

    rate: float
    waiting: int
    lacked: float
    behind: float
    silent: bool
    age: float
    joined: int
    reports: bool


class FrameSide(Protocol):
    """The coded topics of one sender.

    :ivar relayed: whether what it sends is to be sent on: then latched topics are not coded, since chains are not
    """

    relayed: bool

    def begin(self, topic_id: int, output: str = "") -> None:
        """Send frames of a topic from now on, in the class bulk unless its options say otherwise.

        :param output: type of the messages that receivers make of them; '' = the topic's
        """

    def end(self, topic_id: int) -> None:
        """No frame of a topic follows, and those that have left are of no more use."""

    def asks(self, topic_id: int) -> int:
        """How often a robot has asked for the topic, within what is answered."""

    @property
    def reports(self) -> bool:
        """Whether any robot reports."""

    def progress(self, topic_id: int, now: float) -> FrameState:
        """How it stands. It is work: what waits and what is confirmed is looked through."""

    def submit(self, topic_id: int, frame: bytes, came: float, now: float, *, key: bool, chain: int = 0) -> bool:
        """Send a frame. Returns whether it is sent: one that is longer than a message may be is not.

        :param came: when its message came, s
        :param key: it needs no other frame: all of its chain before it are of no more use when it has left, and those
            that somebody has lacked for ``LONG_S`` at once
        """

    def refuse(self, topic_id: int, fate: Fate, detail: str) -> None:
        """A message of a topic is not coded."""

    def watched(self, topic_id: int) -> None:
        """Somebody has begun to watch a topic of this robot, and needs a key frame."""

    def lost(self, src_id: int, topic_id: int) -> None:
        """A frame of another robot could not be decoded: that robot is asked for a key frame."""
