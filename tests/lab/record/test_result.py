"""`result.json`: what goes in comes out, and nothing else is taken for a result."""

from __future__ import annotations

import json
from dataclasses import replace
from math import inf, nan
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2_lab.record.result import Result, read_result, write_result


def test_a_result_comes_back_as_it_was(tmp_path: Path, result: Result) -> None:
    assert write_result(result, tmp_path) == tmp_path / "result.json"
    assert read_result(tmp_path) == read_result(tmp_path / "result.json") == result
    assert [path.name for path in tmp_path.iterdir()] == ["result.json"]


def test_the_names_other_programs_rely_on(tmp_path: Path, result: Result) -> None:
    values = json.loads(write_result(result, tmp_path / "new" / "folder" / "r.json").read_text())
    assert {"scenario", "seed", "duration_s", "config", "topics", "packets", "phy"} <= values.keys()
    odom, imu = values["topics"]
    names = {"topic", "type", "src_id", "sent", "delivered", "pdr", "goodput_Bps", "latency_s", "latency_clock"}
    assert names | {"age_s", "path_error_m", "ledger"} <= odom.keys()
    assert odom["latency_s"] == {"p50": 0.1, "p95": 0.2, "p99": 0.3, "max": 0.4}
    assert odom["age_s"] == {"mean": 0.05, "peak": 0.5}
    assert imu["latency_s"] == {"p50": None, "p95": None, "p99": None, "max": None}
    assert imu["pdr"] is imu["path_error_m"] is imu["latency_clock"] is None


def test_numbers_that_are_not_finite_are_null(tmp_path: Path, result: Result) -> None:
    phy: dict[str, Any] = {"name": "ofdm", "a": nan, "b": [inf, np.float64(2.5)], "c": {"d": np.int64(7)}}
    written = json.loads(write_result(replace(result, phy=phy), tmp_path).read_text())
    assert written["phy"] == {"name": "ofdm", "a": None, "b": [None, 2.5], "c": {"d": 7}}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "damaged or half-written"),
        ('{"scenario": "x", "seed"', "damaged or half-written"),
        ("[" * 100_000, "damaged or half-written"),
        ("\udcff", "damaged or half-written"),
        ("[]", "no result of an experiment"),
        ('{"scenario": "x"}', "no result of an experiment"),
        (None, "cannot be read"),
    ],
)
def test_anything_else_is_refused_in_one_line(tmp_path: Path, text: str | None, says: str) -> None:
    path = tmp_path / "result.json"
    if text is not None:
        path.write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(ConfigError, match=says) as caught:
        read_result(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_every_cut_of_a_result_is_refused(tmp_path: Path, result: Result) -> None:
    data = write_result(result, tmp_path).read_bytes().rstrip()
    for size in range(0, len(data), 97):
        (tmp_path / "cut.json").write_bytes(data[:size])
        with pytest.raises(ConfigError):
            read_result(tmp_path / "cut.json")


def test_a_ledger_that_does_not_add_up_is_refused(tmp_path: Path, result: Result) -> None:
    text = write_result(result, tmp_path).read_text().replace('"lost_fragments": 1', '"lost_fragments": 2')
    (tmp_path / "result.json").write_text(text)
    with pytest.raises(ConfigError, match="fates add up to 11, sent are 10"):
        read_result(tmp_path)


def test_keys_of_later_versions_are_ignored(tmp_path: Path, result: Result) -> None:
    values = json.loads(write_result(result, tmp_path).read_text())
    values["new"] = values["topics"][0]["new"] = 1
    (tmp_path / "result.json").write_text(json.dumps(values))
    assert read_result(tmp_path) == result


def test_a_place_that_cannot_be_written(tmp_path: Path, result: Result) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="cannot be written"):
        write_result(result, tmp_path / "file" / "result.json")
