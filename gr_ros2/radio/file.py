"""The `file` front end: samples to send are written to a SigMF recording, and recorded samples are received again.

Invariants: the clock paces a replay at its sample rate. Zeros for whole packets follow, so that the receiver completes
the last packet too. A sample that is not a finite number is replaced by 0 and counted, because the filters and loops of
a receiver would not recover from it. A transmission is recorded without the silence between packets, and each burst is
annotated.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from gnuradio import gr
from numpy.typing import NDArray
from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from gr_ros2.core.errors import ConfigError
from gr_ros2.phy import Phy
from gr_ros2.phy.threads import KeepsThreadState
from gr_ros2.radio.bursts import BurstCutter
from gr_ros2.radio.front_end import AGAIN_MS, FrontEnd, FrontEndCounters, FrontEndOptions
from gr_ros2.radio.sigmf import SigmfRecorder, SigmfRecording, read_recording
from gr_ros2.settings.config import STRICT

_STEP_S = 0.005
_LONGEST_WAIT_S = 0.1
_BEHIND = 2
"""Length of the zeros behind a replay, in packets."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class FileOptions(FrontEndOptions):
    """Settings of this front end; at least one of the two paths. Paths are relative to the current directory."""

    write: Annotated[str, Field(title="Recording of what is sent")] = ""
    """recording to make of what is sent, '' = send nothing"""
    read: Annotated[str, Field(title="Recording to replay")] = ""
    """recording to receive, '' = receive nothing"""
    speed: Annotated[float, Field(ge=0, le=1000, title="Replay speed (times real time)")] = 1.0
    """of the replay, 1 = as recorded, 0 = as fast as the receiver takes it"""
    repeat: Annotated[bool, Field(title="Repeat the replay")] = False
    """begin again at its end"""

    @model_validator(mode="after")
    def _something(self) -> FileOptions:
        if not self.write and not self.read:
            raise ValueError("write and read are both empty; set one of them to the path of a SigMF recording")
        return self


class FileFrontEnd(FrontEnd):
    """Bursts into a recording, and a recording as what is received."""

    name = "file"
    Options = FileOptions
    any_length = True

    def __init__(self, phy: Phy, **options: Any) -> None:
        super().__init__(phy, **options)
        self._recorder: SigmfRecorder | None = None
        self._replay: _Replay | None = None
        self._frequency: float | None = None
        if self.options.read:
            about, samples = read_recording(Path(self.options.read))
            if about.sample_rate != phy.sample_rate:
                raise ConfigError(
                    f"recording {self.options.read}: {about.sample_rate:g} samples/s; set phy.sample_rate to that "
                    f"instead of {phy.sample_rate:g}"
                )
            self._replay = _Replay(samples, phy, self.options)
            self._frequency = about.frequency
        if self.options.write and self.transmits:
            about = SigmfRecording(phy.sample_rate, None, f"sent with phy {phy.name}, {phy.packet_len} B packets")
            bursts = BurstCutter(phy.airtime_samples(), phy.any_length)
            self._recorder = SigmfRecorder(Path(self.options.write), about, bursts, lossless=True)

    @property
    def sink(self) -> Any:
        return self._recorder

    @property
    def source(self) -> Any:
        return self._replay

    @property
    def receive_frequency(self) -> float | None:
        return self._frequency

    @property
    def finished(self) -> bool:
        return self._replay is not None and self._replay.finished and self._recorder is None

    def counters(self) -> FrontEndCounters:
        """Numbers of samples. ``unwritten``: not written, for example because the disk is full. ``not_finite``: not a
        finite number in the recording, replaced by 0."""
        unwritten = {} if self._recorder is None else {"unwritten": self._recorder.failed}
        not_finite = {} if self._replay is None else {"not_finite": self._replay.not_finite}
        return FrontEndCounters({}, {**unwritten, **not_finite})

    def drain(self, packets: int) -> None:
        if self._recorder is not None:
            self._recorder.wait_for_bursts(packets)

    def close(self) -> None:
        if self._recorder is not None:
            self._recorder.close()


class _Replay(KeepsThreadState, gr.sync_block):  # type: ignore[misc]
    """Gives the samples of a recording, paced by the clock."""

    def __init__(self, samples: NDArray[np.complex64], phy: Phy, options: FileOptions) -> None:
        super().__init__("gr_ros2_replay", None, [np.complex64])
        self._samples = samples
        self._zeros = _BEHIND * phy.airtime_samples()
        self._rate = phy.sample_rate * options.speed
        self._repeat = options.repeat
        self._at = 0
        self._given = 0
        self._begin: float | None = None
        self.finished = False
        """Whether the last sample and the zeros behind it have been given."""
        self.not_finite = 0
        """Number of samples that were not finite numbers."""
        self.set_blkd_input_timer_value(AGAIN_MS)

    def work(self, input_items: list[Any], output_items: list[NDArray[np.complex64]]) -> int:  # noqa: ARG002
        out = output_items[0]
        total = len(self._samples) + self._zeros
        if self._at == total:
            if not self._repeat:
                self.finished = True
                return -1
            self._at = 0
        count = min(len(out), total - self._at, self._due(len(out)))
        recorded = self._samples[self._at : self._at + count]
        finite = np.isfinite(recorded)
        out[: len(recorded)] = np.where(finite, recorded, 0)
        self.not_finite += len(recorded) - int(finite.sum())
        out[len(recorded) : count] = 0
        self._at += count
        self._given += count
        return count

    def _due(self, most: int) -> int:
        """Number of samples that may be given now. Waits for some if there are none."""
        if not self._rate:
            return most
        if self._begin is None:
            self._begin = time.monotonic()
        due = int((time.monotonic() - self._begin) * self._rate) - self._given
        if due <= 0:
            time.sleep(min(max(_STEP_S, (1 - due) / self._rate), _LONGEST_WAIT_S))
            due = int((time.monotonic() - self._begin) * self._rate) - self._given
        return max(0, due)
