"""`gr-ros2 doctor --self-test`: passes on what is installed, and fails where a PHY or a file does not do its work."""

from __future__ import annotations

import json
from typing import Any

import pytest

from gr_ros2.cli.main import run
from gr_ros2.doctor import self_test
from gr_ros2.phy import PHY

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")


def told(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    findings = json.loads(capsys.readouterr().out)["findings"]
    return {finding["what"]: finding for finding in findings}


def test_it_passes_here_and_tries_every_phy_with_samples(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["doctor", "--self-test", "--json"]) == 0
    found = told(capsys)
    assert {f"phy {name}" for name in PHY} <= found.keys()
    for name in ("ofdm", "gfsk", "psk", "lora"):
        assert found[f"phy {name}"]["text"].startswith("8 of 8 packets came back"), name
    assert found["examples"]["state"] == found["message"]["state"] == "ok"
    assert run(["doctor", "--self-test"]) == 0
    assert capsys.readouterr().out.endswith("The self-test passed.\n")


def test_what_does_not_come_back_and_what_is_missing_fail_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("gr_ros2.phy.measure.deliver", lambda *_: [])
    monkeypatch.setattr(self_test, "EXAMPLES", ("no_such.grc",))
    assert run(["doctor", "--self-test", "--json"]) == 1
    found = told(capsys)
    assert found["phy psk"]["state"] == "failed"
    assert "0 of 8 packets came back" in found["phy psk"]["text"]
    assert "no example 'no_such.grc'" in found["examples"]["text"]
    assert run(["doctor", "--self-test"]) == 1
    assert "The self-test failed: phy ofdm" in capsys.readouterr().out
