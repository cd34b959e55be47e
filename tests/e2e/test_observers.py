"""Whoever looks on at a link, and whatever is written while it runs, neither stops nor slows it nor alters a figure."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest

from gr_ros2.cli import main as command
from gr_ros2.core.errors import ConfigError, CrcError, RunError
from gr_ros2.link.events import PacketId, ReceiverEvent, Rejected, SenderEvent
from gr_ros2.observe import observers as run_observers
from gr_ros2.observe.capture import PacketCapture
from gr_ros2.observe.observers import LiveRun
from gr_ros2.radio.sigmf import SigmfRecorder, SigmfRecording, read_recording
from gr_ros2_lab.record.ledger import Ledger
from gr_ros2_lab.record.result import Result, read_result
from gr_ros2_lab.run.outcome import DELIVERED_BAG
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import Scenario, load_scenario
from tests.e2e.support import COMMAND, check_complete
from tests.programs import run_program
from tests.radio.robots import ROOT, Robot, link_command
from tests.waiting import wait_for

MEMORY = ("graph.middleware=memory",)
FULL = "No space left on device"
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="mounts a disk or limits shared memory: run as root")


@contextmanager
def disk(folder: Path, options: str) -> Iterator[Path]:
    """A disk of its own in a folder, made for it."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)


def scenario(duration_s: float, *overrides: str) -> Scenario:
    return load_scenario("paper-direct", [*MEMORY, *overrides], duration_s=duration_s)


def fill_disk(file: Path) -> bool:
    """Let every file of this process that is open at a path be on a full disk from now on; whether there is one."""
    filled = False
    for entry in Path("/proc/self/fd").iterdir():
        try:
            if entry.readlink() == file:
                with Path("/dev/full").open("wb") as full:
                    os.dup2(full.fileno(), int(entry.name))
                filled = True
        except OSError:  # it has been closed in the meantime
            continue
    return filled


@contextmanager
def filled_when(file: Callable[[], Path | None], size: int) -> Iterator[None]:
    """Within the block the disk of a file becomes full as soon as so much is in it."""
    over = threading.Event()

    def watch_it() -> None:
        while not over.wait(0.002):
            path = file()
            if path is not None and path.exists() and path.stat().st_size > size and fill_disk(path):
                return

    watching = threading.Thread(target=watch_it)
    watching.start()
    try:
        yield
    finally:
        over.set()
        watching.join()


class RecordingObserver:
    """Does nothing, which a test changes."""

    name = "observer"
    instruments = False

    def __init__(self, on_packet: Callable[[], object] = lambda: None) -> None:
        self.on_packet = on_packet
        self.heard = 0
        self.result: Result | None = None

    def run_started(self, run: LiveRun) -> None:
        """Nothing."""

    def run_ended(self, result: Result | None) -> None:
        self.result = result

    def sender_event(self, src_id: int, event: SenderEvent) -> None:  # noqa: ARG002
        self.on_packet()
        self.heard += 1

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:  # noqa: ARG002
        self.on_packet()


def fail() -> None:
    raise ValueError("observer")


@pytest.mark.parametrize("passing", ["real", "packets", "samples"])
def test_one_that_raises_changes_no_figure(passing: str, caplog: pytest.LogCaptureFixture) -> None:
    bad, good = RecordingObserver(fail), RecordingObserver()
    result = run_scenario(scenario(1.0, f"time={passing}"), observers=[bad, good]).result
    check_complete(result)
    (line,) = result.incomplete
    assert line.startswith("observer: ended (ValueError: observer); ")
    assert int(line.split("; ")[1].split()[0]) > good.heard > result.packets["sent"]
    assert bad.heard == 0
    assert bad.result is good.result is result
    assert [record.message for record in caplog.records if "observer" in record.message] == [
        "observer: ended (ValueError: observer); the link goes on without it"
    ]


class Fails(RecordingObserver):
    """Fails at the beginning and at the end of a run."""

    def run_started(self, run: LiveRun) -> None:  # noqa: ARG002
        fail()

    def run_ended(self, result: Result | None) -> None:  # noqa: ARG002
        fail()


@pytest.mark.parametrize("passing", ["real", "packets"])
def test_one_that_raises_when_a_run_begins_and_ends(passing: str) -> None:
    result = run_scenario(scenario(0.5, f"time={passing}"), observers=[Fails()]).result
    check_complete(result)
    assert result.incomplete[0].startswith("observer: ended (ValueError: observer); ")


def test_a_late_one_that_raises_is_left_out_alone() -> None:
    audience, late = run_observers.LateObservers(), Fails()
    invited: list[bool] = []

    def invite() -> None:
        if not invited:
            invited.append(True)
            audience.invite(late)

    result = run_scenario(scenario(0.5), observers=[RecordingObserver(invite), audience]).result
    check_complete(result)
    (line,) = result.incomplete
    assert line.startswith("observer: ended (ValueError: observer); ")


def test_one_that_hangs_holds_nobody_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_observers, "_PATIENCE_S", 0.2)
    gate = threading.Event()
    bad, good = RecordingObserver(gate.wait), RecordingObserver()
    try:
        result = run_scenario(scenario(1.0), observers=[bad, good]).result
        assert bad.heard == 0, "the whole run has gone by while it hung"
    finally:
        gate.set()
    check_complete(result)
    assert result.topics[0].latency_s.p50 is not None
    (line,) = result.incomplete
    assert line.startswith("observer: ended (it has not come back for 0.2 s); ")
    assert int(line.split("; ")[1].split()[0]) >= good.heard


def test_one_that_is_slow_is_left_behind_within_a_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_observers, "_HELD_BYTES", 200_000)
    slow, good = RecordingObserver(lambda: time.sleep(0.01)), RecordingObserver()
    monkeypatch.setattr(run_observers, "_PATIENCE_S", 60.0)
    result = run_scenario(scenario(1.0), observers=[slow, good]).result
    check_complete(result)
    (line,) = result.incomplete
    assert line.startswith("observer: slower than the link; ")
    assert 0 < slow.heard < good.heard


def test_a_recorder_that_fails_ends_the_run_instead_of_making_figures_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    took = Ledger.packet_received

    def fails_later(ledger: Ledger, identity: PacketId) -> int | None:
        if ledger._received > 50:
            raise MemoryError("ledger")
        return took(ledger, identity)

    monkeypatch.setattr(Ledger, "packet_received", fails_later)
    for passing in ("real", "packets"):
        with pytest.raises(RunError, match=r"^Recorder: failed \(MemoryError: ledger\)$"):
            run_scenario(scenario(1.0, f"time={passing}"), tmp_path / passing)
        assert not (tmp_path / passing / "result.json").exists()
    words = [word for override in MEMORY for word in ("--set", override)]
    assert command.run(["run", "paper-direct", "--duration", "1", "--out", str(tmp_path / "c"), *words]) == 1
    assert capsys.readouterr().err.splitlines()[-1] == "gr-ros2: Recorder: failed (MemoryError: ledger)"


# -- files written while it runs ---------------------------------------------------------------------------------


def as_command(out: Path, *options: str, duration_s: float = 2.0) -> int:
    words = [word for override in MEMORY for word in ("--set", override)]
    return command.run(["run", "paper-direct", "--duration", str(duration_s), "--out", str(out), *options, *words])


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("passing", ["real", "packets"])
def test_a_capture_on_a_full_disk_ends_alone(
    passing: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "x.pcapng"
    with filled_when(lambda: path, 20_000):
        duration_s = 2.0 if passing == "real" else 60.0
        assert as_command(tmp_path / "out", "--pcap", str(path), "--set", f"time={passing}", duration_s=duration_s) == 1
    result = read_result(tmp_path / "out")
    check_complete(result)
    (line,) = result.incomplete
    captured = int(line.split(" packets: ")[0].split()[-1])
    assert line.startswith(f"capture {path}: ended (after {captured} packets: {FULL}); ")
    assert 0 < captured < result.packets["sent"] + result.packets["received"]
    assert f"ended (after {captured} packets" in " ".join(capsys.readouterr().out.split())
    assert [record.message for record in caplog.records if "capture" in record.message] == [
        f"capture {path}: ended (after {captured} packets: {FULL}); the link goes on without it"
    ]
    assert "ended (after" in (tmp_path / "out" / "report.html").read_text()
    assert command.run(["packet", "decode", str(path)]) == 0
    assert capsys.readouterr().out.count("CRC ok") == captured  # whole records only


@needs_root
def test_a_capture_on_a_disk_that_takes_half_a_record_ends_with_a_whole_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with disk(tmp_path / "disk", "size=16k") as small:
        capture, noise = PacketCapture(small / "x.pcapng"), Rejected(bytes(61), CrcError("noise"))
        with pytest.raises(RunError, match=FULL):
            for _ in range(1000):
                capture.receiver_event(noise, 0.0)
        packets = capture.packets
        with pytest.raises(RunError, match=FULL):
            capture.receiver_event(noise, 0.0)
        capture.close()
        command.run(["packet", "decode", str(small / "x.pcapng")])
        assert capsys.readouterr().out.count("rejected") == packets > 0


def test_a_capture_that_cannot_begin_is_one_line() -> None:
    with pytest.raises(ConfigError, match=f"--pcap /dev/full: cannot be written .{FULL}"):
        PacketCapture(Path("/dev/full"))


@needs_root
def test_a_bag_on_a_full_disk_costs_the_bag_and_no_figure(tmp_path: Path) -> None:
    with disk(tmp_path / "disk", "size=512k") as out:
        filler = out / "filler"

        class Frees(RecordingObserver):
            """Makes room for the result, once the bag is over."""

            def run_started(self, run: LiveRun) -> None:  # noqa: ARG002
                with filler.open("wb", buffering=0) as file, suppress(OSError):
                    while file.write(bytes(4096)):
                        pass

            def run_ended(self, result: Result | None) -> None:  # noqa: ARG002
                filler.unlink()

        result = run_scenario(scenario(1.0), out, observers=[Frees()]).result
        check_complete(result)
        assert read_result(out).incomplete == result.incomplete
        assert result.counters["listener"] == {"/rx_robot_1/odom": result.topics[0].delivered}
        (line,) = result.incomplete
        said = f"bag {out / DELIVERED_BAG}: cannot be written ({FULL})"
        assert line == f"{said}; any of its {result.topics[0].delivered} messages may be missing"


def test_a_recording_on_a_full_disk_ends_alone(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    heard = SigmfRecorder(tmp_path / "rec", SigmfRecording(1e6, 433e6))
    ramp = np.arange(1000, dtype=np.complex64)
    heard.work([ramp], [])
    wait_for(lambda: (tmp_path / "rec.sigmf-data").stat().st_size == 8000, "the first samples")
    assert fill_disk(tmp_path / "rec.sigmf-data")
    for _ in range(3):
        heard.work([ramp], [])
    heard.stop()
    heard.close()
    heard.close()
    assert heard.failed == 3000
    assert heard.incomplete() == [f"recording {tmp_path / 'rec.sigmf-data'}: 3000 samples are missing ({FULL})"]
    assert sum(FULL in record.message for record in caplog.records) == 1
    about, samples = read_recording(tmp_path / "rec")
    assert (about.sample_rate, samples.tolist()) == (1e6, ramp.tolist())


def test_a_recording_on_a_slow_disk_says_where_samples_are_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gr_ros2.radio.sigmf._HELD_BYTES", 10_000)
    recorder = SigmfRecorder(tmp_path / "rec", SigmfRecording(1e6))
    gate = threading.Event()
    recorder._backlog.offer(0, gate.wait)  # the disk
    for number in range(3):
        recorder.work([np.full(1000, number, np.complex64)], [])
    gate.set()
    recorder.stop()
    recorder.work([np.full(1000, 3, np.complex64)], [])
    recorder.close()
    assert recorder.failed == 2000
    _, samples = read_recording(tmp_path / "rec")
    assert samples.tolist() == [0] * 1000 + [3] * 1000
    captures = json.loads((tmp_path / "rec.sigmf-meta").read_text())["captures"]
    assert [(one["core:sample_start"], one.get("core:global_index", 0)) for one in captures] == [(0, 0), (1000, 3000)]


@needs_root
def test_a_link_that_records_on_a_full_disk_ends_well_and_says_so(tmp_path: Path) -> None:
    SigmfRecorder(tmp_path / "heard", SigmfRecording(1e6)).close()
    np.zeros(100_000, "<c8").tofile(tmp_path / "heard.sigmf-data")
    front_end = {"name": "file", "read": str(tmp_path / "heard"), "repeat": True}
    with disk(tmp_path / "disk", "size=256k") as small:
        data = small / "air.sigmf-data"
        options = ("--duration", "1", "--set", f"record={small / 'air'}")
        done = link_command(tmp_path / "robot.yaml", front_end, 1e6, *options)
        assert done.returncode == 1
        assert done.stderr.splitlines() == [f"recording {data}: ended ({FULL}); the link goes on without it"]
        *_, status, line = done.stdout.splitlines()
        assert status.endswith(" unrecorded")
        assert line.startswith(f"recording {data}: ")
        assert line.endswith(f" samples are missing ({FULL})")
        about, samples = read_recording(small / "air")
        assert about.sample_rate == 1e6
        assert len(samples) > 1000


def test_an_observer_that_fails_does_not_end_a_link(caplog: pytest.LogCaptureFixture) -> None:
    with Robot(1, {"name": "sim"}, hears=(1,), observer=RecordingObserver(fail)) as robot:
        said = robot.say(*range(5))
        wait_for(lambda: robot.heard == said, "what was said")
        assert robot.link.source.stats()["pump_failed"] == robot.link.sink.stats()["handler_failed"] == 0
        (line,) = robot.link.stats()["incomplete"]
    assert line.startswith("observer: ended (ValueError: observer); ")
    assert [record.levelno for record in caplog.records if "observer" in record.message] == [logging.ERROR]


# -- the program around it ---------------------------------------------------------------------------------------


def test_a_link_whose_output_is_on_a_full_disk_goes_on(tmp_path: Path) -> None:
    (tmp_path / "robot.yaml").write_text(
        f"""
        registry: {ROOT / "tests/radio/topics.csv"}
        robot: 1
        graph: {{middleware: memory}}
        phy: {{name: psk, sample_rate: 1e6}}
        """
    )
    words = ["link", str(tmp_path / "robot.yaml"), "--duration", "0.5", "--pcap", str(tmp_path / "x.pcapng")]
    with Path("/dev/full").open("w") as full:
        done = run_program([*COMMAND, *words], stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 1
    lines = done.stderr.splitlines()
    assert lines == [
        f"status line: ended ({FULL}); the link goes on without it",
        f"gr-ros2: a file or the output: {FULL}",
    ]


def test_a_program_that_nobody_can_find_runs_all_the_same(tmp_path: Path) -> None:
    runtime = tmp_path / ("long" * 40)  # too long for a socket's address
    runtime.mkdir()
    env = {**os.environ, "XDG_RUNTIME_DIR": str(runtime)}
    done = link_command(tmp_path / "robot.yaml", {"name": "sim"}, 1e6, "--duration", "0.2", env=env)
    assert done.returncode == 0
    assert done.stderr.splitlines() == ["`gr-ros2 dashboard` cannot find this program (AF_UNIX path too long)"]


def test_progress_that_cannot_be_shown_ends_no_run() -> None:
    for passing in ("real", "packets"):

        def full(_progress: object) -> None:
            raise OSError(28, FULL)

        check_complete(run_scenario(scenario(1.0, f"time={passing}"), on_progress=full).result)


@needs_root
def test_a_read_only_disk_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with disk(tmp_path / "disk", "ro") as fixed:
        for passing in ("real", "packets"):
            assert as_command(fixed / "out", "--set", f"time={passing}", duration_s=0.5) == 2
            said = f"gr-ros2: {fixed / 'out'}: cannot be written (Read-only file system); choose another folder"
            assert [line for line in capsys.readouterr().err.splitlines() if line] == [said]


@needs_root
@pytest.mark.parametrize("words", [("run", "paper-ofdm", "--set", "time=samples"), ("losses", "paper-ofdm")])
def test_no_shared_memory_left_is_one_line(words: tuple[str, ...], tmp_path: Path) -> None:
    shell = 'echo 1 > /proc/sys/kernel/shmmni; exec "$@"'
    arguments = [*words, "--duration", "0.5"] if words[0] == "run" else [*words, "--packets", "10"]
    done = subprocess.run(
        ["unshare", "--ipc", "bash", "-c", shell, "-", *COMMAND, *arguments, "--out", str(tmp_path / "out")],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "XDG_CACHE_HOME": str(tmp_path)},
    )
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stderr
    last = done.stderr.splitlines()[-1]
    assert last.removeprefix("gr-ros2: ").removeprefix("phy ofdm: ").startswith("GNU Radio gets no shared memory for")
