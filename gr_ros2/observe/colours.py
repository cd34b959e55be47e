"""Colours of topics, runs and ledger fates, on every page and in every figure.

Invariant: a ledger fate has the same colour everywhere.
"""

from __future__ import annotations

from gr_ros2.link.fates import FATES

COLOURS = (
    *("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#7f3c8d", "#5a5a5a"),
    *("#88ccee", "#882255", "#44aa99", "#ddcc77", "#332288", "#aa4499", "#999933", "#661100"),
)
"""Colours of topics and runs, in their order. Colour-blind readers can distinguish them as well as is possible with
sixteen colours."""

AIR_COLOURS = {"new": "#2a9d5c", "repair": "#56b4e9", "report": "#e69f00", "hello": "#9db8d9"}
"""Colours of what packets are for."""

OUTCOME_COLOURS = {"heard by all": "#0072b2", "not by all": "#e69f00", "overlapped": "#d62728", "relayed": "#009e73"}
"""Colours of what became of a packet on a shared channel, see :meth:`gr_ros2.observe.team.Send.outcome`."""


def fate_colour(fate: str) -> str:
    """The colour of a ledger fate. A fate that this version does not know also has a fixed colour."""
    return FATES[fate].colour if fate in FATES else COLOURS[sum(fate.encode()) % len(COLOURS)]


def ink_on(background: str) -> str:
    """Black or white, whichever has more contrast on a colour, by WCAG 2.

    :param background: #rrggbb
    """
    channels = (int(background[start : start + 2], 16) / 255 for start in (1, 3, 5))
    linear = (value / 12.92 if value <= 0.03928 else ((value + 0.055) / 1.055) ** 2.4 for value in channels)
    luminance = sum(weight * value for weight, value in zip((0.2126, 0.7152, 0.0722), linear, strict=True))
    return "#000000" if (luminance + 0.05) ** 2 > 1.05 * 0.05 else "#ffffff"
