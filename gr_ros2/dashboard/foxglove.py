"""Serves what a link sends and what comes out of it to Foxglove, by Foxglove's own SDK.

Messages are the bytes that DDS carries, with the definition of their type where ROS ships it, so an operator's computer
needs no ROS.

Invariants: whoever watches slows nothing: this observer runs in a thread of its own behind a bounded queue, and the SDK
drops the oldest message of a client that does not keep up; a topic is offered once its first message has come; who
subscribes to a latched topic gets its newest message.
"""

from __future__ import annotations

import threading
from importlib import import_module
from typing import Any, NamedTuple

from gr_ros2.codecs.frames import frames_output
from gr_ros2.core.errors import BackendMissingError, ConfigError
from gr_ros2.link.events import Accepted, Announced, Delivered, ReceiverEvent, SenderEvent
from gr_ros2.middleware.type_definitions import definition
from gr_ros2.observe.observers import LiveRun
from gr_ros2.observe.result import RunResult

BACKLOG = 256
"""Messages that wait for one client at most."""
_CACHED_BYTES = 1 << 26
"""Bytes of latched messages that are kept for clients that subscribe later."""


class _Shown(NamedTuple):
    topic: str
    type_name: str
    latched: bool


class FoxgloveServer:
    """A server of Foxglove's protocol, and an observer of a link.

    :param port: 0 = any that is free
    :raises BackendMissingError: when the SDK is not installed
    :raises ConfigError: when nothing can be served there
    :ivar port: where it serves
    """

    name = "foxglove"
    instruments = False

    def __init__(self, address: str, port: int, program: str = "gr-ros2") -> None:
        try:
            foxglove: Any = import_module("foxglove")
        except ModuleNotFoundError as error:
            raise BackendMissingError("--foxglove needs foxglove-sdk: pip install 'gr-ros2[foxglove]'") from error
        self._foxglove = foxglove
        self._context = foxglove.Context()
        self._run: LiveRun | None = None
        self._told: dict[tuple[int, int], _Shown] = {}
        self._sent: dict[tuple[int, int], _Shown] = {}
        self._channels: dict[str, tuple[str, Any]] = {}
        """Type and channel of each topic."""
        self._newest: dict[int, bytes] = {}
        """Newest message of each latched channel."""
        self._lock = threading.Lock()
        try:
            self._server = foxglove.start_server(
                name=program,
                host=address,
                port=port,
                context=self._context,
                message_backlog_size=BACKLOG,
                server_listener=self,
            )
        except (RuntimeError, OSError, ValueError) as error:
            raise ConfigError(f"foxglove = {address}:{port}: cannot be served there ({error})") from error
        self.port = self._server.port

    def close(self) -> None:
        """Serve nothing more."""
        self._server.stop()

    def __enter__(self) -> FoxgloveServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ---- observer

    def run_started(self, run: LiveRun) -> None:
        self._run = run

    def run_ended(self, result: RunResult | None) -> None:
        pass

    def sender_event(self, src_id: int, event: SenderEvent) -> None:
        """Show a message that this robot sends, unless it is sent as frames."""
        if isinstance(event, Accepted) and self._run is not None:
            subscriptions = self._run.sources[src_id].subscriptions
            if subscriptions.frames is not None and event.topic_id in subscriptions.frames:
                return
            shown = self._sent.get((src_id, event.topic_id))
            if shown is None:
                named = {topic.topic_id: (name, topic) for name, topic in subscriptions.named()}
                if event.topic_id not in named:
                    return  # a call of a service
                name, topic = named[event.topic_id]
                shown = self._sent[src_id, event.topic_id] = _Shown(name, topic.type_name, topic.latched)
            self._show(shown, event.payload)

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:  # noqa: ARG002
        """Show a message that came out."""
        if isinstance(event, Announced) and self._run is not None:
            for row in event.topics:
                output = frames_output(row)
                type_name = row.type_name
                if output is not None:
                    from gr_ros2.codecs.camera import OUTPUTS

                    type_name = OUTPUTS.get(output, type_name)
                name = self._run.received_as(event.src_id, row.name)
                self._told[event.src_id, row.topic_id] = _Shown(name, type_name, row.latched)
        elif isinstance(event, Delivered) and (shown := self._told.get((event.src_id, event.topic_id))) is not None:
            self._show(shown, event.message)

    # ---- listener of the server

    def on_subscribe(self, client: Any, channel: Any) -> None:  # noqa: ARG002
        """A client subscribes: of a latched topic it gets the newest message, which others get once more."""
        with self._lock:
            message, found = self._newest.get(channel.id), self._channels.get(channel.topic)
        if message is not None and found is not None:
            found[1].log(message)

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        """A client has had enough: the server stops by itself."""

    def _show(self, shown: _Shown, message: bytes) -> None:
        with self._lock:
            type_name, channel = self._channels.get(shown.topic, ("", None))
            if type_name != shown.type_name:
                if channel is not None:
                    channel.close()
                text = definition(shown.type_name).text.encode()
                schema = self._foxglove.Schema(name=shown.type_name, encoding="ros2msg", data=text)
                channel = self._foxglove.Channel(
                    shown.topic, schema=schema, message_encoding="cdr", context=self._context
                )
                self._channels[shown.topic] = shown.type_name, channel
            if shown.latched and len(message) + sum(map(len, self._newest.values())) <= _CACHED_BYTES:
                self._newest[channel.id()] = message
        channel.log(message)
