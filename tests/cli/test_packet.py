"""`packet decode`: all the ways packets are handed over."""

from __future__ import annotations

import io
import json
import struct
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.cli.capture import packets_in
from gr_ros2.cli.main import run
from gr_ros2.core.errors import ConfigError
from gr_ros2.link.v1.sealing import Keys, SealMode
from gr_ros2.wire.control import Hello
from gr_ros2.wire.v0 import V0, EntryV0, PacketV0
from gr_ros2.wire.v1 import Header, RepairHeader, write_body, write_header, write_repair_header
from tests.link.v1.air import Robot, registry

VECTORS = json.loads((Path(__file__).parent.parent / "vectors" / "v0.json").read_text())
V1 = json.loads((Path(__file__).parent.parent / "vectors" / "v1.json").read_text())
PACKETS = [
    V0.encode(PacketV0(1, 255, seq, 1, (EntryV0(1, seq, 0, 1, b"payload %d" % seq), EntryV0(2, 9, 3, 8, b""))), 64)
    for seq in range(3)
]


def pcap(records: list[bytes], link_type: int = 147, order: str = "<") -> bytes:
    head = struct.pack(order + "IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, link_type)
    return head + b"".join(struct.pack(order + "4I", 0, 0, len(data), len(data)) + data for data in records)


def _block(kind: int, body: bytes, order: str) -> bytes:
    body += bytes(-len(body) % 4)
    length = struct.pack(order + "I", 12 + len(body))
    return struct.pack(order + "I", kind) + length + body + length


def pcapng(records: list[bytes], link_type: int = 147, order: str = "<") -> bytes:
    data = _block(0x0A0D0D0A, struct.pack(order + "IHHq", 0x1A2B3C4D, 1, 0, -1), order)
    data += _block(1, struct.pack(order + "HHI", link_type, 0, 65535), order)
    for number, record in enumerate(records):
        if number % 2:
            data += _block(3, struct.pack(order + "I", len(record)) + record, order)
        else:
            data += _block(6, struct.pack(order + "5I", 0, 0, 0, len(record), len(record)) + record, order)
    return data


def udp(payload: bytes, ethernet: bool = True) -> bytes:
    datagram = struct.pack(">4H", 4000, 4001, 8 + len(payload), 0) + payload
    ip = struct.pack(">BBHHHBBH8s", 0x45, 0, 20 + len(datagram), 0, 0, 64, 17, 0, bytes(8))
    return (bytes(12) + b"\x08\x00" if ethernet else b"") + ip + datagram + (bytes(6) if ethernet else b"")


@pytest.mark.parametrize("vector", VECTORS["valid"], ids=lambda vector: vector["name"])
def test_the_vectors_as_hex(vector: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["packet", "decode", "--packet-len", str(vector["packet_len"]), vector["hex"]]) == 0
    out = capsys.readouterr().out
    packet = vector["packet"]
    assert f"src {packet['src_id']}, dst {packet['dst_id']}" in out
    assert f"seq {packet['seq']}, hop {packet['hop']}, {len(packet['entries'])} entries" in out
    for entry in packet["entries"]:
        fields = f"topic {entry['topic_id']}, entry_id {entry['entry_id']}, index {entry['index']} of {entry['total']}"
        assert fields in out


@pytest.mark.parametrize("vector", VECTORS["invalid"], ids=lambda vector: vector["name"])
def test_a_refused_packet_is_shown_with_its_reason(vector: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["packet", "decode", "--packet-len", str(vector["packet_len"]), vector["hex"]]) == 1
    captured = capsys.readouterr()
    assert captured.out.startswith("packet 1: rejected: ")
    assert captured.err == ""


@pytest.mark.parametrize(
    "data",
    [
        b"".join(PACKETS),
        b"\n".join(packet.hex().encode() for packet in PACKETS) + b"\n",
        b"# three packets\n\n" + b"\r\n".join(packet.hex(":").encode() + b"  # one" for packet in PACKETS),
        pcap(PACKETS),
        pcap(PACKETS, order=">"),
        pcap([udp(packet) for packet in PACKETS], link_type=1),
        pcap([udp(packet, ethernet=False) for packet in PACKETS], link_type=101),
        pcapng(PACKETS),
        pcapng(PACKETS, order=">"),
        pcapng([udp(packet) for packet in PACKETS], link_type=1),
    ],
    ids=["binary", "hex", "colons", "pcap", "pcap-big", "pcap-udp", "pcap-ip", "pcapng", "pcapng-big", "pcapng-udp"],
)
def test_files(data: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert list(packets_in(data, 64, "file")) == [(packet, 64) for packet in PACKETS]
    path = tmp_path / "file"
    path.write_bytes(data)
    assert run(["packet", "decode", "--packet-len", "64", str(path)]) == 0
    out = capsys.readouterr().out
    assert [f"packet {number}: 64 bytes" in out for number in (1, 2, 3, 4)] == [True, True, True, False]


def test_standard_input(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["packet", "decode"], ["packet", "decode", "-", PACKETS[2].hex()]):
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(PACKETS[0].hex().encode())))
        assert run(arguments) == 0
        assert capsys.readouterr().out.count("CRC ok") == len(arguments) - 1 - (len(arguments) > 2)


def test_a_rest_is_shown_as_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "cut.bin"
    path.write_bytes(PACKETS[0] + PACKETS[1][:30])
    assert run(["packet", "decode", "--packet-len", "64", str(path)]) == 1
    assert "packet 2: rejected: length: 30 bytes where packet_len is 64" in capsys.readouterr().out


def test_topics_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "r.csv").write_text("scan,sensor_msgs/LaserScan\nodom,nav_msgs/Odometry\n")
    assert run(["packet", "decode", "--registry", str(tmp_path / "r.csv"), PACKETS[0].hex()]) == 0
    out = capsys.readouterr().out
    assert "topic 1 (odom)" in out
    assert "topic 2 (not in the registry)" in out


@pytest.mark.parametrize("text", ["nonsense", "/nowhere/at/all", "x" * 5000])
def test_neither_hex_nor_a_file(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["packet", "decode", text]) == 2
    assert "neither hex digits nor a file" in capsys.readouterr().err


def test_nothing_to_decode(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").touch()
    assert run(["packet", "decode", str(tmp_path / "empty")]) == 2
    assert "empty" in capsys.readouterr().err


@pytest.mark.parametrize("data", [pcap(PACKETS)[:-1], pcap(PACKETS) + b"1234", pcapng(PACKETS)[:-1]])
def test_a_damaged_capture(data: bytes) -> None:
    with pytest.raises(ConfigError, match="file: the capture"):
        list(packets_in(data, 64, "file"))


@given(st.binary(max_size=200), st.sampled_from([b"", pcap([])[:20], pcap([]), pcapng([]), pcapng([])[:28]]))
def test_any_bytes_are_packets_or_a_config_error(data: bytes, start: bytes) -> None:
    found: list[tuple[bytes, int]] = []
    with suppress(ConfigError):
        found.extend(packets_in(start + data, None, "file"))
    assert sum(len(packet) for packet, _ in found) <= len(start + data)


# -- version 1 ----------------------------------------------------------------------------------------------------


def hello(vector: dict[str, Any], key: bytes = b"") -> str:
    """What tells how the packet of a vector is read: a hello of its sender's, which stands at its number."""
    mode: SealMode = "none" if not key else "encrypt" if vector["encrypts"] else "authenticate"
    keys = Keys((key,) if key else (), mode)
    src_id, turns = bytes.fromhex(vector["hex"])[1], vector["newest"] >> 16
    clear = write_header(Header(3, bool(key), src_id, vector["newest"] & 0xFFFF))
    clear += write_repair_header(RepairHeader(99, clear=True))
    body = write_body([Hello(vector["boot"], turns, 1 | 2 * keys.encrypts, 0)], 50)
    return keys.own(src_id, vector["boot"]).close(clear, body, vector["newest"], 99, plain=True).hex()


def check_entries(vector: dict[str, Any], lines: list[str]) -> None:
    relayed = [line for line in lines if line.startswith("    relayed: ")]
    lines = [line for line in lines if line not in relayed]
    assert len(relayed) == sum(entry.get("topic_id", 0) > 240 for entry in vector["entries"])
    assert set(relayed) <= {
        "    relayed: robot 7's (boot ends in cafe) topic 3, from its packet 70000.1, hop 2, 0.05 s old",
        "    relayed: robot 7's (boot ends in cafe) topic 3 to robot 9, from its packet 70000.128, hop 2, 1 s old, "
        "taken on by robot 3",
        "    relayed: robot 7's (boot ends in cafe) topic 3, from its packet 70000.1 after 69990.0, hop 2, more than "
        "4915.2 s old",
    }
    assert len(lines) == len(vector["entries"])
    for line, entry in zip(lines, vector["entries"], strict=True):
        if "payload" in entry:
            payload = entry["payload"]
            assert f": topic {entry['topic_id']}, " in line
            assert f"payload {len(payload) // 2} bytes: {payload[:32]}" in line
            assert line.endswith(", coded") == entry["coded"]
            if entry["offset"]:
                assert f"began {entry['back']} packets ago, bytes from {entry['offset']} on" in line
        else:
            (kind,) = {"hello", "ask", "report", "heard", "ping", "about", "newest", "left_out"} & entry.keys()
            assert f": {'pong' if entry.get('reply') else kind.replace('_', ' ')}, " in line
            shown = str(entry.get("number", entry[kind]))
            if kind == "hello":
                shown = f"boot {entry['hello'] >> 32}.{entry['hello'] & 0xFFFF_FFFF:08x}, "
            elif kind == "ping":
                shown = f"number {entry['number']} to robot {entry['ping']}"
                assert ("asks what it is" in line) == entry["wants_about"]
                assert (f"{entry['arrived']} have come, held for {entry['held'] / 10} ms" in line) == entry["reply"]
                assert (f"SNR {entry['snr_db']} dB" in line) == (entry["snr_db"] is not None)
            elif kind == "about":
                text = bytes.fromhex(entry["text"]).decode()
                shown = f"packets of {entry['about']} bytes, phy {entry['phy']:08x}, key {entry['key']:08x}, '{text}'"
            assert shown in line


@pytest.mark.parametrize("vector", V1["packets"], ids=lambda vector: vector["name"])
def test_the_vectors_of_version_1(vector: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["packet", "decode", "--packet-len", "64", hello(vector), vector["hex"]]) == 0
    first, *entries = capsys.readouterr().out.split("packet 2: ")[1].splitlines()
    assert first.endswith("CRC ok")
    assert f"src {vector['header']['src_id']}, dst {vector['header']['dst_id']}" in first
    assert f"number {vector['number']}, " in first
    if "block" in vector:
        assert f"  medium access: slot {vector['block']['slot']}, next sends +7, +" in entries.pop(0)
    check_entries(vector, entries)


@pytest.mark.parametrize("vector", V1["repairs"], ids=lambda vector: vector["name"])
def test_repairs(vector: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        run(
            [
                "packet",
                "decode",
                "--packet-len",
                "64",
                hello(vector | {"hex": vector["repairs"][0]}),
                *vector["repairs"],
            ]
        )
        == 0
    )
    lines = capsys.readouterr().out.splitlines()[2:]
    assert len(lines) == len(vector["repairs"])
    members = vector["members"]
    assert all(f"of {len(members)} packets in {min(members)}..{max(members)}, " in line for line in lines)
    assert all("version 1, repair, " in line and line.endswith("CRC ok") for line in lines)


@pytest.mark.parametrize("vector", V1["sealed"], ids=lambda vector: vector["name"])
def test_sealed_packets_with_and_without_the_key(
    vector: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    key = tmp_path / "key"
    key.write_text(vector["key"] + "\n")
    key.chmod(0o600)
    packets = [hello(vector, bytes.fromhex(vector["key"])), vector["hex"]]
    assert run(["packet", "decode", "--packet-len", "64", "--key", str(key), *packets]) == 0
    first, *entries = capsys.readouterr().out.split("packet 2: ")[1].splitlines()
    assert first.endswith("tag ok")
    if "block" in vector["name"]:
        assert entries.pop(0).endswith("expects to receive in +1, +28, weight 12, robot 254 gives up +18")
    check_entries(vector, entries)
    assert run(["packet", "decode", "--packet-len", "64", *packets]) == 0
    first, *entries = capsys.readouterr().out.split("packet 2: ")[1].splitlines()
    assert first.endswith("tag not checked: no key")
    if vector["encrypts"] and "a hello" not in vector["name"]:
        assert " bytes encrypted: " in first
        assert len(entries) == ("block" in vector["name"])
    else:
        del entries[: "block" in vector["name"]]
        check_entries(vector, entries)
    key.write_text("00" * 32 + "\n")
    assert run(["packet", "decode", "--packet-len", "64", "--key", str(key), *packets]) == 1
    assert "packet 1: rejected: wrong_key: " in capsys.readouterr().out


def test_announced_topics_have_names_and_packets_as_long_as_needed_are_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = Robot(1, registry(), any_length=True)
    now, packets = 0.0, []
    for number in range(40):
        one.end.messages.submit(number % 3, bytes(10 * number), now)
        for _ in range(8):
            now += 1 / 75
            data = one.slot(now)
            packets += [data] if data is not None else []
    path = tmp_path / "sent.pcapng"
    path.write_bytes(pcapng(packets))
    assert run(["packet", "decode", str(path)]) == 0
    out = capsys.readouterr().out
    assert "  announces topic 1: scan std_msgs/msg/String, default" in out
    assert "topic 1 (scan), whole, " in out
    assert out.count("CRC ok") == len(packets) > 100
    assert run(["packet", "decode", "--packet-len", "64", str(path)]) == 0
    assert capsys.readouterr().out == out
