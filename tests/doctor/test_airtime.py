"""`gr-ros2 doctor LINK` and `gr-ros2 doctor BAND`: what a limit of airtime means, in seconds and in packets."""

from __future__ import annotations

from pathlib import Path

import pytest

from gr_ros2.cli.main import run
from gr_ros2.doctor.airtime import airtime_checks
from gr_ros2.doctor.finding import Finding
from gr_ros2.radio import FRONT_ENDS
from gr_ros2.settings.airtime import BANDS
from gr_ros2.settings.config import build
from gr_ros2.state.airtime import AirtimeFile

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

MODEM = """
robot: 7
packet_len: 100
phy: {name: modem, options: {bit_rate: 1000, overhead_bytes: 25}}
front_end: {name: serial, device: /dev/ttyUSB0, guard_s: 0.5, backoff_s: 0.5}
"""
"""A packet takes 2 s."""


@pytest.fixture
def link(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    path = tmp_path / "robot.yaml"
    path.write_text(MODEM)
    return str(path)


def found(what: str, *overrides: str) -> dict[str, Finding]:
    return {finding.what: finding for check in airtime_checks(what, overrides) for finding in check.findings()}


@pytest.mark.parametrize("band", list(BANDS))
def test_every_band_says_what_it_limits_and_where_that_stands(band: str) -> None:
    told = found(band)
    assert BANDS[band].source in told[f"band {band}"].text
    duty = BANDS[band].duty_cycle
    said = "no limit of time" if duty == 1 else f"{duty * BANDS[band].window_s:.3g} s of any {BANDS[band].window_s:g} s"
    assert said in told["limit"].text


def test_the_limit_of_a_link_is_told_in_packets(link: str) -> None:
    told = found(link, "airtime={duty_cycle: 0.1, window_s: 1000}")
    assert told["limit"].text.startswith("100 s of any 1000 s (10 %): 10 s of it at once, the rest evenly, 9 % of the")
    assert told["packets"].text == "one of 100 B takes 2 s: 50 of them in 1000 s, 5 at once, then one every 22.2 s"
    assert told["account"].text.startswith("0 of 100 s sent or reserved")


def test_what_was_sent_counts_and_a_running_link_keeps_its_account(link: str, tmp_path: Path) -> None:
    path = tmp_path / "state" / "gr_ros2" / "robot_7.airtime"
    running = AirtimeFile(path)
    running.save([(0.0, 3.0), (5.0, 2.0)])
    assert "a running link has it" in found(link, "airtime=eu433")["account"].text
    running.close()
    assert found(link, "airtime=eu433")["account"].text == f"5 of 360 s sent or reserved; {path}"
    path.write_text("no account")
    assert found(link, "airtime=eu433")["account"].state == "failed"


def test_a_packet_that_never_fits_and_a_radio_without_a_limit(link: str) -> None:
    told = found(link, "airtime={duty_cycle: 0.01, window_s: 100}")
    assert (told["packets"].state, told["packets"].remedy) == ("failed", "set a smaller packet_len, or a faster rate")
    free = found(link)
    assert (free["limit"].state, free["packets"].text) == ("warning", "one of 100 B takes 2 s")
    assert "account" not in free


def test_the_airtime_is_that_of_the_front_end_when_it_is_open() -> None:
    from gr_ros2.phy.psk import PskPhy
    from gr_ros2.radio.soapy import SoapyFrontEnd

    phy = PskPhy(64, 2e6)
    chosen = build(SoapyFrontEnd.Options, {"frequency": 433e6, "multiple": 131072, "half_duplex": True}, "front_end")
    assert SoapyFrontEnd.airtime_with(phy, chosen) == pytest.approx(131072 / 2e6 + 0.005)
    assert FRONT_ENDS.load("sim").airtime_with(phy, build(FRONT_ENDS.load("sim").Options, {})) == phy.airtime()


def test_the_command(link: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["doctor", link, "--set", "airtime=eu433"]) == 0
    assert "band eu433: 433.05 to 434.79 MHz" in capsys.readouterr().out
    assert run(["doctor", link, "--set", "airtime={duty_cycle: 0.01, window_s: 100}"]) == 1
    capsys.readouterr()
    for words, said in (
        (("nosuch",), "neither a link's YAML file nor a band; known bands are eu433"),
        (("--set", "airtime=eu433"), "--set needs LINK"),
        (("eu433", "--self-test"), "--self-test takes none"),
        ((link, "--set", "airtime.duty_cycle=0"), "airtime.duty_cycle = 0"),
    ):
        assert run(["doctor", *words]) == 2
        assert said in capsys.readouterr().err
