"""Whatever happens to robots with and without a key: every packet ends, and then new messages cross again.

``PacketsEnd`` is checked after every slot.
"""

from __future__ import annotations

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gr_ros2.link.events import Delivered
from gr_ros2.link.v1.sealing import SealMode
from tests.link.v1.air import Robot
from tests.link.v1.test_outages import TOPICS, Talk

PAIRS = [(one, other) for one in (1, 2, 3) for other in (1, 2, 3) if one != other]
EPISODES = st.lists(
    st.tuples(
        st.one_of(st.just(PAIRS), st.lists(st.sampled_from(PAIRS), unique=True), st.sampled_from([1, 2, 3])),
        st.sampled_from([1.0, 4.0, 12.0, 25.0]),
        st.sampled_from([0, 0, 0, 1, 2, 3]),
    ),
    min_size=1,
    max_size=4,
)
"""Who is out of whose range, or out of everybody's; for how long, s; and who starts again then."""


@pytest.mark.slow
@settings(max_examples=6)
@given(
    mode=st.sampled_from(["none", "authenticate", "encrypt"]),
    count=st.sampled_from([2, 3]),
    relays=st.booleans(),
    loss=st.sampled_from([0.0, 0.1, 0.3]),
    episodes=EPISODES,
)
@example(mode="authenticate", count=3, relays=True, loss=0.3, episodes=[(PAIRS, 25.0, 0), (PAIRS, 1.0, 3), (3, 4.0, 0)])
def test_every_packet_ends(
    mode: SealMode,
    count: int,
    relays: bool,
    loss: float,
    episodes: list[tuple[list[tuple[int, int]] | int, float, int]],
) -> None:
    robots = [Robot(n, TOPICS, mode=mode, packet_len=220, any_length=True, relay=relays) for n in range(1, count + 1)]
    talk = Talk(*robots, loss=loss)
    talk.run(3, 0.2)
    for cut, seconds, restarts in episodes:
        talk.part(*([pair for pair in PAIRS if cut in pair] if isinstance(cut, int) else cut))
        talk.run(seconds, 0.2)
        if 0 < restarts <= count:
            robots[restarts - 1].start()
        talk.part()
        talk.run(2, 0.2)
    talk.air.run(40)
    before = {robot.src_id: len(robot.events) for robot in robots}
    talk.run(1, 0.2)
    talk.air.run(20)
    for robot in robots:
        senders = {event.src_id for event in robot.events[before[robot.src_id] :] if isinstance(event, Delivered)}
        assert senders == {other.src_id for other in robots if other is not robot}
