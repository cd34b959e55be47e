"""A second decoder of version 1, made from docs/reference/wire-format.md alone; it shares no code with gr_ros2.

It opens packets of one sender, collects source bodies, solves repairs by Gauss-Jordan elimination over everything it
has, and joins messages. It exists to find out whether the page says enough.
"""

from __future__ import annotations

import hmac
import struct
from functools import cache
from hashlib import sha256


class Refused(Exception):
    """What the page says is to be refused; its text is the name."""


def crc32(data: bytes) -> int:
    """IEEE 802.3, bit by bit."""
    value = 0xFFFFFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (0xEDB88320 if value & 1 else 0)
    return value ^ 0xFFFFFFFF


@cache
def times(a: int, b: int) -> int:
    """In GF(256) with 0x11D."""
    total = 0
    for bit in range(8):
        if b >> bit & 1:
            total ^= a << bit
    for bit in range(14, 7, -1):
        if total >> bit & 1:
            total ^= 0x11D << bit - 8
    return total


INVERSE = [0] + [next(b for b in range(1, 256) if times(a, b) == 1) for a in range(1, 256)]


def coefficient(repair_id: int, number: int) -> int:
    return INVERSE[(128 + repair_id % 128) ^ (number % 128)]


def subkey(key: bytes, src_id: int, boot: int) -> bytes:
    """HKDF-SHA256, one block of it."""
    extracted = hmac.new(b"gr-ros2 version 1", key, sha256).digest()
    info = bytes([src_id]) + boot.to_bytes(8, "big")
    return hmac.new(extracted, info + b"\x01", sha256).digest()[:16]


def unseal(key: bytes, nonce: bytes, associated: bytes, encrypted: bytes, tag: bytes) -> bytes:
    """AES-CCM put together from AES of single blocks, as RFC 3610 has it (M = 8, L = 2)."""
    from cryptography.hazmat.primitives.ciphers import Cipher, algorithms, modes

    def aes(block: bytes) -> bytes:
        encryptor = Cipher(algorithms.AES(key), modes.ECB()).encryptor()
        return encryptor.update(block)

    def xor(a: bytes, b: bytes) -> bytes:
        return bytes(x ^ y for x, y in zip(a, b, strict=False))

    plain = b""
    for counter in range(0, len(encrypted), 16):
        stream = aes(b"\x01" + nonce + (counter // 16 + 1).to_bytes(2, "big"))
        plain += xor(encrypted[counter : counter + 16], stream)
    first = bytes([(64 if associated else 0) | 3 << 3 | 1]) + nonce + len(plain).to_bytes(2, "big")
    blocks = first
    if associated:
        named = len(associated).to_bytes(2, "big") + associated
        blocks += named + bytes(-len(named) % 16)
    blocks += plain + bytes(-len(plain) % 16)
    mac = bytes(16)
    for at in range(0, len(blocks), 16):
        mac = aes(xor(mac, blocks[at : at + 16]))
    if xor(mac[:8], aes(b"\x01" + nonce + bytes(2))) != tag:
        raise Refused("tag")
    return plain


def varint(body: bytes, at: int, end: int) -> tuple[int, int]:
    value = 0
    for place in range(4):
        if at >= end:
            raise Refused("entry_bounds")
        byte = body[at]
        at += 1
        value += (byte & 127) * 128**place
        if byte < 128:
            if place and not byte:
                raise Refused("varint")
            return value, at
    raise Refused("varint")


def read_body(body: bytes, room: int) -> list[dict[str, object]]:
    """The entries of a body as JSON-like values."""
    entries: list[dict[str, object]] = []
    at, end = 0, min(room, len(body))
    while at < end and body[at]:
        kind = body[at]
        if kind >= 244:
            if at + 2 > end or at + 2 + body[at + 1] > end:
                raise Refused("entry_bounds")
            content = body[at + 2 : at + 2 + body[at + 1]]
            at += 2 + len(content)
            entry = read_control(kind, content)
            if entry is not None:
                entries.append(entry)
            continue
        if at + 2 > end:
            raise Refused("entry_bounds")
        flags = body[at + 1]
        at += 2
        fills = flags & 0x10
        length = 0
        if fills and flags & 15:
            fills, length = 0, flags & 15
        elif fills:
            if len(body) < room:
                raise Refused("entry_kind")
        else:
            if at >= end:
                raise Refused("entry_bounds")
            length = (flags & 15) * 256 + body[at]
            at += 1
        back = offset = 0
        which = flags >> 6
        if which >= 2:
            back, at = varint(body, at, end)
            offset, at = varint(body, at, end)
            if not (offset or back):
                raise Refused("entry_kind")
        stop = end if fills else at + length
        if stop > end:
            raise Refused("entry_bounds")
        if which and stop <= at:
            raise Refused("entry_kind")
        if back >= 1 << 21 or offset + stop - at > 1 << 24:
            raise Refused("varint")
        entries.append(
            {
                "topic_id": kind - 1,
                "payload": body[at:stop].hex(),
                "back": back,
                "offset": offset,
                "last": which in (0, 3),
                "coded": bool(flags & 0x20),
            }
        )
        at = stop
    if any(body[at:]):
        raise Refused("pad")
    return entries


def read_control(kind: int, content: bytes) -> dict[str, object] | None:
    def number(start: int, stop: int) -> int:
        return int.from_bytes(content[start:stop], "big")

    if kind == 0xF6:
        if len(content) != 11:
            raise Refused("entry_bounds")
        return {"left_out": number(0, 2), "packets": number(2, 10), "settled": content[10] & 1 == 1}
    if kind == 0xF7:
        if not content:
            raise Refused("entry_bounds")
        return {"waited": list(content)}
    if kind == 0xF8:
        if len(content) < 17 or (len(content) - 17) % 5:
            raise Refused("entry_bounds")
        marks = [[content[at], number(at + 1, at + 5)] for at in range(17, len(content), 5)]
        return {
            "hello": number(0, 8),
            "turns": number(8, 12),
            "capabilities": content[12],
            "digest": number(13, 17),
            "marks": marks,
        }
    if kind == 0xF9:
        if len(content) < 2:
            raise Refused("entry_bounds")
        return {"ask": content[0], "topic_ids": list(content[1:])}
    if kind == 0xFA:
        if len(content) not in (14, 15):
            raise Refused("entry_bounds")
        if len(content) == 15 and content[14] > 200:
            raise Refused("entry_kind")
        tail = content[13]
        return {
            "report": content[0],
            "boot": number(1, 3),
            "number": number(3, 5),
            "arrived": number(5, 13),
            "settled": tail >= 128,
            "loss": tail % 128,
            "snr_db": content[14] / 2 - 40 if len(content) == 15 else None,
        }
    if kind == 0xFB:
        if len(content) != 7:
            raise Refused("entry_bounds")
        return {"heard": content[0], "echo": number(1, 5), "since": number(5, 7)}
    if kind == 0xFC:
        if len(content) != 17:
            raise Refused("entry_bounds")
        if 200 < content[16] < 255:
            raise Refused("entry_kind")
        return {
            "ping": content[0],
            "number": number(1, 3),
            "reply": content[3] % 2 == 1,
            "wants_about": content[3] // 2 % 2 == 1,
            "arrived": number(4, 6),
            "held": number(6, 8),
            "clock_us": number(8, 16),
            "snr_db": None if content[16] == 255 else content[16] / 2 - 40,
        }
    if kind == 0xFD:
        if len(content) < 10:
            raise Refused("entry_bounds")
        return {"about": number(0, 2), "phy": number(2, 6), "key": number(6, 10), "text": content[10:].hex()}
    if kind == 0xFE:
        if len(content) not in (5, 8):
            raise Refused("entry_bounds")
        newest = {"newest": content[0], "start": content[1], "topic_id": content[2]}
        if len(content) == 8:
            return {**newest, "number": number(3, 7), "place": content[7]}
        return {**newest, "number": number(3, 5), "place": None}
    return None


def read_relayed(content: bytes) -> dict[str, object]:
    """A message of topic 241."""
    if len(content) < 11 or (content[9] & 64 and len(content) < 12):
        raise Refused("entry_bounds")
    begin = 12 if content[9] & 64 else 11
    to = content[11] if begin == 12 else 255
    if content[8] > 240 or content[0] == 255 or (begin == 12 and to == 255):
        raise Refused("entry_kind")
    name, after = [int.from_bytes(content[3:7], "big"), content[7]], None
    if content[9] & 32:
        back, begin = varint(content, begin, len(content) - 1)
        after, begin = [name[0] - back, content[begin]], begin + 1
        if after[0] < 0 or after >= name:
            raise Refused("entry_kind")
    return {
        "origin": content[0],
        "start": int.from_bytes(content[1:3], "big"),
        "number": int.from_bytes(content[3:7], "big"),
        "place": content[7],
        "topic_id": content[8],
        "hops": content[9] % 32,
        "payload": content[begin:].hex(),
        "coded": content[9] >= 128,
        "dst_id": to,
        "age": content[10],
        "limit": 255,
        "waits": 0,
        "after": after,
    }


def age_of(code: int) -> float:
    """Seconds of a code of an age."""
    return code / 100 if code < 32 else 2 * age_of(code - 16)


def read_carried(content: bytes) -> dict[str, object]:
    """A message of topic 242."""
    message = read_relayed(content[3:])
    if content[0] == 255 or message["dst_id"] == 255 or content[2] > 127 or message["after"]:
        raise Refused("entry_kind")
    return {"taker": content[0], **message, "limit": content[1], "waits": content[2]}


def read_receipts(payload: bytes) -> list[dict[str, object]]:
    """The message of a carried one of topic 240."""
    if len(payload) % 8:
        raise Refused("entry_bounds")
    entries = [payload[at : at + 8] for at in range(0, len(payload), 8)]
    return [
        {
            "start": int.from_bytes(entry[:2], "big"),
            "topic_id": entry[2],
            "number": int.from_bytes(entry[3:7], "big"),
            "place": entry[7],
        }
        for entry in entries
    ]


def read_medium_access(data: bytes) -> dict[str, object]:
    """The block at the begin of these bytes."""
    if len(data) < 6 or (data[3] & 128 and len(data) < 12):
        raise Refused("entry_bounds")
    ahead = [code if code < 128 else 127 + 4 * (code - 127) for code in data[1:3]]
    heard = data[3] & 127
    heard = heard if heard <= 63 else 63 + 3 * (heard - 63)
    expected, conflict, weight = None, [0, 255], 1
    if data[3] & 128:
        weight, expected = 1 + (data[6] >> 4), int.from_bytes(data[6:10], "big") & 0x0FFFFFFF
        conflict = list(data[10:12])
    return {
        "slot": data[0],
        "ahead": ahead,
        "heard": heard,
        "names": list(data[4:6]),
        "expected": expected,
        "conflict": conflict,
        "weight": weight,
    }


def read_packet(
    data: bytes, packet_len: int, boot: int, newest: int, *, key: bytes | None = None, encrypts: bool = False
) -> dict[str, object]:
    """One packet, opened: its fields, and ``body`` of a repair.

    :param newest: packet number that the packet's is nearest to
    """
    if not 8 <= len(data) <= packet_len:
        raise Refused("length")
    if data[0] >> 4 & 7 != 1:
        raise Refused("version")
    sealed, addressed, qos = bool(data[0] & 8), bool(data[0] & 4), data[0] & 3
    trailer, start = (8 if sealed else 4), (6 if addressed else 4)
    if len(data) < start + trailer:
        raise Refused("length")
    low = data[2] * 256 + data[3]
    number = newest - 32768 + (low - (newest - 32768)) % 65536
    packet: dict[str, object] = {"qos": qos, "sealed": sealed, "src_id": data[1], "number": number}
    if addressed:
        packet["dst_id"], packet["hop"] = data[4], data[5]
    end = len(data) - trailer
    room = packet_len - start - 2 - trailer
    if data[0] & 128:
        packet["block"] = read_medium_access(data[start:end])
        start += 12 if data[start + 3] & 128 else 6
        room -= 12
    repair_id, window, hello = 255, 0, False
    if qos == 3:
        if start + 2 > end:
            raise Refused("entry_bounds")
        window, repair_id = data[start] % 128, data[start + 1] % 128
        masked, oldest = data[start] >= 128, data[start + 1] >= 128
        packet["repair_id"], packet["oldest"] = repair_id, oldest
        start += 2
        members = list(range(window))
        if not window:
            hello = masked
        elif masked:
            size = (window + 7) // 8
            if start + size > end:
                raise Refused("entry_bounds")
            mask = int.from_bytes(data[start : start + size], "little")
            members = [bit for bit in range(size * 8) if mask >> bit & 1]
            if not members or members[0] or members[-1] != window - 1 or len(members) == window:
                raise Refused("window")
            start += size
        packet["members"] = [number - bit for bit in members]
        packet["clear"] = hello
    if sealed:
        assert key is not None
        nonce = bytes(4) + number.to_bytes(8, "big") + bytes([repair_id])
        associated = data[:start] if not addressed else data[:5] + data[6:start]
        opened = subkey(key, data[1], boot)
        if encrypts and not hello:
            body = unseal(opened, nonce, associated, data[start:end], data[end:])
        else:
            body = data[start:end]
            unseal(opened, nonce, associated + body, b"", data[end:])
    else:
        body = data[start:end]
        turns = number >> 16
        session = boot.to_bytes(8, "big") + turns.to_bytes(4, "big")
        if crc32(session + data[:end]) != int.from_bytes(data[end:], "big"):
            raise Refused("crc")
    if qos == 3 and window:
        packet["body"] = body
    else:
        packet["entries"] = read_body(body, max(room, 0))
        packet["body"] = body[:room]
    return packet


def solve(known: dict[int, bytes], repairs: list[tuple[int, list[int], bytes]], room: int) -> dict[int, bytes]:
    """Bodies that follow from repairs (repair id, numbers, combination): Gauss-Jordan elimination, nothing clever."""
    missing = sorted({number for _, numbers, _ in repairs for number in numbers} - set(known))
    column = {number: at for at, number in enumerate(missing)}
    rows: list[list[int]] = []
    for repair_id, numbers, combined in repairs:
        left = [0] * len(missing)
        right = list(combined.ljust(room, b"\0")[:room])
        for number in numbers:
            factor = coefficient(repair_id, number)
            if number in column:
                left[column[number]] = factor
            else:
                for at, byte in enumerate(known[number]):
                    right[at] ^= times(factor, byte)
        rows.append(left + right)
    done = 0
    for at in range(len(missing)):
        pivot = next((index for index in range(done, len(rows)) if rows[index][at]), None)
        if pivot is None:
            continue
        rows[done], rows[pivot] = rows[pivot], rows[done]
        inverse = INVERSE[rows[done][at]]
        rows[done] = [times(inverse, value) for value in rows[done]]
        for index, row_values in enumerate(rows):
            if index != done and (factor := row_values[at]):
                rows[index] = [a ^ times(factor, b) for a, b in zip(row_values, rows[done], strict=True)]
        done += 1
    found = {}
    for row_values in rows[:done]:
        columns = [at for at, value in enumerate(row_values[: len(missing)]) if value]
        if len(columns) == 1:
            found[missing[columns[0]]] = bytes(row_values[len(missing) :])
    return found


def messages(bodies: dict[int, bytes], room: int) -> dict[tuple[int, int, int], bytes]:
    """Whole messages by (topic id, packet in which they began, place among its entries). Where the begin is known only
    of a message that was sent again, these are those of its newest fragment."""
    whole: dict[tuple[int, int, int], bytes] = {}
    parts: dict[tuple[int, int], list[tuple[int, bytes, bool, tuple[int, int], bool]]] = {}
    for number, body in bodies.items():
        for place, entry in enumerate(read_body(body.ljust(room, b"\0"), room)):
            if "topic_id" not in entry:
                continue
            topic, back, offset = (int(str(entry[name])) for name in ("topic_id", "back", "offset"))
            payload, last = bytes.fromhex(str(entry["payload"])), bool(entry["last"])
            if last and not offset and not back:
                whole[topic, number, place] = payload
            else:
                first = not offset and not back
                parts.setdefault((topic, number - back), []).append((offset, payload, last, (number, place), first))
    for (topic, _), pieces in parts.items():
        data = {at: byte for offset, piece, *_ in pieces for at, byte in enumerate(piece, offset)}
        ends = [offset + len(piece) for offset, piece, last, *_ in pieces if last]
        if ends and sorted(data) == list(range(ends[0])):
            order = next((at for *_, at, first in pieces if first), max(at for *_, at, _ in pieces))
            whole[topic, order[0], order[1]] = bytes(data[at] for at in range(ends[0]))
    return whole


def read_table(data: bytes) -> list[dict[str, object]]:
    """The rows in a message of topic 240."""
    if data[:1] != b"\1":
        raise Refused("version")
    rows: list[dict[str, object]] = []
    at = 1
    while at < len(data):
        if at + 4 > len(data):
            raise Refused("entry_bounds")
        topic_id, flags, depth = data[at : at + 3]
        at, to = at + 3, 255
        if flags & 32:
            at, to = at + 1, data[at]
            if to == 255:
                raise Refused("entry_kind")
        deadline = 0
        if flags & 64:
            if at == len(data):
                raise Refused("entry_bounds")
            at, deadline = at + 1, data[at]
            if deadline in (0, 255):
                raise Refused("entry_kind")
        texts: list[str] = []
        for _ in range(3):
            if at >= len(data) or at + 1 + data[at] > len(data):
                raise Refused("entry_bounds")
            try:
                texts.append(data[at + 1 : at + 1 + data[at]].decode())
            except UnicodeDecodeError as error:
                raise Refused("entry_kind") from error
            at += 1 + data[at]
        if topic_id >= 240 or flags >= 128 or flags % 4 == 3 or topic_id in [row["topic_id"] for row in rows]:
            raise Refused("entry_kind")
        row: dict[str, object] = {"topic_id": topic_id, "name": texts[0], "type_name": texts[1], "qos": flags % 4}
        row |= {"reliable": bool(flags & 4), "latched": bool(flags & 8), "depth": depth, "codec": texts[2]}
        rows.append(row | {"fresh": bool(flags & 16), "dst_id": to, "deadline": deadline})
    return rows


def known_rows(messages: list[bytes]) -> tuple[dict[object, dict[str, object]], int]:
    """The newest row of each topic of these messages, and what a hello says when these are all."""
    rows, marks = {}, {}
    for message in messages:
        for row in read_table(message):
            rows[row["topic_id"]] = row
            if len(read_table(message)) == 1:  # a sender writes one row per message
                marks[row["topic_id"]] = crc32(message)
    return rows, sum(marks.values()) % 2**32


def delivered(received: list[bytes]) -> list[bytes]:
    """Of the messages of a topic with kept messages, as they are on the air, those that are not a repeat."""
    new: list[bytes] = []
    for message in received:
        if not new or crc32(message) != crc32(new[-1]):
            new.append(message)
    return new


def read_call(data: bytes) -> dict[str, object]:
    """A frame of a call."""
    head = {"robot": data[1], "start": int.from_bytes(data[2:10], "big"), "number": int.from_bytes(data[10:14], "big")}
    if data[0] == 1:
        return {**head, "payload": data[14:]}
    assert data[0] == 0
    return {**head, "service": data[14], "deadline": int.from_bytes(data[15:17], "big") / 10, "payload": data[17:]}


def read_wish(data: bytes) -> dict[str, object]:
    """What a link is asked; ValueError where it is to be refused."""
    if data == b"\0":
        return {"kind": "list"}
    if not data or data[0] not in (1, 2):
        raise ValueError("kind")
    name = data[1 if data[0] == 2 else 7 :].decode()
    if not 0 < len(name.encode()) < 256 or not name.isprintable():
        raise ValueError("name")
    if data[0] == 2:
        return {"kind": "give up", "name": name}
    rate, for_s = struct.unpack(">fH", data[1:7])
    if not 0 <= rate <= 1e6 or not for_s:
        raise ValueError("rate or time")
    return {"kind": "want", "name": name, "rate": rate, "for_s": for_s}


def read_wish_answer(data: bytes) -> dict[str, object]:
    """What became of a wish."""
    return dict(zip(("outcome", "rate", "cost", "free"), struct.unpack(">Bfff", data), strict=True))


def read_offers(data: bytes) -> list[dict[str, object]]:
    """What a robot offers."""
    rows: list[dict[str, object]] = []
    while data:
        flags, rate, size, names, kinds = struct.unpack(">BffBB", data[:11])
        name, kind, data = data[11 : 11 + names], data[11 + names : 11 + names + kinds], data[11 + names + kinds :]
        row = {"name": name.decode(), "type_name": kind.decode(), "rate": rate, "size": size}
        rows.append({**row, "wanted": bool(flags & 1), "fits": bool(flags & 2)})
    return rows
