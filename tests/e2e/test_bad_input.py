"""Bad input: a clear line and exit status 2, or a counted drop; and nothing else is lost."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pmt
import pytest
from gnuradio import gr

from gr_ros2.cli import main as command
from gr_ros2.middleware.dds import DdsMiddleware
from gr_ros2.paper import RosSink, RosSource
from gr_ros2.settings.registry import Registry
from gr_ros2_lab.run.runner import run_scenario
from tests.domains import free_domains
from tests.e2e.support import check_books, on_free_domains, scenario, set_options
from tests.gr.ends import link
from tests.gr.probe import Probe, pdu
from tests.middleware.support import RELIABLE, STRING, message, same
from tests.waiting import wait_for

PACKET_LEN = 64
TOO_LONG = PACKET_LEN + 1, 5000


def files(folder: Path) -> dict[str, str]:
    """Files that are wrong, by what they are to be."""
    for name, data in {
        "damaged.mcap": b"\x89MCAP0\r\nnot at all",
        "empty.mcap": b"",
        "text.db3": b"not a database",
        "columns.csv": b"odom,nav_msgs/Odometry,latency\n",
        "twice.csv": b"odom,nav_msgs/Odometry\nodom,nav_msgs/Odometry\n",
        "seventeen.csv": b"".join(b"t%d,std_msgs/String\n" % number for number in range(17)),
        "type.csv": b"odom,Odometry\n",
        "key.yaml": b"registry: odom.csv\ncolour: red\n",
        "list.yaml": b"- 1\n",
        "half.yaml": b"registry: {odom",
    }.items():
        (folder / name).write_bytes(data)
    return {"f": str(folder)}


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("run nonsense", "scenario 'nonsense' is neither a file nor built in; built in are "),
        ("run {f}/key.yaml", "unknown key colour; known are "),
        ("run {f}/list.yaml", "expected keys and values, found list"),
        ("run {f}/half.yaml", "no YAML"),
        ("run paper-direct --set registry={f}/columns.csv", "columns.csv:1: 3 columns where 2 were expected"),
        (
            "run paper-direct --set registry={f}/twice.csv",
            "twice.csv:2: duplicate topic 'odom'; it stands first in line 1",
        ),
        (
            "run paper-direct --set registry={f}/seventeen.csv",
            "topic 17, 't16': the paper's packets carry 16 topics; leave some out, or take a ROS Link",
        ),
        ("run paper-direct --set registry={f}/type.csv", "type.csv:1: topic 'odom': malformed type 'Odometry'"),
        ("run paper-direct --set registry={f}/nowhere.csv", "nowhere.csv': no such file"),
        ("run paper-direct --set source=bag:{f}/nowhere", "nowhere"),
        ("run paper-direct --set source=bag:{f}/damaged.mcap", "damaged.mcap"),
        ("run paper-direct --set source=bag:{f}/empty.mcap", "empty.mcap"),
        ("run paper-direct --set source=bag:{f}/text.db3", "text.db3"),
        ("run paper-direct --set source=bag:", "the path of the bag is missing; write bag:PATH"),
        ("run paper-direct --set source=radio", "source = 'radio': write sim or bag:PATH"),
        ("run paper-direct --set colour=red", "unknown key colour"),
        ("run paper-direct --set colour=red", "unknown key colour; known are name, phy, "),
        ("run paper-direct --set packet_len=13", "packet_len = 13"),
        ("run paper-direct --set paper.min_fragment=60", "min_fragment = 60 does not fit packet_len = 64"),
        ("run paper-direct --set phy.name=smoke", "phy.name = 'smoke': no such phy; known are direct, "),
        ("run paper-direct --set phy.options.colour=red", "phy direct: unknown key colour"),
        ("run paper-direct --set topics=[scan]", "topic 'scan' is not in the registry; it has odom"),
        ("run paper-direct --set robots.0.robot=/robot", "the name has no digits; write the robot's number"),
        ("run paper-direct --set graph.domain_id=233", "graph.domain_id = 233"),
        ("run paper-direct --set hop", "write key=value"),
        (
            "run paper-direct --set channel.snr_db=20",
            "channel.snr_db = 20.0: phy direct has no samples for it to act on",
        ),
        ("run paper-direct --set channel.doppler_hz=5", "channel.doppler_hz = 5.0: phy direct has no samples"),
        ("run paper-ofdm --set channel.snr_db=500", "channel.snr_db = 500"),
        (
            "run paper-ofdm --set channel.doppler_hz=60000",
            "channel.doppler_hz = 60000: phy ofdm has 100000 samples/s; at",
        ),
        ("run paper-direct --set channel.outages=[[5,3]]", "outages: [5, 3] ends before it begins"),
        ("run paper-direct --set channel.burst_loss=0.1", "channel.burst_loss = 0.1"),
        ("run two-way --set robots.1.robot=/robot_1", "two are robot 1; give each a number of its own"),
        ("run paper-direct --repetitions 0", "'--repetitions': 0 is not in the range x>=1"),
        ("run paper-direct --duration 0", "duration_s = 0: the simulator has no end"),
        ("packet demo", "No such command 'demo'; see gr-ros2 packet --help"),
        ("registry run", "No such command 'run'; see gr-ros2 registry --help"),
        ("registry check {f}/twice.csv", "twice.csv:2: duplicate topic"),
        ("registry check {f}/nowhere.csv", "nowhere.csv: cannot be read"),
    ],
)
def test_wrong_input_is_one_line_on_stderr_and_status_2(
    words: str, says: str, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = [word.format(**files(tmp_path)) for word in words.split(" ", 4)]
    if arguments[0] == "run":
        first = [*arguments[:2], "--out", str(tmp_path / "out"), *set_options(on_free_domains())]
        arguments = [*first, *arguments[2:]]
    assert command.run(arguments) == command.BAD_INPUT
    shown = capfd.readouterr()
    assert shown.err.startswith("gr-ros2: ")
    assert shown.err.count("\n") == 1
    assert says in shown.err
    assert not (tmp_path / "out" / "result.json").exists()


def test_results_of_another_run_are_not_overwritten(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    arguments = ["run", "paper-direct", "--duration", "0.3", "--out", str(tmp_path), *set_options(on_free_domains())]
    assert command.run(arguments) == 0
    before = (tmp_path / "result.json").read_bytes()
    capfd.readouterr()
    assert command.run(arguments) == command.BAD_INPUT
    assert "holds a run already; choose another folder" in capfd.readouterr().err
    assert (tmp_path / "result.json").read_bytes() == before


def test_a_message_of_more_than_255_entries_is_counted_and_the_others_pass(tmp_path: Path) -> None:
    # A map of 100 x 100 cells needs 255 entries of 40 bytes; the odometry beside it does not notice.
    too_small = scenario("paper-direct", "registry=table4", "topics=[odom, map]", "packet_len=40", duration_s=1.5)
    result = run_scenario(too_small, tmp_path).result
    check_books(result)
    books = {topic.topic: topic.ledger for topic in result.topics}
    assert books["/robot_1/map"] == {"too_large": 1}
    assert books["/robot_1/odom"]["delivered"] > 20
    assert set(books["/robot_1/odom"]) <= {"delivered", "in_flight"}, "where the computer is late as the run ends"


def garbage(seed: int, good: bytes) -> Iterator[object]:
    """What a broken PHY might hand over, valid packets with flipped bits among it."""
    rng = random.Random(seed)
    yield from (pmt.PMT_T, pmt.PMT_NIL, pmt.from_long(3), pmt.intern("pdu"), pmt.make_dict())
    yield pmt.cons(pmt.make_dict(), pmt.intern("no vector"))
    yield pmt.cons(pmt.PMT_NIL, pmt.init_f32vector(2, [1.0, 2.0]))
    yield pmt.cons(pmt.make_dict(), pmt.PMT_NIL)
    for length in (0, 1, 13, PACKET_LEN - 1, *TOO_LONG):
        yield pdu(rng.randbytes(length))
    for _ in range(200):
        yield pdu(rng.randbytes(PACKET_LEN))
        flipped = bytearray(good)
        for bit in rng.sample(range(8 * PACKET_LEN), rng.choice((1, 2))):
            flipped[bit // 8] ^= 1 << bit % 8
        yield pdu(bytes(flipped))


@pytest.mark.parametrize("version", [0, 1])
def test_garbage_from_the_phy_is_counted_and_nothing_else_is_lost(version: int) -> None:
    sending, receiving = free_domains()
    registry = Registry.from_rows({"chatter": STRING})
    with ExitStack() as stack:
        graphs = [
            stack.enter_context(DdsMiddleware(domain_id=domain, node_name=name, localhost_only=True))
            for domain, name in ((sending, "robot"), (sending, "source"), (receiving, "sink"), (receiving, "listener"))
        ]
        heard: list[bytes] = []
        common = {"packet_len": PACKET_LEN, "registry": registry}
        sends = {"middleware": graphs[1], "robot": 1, "graph_namespace": "", "queue_depth": 0, "graph_depth": 0}
        takes = {"middleware": graphs[2], "publish_depth": 1000}
        if version:
            ends = [link(direction="send", **sends, **common)]
            ends.append(link(direction="receive", robot=2, **takes, **common))
            source, sink = ends[0].source, ends[1].sink
        else:
            source, sink = ends = [RosSource(**sends, **common), RosSink(**takes, **common)]
        for end in ends:
            stack.callback(end.close)
        sink.outputs.announce(1, [0])
        broken, tap = Probe(), Probe()
        flowgraph = gr.top_block()
        flowgraph.msg_connect(source, "pdus", sink, "pdus")
        flowgraph.msg_connect(source, "pdus", tap, "pdus")
        flowgraph.msg_connect(broken, "pdus", sink, "pdus")
        publisher = graphs[0].advertise("/chatter", STRING, RELIABLE)
        listener = graphs[3].subscribe("/rx_robot_1/chatter", STRING, RELIABLE, heard.append)
        wait_for(lambda: publisher.matched() and listener.matched() and source.matched, "both graphs to match")
        flowgraph.start()
        stack.callback(flowgraph.wait)
        stack.callback(flowgraph.stop)
        publisher.publish(message(0, 200))
        wait_for(lambda: heard and tap.packets, "the first message and its packets")
        sent = [message(0, 200)]
        thrown = list(garbage(5, tap.packets[0]))
        for number, bad in enumerate(thrown, start=1):
            broken.post_message(bad)
            publisher.publish(message(number, 200))
            sent.append(message(number, 200))
        wait_for(lambda: len(heard) == len(sent), f"{len(sent)} messages")
        wait_for(lambda: sink.handled == len(thrown) + len(tap.messages), "all of the garbage")
        wait_for(lambda: sink.stats()["packets"] == len(tap.messages), "every packet to be counted, and nothing else")
        stats = sink.stats()
    assert all(same(got, one, 3) for got, one in zip(heard, sent, strict=True))
    refused = [*stats["rejected"].values(), *stats["dropped"].values()]
    counted = sum(refused) + stats["not_a_pair"] + stats["not_u8"]
    further = sum(-(-length // PACKET_LEN) - 1 for length in TOO_LONG)  # these are cut into packets
    assert counted == len(thrown) + further
    assert stats["joined"] == len(TOO_LONG)
    if not version:
        reasons = {"length", "crc", "version", "no_entries", "entry_bounds", "pad", "total", "index"}
        assert set(stats["rejected"]) <= reasons
        assert stats["rejected"]["length"] == 6
    assert stats["handler_failed"] == stats["publish_failed"] == 0
