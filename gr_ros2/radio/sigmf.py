"""SigMF recordings: samples in `NAME.sigmf-data`, what they are in `NAME.sigmf-meta` (sigmf.org, version 1.0.0).

Laws: samples are cf32_le, one channel; a recording that was cut off by a kill is still one, with the metadata it began
with; a recording is never written over another.
"""

from __future__ import annotations

import json
import logging
import threading
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
from gnuradio import gr
from numpy.typing import NDArray

from gr_ros2 import __version__
from gr_ros2.errors import ConfigError, RadioError
from gr_ros2.phy.threads import KeepsThread

VERSION = "1.0.0"
META, DATA = ".sigmf-meta", ".sigmf-data"
SAMPLE = np.dtype("<c8")
_DATATYPE = "cf32_le"
_MOST_ANNOTATIONS = 100_000
"""Bursts annotated; those beyond are recorded all the same."""
_log = logging.getLogger(__name__)


@dataclass
class Recording:
    """What a recording says of its samples.

    :param sample_rate: samples/s
    :param frequency: Hz, of the receiver; None where there is none
    :param description: for people
    :param annotations: (first sample, samples, label)
    """

    sample_rate: float
    frequency: float | None = None
    description: str = ""
    annotations: list[tuple[int, int, str]] = field(default_factory=list)

    def to_json(self, began: datetime) -> dict[str, Any]:
        """The content of the metadata file."""
        capture: dict[str, Any] = {"core:sample_start": 0, "core:datetime": began.strftime("%Y-%m-%dT%H:%M:%S.%fZ")}
        if self.frequency is not None:
            capture["core:frequency"] = self.frequency
        return {
            "global": {
                "core:datatype": _DATATYPE,
                "core:sample_rate": self.sample_rate,
                "core:version": VERSION,
                "core:description": self.description,
                "core:recorder": f"gr-ros2 {__version__}",
            },
            "captures": [capture],
            "annotations": [
                {"core:sample_start": start, "core:sample_count": count, "core:label": label}
                for start, count, label in self.annotations
            ],
        }


def base_path(path: Path) -> Path:
    """The path of a recording without ``.sigmf-meta`` or ``.sigmf-data``."""
    return path.with_suffix("") if path.suffix in (META, DATA) else path


def read_recording(path: Path) -> tuple[Recording, NDArray[np.complex64]]:
    """A recording and its samples, which stay in the file until they are looked at.

    :raises ConfigError: when it is not there, is no SigMF, or is of a datatype other than cf32_le; names it
    """
    base = base_path(path)
    meta, data = Path(f"{base}{META}"), Path(f"{base}{DATA}")
    try:
        whole = json.loads(meta.read_text(encoding="utf-8"))
        about, captures = whole["global"], whole["captures"]
        datatype, sample_rate = about["core:datatype"], float(about["core:sample_rate"])
        size = data.stat().st_size
    except OSError as error:
        raise ConfigError(f"recording {error.filename}: {error.strerror}; it takes {META} and {DATA}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"recording {meta}: no SigMF metadata with datatype and sample rate ({error!r})") from error
    if datatype != _DATATYPE or about.get("core:num_channels", 1) != 1:
        raise ConfigError(f"recording {meta}: datatype {datatype!r}; only {_DATATYPE} of one channel can be replayed")
    frequency = captures[0].get("core:frequency") if captures else None
    # An empty file cannot be mapped; a torn last sample is left out.
    count = size // SAMPLE.itemsize
    samples = np.memmap(data, SAMPLE, "r", shape=(count,)) if count else np.empty(0, SAMPLE)
    return Recording(sample_rate, frequency, str(about.get("core:description", ""))), samples


class SigmfRecorder(KeepsThread, gr.sync_block):  # type: ignore[misc]
    """Samples in, a recording out.

    :param path: of the recording, with or without suffix
    :param burst: samples of a packet, to annotate each; 0 = a continuous stream, without annotations
    :raises ConfigError: when there is a recording already
    :raises RadioError: when it cannot be written
    """

    def __init__(self, path: Path, about: Recording, burst: int = 0) -> None:
        super().__init__("gr_ros2_sigmf_recorder", [np.complex64], None)
        self._meta, data = (Path(f"{base_path(path)}{suffix}") for suffix in (META, DATA))
        self._about = about
        self._burst = burst
        self._began = datetime.now(timezone.utc)
        self._lock = threading.Lock()
        self.failed = 0
        """Samples that could not be written, as on a full disk."""
        try:
            self._file = data.open("xb")
            self._write_meta()
        except FileExistsError as error:
            raise ConfigError(f"recording {data}: there is one already; choose another name") from error
        except OSError as error:
            raise RadioError(f"recording {data}: cannot be written ({error.strerror})") from error
        self.set_output_multiple(burst or 1)

    def work(self, input_items: list[NDArray[np.complex64]], output_items: list[Any]) -> int:  # noqa: ARG002
        samples = input_items[0]
        with self._lock:
            self._write(samples)
        return len(samples)

    def stop(self) -> bool:
        # A flowgraph made by GRC stops, and closes nothing.
        try:
            with self._lock:
                if not self._file.closed:
                    self._file.flush()
                    self._write_meta()
        except OSError as error:
            _log.warning("recording %s: cannot be finished (%s)", self._meta, error.strerror)
        return super().stop()

    def close(self) -> None:
        """Finish the recording. Idempotent.

        :raises OSError: when the rest of it cannot be written, as on a full disk
        """
        with self._lock:
            if not self._file.closed:
                self._file.close()
                self._write_meta()

    def _write(self, samples: NDArray[np.complex64]) -> None:
        try:
            at = self._file.tell() // SAMPLE.itemsize
            self._file.write(samples.astype(SAMPLE, copy=False).tobytes())
        except (OSError, ValueError):  # a full disk; ValueError once it is closed
            self.failed += len(samples)
            return
        if self._burst:
            starts = range(at, at + len(samples), self._burst)
            room = _MOST_ANNOTATIONS - len(self._about.annotations)
            self._about.annotations += [(start, self._burst, "packet") for start in starts[: max(0, room)]]

    def _write_meta(self) -> None:
        self._meta.write_text(json.dumps(self._about.to_json(self._began), indent=1) + "\n", encoding="utf-8")
