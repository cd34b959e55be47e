"""Writes one ROS 2 bag.

Invariants: one thread owns the file (sqlite3 requires it), so that publishing waits for the disk, or drops and counts a
message, only when ``BACKLOG`` messages are waiting; after an error nothing more is written, further messages are
counted, and every call raises the error; a message is in the file ``UNWRITTEN_S`` after it came, if the disk keeps up,
whatever becomes of this program then.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from functools import partial
from math import inf
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

from rosbags.interfaces import Connection, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.interfaces import Qos as Profile
from rosbags.rosbag2 import StoragePlugin, Writer

from gr_ros2.core.errors import BagError, ConfigError, MiddlewareError
from gr_ros2.middleware.bag_files import RecordedTopic, explained
from gr_ros2.middleware.bag_mcap import TwoTimes
from gr_ros2.middleware.bag_sqlite import CommittedSqlite
from gr_ros2.middleware.base import Qos
from gr_ros2.middleware.type_definitions import Definition, definition, recorded_definition

BACKLOG = 10_000
"""Messages that may wait for the disk before publishing blocks."""
UNWRITTEN_S = 5.0
"""s after which what has come is written into the file. Each time takes about 200 bytes of an MCAP file."""

_STORAGES = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
_METADATA_VERSION: Final = 8
"""Version of metadata.yaml; version 9 writes QoS in a form that Humble's rosbag2 does not read."""
_FOREVER = QosTime(0x7FFFFFFF, 0xFFFFFFFF)


class _Writer(Writer):
    """rosbags' writer, with files into which what has come so far can be written."""

    STORAGE_PLUGINS = {StoragePlugin.MCAP: TwoTimes, StoragePlugin.SQLITE3: CommittedSqlite}  # noqa: RUF012

    def flush(self) -> None:
        """Write what has come so far."""
        if isinstance(self.storage, TwoTimes | CommittedSqlite):
            self.storage.flush()


class BagChannel(NamedTuple):
    """One topic of the file with the QoS of one publisher."""

    topic: str
    type_name: str
    connection: Connection


class _Message(NamedTuple):
    channel: BagChannel
    stamp_ns: int
    payload: bytes
    sent_ns: int | None


class _Job(NamedTuple):
    work: Callable[[], Any]
    result: Future[Any]


class BagRecorder:
    """A bag being written.

    :param path: folder that does not exist yet
    :param storage: ``mcap`` or ``sqlite3``
    :param definitions: ``.msg`` texts by type name; other types have the definition of ROS
    :param count: ``Middleware.count``
    :param lossless: publishing waits while ``BACKLOG`` messages are waiting; otherwise further messages are dropped and
        counted
    :raises ConfigError: no such storage
    :raises BagError: exists already, or cannot be made
    """

    def __init__(
        self,
        path: Path,
        storage: str,
        definitions: Mapping[str, str],
        count: Callable[[str, str], None],
        *,
        lossless: bool = True,
    ) -> None:
        if storage not in _STORAGES:
            raise ConfigError(f"storage = {storage!r}: {' or '.join(_STORAGES)}")
        if path.exists():
            raise BagError(f"bag {path}: exists already; choose another name or remove it")
        self.path = path
        self.error: BagError | None = None
        self._definitions = dict(definitions)
        self._count = count
        self._lossless = lossless
        self._writer = _Writer(path, version=_METADATA_VERSION, storage_plugin=_STORAGES[storage])
        # rosbag2 of Humble expects a mapping here, and rosbags writes none where nothing is set.
        self._writer.set_custom_data("recorded_by", "gr_ros2")
        self._channels: dict[tuple[str, tuple[Profile, ...]], BagChannel] = {}
        self._closed = False
        self._lock = threading.Lock()
        self._queue: queue.Queue[_Message | _Job | None] = queue.Queue(BACKLOG)
        self._thread = threading.Thread(target=self._run, name=f"bag-{path.name}", daemon=True)
        self._thread.start()
        try:
            self._ask(self._writer.open)
        except BagError:
            self._queue.put(None)
            raise

    @property
    def closed(self) -> bool:
        """Whether nothing more can be written."""
        return self._closed

    def channel(self, topic: str, type_name: str, qos: Qos) -> BagChannel:
        """The channel of a topic; the same for the same arguments.

        :raises ConfigError: the topic is being written with another type
        """
        return self._channel(
            topic, type_name, definition(type_name, self._definitions.get(type_name)), (_profile(qos),)
        )

    def copy(self, topic: RecordedTopic) -> BagChannel:
        """The channel for a topic of another bag, with the same name, definition and offered QoS as there.

        :raises ConfigError: the topic is being written with another type
        """
        type_name = topic.info.type_name
        text = recorded_definition(type_name, topic.definition.data, topic.digest)
        return self._channel(topic.recorded_as, type_name, text, topic.profiles)

    def _channel(self, topic: str, type_name: str, definition: Definition, profiles: tuple[Profile, ...]) -> BagChannel:
        with self._lock:
            for other in self._channels.values():
                if other.topic == topic and other.type_name != type_name:
                    raise ConfigError(f"bag {self.path}: {topic} is {other.type_name}, not {type_name}")
            if (topic, profiles) not in self._channels:
                connection = self._ask(
                    lambda: self._writer.add_connection(
                        topic,
                        type_name,
                        msgdef=definition.text,
                        rihs01=definition.digest,
                        offered_qos_profiles=profiles,
                    )
                )
                self._channels[topic, profiles] = BagChannel(topic, type_name, connection)
            return self._channels[topic, profiles]

    def write(self, channel: BagChannel, stamp_ns: int, payload: bytes, sent_ns: int | None = None) -> None:
        """Queue one message.

        :param stamp_ns: when it was received, ns since 1970
        :param sent_ns: when it was sent, None = the same; only MCAP keeps it
        :raises MiddlewareError: closed
        :raises BagError: the file could not be written
        """
        if self._closed:
            raise MiddlewareError(f"publish on {channel.topic}: bag {self.path} is closed")
        if self.error is not None:
            raise self.error
        try:
            self._queue.put(_Message(channel, stamp_ns, payload, sent_ns), block=self._lossless)
        except queue.Full:
            self._count(f"not_recorded:{channel.topic}", f"the disk is {BACKLOG} messages behind")

    def note(self, name: str, text: str) -> None:
        """Say something in ``metadata.yaml`` (``custom_data``), which is written at the end."""
        self._writer.set_custom_data(name, text)

    def close(self) -> None:
        """Write what is queued and the index; the second call does nothing.

        :raises BagError: the file could not be written
        """
        with self._lock:
            if self._closed:
                return
            self._closed = True
        self._queue.put(None)
        self._thread.join()
        if self.error is not None:
            raise self.error

    def _ask(self, work: Callable[[], Any]) -> Any:
        job = _Job(work, Future())
        self._queue.put(job)
        return job.result.result()

    def _run(self) -> None:
        due = inf
        while (request := self._next(due)) is not None:
            if isinstance(request, _Message):
                self._write(request)
                due = min(due, time.monotonic() + UNWRITTEN_S)
            elif isinstance(request, _Job):
                try:
                    with explained(self.path, "written"):
                        request.result.set_result(request.work())
                except BagError as error:
                    request.result.set_exception(error)
            if due <= time.monotonic():
                due = inf
                if self.error is None:
                    self._attempt(self._writer.flush)
        if self._writer.storage is not None:
            self._attempt(self._writer.close)

    def _next(self, due: float) -> _Message | _Job | Literal[False] | None:
        """What is to be done next; False where nothing was until some time, in s."""
        try:
            return self._queue.get(timeout=None if due == inf else max(due - time.monotonic(), 0.0))
        except queue.Empty:
            return False

    def _attempt(self, work: Callable[[], None]) -> None:
        """Do something with the file; after its first error nothing more is written."""
        try:
            with explained(self.path, "written"):
                work()
        except BagError as error:
            self.error = self.error or error

    def _write(self, message: _Message) -> None:
        if self.error is None:
            self._attempt(partial(self._write_now, message))
        if self.error is not None:
            self._count(f"not_recorded:{message.channel.topic}", str(self.error))

    def _write_now(self, message: _Message) -> None:
        if isinstance(self._writer.storage, TwoTimes):
            self._writer.storage.sent_ns = message.sent_ns
        self._writer.write(message.channel.connection, message.stamp_ns, message.payload)


def _profile(qos: Qos) -> Profile:
    return Profile(
        QosHistory.KEEP_ALL if qos.depth == 0 else QosHistory.KEEP_LAST,
        qos.depth,
        QosReliability.BEST_EFFORT if qos.reliability == "best_effort" else QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL if qos.durability == "transient_local" else QosDurability.VOLATILE,
        deadline=_time(qos.deadline_s),
        lifespan=_time(qos.lifespan_s),
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=_FOREVER,
        avoid_ros_namespace_conventions=False,
    )


def _time(seconds: float) -> QosTime:
    return QosTime(*divmod(int(seconds * 1e9), 1_000_000_000)) if seconds else _FOREVER
