"""Tables of packet loss: measured once, kept, and read between their points."""

from __future__ import annotations

import json
import logging
from math import sqrt
from pathlib import Path

import pytest

from gr_ros2.core.errors import ConfigError, RunError
from gr_ros2.phy import PHY, Phy
from gr_ros2.settings.config import ChannelConfig
from gr_ros2_lab.medium import loss_table
from gr_ros2_lab.medium.loss_table import (
    LossTable,
    Point,
    measure,
    neighbours,
    packet_losses,
    program,
    setting_of,
    table_for,
)

PACKETS = 200


def phy(name: str = "gfsk", packet_len: int = 33) -> Phy:
    made: Phy = PHY.load(name)(packet_len, 1e5)
    return made


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(loss_table, "PACKETS", PACKETS)
    return tmp_path / "gr-ros2" / "losses"


def test_what_is_missing_is_measured_once_and_said(
    cache: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    channel = ChannelConfig(snr_db=6.2)
    with caplog.at_level(logging.WARNING):
        table = table_for(phy(), channel, {6.0, 6.5}, packets=PACKETS)
    assert [record.message.split(";")[0] for record in caplog.records] == [
        "measuring the packet loss of gfsk, 33 B, at 6 dB",
        "measuring the packet loss of gfsk, 33 B, at 6.5 dB",
    ]
    (file,) = cache.glob("*.json")
    assert json.loads(file.read_text())["points"] == [
        [snr_db, point.sent, point.delivered, point.lost_in] for snr_db, point in sorted(table.points.items())
    ]
    monkeypatch.setattr(loss_table, "measure", None)  # calling it would fail
    assert table_for(phy(), channel, {6.0, 6.5}, packets=PACKETS) == table
    assert table_for(phy(), ChannelConfig(seed=5, packet_loss=0.5), {6.0}, packets=PACKETS).points[6.0].sent


def test_more_packets_than_were_sent_are_measured_again() -> None:
    assert table_for(phy(), ChannelConfig(), {None}, packets=20).points[None].sent == 20
    assert table_for(phy(), ChannelConfig(), {None}, packets=40).points[None].sent == 40
    assert table_for(phy(), ChannelConfig(), {None}, packets=10).points[None].sent == 40


@pytest.mark.parametrize("content", ["", "{", "[]", '{"points": [[1]]}'])
def test_a_damaged_table_is_measured_again(cache: Path, content: str, caplog: pytest.LogCaptureFixture) -> None:
    table = LossTable(setting_of(phy(), ChannelConfig()))
    cache.mkdir(parents=True)
    (cache / table.name).write_text(content)
    assert table_for(phy(), ChannelConfig(), {None}, packets=10).points[None].delivered == 10
    assert any("no table of losses" in record.message for record in caplog.records)


@pytest.mark.parametrize(
    "row", [[None, "x", 0, 0], [None, 0, 0, 0], [None, 10, 20, 0], ["x", 10, 10, 0], [None, 10, 10, []]]
)
def test_a_count_that_is_none_is_measured_again(cache: Path, row: list[object]) -> None:
    table = LossTable(setting_of(phy(), ChannelConfig()))
    cache.mkdir(parents=True)
    values = {"program": program(), "setting": table.setting, "points": [row]}
    (cache / table.name).write_text(json.dumps(values))
    assert table_for(phy(), ChannelConfig(), {None}, packets=10).points == {None: Point(10, 10, 0)}


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match=r"cannot be kept.*XDG_CACHE_HOME"):
        table_for(phy(), ChannelConfig(), {None}, packets=1, folder=tmp_path / "file" / "folder")


def test_between_two_points_the_loss_lies_between_theirs() -> None:
    table = LossTable({}, {10.0: Point(1000, 100, 90), 10.5: Point(1000, 900, 90)})
    losses = [table.losses(snr_db)[0] for snr_db in (10.0, 10.1, 10.25, 10.4, 10.5)]
    assert losses == sorted(losses, reverse=True)
    assert losses[2] == pytest.approx(0.5)
    nothing_lost = LossTable({}, {10.0: Point(1000, 1000, 0), 10.5: Point(1000, 1000, 0)})
    assert nothing_lost.losses(10.2) == (0.0, 0.0)
    assert neighbours(10.2) == (10.0, 10.5)
    assert neighbours(-0.2) == (-0.5, 0.0)
    assert neighbours(10.5) == (10.5, 10.5)


def test_the_setting_is_all_that_losses_depend_on() -> None:
    plain = setting_of(phy(), ChannelConfig())
    assert setting_of(phy(), ChannelConfig(snr_db=3, seed=4, packet_loss=0.1)) == plain
    assert setting_of(phy(), ChannelConfig(taps=(1, 0.4j))) != plain
    assert setting_of(phy(packet_len=34), ChannelConfig()) != plain
    assert "sample_rate" in setting_of(phy(), ChannelConfig(doppler_hz=1))


def test_fading_loses_packets_in_bursts_and_noise_does_not() -> None:
    noise = measure(phy(), ChannelConfig(snr_db=1.0), 400)
    fading = measure(phy(), ChannelConfig(snr_db=8.0, doppler_hz=1.0), 400)
    assert 0.1 < noise.pdr < 0.9
    assert 0.1 < fading.pdr < 0.98
    assert noise.memory < 0.2
    assert fading.memory > 0.5
    assert measure(phy(), ChannelConfig(snr_db=1.0), 400) == noise


def test_losses_are_those_of_the_table(monkeypatch: pytest.MonkeyPatch) -> None:
    points = {None: Point(1000, 1000, 0), 4.0: Point(1000, 600, 240), 5.0: Point(1000, 0, 1)}
    monkeypatch.setattr(loss_table, "table_for", lambda *_, **__: LossTable({}, points))
    assert packet_losses(phy(), ChannelConfig()).packet_loss == 0
    assert packet_losses(phy(), ChannelConfig(snr_db=4)).packet_loss == pytest.approx(0.4)
    faded = packet_losses(phy(), ChannelConfig(snr_db=4, doppler_hz=1)).burst_loss
    assert faded is not None
    assert faded.p_bad_to_good == pytest.approx(0.6), "runs as long as chance makes them"
    points[4.0] = Point(1000, 600, 40)
    faded = packet_losses(phy(), ChannelConfig(snr_db=4, doppler_hz=1)).burst_loss
    assert faded is not None
    assert faded.mean_loss == pytest.approx(0.4)
    assert 1 / faded.p_bad_to_good == pytest.approx(10), "packets in a row"
    assert packet_losses(phy(), ChannelConfig(snr_db=5, doppler_hz=1)).packet_loss == 1


def test_a_phy_without_samples_loses_nothing_and_takes_no_noise() -> None:
    direct = phy("direct")
    assert packet_losses(direct, ChannelConfig()) == ChannelConfig()
    with pytest.raises(ConfigError, match="snr_db"):
        packet_losses(direct, ChannelConfig(snr_db=3))


FILES = sorted(loss_table.BUILTIN_DIR.glob("*.json"))


@pytest.mark.parametrize("file", FILES, ids=[file.stem for file in FILES])
def test_the_tables_that_come_with_it_are_those_of_the_phys_as_they_are(file: Path) -> None:
    setting = json.loads(file.read_text())["setting"]
    radio = PHY.load(setting["phy"])(setting["packet_len"], 1e5, **setting["options"])
    table = table_for(radio, ChannelConfig(), {None}, packets=1)
    assert table.name == file.name
    assert table.points[None].pdr == 1
    known = [snr_db for snr_db in table.points if snr_db is not None]
    assert table.points[min(known)].pdr < 0.1
    assert table.points[max(known)].pdr > 0.99
    middle = min(known, key=lambda snr_db: abs(table.points[snr_db].pdr - 0.5))
    # The first packets of a table are those of a shorter measurement, in the same noise.
    point, again = table.points[middle], measure(radio, ChannelConfig(snr_db=middle), 150)
    assert abs(again.pdr - point.pdr) < 4 * sqrt(0.25 / 150), "changed since: run tools/measure-losses"


def test_there_are_tables() -> None:
    assert FILES
