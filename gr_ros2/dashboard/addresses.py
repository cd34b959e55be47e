"""Under which address others reach what this machine serves."""

from __future__ import annotations

import fcntl
import socket
import struct
from contextlib import suppress
from ipaddress import ip_address

ANY = ("0.0.0.0", "::")
"""Every interface."""
_SIOCGIFADDR = 0x8915
"""Asks Linux for the address of an interface (netdevice(7))."""


def own_addresses() -> list[str]:
    """The IPv4 addresses of this machine, those of a network first."""
    found = {"127.0.0.1"}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
        for _, name in socket.if_nameindex():
            with suppress(OSError):  # an interface without an address
                request = struct.pack("256s", name.encode())
                found.add(socket.inet_ntoa(fcntl.ioctl(asked, _SIOCGIFADDR, request)[20:24]))
    return sorted(found, key=lambda address: (address.startswith("127."), address))


def in_url(address: str) -> str:
    """An address as a URL has it. Where every interface serves, one under which others reach it, if there is one."""
    return bracketed(own_addresses()[0] if address in ANY else address)


def bracketed(host: str) -> str:
    """A host as a URL has it (RFC 3986, section 3.2.2)."""
    return f"[{host}]" if ":" in host else host


def exposed(address: str) -> bool:
    """Whether others than this machine reach what is served there."""
    try:
        return not ip_address(address).is_loopback
    except ValueError:
        return address != "localhost"
