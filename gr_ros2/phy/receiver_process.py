"""A burst receiver in a process of its own, so that the modem and the ROS side do not share one Python interpreter
lock.

Invariants: the packets are those that ``BurstReceiver`` finds in the same samples, in the same order; the process ends
when its stream of samples ends, and so also when its parent process ends; where it cannot be started or dies, reception
continues in this process, and the log says so.
"""

from __future__ import annotations

import logging
import os
import pickle
import select
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from gr_ros2.phy.burst import BurstModem, BurstReceiver, DemodulatedPacket, Samples

_START_S = 30.0
"""Time limit for loading Python and its libraries, on a small and busy computer."""
_STOP_S = 2.0
_READ_LEN = 1 << 16
_SAMPLE_LEN = 8
_log = logging.getLogger(__name__)


class _ProcessReport(NamedTuple):
    """A report of the process: packets since the last report, and the current counters."""

    packets: list[DemodulatedPacket]
    damaged: int
    points: Samples
    snr_db: float | None


class ReceiverProcess:
    """A :class:`BurstReceiver` in another process.

    :param modem: modulation and frames
    :param deliver: called with the packets of each report, in a thread of its own
    """

    def __init__(self, modem: BurstModem, deliver: Callable[[list[DemodulatedPacket]], None]) -> None:
        self._modem = modem
        self._deliver = deliver
        self._report = _ProcessReport([], 0, np.empty(0, np.complex64), None)
        self._here: BurstReceiver | None = None
        """Receiver in this process that is used after the other process has ended."""
        self._given = 0
        """Samples that the other process was given."""
        self._process: Any = None
        self._thread: threading.Thread | None = None
        reading, writing = os.pipe()
        self._reports = os.fdopen(reading, "rb")
        try:
            try:
                self._process = _start(writing)
            finally:
                os.close(writing)
            pickle.dump(modem, self._process.stdin)
            self._process.stdin.flush()
            if not select.select([self._reports], [], [], _START_S)[0]:
                raise TimeoutError(f"not ready after {_START_S:g} s")
            self._report = pickle.load(self._reports)
        except (OSError, EOFError) as error:
            self._continue_in_this_process(error)
            self.close()
        else:
            self._thread = threading.Thread(target=self._listen, name="gr-ros2-receiver", daemon=True)
            self._thread.start()

    @property
    def damaged(self) -> int:
        """Bursts found whose CRC-32 was wrong; noise taken for a preamble counts too."""
        return self._report.damaged + (0 if self._here is None else self._here.damaged)

    @property
    def points(self) -> Samples:
        """The constellation points of the newest packet."""
        return self._report.points if self._here is None else self._here.points

    @property
    def snr_db(self) -> float | None:
        """SNR over the sampled band, dB: the median of the newest packets; None before the first."""
        return self._report.snr_db if self._here is None else self._here.snr_db

    def feed(self, samples: Samples) -> list[DemodulatedPacket]:
        """Take the next samples, and wait while the process is behind; returns packets that were decoded in this
        process."""
        if self._here is None:
            try:
                self._process.stdin.write(np.ascontiguousarray(samples))
                self._process.stdin.flush()
                self._given += len(samples)
                return []
            except OSError as error:
                self._continue_in_this_process(error)
        assert self._here is not None
        return [packet._replace(end=packet.end + self._given) for packet in self._here.feed(samples)]

    def close(self) -> None:
        """End the process after it has processed all samples."""
        if self._process is not None:
            with suppress(BrokenPipeError):  # the process ended before it read everything
                self._process.stdin.close()
            if self._thread is not None:
                self._thread.join(_STOP_S)
            self._process.kill()
            self._process.wait()
        if self._thread is not None:
            self._thread.join()
        self._reports.close()

    def _continue_in_this_process(self, reason: Exception) -> None:
        _log.warning("the receiver's own process has ended (%s); reception continues in this one", reason)
        self._here = BurstReceiver(self._modem)

    def _listen(self) -> None:
        while True:
            try:
                report = pickle.load(self._reports)
            except (EOFError, OSError, pickle.UnpicklingError):  # the process ended, perhaps in the middle of a report
                return
            self._report = report
            self._deliver(report.packets)


def _start(reports: int) -> Any:
    """The process, which writes reports to a file descriptor."""
    code = f"import sys; sys.path[:] = {sys.path!r}; from gr_ros2.phy.receiver_process import serve; serve({reports})"
    return subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.PIPE,
        pass_fds=[reports],
        # Ctrl-C of the terminal must not end it: it has to continue as long as it gets samples.
        start_new_session=True,
        # Its arrays are small: more threads would only occupy cores that other programs need.
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )


def serve(descriptor: int) -> None:
    """The process: a modem and samples on standard input, reports on a file descriptor.

    :param descriptor: file descriptor to write to
    """
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # the parent process has ended
    samples = os.fdopen(sys.stdin.fileno(), "rb")
    with os.fdopen(descriptor, "wb") as reports:
        receiver = BurstReceiver(pickle.load(samples))
        _send_report(reports, receiver, [])
        rest, told = b"", 0
        while data := samples.read1(_READ_LEN):
            data = rest + data
            whole = len(data) // _SAMPLE_LEN * _SAMPLE_LEN
            rest = data[whole:]
            packets = receiver.feed(np.frombuffer(data[:whole], np.complex64))
            if packets or receiver.damaged != told:
                told = receiver.damaged
                _send_report(reports, receiver, packets)


def _send_report(reports: BinaryIO, receiver: BurstReceiver, packets: list[DemodulatedPacket]) -> None:
    pickle.dump(
        _ProcessReport(packets, receiver.damaged, receiver.points, receiver.snr_db), reports, pickle.HIGHEST_PROTOCOL
    )
    reports.flush()
