"""The contenders of the race and their settings.

Invariant: the peers have the settings that their manuals offer for slow links and that measured best here.
docs/explanation/race.md gives the reason for each setting.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Literal

from gr_ros2.core.errors import ConfigError

Stack = Literal["gr-ros2", "dds", "zenoh"]

ADDRESSES = ("10.77.0.1", "10.77.0.2")
"""IP addresses of the sending and the receiving end, on the radio."""
MTU = 1500
"""Bytes of the largest IP packet. Each message of the race fits into one IP packet."""

_IP_UDP_HEADERS = 28
_ZENOH_PORT = 7447
_ZENOH_SEND_BUFFER = 8192
"""Bytes. The buffer of TCP is small, because a message that waits in it is old when it arrives."""
_ZENOH_WAIT_US = 20_000
"""us that Zenoh waits for room in its queue. With Zenoh's default of 1 ms, it dropped many messages in a row when the
computer was busy."""
_ZENOH_OPEN_MS = 2000
"""ms. Over UDP, a lost packet of the handshake costs this time. Zenoh's default is 10 s."""


@dataclass(frozen=True)
class Contender:
    """One row of the race.

    :param stack: what carries the messages
    :param reliable: whether data that is lost on the air is sent again
    :param summary: description in one line
    :param settings: ``version`` and ``compression`` of both ends and further settings of the ``source`` (`gr-ros2`);
        or ``transport`` and ``congestion`` control of Zenoh
    """

    stack: Stack
    reliable: bool
    summary: str
    settings: dict[str, Any] = field(default_factory=dict)


CONTENDERS = {
    "gr-ros2": Contender("gr-ros2", True, "version 1, compressed", {"version": 1, "compression": True, "source": {}}),
    "gr-ros2-v0": Contender(
        "gr-ros2",
        False,
        "version 0, compressed",
        {"version": 0, "compression": True, "source": {"queue_depth": 8}},
    ),
    "gr-ros2-plain": Contender(
        "gr-ros2",
        False,
        "version 0, as it is, a packet per message",
        {"version": 0, "compression": False, "source": {"queue_depth": 1}},
    ),
    "cyclone-best-effort": Contender("dds", False, "Cyclone DDS, best effort"),
    "cyclone-reliable": Contender("dds", True, "Cyclone DDS, reliable"),
    "zenoh-udp": Contender(
        "zenoh", False, "Zenoh over UDP, best effort, compressed", {"transport": "udp", "congestion": "DROP"}
    ),
    "zenoh-tcp": Contender(
        "zenoh", True, "Zenoh over TCP, compressed, waits when full", {"transport": "tcp", "congestion": "BLOCK"}
    ),
    "zenoh-tcp-drop": Contender(
        "zenoh", True, "Zenoh over TCP, compressed, drops when full", {"transport": "tcp", "congestion": "DROP"}
    ),
}


def chosen(names: Iterable[str]) -> dict[str, Contender]:
    """The contenders with these names, in the order of the table. Without names: all contenders.

    :raises ConfigError: for a name that is not in the table
    """
    wanted = set(names) or set(CONTENDERS)
    unknown = sorted(wanted - set(CONTENDERS))
    if unknown:
        raise ConfigError(f"peers = {unknown[0]!r}: no such contender; known are {', '.join(CONTENDERS)}")
    return {name: contender for name, contender in CONTENDERS.items() if name in wanted}


def cyclone_uri(peer: str, interface: str) -> str:
    """Value of ``CYCLONEDDS_URI``: this interface, one peer, no multicast, no message larger than an IP packet."""
    largest = MTU - _IP_UDP_HEADERS
    return (
        '<CycloneDDS><Domain Id="any"><General>'
        f'<Interfaces><NetworkInterface name="{interface}" multicast="false"/></Interfaces>'
        "<AllowMulticast>false</AllowMulticast>"
        f"<MaxMessageSize>{largest}B</MaxMessageSize><MaxRexmitMessageSize>{largest}B</MaxRexmitMessageSize>"
        f"<FragmentSize>{largest - 128}B</FragmentSize></General>"
        "<Discovery><ParticipantIndex>0</ParticipantIndex><MaxAutoParticipantIndex>0</MaxAutoParticipantIndex>"
        # By default, Cyclone asks a peer only at the start, even if the peer is absent or its packet is lost.
        f'<SPDPInterval>8s</SPDPInterval><Peers AddLocalhost="false"><Peer Address="{peer}" PruneDelay="inf"/></Peers>'
        "</Discovery>"
        "</Domain></CycloneDDS>"
    )


def zenoh_config(transport: str, listens: bool) -> dict[str, Any]:
    """Configuration of a session with one peer at a known address. It sends as few and as small packets as possible.

    :param transport: udp or tcp
    :param listens: whether this end waits for the connection of the other end
    """
    endpoint = f"{transport}/{ADDRESSES[1]}:{_ZENOH_PORT}"
    retry = {"period_init_ms": 500, "period_max_ms": 1000, "period_increase_factor": 1.5}
    return {
        "mode": "peer",
        ("listen" if listens else "connect"): {
            "endpoints": [endpoint],
            "timeout_ms": -1,
            "exit_on_failure": False,
            "retry": retry,
        },
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "timestamping": {"enabled": False},
        "transport": {
            "shared_memory": {"enabled": False},
            "unicast": {
                "compression": {"enabled": True},
                "open_timeout": _ZENOH_OPEN_MS,
                "accept_timeout": _ZENOH_OPEN_MS,
            },
            "link": {
                "tcp": {"so_sndbuf": _ZENOH_SEND_BUFFER, "so_rcvbuf": _ZENOH_SEND_BUFFER},
                "tx": {
                    "batch_size": MTU - _IP_UDP_HEADERS,
                    "queue": {"congestion_control": {"drop": {"wait_before_drop": _ZENOH_WAIT_US}}},
                },
            },
        },
    }
