"""`gr-ros2 packet decode`: the fields of a packet, or the reason why it is refused."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import click

from gr_ros2.cli.capture import DEFAULT_PACKET_LEN, from_hex, packets_in
from gr_ros2.core.errors import ConfigError, WireError
from gr_ros2.link.reader import Dissection, Reader
from gr_ros2.settings.config import MAX_PACKET_LEN, MIN_PACKET_LEN
from gr_ros2.settings.registry import Registry
from gr_ros2.state.keys import read_key_file
from gr_ros2.wire import BOUND, BROADCAST, QOS_NAMES, Entry, Packet, decode, format_of

_SHOWN = 16
"""Most payload bytes of an entry that are printed."""


@click.command("decode")
@click.argument("inputs", nargs=-1, metavar="[HEX|FILE|-]...")
@click.option(
    "--packet-len",
    type=click.IntRange(MIN_PACKET_LEN, MAX_PACKET_LEN),
    help="Bytes of a packet. Default: as long as each hex text or captured record is; "
    f"{DEFAULT_PACKET_LEN} for a file of back-to-back packets.",
)
@click.option("--registry", "registry_path", metavar="CSV", help="Show topics by name.")
@click.option("--key", "key_path", metavar="FILE", help="Open sealed packets with these keys (gr-ros2 key new).")
@click.pass_context
def decode_packets(
    context: click.Context,
    inputs: tuple[str, ...],
    packet_len: int | None,
    registry_path: str | None,
    key_path: str | None,
) -> None:
    """Show packets as readable fields, of both versions of the wire format.

    Each input is a packet in hex digits, or a file: a pcap or pcapng capture, hex text with one packet a line, or
    binary packets back to back. Without inputs, or for -, standard input is read. A packet that is refused is shown
    with the reason, and the exit status is 1.

    A packet of version 1 is checked by a hello of its sender among the inputs; the topics that robots announce there
    are shown by name. What is encrypted stays hidden without --key.
    """
    registry = Registry.from_csv(registry_path) if registry_path else None
    keys = read_key_file(key_path) if key_path else ()
    packets = list(_packets(inputs or ("-",), packet_len))
    if not packets:
        raise ConfigError("nothing to decode: the input is empty")
    readers = {mark: _reader([data for data, _ in packets], mark, packet_len, keys) for mark in (b"", BOUND)}
    rejected = 0
    for number, (data, expected) in enumerate(packets, start=1):
        try:
            if _is_version_1(data):
                mark = data[:1] if data.startswith(BOUND) else b""
                look = readers[mark].read(data.removeprefix(mark))
                lines = _looked_at(look, data, readers[mark], registry)
            else:
                lines = _lines(decode(data, expected), expected, registry)
            print(f"packet {number}: " + "\n".join(lines))
        except WireError as error:
            rejected += 1
            unsure = "" if packet_len or not _is_version_1(data) else "; if packets are longer, give --packet-len"
            print(f"packet {number}: rejected: {error.kind}: {error}{unsure} ({_preview(data)})")
    if rejected:
        context.exit(1)


def _reader(packets: Sequence[bytes], mark: bytes, packet_len: int | None, keys: Sequence[bytes]) -> Reader:
    """What reads those of some packets of version 1 that have a mark before them, or none."""
    mine = [data.removeprefix(mark) for data in packets if _is_version_1(data) and data.startswith(BOUND) == bool(mark)]
    # A sender without fixed lengths fills few packets. The longest packet gives the packet length of the link.
    longest = packet_len - len(mark) if packet_len else max(map(len, mine), default=0)
    reader = Reader(longest, keys, bound=bool(mark))
    for data in mine:
        reader.learn(data)
    return reader


def _is_version_1(data: bytes) -> bool:
    return data.removeprefix(BOUND)[:1].hex().startswith(("1", "9"))  # 9: with a block for medium access


def _packets(inputs: tuple[str, ...], packet_len: int | None) -> Iterator[tuple[bytes, int]]:
    """Each packet with its expected length. Hex digits are not a file name; for a file named face, write ./face."""
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


def _lines(packet: Packet, packet_len: int, registry: Registry | None) -> Iterator[str]:
    destination = f"{packet.dst_id} (broadcast)" if packet.dst_id == BROADCAST else str(packet.dst_id)
    flags = "".join([", compressed" if packet.compressed else "", ", encrypted" if packet.encrypted else ""])
    pad = sum(span.size for span in format_of(packet.version).layout(packet, packet_len) if span.kind == "pad")
    yield (
        f"{packet_len} bytes, version {packet.version}, qos {QOS_NAMES[packet.qos]}{flags}, "
        f"src {packet.src_id}, dst {destination}, seq {packet.seq}, hop {packet.hop}, "
        f"{len(packet.entries)} entries, {pad} bytes PAD, CRC ok"
    )
    for index, entry in enumerate(packet.entries):
        yield f"  entry {index}: {_of_topic(entry, _name(entry.topic_id, registry))}"


def _looked_at(look: Dissection, data: bytes, reader: Reader, registry: Registry | None) -> Iterator[str]:
    header, repair = look.header, look.repair
    addressed = header.dst_id != BROADCAST
    to = f"dst {header.dst_id}, hop {header.hop}" if addressed else f"dst {header.dst_id} (broadcast)"
    if repair is None:
        kind, what = f"source, qos {QOS_NAMES[header.qos]}", f"number {look.number}"
    elif repair.mask:
        kind = "repair"
        count, first = repair.mask.bit_count(), look.number - repair.mask.bit_length() + 1
        what = f"repair id {repair.repair_id}, of {count} packets in {first}..{look.number}"
        what += ", nothing older is worth repairing" if repair.oldest else ""
    else:
        kind, what = "control", f"at number {look.number}, repair id {repair.repair_id}"
    if look.hidden:
        content = f"{len(look.hidden)} bytes encrypted: {_preview(look.hidden)}"
    elif repair is not None and repair.mask:
        content = f"{len(look.combined)} bytes combined: {_preview(look.combined)}"
    else:
        content = f"{len(look.entries)} entries"
    kind = f"bound to one radio, {kind}" if data.startswith(BOUND) else kind
    yield f"{len(data)} bytes, version 1, {kind}, src {header.src_id}, {to}, {what}, {content}, {look.check}"
    if look.access is not None:
        yield f"  medium access: {look.access.describe()}"
    announced = reader.topics.get(header.src_id, {})
    for index, entry in enumerate(look.entries):
        message = look.message(index)
        if message is None:
            yield f"  entry {index}: {entry.describe()}"
        else:
            topic = announced.get(message.topic_id)
            text = _of_topic(message, topic.name if topic is not None else _name(message.topic_id, registry))
            yield f"  entry {index}: {text}{', coded' if message.coded else ''}"
            relayed = look.relayed(index)
            if relayed is not None:
                taker, of = relayed
                way = "" if taker == BROADCAST else f", taken on by robot {taker}"
                yield f"    relayed: {of.describe()}{way}"
    for topic in look.announced:
        yield f"  announces {topic.describe()}"


def _name(topic_id: int, registry: Registry | None) -> str | None:
    """Name of a topic by its topic in the registry; None without a registry."""
    if registry is None:
        return None
    return registry[topic_id].name if topic_id < len(registry) else "not in the registry"


def _of_topic(entry: Entry, name: str | None) -> str:
    topic = f"{entry.topic_id} ({name})" if name is not None else str(entry.topic_id)
    return f"topic {topic}, {entry.describe()}, payload {len(entry.payload)} bytes: {_preview(entry.payload)}"


def _preview(data: bytes) -> str:
    return data[:_SHOWN].hex() + ("…" if len(data) > _SHOWN else "")
