"""Reports and sweeps on paper and on a small screen: nothing is cut off."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2_lab.report.page import read_runs, write_report
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import load_scenario
from gr_ros2_lab.study.sweep.sweep_page import write_sweep
from tests.browser import Browser, needed
from tests.lab.study.sweeps import plan
from tests.lab.study.test_sweep_summaries import IMU, ODOM, results, topic

pytestmark = [needed, pytest.mark.slow]

A4 = {"width": 718, "height": 1047, "deviceScaleFactor": 1, "mobile": False}
"""Pixels of CSS within margins of a centimetre."""
CUT = """
return [...document.querySelectorAll("*")].filter(node => node.clientWidth && node.scrollWidth > node.clientWidth + 1)
    .map(node => node.tagName + " " + node.className + ": " + node.textContent.slice(0, 60));
"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    browser = Browser(tmp_path_factory.mktemp("profile"))
    yield browser
    browser.driver.quit()


@pytest.mark.parametrize("name", ["demo", "team"])
def test_a_report_fits_on_a4(browser: Browser, tmp_path: Path, name: str) -> None:
    run_scenario(load_scenario(name, duration_s=4.0, time="packets"), tmp_path)
    page, *_ = write_report(read_runs([tmp_path]), tmp_path)
    with browser.window():
        browser.driver.get(page.as_uri())
        browser.emulate("EmulatedMedia", media="print")
        browser.emulate("DeviceMetricsOverride", **A4)
        assert browser.run(CUT) == []
        browser.run("for (const part of document.querySelectorAll('details')) part.open = true")
        assert browser.run(CUT) == []


def test_a_sweep_fits_a_small_laptop(browser: Browser, tmp_path: Path) -> None:
    made = plan(tmp_path, grid={"channel.packet_loss": [0.0, 0.1], "packet_len": [64, 128], "sim.odom_rate": [10, 20]})
    found = results(made, topic(ODOM, 100, 50, 0.012), topic(IMU, 3000, 2999, 0.2))
    page, *_ = write_sweep(made, found, [], tmp_path)
    with browser.window():
        browser.driver.get(page.as_uri())
        browser.emulate("DeviceMetricsOverride", width=1280, height=800, deviceScaleFactor=1, mobile=False)
        assert browser.run(CUT) == []
