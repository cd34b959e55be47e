"""Who may come in: no more viewers than there is room for, and nobody whose bytes cost or print anything."""

from __future__ import annotations

import asyncio
import gc
import json
import logging
import math
import re
import socket
from collections.abc import Iterator
from contextlib import suppress
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from bokeh.document import Document
from tornado.httpclient import HTTPRequest
from tornado.websocket import WebSocketClientConnection, WebSocketClosedError, websocket_connect

from gr_ros2.core.errors import ConfigError
from gr_ros2.dashboard import admission
from gr_ros2.dashboard.live_page import LivePage
from gr_ros2.dashboard.server import Dashboard
from tests.waiting import PATIENCE_S, wait_for

PULL = ('{"msgid": "1", "msgtype": "PULL-DOC-REQ"}', "{}", "{}")


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody waits for his page on purpose; pages that nobody connects to stay."""
    monkeypatch.setattr(admission, "SHARE", math.inf)
    monkeypatch.setattr("gr_ros2.dashboard.server._UNUSED_MS", 60_000)


@pytest.fixture
def records() -> Iterator[list[logging.LogRecord]]:
    """All that is logged from errors on."""
    found: list[logging.LogRecord] = []
    handler = logging.Handler(logging.ERROR)
    handler.emit = found.append  # type: ignore[method-assign]
    logging.getLogger().addHandler(handler)
    yield found
    logging.getLogger().removeHandler(handler)


def get(url: str, **headers: str) -> tuple[int, str]:
    try:
        with urlopen(Request(url, headers=headers), timeout=PATIENCE_S) as answer:
            return answer.status, answer.read().decode()
    except HTTPError as error:
        with error:
            return error.code, error.read().decode()


def token(page: str) -> str:
    found = re.search(r'"token":"([^"]+)"', page)
    assert found is not None
    return found[1]


async def connect(dashboard: Dashboard, token: str, protocol: str = "bokeh") -> WebSocketClientConnection:
    request = HTTPRequest(
        f"{dashboard.url.replace('http', 'ws')}ws",
        headers={"Origin": dashboard.url.rstrip("/"), "Sec-WebSocket-Protocol": f"{protocol}, {token}"},
        request_timeout=PATIENCE_S,
    )
    return await websocket_connect(request)


async def hear(wire: WebSocketClientConnection, kind: str) -> bool:
    """Whether a message of that kind came; false when the connection was closed."""
    while (said := await asyncio.wait_for(wire.read_message(), PATIENCE_S)) is not None:
        if isinstance(said, str) and f'"{kind}"' in said:
            return True
    return False


def test_one_more_than_there_is_room_for_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(admission, "MAX_VIEWERS", 5)
    with Dashboard(port=0) as dashboard:
        answers = [get(dashboard.url) for _ in range(20)]
        assert [status for status, _ in answers] == [200] * 5 + [503] * 15
        assert dashboard.viewers == admission.MAX_VIEWERS
        page = answers[-1][1]
        assert f"{admission.MAX_VIEWERS} pages of this dashboard are open" in page
        assert 'http-equiv="refresh"' in page
        assert get(dashboard.url + "alive")[0] == 200
        for path in ("autoload.js?bokeh-autoload-element=1", "metadata", "?bokeh-session-id=mine"):
            assert get(dashboard.url + path)[0] in (404, 503)
        assert dashboard.viewers == admission.MAX_VIEWERS


def test_a_place_is_free_again_and_nothing_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(admission, "MAX_VIEWERS", 2)
    monkeypatch.setattr("gr_ros2.dashboard.server._UNUSED_MS", 200)
    gc.collect()
    before = sum(isinstance(item, Document | LivePage) for item in gc.get_objects())
    with Dashboard(port=0) as dashboard:
        for _ in range(3):
            wait_for(lambda: get(dashboard.url)[0] == 200, "a place")
            assert 1 <= dashboard.viewers <= 2
        wait_for(lambda: dashboard.viewers == 0, "all to have left")

        def none() -> bool:
            gc.collect()
            return sum(isinstance(item, Document | LivePage) for item in gc.get_objects()) == before

        wait_for(none, "what they had to be gone")


def test_a_connection_without_a_page_makes_none_where_there_is_no_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """A page's session has ended, its token is still good, and others have come meanwhile."""
    monkeypatch.setattr(admission, "MAX_VIEWERS", 1)
    monkeypatch.setattr("gr_ros2.dashboard.server._UNUSED_MS", 200)

    async def come_back(dashboard: Dashboard, old: str, new: str) -> None:
        there = await connect(dashboard, new)
        assert await hear(there, "ACK")
        back = await connect(dashboard, old)
        assert await hear(back, "ACK")
        for part in PULL:
            await back.write_message(part)
        while (said := await asyncio.wait_for(back.read_message(), PATIENCE_S)) is not None and '"roots"' not in said:
            pass
        assert said is not None
        assert json.loads(said)["doc"]["roots"] == []
        assert dashboard.viewers == 1

    with Dashboard(port=0) as dashboard:
        old = token(get(dashboard.url)[1])
        wait_for(lambda: dashboard.viewers == 0, "the first page to be forgotten")
        asyncio.run(come_back(dashboard, old, token(get(dashboard.url)[1])))


def test_a_viewer_that_leaves_while_it_is_let_in_leaves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gr_ros2.dashboard.server._UNUSED_MS", 200)

    async def leave_at_once(dashboard: Dashboard, token: str) -> None:
        for _ in range(20):
            wire = await connect(dashboard, token)
            wire.close()

    with Dashboard(port=0) as dashboard:
        page = get(dashboard.url)[1]
        assert dashboard.viewers == 1
        asyncio.run(leave_at_once(dashboard, token(page)))
        wait_for(lambda: dashboard.viewers == 0, "the page to be forgotten")


GARBAGE = (
    *("garbage", "[" * 30_000, "{}", "[]", "7", '{"msgtype": []}', b"\xff\0", b""),
    *('{"msgid": "1", "msgtype": "NONE"}', "x" * 100_000),
)
MESSAGES = (
    ("PUSH-DOC", {"doc": {"roots": []}}),
    ("PATCH-DOC", {"events": [{"kind": "ModelChanged", "model": {"id": "none"}, "attr": "x", "new": 1}]}),
    ("PATCH-DOC", {"events": [{"kind": "RootAdded", "model": {"type": "object", "name": "Div", "id": "x"}}]}),
    ("PATCH-DOC", {"events": 3}),
    ("PATCH-DOC", []),
    ("ACK", {}),
)


def test_garbage_closes_the_connection_and_prints_nothing(records: list[logging.LogRecord]) -> None:
    messages = [(json.dumps({"msgid": "1", "msgtype": kind}), "{}", json.dumps(content)) for kind, content in MESSAGES]

    async def throw(dashboard: Dashboard, token: str) -> None:
        stays = await connect(dashboard, token)
        assert await hear(stays, "ACK")
        for parts in [*((one,) * 3 for one in GARBAGE), *messages]:
            for waits in (True, False):
                wire = await connect(dashboard, token)
                assert not waits or await hear(wire, "ACK")
                with suppress(WebSocketClosedError):  # closed after the first of them
                    for part in parts:
                        await wire.write_message(part, binary=isinstance(part, bytes))
                assert not await hear(wire, "nothing of that kind")
        for given, protocol in (("garbage", "bokeh"), ("YWJj.ZGVm", "bokeh"), (token[:-1], "bokeh"), (token, "other")):
            assert not await hear(await connect(dashboard, given, protocol), "ACK")
        for part in PULL:
            await stays.write_message(part)
        assert await hear(stays, "PULL-DOC-REPLY")

    with Dashboard(port=0) as dashboard:
        asyncio.run(throw(dashboard, token(get(dashboard.url)[1])))
        for path in ("?bokeh-token=abc", "?bokeh-session-id=", "%ff", "static/../../x"):
            assert get(dashboard.url + path)[0] in (200, 403, 404)
        assert get(dashboard.url, **{"Bokeh-Session-Id": "mine"})[0] == 200
        assert get(dashboard.url + "alive")[0] == 200
    assert [record.getMessage() for record in records if record.exc_info] == []


def test_connections_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(admission, "_MAX_CONNECTIONS", 5)
    monkeypatch.setattr(admission, "_MAX_SOCKETS", 3)
    monkeypatch.setattr(admission, "_SILENT_S", 0.5)

    async def crowd(dashboard: Dashboard, token: str) -> list[bool]:
        sockets = [await connect(dashboard, token) for _ in range(5)]
        return [await hear(wire, "ACK") for wire in sockets]

    with Dashboard(port=0) as dashboard:
        page = get(dashboard.url)[1]
        assert asyncio.run(crowd(dashboard, token(page))) == [True] * 3 + [False] * 2
        silent = [socket.create_connection(("127.0.0.1", dashboard.port), PATIENCE_S) for _ in range(20)]
        for connection in silent:  # the first five after they said nothing for too long, all others at once
            assert connection.recv(1) == b""
            connection.close()
        assert get(dashboard.url + "alive")[0] == 200


@pytest.mark.parametrize(
    ("address", "port"), [("127.0.0.1", 65_536), ("127.0.0.1", -1), ("a\0b", 0), ("a" * 70, 0), ("none.invalid", 0)]
)
def test_a_place_that_is_none(address: str, port: int) -> None:
    with pytest.raises(ConfigError, match=r"cannot be served there|a port is 0 to 65535"):
        Dashboard(address, port).start()


def test_a_host_that_nobody_resolves(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(_name: str) -> None:
        raise socket.gaierror(-2, "Name or service not known")

    monkeypatch.setattr(socket, "gethostbyname_ex", unknown)
    with Dashboard("0.0.0.0", 0) as dashboard:
        assert get(dashboard.url)[0] == 200


def test_a_page_that_cannot_be_made_leaves_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever goes wrong while it is made."""
    monkeypatch.setattr(admission, "MAX_VIEWERS", 1)
    monkeypatch.setattr("gr_ros2.dashboard.server._UNUSED_MS", 200)
    monkeypatch.setattr("gr_ros2.dashboard.live_page.tiles_html", None)
    with Dashboard(port=0) as dashboard:
        assert get(dashboard.url)[0] == 500
        monkeypatch.undo()
        wait_for(lambda: get(dashboard.url)[0] == 200, "a place")


def test_the_budget_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(admission, "SHARE", 0.25)
    budget = admission.ProcessorBudget()
    now = spent = 0.0
    while now < 100.0:
        now += budget.wait_s(now)
        budget.spend(0.15, now)
        spent += 0.15
    assert spent == pytest.approx(0.25 * (100.0 + admission.BURST_S), abs=0.3)
    now += 1000.0
    assert budget.wait_s(now) == 0  # what was not spent for a long time
    budget.spend(0.25 * admission.BURST_S + 0.1, now)
    assert budget.wait_s(now) == pytest.approx(0.4)  # is no reserve


def test_drawing_a_page_again_and_again_is_held_to_the_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    async def pull(dashboard: Dashboard, token: str) -> None:
        wire = await connect(dashboard, token)
        assert await hear(wire, "ACK")
        for _ in range(3):
            for part in PULL:
                await wire.write_message(part)
        for _ in range(3):
            assert await hear(wire, "PULL-DOC-REPLY")

    with Dashboard(port=0) as dashboard:
        spent: list[float] = []
        monkeypatch.setattr(dashboard._admission.budget, "spend", lambda processor_s, _now: spent.append(processor_s))
        asyncio.run(pull(dashboard, token(get(dashboard.url)[1])))
        assert len(spent) == 4
        assert min(spent) > 0
