"""What the tests of the race share: where it can run, and a recording that is quick to carry."""

from __future__ import annotations

import pytest

from gr_ros2.core.errors import RunError
from gr_ros2_lab.race.measure import RaceCell
from gr_ros2_lab.race.namespaces import check_means


def _missing() -> str:
    try:
        check_means()
    except RunError as error:
        return str(error)
    return ""


_REASON = _missing()
needs_namespaces = pytest.mark.skipif(bool(_REASON), reason=_REASON)


def cell(contender: str, **changes: object) -> RaceCell:
    """A cell in which everything went well."""
    values = {
        "load": 2.0,
        "loss": 0.05,
        "sample_rate": 1e5,
        "matched": True,
        "sent": 100,
        "delivered": 90,
        "altered": 0,
        "duplicates": 0,
        "pdr": 0.9,
        "latency_p50": 0.01,
        "latency_p99": 0.02,
        "age_mean": 0.03,
        "airtime_per_message": 0.004,
        "air_bytes_per_message": 70.0,
        "air_bytes_reverse": 0.0,
        "discovery_bytes": 0.0,
        "first_message": 0.5,
        "drops": {},
        "busy": 0.3,
    }
    return RaceCell(contender=contender, **{**values, **changes})  # type: ignore[arg-type]
