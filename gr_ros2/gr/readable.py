"""What `debug` writes: one line per packet, for people.

Law: only where a user asked for `debug` and no logging is set up does a handler appear, on standard output as the
paper has it (section 4.3); otherwise logging is the application's.
"""

from __future__ import annotations

import logging
import sys

from gr_ros2.errors import WireError
from gr_ros2.registry import Registry
from gr_ros2.wire import QOS_NAMES, Packet, decode


def describe(packet: Packet, registry: Registry) -> str:
    """Header fields, then each entry as topic#entry_id[index/total] and its size."""
    entries = " ".join(
        f"{_topic(entry.topic_id, registry)}{entry.label}={len(entry.payload)}B" for entry in packet.entries
    )
    flags = ("C" if packet.compressed else "") + ("E" if packet.encrypted else "")
    return (
        f"v{packet.version} qos={QOS_NAMES[packet.qos]} flags={flags or '-'} src={packet.src_id} dst={packet.dst_id} "
        f"seq={packet.seq} hop={packet.hop} entries={len(packet.entries)}: {entries}"
    )


def describe_bytes(data: bytes, packet_len: int, registry: Registry) -> str:
    """The same from bytes; what is no packet is said to be none."""
    try:
        return describe(decode(data, packet_len), registry)
    except WireError as error:
        return f"refused ({error.kind}): {error}"


def debug_logger(name: str, debug: bool) -> logging.Logger:
    """The logger of a block, made to show its debug lines where asked."""
    logger = logging.getLogger(name)
    if debug:
        logger.setLevel(logging.DEBUG)
        if not logger.hasHandlers():
            handler = logging.StreamHandler(sys.stdout)
            handler.setFormatter(logging.Formatter("%(asctime)s %(name)s: %(message)s"))
            logger.addHandler(handler)
    return logger


def _topic(topic_id: int, registry: Registry) -> str:
    return f"{topic_id}:{registry[topic_id].name}" if topic_id < len(registry) else f"{topic_id}:?"
