"""Settings that had another name once: what a file that still has the old one is told.

Invariant: a row's new name exists, in the class that the old one stood in; a name that is in use again is no row.
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
"""Old name -> a field of the class that had it, and what to write now."""


def new_name(old: str, known: Collection[str]) -> str:
    """What to write for a name of old, '' where it is none.

    :param known: the names of today, of the class in which it stands
    """
    field, said = OLD_NAMES.get(old, ("", ""))
    return said if field in known else ""
