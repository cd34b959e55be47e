"""Who may send, where: a radio asks for a word of permission and for a key, and a band limits frequency and callsign.

Invariant: a front end without a radio asks for nothing.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from gr_ros2.core.errors import ConfigError
from gr_ros2.radio.front_end import FrontEnd
from gr_ros2.settings.airtime import AirtimeConfig
from gr_ros2.settings.fields import Auto
from gr_ros2.wire import is_sealed

_NO_KEY = ", and there is no key: anybody could read, forge and replay its packets; set key (gr-ros2 key new FILE), or "
_log = logging.getLogger(__name__)


def permitted(
    transmit: bool | Auto, front_end: type[FrontEnd], options: Mapping[str, Any], *, guarded: bool = True
) -> bool:
    """Whether a front end may send.

    :param transmit: what its user has said: yes, no or nothing
    :param options: settings of the front end
    :param guarded: whether a key seals the packets, or its user has said that none is needed
    :raises ConfigError: for a radio that would send without a word, or without a key
    """
    if transmit is False or not front_end.asks(options):
        return transmit is not False
    on_air = f"front_end {front_end.name} sends {front_end.on_air(options)}"
    if transmit is not True:
        raise ConfigError(
            f"{on_air}: say once that it may, with --transmit or transmit: true in the file or in the block of GRC "
            "(docs/how-to/radios.md, Before you send); --listen-only or transmit: false only receives"
        )
    if not guarded:
        raise ConfigError(f"{on_air}{_NO_KEY}--open, open: true in the file")
    return True


class SealedOnly:
    """Lets only packets pass that a key seals, and says once what to do about the others: for a radio whose link is
    another block, so that what it sends is known when it comes.

    :param front_end: of the radio
    :param options: its settings
    """

    def __init__(self, front_end: type[FrontEnd], options: Mapping[str, Any]) -> None:
        self._told = (
            f"front_end {front_end.name} would send {front_end.on_air(options)}{_NO_KEY}open: True in its block of GRC"
        )
        self._said = False

    def __call__(self, packet: bytes) -> bool:
        """Whether a packet may leave."""
        passes = is_sealed(packet)
        if not passes and not self._said:
            self._said = True
            _log.error("%s", self._told)
        return passes


def check_band(airtime: AirtimeConfig, options: Mapping[str, Any], sample_rate: float) -> None:
    """Whether the band that a link names allows its front end.

    :param options: settings of the front end
    :param sample_rate: samples/s, 0 where there are none
    :raises ConfigError: for a frequency outside the band, or a missing callsign
    """
    band, frequency = airtime.of_band, options.get("frequency")
    if band is None:
        return
    if band.in_clear and not options.get("callsign"):
        raise ConfigError(
            f"airtime.band = {airtime.band!r}: a station says its callsign in clear ({band.source}), which front_end "
            "kiss alone does, in each packet; set front_end.name to kiss, and front_end.callsign"
        )
    if not band.highest_hz or not isinstance(frequency, int | float):
        return
    half = sample_rate / 2
    if not band.lowest_hz <= frequency - half < frequency + half <= band.highest_hz:
        raise ConfigError(
            f"front_end.frequency = {frequency:g}: with phy.sample_rate = {sample_rate:g} not within the "
            f"{band.lowest_hz / 1e6:g} to {band.highest_hz / 1e6:g} MHz of airtime.band = {airtime.band!r}; set "
            "another frequency or band"
        )
