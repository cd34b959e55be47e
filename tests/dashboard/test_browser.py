"""The dashboard as a person has it: the command in one process, Chromium in another."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("bokeh", reason="needs bokeh: pip install 'gr-ros2[dashboard]'")
from selenium import webdriver
from selenium.webdriver.common.keys import Keys

from gr_ros2.middleware import Qos
from gr_ros2.middleware.dds import DdsMiddleware
from gr_ros2.radio.config import link_from
from gr_ros2.radio.robot_link import RobotLink
from gr_ros2.settings.files import REGISTRY_DIR
from gr_ros2_lab.record.result import Result, read_result
from tests.browser import FIND, Browser, needed
from tests.domains import free_domains, free_ports
from tests.programs import ProgramProcess
from tests.waiting import PATIENCE_S, wait_for

pytestmark = needed

FOCUSED = """
let node = document.activeElement;
while (node.shadowRoot?.activeElement) node = node.shadowRoot.activeElement;
const ring = getComputedStyle(node), name = node.getAttribute("aria-label") || node.innerText;
return [name, ring.outlineStyle, ring.outlineWidth, node === document.body];
"""
"""The element with the keyboard's focus: its name, and the ring around it."""
PALE = """
const parts = text => text.match(/[\\d.]+/g).map(Number);
const light = rgb => rgb.slice(0, 3).map(v => (v /= 255) <= .03928 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4)
    .reduce((sum, v, place) => sum + v * [.2126, .7152, .0722][place], 0);
const above = node => node.parentElement ?? node.getRootNode().host;
const behind = node => {
    for (; node; node = above(node)) {
        const rgba = parts(getComputedStyle(node).backgroundColor);
        if (rgba.length < 4 || rgba[3] > .5) return rgba;
    }
    return [255, 255, 255];
};
const pale = [];
const look = root => {
    for (const node of root.querySelectorAll("*")) {
        if (node.shadowRoot) look(node.shadowRoot);
        const says = [...node.childNodes].some(child => child.nodeType === 3 && child.textContent.trim());
        if (!says || ["STYLE", "SCRIPT", "TITLE"].includes(node.tagName) || !node.checkVisibility()) continue;
        const [one, other] = [light(parts(getComputedStyle(node).color)), light(behind(node))];
        if ((Math.max(one, other) + .05) / (Math.min(one, other) + .05) < 4.5) pale.push(node.outerHTML.slice(0, 120));
    }
};
look(document);
return pale;
"""
"""Texts with less contrast than WCAG 2 asks of small text."""
HOLES = """
const rows = new Map();
for (const card of document.querySelectorAll("#page > .card, #page > .stack, .fold > div > .card")) {
    if (!card.checkVisibility()) continue;
    const {top, right} = card.getBoundingClientRect();
    rows.set(top, Math.max(rows.get(top) ?? 0, right));
}
return [...rows.values()].filter(right => right < document.getElementById("page").clientWidth - 20);
"""
"""Where rows of cards end before the page does."""


class Viewer(Browser):
    """A browser that looks at a dashboard."""

    def numbers(self, selector: str = ".tile b") -> dict[str, float]:
        """``data-value`` by ``data-field``."""
        script = f"{FIND} return found.map(node => [node.dataset.field, node.dataset.value])"
        return {name: float(value) for name, value in self.run(script, selector) if value is not None}

    def topic(self, name: str) -> dict[str, float]:
        return self.numbers(f'tr[data-topic="{name}"] td[data-field]')

    def ledger(self, topic: str) -> dict[str, int]:
        script = f"{FIND} return found.map(node => [node.dataset.fate, node.dataset.value])"
        return {fate: int(count) for fate, count in self.run(script, f'tr[data-topic="{topic}"] i[data-fate]')}

    def text(self, selector: str) -> list[str]:
        texts: list[str] = self.run(f"{FIND} return found.map(node => node.textContent)", selector)
        return texts

    def phase(self) -> str:
        return "".join(self.text("b[data-field=phase]"))

    def gone(self) -> bool:
        return bool(self.run("return document.body.classList.contains('gone')"))

    def slide(self, number: int, key: str) -> None:
        """Press a key on the handle of a slider; they are counted from the top."""
        self.run(f"{FIND} return found", ".noUi-handle")[number].send_keys(key)

    def slider(self, number: int) -> float:
        return float(self.run(f"{FIND} return found", ".noUi-handle")[number].get_attribute("aria-valuenow"))

    def button(self, label: str) -> Any:
        (found,) = (one for one in self.run(f"{FIND} return found", ".bk-btn") if one.text == label)
        return found

    def scheme(self, name: str) -> None:
        """Bright or dark, as the system is set."""
        features = {"features": [{"name": "prefers-color-scheme", "value": name}]}
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", features)


SNR, OFFSET, LOSS = range(3)
ODOM = "/robot_1/odom"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Viewer]:
    """One for all tests: each would start it for longer than it takes to look at a page."""
    browser = Viewer(tmp_path_factory.mktemp("profile"))
    yield browser
    browser.driver.quit()


@pytest.fixture
def viewer(browser: Viewer) -> Iterator[Viewer]:
    with browser.window():
        yield browser


@contextmanager
def program(out: Path, port: int = 0, *more: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A long run over OFDM with a dashboard, and where that is."""
    settings = ["graph.middleware=memory", "packet_len=220", "phy.name=ofdm"]
    settings += ["phy.sample_rate=2.5e5", "channel.snr_db=30", "sim.odom_rate=10", *more]
    command = [sys.executable, "-m", "gr_ros2.cli", "run", "paper-direct", "--duration", "3600"]
    command += [
        "--no-report",
        "--out",
        str(out),
        f"--dashboard={port}",
        *(word for one in settings for word in ("--set", one)),
    ]
    process = ProgramProcess(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        url = re.search(r"http://\S+", line)
        assert url is not None, line + process.stdout.read()
        yield process, url[0]
    finally:
        process.kill()
        process.communicate()


def stop(process: subprocess.Popen[str], out: Path) -> Result:
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, output
    return read_result(out)


@pytest.mark.slow
def test_it_shows_what_the_result_says_sliders_act_and_it_returns_with_the_next_run(
    viewer: Viewer, tmp_path: Path
) -> None:
    (port,) = free_ports(1, socket.SOCK_STREAM)
    with program(tmp_path / "out", port) as (process, url):
        viewer.driver.get(url)
        wait_for(lambda: viewer.topic(ODOM).get("delivered", 0) > 0, "a delivery on the page")
        first = viewer.topic(ODOM)
        wait_for(lambda: viewer.topic(ODOM)["delivered"] > first["delivered"], "numbers that move")
        wait_for(lambda: viewer.topic(ODOM).get("pdr_now", 0) > 0.9, "a good link")
        assert viewer.phase().startswith("live")
        assert any(re.match(r"odom #\d+\[\d/4\]", text) for text in viewer.text(".bytes .entry"))
        points = "return Bokeh.documents[0].get_model_by_name(arguments[0]).renderers[0].data_source.length"
        for plot in ("map", "error", "latency", "pdr", "constellation", "spectrum"):
            wait_for(lambda plot=plot: viewer.run(points, plot) > 0, f"something on {plot}")

        # Another viewer sees what this one sets.
        mine = viewer.driver.current_window_handle
        viewer.driver.switch_to.new_window("window")
        viewer.driver.get(url)
        wait_for(lambda: viewer.topic(ODOM).get("delivered", 0) > 0, "the second viewer's numbers")
        viewer.slide(LOSS, Keys.END)
        wait_for(lambda: viewer.topic(ODOM).get("pdr_now") == 0, "a PDR of 0 at a loss of 100 %")
        viewer.driver.close()
        viewer.driver.switch_to.window(mine)
        wait_for(lambda: viewer.slider(LOSS) == 100, "the first viewer's slider")
        wait_for(lambda: viewer.topic(ODOM).get("pdr_now") == 0, "the first viewer's PDR")
        viewer.slide(LOSS, Keys.HOME)
        wait_for(lambda: viewer.topic(ODOM)["pdr_now"] > 0.5, "a link that is good again")
        viewer.slide(SNR, Keys.HOME)
        wait_for(lambda: viewer.topic(ODOM)["pdr_now"] == 0, "a PDR of 0 in noise")

        errors = [entry["message"] for entry in viewer.driver.get_log("browser") if entry["level"] == "SEVERE"]
        assert errors == []
        result = stop(process, tmp_path / "out")
        wait_for(viewer.gone, "the page to notice that the program has ended")
    (topic,) = result.topics
    shown = viewer.topic(ODOM)
    assert viewer.phase() == "ended"
    assert 0 < topic.delivered < topic.sent
    assert (shown["sent"], shown["delivered"]) == (topic.sent, topic.delivered)
    assert (shown["pdr"], shown["goodput_Bps"]) == (topic.pdr, topic.goodput_Bps)
    assert (shown["latency_p50"], shown["latency_p99"]) == (topic.latency_s.p50, topic.latency_s.p99)
    assert (shown["age_mean"], shown["age_peak"]) == (topic.age_s.mean, topic.age_s.peak)
    assert viewer.ledger(ODOM) == {fate: count for fate, count in topic.ledger.items() if count}
    tiles = viewer.numbers()
    assert (tiles["sent"], tiles["delivered"], tiles["pdr"]) == (topic.sent, topic.delivered, topic.pdr)
    assert result.interrupted is True

    with program(tmp_path / "two", port):
        wait_for(lambda: not viewer.gone() and viewer.phase().startswith("live"), "the next run on the same page")
        wait_for(lambda: 0 < viewer.numbers().get("sent", 0) < topic.sent, "its numbers")


@pytest.mark.slow
def test_it_shows_what_repair_does_and_can_be_used_with_a_keyboard_and_a_screen_reader_and_read_in_both_modes(
    viewer: Viewer, tmp_path: Path
) -> None:
    lossy = (
        "paper=null",
        "robots=[{}, {topics: []}]",
        "channel.packet_loss=0.3",
        "channel.snr_db=null",
        "sim.odom_rate=10",
    )
    with program(tmp_path / "out", 0, *lossy) as (process, url):
        viewer.driver.get(url)
        wait_for(lambda: viewer.numbers().get("repaired", 0) > 2, "repaired messages")
        wait_for(lambda: viewer.text(".gap"), "a gap between the last packets")
        gaps = [int(number) for text in viewer.text(".gap") for number in re.findall(r"(\d+) missing", text)]
        assert all(0 < gap < 1000 for gap in gaps), "a repair stands at the newest packet's number"
        tiles = viewer.numbers()
        assert tiles["air_repair"] > 0
        assert tiles["air_report"] > 0
        assert sum(tiles[f"air_{kind}"] for kind in ("new", "repair", "report", "hello")) == pytest.approx(1)
        assert any("repair" in text for text in viewer.text(".topics .key"))

        stops = []
        while True:
            webdriver.ActionChains(viewer.driver).send_keys(Keys.TAB).perform()
            name, *ring, over = viewer.run(FOCUSED)
            if over:
                break
            assert ring == ["solid", "3px"], name
            stops.append(name)
        sliders = ["SNR in the sampled band [dB]", "carrier offset [1/1000 of the sample rate]", "packets lost [%]"]
        folds = viewer.text("summary")
        assert len(folds) == 3
        assert stops == ["Pause", folds[0], "stop sending", "noise", *sliders, *folds[1:]]
        assert viewer.button("Pause").get_attribute("aria-pressed") == "false"
        viewer.button("Pause").send_keys(Keys.SPACE)
        wait_for(lambda: viewer.button("Pause").get_attribute("aria-pressed") == "true", "a pressed toggle")
        viewer.button("Pause").send_keys(Keys.SPACE)
        for scheme in ("light", "dark"):
            viewer.scheme(scheme)
            wait_for(lambda: viewer.run(PALE) == [], f"texts that can be read on a {scheme} page")
        # A screen reader says what is in an element that stays and has the role of a status.
        viewer.slide(LOSS, Keys.END)
        wait_for(lambda: "heard" in viewer.run("return document.querySelector('[role=status]').textContent"), "alarm")

        result = stop(process, tmp_path / "out")
        wait_for(viewer.gone, "the page to notice that the program has ended")
    (topic,) = result.topics
    assert viewer.numbers()["repaired"] == viewer.ledger(ODOM)["repaired"] == topic.ledger["repaired"] > 2


PICTURES = os.environ.get("GR_ROS2_PICTURES", "")
"""Folder where the pictures of this test are kept, for a person to look at; '' keeps them with the test."""


@pytest.mark.slow
def test_trouble_is_shown_as_trouble_in_five_states(viewer: Viewer, tmp_path: Path) -> None:
    pictures = Path(PICTURES) if PICTURES else tmp_path
    pictures.mkdir(exist_ok=True)

    def picture(name: str) -> None:
        assert viewer.driver.save_screenshot(str(pictures / f"{name}.png"))

    def alarm(word: str) -> Callable[[], bool]:
        """A busy computer is late, which the state says first; the alarms name everything."""
        return lambda: viewer.phase() != "live" and any(word in text for text in viewer.text(".alarms li"))

    def card(name: str) -> bool:
        return bool(viewer.run(f"{FIND} return found[0].checkVisibility()", f'[data-card="{name}"]'))

    lossy = ("paper=null", "robots=[{}, {topics: []}]", "repair=off", "sim.odom_rate=20")
    with program(tmp_path / "out", 0, *lossy) as (process, url):
        viewer.driver.get(url)
        wait_for(lambda: viewer.topic(ODOM).get("delivered", 0) > 60, "deliveries")
        wait_for(lambda: viewer.phase().startswith("live"), "a state")
        picture("up")
        assert {"1"} <= set(viewer.run(f"{FIND} return found.map(row => row.dataset.robot)", ".heard tr[data-robot]"))
        for name in ("pdr", "loss", "age", "air", "path", "channel"):
            assert card(name), name
        assert not card("constellation"), "folded"
        for fold in viewer.run(f"{FIND} return found", "summary"):
            fold.click()
        for name in ("snr", "constellation", "queue"):
            wait_for(lambda name=name: card(name), f"what was folded: {name}")
        assert viewer.run(HOLES) == []
        picture("unfolded")
        viewer.driver.refresh()
        wait_for(lambda: viewer.topic(ODOM).get("delivered", 0) > 0, "the page again")
        assert card("constellation"), "as it was left"
        axes = "return Bokeh.documents[0].get_model_by_name(arguments[0]).below[0].axis_label"
        assert viewer.run(axes, "spectrum") == "frequency [kHz]"
        for _ in range(5):
            viewer.slide(LOSS, Keys.PAGE_UP)
        wait_for(alarm("arrived"), "a link that is degraded")
        picture("degraded")
        viewer.slide(LOSS, Keys.END)
        wait_for(alarm("heard"), "a link that is down")
        picture("down")
        viewer.button("Pause").click()
        wait_for(lambda: "active" in viewer.button("Pause").get_attribute("class"), "pause")

        def still() -> bool:
            """Whether no number moves while pictures are taken, for which the page has time to change many times."""
            before = viewer.numbers()
            for _ in range(5):
                viewer.driver.get_screenshot_as_png()
            return bool(viewer.numbers() == before)

        wait_for(still, "numbers that stand still")
        before = viewer.numbers()["sent"]
        viewer.button("Pause").click()
        wait_for(lambda: viewer.numbers()["sent"] > before + 20, "numbers that move again")
        viewer.scheme("dark")
        phone = {"width": 360, "height": 1600, "deviceScaleFactor": 1, "mobile": True}
        viewer.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", phone)
        wide = "return [document.documentElement.scrollWidth, innerWidth]"
        wait_for(lambda: viewer.run(wide) == [360, 360], "a phone's width")
        assert viewer.run("return getComputedStyle(document.body).backgroundColor") == "rgb(20, 24, 29)"
        picture("phone-dark")
        stop(process, tmp_path / "out")
        viewer.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
        wait_for(viewer.gone, "the page to notice that the program has ended")
        picture("ended")
    assert not viewer.text(".alarms li")


@pytest.mark.slow
def test_a_live_link_shows_the_names_that_come_out_and_no_empty_card(viewer: Viewer, tmp_path: Path) -> None:
    (domain,) = free_domains(1)
    settings = {
        "registry": str(REGISTRY_DIR / "table4.csv"),
        "packet_len": 220,
        "robot": "/robot_1",
        "graph": {"domain_id": domain, "localhost_only": True},
        "phy": {"name": "psk", "sample_rate": 1e6},
        "front_end": {"name": "zmq", "bind": f"ipc://{tmp_path}/one", "connect": [f"ipc://{tmp_path}/two"]},
        "state": str(tmp_path / "one.json"),
    }
    (tmp_path / "one.yaml").write_text(json.dumps(settings))
    other = {
        **settings,
        "robot": "/robot_2",
        "front_end": {"name": "zmq", "bind": f"ipc://{tmp_path}/two", "connect": [f"ipc://{tmp_path}/one"]},
        "state": str(tmp_path / "two.json"),
        "diagnostics": {"period_s": 0},
    }
    command = [sys.executable, "-m", "gr_ros2.cli", "link", str(tmp_path / "one.yaml"), "--dashboard=0"]
    process = ProgramProcess(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert process.stdout is not None
        url = next(found[0] for line in process.stdout if (found := re.search(r"http://\S+", line)))
        with RobotLink(link_from(other)), DdsMiddleware(domain_id=domain, localhost_only=True) as robot:
            publisher = robot.advertise("/robot_2/cmd_vel", "geometry_msgs/msg/Twist", Qos("reliable"))
            viewer.driver.get(url)

            def shown() -> bool:
                publisher.publish(b"\0\1\0\0" + bytes(48))
                return viewer.topic("/rx_robot_2/cmd_vel").get("delivered", 0) > 3

            wait_for(shown, "the name that comes out")
            hidden = viewer.run(
                f"{FIND} return found.filter(one => one.hidden).map(one => one.dataset.card)", "[data-card]"
            )
            assert {"path", "error", "latency", "pdr"} <= set(hidden)
            if PICTURES:
                viewer.driver.save_screenshot(f"{PICTURES}/link.png")
    finally:
        process.kill()
        process.communicate()
