"""Which DDS domains this process has open, and on which interfaces.

Law: a domain is configured once, by whoever opens it first, and is shared by all participants of the process; one
that would need another configuration is refused instead of silently leaving or not leaving the machine.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

from gr_ros2.errors import ConfigError
from gr_ros2.middleware import cdr_dds

LOOPBACK_XML = (
    '<CycloneDDS><Domain Id="any">'
    '<General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces></General>'
    "<Discovery><ParticipantIndex>auto</ParticipantIndex>"
    '<Peers><Peer address="127.0.0.1"/></Peers></Discovery>'
    "</Domain></CycloneDDS>"
)
"""Loopback interface only. Multicast stays on: without it Fast DDS may never match."""


@dataclass
class _Domain:
    localhost_only: bool
    entity: cdr_dds.Entity | None
    members: int = 0


class DomainPool:
    """Opens domains when the first of our participants joins, closes them after the last has left."""

    def __init__(self) -> None:
        self._domains: dict[int, _Domain] = {}
        self._lock = threading.Lock()

    def join(self, domain_id: int, localhost_only: bool, user_data: bytes) -> cdr_dds.Entity:
        """A new participant.

        :raises ConfigError: the domain is open in this process with other interfaces
        :raises DdsError: it cannot be opened
        """
        with self._lock:
            domain = self._domains.get(domain_id) or self._open(domain_id, localhost_only)
            if domain.localhost_only != localhost_only:
                raise ConfigError(
                    f"domain {domain_id}: open in this process with ROS_LOCALHOST_ONLY={int(domain.localhost_only)}, "
                    f"asked for {int(localhost_only)}; use one value or another domain"
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
        """Delete a participant with all it contains."""
        cdr_dds.delete(participant)
        with self._lock:
            self._domains[domain_id].members -= 1
            self._close_unused(domain_id)

    def _open(self, domain_id: int, localhost_only: bool) -> _Domain:
        if not localhost_only:
            return _Domain(False, None)  # opened implicitly, configured by CYCLONEDDS_URI
        if cdr_dds.participants_in(domain_id):
            raise ConfigError(
                f"domain {domain_id}: other code of this process has it open; "
                "ROS_LOCALHOST_ONLY=1 needs it opened here first, or another domain"
            )
        return _Domain(True, cdr_dds.create_domain(domain_id, LOOPBACK_XML))

    def _close_unused(self, domain_id: int) -> None:
        domain = self._domains[domain_id]
        if domain.members:
            return
        # Deleting a domain deletes every participant in it, and other code may have joined the one we opened.
        if domain.entity is not None and cdr_dds.participants_in(domain_id):
            return
        del self._domains[domain_id]
        if domain.entity is not None:
            cdr_dds.delete(domain.entity)


POOL = DomainPool()
"""The one pool of this process."""
