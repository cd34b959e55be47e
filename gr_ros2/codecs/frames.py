"""Topics as chains of frames on a link: cameras, depth and maps.

:class:`FrameSender` decides when the newest message of each topic is coded and keeps the encoders, whoever runs them:
a thread of a link, or a simulation at once. :class:`FrameReceiver` keeps one decoder for each topic of each robot.

Invariants: sans-IO; encoding needs no lock, and one message of a topic is encoded at a time; every message that is
offered becomes a frame or is refused by name; a message that no codec takes passes exactly, and is named once; one that
cannot be coded ends nothing but itself.
"""

from __future__ import annotations

import logging
from collections import OrderedDict, deque
from collections.abc import Mapping
from math import inf
from typing import Any, NamedTuple

from gr_ros2.codecs.base import MAX_SIZE, Coded
from gr_ros2.codecs.messages import CAMERA_INFO, GRID
from gr_ros2.codecs.pull import FramePull, Pull, StatePull
from gr_ros2.codecs.topic import CODECS, OFF, CodedTopic, TopicDecoder, TopicEncoder
from gr_ros2.core.errors import BackendMissingError, CodecError
from gr_ros2.link.fates import Fate
from gr_ros2.link.frames import MARK, FrameSide
from gr_ros2.settings.config import DepthOptions
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import Topic
from gr_ros2.wire import AnnouncedTopic

CODING_S = 0.008
"""s that coding takes: one of 640 × 480 pixels needs half of it, and the computer has more to do."""
MOST_DECODERS = 32
"""Topics of others that are decoded at a time; each may hold some pictures. The one that was used longest ago begins
anew with a key frame."""
_SECONDS = 2.0
"""s over which what is said of a topic is a mean."""
_log = logging.getLogger(__name__)


class Job(NamedTuple):
    """A message to be encoded.

    :param encoder: whose ``encode`` it is for, without a lock
    """

    topic_id: int
    pull: Pull
    encoder: TopicEncoder

    def run(self) -> Coded | CodecError:
        """The frame, or why there is none."""
        try:
            return self.encoder.encode(self.pull.message, self.pull.budget, self.pull.key)
        except CodecError as error:
            return error
        except (ValueError, OverflowError, MemoryError) as error:  # it contradicts itself
            return CodecError(f"image: {error}")


class _Sent:
    """A topic that is sent as frames."""

    def __init__(self, topic: Topic, coded: CodedTopic) -> None:
        self.name = topic.name
        self.encoder = coded.encoder()
        self.is_map = topic.type_name == GRID
        self.pull: FramePull | StatePull = (StatePull if self.is_map else FramePull)(coding_s=CODING_S)
        self.limit(topic)
        self.said: set[str] = set()
        self.frames = self.failed = 0
        self._lately: deque[tuple[float, int, int]] = deque()
        """When, bytes that came, and bytes of a frame that was sent."""
        self.what = ""

    def note(self, now: float, came: int = 0, frame: int = 0) -> None:
        """So many bytes came, or were sent."""
        self._lately.append((now, came, frame))
        while self._lately[0][0] < now - _SECONDS:
            self._lately.popleft()

    def lives(self, now: float) -> bool:
        """Whether messages have come lately."""
        return bool(self._lately) and self._lately[-1][0] >= now - _SECONDS

    def words(self, now: float, age_s: float) -> str:
        """What has become of the topic lately."""
        lately = [item for item in self._lately if item[0] >= now - _SECONDS]
        whole = sum(came for _, came, _ in lately) / _SECONDS
        frames = [frame for _, _, frame in lately if frame]
        rate = f"{whole / 1e6:.1f} MB/s" if whole >= 1e5 else f"{whole / 1e3:.1f} kB/s"
        return (
            f"{self.name}: {rate} as it is, sent as {len(frames) / _SECONDS:.0f} frames/s in "
            f"{sum(frames) / _SECONDS * 8e-3:.0f} kbit/s, {age_s:.1f} s old"
        )

    def limit(self, topic: Topic) -> None:
        """Heed the options of the topic that may change while it is sent."""
        options = topic.options
        fps = options.max_rate if options.camera.fps == AUTO else options.camera.fps
        self.weight, self.pull.period_s = options.weight, 1 / fps if fps else 0.0


class FrameSender:
    """The topics that one robot sends as frames.

    :param frames: of its endpoint
    """

    def __init__(self, frames: FrameSide) -> None:
        self._frames = frames
        self._sent: dict[int, _Sent] = {}

    def add(self, topic: Topic, *, latched: bool = False) -> bool:
        """Send a topic as frames if it is a camera, depth or a latched map, and its options do not say otherwise.
        Returns whether it is sent so.

        :param latched: whether its one publisher keeps its message for late joiners
        """
        known = self._sent.get(topic.topic_id)
        if known is not None:
            known.limit(topic)
            return True
        coded = coded_topic(topic, latched=(latched or topic.latched) and not self._frames.relayed)
        if coded is None:
            return False
        self._sent[topic.topic_id] = _Sent(topic, coded)
        output = topic.options.camera.output
        self._frames.begin(topic.topic_id, "" if output == "same" else output)
        return True

    def forget(self, topic_id: int) -> None:
        """Send no message of a topic so far to those who come."""
        if topic_id in self._sent and self._sent[topic_id].is_map:
            self._sent[topic_id].pull = StatePull(period_s=self._sent[topic_id].pull.period_s, coding_s=CODING_S)

    def __contains__(self, topic_id: int) -> bool:
        return topic_id in self._sent

    def offer(self, topic_id: int, message: bytes, now: float) -> None:
        """A message has come."""
        sent = self._sent[topic_id]
        sent.note(now, came=len(message))
        if sent.pull.offer(message, now):
            self._frames.refuse(topic_id, Fate.SUPERSEDED, "a newer one came before the air was free for it")

    def next(self, now: float) -> Job | None:
        """A message that is to be encoded now. ``done`` has to follow."""
        for topic_id, sent in self._sent.items():
            if sent.pull.waits(now):
                share = sent.weight / sum(
                    other.weight for other in self._sent.values() if other is sent or other.lives(now)
                )
                pull = sent.pull.pull(now, self._frames.progress(topic_id, now), share)
                if pull is not None:
                    return Job(topic_id, pull, sent.encoder)
        return None

    def done(self, job: Job, made: Coded | CodecError, now: float) -> None:
        """What has become of a message."""
        sent = self._sent[job.topic_id]
        sent.pull.done(job.pull if isinstance(made, CodecError) else None)
        if isinstance(made, CodecError):
            sent.failed += 1
            self._frames.refuse(job.topic_id, Fate.DAMAGED, str(made))
            return
        if made.data[0] == 0 and not sent.is_map and made.said not in sent.said:
            sent.said.add(made.said)
            _log.warning("topic %s: passes exactly, not as pictures: %s", sent.name, made.said)
        sent.frames, sent.what = sent.frames + 1, made.said
        sent.note(now, frame=len(made.data))
        self._frames.submit(job.topic_id, made.data, job.pull.came, now, key=made.before is None)
        if sent.is_map:
            sent.encoder.confirmed(made.name)  # frames arrive in order

    def end(self) -> None:
        """Code nothing more: messages that wait are not sent."""
        for topic_id, sent in self._sent.items():
            if sent.pull.end():
                self._frames.refuse(topic_id, Fate.SUPERSEDED, "sending ended before the air was free for it")

    def stats(self, topic_id: int, now: float) -> dict[str, Any] | None:
        """What is made of a topic: frames so far, messages that could not be coded, and in words what the newest frame
        leaves out and what the topic has become lately; None for one that is not sent as frames."""
        sent = self._sent.get(topic_id)
        if sent is None:
            return None
        state = self._frames.progress(topic_id, now)
        return {"frames": sent.frames, "not_coded": sent.failed, "made": sent.what, "words": sent.words(now, state.age)}


class TimedCoder:
    """Encodes what a sender asks for in simulated time: at once, and each frame is there ``CODING_S`` later, so that
    equal runs have equal frames.

    :ivar due: when the next frame is there, s; infinite for none
    """

    def __init__(self, sender: FrameSender) -> None:
        self._sender = sender
        self._jobs: deque[tuple[float, Job, Coded | CodecError]] = deque()

    @property
    def due(self) -> float:
        return self._jobs[0][0] if self._jobs else inf

    def look(self, now: float) -> None:
        """Hand over what is there, and encode what is due now."""
        while self.due <= now:
            _, job, made = self._jobs.popleft()
            self._sender.done(job, made, now)
        while (following := self._sender.next(now)) is not None:
            self._jobs.append((now + CODING_S, following, following.run()))


def coded_topic(topic: Topic, *, latched: bool = False) -> CodedTopic | None:
    """How a topic is coded as frames; None if it is not. What has to be installed for it is said.

    :param latched: whether one publisher keeps its newest message for late joiners
    """
    if topic.type_name == GRID and topic.options.codec == AUTO and latched:
        return CodedTopic(GRID)
    options, depth = topic.options, topic.options.depth_image
    kept = topic.latched or options.keep_s > 0
    if topic.type_name not in CODECS["camera"].types or options.codec != AUTO or kept:
        return None
    if options.camera.off and depth in (DepthOptions(), DepthOptions(off=True)):
        return None
    chosen: dict[str, Mapping[str, Any] | str] = {
        "camera": OFF if options.camera.off else {"size": options.camera.size},
        "depth": OFF if depth.off else {"mode": depth.mode, "near": depth.near, "far": depth.far},
    }
    coded = CodedTopic(topic.type_name, chosen)
    if coded.missing:
        _log.warning("topic %s: passes as it is, and is not made small: %s", topic.name, coded.missing)
        return None
    return coded


def frames_output(told: AnnouncedTopic) -> str | None:
    """The option ``output`` of a topic that comes as frames; None if it does not."""
    mark, _, output = told.codec.partition(" ")
    return (output or "same") if mark == MARK else None


class FrameReceiver:
    """The frames of other robots to messages.

    :param max_size: bytes of the largest message that is made
    """

    def __init__(self, max_size: int = MAX_SIZE) -> None:
        self._max_size = max_size
        self._topics: dict[tuple[int, int], tuple[str, str, CodedTopic]] = {}
        self._decoders: OrderedDict[tuple[int, int], TopicDecoder] = OrderedDict()
        """Those that were used last, the newest last."""
        self._sizes: dict[tuple[int, str], tuple[int, int] | None] = {}
        """Width and height of the newest picture in a namespace of a robot; None for one that has its own size. Only of
        the namespaces that were used last, the newest last."""

    def announce(self, key: tuple[int, int], told: AnnouncedTopic) -> str:
        """A robot has announced a topic. Returns the type of the messages that come out.

        :param key: of the robot and the topic
        :raises ConfigError: for an output that is not known here
        :raises BackendMissingError: when what decodes it is not installed
        """
        output = frames_output(told)
        if output is None:
            if self._topics.pop(key, None):
                self._sizes.pop(_place(key, told.name), None)
            return told.type_name
        if key not in self._topics or self._topics[key][:2] != (told.type_name, output):
            coded = CodedTopic(told.type_name, {"camera": {"output_type": output}})
            if coded.missing:
                raise BackendMissingError(f"topic {told.name} comes as video: {coded.missing}")
            self._topics[key] = told.type_name, output, coded
            self._decoders.pop(key, None)
        return next(iter(self._topics[key][2].codecs.values())).output

    def decode(self, key: tuple[int, int], name: str, payload: bytes) -> bytes:
        """The message of a frame, and any other as it is.

        :param name: of its topic
        :raises CodecError: the frame before is missing, or it is damaged
        """
        if key not in self._topics:
            return payload
        decoder = self._decoders.setdefault(key, self._topics[key][2].decoder(self._max_size))
        self._decoders.move_to_end(key)
        if len(self._decoders) > MOST_DECODERS:
            self._decoders.popitem(last=False)
        message = decoder.decode(payload)
        place = _place(key, name)
        self._sizes.pop(place, None)
        self._sizes[place] = decoder.size
        if len(self._sizes) > MOST_DECODERS:
            del self._sizes[next(iter(self._sizes))]
        return message

    def scaled(self, src_id: int, name: str, type_name: str, message: bytes) -> bytes:
        """A CameraInfo for the picture beside it, as large as that came out; any other message as it is."""
        size = self._sizes.get((src_id, name.rpartition("/")[0])) if type_name == CAMERA_INFO else None
        if size is None:
            return message
        from gr_ros2.codecs.camera import scaled_camera_info

        return scaled_camera_info(message, *size)


def _place(key: tuple[int, int], name: str) -> tuple[int, str]:
    """The robot and the namespace of a topic."""
    # Plug-ins of image_transport publish camera/image/compressed beside camera/camera_info.
    base = name.removesuffix("/compressed").removesuffix("/compressedDepth")
    return key[0], base.rpartition("/")[0]
