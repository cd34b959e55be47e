"""The `udp` front end: each packet is one datagram, for modems and radios with an Ethernet port, or for trials.

Datagrams of anybody are taken. A key (docs/how-to/radios.md) tells whose they are.
"""

from __future__ import annotations

import socket
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Annotated
from urllib.parse import urlsplit

from pydantic import AfterValidator, Field
from pydantic.dataclasses import dataclass

from gr_ros2.core.errors import RadioError
from gr_ros2.radio.front_end import SharedAir
from gr_ros2.radio.packet_port import Connection, PacketFrontEnd
from gr_ros2.settings.config import STRICT

_AT_ONCE = 64
"""Datagrams that are read before the connection is written again."""


def _split(address: str) -> tuple[str, int]:
    """Host and port; the host is '' in ``5555`` and ``:5555``."""
    parts = urlsplit(f"//{address if ':' in address else ':' + address}")
    return parts.hostname or "", parts.port or 0


def _own(address: str) -> str:
    host, port = _split(address)
    if not port:
        raise ValueError("write PORT or HOST:PORT")
    return f"{host}:{port}" if ":" not in host else f"[{host}]:{port}"


def _other(address: str) -> str:
    if not all(_split(address)):
        raise ValueError("write HOST:PORT")
    return address


OwnAddress = Annotated[str, Field(min_length=1), AfterValidator(_own)]
Address = Annotated[str, Field(min_length=1), AfterValidator(_other)]


@dataclass(frozen=True, kw_only=True, config=STRICT)
class UdpOptions(SharedAir):
    """Settings of this front end."""

    listen: Annotated[OwnAddress, Field(title="Own address")]
    """own address: ``5555`` (all interfaces) or ``10.0.0.1:5555``"""
    send_to: Annotated[tuple[Address, ...], Field(min_length=1, title="Addresses to send to")]
    """addresses to which every packet is sent, ``10.0.0.2:5555``; a broadcast address is one for all"""


class UdpFrontEnd(PacketFrontEnd):
    """Packets as datagrams."""

    name = "udp"
    Options = UdpOptions

    def _connect(self) -> Connection:
        options = self.options
        return Datagrams(options.listen, options.send_to, self.phy.packet_len, self._counters)


class Datagrams(Connection):
    """A UDP socket.

    :param listen, send_to: see :class:`UdpOptions`
    :param longest: bytes of the longest packet that is accepted
    :param counters: counts what is dropped
    :raises RadioError: when an address is not known, or not free
    """

    def __init__(self, listen: str, send_to: Sequence[str], longest: int, counters: Counter[str]) -> None:
        self._longest, self._counters = longest, counters
        found = [_resolved(address) for address in send_to]
        families = {family for family, _ in found}
        if len(families) > 1:
            raise RadioError(f"front_end udp: send_to = {list(send_to)}: IPv4 and IPv6 cannot be mixed; use one")
        (family,) = families
        self._peers = [address for _, address in found]
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        try:
            self._socket.bind(_split(listen))
        except OSError as error:
            self._socket.close()
            raise RadioError(
                f"front_end udp: listen = {listen!r}: {error.strerror}; write an own address and a free port"
            ) from error

    def fileno(self) -> int:
        return self._socket.fileno()

    def receive(self) -> Iterator[bytes]:
        for _ in range(_AT_ONCE):
            try:
                packet = self._socket.recv(self._longest + 1)
            except BlockingIOError:
                return
            if len(packet) > self._longest:
                self._counters["too_long"] += 1
            elif not packet:
                self._counters["malformed"] += 1
            else:
                yield packet

    def send(self, packet: bytes) -> None:
        for peer in self._peers:
            try:
                self._socket.sendto(packet, peer)
            except OSError:  # full, or no route at the moment; as on the air, nobody waits
                self._counters["not_taken"] += 1

    def close(self) -> None:
        self._socket.close()


def _resolved(address: str) -> tuple[int, tuple[str, int]]:
    host, port = _split(address)
    try:
        family, _, _, _, found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
    except OSError as error:
        raise RadioError(f"front_end udp: send_to: {address!r}: {error.strerror}; write HOST:PORT") from error
    return family, (str(found[0]), int(found[1]))
