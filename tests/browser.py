"""A browser for pages that a person looks at."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from selenium import webdriver
from selenium.webdriver.chrome.service import Service

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
needed = pytest.mark.skipif(
    not (CHROMIUM and DRIVER), reason="no chromium or chromedriver; Debian: apt-get install chromium chromium-driver"
)

FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--window-size=1500,1600"),
)
FIND = """
const found = [], selector = arguments[0];
const look = root => {
    found.push(...root.querySelectorAll(selector));
    for (const node of root.querySelectorAll("*")) if (node.shadowRoot) look(node.shadowRoot);
};
look(document);
"""
"""Bokeh's models live in shadow roots."""


class Browser:
    """One browser."""

    def __init__(self, profile: Path) -> None:
        options = webdriver.ChromeOptions()
        options.binary_location = CHROMIUM
        for flag in (*FLAGS, f"--user-data-dir={profile}"):
            options.add_argument(flag)
        self.driver = webdriver.Chrome(options=options, service=Service(DRIVER))

    def run(self, script: str, *arguments: Any) -> Any:
        return self.driver.execute_script(script, *arguments)

    def emulate(self, what: str, **settings: Any) -> None:
        """Set what DevTools' domain Emulation can: ``DeviceMetricsOverride``, ``EmulatedMedia``."""
        self.driver.execute_cdp_cmd(f"Emulation.set{what}", settings)

    @contextmanager
    def window(self) -> Iterator[None]:
        """A window of the test's own."""
        (first,) = self.driver.window_handles
        self.driver.switch_to.new_window("window")
        self.driver.get_log("browser")  # what other tests have left there
        yield
        for handle in set(self.driver.window_handles) - {first}:
            self.driver.switch_to.window(handle)
            self.driver.close()
        self.driver.switch_to.window(first)
