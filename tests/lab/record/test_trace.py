"""The tables of a run: what goes in comes out, and nothing else is taken for a table."""

from __future__ import annotations

import csv
import random
import shutil
import threading
import tracemalloc
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pa_parquet
import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.link.events import Accepted, Delivered, SentEntry, SentPacket
from gr_ros2.wire.v0 import EntryV0, PacketV0
from gr_ros2_lab.record.ledger import Ledger
from gr_ros2_lab.record.trace import PacketLog, Track, make_trace, read_trace, write_trace
from tests.lab.record.runs import DURATION_S, IMU, IN_FLIGHT, LOST, ODOM, TOO_LARGE, UNSENT, empty_trace, make_run

NAMES = ["messages", "packets", "paths"]


def test_messages_come_back_with_their_fate(tmp_path: Path) -> None:
    make_run(tmp_path)
    odom, imu = read_trace(tmp_path).messages()
    assert (odom.topic, odom.src_id, imu.topic) == ("/robot_1/odom", 1, "/robot_1/imu")
    assert odom.t_sent == pytest.approx(np.arange(ODOM) / 10)
    fates = {fate: int((odom.fate == fate).sum()) for fate in set(odom.fate)}
    lost = {"lost_fragments": LOST, "too_large": TOO_LARGE, "in_flight": IN_FLIGHT + UNSENT}
    assert fates == {**lost, "delivered": ODOM - sum(lost.values())}
    assert (odom.delivered == (odom.fate == "delivered")).all()
    assert (odom.t_delivered - odom.t_sent)[odom.delivered] == pytest.approx(0.07)
    assert set(odom.size.tolist()) == {odom.size[0]}
    assert len(imu.serial) == IMU
    assert sorted([*odom.serial, *imu.serial]) == list(range(ODOM + IMU))


def test_packets_come_back_with_their_entries(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    packets = read_trace(tmp_path).packets()
    t_sent, t_received = packets.times()
    assert len(t_sent) == run.result.packets["sent"]
    assert int((~np.isnan(t_received)).sum()) == run.result.packets["received"]
    assert (t_received - t_sent)[~np.isnan(t_received)] == pytest.approx(0.05)
    assert len(packets.packet) == len(t_sent) + IMU
    first = packets.packet == 2 * (4 - TOO_LARGE)  # the first packet of the fifth message carries an IMU message too
    assert packets.topic[first].tolist() == ["/robot_1/odom", "/robot_1/imu"]
    assert (packets.index[first].tolist(), packets.total[first].tolist()) == ([0, 0], [2, 1])


def test_paths_come_back(tmp_path: Path) -> None:
    make_run(tmp_path)
    (path,) = read_trace(tmp_path).paths()
    assert (path.topic, path.published_as) == ("/robot_1/odom", "/rx_robot_1/odom")
    assert path.sent[5].tolist() == [5, 2.5]
    assert len(path.received) == ODOM - LOST - TOO_LARGE - IN_FLIGHT - UNSENT


def test_anyone_can_read_the_csv(tmp_path: Path) -> None:
    make_run(tmp_path)
    with open(tmp_path / "messages.csv", newline="") as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == ODOM + IMU
    assert list(lines[0]) == ["topic", "src_id", "serial", "t_sent", "t_delivered", "hops", "size", "fate"]
    assert (lines[0]["t_delivered"], lines[0]["hops"], lines[0]["fate"]) == ("", "", "too_large")
    assert {line["hops"] for line in lines if line["t_delivered"]} == {"0"}
    table = pa_parquet.read_table(tmp_path / "messages.parquet").to_pylist()
    assert [line["fate"] for line in lines] == [line["fate"] for line in table]


def test_a_run_without_messages(tmp_path: Path) -> None:
    write_trace(empty_trace(), tmp_path)
    trace = read_trace(tmp_path)
    assert not list(trace.messages())
    assert not list(trace.paths())
    assert len(trace.packets().times()[0]) == 0


def test_only_whole_files_are_left(tmp_path: Path) -> None:
    make_run(tmp_path)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"result.json", "messages.csv", *(f"{name}.parquet" for name in NAMES)}


@pytest.mark.parametrize("name", NAMES)
def test_a_missing_or_cut_table_is_named(tmp_path: Path, name: str) -> None:
    make_run(tmp_path)
    path = tmp_path / f"{name}.parquet"
    data = path.read_bytes()
    for size in (0, 4, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:size])
        with pytest.raises(ConfigError, match="damaged or half-written") as caught:
            read_trace(tmp_path)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)
    path.unlink()
    with pytest.raises(ConfigError, match=f"{name}.parquet: cannot be read .no such file"):
        read_trace(tmp_path)


def test_flipped_bits_never_end_in_another_error(tmp_path: Path) -> None:
    make_run(tmp_path)
    path = tmp_path / "packets.parquet"
    data = path.read_bytes()
    rng = random.Random(1)
    refused = 0
    for _ in range(200):
        broken = bytearray(data)
        broken[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        path.write_bytes(broken)
        try:
            read_trace(tmp_path).packets()
        except ConfigError:
            refused += 1
    assert refused > 100


def test_tables_of_something_else_are_refused(tmp_path: Path) -> None:
    make_run(tmp_path)
    shutil.copy(tmp_path / "paths.parquet", tmp_path / "packets.parquet")
    with pytest.raises(ConfigError, match=r"packets.parquet: no table of a run \(column 'packet' is missing"):
        read_trace(tmp_path)
    table = pa_parquet.read_table(tmp_path / "messages.parquet")
    pa_parquet.write_table(table.replace_schema_metadata({}), tmp_path / "messages.parquet")
    with pytest.raises(ConfigError, match=r"messages\.parquet: no table of a run .it does not say when"):
        read_trace(tmp_path)


@pytest.mark.parametrize(("name", "column"), [("packets", "total"), ("messages", "fate")])
def test_rows_without_what_each_has_are_refused(tmp_path: Path, name: str, column: str) -> None:
    make_run(tmp_path)
    path = tmp_path / f"{name}.parquet"
    table = pa_parquet.read_table(path)
    place = table.column_names.index(column)
    empty = pa.nulls(table.num_rows, table.schema.field(column).type)
    pa_parquet.write_table(table.set_column(place, table.schema.field(column), empty), path)
    with pytest.raises(ConfigError, match=rf"{name}\.parquet: no table of a run \(column '{column}' has rows without"):
        read_trace(tmp_path)


def test_tables_of_two_runs_are_refused(tmp_path: Path) -> None:
    make_run(tmp_path)
    write_trace(empty_trace(), tmp_path / "other")
    shutil.copy(tmp_path / "other" / "paths.parquet", tmp_path)
    with pytest.raises(ConfigError, match=r"paths\.parquet: of another run"):
        read_trace(tmp_path)


def test_a_folder_with_an_equals_sign_adds_no_column(tmp_path: Path) -> None:
    make_run(tmp_path / "snr=10")
    assert read_trace(tmp_path / "snr=10").t_end == pytest.approx(DURATION_S)


def test_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="cannot be written"):
        write_trace(empty_trace(), tmp_path / "file")


def test_a_packet_costs_numbers_and_no_objects() -> None:
    ledger, log = Ledger(), PacketLog()

    def send(numbers: range) -> None:
        for number in numbers:
            ledger.sender_event(1, Accepted(number, 0, b"x%d" % number, float(number)))
            packet = PacketV0(1, 255, number & 255, 1, (EntryV0(0, number & 255, 0, 1, b""),))
            entry = SentEntry(number, 0, number & 255, 0, 1)
            event = SentPacket(b"", packet, 1, 0, number, 0, (entry,), float(number))
            log.sent(event)
            ledger.sender_event(1, event)
            assert ledger.packet_received(event.identity) == number
            log.received(number, float(number))
            ledger.receiver_event(Delivered(1, 0, b"x%d" % number, 0, number & 255), float(number))

    send(range(5000))
    tracemalloc.start()
    send(range(5000, 25000))
    grown, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert grown / 20000 < 120  # 33 + 34 bytes, and what arrays reserve for growth


def test_a_track_that_grows_is_cut_to_what_is_complete() -> None:
    """Ctrl-C: the tables are made while a position is being added."""
    track = Track()
    track.add(1.0, 2.0, 3.0)
    track.t.append(2.0)
    track.x.append(4.0)
    trace = make_trace(
        [], logs={}, tracks={(1, 0): (track, Track())}, name_of=lambda *_: "/odom", published_as={}, t0=0.0, t_end=3.0
    )
    (path,) = trace.paths()
    assert path.sent.tolist() == [[2.0, 3.0]]


def test_reading_what_grows_disturbs_nobody() -> None:
    track, log, done = Track(), PacketLog(), threading.Event()

    def write() -> None:
        try:
            for number in range(30_000):
                track.add(float(number), 1.0, 2.0)
                packet = PacketV0(1, 255, number & 255, 1, (EntryV0(0, number & 255, 0, 1, b""),) * 2)
                entries = (SentEntry(number, 0, number & 255, 0, 1),) * 2
                log.sent(SentPacket(b"", packet, 1, 0, number, 0, entries, float(number)))
        finally:
            done.set()

    writer = threading.Thread(target=write)
    writer.start()
    while not done.is_set():
        t, xy = track.points()
        assert t.shape == (len(xy),)
        assert len({len(column) for column in log.columns(1, str, 0.0).values()}) == 1
    writer.join()
    assert len(track.points()[0]) == 30_000 and len(log.columns(1, str, 0.0)["packet"]) == 60_000
