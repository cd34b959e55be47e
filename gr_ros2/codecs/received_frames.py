"""Frames of other robots to messages.

Invariants: sans-IO; one decoder for each chain of a topic of a robot; memory, and the messages that are made in a
second, are bounded, whatever comes.
"""

from __future__ import annotations

from collections import OrderedDict

from gr_ros2.codecs.base import MAX_SIZE, OF_CHAIN
from gr_ros2.codecs.messages import CAMERA_INFO
from gr_ros2.codecs.topic import CodedTopic, TopicDecoder
from gr_ros2.core.errors import BackendMissingError, CodecError, MissingFrameError
from gr_ros2.link.frames import MARK
from gr_ros2.settings.registry import PICTURES
from gr_ros2.wire import AnnouncedTopic

MOST_DECODERS = 32
"""Topics of others that are decoded at a time; each may hold some pictures. The one that was used longest ago begins
anew with a key frame."""
MOST_BYTES_S = 256e6
"""Bytes of messages in a second that are made of one robot's frames, on average over a second: 250 bytes of video may
say "the same as before" of 8 million pixels, which takes 18 ms. It is more than a camera of 1920 × 1080 pixels at 30/s,
and keeps half a core busy."""
_TOGETHER, _ALL = 4, -1
"""Times as many of all robots together, and whose they are."""
_DAMAGED_BYTES = 1 << 23
"""Bytes that a damaged frame counts: whatever was wrong with it may have been found at its end."""
_BESIDE = ("image_raw", "image", "image_color", "image_mono")
"""Ends of the names of pictures that a CameraInfo beside them is of, the likeliest first."""
MOST_HELD = 1 << 28
"""Bytes of maps and the like of others that are kept, for what changes of them: of those used longest ago none are."""


def chain_of(payload: bytes) -> tuple[int, bytes]:
    """The number of the chain of a frame, and the frame."""
    return (payload[1], payload[2:]) if len(payload) > 1 and payload[0] == OF_CHAIN else (0, payload)


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
        self._shared: dict[tuple[str, str], CodedTopic] = {}
        """Some of these, by type and output: topics share them, since others may announce many."""
        self._left: dict[int, tuple[float, float]] = {}
        """Bytes of messages that may be made of each robot's frames, at a time in s."""
        self._decoders: OrderedDict[tuple[int, int, int], TopicDecoder] = OrderedDict()
        """Those of the chains of topics that were used last, the newest last."""
        self._sizes: dict[tuple[int, str], tuple[int, int] | None] = {}
        """Width and height of the newest picture of each camera of a robot; None for one that has its own size. Only of
        the cameras that were used last, the newest last."""

    def announce(self, key: tuple[int, int], told: AnnouncedTopic) -> str:
        """A robot has announced a topic. Returns the type of the messages that come out.

        :param key: of the robot and the topic
        :raises ConfigError: for an output that is not known here
        :raises BackendMissingError: when what decodes it is not installed
        """
        output = frames_output(told)
        if output is None:
            if self._topics.pop(key, None):
                self._sizes.pop((key[0], _camera(told.name)), None)
            return told.type_name
        if key not in self._topics or self._topics[key][:2] != (told.type_name, output):
            coded = self._shared.get((told.type_name, output))
            if coded is None:
                coded = CodedTopic(told.type_name, {"camera": {"output_type": output}, "growing": {}})
                if len(self._shared) == MOST_DECODERS:
                    self._shared.clear()
                self._shared[told.type_name, output] = coded
            if coded.missing:
                raise BackendMissingError(f"topic {told.name} comes as video: {coded.missing}")
            self._topics[key] = told.type_name, output, coded
            for chain in [chain for chain in self._decoders if chain[:2] == key]:
                del self._decoders[chain]
        return self._topics[key][2].output

    def decode(self, key: tuple[int, int], name: str, payload: bytes, now: float) -> bytes:
        """The message of a frame, and any other as it is.

        :param name: of its topic
        :raises CodecError: the frame before is missing, or it is damaged, or its robot's frames make more messages than
            ``MOST_BYTES_S``
        """
        camera = key[0], _camera(name)
        if key not in self._topics:
            self._sizes.pop(camera, None)  # of the same camera as video
            return payload
        left = {whose: self._allowed(whose, now) for whose in (key[0], _ALL)}
        if min(left.values()) < 0:
            who = f"robot {key[0]} make" if left[key[0]] < 0 else "all robots make"
            most = f"{(MOST_BYTES_S if left[key[0]] < 0 else _TOGETHER * MOST_BYTES_S) / 1e6:,.0f} MB"
            raise CodecError(f"frames of {who} more than {most} of messages in a second")
        number, frame = chain_of(payload)
        chain = (*key, number)
        decoder = self._decoders.setdefault(chain, self._topics[key][2].decoder(self._max_size))
        self._decoders.move_to_end(chain)
        if len(self._decoders) > MOST_DECODERS:
            self._decoders.popitem(last=False)
        while len(self._decoders) > 1 and sum(each.held for each in self._decoders.values()) > MOST_HELD:
            self._decoders.popitem(last=False)
        made = _DAMAGED_BYTES
        try:
            message = decoder.decode(frame)
            made = len(message)
        except MissingFrameError:
            made = 0
            raise
        finally:
            self._left |= {whose: (bytes_left - made, now) for whose, bytes_left in left.items()}
        self._sizes.pop(camera, None)
        if self._topics[key][0] in PICTURES:
            self._sizes[camera] = decoder.size
        if len(self._sizes) > MOST_DECODERS:
            del self._sizes[next(iter(self._sizes))]
        return message

    def _allowed(self, whose: int, now: float) -> float:
        """Bytes of messages that may be made of the frames of a robot, or of all, now."""
        most = MOST_BYTES_S * (_TOGETHER if whose == _ALL else 1)
        left, at = self._left.get(whose, (most, now))
        return min(left + (now - at) * most, most)

    def scaled(self, src_id: int, name: str, type_name: str, message: bytes) -> bytes:
        """A CameraInfo for the picture beside it, as large as that came out; any other message as it is.

        Of several pictures beside it, it fits the first of ``_BESIDE``, or else the first by name.
        """
        if type_name != CAMERA_INFO:
            return message
        place, _, own = name.rpartition("/")
        begin = f"{place}/{own.removesuffix('camera_info')}".lstrip("/")
        beside = {
            camera.rpartition("/")[2]: size
            for (robot, camera), size in self._sizes.items()
            if robot == src_id and camera.startswith(begin) and camera.rpartition("/")[0] == place
        }
        size = beside[min(beside, key=_rank)] if beside else None
        if size is None:
            return message
        from gr_ros2.codecs.camera import scaled_camera_info

        return scaled_camera_info(message, *size)


def _camera(name: str) -> str:
    """The name of a camera, without that of its transport: its CameraInfo is beside it."""
    return name.removesuffix("/compressed").removesuffix("/compressedDepth")


def _rank(name: str) -> tuple[int, str]:
    """The place of a picture among those beside a CameraInfo."""
    known = [place for place, end in enumerate(_BESIDE) if name.endswith(end)]
    return min(known, default=len(_BESIDE)), name
