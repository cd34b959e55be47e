"""The contenders of the races and their settings.

Invariant: the peers have the settings that their manuals offer for slow links and that measured best here.
docs/explanation/race.md gives the reason for each setting.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Literal

from gr_ros2.core.errors import ConfigError

Stack = Literal["gr-ros2", "dds", "fast", "zenoh"]
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
QUEUE = "queue_bytes"
"""Name of the setting that says how many bytes may wait before the interface of a DDS."""
_PAYLOAD = MTU - _IP_UDP_HEADERS
CYCLONE: dict[str, Any] = {
    "General/MaxMessageSize": f"{_PAYLOAD}B",
    "General/MaxRexmitMessageSize": f"{_PAYLOAD}B",
    "General/FragmentSize": f"{_PAYLOAD - 128}B",
    "Discovery/SPDPInterval": "8s",
    "Internal/NackDelay": "10ms",
    "Internal/HeartbeatInterval": "300ms",
    'Internal/SocketSendBufferSize min="8kB" max="8kB"': "",
    QUEUE: 64_000,
}
"""Of Cyclone DDS, by path in its configuration: no message larger than an IP packet; a peer that was absent, or whose
packet was lost, is asked again; what is lost is asked for sooner; who sends waits for a slow link, for which the queue
before the interface has to hold more than the socket."""
FAST: dict[str, Any] = {"message": _PAYLOAD, "heartbeat": 0.05}
"""Of Fast DDS: bytes of the largest ``message``, s between ``heartbeat``s, ``nack`` and ``send_buffer``."""
ZENOH: dict[str, Any] = {
    "transport/unicast/compression/enabled": True,
    "transport/multicast/compression/enabled": True,
    # Over UDP, a lost packet of the handshake costs this time, in ms. Zenoh's default is 10 s.
    "transport/unicast/open_timeout": 2000,
    "transport/unicast/accept_timeout": 2000,
    # A message that waits in TCP's buffer is old when it arrives.
    "transport/link/tcp/so_sndbuf": 8192,
    "transport/link/tcp/so_rcvbuf": 8192,
    "transport/link/tx/batch_size": _PAYLOAD,
}
"""Of Zenoh, by path in its configuration."""
_ZENOH_RMW: dict[str, Any] = {
    "transport/unicast/open_timeout": 60_000,
    "transport/unicast/accept_timeout": 60_000,
    "transport/link/tx/lease": 60_000,
    "transport/link/tx/keep_alive": 2,
}
"""What the configuration of rmw_zenoh's router sets otherwise than Zenoh does."""


@dataclass(frozen=True)
class Contender:
    """One row of the race.

    :param stack: what carries the messages
    :param reliable: whether data that is lost on the air is sent again
    :param summary: description in one line
    :param settings: settings of both robots, and what the ``paper``'s blocks have beside them (`gr-ros2`);
        ``transport`` (multicast, udp or tcp) and ``congestion`` control of Zenoh; what waits in the ``queue`` of a
        topic of a team; of the peers, what their profile has beside address and interface
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
    "cyclone-stock": Contender("dds", True, "Cyclone DDS as it comes, reliable", {}, ("two", "row")),
    "cyclone-best-effort": Contender("dds", False, "Cyclone DDS, best effort", CYCLONE),
    "cyclone-reliable": Contender("dds", True, "Cyclone DDS, reliable", CYCLONE),
    "fast-stock": Contender("fast", True, "Fast DDS as it comes, reliable", {}, ("two", "row")),
    "fast-best-effort": Contender("fast", False, "Fast DDS, best effort", FAST, ("two", "row")),
    "fast-reliable": Contender("fast", True, "Fast DDS, reliable", FAST, ("two", "row")),
    "zenoh-stock": Contender(
        "zenoh", True, "Zenoh over TCP as rmw_zenoh has it", {"transport": "tcp", "congestion": "DROP"}, ("two", "row")
    ),
    "zenoh-multicast": Contender(
        "zenoh",
        False,
        "Zenoh over UDP multicast, best effort, compressed",
        {"transport": "multicast", "congestion": "DROP", **ZENOH},
        ("team",),
    ),
    "zenoh-udp": Contender(
        "zenoh", False, "Zenoh over UDP, best effort, compressed", {"transport": "udp", "congestion": "DROP", **ZENOH}
    ),
    "zenoh-tcp": Contender(
        "zenoh",
        True,
        "Zenoh over TCP, compressed, waits when full",
        {"transport": "tcp", "congestion": "BLOCK", **ZENOH},
    ),
    "zenoh-tcp-drop": Contender(
        "zenoh",
        True,
        "Zenoh over TCP, compressed, drops when full",
        {"transport": "tcp", "congestion": "DROP", **ZENOH},
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


def cyclone_uri(interface: str, peer: str, settings: dict[str, Any]) -> str:
    """Value of ``CYCLONEDDS_URI``: this interface, and settings by their path.

    :param peer: address of the only other one, without multicast; '' = all are found and reached by multicast
    """
    multicast = "false" if peer else "true"
    parts = {
        "General": f'<Interfaces><NetworkInterface name="{interface}" multicast="{multicast}"/></Interfaces>'
        f"<AllowMulticast>{multicast}</AllowMulticast>",
        "Discovery": "<ParticipantIndex>0</ParticipantIndex><MaxAutoParticipantIndex>0</MaxAutoParticipantIndex>",
    }
    if peer:
        # By default, Cyclone asks a peer only at the start, even if the peer is absent or its packet is lost.
        forever = ' PruneDelay="inf"' if settings else ""
        parts["Discovery"] += f'<Peers AddLocalhost="false"><Peer Address="{peer}"{forever}/></Peers>'
    for path, value in settings.items():
        part, _, name = path.partition("/")
        if name:  # what has no path is for the race itself
            parts[part] = parts.get(part, "") + f"<{name}>{value}</{name.split()[0]}>"
    inside = "".join(f"<{part}>{text}</{part}>" for part, text in parts.items())
    return f'<CycloneDDS><Domain Id="any">{inside}</Domain></CycloneDDS>'


def fast_profiles(address: str, peer: str, settings: dict[str, Any]) -> str:
    """Profiles of Fast DDS: UDP on this address, and one unicast peer, without multicast.

    :param settings: see ``FAST``
    """
    port = 7410  # RTPS: of domain 0, for the metatraffic of participant 0
    place = "<locator><udpv4><address>{}</address><port>{}</port></udpv4></locator>".format
    sizes = ""
    if "message" in settings:
        sizes = f"<maxMessageSize>{settings['message']}</maxMessageSize>"
    buffer = f"<sendBufferSize>{settings['send_buffer']}</sendBufferSize>" if "send_buffer" in settings else ""
    lease = _fast_time("leaseDuration", settings["lease"]) if "lease" in settings else ""
    times = "".join(
        _fast_time(name, settings[key])
        for key, name in (("heartbeat", "heartbeatPeriod"), ("nack", "nackResponseDelay"))
        if key in settings
    )
    mode = f"<publishMode><kind>{settings.get('publish', 'SYNCHRONOUS')}</kind></publishMode>"
    reader = (
        f"<times>{_fast_time('heartbeatResponseDelay', settings['response'])}</times>" if "response" in settings else ""
    )
    return (
        '<?xml version="1.0"?><dds><profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">'
        "<transport_descriptors><transport_descriptor><transport_id>air</transport_id><type>UDPv4</type>"
        f"{buffer}{sizes}<interfaceWhiteList><address>{address}</address></interfaceWhiteList>"
        "</transport_descriptor></transport_descriptors>"
        '<participant profile_name="race"><rtps><builtin>'
        f"<discovery_config>{lease}</discovery_config>"
        f"<metatrafficUnicastLocatorList>{place(address, port)}</metatrafficUnicastLocatorList>"
        f"<initialPeersList>{place(peer, port)}</initialPeersList></builtin>"
        "<userTransports><transport_id>air</transport_id></userTransports>"
        "<useBuiltinTransports>false</useBuiltinTransports></rtps></participant>"
        f'<data_writer profile_name="race_writer"><qos>{mode}</qos><times>{times}</times></data_writer>'
        f'<data_reader profile_name="race_reader">{reader}</data_reader></profiles></dds>'
    )


def _fast_time(name: str, seconds: float) -> str:
    whole = int(seconds)
    return f"<{name}><sec>{whole}</sec><nanosec>{round((seconds - whole) * 1e9)}</nanosec></{name}>"


def zenoh_config(
    transport: str, number: int, robots: int, interface: str, settings: dict[str, Any]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Configuration of a session with peers at known addresses, and what is to be set in it by path.

    :param transport: multicast, or udp or tcp to each of the others
    :param number: of this robot, from 0; it connects to those after it
    :param robots: how many there are
    :param settings: none: as rmw_zenoh's router has it
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
    config = {
        "mode": "peer",
        "listen": {"endpoints": endpoints, **begin},
        "connect": {"endpoints": later, **begin},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"shared_memory": {"enabled": False}},
    }
    return config, settings or _ZENOH_RMW
