"""The output of `debug`: one readable line per packet.

Invariant: a log handler is added only if a user asked for `debug` and no logging is set up. It writes to standard
output, as in the paper (section 4.3). Otherwise the application controls the logging.
"""

from __future__ import annotations

import logging
import sys

from gr_ros2.link import Received, Rejected, SentPacket
from gr_ros2.settings.registry import Registry
from gr_ros2.wire import QOS_NAMES


def describe(event: SentPacket | Received | Rejected, registry: Registry) -> str:
    """Header fields, then each entry as topic#entry_id[index/total] and its size; or why the packet was refused."""
    if isinstance(event, Rejected):
        return f"refused ({event.error.kind}): {event.error}"
    packet = event.packet
    entries = " ".join(
        f"{_topic(entry.topic_id, registry)}{entry.label}={len(entry.payload)}B" for entry in packet.entries
    )
    flags = ("C" if packet.compressed else "") + ("E" if packet.encrypted else "")
    return (
        f"v{packet.version} qos={QOS_NAMES[packet.qos]} flags={flags or '-'} src={packet.src_id} dst={packet.dst_id} "
        f"seq={packet.seq} hop={packet.hop} entries={len(packet.entries)}: {entries}"
    )


def debug_logger(name: str, debug: bool) -> logging.Logger:
    """The logger of a block. With ``debug``, its debug lines are shown."""
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
