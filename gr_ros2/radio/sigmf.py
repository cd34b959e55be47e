"""SigMF recordings: samples in `NAME.sigmf-data`, metadata in `NAME.sigmf-meta` (sigmf.org, version 1.0.0).

Invariants: samples are cf32_le, one channel. A recording whose process was killed is still valid, with the metadata of
its start. A recording never overwrites another one. A separate thread writes to the disk. An error of writing ends only
the recording.
"""

from __future__ import annotations

import json
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np
from gnuradio import gr
from numpy.typing import NDArray

from gr_ros2 import __version__
from gr_ros2.core.backlog import Backlog
from gr_ros2.core.errors import ConfigError, RadioError
from gr_ros2.core.files import replacing
from gr_ros2.core.guard import Guard, one_line
from gr_ros2.core.watch import LOOK_S, Watch
from gr_ros2.phy.threads import KeepsThreadState
from gr_ros2.radio.bursts import BurstCutter

VERSION = "1.0.0"
META, DATA = ".sigmf-meta", ".sigmf-data"
SAMPLE = np.dtype("<c8")
_DATATYPE = "cf32_le"
_BESIDE_SAMPLES = {"core:dataset", "core:metadata_only", "core:header_bytes", "core:trailing_bytes"}
"""What says that the samples are not all of the data file, or that there is none."""
_MOST_HZ = 1e15
_MOST_ANNOTATIONS = 100_000
"""Largest number of annotated bursts. Bursts beyond it are recorded without annotation."""
_MOST_GAPS = 10_000
_HELD_BYTES = 1 << 26
"""Memory for samples that wait for the disk: 0.4 s at 20 million samples/s."""
_PATIENCE_S = 5.0
"""Time that a recording may take to end, s."""


@dataclass
class SigmfRecording:
    """The metadata of a recording.

    :param sample_rate: samples/s
    :param frequency: Hz, of the receiver; None where there is none
    :param description: for people
    :param annotations: (first sample, samples, label)
    :param gaps: (sample in the recording, its number in the recorded stream), for each sample that follows missing ones
    """

    sample_rate: float
    frequency: float | None = None
    description: str = ""
    annotations: list[tuple[int, int, str]] = field(default_factory=list)
    gaps: list[tuple[int, int]] = field(default_factory=list)

    def index_at(self, sample: int) -> int:
        """The number, in the recorded stream, of a sample after the last gap."""
        start, index = self.gaps[-1] if self.gaps else (0, 0)
        return index + sample - start

    def to_json(self, began: datetime) -> dict[str, Any]:
        """The content of the metadata file."""
        captures = [self._capture(start, index, began) for start, index in [(0, 0), *self.gaps]]
        return {
            "global": {
                "core:datatype": _DATATYPE,
                "core:sample_rate": self.sample_rate,
                "core:version": VERSION,
                "core:description": self.description,
                "core:recorder": f"gr-ros2 {__version__}",
            },
            "captures": captures,
            "annotations": [
                {"core:sample_start": start, "core:sample_count": count, "core:label": label}
                for start, count, label in self.annotations
            ],
        }

    def _capture(self, start: int, index: int, began: datetime) -> dict[str, Any]:
        """The metadata of one part of the stream without gaps."""
        at = began + timedelta(seconds=index / self.sample_rate)
        found: dict[str, Any] = {"core:sample_start": start, "core:datetime": at.strftime("%Y-%m-%dT%H:%M:%S.%fZ")}
        if index:
            found["core:global_index"] = index
        if self.frequency is not None:
            found["core:frequency"] = self.frequency
        return found


def base_path(path: Path) -> Path:
    """The path of a recording without ``.sigmf-meta`` or ``.sigmf-data``."""
    return path.with_suffix("") if path.suffix in (META, DATA) else path


def read_recording(path: Path) -> tuple[SigmfRecording, NDArray[np.complex64]]:
    """Read a recording. Its samples stay in the file until they are used.

    :raises ConfigError: when the recording does not exist, is not SigMF, or its data are other than cf32_le samples of
        one channel alone; the message names it
    """
    base = base_path(path)
    meta, data = Path(f"{base}{META}"), Path(f"{base}{DATA}")
    try:
        text, size = meta.read_bytes(), data.stat().st_size
    except OSError as error:
        raise ConfigError(f"recording {error.filename}: {error.strerror}; it takes {META} and {DATA}") from error
    try:
        about = read_metadata(text)
    except ValueError as error:
        raise ConfigError(f"recording {meta}: {error}") from error
    # An empty file cannot be mapped; an incomplete last sample is left out.
    count = size // SAMPLE.itemsize
    samples = np.memmap(data, SAMPLE, "r", shape=(count,)) if count else np.empty(0, SAMPLE)
    return about, samples


def read_metadata(text: bytes) -> SigmfRecording:
    """What the metadata of a recording say.

    :raises ValueError: they are not SigMF, or data that they describe cannot be replayed; with thing, value and remedy
    """
    try:
        whole = json.loads(text)
        about, captures = whole["global"], whole["captures"]
        if not isinstance(about, dict) or not all(isinstance(capture, dict) for capture in captures):
            raise TypeError("global is no object, or captures are no list of objects")
        datatype, sample_rate = about["core:datatype"], about["core:sample_rate"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"no SigMF metadata with datatype, sample rate and captures ({one_line(error)})") from error
    if datatype != _DATATYPE or about.get("core:num_channels", 1) != 1:
        channels = about.get("core:num_channels", 1)
        raise ValueError(
            f"datatype {datatype!r:.80}, channels {channels!r:.80}; only {_DATATYPE} of one channel can be replayed"
        )
    for part in (about, *captures):
        for key in _BESIDE_SAMPLES & part.keys():
            if part[key]:
                raise ValueError(
                    f"{key} = {part[key]!r:.80}: the samples do not fill {DATA} alone; write them, and nothing else, "
                    f"to a recording without {key}"
                )
    _check_extensions(about.get("core:extensions"))
    _check_hz("core:sample_rate", sample_rate, above=0)
    frequency = captures[0].get("core:frequency") if captures else None
    if frequency is not None:
        _check_hz("core:frequency", frequency, above=-_MOST_HZ)
    return SigmfRecording(float(sample_rate), frequency, str(about.get("core:description", "")))


def _check_extensions(declared: Any) -> None:
    """Check that nobody has to know an extension of SigMF to read the samples. Before version 1.0.0 they were an object
    of names and versions, and did not say whether they have to be known."""
    for extension in declared if isinstance(declared, list) else []:
        if not isinstance(extension, dict) or extension.get("optional") is not True:
            raise ValueError(
                f"core:extensions has {extension!r:.80}: no extension is known here; if its samples can be replayed "
                "without it, set its optional to true"
            )


def _check_hz(key: str, value: Any, above: float) -> None:
    if isinstance(value, bool) or not isinstance(value, int | float) or not above < value <= _MOST_HZ:
        raise ValueError(f"{key} = {value!r:.80}: set a number in Hz, above {above:g} and up to {_MOST_HZ:g}")


class SigmfRecorder(KeepsThreadState, gr.sync_block):  # type: ignore[misc]
    """Writes samples to a recording.

    If the disk is full or slower than the samples, the recording loses samples, and ``failed`` counts them. The
    flowgraph is not affected. After missing samples a new capture begins. Its ``core:global_index`` tells how many are
    missing.

    :param path: of the recording, with or without suffix
    :param bursts: cuts the samples into packets, to annotate each packet; None = a continuous stream, without
        annotations
    :param lossless: let the flowgraph wait for a slow disk instead of losing samples
    :raises ConfigError: when the recording exists already
    :raises RadioError: when it cannot be written
    """

    def __init__(
        self, path: Path, about: SigmfRecording, bursts: BurstCutter | None = None, *, lossless: bool = False
    ) -> None:
        super().__init__("gr_ros2_sigmf_recorder", [np.complex64], None)
        self._meta, self._data = (Path(f"{base_path(path)}{suffix}") for suffix in (META, DATA))
        self._about = about
        self._bursts = bursts
        self._began = datetime.now(timezone.utc)
        self._came = self._written = self._cut = 0
        self._changed = threading.Condition()
        self._refused = self._unwritten = 0
        self._guard = Guard(f"recording {self._data}")
        try:
            # Unbuffered: a full disk is an error at once, and not when the file is closed.
            self._file = self._data.open("xb", buffering=0)
            self._write_meta()
        except FileExistsError as error:
            raise ConfigError(f"recording {self._data}: there is one already; choose another name") from error
        except OSError as error:
            raise RadioError(f"recording {self._data}: cannot be written ({error.strerror})") from error
        self._backlog = Backlog("gr-ros2-recording", _HELD_BYTES)
        self._hand_over = self._backlog.put if lossless else self._backlog.offer

    @property
    def failed(self) -> int:
        """Number of samples that could not be written, for example because the disk is full."""
        return self._refused + self._unwritten

    def incomplete(self) -> list[str]:
        """What is missing and why, as one line. Empty if nothing is missing."""
        if self._guard.error is None and not self.failed:
            return []
        why = "the disk is slower than the samples" if self._guard.error is None else one_line(self._guard.error)
        return [f"{self._guard.name}: {self.failed} samples are missing ({why})"]

    def work(self, input_items: list[NDArray[np.complex64]], output_items: list[Any]) -> int:  # noqa: ARG002
        samples = input_items[0]
        if self._bursts is None:
            self._record(samples)
            return len(samples)
        bursts, taken = self._bursts.cut(self, samples)
        for burst in bursts:
            self._record(burst.samples)
        with self._changed:
            self._cut += len(bursts)
            self._changed.notify_all()
        return taken

    def wait_for_bursts(self, number: int) -> None:
        """Wait until so many bursts have come, in a flowgraph that runs; no longer once none comes for a while."""
        watch = Watch()
        with self._changed:
            while self._cut < number and watch.still_s(self._cut, time.monotonic()) < _PATIENCE_S:
                self._changed.wait(LOOK_S)

    def _record(self, samples: NDArray[np.complex64]) -> None:
        data = samples.astype(SAMPLE, copy=False).tobytes()
        if not self._hand_over(len(data), self._write, data, self._came):
            self._refused += len(samples)
        self._came += len(samples)

    def stop(self) -> bool:
        # A flowgraph made by GRC calls `stop`, but not `close`.
        if self._backlog.settle(_PATIENCE_S) and not self._file.closed:
            self._finish_meta()
        return super().stop()

    def close(self) -> None:
        """Finish the recording. Idempotent."""
        if self._backlog.close(_PATIENCE_S) and not self._file.closed:
            self._file.close()
            self._finish_meta()

    def _write(self, data: bytes, place: int) -> None:
        """Write samples; the first one has the number ``place`` in the stream."""
        count, at = len(data) // SAMPLE.itemsize, self._written
        if self._guard.error is None:
            try:
                left = memoryview(data)
                while left:
                    left = left[self._file.write(left) :]
            except OSError as error:
                self._guard.end(error)
                # Nothing more is written, so the file ends with a whole sample.
                with suppress(OSError):
                    self._file.truncate(at * SAMPLE.itemsize)
        if self._guard.error is not None:
            self._unwritten += count
            return
        self._written += count
        if place != self._about.index_at(at) and len(self._about.gaps) < _MOST_GAPS:
            self._about.gaps.append((at, place))
        if self._bursts is not None and len(self._about.annotations) < _MOST_ANNOTATIONS:
            self._about.annotations.append((at, count, "packet"))

    def _finish_meta(self) -> None:
        try:
            self._write_meta()
        except OSError as error:
            self._guard.end(error)

    def _write_meta(self) -> None:
        """Replace the metadata. If the disk is full, they stay as they are."""
        with replacing(self._meta) as part:
            part.write_text(json.dumps(self._about.to_json(self._began), indent=1) + "\n", encoding="utf-8")
