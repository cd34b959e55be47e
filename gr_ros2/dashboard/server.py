"""The dashboard's web server: its own thread beside a run, for several viewers.

Invariants: without a viewer, the server does little more than count. With the most viewers that ``admission`` allows,
it leaves most of a core to the link. By default it serves on a loopback address, and only its own pages may connect to
it. Before it closes, it shows every viewer the last picture. It leaves no thread.
"""

from __future__ import annotations

import asyncio
import secrets
import socket
import threading
import uuid
from concurrent.futures import Future
from contextlib import suppress
from typing import Any

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from bokeh.server.util import bind_sockets
from tornado.ioloop import IOLoop, PeriodicCallback
from tornado.web import RequestHandler

from gr_ros2.core.closing import Closing
from gr_ros2.core.errors import ConfigError, reason
from gr_ros2.dashboard.addresses import ANY, bracketed, exposed, in_url, own_addresses
from gr_ros2.dashboard.admission import SETTINGS, Admission, BoundedServer, keep
from gr_ros2.dashboard.live_page import LivePage
from gr_ros2.dashboard.monitor import TICK_S, RunMonitor
from gr_ros2.observe.result import RunResult

_LOOK_S = 0.1
_LAST_PICTURE_S = 2.0
"""s that a viewer has to draw the last picture before the server ends."""
_POLL_S = 0.02
_UNUSED_MS = 5000
"""ms that a closed page is kept, in case its viewer comes back."""


class Dashboard(Closing, RunMonitor):
    """A monitor with a web page.

    :param address: address to serve on; 0.0.0.0 for every interface
    :param port: 1..65535, 0 = any free one
    """

    def __init__(self, address: str = "127.0.0.1", port: int = 5006) -> None:
        super().__init__()
        self.address = address
        self.port = port
        self._instance = uuid.uuid4().hex
        self._pages: set[LivePage] = set()
        self._admission = Admission()
        self._loop: IOLoop | None = None
        self._thread: threading.Thread | None = None

    @property
    def url(self) -> str:
        """Address of the page. Where every interface serves it, one under which others reach it, if there is one."""
        return f"http://{in_url(self.address)}:{self.port}/"

    @property
    def exposed(self) -> bool:
        """Whether others than this machine can open the page."""
        return exposed(self.address)

    @property
    def viewers(self) -> int:
        """Number of open pages."""
        return len(self._pages)

    def start(self) -> None:
        """Start to serve.

        :raises ConfigError: when it cannot serve at this address and port
        """
        if not 0 <= self.port <= 65535:  # a socket would take it modulo 65536
            raise ConfigError(f"dashboard = {self.address}:{self.port}: a port is 0 to 65535")
        started: Future[None] = Future()
        self._thread = threading.Thread(target=self._serve, args=(started,), name="gr-ros2-dashboard", daemon=True)
        self._thread.start()
        try:
            started.result()
        except (OSError, ValueError) as error:  # an invalid host name raises no OSError
            self._thread.join()
            raise ConfigError(
                f"dashboard = {self.address}:{self.port}: cannot be served there ({reason(error)}); choose another "
                "address or port"
            ) from error

    def close(self) -> None:
        """Let every viewer draw the last picture, then stop serving. Idempotent."""
        if self._loop is not None and self._thread is not None:
            loop, self._loop = self._loop, None
            loop.add_callback(self._leave, loop)
            self._thread.join()

    def run_ended(self, result: RunResult | None) -> None:
        super().run_ended(result)
        if self._loop is not None:
            self._loop.add_callback(self._show, always=True)

    def __enter__(self) -> Dashboard:
        self.start()
        return self

    def _serve(self, started: Future[None]) -> None:
        asyncio.set_event_loop(asyncio.new_event_loop())
        loop = IOLoop.current()
        try:
            server = self._build(loop)
        except Exception as error:  # noqa: BLE001 - raised again by the thread that waits for it
            loop.close(all_fds=True)
            started.set_exception(error)
            return
        server.start()
        for callback, seconds in ((self._beat, TICK_S), (self._look_if_viewed, _LOOK_S)):
            PeriodicCallback(callback, seconds * 1000).start()
        self._loop = loop
        started.set_result(None)
        loop.start()
        server.stop()
        loop.close(all_fds=True)

    def _build(self, loop: IOLoop) -> BaseServer:
        sockets, self.port = bind_sockets(self.address, self.port)
        pages = BokehTornado(
            {"/": Application(FunctionHandler(self._open))},
            extra_websocket_origins=self._origins(),
            extra_patterns=[("/alive", _Alive, {"instance": self._instance})],
            check_unused_sessions_milliseconds=_UNUSED_MS,
            unused_session_lifetime_milliseconds=_UNUSED_MS,
            secret_key=secrets.token_bytes(32),
            **SETTINGS,
        )
        keep(pages, self._admission)
        http = BoundedServer(pages)
        http.add_sockets(sockets)
        return BaseServer(loop, pages, http)

    def _origins(self) -> list[str]:
        """Host names, with the port, under which the page may be opened."""
        hosts = {self.address, "localhost"} if self.address in ("127.0.0.1", "::1") else {self.address}
        if self.address in ANY:
            name = socket.gethostname()
            hosts = {self.address, "localhost", name, socket.getfqdn(), *own_addresses()}
            with suppress(OSError):  # the host cannot resolve its own name
                hosts.update(socket.gethostbyname_ex(name)[2])
        return [f"{bracketed(host)}:{self.port}" for host in sorted(hosts)]

    def _open(self, document: Document) -> None:
        """Make the page of a new viewer."""
        if not self._admission.enter(document):
            return  # a WebSocket came without a request for its page, and there is no room
        page = LivePage(document, self, self._instance)
        self._pages.add(page)
        document.on_session_destroyed(lambda _context: self._pages.discard(page))

    def _beat(self) -> None:
        self.tick()
        self._show()

    def _look_if_viewed(self) -> None:
        if self._pages:
            self.look()

    def _show(self, always: bool = False) -> None:
        for page in list(self._pages):
            page.offer(self.snapshot, self.radio, always)

    async def _leave(self, loop: IOLoop) -> None:
        self._show(always=True)
        await asyncio.sleep(_POLL_S)
        deadline = loop.time() + _LAST_PICTURE_S
        while any(page.behind for page in self._pages) and loop.time() < deadline:
            await asyncio.sleep(_POLL_S)
        loop.stop()


class _Alive(RequestHandler):  # type: ignore[misc]
    """Tells a page whether the server that made it is still there."""

    def initialize(self, instance: str) -> None:
        self._instance = instance

    def get(self) -> None:
        self.set_header("Cache-Control", "no-store")
        answer: dict[str, Any] = {"instance": self._instance}
        self.finish(answer)
