"""The DDS domains that this process has open, and the range of their discovery.

Invariant: a domain is configured once, by the participant that opens it first, and is shared by all participants of the
process; a participant that needs another configuration is refused, so that its messages never leave the machine against
its settings. Source of the meaning of the discovery ranges: rmw_cyclonedds and rcl of Jazzy.
"""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from html import escape

from gr_ros2.core.errors import ConfigError
from gr_ros2.middleware import cdr_dds
from gr_ros2.middleware.ros_graph import DiscoveryOptions

_log = logging.getLogger(__name__)
_LAST_PORT = 65535
_LOOPBACK = '<NetworkInterface address="127.0.0.1"/>'
_UNICAST_ONLY = '<NetworkInterface autodetermine="true" multicast="false" priority="3"/>'
"""Cyclone DDS looks for peers through the interface of the highest priority only; the loopback interface has 2."""
_OFTEN = "<SPDPInterval>250ms</SPDPInterval>"
"""A node on another interface is not received on the loopback interface; it finds this participant when this
participant announces itself. Cyclone DDS does that every 8 s by default. On the loopback interface a short interval
costs nothing."""
_ASK_AGAIN = "<SPDPInterval>2s</SPDPInterval>"
_NEVER_FORGET = 'PruneDelay="inf"'
"""By itself Cyclone DDS 11 asks a peer in the first moment and drops its address after 30 s, before it would ask again.
A peer that starts a second later would never be found. Asking is a packet of 0.3 kB to each of 100 ports."""
_NODES_ON_LOCALHOST = f'<Peer Address="127.0.0.1" {_NEVER_FORGET}/>'
"""A node of this machine on LOCALHOST does not receive multicast on another interface, and Cyclone DDS 11 ignores its
packets to 127.0.0.1 there. So it is asked."""

_COMPATIBILITY = (
    "<Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>"
    "<Internal><GenerateKeyhash>true</GenerateKeyhash></Internal>"
)
"""Without the hash Fast DDS 2 does not understand that an endpoint has gone, and takes it for present until its
participant leaves. Messages have no keys, so it costs them nothing.

1.15 is Fast DDS. Its nodes exchange type objects over endpoints that every participant shares. Cyclone DDS 11 cannot
read these objects, asks for them and answers with what it has; then other nodes of Fast DDS, which get that answer too,
do not match any more (``invalid type object``, ``Inconsistent TypeObject``). Opaque topics need no type information."""


def participants_of(domain_id: int) -> int:
    """Participants on one machine that a domain has ports for, and that are asked for: 100, and fewer in the last
    domain, whose ports would exceed 16 bits (RTPS 2.5, section 9.6.2.3)."""
    return min(100, (_LAST_PORT - 7400 - 250 * domain_id - 11) // 2 + 1)


def configuration(options: DiscoveryOptions, participants: int, environment: Mapping[str, str] = os.environ) -> str:
    """The XML of a domain, followed by CYCLONEDDS_URI, which therefore takes precedence.

    :param participants: most of one machine
    """
    content = _COMPATIBILITY + ("" if options.range == "SYSTEM_DEFAULT" else _discovery(options, participants))
    return f'<CycloneDDS><Domain Id="any">{content}</Domain></CycloneDDS>,{environment.get("CYCLONEDDS_URI", "")}'


def _discovery(options: DiscoveryOptions, participants: int) -> str:
    peers = "".join(f"<Peer Address='{escape(peer)}' {_NEVER_FORGET}/>" for peer in options.peers)
    interval = _ASK_AGAIN if peers else ""
    if options.range == "OFF":
        general = "<AllowMulticast>false</AllowMulticast>"
        # Only participants with an equal tag find each other.
        discovery = f"<ParticipantIndex>none</ParticipantIndex><Tag>gr_ros2_discovery_off_{os.getpid()}</Tag>"
    elif options.range == "LOCALHOST":
        # Multicast stays on: without it Fast DDS may never match. Peers need another interface, without multicast.
        general = f"<Interfaces>{_LOOPBACK}{_UNICAST_ONLY if peers else ''}</Interfaces>"
        discovery = "<ParticipantIndex>auto</ParticipantIndex>"
        interval = interval or _OFTEN
        peers = f'<Peer Address="127.0.0.1"/>{peers}'
    else:
        general = "<AllowMulticast>spdp</AllowMulticast>"
        discovery = "<ParticipantIndex>auto</ParticipantIndex>"  # sets the ports at which peers look for us
        interval, peers = _ASK_AGAIN, f"{_NODES_ON_LOCALHOST}{peers}"
    most = f"<MaxAutoParticipantIndex>{participants - 1}</MaxAutoParticipantIndex>"
    discovery += f"{most}{interval}<Peers>{peers}</Peers>"
    return f"<General>{general}</General><Discovery>{discovery}</Discovery>"


@dataclass
class _Domain:
    options: DiscoveryOptions
    entity: cdr_dds.Entity | None
    members: int = 0


class DomainPool:
    """Opens a domain when the first participant of this process joins, and closes it after the last one has left."""

    def __init__(self) -> None:
        self._domains: dict[int, _Domain] = {}
        self._lock = threading.Lock()

    def join(self, domain_id: int, options: DiscoveryOptions, user_data: bytes) -> cdr_dds.Entity:
        """Create a participant.

        :raises ConfigError: the domain is open in this process with other options
        :raises DdsError: it cannot be opened
        """
        with self._lock:
            domain = self._domains.get(domain_id) or self._open(domain_id, options)
            if domain.options != options:
                raise ConfigError(
                    f"domain {domain_id}: open in this process with {domain.options}, asked for {options}; "
                    "use the same or another domain"
                )
            self._domains[domain_id] = domain
            try:
                participant = cdr_dds.create_participant(domain_id, user_data)
            except cdr_dds.DdsError:
                self._close_unused(domain_id)
                raise
            domain.members += 1
            return participant

    def leave(self, domain_id: int, participant: cdr_dds.Entity) -> None:
        """Delete a participant with all its entities."""
        cdr_dds.delete(participant)
        with self._lock:
            self._domains[domain_id].members -= 1
            self._close_unused(domain_id)

    def _open(self, domain_id: int, options: DiscoveryOptions) -> _Domain:
        others = cdr_dds.participants_in(domain_id)
        if others and options.range in ("LOCALHOST", "OFF"):
            raise ConfigError(
                f"domain {domain_id}: other code of this process has it open; "
                f"{options} needs it opened here first, or another domain"
            )
        participants = participants_of(domain_id)
        if participants < participants_of(0):
            _log.warning(
                "domain %d: its ports end after %d participants of a machine, and further ones find nobody; set "
                "ROS_DOMAIN_ID or domain_id to a lower one",
                domain_id,
                participants,
            )
        entity = None if others else cdr_dds.create_domain(domain_id, configuration(options, participants))
        return _Domain(options, entity)

    def _close_unused(self, domain_id: int) -> None:
        domain = self._domains[domain_id]
        if domain.members:
            return
        # Deleting a domain deletes every participant in it, and other code of this process may have joined it.
        if domain.entity is not None and cdr_dds.participants_in(domain_id):
            return
        del self._domains[domain_id]
        if domain.entity is not None:
            cdr_dds.delete(domain.entity)


POOL = DomainPool()
"""The one pool of this process."""
