"""The control socket: any bytes get one line of JSON as answer, the next client too; a client accepts any answer."""

from __future__ import annotations

import os
import socket
import tempfile
import time
from collections.abc import Mapping
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

from fuzz.loop import KEPT, main, within
from gr_ros2.cli.control_socket import ControlSocket, parse, receive

_PATIENCE_S = 60.0
BASE, PER_BYTE = 1500, 1
"""Lines of Python that a line may take, and more for each byte of it."""


def control_socket(data: bytes) -> None:
    """One client's bytes, then a client who knows what to say."""
    within(BASE + PER_BYTE * len(data), partial(_parsed, data))
    path = _server()
    assert "name" in (said := _say(path, data)) or "error" in said
    assert _say(path, b'{"port": 7, "address": "x"}\n') == {"name": "fuzzed", "url": "x:7"}


def _parsed(data: bytes) -> None:
    with suppress(ValueError):
        assert isinstance(parse(data), Mapping)


def _say(path: Path, data: bytes) -> Mapping[str, Any]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.settimeout(_PATIENCE_S)
        client.connect(str(path))
        client.sendall((data or b" ")[:4095].replace(b"\n", b" ") + b"\n")  # one line, as long as the socket takes
        return parse(receive(client, 4096, time.monotonic() + _PATIENCE_S, b"\n"))


@cache
def _server() -> Path:
    where = KEPT.enter_context(tempfile.TemporaryDirectory())
    with patch.dict(os.environ, {"XDG_RUNTIME_DIR": where}):
        server = ControlSocket("fuzzed", lambda asked: {"url": f"{asked['address']}:{int(asked['port'])}"})
    KEPT.enter_context(server)
    KEPT.callback(_server.cache_clear)
    return next(Path(where).rglob("*.sock"))


def corpus() -> list[bytes]:
    """What clients say, and what is hard on parsers."""
    return [
        b"{}",
        b'{"address": "127.0.0.1", "port": 5006}',
        b'{"port": Infinity, "address": null}',
        b'{"port": -1e999, "address": [[]]}',
        b'{"port": ' + b"9" * 3000 + b', "address": "x"}',
        b"[" * 4000,
        b'{"a":' * 800,
        b'"\\ud800"',
        b"\xff\xfe{\0}\0",
        b"",
    ]


if __name__ == "__main__":
    main(control_socket, corpus())
