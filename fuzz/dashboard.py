"""The dashboard's web server: whatever comes over a connection costs little and prints nothing, and the next is served.

The first byte of an input says where the rest goes: into a bare connection, or, cut at every byte 30, into the frames
of a WebSocket such as a viewer's page opens.
"""

from __future__ import annotations

import base64
import json
import logging
import math
import re
import socket
import threading
import time
from contextlib import suppress
from functools import cache
from unittest.mock import patch
from urllib.request import urlopen

from fuzz.loop import KEPT, main
from gr_ros2.cli.control_socket import receive
from gr_ros2.dashboard import admission
from gr_ros2.dashboard.server import Dashboard

_PATIENCE_S = 60.0
BASE_S, BYTE_S = 0.4, 1e-5
"""s of processor time that one client's bytes may take the server, and more for each byte. Drawing a page for the
first time takes 0.13 s; how often that may be asked for is left out here."""
_CUT = b"\x1e"
_TEXT, _BINARY, _CLOSE = 1, 2, 8


class _Tracebacks(logging.Handler):
    """Remembers what would be printed with a traceback."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        if record.exc_info:
            self.found.append(self.format(record))


class _Served:
    """One server, and a viewer that stays so that its page does."""

    def __init__(self) -> None:
        KEPT.enter_context(patch.object(admission, "SHARE", math.inf))
        self.dashboard = KEPT.enter_context(Dashboard(port=0))
        self.tracebacks = _Tracebacks()
        logging.getLogger().addHandler(self.tracebacks)
        KEPT.callback(logging.getLogger().removeHandler, self.tracebacks)
        (thread,) = [thread for thread in threading.enumerate() if thread.name == "gr-ros2-dashboard"]
        assert thread.ident is not None
        self._clock = time.pthread_getcpuclockid(thread.ident)
        with urlopen(self.dashboard.url, timeout=_PATIENCE_S) as answer:
            token = re.search(r'"token":"([^"]+)"', answer.read().decode())
        assert token is not None
        self.token = token[1]
        self._stays = KEPT.enter_context(self.wire())

    @property
    def spent_s(self) -> float:
        """Processor time of the server's thread."""
        return time.clock_gettime(self._clock)

    def connect(self) -> socket.socket:
        return socket.create_connection(("127.0.0.1", self.dashboard.port), _PATIENCE_S)

    def wire(self) -> socket.socket:
        """A WebSocket that has heard the server's first message."""
        lines = (
            *("GET /ws HTTP/1.1", f"Host: 127.0.0.1:{self.dashboard.port}", "Connection: Upgrade"),
            *("Upgrade: websocket", "Sec-WebSocket-Version: 13"),
            f"Sec-WebSocket-Key: {base64.b64encode(bytes(16)).decode()}",
            f"Sec-WebSocket-Protocol: bokeh, {self.token}",
            *(f"Origin: {self.dashboard.url.rstrip('/')}", "", ""),
        )
        connection = self.connect()
        connection.sendall("\r\n".join(lines).encode())
        opened = receive(connection, 1 << 16, time.monotonic() + _PATIENCE_S, b'"ACK"')
        assert b" 101 " in opened
        assert b'"ACK"' in opened
        return connection


def dashboard(data: bytes) -> None:
    """One client's bytes, then a client who asks whether it is there."""
    served = _served()
    before = served.spent_s
    where, rest = (data[0] if data else 0) % 3, data[1:]
    with served.wire() if where else served.connect() as connection, suppress(ConnectionError):
        if where:
            for part in rest.split(_CUT):
                connection.sendall(frame(part, _TEXT if where == 1 else _BINARY))
            connection.sendall(frame(b"\x03\xe8", _CLOSE))
        else:
            connection.sendall(rest)
            connection.shutdown(socket.SHUT_WR)
        receive(connection, 1 << 24, time.monotonic() + _PATIENCE_S)
    with urlopen(f"{served.dashboard.url}alive", timeout=_PATIENCE_S) as answer:
        assert b"instance" in answer.read()
    spent = served.spent_s - before
    assert spent <= BASE_S + BYTE_S * len(data), f"{spent * 1e3:.1f} ms of processor time"
    assert not served.tracebacks.found, served.tracebacks.found[0]


def frame(data: bytes, opcode: int) -> bytes:
    """One frame of a client (RFC 6455, section 5.2), its mask zero."""
    length = len(data)
    head = bytes([0x80 | opcode]) + (bytes([0x80 | length]) if length < 126 else b"\xfe" + length.to_bytes(2, "big"))
    return head + bytes(4) + data


@cache
def _served() -> _Served:
    logging.getLogger("bokeh").setLevel(logging.ERROR)  # it warns of every viewer that leaves
    KEPT.callback(_served.cache_clear)
    return _Served()


def message(kind: str, content: object) -> bytes:
    """A message of Bokeh's protocol."""
    return _CUT.join(json.dumps(part).encode() for part in ({"msgid": "1", "msgtype": kind}, {}, content))


def corpus() -> list[bytes]:
    """Requests and messages as browsers send them, and what is hard on parsers."""
    changed = {"kind": "ModelChanged", "model": {"id": "p1001"}, "attr": "value", "new": 3}
    ready = {"kind": "MessageSent", "msg_type": "bokeh_event", "msg_data": {"type": "event", "name": "document_ready"}}
    added = {"kind": "RootAdded", "model": {"type": "object", "name": "Div", "id": "x"}}
    sent = [
        message("PULL-DOC-REQ", {}),
        message("SERVER-INFO-REQ", {}),
        message("PATCH-DOC", {"events": [changed]}),
        message("PATCH-DOC", {"events": [ready, added]}),
        message("PUSH-DOC", {"doc": {"roots": []}}),
        b"[" * 4000,
        b"{}",
        b"\xff\xfe",
    ]
    request = b"%s HTTP/1.1\r\nHost: x\r\n\r\n"
    bare = [request % b"GET /alive", request % b"GET /nothing", request % b"POST /", b"\x16\x03\x01", b"GET " * 1000]
    bare.append(b"GET /alive HTTP/1.1\r\nContent-Length: 99999999999\r\n\r\n")
    return [b"", *(b"\0" + data for data in bare), *(kind + data for data in sent for kind in (b"\1", b"\2"))]


if __name__ == "__main__":
    main(dashboard, corpus())
