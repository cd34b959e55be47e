"""What tests of compression share: any message of any type, written by a serializer of their own."""

from __future__ import annotations

import random
import struct
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from runpy import run_path
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from gr_ros2.compression import Dictionary, LinkCodec
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Topic, normalize_type
from gr_ros2_lab.sim.fleet import Fleet
from gr_ros2_lab.sim.sim_settings import SimSettings

STORE = get_typestore(Stores.ROS2_HUMBLE)
_CODES = {
    "bool": "B", "byte": "B", "char": "B", "uint8": "B", "int8": "b", "uint16": "H", "int16": "h", "uint32": "I",
    "int32": "i", "uint64": "Q", "int64": "q", "float32": "I", "float64": "Q",
}  # fmt: skip
_DOUBLES = (
    0, 1 << 63, 0x3FF0000000000000, 0x7FF0000000000000, 0xFFF0000000000000, 0x7FF8000000000000, 0x7FF0000000000001,
    0xFFFFFFFFFFFFFFFF, 1, 0x000FFFFFFFFFFFFF, 0x7FEFFFFFFFFFFFFF, 0x3F50624DD2F1A9FC, 0x3FB99999A0000000,
)  # fmt: skip
_SINGLES = (
    0,
    1 << 31,
    0x3F800000,
    0x7F800000,
    0xFF800000,
    0x7FC00000,
    0x7F800001,
    0xFFFFFFFF,
    1,
    0x7F7FFFFF,
    0x3DCCCCCD,
)


class Writer:
    """Serializes random members of a type, once with garbage in the alignment gaps and once with zeros."""

    def __init__(self, rng: random.Random, order: str = "<", garbage: bool = True, store: Typestore = STORE) -> None:
        self.rng, self.order, self.garbage, self.store = rng, order, garbage, store
        self.with_garbage, self.clean = bytearray(), bytearray()

    def message(self, type_name: str, tail: int = 0) -> tuple[bytes, bytes]:
        """(as a middleware may hand it over, as it has to come out)"""
        self._type(type_name)
        header = b"\0\1\0\0" if self.order == "<" else b"\0\0\0\0"
        return header + self.with_garbage + bytes(tail), header + self.clean + bytes(tail)

    def _type(self, type_name: str) -> None:
        for _, (kind, detail) in self.store.fielddefs[type_name][1]:
            if kind is Nodetype.BASE:
                self._base(detail[0])
            elif kind is Nodetype.NAME:
                self._type(detail)
            else:
                self._many(detail[0], detail[1] if kind is Nodetype.ARRAY else None)

    def _many(self, element: Any, count: int | None) -> None:
        if count is None:
            count = self.rng.choice([0, 1, 2, 3, 9, 30] if element[0] is Nodetype.BASE else [0, 1, 2])
            self._put(struct.pack(self.order + "I", count), 4)
        for _ in range(count):
            if element[0] is Nodetype.BASE:
                self._base(element[1][0])
            else:
                self._type(element[1])

    def _put(self, data: bytes, alignment: int) -> None:
        gap = -len(self.clean) % alignment
        self.with_garbage += self.rng.randbytes(gap) if self.garbage else bytes(gap)
        self.clean += bytes(gap)
        self.with_garbage += data
        self.clean += data

    def _base(self, code: str) -> None:
        if code == "string":
            text = self._text()
            self._put(struct.pack(self.order + "I", len(text)), 4)
            self._put(text, 1)
            return
        letter = _CODES[code]
        size = struct.calcsize(letter)
        self._put(struct.pack(self.order + letter.upper(), self._bits(code, size)), size)

    def _text(self) -> bytes:
        rng = self.rng
        kind = rng.randrange(8)
        if kind == 0:
            return b""
        if kind == 1:
            return rng.randbytes(rng.randrange(1, 100))
        if kind == 2:
            return b"robot_%d/base_link\0" % rng.randrange(300)
        if kind == 3:
            return "".join(rng.choices("abc_/09 Zé~", k=rng.randrange(200))).encode() + b"\0"
        return rng.choice([b"odom\0", b"base_link\0", b"map\0", b"\0", b"imu_link\0"])

    def _bits(self, code: str, size: int) -> int:
        rng = self.rng
        if code == "float64" and (kind := rng.randrange(8)) < 7:
            if kind < 2:
                return rng.choice(_DOUBLES)
            if kind == 2:
                return 0
            value = [rng.gauss(0, 10), round(rng.gauss(0, 10), rng.randrange(7)), round(rng.random(), 2) ** 2, 1e-3][
                kind - 3
            ]
            return int(struct.unpack("<Q", struct.pack("<d", value))[0])
        if code == "float32" and (kind := rng.randrange(5)) < 4:
            if kind < 2:
                return rng.choice(_SINGLES)
            value = rng.gauss(0, 10) if kind == 2 else round(rng.gauss(0, 10), rng.randrange(4))
            return int(struct.unpack("<I", struct.pack("<f", value))[0])
        return rng.choice([0, 1, rng.randrange(1 << 8 * size), rng.randrange(256), (1 << 8 * size) - 1])


def codec_for(type_name: str, *dictionaries: Dictionary, max_size: int = 1 << 20, **options: Any) -> LinkCodec:
    """The codec of a link with one topic."""
    topic = Topic(0, "topic", normalize_type(type_name), SendOptions(**options))
    made = LinkCodec((), max_size=max_size)
    made._sets = [*dictionaries, *made._sets]
    made.add(topic)
    return made


@cache
def trainer() -> Any:
    """What trains the sets that are shipped: ``learn(samples, name)``."""
    return run_path(str(Path(__file__).parents[2] / "tools" / "train-dictionaries"))["learn"]


def learn(samples: Iterable[tuple[str, bytes]], name: str, **options: Any) -> Dictionary:
    """A set that is not shipped."""
    made: Dictionary = trainer()(samples, name, **{"number": 13, **options})
    return made


def simulated(topic: str, seconds: float = 10.0, **settings: Any) -> list[bytes]:
    """Payloads of one topic of one simulated robot, which does not depend on the others; scans take longest."""
    fleet = Fleet(SimSettings(robots=1, **({} if topic == "scan" else {"scan_rate": 0.1}), **settings))
    return [m.payload for m in fleet.messages(seconds, 1.7e9) if m.topic.endswith(f"/{topic}")]
