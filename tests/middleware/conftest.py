"""A Zenoh router of the tests' own, as rmw_zenoh needs one."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest


@pytest.fixture(scope="session")
def router() -> Iterator[str]:
    """Its endpoint."""
    import zenoh

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    config = zenoh.Config()
    for key, value in {
        "mode": '"router"',
        "listen/endpoints": f'["{endpoint}"]',
        "scouting/multicast/enabled": "false",
    }.items():
        config.insert_json5(key, value)
    with zenoh.open(config):
        yield endpoint


@pytest.fixture
def zenoh_router(router: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """Its endpoint, which sessions opened in the test connect to."""
    monkeypatch.setenv("ZENOH_CONFIG_OVERRIDE", f'connect/endpoints=["{router}"]')
    monkeypatch.delenv("ZENOH_SESSION_CONFIG_URI", raising=False)
    return router
