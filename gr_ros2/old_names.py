"""Settings that had another name earlier, and the hint for a file that still uses the old name.

Invariant: the new name of each row exists in the class that had the old one; an old name that is in use again has no
row.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

OLD_NAMES: Mapping[str, tuple[str, str]] = {
    "deadline_ms": ("deadline_s", "deadline_s, in seconds"),
    "flush_timeout": ("flush_timeout_s", "flush_timeout_s"),
    "guard": ("guard_s", "guard_s"),
    "pace": ("time", "time: unthrottled for pace: flow, and nothing for pace: airtime"),
    "paced": ("ros_source", "ros_source.packet_rate: 0 for paced: false, and nothing for paced: true"),
    "queue": ("burst_queue", "burst_queue"),
    "reassembly_timeout": ("reassembly_timeout_s", "reassembly_timeout_s"),
    "start_time": ("start_time_s", "start_time_s"),
    "turnaround": ("turnaround_s", "turnaround_s"),
}
"""Old name -> a field of the class that had it, and the setting to write now."""


def new_name(old: str, known: Collection[str]) -> str:
    """The setting to write instead of an old name, '' if the name is not an old one.

    :param known: the present names of the settings in the class
    """
    field, message = OLD_NAMES.get(old, ("", ""))
    return message if field in known else ""
