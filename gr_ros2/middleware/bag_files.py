"""What stands in a ROS 2 bag, MCAP or sqlite3: a folder with metadata.yaml, or a bare storage file.

Law: reading changes nothing, and whatever is wrong with a file is a BagError in one line that names it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinitionFormat,
    QosDurability,
    QosHistory,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import Reader

from gr_ros2.errors import BagError, ConfigError, MiddlewareError
from gr_ros2.middleware.base import Qos, TopicInfo, finite


class BagMessage(NamedTuple):
    """One recorded message; ``stamp_ns`` is when it was recorded, ns since 1970."""

    topic: str
    type_name: str
    stamp_ns: int
    payload: bytes


@contextmanager
def explained(path: Path, doing: str) -> Iterator[None]:
    """Whatever goes wrong inside is a BagError that names the file."""
    try:
        yield
    except (MiddlewareError, ConfigError):
        raise
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise BagError(f"bag {path}: cannot be {doing} ({reason})") from error


@contextmanager
def _opened(path: Path) -> Iterator[Reader]:
    with explained(path, "read"):
        if not path.exists():
            raise BagError(f"bag {path}: there is no such file or folder")
        with Reader(path) as reader:
            yield reader


def read_bag(path: str | Path, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
    """The messages of a bag in recorded order.

    :param path: bag folder, or a bare ``.mcap`` or ``.db3`` file
    :param topics: absolute names, None = all
    :raises BagError: missing, damaged, or no bag
    """
    path = Path(path)
    with _opened(path) as reader:
        chosen = [c for c in reader.connections if topics is None or c.topic in topics]
        if chosen:
            for connection, stamp_ns, payload in reader.messages(chosen):
                yield BagMessage(connection.topic, connection.msgtype, stamp_ns, bytes(payload))


def bag_topics(path: str | Path) -> list[TopicInfo]:
    """The topics of a bag with the QoS their publishers offered (reliable, volatile, 10 where not recorded).

    :raises BagError: missing, damaged, or no bag
    """
    rows: dict[tuple[str, str], list[Qos]] = {}
    with _opened(Path(path)) as reader:
        for connection in reader.connections:
            rows.setdefault((connection.topic, connection.msgtype), []).extend(_offered(connection))
    return [TopicInfo(topic, type_name, tuple(offers)) for (topic, type_name), offers in sorted(rows.items())]


def bag_definitions(path: str | Path) -> dict[str, str]:
    """The ``.msg`` texts a bag carries, by type name; for ``BagMiddleware(definitions=…)``.

    :raises BagError: missing, damaged, or no bag
    """
    with _opened(Path(path)) as reader:
        return {c.msgtype: c.msgdef.data for c in reader.connections if c.msgdef.format is MessageDefinitionFormat.MSG}


def _offered(connection: Connection) -> list[Qos]:
    profiles = connection.ext.offered_qos_profiles if isinstance(connection.ext, ConnectionExtRosbag2) else []
    return [
        Qos(
            "best_effort" if profile.reliability is QosReliability.BEST_EFFORT else "reliable",
            "transient_local" if profile.durability is QosDurability.TRANSIENT_LOCAL else "volatile",
            0 if profile.history is QosHistory.KEEP_ALL else profile.depth,
            _seconds(profile.lifespan),
            _seconds(profile.deadline),
        )
        for profile in profiles
    ] or [Qos("reliable", "volatile", 10)]


def _seconds(time: QosTime) -> float:
    return finite(time.sec + time.nsec * 1e-9)
