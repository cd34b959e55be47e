"""Serves what a link sends and what comes out of it to Foxglove, by Foxglove's own SDK.

Messages are the bytes that DDS carries, with the definition of their type where ROS ships it, so an operator's computer
needs no ROS.

Services of other robots can be called as they can on the ROS graph.

Invariants: whoever watches slows nothing: this observer runs in a thread of its own behind a bounded queue, and the SDK
drops the oldest message of a client that does not keep up; a topic is offered once its first message has come; who
subscribes to a latched topic gets its newest message.
"""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from importlib import import_module
from math import inf
from typing import Any, NamedTuple

from gr_ros2.codecs.messages import VIDEO
from gr_ros2.codecs.received_frames import FrameReceiver, frames_output
from gr_ros2.core.closing import Closing
from gr_ros2.core.errors import BackendMissingError, CodecError, ConfigError, reason
from gr_ros2.link.events import Accepted, Announced, Delivered, ReceiverEvent, SenderEvent
from gr_ros2.link.frames import MARK
from gr_ros2.middleware.service_definitions import service_definition
from gr_ros2.middleware.type_definitions import definition
from gr_ros2.observe.observers import FarServices, LiveRun
from gr_ros2.observe.result import RunResult
from gr_ros2.settings.registry import PICTURES
from gr_ros2.wire import AnnouncedTopic

BACKLOG = 256
"""Messages that wait for one client at most."""
VIDEO_NAME = "video"
"""Of the topic beside one of pictures that has H.264 as it crossed the link."""
_CACHED_BYTES = 1 << 26
"""Bytes of latched messages that are kept for clients that subscribe later."""
_SEQUENCE = b"\0\0\1\x67"
"""Begins what a decoder of H.264 needs first; every key frame has it."""
_AGAIN_S = 2.0
"""s after which a key frame that has not come is asked for again: what asks for it may be lost on the air."""
_LOOK_S = 0.5
"""s between two looks at which services other robots have."""


class _Shown(NamedTuple):
    topic: str
    type_name: str
    latched: bool


class FoxgloveServer(Closing):
    """A server of Foxglove's protocol, and an observer of a link.

    :param port: 0 = any that is free
    :raises BackendMissingError: when the SDK is not installed
    :raises ConfigError: when nothing can be served there
    :ivar port: where it serves
    """

    name = "foxglove"
    instruments = False

    def __init__(self, address: str, port: int) -> None:
        try:
            foxglove: Any = import_module("foxglove")
        except ModuleNotFoundError as error:
            raise BackendMissingError("--foxglove needs foxglove-sdk: pip install 'gr-ros2[foxglove]'") from error
        self._foxglove = foxglove
        self._context = foxglove.Context()
        self._run: LiveRun | None = None
        self._told: dict[tuple[int, int], _Shown] = {}
        self._sent: dict[tuple[int, int], _Shown] = {}
        self._videos: dict[tuple[int, int], _Shown] = {}
        self._wanted: dict[tuple[int, int], float] = {}
        """When a key frame of video that has not come was asked for, s, monotonic."""
        self._frames = FrameReceiver()
        self._services: dict[str, str] = {}
        """Types of the services that are offered, by name."""
        self._looked = -inf
        self._channels: dict[str, tuple[str, Any]] = {}
        """Type and channel of each topic."""
        self._newest: dict[int, bytes] = {}
        """Newest message of each latched channel."""
        self._lock = threading.Lock()
        try:
            self._server = foxglove.start_server(
                name="gr-ros2",
                host=address,
                port=port,
                context=self._context,
                message_backlog_size=BACKLOG,
                server_listener=self,
                capabilities=[foxglove.Capability.Services],
                supported_encodings=["cdr"],
            )
        except (RuntimeError, OSError, ValueError) as error:
            raise ConfigError(
                f"foxglove = {address}:{port}: cannot be served there ({reason(error)}); choose another address or port"
            ) from error
        self.port = self._server.port

    def close(self) -> None:
        """Serve nothing more."""
        self._server.stop()

    # ---- observer

    def run_started(self, run: LiveRun) -> None:
        self._run = run

    def run_ended(self, result: RunResult | None) -> None:
        pass

    def sender_event(self, src_id: int, event: SenderEvent) -> None:
        """Show a message that this robot sends. What is sent as frames is shown as it comes out: pictures as video."""
        if isinstance(event, Accepted) and self._run is not None:
            subscriptions, key = self._run.sources[src_id].subscriptions, (src_id, event.topic_id)
            framed = subscriptions.frames is not None and event.topic_id in subscriptions.frames
            shown = self._sent.get(key)
            if shown is None:
                named = {topic.topic_id: (name, topic) for name, topic in subscriptions.named()}
                if event.topic_id not in named:
                    return  # a call of a service
                name, topic = named[event.topic_id]
                shown = self._sent[key] = _Shown(name, topic.type_name, topic.latched)
                if framed:
                    self._see_frames(key, shown)
            if framed:
                self._show_frame(key, event.payload, event.now)
            else:
                self._show(shown, event.payload)

    def _see_frames(self, key: tuple[int, int], shown: _Shown) -> None:
        """Hand on the frames of a topic: H.264 as it is, beside pictures under the same name and ``VIDEO_NAME``."""
        picture = shown.type_name in PICTURES
        told = AnnouncedTopic(
            key[1], shown.topic, shown.type_name, codec=f"{MARK} CompressedVideo" if picture else MARK
        )
        with suppress(BackendMissingError):
            type_name = self._frames.announce(key, told)
            topic = f"{shown.topic}/{VIDEO_NAME}" if picture else shown.topic
            self._videos[key] = _Shown(topic, type_name, shown.latched)

    def _show_frame(self, key: tuple[int, int], frame: bytes, now: float) -> None:
        """Show what a frame is; depth and what passes exactly is no video."""
        shown = self._videos.get(key)
        if shown is not None:
            with suppress(CodecError):
                message = self._frames.decode(key, shown.topic, frame, now)
                self._show(shown, message)
                if (asked := self._wanted.get(key)) is not None:
                    if _SEQUENCE in message:
                        self._wanted.pop(key, None)
                    elif time.monotonic() - asked > _AGAIN_S:
                        self._ask_key(key, shown)

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:
        """Show a message that came out, and of pictures that came as video that, too."""
        if self._run is not None and self._run.calls is not None and now - self._looked > _LOOK_S:
            self._looked = now
            self._offer(self._run.calls)
        if isinstance(event, Announced) and self._run is not None:
            for row in event.topics:
                output = frames_output(row)
                type_name = row.type_name
                if output is not None:
                    from gr_ros2.codecs.camera import OUTPUTS

                    type_name = OUTPUTS.get(output, type_name)
                name, key = self._run.received_as(event.src_id, row.name), (event.src_id, row.topic_id)
                self._told[key] = _Shown(name, type_name, row.latched)
                self._videos.pop(key, None)
                if output is not None and row.type_name in PICTURES and type_name != VIDEO:
                    self._see_frames(key, _Shown(name, row.type_name, row.latched))
        elif isinstance(event, Delivered) and (shown := self._told.get((event.src_id, event.topic_id))) is not None:
            self._show(shown, event.message)
            self._show_frame((event.src_id, event.topic_id), event.payload, now)

    def _offer(self, calls: FarServices) -> None:
        """Offer the services of other robots that can be called now."""
        here = calls.reached()
        if gone := [name for name, kind in self._services.items() if here.get(name) != kind]:
            self._server.remove_services(gone)
        came = [name for name, kind in here.items() if self._services.get(name) != kind]
        self._server.add_services([self._service(name, here[name], calls) for name in came])
        self._services = dict(here)

    def _service(self, name: str, kind: str, calls: FarServices) -> Any:
        of = self._foxglove
        texts = service_definition(kind) or (None, None)
        request, response = (
            None
            if text is None
            else of.MessageSchema(
                encoding="cdr", schema=of.Schema(name=f"{kind}_{part}", encoding="ros2msg", data=text.encode())
            )
            for text, part in zip(texts, ("Request", "Response"), strict=True)
        )
        schema = of.ServiceSchema(kind, request=request, response=response)
        return of.Service(name, schema=schema, handler=lambda asked: calls.call(name, asked.payload))

    # ---- listener of the server

    def on_subscribe(self, client: Any, channel: Any) -> None:  # noqa: ARG002
        """A client subscribes: of a latched topic it gets the newest message, which others get once more."""
        with self._lock:
            message, found = self._newest.get(channel.id), self._channels.get(channel.topic)
        if message is not None and found is not None:
            found[1].log(message)
        for key, shown in list(self._videos.items()):
            if shown.topic == channel.topic:
                self._ask_key(key, shown)

    def _ask_key(self, key: tuple[int, int], shown: _Shown) -> None:
        """Ask for a key frame: the frames of now are of no use to who has not seen those before."""
        if self._run is not None:
            if shown.type_name == VIDEO:
                self._wanted[key] = time.monotonic()
            self._run.wants_key(*key)

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        """A client has had enough: the server stops by itself."""

    def _show(self, shown: _Shown, message: bytes) -> None:
        with self._lock:
            type_name, channel = self._channels.get(shown.topic, ("", None))
            if type_name != shown.type_name:
                if channel is not None:
                    self._newest.pop(channel.id(), None)
                    channel.close()
                text = definition(shown.type_name).text.encode()
                schema = self._foxglove.Schema(name=shown.type_name, encoding="ros2msg", data=text)
                channel = self._foxglove.Channel(
                    shown.topic, schema=schema, message_encoding="cdr", context=self._context
                )
                self._channels[shown.topic] = shown.type_name, channel
            if shown.latched:
                self._newest.pop(channel.id(), None)  # what is too large to be kept leaves no older one behind
                if len(message) + sum(map(len, self._newest.values())) <= _CACHED_BYTES:
                    self._newest[channel.id()] = message
        channel.log(message)
