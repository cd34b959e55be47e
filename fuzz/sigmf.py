"""The metadata of somebody else's recording: what a replay needs of them, or a ValueError of one line."""

from __future__ import annotations

import json
from math import isfinite

from fuzz.loop import main
from gr_ros2.radio.sigmf import read_metadata

_GLOBAL = {"core:datatype": "cf32_le", "core:sample_rate": 1e6, "core:version": "1.0.0"}


def sigmf(data: bytes) -> None:
    """The text of a metadata file."""
    try:
        about = read_metadata(data)
    except ValueError as error:
        assert "\n" not in str(error)
        return
    assert 0 < about.sample_rate < 1e16
    assert about.frequency is None or isfinite(about.frequency)
    assert isinstance(about.description, str)


def corpus() -> list[bytes]:
    """Valid metadata, and some that are not."""
    captures: list[object] = [
        [],
        [{"core:sample_start": 0, "core:frequency": 433e6}],
        [{"core:header_bytes": 80}],
        ["x"],
    ]
    captures += [{"a": 1}, None, [{"core:frequency": "1"}], [{"core:frequency": float("inf")}]]
    wholes: list[object] = [{"global": _GLOBAL, "captures": capture, "annotations": []} for capture in captures]
    for key, value in (
        ("sample_rate", float("nan")),
        ("sample_rate", 10**400),
        ("dataset", "x"),
        ("num_channels", 2),
        ("sample_rate", None),
    ):
        wholes.append({"global": {**_GLOBAL, f"core:{key}": value}, "captures": []})
    return [b"", b"{", b"[" * 5000, *(json.dumps(whole).encode() for whole in wholes)]


if __name__ == "__main__":
    main(sigmf, corpus())
