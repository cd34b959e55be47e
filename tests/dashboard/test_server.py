"""The web server without a browser: where it serves, what it refuses, and that it goes."""

from __future__ import annotations

import json
import re
import socket
import subprocess
import threading
from http.client import HTTPConnection
from urllib.request import urlopen

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from bokeh.document import Document

from gr_ros2.core.errors import ConfigError
from gr_ros2.dashboard.addresses import own_addresses
from gr_ros2.dashboard.live_page import LivePage
from gr_ros2.dashboard.server import Dashboard
from gr_ros2.dashboard.state import DashboardState
from tests.dashboard.feed import NAMES, REGISTRY, Feed, at
from tests.domains import free_ports
from tests.waiting import PATIENCE_S


def get(url: str) -> str:
    with urlopen(url, timeout=PATIENCE_S) as answer:
        text: str = answer.read().decode()
    return text


def test_it_serves_a_page_that_needs_nothing_from_elsewhere() -> None:
    with Dashboard(port=0) as dashboard:
        page = get(dashboard.url)
        assert dashboard.url.startswith("http://127.0.0.1:")
        assert "gr-ros2" in page
        assert "cdn" not in page
        assert json.loads(get(dashboard.url + "alive"))["instance"] in page


@pytest.mark.parametrize(("own", "status"), [(True, 101), (False, 403)])
def test_another_site_may_not_talk_to_it(own: bool, status: int) -> None:
    with Dashboard(port=0) as dashboard:
        token = re.search(r'"token":"([^"]+)"', get(dashboard.url))
        assert token is not None
        connection = HTTPConnection("127.0.0.1", dashboard.port, timeout=PATIENCE_S)
        headers = {
            "Connection": "Upgrade",
            "Upgrade": "websocket",
            "Sec-WebSocket-Version": "13",
            "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
            "Sec-WebSocket-Protocol": f"bokeh, {token[1]}",
            "Origin": dashboard.url.rstrip("/") if own else "http://elsewhere.example:80",
        }
        connection.request("GET", "/ws", headers=headers)
        assert connection.getresponse().status == status
        connection.close()


def test_a_taken_port_is_named() -> None:
    with Dashboard(port=0) as first, pytest.raises(ConfigError, match=f"127.0.0.1:{first.port}"):
        Dashboard(port=first.port).start()


def test_every_interface_only_where_asked() -> None:
    with Dashboard("0.0.0.0", port=0) as dashboard:
        here, *_ = own_addresses()
        assert dashboard.url == f"http://{here}:{dashboard.port}/"
        assert get(dashboard.url)
        assert {f"{host}:{dashboard.port}" for host in (here, "0.0.0.0", "localhost")} <= {*dashboard._origins()}
    assert Dashboard("::1", 80).url == "http://[::1]:80/"


def test_the_addresses_of_this_machine_are_those_that_linux_names() -> None:
    told = subprocess.run(["ip", "-4", "-o", "addr"], capture_output=True, text=True, check=True).stdout
    named = set(re.findall(r"inet ([0-9.]+)", told))
    found = own_addresses()
    assert set(found) <= named
    assert found[0].startswith("127.") == all(address.startswith("127.") for address in named)


@pytest.mark.parametrize(
    ("address", "exposed"),
    [
        ("127.0.0.1", False),
        ("::1", False),
        ("localhost", False),
        ("0.0.0.0", True),
        ("::", True),
        ("robot.local", True),
    ],
)
def test_it_knows_whether_others_can_open_it(address: str, exposed: bool) -> None:
    assert Dashboard(address, 80).exposed is exposed


def test_it_goes_and_leaves_no_thread() -> None:
    dashboard = Dashboard(port=free_ports(1, socket.SOCK_STREAM)[0])
    dashboard.start()
    dashboard.close()
    dashboard.close()
    assert not [thread for thread in threading.enumerate() if thread.name == "gr-ros2-dashboard"]
    with Dashboard(port=dashboard.port):
        pass


def test_a_page_grows_no_larger_with_time() -> None:
    document = Document()
    dashboard = Dashboard()
    page = LivePage(document, dashboard, "test")
    state = DashboardState(REGISTRY, NAMES, 64, name="test")
    feed = Feed(state, lost=lambda number: number % 7 == 0, packet_len=64)
    sizes: list[int] = []
    for step in range(600):
        feed.submit(0, at(step, -step), step / 2)
        feed.fly(step / 2)
        page.draw(state.tick(step / 2), dashboard.radio)
        if step % 200 == 199:
            everything = document.to_json()
            sizes.append(
                len(json.dumps(everything.content, default=str)) + sum(len(b.data) for b in everything.buffers)
            )
    assert sizes[2] < 1.05 * sizes[1]
    assert len(list(document.models)) < 600


def test_every_other_picture_has_new_curves_and_the_last_one_too() -> None:
    document, dashboard = Document(), Dashboard()
    page = LivePage(document, dashboard, "test")
    page.ready()
    curves: list[object] = []
    for last in (False, False, False, True):
        page.offer(dashboard.snapshot, dashboard.radio, last)
        (drawing,) = document.session_callbacks
        document.remove_next_tick_callback(drawing)
        page._sources["error"].data = {"name": ["old"]}
        drawing.callback()
        curves.append(page._sources["error"].data["name"] == [])
        page._counter.seen = page._counter.drawn
    assert curves == [True, False, True, True]


def test_a_viewer_that_cannot_keep_up_gets_fewer_pictures() -> None:
    document = Document()
    dashboard = Dashboard()
    page = LivePage(document, dashboard, "test")
    page.offer(dashboard.snapshot, dashboard.radio)
    assert not document.session_callbacks  # nobody is there yet
    page.ready()
    page.offer(dashboard.snapshot, dashboard.radio)
    assert len(document.session_callbacks) == 1
    for _ in range(10):
        page.draw(dashboard.snapshot, dashboard.radio)  # and the browser never answers
    page.offer(dashboard.snapshot, dashboard.radio)
    assert len(document.session_callbacks) == 1
