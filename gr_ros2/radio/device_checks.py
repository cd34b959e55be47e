"""What a device has, compared with what was asked of it.

Invariant: a device that does not have the requested sample rate, frequency, gain or antenna is refused in one line that
names the setting, before it sends. Packets at another rate are noise; another frequency may belong to somebody else.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

from gr_ros2.core.errors import RadioError
from gr_ros2.settings.fields import AUTO

TOLERANCE = 1e-4
"""Largest relative error of sample rate and frequency. The PHYs are made for clocks within 100 ppm."""

GAIN_TOLERANCE = 0.5
"""Largest error of a gain, dB, if the device does not have coarser steps."""

Direction = Literal["tx", "rx"]


class DeviceChecks:
    """The checks of one device.

    :param name: of the front end
    :param options: its settings, :class:`gr_ros2.radio.device.DeviceOptions`
    :param sample_rate: of the PHY, samples/s
    """

    def __init__(self, name: str, options: Any, sample_rate: float) -> None:
        self._name, self._options, self._sample_rate = name, options, sample_rate

    def rate(self, got: float) -> None:
        """:raises RadioError: when a device runs at another sample rate than the PHY"""
        wanted = self._sample_rate
        if not abs(got - wanted) <= TOLERANCE * wanted:
            raise self._unlike(f"runs at {got:,.0f} samples/s, not at {wanted:,.0f}", "phy.sample_rate")

    def antenna(self, direction: Direction, known: Sequence[str]) -> str:
        """The requested antenna, '' for the device's choice.

        :raises RadioError: when the device has no such antenna
        """
        key = f"antenna_{direction}"
        antenna: str = getattr(self._options, key)
        if antenna == AUTO:
            return ""
        if antenna not in known:
            raise RadioError(f"front_end {self._name}: {key} = {antenna!r}: the device has {', '.join(known)}")
        return antenna

    def frequency(self, direction: Direction, got: float) -> None:
        """:raises RadioError: when a device is not tuned to the requested frequency

        :param got: frequency of the device, Hz
        """
        options = self._options
        wanted = options.frequency if direction == "tx" else options.receive_frequency
        key = "frequency" if direction == "tx" or options.frequency_rx == AUTO else "frequency_rx"
        if not abs(got - wanted) <= TOLERANCE * wanted:
            raise self._unlike(f"is tuned to {got:,.0f} Hz, not to {wanted:,.0f}", key)

    def gain(
        self,
        direction: Direction,
        got: float,
        low: float = float("-inf"),
        high: float = float("inf"),
        step: float = 0.0,
    ) -> None:
        """:raises RadioError: when a device does not have the requested gain, or cannot have it

        :param got: gain of the device, dB. Its gains are from ``low`` to ``high`` in steps of ``step``, all in dB
        """
        key = f"gain_{direction}"
        wanted: float = getattr(self._options, key)
        near = max(GAIN_TOLERANCE, step)
        if not low - near <= wanted <= high + near:
            raise RadioError(f"front_end {self._name}: {key} = {wanted:g} dB: the device has {low:g} to {high:g} dB")
        if not abs(got - wanted) <= near:
            raise self._unlike(f"has a gain of {got:g} dB, not of {wanted:g}", key)

    def _unlike(self, found: str, key: str) -> RadioError:
        args = self._options.args
        return RadioError(f"front_end {self._name}: args = {args!r}: the device {found}; set {key} to one it has")
