"""`gr-ros2 packet decode`: what stands in a packet, or why it is none."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import click

from gr_ros2.cli.capture import DEFAULT_PACKET_LEN, from_hex, packets_in
from gr_ros2.config import MAX_PACKET_LEN, MIN_PACKET_LEN
from gr_ros2.errors import ConfigError, WireError
from gr_ros2.registry import Registry
from gr_ros2.wire import BROADCAST, QOS_NAMES, Packet, decode, format_of

_SHOWN = 16
"""Payload bytes printed of an entry."""


@click.command("decode")
@click.argument("inputs", nargs=-1, metavar="[HEX|FILE|-]...")
@click.option(
    "--packet-len",
    type=click.IntRange(MIN_PACKET_LEN, MAX_PACKET_LEN),
    help="Bytes of a packet. Default: as long as each hex text or captured record is; "
    f"{DEFAULT_PACKET_LEN} for a file of back-to-back packets.",
)
@click.option("--registry", "registry_path", metavar="CSV", help="Show topics by name.")
@click.pass_context
def decode_packets(
    context: click.Context, inputs: tuple[str, ...], packet_len: int | None, registry_path: str | None
) -> None:
    """Show packets as readable fields.

    Each input is a packet in hex digits, or a file: a pcap or pcapng capture, hex text with one packet a line, or
    binary packets back to back. Without inputs, or for -, standard input is read. A packet that is refused is shown
    with the reason, and the exit status is 1.
    """
    registry = Registry.from_csv(registry_path) if registry_path else None
    number = rejected = 0
    for number, (data, expected) in enumerate(_packets(inputs or ("-",), packet_len), start=1):
        try:
            packet = decode(data, expected)
        except WireError as error:
            rejected += 1
            print(f"packet {number}: rejected: {error.kind}: {error} ({_preview(data)})")
        else:
            print("\n".join(_lines(number, packet, expected, registry)))
    if not number:
        raise ConfigError("nothing to decode: the input is empty")
    if rejected:
        context.exit(1)


def _packets(inputs: tuple[str, ...], packet_len: int | None) -> Iterator[tuple[bytes, int]]:
    """Each packet and the length it ought to have. What reads as hex digits is no file name; write ./face for that."""
    for text in inputs:
        if text == "-":
            data, where = sys.stdin.buffer.read(), "standard input"
        elif (packet := from_hex(text)) is not None:
            yield packet, packet_len or max(len(packet), MIN_PACKET_LEN)
            continue
        else:
            try:
                data, where = Path(text).read_bytes(), text
            except OSError as error:
                raise ConfigError(
                    f"{text!r} is neither hex digits nor a file that can be read ({error.strerror})"
                ) from error
        yield from packets_in(data, packet_len, where)


def _lines(number: int, packet: Packet, packet_len: int, registry: Registry | None) -> Iterator[str]:
    destination = f"{packet.dst_id} (broadcast)" if packet.dst_id == BROADCAST else str(packet.dst_id)
    flags = "".join([", compressed" if packet.compressed else "", ", encrypted" if packet.encrypted else ""])
    pad = sum(span.size for span in format_of(packet.version).layout(packet, packet_len) if span.kind == "pad")
    yield (
        f"packet {number}: {packet_len} bytes, version {packet.version}, qos {QOS_NAMES[packet.qos]}{flags}, "
        f"src {packet.src_id}, dst {destination}, seq {packet.seq}, hop {packet.hop}, "
        f"{len(packet.entries)} entries, {pad} bytes PAD, CRC ok"
    )
    for index, entry in enumerate(packet.entries):
        topic = str(entry.topic_id)
        if registry is not None:
            known = entry.topic_id < len(registry)
            topic += f" ({registry[entry.topic_id].name if known else 'not in the registry'})"
        yield (
            f"  entry {index}: topic {topic}, {entry.describe()}, "
            f"payload {len(entry.payload)} bytes: {_preview(entry.payload)}"
        )


def _preview(data: bytes) -> str:
    return data[:_SHOWN].hex() + ("…" if len(data) > _SHOWN else "")
