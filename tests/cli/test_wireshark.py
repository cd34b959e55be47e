"""The dissector in a real tshark: the vectors, refusals by name, and captures of our own."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import tempfile
from itertools import zip_longest
from pathlib import Path
from typing import Any

import pytest

from gr_ros2.cli.main import run
from gr_ros2.cli.wireshark import DISSECTOR
from gr_ros2.core.errors import ConfigError, WireError
from gr_ros2.link.events import BoundPacket, PacketId, Received, SentPacket
from gr_ros2.link.v1.sealing import SealMode
from gr_ros2.observe.capture import PacketCapture
from gr_ros2.settings.registry import Registry
from gr_ros2.wire import BOUND
from gr_ros2.wire.mac_block import read_block
from gr_ros2.wire.relayed import read_relayed
from gr_ros2.wire.v0 import V0, PacketV0, with_crc
from gr_ros2.wire.v1 import CARRIED_TOPIC, Header, crc, session_crc, write_header
from gr_ros2.wire.v1 import decode as read
from gr_ros2_lab.run.scenario import load_scenario
from tests.cli.test_packet import hello
from tests.link.test_reader import talk

V1 = json.loads((Path(__file__).parent.parent / "vectors" / "v1.json").read_text())
VECTORS = json.loads((Path(__file__).parent.parent / "vectors" / "v0.json").read_text())
FIELDS = ("src_id", "dst_id", "seq", "hop", "qos", "compressed", "encrypted", "entries", "crc")

NOTHING = PacketV0(1, 255, 0, 1, ())
NOBODY = PacketId(1, 0, 0, 0)
"""A capture has the bytes as they are."""


def capture(path: Path, packets: list[bytes]) -> Path:
    with PacketCapture(path, clock=lambda: 0.0) as writing:
        for number, data in enumerate(packets):
            writing.sender_event(1, SentPacket(data, NOTHING, *NOBODY, (), number * 0.5))
            writing.receiver_event(Received(data, NOTHING, *NOBODY), number * 0.5 + 0.25)
    return path


def tshark(path: Path, *arguments: str) -> str:
    command = ["tshark", "-X", f"lua_script:{DISSECTOR}", "-r", str(path), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def why_no_tshark() -> str:
    """Why the dissector cannot be tried here, empty where it can."""
    if shutil.which("tshark") is None:
        return "tshark is missing: apt install tshark"
    with tempfile.TemporaryDirectory() as folder:
        try:
            tshark(capture(Path(folder) / "one.pcapng", [bytes(14)]), "-Y", "gr_ros2")
        except subprocess.CalledProcessError:
            if os.geteuid() == 0:
                return "this tshark runs no Lua for root: run the tests as a user"
    return ""


NO_TSHARK = why_no_tshark()
needs_tshark = pytest.mark.skipif(bool(NO_TSHARK), reason=NO_TSHARK)


def dissected(path: Path, *arguments: str) -> list[dict[str, Any]]:
    """Each packet's fields; of several with one name, a list."""
    found = json.loads(tshark(path, "-T", "json", "--no-duplicate-keys", *arguments))
    return [packet["_source"]["layers"] for packet in found]


def values(tree: Any, name: str) -> list[str]:
    """Every value of a field, wherever it stands in the tree."""
    found: list[str] = []
    if isinstance(tree, list):
        return [value for item in tree for value in values(item, name)]
    if not isinstance(tree, dict):
        return found
    for key, value in tree.items():
        if key == name:
            found += [one for one in (value if isinstance(value, list) else [value]) if isinstance(one, str)]
        else:
            found += values(value, name)
    return found


@needs_tshark
def test_every_valid_vector_is_shown_as_it_is(tmp_path: Path) -> None:
    vectors = VECTORS["valid"]
    path = capture(tmp_path / "valid.pcapng", [bytes.fromhex(vector["hex"]) for vector in vectors])
    shown = dissected(path)
    assert len(shown) == 2 * len(vectors)
    for vector, layers in zip(vectors, shown[::2], strict=True):
        packet, tree = vector["packet"], layers["gr_ros2"]
        for name in ("version", "qos", "src_id", "dst_id", "seq", "hop"):
            assert int(values(tree, f"gr_ros2.{name}")[0]) == packet[name], (vector["name"], name)
        assert [int(one) for one in values(tree, "gr_ros2.total")] == [entry["total"] for entry in packet["entries"]]
        assert [int(one) for one in values(tree, "gr_ros2.topic_id")] == [
            entry["topic_id"] for entry in packet["entries"]
        ]
        payloads = [entry["payload"] for entry in packet["entries"] if entry["payload"]]
        assert [one.replace(":", "") for one in values(tree, "gr_ros2.payload")] == payloads
    assert not tshark(path, "-Y", "_ws.expert")


@needs_tshark
def test_what_a_receiver_refuses_is_marked_by_the_same_name(tmp_path: Path) -> None:
    refused = {vector["name"]: bytes.fromhex(vector["hex"]) for vector in VECTORS["invalid"]}
    # A first digit of 9 is version 1 with a block for medium access, to whoever knows version 1 too.
    other = refused.pop("version 9")
    refused["version 7"] = with_crc(bytes([0x70 | other[0] & 15]) + other[1:-2])
    for number, (name, data) in enumerate(refused.items()):
        # A dissector does not know packet_len: a packet cut short shows as a wrong CRC.
        with pytest.raises(WireError) as refusal:
            V0.decode(data, len(data))
        path = capture(tmp_path / f"{number}.pcapng", [data])
        assert tshark(path, "-Y", f"gr_ros2.refused.{refusal.value.kind}").count("\n") == 2, name


@needs_tshark
@pytest.mark.parametrize(
    "rows",
    [
        "topic,type\n# robots\n/a,std_msgs/String\nodom,nav_msgs/msg/Odometry\n",
        "Name,Type,qos\n/a,std_msgs/String,\nodom,nav_msgs/Odometry,bulk\n",
        '\ufeff"/a", std_msgs/String\r\n\r\n"odom", "nav_msgs/Odometry"\r\n',
    ],
)
def test_topics_have_names_with_the_registry_and_times_and_directions_are_kept(rows: str, tmp_path: Path) -> None:
    registry = tmp_path / "topics.csv"
    registry.write_text(rows)
    assert [topic.name for topic in Registry.from_csv(registry)] == ["/a", "odom"]
    vector = next(one for one in VECTORS["valid"] if any(entry["topic_id"] == 1 for entry in one["packet"]["entries"]))
    path = capture(tmp_path / "named.pcapng", [bytes.fromhex(vector["hex"])] * 2)
    arguments = ["-o", f"gr_ros2.registry:{registry}", "-T", "fields"]
    for field in ("gr_ros2.topic", "frame.interface_name", "frame.time_relative"):
        arguments += ["-e", field]
    rows = [line.split("\t") for line in tshark(path, *arguments).splitlines()]
    assert all("odom" in row[0].split(",") for row in rows)
    assert [row[1] for row in rows] == ["sent", "received"] * 2
    assert [float(row[2]) for row in rows] == pytest.approx([0, 0.25, 0.5, 0.75], abs=1e-6)


@needs_tshark
def test_every_vector_of_version_1_is_shown_as_it_is(tmp_path: Path) -> None:
    vectors = V1["packets"] + V1["sealed"]
    packets = []
    for vector in vectors:
        packets += [bytes.fromhex(hello(vector, bytes.fromhex(vector.get("key", "")))), bytes.fromhex(vector["hex"])]
    path = capture(tmp_path / "v1.pcapng", packets)
    preference = ("-o", "gr_ros2.packet_len:64")
    shown = dissected(path, *preference)[2::4]
    for vector, layers in zip(vectors, shown, strict=True):
        tree, entries = layers["gr_ros2"], vector["entries"]
        data = bytes.fromhex(vector["hex"])
        sealed = "key" in vector

        def numbers(name: str, tree: Any = tree) -> list[int]:
            return [int(one, 0) for one in values(tree, f"gr_ros2.{name}")]

        assert numbers("version") == [1]
        assert numbers("src_id") == [data[1]]
        assert numbers("packet_number") == [vector["number"]], vector["name"]
        block = data[6 if data[0] & 4 else 4 :][:12] if data[0] & 128 else b""
        at = 5 + (12 if block and block[3] & 128 else 6) * bool(block)
        assert numbers("repair_id") == ([data[at] & 127] if data[0] & 3 == 3 else [])
        assert numbers("shares") == [bool(block)]
        said = read_block(block)[0] if block else None
        for field, value in (
            ("slot", said and [said.slot]),
            ("slot.next", said and [said.ahead[0]]),
            ("slot.after", said and [said.ahead[1]]),
            ("slot.heard", said and [said.heard]),
            ("slot.name", said and list(said.names)),
            ("slot.weight", said and said.expected is not None and [said.weight]),
            ("slot.map", said and said.expected is not None and [said.expected]),
            ("slot.conflict", said and said.expected is not None and [said.conflict[0]]),
            ("slot.yields", said and said.expected is not None and [said.conflict[1]]),
        ):
            assert numbers(field) == (value or []), (vector["name"], field)
        assert numbers("sealed") == [sealed]
        assert values(tree, "gr_ros2.tag") == ([data[-8:].hex(":")] if sealed else [])
        assert numbers("crc32") == ([] if sealed else [int.from_bytes(data[-4:], "big")])
        if sealed and vector["encrypts"] and "a hello" not in vector["name"]:
            (hidden,) = values(tree, "gr_ros2.ciphertext")
            assert bytes.fromhex(hidden.replace(":", "")) in data[:-8]
            continue
        parts = [entry for entry in entries if "payload" in entry]
        over = [(part["topic_id"], bytes.fromhex(part["payload"])) for part in parts if part["topic_id"] > 240]
        assert numbers("relayed.taker") == [content[0] for topic_id, content in over if topic_id == CARRIED_TOPIC]
        assert numbers("relayed.limit") == [content[1] for topic_id, content in over if topic_id == CARRIED_TOPIC]
        assert numbers("relayed.waits") == [content[2] for topic_id, content in over if topic_id == CARRIED_TOPIC]
        relayed = [read_relayed(content[3 * (topic_id == CARRIED_TOPIC) :]) for topic_id, content in over]
        for field in ("origin", "start", "number", "place", "topic_id", "coded", "hops", "age"):
            assert numbers(f"relayed.{field}") == [getattr(message, field) for message in relayed], field
        assert numbers("topic_id") == [entry["topic_id"] for entry in parts]
        assert [one.replace(":", "") for one in values(tree, "gr_ros2.payload")] == [
            entry["payload"] for entry in parts if entry["payload"]
        ]
        assert numbers("offset") == [entry["offset"] for entry in parts if entry["offset"] or entry["back"]]
        assert numbers("back") == [entry["back"] for entry in parts if entry["offset"] or entry["back"]]
        assert numbers("coded") == [entry["coded"] for entry in parts]
        for name, of_kind in CONTROLS.items():
            said = [entry for entry in entries if name in entry]
            assert numbers(f"{name}.{of_kind[name]}") == [entry[name] for entry in said], vector["name"]
            for field, key in of_kind.items():
                if field != name:
                    assert numbers(f"{name}.{key}") == [entry[field] for entry in said]
        for bit, capability in enumerate(("hears", "encrypts", "reported", "wants_proof", "reads_left_out")):
            said = [entry["capabilities"] >> bit & 1 for entry in entries if "hello" in entry]
            assert numbers(f"hello.{capability}") == said, vector["name"]
    assert not tshark(path, "-Y", "_ws.expert")
    assert tshark(path, "-V").count("(correct)") == 4 * len(V1["packets"])


CONTROLS = {
    "hello": {"hello": "boot", "turns": "turns", "digest": "digest"},
    "ask": {"ask": "src_id"},
    "report": {"report": "src_id", "boot": "boot", "number": "number", "arrived": "arrived", "loss": "loss"},
    "heard": {"heard": "src_id", "echo": "echo", "since": "since"},
    "newest": {"newest": "origin", "start": "start", "topic_id": "topic_id", "number": "number"},
}
"""Names of values in the vectors, and of the dissector's fields."""


@needs_tshark
def test_repairs_are_shown(tmp_path: Path) -> None:
    for vector in V1["repairs"]:
        packets = [bytes.fromhex(hello(vector | {"hex": vector["repairs"][0]})), *map(bytes.fromhex, vector["repairs"])]
        path = capture(tmp_path / "repairs.pcapng", packets)
        members = vector["members"]
        shown = dissected(path)[2::2]
        assert len(shown) == len(vector["repairs"])
        for layers in shown:
            tree = layers["gr_ros2"]
            assert values(tree, "gr_ros2.kind") == ["1"]
            assert values(tree, "gr_ros2.packet_number") == [str(max(members))]
            assert values(tree, "gr_ros2.window") == [str(max(members) - min(members) + 1)]
            for text in values(tree, "gr_ros2.mask"):
                mask = int.from_bytes(bytes.fromhex(text.replace(":", "")), "little")
                assert mask == sum(1 << max(members) - number for number in members)
        assert not tshark(path, "-Y", "_ws.expert")


@needs_tshark
def test_what_a_receiver_of_version_1_refuses_is_marked_by_the_same_name(tmp_path: Path) -> None:
    boot, first = 7, {"boot": 7, "newest": 0, "hex": "1001"}
    packets, kinds = [bytes.fromhex(hello(first))], [""]

    def add(clear: bytes, body: bytes, kind: str) -> None:
        packets.append(clear + body + crc(clear + body, session_crc(boot, 0)))
        kinds.append(kind)

    for number, vector in enumerate(V1["refused_bodies"], 1):
        add(write_header(Header(0, False, 1, number)), bytes.fromhex(vector["hex"]), vector["error"])
    for text in ("fa07070203", "fa07078203ff0000000012"):
        add(b"\x90\x01\x00\x01", bytes.fromhex(text), "entry_bounds")
    repair = write_header(Header(3, False, 1, 1))
    for text in ("850003", "850012", "85001f"):
        add(repair, bytes.fromhex(text), "window")
    for text in ("00", "8900ff"):
        add(repair, bytes.fromhex(text), "entry_bounds")
    packets.append(packets[0][:-1] + bytes((packets[0][-1] ^ 1,)))
    kinds.append("crc")
    packets.append(b"\x10\x01\x00\x01" + bytes(3))
    kinds.append("length")
    path = capture(tmp_path / "refused.pcapng", packets)
    preference = ("-o", "gr_ros2.packet_len:50")  # a body of 40 bytes
    for kind in set(kinds) - {""}:
        marked = tshark(path, *preference, "-Y", f"gr_ros2.refused.{kind}", "-T", "fields", "-e", "frame.number")
        wanted = [number for number, one in enumerate(kinds) if one == kind]
        assert [int(line) for line in marked.split()][::2] == [2 * number + 1 for number in wanted], kind
        for number in wanted:
            with pytest.raises(WireError) as refusal:
                read(packets[number], 50, boot)
            assert refusal.value.kind == kind


@needs_tshark
@pytest.mark.parametrize("mode", ["none", "encrypt"])
def test_a_conversation_is_read_with_the_topics_that_it_announces(mode: SealMode, tmp_path: Path) -> None:
    packets = talk(mode)
    path = tmp_path / "talk.pcapng"
    with PacketCapture(path, clock=lambda: 0.0) as writing:
        for number, data in enumerate(packets):
            writing.receiver_event(Received(data, NOTHING, *NOBODY), number / 75)
    assert not tshark(path, "-Y", "_ws.expert")
    hidden = tshark(path, "-Y", "gr_ros2.ciphertext").count("\n")
    named = tshark(path, "-Y", 'gr_ros2.topic == "scan"').count("\n")
    if mode == "none":
        assert tshark(path, "-V").count("(correct)") == len(packets)
        assert named == 10
        assert tshark(path, "-Y", 'gr_ros2.table.name == "map"').count("\n") >= 1
        assert not hidden
    else:
        assert 0 < hidden < len(packets)
        assert not named


@needs_tshark
def test_what_is_bound_to_one_radio_has_starts_numbers_and_topics_of_its_own(tmp_path: Path) -> None:
    packets, bound = talk("none"), [BOUND + data for data in talk("none", restart=True)]
    path = tmp_path / "bound.pcapng"
    with PacketCapture(path, clock=lambda: 0.0) as writing:
        for number, (data, own) in enumerate(zip_longest(packets, bound)):
            for event in filter(None, (data and Received(data, NOTHING, *NOBODY), own and BoundPacket(own, 0.0))):
                writing.receiver_event(event, number / 75)
    assert not tshark(path, "-Y", "_ws.expert")
    assert tshark(path, "-V").count("(correct)") == len(packets) + len(bound)
    assert tshark(path, "-Y", "gr_ros2.bound == 0x20").count("\n") == len(bound)
    assert tshark(path, "-Y", 'gr_ros2.topic == "scan" and !gr_ros2.bound').count("\n") == 10
    assert tshark(path, "-Y", 'gr_ros2.topic == "scan" and gr_ros2.bound').count("\n") == 10


def test_the_documentation_lists_the_fields_of_version_1() -> None:
    source = DISSECTOR.read_text().split("-- Version 1.")[1].split("local fields")[0]
    fields = set(re.findall(r'"gr_ros2\.([\w.]+)"', source))
    page = (DISSECTOR.parents[2] / "docs" / "how-to" / "gnuradio.md").read_text()
    table = page.split("| Fields of version 1 |")[1].split("\n\n")[0]
    assert set(re.findall(r"`([\w.]+)`", table)) == fields


def test_our_own_decoder_reads_the_capture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    vector = VECTORS["valid"][0]
    path = capture(tmp_path / "own.pcapng", [bytes.fromhex(vector["hex"])])
    assert run(["packet", "decode", "--packet-len", str(vector["packet_len"]), str(path)]) == 0
    assert capsys.readouterr().out.count("CRC ok") == 2


def test_a_run_captures_every_packet_at_both_ends(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    memory = ["--set", "graph.middleware=memory"]
    from gr_ros2_lab.run.runner import REGISTRY_FILE

    path = tmp_path / "run.pcapng"
    command = ["run", "paper-direct", "--duration", "0.5", "--out", str(tmp_path / "out"), "--pcap", str(path)]
    assert run([*command, "--no-report", *memory]) == 0
    packets = json.loads((tmp_path / "out" / "result.json").read_text())["packets"]
    assert (tmp_path / "out" / REGISTRY_FILE).read_bytes() == Path(load_scenario("paper-direct").registry).read_bytes()
    capsys.readouterr()
    assert run(["packet", "decode", str(path)]) == 0
    assert capsys.readouterr().out.count("CRC ok") == packets["sent"] + packets["received"] > 0


@pytest.fixture(scope="module")
def relayed_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The capture of four robots, of which each hears the next one alone."""
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    from gr_ros2.observe.observers import RunObservers
    from gr_ros2_lab.run.simulated_runner import run_simulated

    gains = [[-100 if abs(one - other) < 2 else None for other in range(4)] for one in range(4)]
    scenario = load_scenario("line", ["robots=4", "duration_s=8", f"gains_db={json.dumps(gains)}"])
    path = tmp_path_factory.mktemp("relayed") / "run.pcapng"
    with PacketCapture(path, clock=lambda: 0.0) as writing:
        ran = run_simulated(scenario, run_observers=RunObservers([writing], threaded=False)).result
    assert {hops for topic in ran.topics for hops in topic.hops} == {"0", "1", "2"}
    return path


def test_a_capture_says_whose_messages_a_robot_sent_on_and_over_how_many_hops(
    relayed_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["packet", "decode", "--packet-len", "96", str(relayed_run)]) == 0
    lines, src, found = capsys.readouterr().out.splitlines(), 0, set()
    for line in lines:
        if sender := re.search(r", src (\d+),", line):
            src = int(sender[1])
        if relayed := re.search(r"relayed: robot (\d+)'s .* hop (\d+)", line):
            found.add((src, int(relayed[1]), int(relayed[2])))
    assert {(2, 1, 1), (3, 1, 2), (3, 4, 1), (2, 4, 2)} <= found
    assert all(hops == abs(src - origin) for src, origin, hops in found), "on the only way there is"


@needs_tshark
def test_wireshark_shows_the_same_of_relayed_messages(relayed_run: Path) -> None:
    whose = [
        argument for name in ("src_id", "relayed.origin", "relayed.hops") for argument in ("-e", f"gr_ros2.{name}")
    ]
    length = "-o", "gr_ros2.packet_len:96"
    rows = tshark(relayed_run, *length, "-Y", "gr_ros2.relayed.hops", "-T", "fields", *whose).splitlines()
    found = set()
    for src, origins, hops in (row.split("\t") for row in rows):
        found |= {(int(src), *map(int, pair)) for pair in zip(origins.split(","), hops.split(","), strict=True)}
    assert {(2, 1, 1), (3, 1, 2), (3, 4, 1), (2, 4, 2)} <= found
    assert all(hops == abs(src - origin) for src, origin, hops in found)
    assert not tshark(relayed_run, *length, "-Y", "_ws.expert")


def test_a_capture_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no-such-folder"):
        PacketCapture(tmp_path / "no-such-folder" / "x.pcapng")


def test_the_command_prints_and_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    assert run(["wireshark"]) == 0
    assert capsys.readouterr().out.strip() == str(DISSECTOR)
    assert run(["wireshark", "--install"]) == 0
    installed = Path(capsys.readouterr().out.strip())
    assert installed.read_text() == DISSECTOR.read_text()
    if shutil.which("tshark"):
        folders = subprocess.run(["tshark", "-G", "folders"], capture_output=True, text=True, check=True).stdout
        assert str(installed.parent) in folders
