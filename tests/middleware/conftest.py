"""What tests of the middlewares share: a DDS domain of their own, and a Zenoh router, as rmw_zenoh needs one."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from gr_ros2.middleware.dds import DdsMiddleware
from tests.domains import free_domains


@pytest.fixture
def domain() -> int:
    """A DDS domain nobody uses."""
    return free_domains(1)[0]


@pytest.fixture
def graph(domain: int) -> Iterator[DdsMiddleware]:
    """The DDS graph of that domain on this host."""
    with DdsMiddleware(domain_id=domain, localhost_only=True) as graph:
        yield graph


@pytest.fixture(scope="session")
def router(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Its endpoint: a Unix socket, since a port found free may be taken by another before it is used."""
    import zenoh

    endpoint = f"unixsock-stream/{tmp_path_factory.mktemp('zenoh')}/router"
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
