"""Admission of viewers: the limits of the dashboard's web server, and the page for viewers beyond the limit.

Invariants: at most MAX_VIEWERS pages are open at a time. A further viewer gets a page that says so and tries again.
Pages are made and drawn for the first time one after another; on average this takes at most a quarter of a core. The
number of connections is bounded, and silent connections are closed. Whatever arrives on a WebSocket, the worst result
is that this WebSocket is closed. A WebSocket belongs to a page that this server has served.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from bokeh.document import Document
from bokeh.protocol.exceptions import ProtocolError
from bokeh.server.connection import ServerConnection
from bokeh.server.contexts import ApplicationContext
from bokeh.server.session import ServerSession
from bokeh.server.tornado import BokehTornado
from bokeh.server.views.doc_handler import DocHandler
from bokeh.server.views.ws import WSHandler
from jinja2 import Environment, FileSystemLoader
from tornado.httpserver import HTTPServer
from tornado.iostream import IOStream
from tornado.web import ErrorHandler

MAX_VIEWERS = 8
"""Most pages at a time. Each takes about 2 % of a core and 2 MB."""
_RETRY_S = 10
"""s after which the page for a refused viewer tries again."""
SHARE, BURST_S = 0.25, 4.0
"""Share of a core for making pages and drawing them for the first time; and the s whose share may be used at once."""
_MAX_SOCKETS = 2 * MAX_VIEWERS
"""Most WebSockets at a time. A page that is reloaded has two for a moment."""
_MAX_CONNECTIONS = 256
"""Most connections at a time that are not a WebSocket. A browser opens up to six."""
_SILENT_S = 15
"""s that a connection may take for a request, or for an answer to a ping."""
_MAX_BODY, _MAX_HEADER = 1 << 12, 1 << 14
_MAX_FRAME = 65_536
"""Most bytes of a WebSocket message. A viewer sends positions of sliders."""
_TRY_AGAIN_LATER, _NOT_UNDERSTOOD = 1013, 1002
"""Status codes with which a WebSocket is closed (RFC 6455, section 7.4, and IANA's registry)."""
_UNDERSTOOD = ("PULL-DOC-REQ", "PATCH-DOC")
_CHANGES = ("ModelChanged", "MessageSent")
_log = logging.getLogger(__name__)
_TEMPLATES = Path(__file__).parent / "templates"

SETTINGS: dict[str, Any] = {
    "sign_sessions": True,
    "include_headers": [],
    "include_cookies": [],  # other programs' cookies on this host would make the token too long for a header
    "keep_alive_milliseconds": 0,  # Bokeh's pings expect no answer; these do:
    "websocket_ping_interval": _SILENT_S,
    "websocket_ping_timeout": _SILENT_S,
    "websocket_max_message_size_bytes": _MAX_FRAME,
    "log_function": lambda _handler: None,
}
"""Settings of the Bokeh application."""


class Admission:
    """Counts the open pages and WebSockets."""

    def __init__(self) -> None:
        self.documents: set[Document] = set()
        self.waiting = 0
        self.sockets: set[PageSocket] = set()
        self.budget = ProcessorBudget()
        self._busy = asyncio.Lock()

    @property
    def full(self) -> bool:
        """Whether the limit of pages is reached."""
        return len(self.documents) + self.waiting >= MAX_VIEWERS

    def enter(self, document: Document) -> bool:
        """Admit a page if there is room. Return whether there was. Its place is free again when the session ends."""
        if len(self.documents) >= MAX_VIEWERS:
            return False
        self.documents.add(document)
        document.on_session_destroyed(lambda _context: self.documents.discard(document))
        return True

    @asynccontextmanager
    async def turn(self) -> AsyncIterator[None]:
        """Run long work, one piece after another, within the budget."""
        async with self._busy:
            await asyncio.sleep(self.budget.wait_s(time.monotonic()))
            begin = time.thread_time()
            try:
                yield
            finally:
                self.budget.spend(time.thread_time() - begin, time.monotonic())


class ProcessorBudget:
    """Budget of processor time: a share of the last BURST_S seconds."""

    def __init__(self) -> None:
        self._paid_until = -math.inf

    def wait_s(self, now: float) -> float:
        """s until processor time may be used again."""
        return max(0.0, self._paid_until - now)

    def spend(self, processor_s: float, now: float) -> None:
        """Record used processor time."""
        self._paid_until = max(self._paid_until, now - BURST_S) + processor_s / SHARE


def keep(pages: BokehTornado, admission: Admission) -> None:
    """Apply these limits to an application."""
    inside = {"application_context": pages.applications["/"], "bokeh_websocket_path": "/ws"}
    pages.add_handlers(
        ".*",
        [
            (r"/?", PageHandler, {**inside, "admission": admission}),
            (r"/ws", PageSocket, {**inside, "admission": admission}),
            (r"/(?:metadata|autoload\.js)", ErrorHandler, {"status_code": 404}),  # they would create pages too
        ],
    )


class BoundedServer(HTTPServer):  # type: ignore[misc]
    """An HTTP server that limits the number of connections, the size of their data, and their duration."""

    def initialize(self, *arguments: Any, **options: Any) -> None:
        self._here = 0
        bounds = {"max_body_size": _MAX_BODY, "max_header_size": _MAX_HEADER}
        super().initialize(*arguments, idle_connection_timeout=_SILENT_S, body_timeout=_SILENT_S, **bounds, **options)

    def handle_stream(self, stream: IOStream, address: tuple[Any, ...]) -> None:
        if self._here >= _MAX_CONNECTIONS:
            stream.close()
            return
        self._here += 1
        super().handle_stream(stream, address)

    def on_close(self, server_conn: object) -> None:
        self._here -= 1
        super().on_close(server_conn)


class PageHandler(DocHandler):  # type: ignore[misc]
    """Serves the page, or the page that says that there is no room."""

    def initialize(
        self, application_context: ApplicationContext, bokeh_websocket_path: str, admission: Admission
    ) -> None:
        del application_context, bokeh_websocket_path  # taken by the constructor
        self._admission = admission

    async def get(self, *arguments: Any, **named: Any) -> None:
        admission = self._admission
        if admission.full:
            self._refuse()
            return
        # Every request gets a new page: a client cannot choose a session.
        self.request.arguments.clear()
        self.request.headers.pop("Bokeh-Session-Id", None)
        admission.waiting += 1
        try:
            async with admission.turn():
                await super().get(*arguments, **named)
        finally:
            admission.waiting -= 1

    def _refuse(self) -> None:
        page = Environment(loader=FileSystemLoader(_TEMPLATES), autoescape=True).get_template("full.html.j2")
        self.set_status(503)
        self.set_header("Retry-After", str(_RETRY_S))
        self.set_header("Cache-Control", "no-store")
        self.set_header("Connection", "close")
        self.finish(page.render(viewers=MAX_VIEWERS, seconds=_RETRY_S))


class PageSocket(WSHandler):  # type: ignore[misc]
    """The connection between a page and its document."""

    connection: ServerConnection | None

    def initialize(
        self, application_context: ApplicationContext, bokeh_websocket_path: str, admission: Admission
    ) -> None:
        del application_context, bokeh_websocket_path  # taken by the constructor
        self._admission = admission
        self._open = True

    def open(self) -> None:
        if len(self._admission.sockets) >= _MAX_SOCKETS:
            self.close(_TRY_AGAIN_LATER, "too many viewers")
            return
        self._admission.sockets.add(self)
        try:
            super().open()
        except Exception:  # noqa: BLE001 - an invalid token, or one of another server, fails in many ways
            self.close(_NOT_UNDERSTOOD)

    async def _async_open(self, token: str) -> None:
        try:
            await super()._async_open(token)
        except Exception:  # noqa: BLE001 - as above
            self.close(_NOT_UNDERSTOOD)
        if not self._open:  # the viewer left meanwhile, and nothing else would tell its session
            self._leave()

    async def on_message(self, fragment: str | bytes) -> None:
        """Take a part of a message. A message that a viewer's page does not send closes the connection."""
        if self.connection is None:
            self.close(_NOT_UNDERSTOOD)
            return
        try:
            message = await self.receiver.consume(fragment)
            if message is None:
                return
            if not _is_viewers(message):
                raise ProtocolError(f"no viewer's page sends {message.msgtype}")
            if message.msgtype == "PULL-DOC-REQ":
                async with self._admission.turn():
                    answer = await ServerSession.pull(message, self.connection)
            else:
                answer = await ServerSession.patch(message, self.connection)
            await self.send_message(answer)
        except Exception as error:  # noqa: BLE001 - parsers fail in many ways on invalid data
            _log.info("a viewer's connection is closed, since it sent what is not understood: %r", error)
            self.close(_NOT_UNDERSTOOD)

    def on_pong(self, data: bytes) -> None:
        """Do nothing: the answer shows that the viewer is still there."""

    def on_close(self) -> None:
        self._open = False
        self._admission.sockets.discard(self)
        self._leave()

    def _leave(self) -> None:
        """Give the session back, only once. A connection without a session cannot give one back."""
        if self.connection is not None:
            super().on_close()
            self.connection = None


def _is_viewers(message: Any) -> bool:
    """Whether a viewer's page sends such a message. The page may change models, but not add or remove them."""
    if message.msgtype not in _UNDERSTOOD:
        return False
    events = message.content.get("events", []) if message.msgtype == "PATCH-DOC" else []
    return all(event["kind"] in _CHANGES for event in events)
