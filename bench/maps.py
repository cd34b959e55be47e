"""A map that grows on a narrow link, simulated: what has changed, beside the whole map each time.

The robots have the engine of a link in simulated time, as in ``bench.cameras``. A robot explores 1000 × 1000 cells, one
map each 2 s; another robot joins at the end. The peer sends the same maps over the same engine with ``codec: zstd``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bench.rows import Row
from gr_ros2.codecs import CodedTopic
from gr_ros2.codecs.messages import GRID
from gr_ros2.link.events import SentPacket
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry, Topic
from tests.codecs import scenes
from tests.codecs.camera_link import Air, Robot

KBIT_S, MAPS, SIZE, EACH_S = 128.0, 15, 1000, 2.0
JOIN_S = 10.0


class Judged(NamedTuple):
    """:param each: bytes on the air for a map but the first, repairs included; joined_s: until a joiner has the map"""

    each: float
    mean_ms: float
    came: int
    joined_s: float


def _maps() -> list[bytes]:
    return list(scenes.exploring(MAPS, SIZE))


def simulate(loss: float, codec: str = "auto") -> Judged:
    """One run."""
    maps = _maps()
    topic = Topic(0, "map", GRID, SendOptions(durability="transient_local", codec=codec))
    mapper, follower = Robot(1, Registry([topic]), KBIT_S), Robot(2, None, KBIT_S)
    air = Air(mapper, follower, loss=loss)

    def sent() -> int:
        packets = (event for event in mapper.events if isinstance(event, SentPacket))
        return sum(len(event.data) for event in packets if event.kind in ("new", "repair"))

    first, made = 0, []
    for number, message in enumerate(maps):
        made.append(air.now)
        mapper.submit(0, message, air.now)
        air.run(air.now + EACH_S * (2 if not number else 1))
        first = first or sent()
    each = (sent() - first) / (len(maps) - 1)
    came = {message: now for now, message in reversed(follower.of(1, 0))}
    assert maps[-1] in came, "the newest map has to come"
    ages = [came[message] - at for message, at in zip(maps, made, strict=True) if message in came]
    late, begin = Robot(3, None, KBIT_S), air.now
    air.robots.append(late)
    air.run(begin + JOIN_S)
    assert [message for _, message in late.of(1, 0)][-1:] == maps[-1:], "a joiner has to get the newest map"
    return Judged(each, 1e3 * float(np.mean(ages)), len(ages), late.of(1, 0)[0][0] - begin)


def maps() -> list[Row]:
    """What a map costs."""
    encoder, patches = CodedTopic(GRID).encoder(), []
    for message in _maps():
        coded = encoder.encode(message)
        encoder.confirmed(coded.name)
        patches.append(len(coded.data))
    patch = float(np.mean(patches[1:]))
    found = []
    for loss in (0.0, 0.2):
        changes, whole = simulate(loss), simulate(loss, "zstd")
        note = (
            f"{patch:,.0f} B of changes in it; {changes.came} of {MAPS} came, {changes.mean_ms:,.0f} ms old; "
            f"whole: {whole.each:,.0f} B, {whole.came}, {whole.mean_ms:,.0f} ms"
        )
        what = f"maps: {SIZE} × {SIZE}, {KBIT_S:.0f} kbit/s, {loss:.0%} lost"
        most = 1.2 * patch / (1 - 1.5 * loss)
        found += [
            Row(f"{what}, bytes of a map on the air", changes.each, "B", "≤", most, note=note),
            Row(f"{what}, who joins has the map within", changes.joined_s, "s", form="{:.1f}"),
        ]
    return found
