"""A survey as GeoJSON (RFC 7946): one point for each row, for maps of the earth."""

from __future__ import annotations

import json
from collections.abc import Iterable
from math import isfinite
from typing import Any

from gr_ros2_lab.survey.poses import GeoOrigin
from gr_ros2_lab.survey.table import SurveyRow

_TOLD = ("t_s", "robot", "packets", "lost", "loss", "snr_db", "rate_hz", "age_s")


def geojson(rows: Iterable[SurveyRow], origin: GeoOrigin | None = None) -> str | None:
    """The rows as text; None where it is not known where on the earth they are.

    :param origin: of x (to the east) and y (to the north), for rows without latitude and longitude
    """
    points = [(row, _degrees(row, origin)) for row in rows]
    placed = [_feature(row, degrees) for row, degrees in points if degrees is not None]
    return json.dumps({"type": "FeatureCollection", "features": placed}) + "\n" if placed else None


def _degrees(row: SurveyRow, origin: GeoOrigin | None) -> tuple[float, float] | None:
    if isfinite(row.latitude) and isfinite(row.longitude):
        return row.latitude, row.longitude
    return None if origin is None else origin.geographic(row.x_m, row.y_m)


def _feature(row: SurveyRow, degrees: tuple[float, float]) -> dict[str, Any]:
    values = {name: getattr(row, name) for name in _TOLD}
    return {
        "type": "Feature",
        "geometry": {"type": "Point", "coordinates": [round(degrees[1], 8), round(degrees[0], 8)]},
        "properties": {name: value if isfinite(value) else None for name, value in values.items()},
    }
