"""The SNR of one robot's packets, smoothed.

One preamble gives the SNR with an error, and the channel changes. The more the SNRs of packets differ from the smoothed
one, the more a new packet counts: a Kalman filter whose channel noise is estimated.
"""

from __future__ import annotations

_ERROR = 1.3
"""Mean square of the error of an SNR that one preamble gives, dB^2, with a margin."""
_LEAST_SHARE, _MOST_SHARE = 0.2, 0.8
"""Limits of the share of a new packet in the smoothed SNR."""
_SMOOTHING = 0.125
CHANGE_DB = 1.5
"""Change of the SNR that is reported at once."""


class SnrFilter:
    """The SNR of one robot's packets.

    :ivar snr_db: of the newest packets, dB; None where it is not measured
    :ivar reported_db: the same in the last report
    """

    def __init__(self) -> None:
        self.snr_db: float | None = None
        self.reported_db: float | None = None
        self._square = _ERROR
        """Mean square of the differences of new SNRs from the smoothed one, dB^2."""

    def measured(self, snr_db: float) -> None:
        """Note the SNR of a packet, dB."""
        if self.snr_db is None:
            self.snr_db = snr_db
        new = snr_db - self.snr_db
        self._square += _SMOOTHING * (new * new - self._square)
        share = min(max(1 - _ERROR / max(self._square, _ERROR), _LEAST_SHARE), _MOST_SHARE)
        self.snr_db += share * new

    @property
    def changed(self) -> bool:
        """Whether the SNR differs so much from the last one reported that the sender should know."""
        if self.snr_db is None:
            return False
        return self.reported_db is None or abs(self.snr_db - self.reported_db) > CHANGE_DB
