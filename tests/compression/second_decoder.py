"""A second decoder of coded messages, made from docs/reference/message-coding.md alone; it shares no code with gr_ros2.

It computes every model anew, walks through a type member by member, and remembers nothing. It exists to find out
whether the page says enough.
"""

from __future__ import annotations

import base64
import json
import math
import re
import struct
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

SETS = Path(__file__).parents[2] / "gr_ros2" / "compression" / "dictionaries"
HUMBLE = get_typestore(Stores.ROS2_HUMBLE).fielddefs
TIME = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
QUATERNION = "geometry_msgs/msg/Quaternion"
LETTERS = b"etaoinsrhldcumfpgwybvkxjqz_/0123456789.-~ ABCDEFGHIJKLMNOPQRSTUVWXYZ:,()[]{}<>=+*'\"!?#@%&|\\^$;`"
NAMES = b"robot_ robot r tb3_ tb turtle turtlebot husky jackal uav drone ugv agent".split()


class Refused(Exception):
    """What the page says is to be refused; its text is the name."""


# Models


def model(weights: Sequence[int]) -> list[int]:
    """The shares of 4096."""
    total = sum(weights)
    shares = [max(1, 4096 * weight // total) if weight else 0 for weight in weights]
    largest_first = sorted(range(len(shares)), key=lambda symbol: (-shares[symbol], symbol))
    over = sum(shares) - 4096
    if over < 0:
        shares[largest_first[0]] -= over
    for symbol in largest_first:
        if over > 0:
            less = min(over, shares[symbol] - 1)
            shares[symbol] -= less
            over -= less
    return shares


MODELS = {
    "LENGTHS": [400, 300, 300, 300, 280, 260, 240, 220, *[160] * 8, *[60] * 16, *[16] * 33],
    "RANKS": [700, 900, 800, 600, 400, 300, 200, 100, 60, 30, 10, 5, 3, 2, 1, 1],
    "HEADS": [3000, *[150] * 3, *[20, 40, 40, 40] * 3, *[4] * 16],
    "BLOB": [1, 3],
    "TEMPLATES": [1200, 500, 300, 200, *[60] * 11, 1100],
    "TIMES": [3000, 200, 200, 350, 250, 90],
    "DECIMALS": [160, *[200] * 3, 120, *[80] * 2, *[10] * 3],
    "EXPONENTS": [*[0] * 6, *[1] * 128],
    "QUATERNIONS": [120, 200, 150, 60, 150, 60, 300, 100, 700, 120, 400, 150, 900, 400, 200],
    "MISSES": [900, 500, 250, 120, 60, 40, 20, 20, *[4] * 17],
    "TEXTS": [2800, 400, 600, 60, 200],
    "LETTERS": [*[300] * 10, *[180] * 10, *[60] * 6, 250, 200, *[80] * 10, *[40] * 4, *[12] * 53],
    "MATRICES": [900, 1000, 1700, 300, 200],
    "SAMENESS": [1400, 2700],
    "OCTETS": [1400, 800, 200, 120, 90, 70, 60, 50, *[10] * 56, *[3] * 191, 60],
}
# zero, constant, float32, decimal, square, centre, below, above, minus
CLASSES = {
    "a": (250, 60, 60, 80, 0, 0, 6, 4, 4),
    "n": (960, 8, 4, 8, 0, 0, 8, 4, 4),
    "z": (600, 30, 30, 40, 0, -1, 5, 3, 4),
    "p": (20, 10, 15, 20, 0, 5, 3, 3, 4),
    "q": (20, 10, 15, 20, 0, 3, 3, 3, 4),
    "u": (30, 10, 15, 30, 0, -1, 3, 1, 4),
    "v": (30, 10, 15, 30, 0, 0, 2, 1, 1),
    "s": (20, 5, 20, 20, 0, -4, 3, 2, 4),
    "t": (20, 5, 20, 20, 0, -7, 3, 2, 4),
    "g": (5, 5, 20, 20, 0, 3, 1, 1, 1),
    "l": (10, 5, 20, 30, 0, 6, 3, 2, 3),
    "d": (100, 100, 50, 650, 0, 0, 6, 4, 4),
    "f": (40, 20, 850, 30, 0, -2, 6, 4, 4),
    "c": (200, 500, 20, 100, 100, 0, 6, 4, 2),
}


def class_weights(letter: str) -> list[int]:
    *first, centre, below, above, minus = CLASSES[letter]
    chances = [max(1, 4096 // 2 ** (2 * abs(e - centre) // (below if e < centre else above))) for e in range(-40, 24)]
    whole, share = sum(chances), max(20, 998 - sum(first))
    weights = [10_000 * weight for weight in first] + [20_000]
    for chance in chances:
        both = 10_000 * share * chance // whole
        weights += [max(1, both * (8 - minus) // 8), max(1, both * minus // 8)]
    return weights


SHARES = {name: model(weights) for name, weights in MODELS.items()}
SHARES |= {letter: model(class_weights(letter)) for letter in CLASSES}


class Number:
    """N, off which values are popped."""

    def __init__(self, value: int) -> None:
        self.n = value

    def below(self, m: int) -> int:
        self.n, value = divmod(self.n, m)
        return value

    def bits(self, count: int) -> int:
        return self.below(1 << count)

    def symbol(self, name: str) -> int:
        rest, start = self.n % 4096, 0
        for symbol, share in enumerate(SHARES[name]):
            if rest < start + share:
                self.n = share * (self.n // 4096) + rest - start
                return symbol
            start += share
        raise AssertionError("shares are 4096 together")

    def natural(self) -> int:
        size = self.symbol("LENGTHS")
        return (1 << size - 1) + self.bits(size - 1) if size > 1 else size

    def rank(self, of: Sequence[Any]) -> Any:
        size = self.symbol("RANKS")
        place = (1 << size) + self.bits(size) - 1
        if place >= len(of):
            raise Refused("damaged")
        return of[place]


def zigzag(z: int) -> int:
    return -(z + 1) // 2 if z % 2 else z // 2


# Types: (kind, detail) with the kinds number, string, time, quaternion, message, array (count, element) and sequence

CODES = {
    "bool": "B", "byte": "B", "char": "B", "uint8": "B", "int8": "B", "uint16": "H", "int16": "h", "uint32": "I",
    "int32": "i", "uint64": "Q", "int64": "q", "float32": "f", "float64": "d",
}  # fmt: skip
Node = tuple[str, Any]


def by_definition(types: Mapping[str, Any], name: str, above: tuple[str, ...] = ()) -> Node:
    """A type; KeyError where it has no definition."""
    if name in TIME:
        return "time", None
    if name == QUATERNION:
        return "quaternion", None
    if name in above or not types[name][1]:
        raise KeyError(name)

    def node(kind: Any) -> Node:
        what, detail = kind
        if what is Nodetype.BASE:
            return ("string", None) if detail[0] == "string" else ("number", CODES[detail[0]])
        if what is Nodetype.NAME:
            return by_definition(types, detail, (*above, name))
        if what is Nodetype.ARRAY:
            if not detail[1]:
                raise KeyError(name)
            return "array", (detail[1], node(detail[0]))
        return "sequence", node(detail[0])

    return "message", [(member, node(kind)) for member, kind in types[name][1]]


def by_structure(text: str) -> Node | None:
    """A type; None where the text is not a structure."""
    stack: list[tuple[str, list[tuple[str, Node]]]] = [("", [])]
    at = 0
    while at < len(text):
        if text[at] == ")":
            count, members = stack.pop()
            at += 1
            if not stack or not members:
                return None
            kind: Node = "message", members
        else:
            found = re.compile(r"(\*|[1-9][0-9]{0,7})?([dfqQiIhHBsTR(])").match(text, at)
            if found is None or (found[2] == "(" and not found[1]):
                return None
            at = found.end()
            count = found[1] or ""
            if found[2] == "(":
                stack.append((count, []))
                if len(stack) > 33:
                    return None
                continue
            kind = {"s": ("string", None), "T": ("time", None), "R": ("quaternion", None)}.get(
                found[2], ("number", found[2])
            )
            if count not in ("", "*") and kind[0] == "number" and int(count) * struct.calcsize(kind[1]) > 1 << 24:
                return None
        if count == "*":
            kind = "sequence", kind
        elif count:
            kind = "array", (int(count), kind)
        stack[-1][1].append(("", kind))
    return ("message", stack[0][1]) if len(stack) == 1 and stack[0][1] else None


# Sets


class Set:
    """Words, constants and what is known about one type ('' = none)."""

    def __init__(self, data: Mapping[str, Any], type_name: str) -> None:
        self.words = [word.encode() + b"\0" for word in data["words"]]
        self.constants = [int(bits, 16) for bits in data["constants"]]
        entry = data["types"].get(type_name, {})
        self.classes: dict[str, str] = entry.get("classes", {})
        self.templates = [(counts, int(text, 16)) for counts, text in entry.get("templates", [])[:15]]
        self.zstd = base64.b64decode(entry.get("zstd", ""))
        own = get_types_from_msg(entry["definition"], type_name) if entry.get("definition") else {}
        try:
            self.type: Node | None = by_definition({**HUMBLE, **own}, type_name)
        except KeyError:
            self.type = None


@cache
def shipped(number: int, type_name: str) -> Set:
    return Set(json.loads((SETS / f"shipped-{number}.json").read_text()), type_name)


# zstd


def varint(data: bytes) -> tuple[int, bytes]:
    value = 0
    for place in range(min(5, len(data))):
        value += (data[place] & 127) << 7 * place
        if data[place] < 128:
            return value, data[place + 1 :]
    raise Refused("damaged")


def blocks(data: bytes, single: int, size: int, dictionary: bytes = b"") -> bytes:
    if single:
        if len(data) >= 1 << 21:
            raise Refused("damaged")
        data = (8 * len(data) + 5).to_bytes(3, "little") + data
    raw = not dictionary.startswith(b"\x37\xa4\x30\xec")
    known = zstd.ZstdDict(dictionary, is_raw=raw) if dictionary else None
    reader: Any = zstd.ZstdDecompressor(zstd_dict=known)
    try:
        out: bytes = reader.decompress(b"\x28\xb5\x2f\xfd\xa0" + size.to_bytes(4, "little") + data)
    except zstd.ZstdError as error:
        raise Refused("damaged") from error
    if len(out) != size or not reader.eof or reader.unused_data:
        raise Refused("damaged")
    return out


# The codec fields


class Slot:
    """A member in its place: what it is, and later its value as little-endian bytes (strings: with their length)."""

    def __init__(self, kind: str, detail: Any, path: str, items: int) -> None:
        self.kind, self.detail, self.path, self.items = kind, detail, path, items
        self.data = b""
        self.way = (0, 0)
        self.long = -1

    @property
    def static(self) -> bool:
        return self.kind in ("octet", "string", "matrix")


def slots_of(node: Node, path: str, counts: Iterator[int], most: int) -> Iterator[Slot]:
    """All members of a message, in order; lengths of sequences among them."""
    kind, detail = node
    if kind == "message":
        for name, member in detail:
            yield from slots_of(member, f"{path}.{name}" if path else name, counts, most)
    elif kind == "number":
        yield Slot("octet" if detail == "B" else "number", detail, path, 1)
    elif kind in ("array", "sequence"):
        count, element = detail if kind == "array" else (next(counts), detail)
        if kind == "sequence":
            made = Slot("length", None, path, 1)
            made.data = struct.pack("<I", min(count, 0xFFFFFFFF))
            yield made
        if element[0] != "number":
            for done in range(count):
                if done > most:
                    raise Refused("damaged")
                yield from slots_of(element, path + "[]", counts, most)
        elif kind == "array" and element[1] == "d" and count in (9, 36):
            yield Slot("matrix", math.isqrt(count), path, 1)
        elif element[1] == "B" and 1 <= count <= 16:
            yield Slot("octets", count, path, 1)
        elif count > 16:
            yield Slot("long", (count, element[1]), path, 1)
        else:
            for _ in range(count):
                yield from slots_of(element, path + "[]", counts, most)
    else:
        yield Slot(kind, detail, path, {"time": 2, "quaternion": 4, "string": 2}[kind])


def lengths(node: Node, n: Number, found: list[int], most: int) -> None:
    kind, detail = node
    if kind == "message":
        for _, member in detail:
            lengths(member, n, found, most)
    elif kind in ("array", "sequence"):
        if kind == "sequence":
            found.append(n.natural())
            count, element = found[-1], detail
        else:
            count, element = detail
        if has_sequence(element):
            for _ in range(count):
                if len(found) > most:
                    raise Refused("damaged")
                lengths(element, n, found, most)


def has_sequence(node: Node) -> bool:
    kind, detail = node
    if kind == "message":
        return any(has_sequence(member) for _, member in detail)
    return kind == "sequence" or (kind == "array" and has_sequence(detail[1]))


def decimal(n: Number) -> float:
    k = n.symbol("DECIMALS")
    value = n.natural()
    return (-value if n.bits(1) else value) / 10**k


def bits64(value: float) -> int:
    return int(struct.unpack("<Q", struct.pack("<d", value))[0])


def float64(n: Number, letter: str, constants: Sequence[int]) -> int:
    """Its bits."""
    symbol = n.symbol(letter)
    if symbol == 0:
        return 0
    if symbol == 1:
        return int(n.rank(constants))
    if symbol == 2:
        return head64(n.symbol("EXPONENTS")) | n.bits(23) << 29
    if symbol in (3, 4):
        value = decimal(n)
        return bits64(value if symbol == 3 else value * value)
    if symbol == 5:
        return n.bits(64)
    return head64(symbol) | n.bits(52)


def head64(symbol: int) -> int:
    """Sign and exponent."""
    return (symbol - 6) % 2 << 63 | ((symbol - 6) // 2 - 40 + 1023) << 52


def float32(n: Number, letter: str) -> int:
    """Its bits."""
    symbol = n.symbol(letter)
    if symbol == 0:
        return 0
    if symbol == 3:
        return int(struct.unpack("<I", struct.pack("<f", decimal(n)))[0])
    if symbol == 5:
        return n.bits(32)
    if symbol < 6:
        raise Refused("damaged")
    return (symbol - 6) % 2 << 31 | ((symbol - 6) // 2 - 40 + 127) << 23 | n.bits(23)


def time(n: Number) -> tuple[int, int]:
    symbol = n.symbol("TIMES")
    if symbol == 1:
        return 0, 0
    if symbol == 5:
        nanosec = n.bits(32)
        return n.bits(32), nanosec
    nanosec = n.below(10**9) if symbol in (0, 3) else n.below(1000) * 10**6
    return (n.bits(30) + 1_200_000_000 if symbol in (0, 2) else n.bits(20)), nanosec


def quaternion(n: Number, letter: str, constants: Sequence[int]) -> list[int]:
    """The bits of x, y, z, w."""
    bits = [0, 0, 0, 0]
    symbol = n.symbol("QUATERNIONS")
    if symbol == 1:
        return [0, 0, 0, bits64(1.0)]
    if symbol == 0:
        return [float64(n, letter, constants) for _ in range(4)]
    if symbol < 10:
        largest, sign = divmod(symbol - 2, 2)
        for place in (3, 2, 1, 0):
            if place != largest:
                bits[place] = float64(n, letter, constants)
    else:
        if symbol == 14:
            bits[1] = n.bits(1) << 63
            bits[0] = n.bits(1) << 63
            symbol = 10 + n.bits(2)
        largest, sign = 2 + (symbol - 10) // 2, (symbol - 10) % 2
        bits[5 - largest] = float64(n, letter, constants)
    size = n.symbol("MISSES")
    miss = zigzag((1 << size - 1) + n.bits(size - 1) if size > 1 else size)
    a, b, c = (struct.unpack("<d", struct.pack("<Q", bits[place]))[0] for place in range(4) if place != largest)
    rest = 1.0 - ((a * a + b * b) + c * c)
    predicted = math.sqrt(rest) if rest > 0 else 0.0
    bits[largest] = (bits64(predicted) + miss) % 2**63 | sign << 63
    return bits


def live(n: Number, slot: Slot, known: Set) -> None:
    letter = known.classes.get(slot.path, "a")
    if slot.kind == "time":
        slot.data = struct.pack("<II", *time(n))
    elif slot.kind == "quaternion":
        slot.data = struct.pack("<4Q", *quaternion(n, letter, known.constants))
    elif slot.kind == "octets":
        slot.data = n.bits(8 * slot.detail).to_bytes(slot.detail, "big")
    elif slot.kind == "long":
        slot.way = n.natural(), n.natural()
    elif slot.detail == "d":
        slot.data = struct.pack("<Q", float64(n, letter, known.constants))
    elif slot.detail == "f":
        slot.data = struct.pack("<I", float32(n, letter))
    else:
        value = n.natural()
        try:
            slot.data = struct.pack("<" + slot.detail, zigzag(value) if slot.detail.islower() else value)
        except struct.error as error:
            raise Refused("damaged") from error


def string(n: Number, slot: Slot, known: Set) -> None:
    kind = n.symbol("TEXTS")
    if kind == 0:
        slot.data = n.rank(known.words)
    elif kind == 1:
        name = n.rank(NAMES)
        slash, between = (b"/" if n.bits(1) else b""), (b"_" if n.bits(1) else b"/")
        number = str(n.natural()).encode()
        slot.data = slash + name + number + between + n.rank(known.words)
    else:
        length = n.natural()
        if kind == 4:
            slot.long = length
        elif length > 64:
            raise Refused("damaged")
        elif kind == 2:
            slot.data = bytes(LETTERS[n.symbol("LETTERS")] for _ in range(length)) + b"\0"
        else:
            slot.data = n.bits(8 * length).to_bytes(length, "big")


def matrix(n: Number, slot: Slot, known: Set, before: dict[int, bytes]) -> None:
    side = slot.detail
    kind = n.symbol("MATRICES")
    entries = [0] * side * side
    if kind == 1:
        if side not in before:
            raise Refused("damaged")
        slot.data = before[side]
        return
    places = {
        0: [],
        2: [(row, row) for row in range(side)],
        3: [(row, column) for row in range(side) for column in range(row, side)],
        4: [(row, column) for row in range(side) for column in range(side)],
    }[kind]
    value = 0
    for index, (row, column) in enumerate(places):
        if not index or not n.symbol("SAMENESS"):
            value = float64(n, "c", known.constants)
        entries[row * side + column] = value
        if kind == 3:
            entries[column * side + row] = value
    slot.data = before[side] = struct.pack(f"<{side * side}Q", *entries)


def statics(n: Number, slots: Sequence[Slot], counts: Sequence[int], known: Set) -> None:
    if known.templates:
        template = n.symbol("TEMPLATES")
        if template < 15:
            if n.n or template >= len(known.templates) or known.templates[template][0] != list(counts):
                raise Refused("damaged")
            n = Number(known.templates[template][1])
    before: dict[int, bytes] = {}
    for slot in slots:
        if slot.kind == "octet":
            slot.data = bytes([n.symbol("OCTETS")])
        elif slot.kind == "string":
            string(n, slot, known)
        else:
            matrix(n, slot, known, before)
    if n.n:
        raise Refused("damaged")


def turned_back(data: bytes, size: int, way: int, parameter: int) -> bytes:
    if way == 0:
        return data
    if way > 3 or size == 1 or (parameter != size if way < 3 else size != 4 or parameter > 4):
        raise Refused("damaged")
    count = len(data) // size
    elements = [int.from_bytes(data[place::count], "little") for place in range(count)]
    if way == 2:
        total = 0
        for place, element in enumerate(elements):
            total = (total + zigzag(element)) % (1 << 8 * size)
            elements[place] = total
    elif way == 3:
        total = 0
        for place, code in enumerate(elements):
            if code < 5:
                elements[place] = (0x7F800000, 0xFF800000, 0x7FC00000, 0xFFC00000, 0x80000000)[code]
                continue
            total = (total + zigzag(code - 5)) % (1 << 32)
            m = total - (1 << 32) if total >> 31 else total
            elements[place] = struct.unpack("<I", struct.pack("<f", m / 10**parameter))[0]
    return b"".join(element.to_bytes(size, "little") for element in elements)


def second_part(data: bytes, packed: int, slots: Sequence[Slot], most: int) -> None:
    parts = [(slot, slot.detail[0] * struct.calcsize(slot.detail[1])) for slot in slots if slot.kind == "long"]
    parts += [(slot, slot.long) for slot in slots if slot.long >= 0]
    size = sum(length for _, length in parts)
    if size > most:
        raise Refused("damaged")
    if packed:
        single, data = varint(data)
        if single > 1:
            raise Refused("damaged")
        data = blocks(data, single, size)
    if len(data) != size:
        raise Refused("damaged")
    for slot, length in parts:
        slot.data, data = data[:length], data[length:]
        if slot.kind == "long":
            slot.data = turned_back(slot.data, struct.calcsize(slot.detail[1]), *slot.way)


def count_items(node: Node) -> tuple[int, int]:
    """Items and values of a message whose sequences are empty."""
    empty = list(slots_of(node, "", iter(lambda: 0, 1), 1 << 20))
    return sum(slot.items for slot in empty), sum(slot.kind != "length" for slot in empty)


def fields(data: bytes, second: bool, node: Node, known: Set, most: int) -> bytes:
    """The message."""
    least, values = count_items(node)
    allowed = min(3199, least + 64 + 4 * len(data))
    if least > 3199 or values > 640:
        raise Refused("damaged")
    rest = b""
    if second:
        length, data = varint(data)
        if length > len(data):
            raise Refused("damaged")
        data, rest = data[:length], data[length:]
    if len(data) > 8192:
        raise Refused("damaged")
    n = Number(int.from_bytes(data, "big"))
    head = n.symbol("HEADS")
    tail, little, options = head % 4, head // 4 < 4, head // 4 % 4
    packed = n.symbol("BLOB") if second else 0
    counts: list[int] = []
    lengths(node, n, counts, allowed)
    slots: list[Slot] = []
    items = 0
    for slot in slots_of(node, "", iter(counts), allowed):
        items += slot.items
        slots.append(slot)
        if items > allowed:
            raise Refused("damaged")
    if sum(slot.kind != "length" for slot in slots) > 640:
        raise Refused("damaged")
    for slot in slots:
        if slot.kind != "length" and not slot.static:
            live(n, slot, known)
    statics(n, [slot for slot in slots if slot.static], counts, known)
    second_part(rest, packed, slots, most)
    out = bytearray()
    for slot in slots:
        for size, piece in pieces(slot):
            out += bytes(-len(out) % size if piece else 0)
            out += piece if little else b"".join(piece[at : at + size][::-1] for at in range(0, len(piece), size))
    message = bytes([0, little, 0, options]) + bytes(out) + bytes(tail)
    if len(message) > most:
        raise Refused("damaged")
    return message


def pieces(slot: Slot) -> list[tuple[int, bytes]]:
    """(size of an element, bytes) to write, in order."""
    if slot.kind == "string":
        return [(4, struct.pack("<I", len(slot.data))), (1, slot.data)]
    if slot.kind in ("length", "time"):
        return [(4, slot.data)]
    if slot.kind in ("quaternion", "matrix"):
        return [(8, slot.data)]
    code = {"octets": "B", "octet": "B"}.get(slot.kind) or (slot.detail[1] if slot.kind == "long" else slot.detail)
    return [(struct.calcsize(code), slot.data)]


def crc16(data: bytes) -> int:
    value = 0
    for byte in data:
        value ^= byte << 8
        for _ in range(8):
            value = (value << 1 ^ (0x1021 if value >> 15 else 0)) & 0xFFFF
    return value


def decode(
    coded: bytes,
    type_name: str,
    announced: str = "",
    max_size: int = 1 << 24,
) -> bytes:
    """The message.

    :param announced: what the table of topics says about its coding
    """
    if not coded:
        raise Refused("damaged")
    if coded[0] == 6:
        coded = coded[2:] if coded[2:3] != b"\6" else b"\7"  # numbered once
        if not coded:
            raise Refused("damaged")
    number, codec = coded[0] >> 4, coded[0] & 15
    if coded[0] == 0:
        if len(coded) - 1 > max_size:
            raise Refused("damaged")
        return coded[1:]
    if codec not in (1, 2, 3) or (codec != 1 and not number):
        raise Refused("unsupported")
    start = 3 if number >= 14 else 1
    data = coded[start:]
    most = min(max_size, 65_536 + 4096 * len(data))
    dictionary = b""
    if number:
        text = announced.partition(" ")[2]
        node: Node | None
        if number == 14:
            node, known = by_structure(text), shipped(1, "")
            if node is None or coded[1:3] != crc16(text.encode()).to_bytes(2, "big"):
                raise Refused("unknown_dictionary")
        elif number in (1, 2):
            known = shipped(number, type_name)
            node, dictionary = known.type, known.zstd
        else:
            raise Refused("unknown_dictionary")
        if (not dictionary) if codec == 1 else node is None:
            raise Refused("unknown_dictionary")
        if codec > 1:
            assert node is not None
            return fields(data, codec == 3, node, known, most)
    size, data = varint(data)
    if size // 2 > most:
        raise Refused("damaged")
    return blocks(data, size % 2, size // 2, dictionary)
