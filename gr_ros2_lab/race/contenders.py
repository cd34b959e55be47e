"""The contenders of the races and their settings.

Invariant: the peers have the settings that their manuals offer for slow links and that measured best here.
docs/explanation/race.md gives the reason for each setting.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Literal

from gr_ros2.core.errors import ConfigError

Stack = Literal["gr-ros2", "dds", "zenoh"]
Races = Literal["two", "row", "team"]
"""The race of one robot and another with odometry alone, its rows with more, and that of a team."""


def address_of(robot: int) -> str:
    """IP address of a robot on the radio, by its number from 0."""
    return f"10.77.0.{robot + 1}"


ADDRESSES = (address_of(0), address_of(1))
"""IP addresses of the sending and the receiving end, on the radio."""
MTU = 1500
"""Bytes of the largest IP packet. Each message of the race fits into one IP packet."""

_IP_UDP_HEADERS = 28
_ZENOH_PORT = 7447
_ZENOH_GROUP = "224.0.0.224"
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
    :param settings: settings of both robots, and what the ``paper``'s blocks have beside them (`gr-ros2`);
        ``transport`` (multicast, udp or tcp) and ``congestion`` control of Zenoh; what waits in the ``queue`` of a
        topic of a team
    :param races: in which it takes part
    """

    stack: Stack
    reliable: bool
    summary: str
    settings: dict[str, Any] = field(default_factory=dict)
    races: tuple[Races, ...] = ("two", "row", "team")

    @property
    def compresses(self) -> bool:
        """Of gr-ros2, whether messages are coded."""
        return bool(self.settings.get("paper", {"compression": True}).get("compression"))


CONTENDERS = {
    "gr-ros2": Contender("gr-ros2", True, "version 1, compressed"),
    "gr-ros2-v0": Contender(
        "gr-ros2",
        False,
        "version 0, compressed",
        {"queue_depth": 8, "paper": {"compression": True}},
        ("two",),
    ),
    "gr-ros2-plain": Contender(
        "gr-ros2",
        False,
        "version 0, as it is, a packet per message",
        {"queue_depth": 1, "paper": {}},
        ("two",),
    ),
    "gr-ros2-latest": Contender(
        "gr-ros2", False, "the newest message of each robot only", {"queue": "latest"}, ("row", "team")
    ),
    "cyclone-best-effort": Contender("dds", False, "Cyclone DDS, best effort"),
    "cyclone-reliable": Contender("dds", True, "Cyclone DDS, reliable"),
    "zenoh-multicast": Contender(
        "zenoh",
        False,
        "Zenoh over UDP multicast, best effort, compressed",
        {"transport": "multicast", "congestion": "DROP"},
        ("team",),
    ),
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


def chosen(names: Iterable[str], races: Races = "two") -> dict[str, Contender]:
    """The contenders of a race with these names, in the order of the table. Without names: all of them.

    :raises ConfigError: for a name that is not in the table
    """
    known = {name: contender for name, contender in CONTENDERS.items() if races in contender.races}
    wanted = set(names) or set(known)
    unknown = sorted(wanted - set(known))
    if unknown:
        raise ConfigError(f"peers = {unknown[0]!r}: no such contender; known are {', '.join(known)}")
    return {name: contender for name, contender in known.items() if name in wanted}


def cyclone_uri(interface: str, peer: str = "") -> str:
    """Value of ``CYCLONEDDS_URI``: this interface, no message larger than an IP packet.

    :param peer: address of the only other one, without multicast; '' = all are found and reached by multicast
    """
    largest = MTU - _IP_UDP_HEADERS
    multicast = "false" if peer else "true"
    # By default, Cyclone asks a peer only at the start, even if the peer is absent or its packet is lost.
    peers = f'<Peers AddLocalhost="false"><Peer Address="{peer}" PruneDelay="inf"/></Peers>' if peer else ""
    return (
        '<CycloneDDS><Domain Id="any"><General>'
        f'<Interfaces><NetworkInterface name="{interface}" multicast="{multicast}"/></Interfaces>'
        f"<AllowMulticast>{multicast}</AllowMulticast>"
        f"<MaxMessageSize>{largest}B</MaxMessageSize><MaxRexmitMessageSize>{largest}B</MaxRexmitMessageSize>"
        f"<FragmentSize>{largest - 128}B</FragmentSize></General>"
        "<Discovery><ParticipantIndex>0</ParticipantIndex><MaxAutoParticipantIndex>0</MaxAutoParticipantIndex>"
        f"<SPDPInterval>8s</SPDPInterval>{peers}</Discovery>"
        "</Domain></CycloneDDS>"
    )


def zenoh_config(transport: str, number: int, robots: int, interface: str, *, latched: bool = False) -> dict[str, Any]:
    """Configuration of a session with peers at known addresses. It sends as few and as small packets as possible.

    :param transport: multicast, or udp or tcp to each of the others
    :param number: of this robot, from 0; it connects to those after it
    :param robots: how many there are
    :param latched: whether anything is kept for late joiners, for which Zenoh needs timestamps
    """
    begin = {
        "timeout_ms": -1,
        "exit_on_failure": False,
        "retry": {"period_init_ms": 500, "period_max_ms": 1000, "period_increase_factor": 1.5},
    }
    if transport == "multicast":
        endpoints = [f"udp/{_ZENOH_GROUP}:{_ZENOH_PORT}#iface={interface}"]
        later = []
    else:
        places = [f"{transport}/{address_of(robot)}:{_ZENOH_PORT}" for robot in range(robots)]
        endpoints, later = [places[number]], places[number + 1 :]
    return {
        "mode": "peer",
        "listen": {"endpoints": endpoints, **begin},
        "connect": {"endpoints": later, **begin},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "timestamping": {"enabled": latched},
        "transport": {
            "shared_memory": {"enabled": False},
            "multicast": {"compression": {"enabled": True}},
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
