"""The SNR of one robot's packets, smoothed.

One preamble gives the SNR with an error, and the channel changes. The more the SNRs of packets differ from the smoothed
one, the more a new packet counts: a Kalman filter whose channel noise is estimated.
"""

from __future__ import annotations

from gr_ros2.core.tuning import Tuning


class SnrFilter:
    """The SNR of one robot's packets.

    :ivar snr_db: of the newest packets, dB; None where it is not measured
    :ivar reported_db: the same in the last report
    """

    def __init__(self, tuning: Tuning) -> None:
        self._tuning = tuning
        self.snr_db: float | None = None
        self.reported_db: float | None = None
        self._square = self._tuning.snr_error
        """Mean square of the differences of new SNRs from the smoothed one, dB^2."""

    def measured(self, snr_db: float) -> None:
        """Note the SNR of a packet, dB."""
        if self.snr_db is None:
            self.snr_db = snr_db
        new = snr_db - self.snr_db
        tuning = self._tuning
        self._square += tuning.snr_smoothing * (new * new - self._square)
        changes = 1 - tuning.snr_error / max(self._square, tuning.snr_error)
        self.snr_db += min(max(changes, tuning.snr_least_share), tuning.snr_most_share) * new

    @property
    def changed(self) -> bool:
        """Whether the SNR differs so much from the last one reported that the sender should know."""
        if self.snr_db is None:
            return False
        return self.reported_db is None or abs(self.snr_db - self.reported_db) > self._tuning.snr_change_db
