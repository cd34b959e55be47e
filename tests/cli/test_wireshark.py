"""The dissector in a real tshark: the vectors, refusals by name, and captures of our own."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import pytest

from gr_ros2.cli.main import run
from gr_ros2.cli.pcap import PacketCapture
from gr_ros2.cli.wireshark import DISSECTOR
from gr_ros2.errors import ConfigError, WireError
from gr_ros2.link.events import SentPacket
from gr_ros2.registry import Registry
from gr_ros2.run.scenario import load_scenario
from gr_ros2.wire.v0 import V0

VECTORS = json.loads((Path(__file__).parent.parent / "vectors" / "v0.json").read_text())
FIELDS = ("src_id", "dst_id", "seq", "hop", "qos", "compressed", "encrypted", "entries", "crc")


def capture(path: Path, packets: list[bytes]) -> Path:
    with PacketCapture(path, clock=lambda: 0.0) as writing:
        for number, data in enumerate(packets):
            writing.sender_event(1, SentPacket(data, (), number * 0.5))
            writing.packet_received(data, number * 0.5 + 0.25)
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
    for number, vector in enumerate(VECTORS["invalid"]):
        data = bytes.fromhex(vector["hex"])
        # A dissector does not know packet_len: a packet cut short shows as a wrong CRC.
        with pytest.raises(WireError) as refusal:
            V0.decode(data, len(data))
        path = capture(tmp_path / f"{number}.pcapng", [data])
        assert tshark(path, "-Y", f"gr_ros2.refused.{refusal.value.kind}").count("\n") == 2, vector["name"]


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


def test_our_own_decoder_reads_the_capture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    vector = VECTORS["valid"][0]
    path = capture(tmp_path / "own.pcapng", [bytes.fromhex(vector["hex"])])
    assert run(["packet", "decode", "--packet-len", str(vector["packet_len"]), str(path)]) == 0
    assert capsys.readouterr().out.count("CRC ok") == 2


def test_a_run_captures_every_packet_at_both_ends(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    memory = ["--set", "ros_source.middleware=memory", "--set", "ros_sink.middleware=memory"]
    from gr_ros2.run.runner import REGISTRY_FILE

    path = tmp_path / "run.pcapng"
    command = ["run", "paper-direct", "--duration", "0.5", "--out", str(tmp_path / "out"), "--pcap", str(path)]
    assert run([*command, *memory]) == 0
    packets = json.loads((tmp_path / "out" / "result.json").read_text())["packets"]
    assert (tmp_path / "out" / REGISTRY_FILE).read_bytes() == Path(load_scenario("paper-direct").registry).read_bytes()
    capsys.readouterr()
    assert run(["packet", "decode", str(path)]) == 0
    assert capsys.readouterr().out.count("CRC ok") == packets["sent"] + packets["received"] > 0


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
