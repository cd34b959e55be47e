"""The hard limit of a transmitter, with the account that its robot keeps from one start to the next.

Invariant: a limit is never without its account, and an account has one user at a time.
"""

from __future__ import annotations

import time
import weakref
from collections.abc import Mapping
from contextlib import ExitStack
from typing import Any

from gr_ros2.core.errors import ConfigError
from gr_ros2.gr.starts import account_of
from gr_ros2.link.airtime_limit import AirtimeLimit
from gr_ros2.phy.airtime import AirtimeGate
from gr_ros2.radio.permission import check_band
from gr_ros2.settings.airtime import AirtimeConfig
from gr_ros2.settings.config import airtime_from
from gr_ros2.settings.fields import AUTO, Auto
from gr_ros2.state.airtime import AirtimeFile


def open_limit(
    airtime: AirtimeConfig,
    longest: float,
    now: float,
    *,
    robot_id: int | Auto,
    state: str,
    radio: int = 0,
    closing: ExitStack,
) -> AirtimeLimit | None:
    """What limits the airtime, with what earlier starts of this robot have sent; None where nothing does.

    :param longest: airtime of the longest packet, s
    :param now: s, monotonic
    :param robot_id: the robot whose account it is
    :param state: its state file, beside which the account is; '' = the usual one
    :param radio: which of its radios, each of which has an account
    :param closing: lets go of the account
    :raises ConfigError: for an account without a robot, that another link uses or that cannot be read; for a packet
        that can never be sent
    """
    if airtime.rule is None:
        return None
    if robot_id == AUTO:
        raise ConfigError("airtime_limit: whose account is it? set robot_id to that of the robot's link")
    file = AirtimeFile(account_of(state, robot_id, radio))
    closing.callback(file.close)
    return AirtimeLimit(airtime.rule, longest, now=now, spent=file.spent, save=file.save)


def make_gate(
    airtime: float,
    *,
    airtime_limit: str | Mapping[str, Any] = "",
    robot_id: int | Auto = AUTO,
    state: str = "",
) -> AirtimeGate:
    """Make the gate of a flowgraph whose transmitter is no radio block of this package, as GRC does.

    :param airtime: s that the longest packet occupies, gap included; 0 lets packets pass at once
    :param airtime_limit, robot_id, state: see :func:`gr_ros2.radio.radio.make_radio`
    :raises ConfigError: for a value out of range, or a limit that a gate cannot keep
    """
    limits = airtime_from(airtime_limit)
    check_band(limits, {}, 0.0)
    if limits.listen_before_send:
        raise ConfigError("airtime_limit.listen_before_send: a gate hears nothing; take a radio block, or leave it out")
    if limits.rule is not None and not airtime > 0:
        raise ConfigError(f"airtime = {airtime} s: nothing to count; set the airtime of a packet, or no airtime_limit")
    with ExitStack() as undo:
        limit = open_limit(limits, airtime, time.monotonic(), robot_id=robot_id, state=state, closing=undo)
        gate = AirtimeGate(airtime, limit=limit)
        weakref.finalize(gate, undo.pop_all().close)
    return gate
