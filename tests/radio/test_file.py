"""SigMF recordings: what is sent is written, what is written is received again."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gnuradio import blocks, gr

from gr_ros2.core.errors import ConfigError, RadioError
from gr_ros2.link.events import ReceiverEvent, SenderEvent, SentPacket
from gr_ros2.radio.bursts import BurstCutter
from gr_ros2.radio.radio import Radio
from gr_ros2.radio.robot_link import RobotLink
from gr_ros2.radio.sigmf import SigmfRecorder, SigmfRecording, read_recording
from tests.radio.robots import RATE, Robot, config
from tests.waiting import PATIENCE_S, wait_for


def sent_recording(path: Path, phy: str = "psk", count: int = 10) -> list[bytes]:
    """Make a recording of so many messages; returns them."""
    modem = {"name": phy, "sample_rate": RATE, "options": {"lengths": "fixed"}}
    with Robot(1, {"name": "file", "write": str(path)}, phy=modem, repair="off") as robot:
        said = robot.say(*range(count))
        wait_for(lambda: robot.silent, "all to be sent")
        samples = robot.link.source.stats()["packets"] * robot.link.phy.airtime_samples()
        wait_for(lambda: robot.link.front_end.sink.nitems_read(0) >= samples, "all to be written")
    assert Path(f"{path}.sigmf-data").stat().st_size >= 8 * samples  # another hello may have left
    return said


class Sent:
    """The bytes of each packet that left, and which of them is the first with a message of the registry."""

    def __init__(self) -> None:
        self.lengths: list[int] = []
        self.command: int | None = None

    def sender_event(self, _src_id: int, event: SenderEvent) -> None:
        if isinstance(event, SentPacket):
            if self.command is None and any(entry.topic_id == 0 for entry in event.entries):
                self.command = len(self.lengths)
            self.lengths.append(len(event.data))

    def receiver_event(self, _event: ReceiverEvent, _at: float) -> None:
        """Nothing is received."""


def metadata(path: Path) -> dict[str, Any]:
    values: dict[str, Any] = json.loads(Path(f"{path}.sigmf-meta").read_text())
    return values


@pytest.mark.parametrize("phy", ["psk", "gfsk", "ofdm"])
def test_what_was_sent_is_received_again(tmp_path: Path, phy: str) -> None:
    said = sent_recording(tmp_path / "sent", phy)
    replay = {"name": "file", "read": str(tmp_path / "sent.sigmf-meta")}
    modem = {"name": phy, "sample_rate": RATE, "options": {"lengths": "fixed"}}
    with Robot(2, replay, hears=(1,), phy=modem) as robot:
        wait_for(lambda: robot.link.finished and len(robot.heard) == len(said), "the end of the recording")
        assert robot.heard == said
        assert (
            robot.link.stats()["uptime_s"] > metadata(tmp_path / "sent")["annotations"][-1]["core:sample_start"] / RATE
        )


def test_a_link_that_is_stopped_at_once_has_recorded_what_has_passed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The recorder gets nothing before the link stops: until then GNU Radio holds all samples."""
    stopping, work, drain = threading.Event(), SigmfRecorder.work, Radio.drain

    def held(recorder: SigmfRecorder, inputs: list[Any], outputs: list[Any]) -> int:
        stopping.wait(PATIENCE_S)
        return work(recorder, inputs, outputs)

    def released(radio: Radio) -> None:
        stopping.set()
        drain(radio)

    monkeypatch.setattr(SigmfRecorder, "work", held)
    monkeypatch.setattr(Radio, "drain", released)
    fixed = {"name": "psk", "sample_rate": RATE, "options": {"lengths": "fixed"}}
    with Robot(1, {"name": "file", "write": str(tmp_path / "sent")}, phy=fixed, repair="off") as robot:
        robot.say(*range(10))
        wait_for(lambda: robot.silent, "all to pass")
        robot.link.transmit(on=False)
        samples = robot.link.stats()["packets"]["out"] * robot.link.phy.airtime_samples()
    assert samples > 0
    assert len(read_recording(tmp_path / "sent")[1]) == samples


def test_a_recording_is_sigmf(tmp_path: Path) -> None:
    sigmf = pytest.importorskip("sigmf", reason="needs sigmf, see requirements-dev.txt")
    sent_recording(tmp_path / "sent")
    whole = sigmf.sigmffile.fromfile(str(tmp_path / "sent"))
    whole.validate()
    _, samples = read_recording(tmp_path / "sent")
    assert np.array_equal(whole.read_samples(), samples)
    assert whole.get_global_field("core:sample_rate") == RATE
    annotations = whole.get_annotations()
    burst = annotations[0]["core:sample_count"]
    assert [entry["core:sample_start"] for entry in annotations] == list(range(0, len(samples), burst))


def test_version_1_sends_a_command_in_the_air_that_it_needs(tmp_path: Path) -> None:
    """Issue: a command of 13 B takes at most 45 % of the air of 64 B with `lora` at factor 9."""
    sent = Sent()
    phy = {"name": "lora", "sample_rate": RATE, "options": {"spreading_factor": 9}}
    settings: dict[str, Any] = {"state": str(tmp_path / "state"), "phy": phy}
    settings |= {"repair": "off", "compression": False}
    front_end = {"name": "file", "write": str(tmp_path / "sent")}
    with Robot(1, front_end, observer=sent, **settings) as robot:
        wait_for(lambda: robot.silent and len(sent.lengths) >= 2, "the robot to have announced its topics")
        robot.publish(bytes([0, 1, 0, 0, *range(9)]))
        wait_for(lambda: sent.command is not None, "the command to leave")
        airtime = robot.link.phy.airtime_samples
        longest = airtime()
        # A burst is annotated when it is written, which is later than it is sent.
        wait_for(
            lambda: robot.link.front_end.sink.nitems_read(0) == sum(map(airtime, list(sent.lengths))),
            "all to be written",
        )
    bursts = [entry["core:sample_count"] for entry in metadata(tmp_path / "sent")["annotations"]]
    assert sent.command is not None
    assert bursts == list(map(airtime, sent.lengths))[: len(bursts)]
    assert bursts[sent.command] <= 0.45 * longest
    assert robot.link.front_end.airtime(sent.lengths[sent.command]) * RATE == bursts[sent.command]


def test_any_link_can_record_what_it_receives(tmp_path: Path) -> None:
    with Robot(1, {"name": "sim"}, hears=(1,), record=str(tmp_path / "heard"), repair="off") as robot:
        said = robot.say(*range(5))
        wait_for(lambda: len(robot.heard) == len(said), "every message")
    about, samples = read_recording(tmp_path / "heard")
    assert (about.sample_rate, about.frequency) == (RATE, None)
    assert "psk" in about.description
    assert len(samples) > 25 * 1000
    with Robot(2, {"name": "file", "read": str(tmp_path / "heard"), "speed": 0}, hears=(1,)) as robot:
        wait_for(lambda: len(robot.heard) == len(said), "the recording")
        assert robot.heard == said


def test_a_recording_that_is_repeated_comes_again(tmp_path: Path) -> None:
    # More than the 64 packets among which a receiver knows one that comes twice.
    said = sent_recording(tmp_path / "sent", count=20)
    replay = {"name": "file", "read": str(tmp_path / "sent"), "repeat": True, "speed": 0}
    fixed = {"name": "psk", "sample_rate": RATE, "options": {"lengths": "fixed"}}
    with Robot(2, replay, hears=(1,), phy=fixed) as robot:
        wait_for(lambda: robot.link.stats()["packets"]["in"] > 6 * len(said), "more than two rounds")
        assert robot.heard == said, "who hears a packet again takes it for a repetition"
        assert not robot.link.finished


def test_a_recording_cut_off_by_a_kill_is_still_one(tmp_path: Path) -> None:
    recorder = SigmfRecorder(tmp_path / "cut", SigmfRecording(RATE, 433e6), BurstCutter(4, tagged=False))
    graph = gr.top_block()
    graph.connect(blocks.vector_source_c(list(range(8))), recorder)
    graph.run()
    with Path(tmp_path / "cut.sigmf-data").open("ab") as data:
        data.write(b"torn")
    about, samples = read_recording(tmp_path / "cut")
    assert (about.frequency, samples.tolist()) == (433e6, list(range(8)))
    recorder.close()
    recorder.close()
    assert len(metadata(tmp_path / "cut")["annotations"]) == 2


def test_samples_that_are_no_numbers_are_zeros_and_counted(tmp_path: Path) -> None:
    said = sent_recording(tmp_path / "sent")
    data = tmp_path / "sent.sigmf-data"
    samples = np.fromfile(data, "<c8")
    bad = np.array([np.nan, np.inf, 1j * np.nan, complex(1, -np.inf)], "<c8")
    np.concatenate([bad, samples]).tofile(data)
    fixed = {"name": "psk", "sample_rate": RATE, "options": {"lengths": "fixed"}}
    with Robot(2, {"name": "file", "read": str(tmp_path / "sent")}, hears=(1,), phy=fixed) as robot:
        wait_for(lambda: robot.link.finished and len(robot.heard) == len(said), "the end of the recording")
        assert robot.heard == said
        assert robot.counters()["not_finite"] == len(bad)


RECORDED = {"core:datatype": "cf32_le", "core:sample_rate": 1e6, "core:version": "1.0.0"}


@pytest.mark.parametrize(
    ("about", "captures", "says"),
    [
        ({}, ["x"], "captures are no list of objects"),
        ({}, {"a": 1}, "captures are no list of objects"),
        ({}, 3, "no SigMF metadata"),
        ({}, [{}, {"core:header_bytes": 80}], "core:header_bytes = 80: .* without core:header_bytes"),
        ({"core:trailing_bytes": 3}, [], "core:trailing_bytes = 3: .* without core:trailing_bytes"),
        ({"core:dataset": "other.bin"}, [], "core:dataset = 'other.bin': .* without core:dataset"),
        ({"core:metadata_only": True}, [], "core:metadata_only = True"),
        ({"core:sample_rate": float("nan")}, [], "core:sample_rate = nan: set a number in Hz"),
        ({"core:sample_rate": 0}, [], "core:sample_rate = 0: set a number in Hz"),
        ({"core:sample_rate": "1e6"}, [], "core:sample_rate = '1e6': set a number in Hz"),
        ({"core:sample_rate": None}, [], "core:sample_rate = None: set a number in Hz"),
        ({}, [{"core:frequency": "100 MHz"}], "core:frequency = '100 MHz': set a number in Hz"),
        ({}, [{"core:frequency": float("inf")}], "core:frequency = inf: set a number in Hz"),
        ({"core:extensions": [{"name": "multichannel", "version": "1.0.0", "optional": False}]}, [], "multichannel"),
        ({"core:extensions": [{"name": "ntia-core", "version": "2.0.0"}]}, [], "core:extensions has .*ntia-core"),
        ({"core:extensions": ["antenna"]}, [], "core:extensions has 'antenna'"),
        ({"core:num_channels": 2}, [], "datatype 'cf32_le', channels 2; only cf32_le of one channel"),
    ],
)
def test_metadata_that_cannot_be_honoured_are_refused_in_one_line(
    tmp_path: Path, about: dict[str, Any], captures: Any, says: str
) -> None:
    whole = {"global": RECORDED | about, "captures": captures, "annotations": []}
    (tmp_path / "in.sigmf-meta").write_text(json.dumps(whole))
    (tmp_path / "in.sigmf-data").write_bytes(bytes(800))
    with pytest.raises(ConfigError, match=rf"^recording .*in\.sigmf-meta: .*{says}") as caught:
        read_recording(tmp_path / "in")
    assert "\n" not in str(caught.value)


def test_metadata_of_others_that_can_be_honoured(tmp_path: Path) -> None:
    captures = [{"core:sample_start": 0, "core:header_bytes": 0, "core:frequency": 433000000}, {"core:sample_start": 9}]
    extensions = [{"name": "antenna", "version": "1.0.0", "optional": True}]
    about = {"core:sample_rate": 1000000, "core:trailing_bytes": 0, "core:extensions": extensions}
    whole = {"global": RECORDED | about, "captures": captures}
    (tmp_path / "in.sigmf-meta").write_text(json.dumps(whole))
    (tmp_path / "in.sigmf-data").write_bytes(bytes(800))
    found, samples = read_recording(tmp_path / "in")
    assert (found.sample_rate, found.frequency, len(samples)) == (1e6, 433e6, 100)


def test_an_empty_recording_ends_at_once(tmp_path: Path) -> None:
    SigmfRecorder(tmp_path / "empty", SigmfRecording(RATE)).close()
    with Robot(2, {"name": "file", "read": str(tmp_path / "empty")}) as robot:
        wait_for(lambda: robot.link.finished, "the end")


def test_what_cannot_be_written_is_counted(tmp_path: Path) -> None:
    recorder = SigmfRecorder(tmp_path / "full", SigmfRecording(RATE))
    recorder.close()
    recorder.work([np.zeros(5, np.complex64)], [])
    assert recorder.failed == 5


def test_wrong_recordings_are_named(tmp_path: Path) -> None:
    sent_recording(tmp_path / "sent")

    def refused(options: dict[str, Any], said: str, **values: Any) -> None:
        with pytest.raises((ConfigError, RadioError), match=said):
            RobotLink(config(2, {"name": "file", **options}, **values))

    refused({}, "write and read are both empty")
    refused({"read": str(tmp_path / "none")}, "none.sigmf-meta: No such file")
    refused({"write": str(tmp_path / "sent")}, "there is one already")
    refused({"write": str(tmp_path / "no" / "where")}, "cannot be written")
    refused({"read": str(tmp_path / "sent")}, "set phy.sample_rate", phy={"name": "psk", "sample_rate": 1e6})
    meta = tmp_path / "sent.sigmf-meta"
    about = metadata(tmp_path / "sent")
    for content, said in (
        ("nonsense", "no SigMF metadata"),
        ("{}", "no SigMF metadata"),
        ("[]", "no SigMF metadata"),
        (json.dumps({**about, "global": {**about["global"], "core:datatype": "ci16_le"}}), "only cf32_le"),
    ):
        meta.write_text(content)
        refused({"read": str(meta)}, said)
