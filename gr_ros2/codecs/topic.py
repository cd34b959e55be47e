"""The codecs of topics: which codec takes which type, and the frames of one topic.

The first byte of a frame of a topic is the number of its codec; the codec's own frame follows.

Invariants: no codec is imported before a message or a frame needs it; a message that no codec takes passes exactly, and
what is said names the reason; frames of different senders never meet, since each sender has a decoder of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, fields
from typing import Any

from gr_ros2.codecs.base import MAX_SIZE, Codec, Coded, Decoder, Encoder
from gr_ros2.codecs.messages import CLOUD, COMPRESSED_IMAGE, GRID, IMAGE
from gr_ros2.core.backends import Backend, BackendTable
from gr_ros2.core.errors import BackendMissingError, ConfigError, DamagedError, OtherKindError, UnfitError


@dataclass(frozen=True)
class CodecRow(Backend):
    """One codec.

    :param number: of its frames, 1..255; those of other packages have 128 and more
    :param types: that it takes; of two that take a type, the first codec of the table that codes a message does
    :param alone: whether each of its frames stands alone, so that a link codes every message of these types with it
    :param asked: whether it is used only where options name it
    """

    number: int = 0
    types: tuple[str, ...] = ()
    alone: bool = False
    asked: bool = False


_VIDEO = "PyAV (pip install 'gr-ros2[video]')"

CODECS = BackendTable(
    "codec",
    {
        "exact": CodecRow("gr_ros2.codecs.exact", "ExactCodec", "any message as it is"),
        "camera": CodecRow(
            "gr_ros2.codecs.camera",
            "CameraCodec",
            "pictures as video",
            _VIDEO,
            imports=("av",),
            number=1,
            types=(IMAGE, COMPRESSED_IMAGE),
        ),
        "depth": CodecRow(
            "gr_ros2.codecs.depth",
            "DepthCodec",
            "depth images as inverse distances",
            _VIDEO,
            imports=("av",),
            number=2,
            types=(IMAGE, COMPRESSED_IMAGE),
        ),
        "cloud": CodecRow("gr_ros2.codecs.cloud", "CloudCodec", "point clouds", number=3, types=(CLOUD,), alone=True),
        "grid": CodecRow("gr_ros2.codecs.grid", "GridCodec", "what changes of a map", number=4, types=(GRID,)),
        "growing": CodecRow(
            "gr_ros2.codecs.growing",
            "GrowingCodec",
            "what changes of a latched message that grows",
            number=5,
            asked=True,
            types=(
                CLOUD,
                "nav_msgs/msg/Path",
                "nav2_msgs/msg/Costmap",
                "octomap_msgs/msg/Octomap",
                "grid_map_msgs/msg/GridMap",
            ),
        ),
    },
    CodecRow,
)
_EXACT = "exact"
OFF = "off"
"""Instead of a codec's options: messages that it takes pass exactly."""


class CodedTopic:
    """How the messages of one topic are coded.

    :param type_name: ``package/msg/Type``
    :param options: by name of a codec, its options or 'off'
    :raises ConfigError: for an unknown codec or option
    """

    def __init__(self, type_name: str, options: Mapping[str, Mapping[str, Any] | str] | None = None) -> None:
        self.type_name = type_name
        self.missing = ""
        """What to install so that a codec of this type works; '' = nothing."""
        self.codecs: dict[int, Codec] = {}
        """By number, the preferred first, exact last."""
        options = options or {}
        if unknown := [name for name in options if name not in CODECS]:
            raise ConfigError(f"no codec {unknown[0]!r}; known are {', '.join(CODECS)}")
        for name, row in rows_of(type_name):
            if options.get(name) != OFF and (name in options or not row.asked):
                try:
                    CODECS.modules(name)
                    self.codecs[row.number] = configured(name, type_name, options.get(name, {}))
                except BackendMissingError as error:
                    self.missing = str(error)
        self.codecs[CODECS[_EXACT].number] = configured(_EXACT, type_name, {})

    @property
    def output(self) -> str:
        """The type of the messages that come out."""
        return next(iter(self.codecs.values())).output

    def makes(self, number: int) -> bool:
        """Whether a codec makes messages of this type."""
        return self.codecs[number].output == self.output

    def encoder(self) -> TopicEncoder:
        return TopicEncoder(self)

    def decoder(self, max_size: int = MAX_SIZE) -> TopicDecoder:
        """For a receiver, one for each sender.

        :param max_size: bytes of the largest message that it makes
        """
        return TopicDecoder(self, max_size)


def rows_of(type_name: str) -> Iterator[tuple[str, CodecRow]]:
    """The codecs that take a type, by name, without those of other packages that cannot be loaded."""
    for name in CODECS:
        with suppress(BackendMissingError):
            row = CODECS[name]
            if type_name in row.types:
                yield name, row


def configured(name: str, type_name: str, options: Mapping[str, Any] | str) -> Codec:
    """A codec with its options.

    :raises ConfigError: for an unknown option, or a wrong value
    :raises BackendMissingError: when what it needs is not installed
    """
    made = CODECS.load(name)
    if not isinstance(options, Mapping):
        raise ConfigError(f"{name}: {options!r} is neither its options nor {OFF!r}")
    known = [field.name for field in fields(made)][1:]
    if unknown := [option for option in options if option not in known]:
        raise ConfigError(f"{name}: no option {unknown[0]!r}; known are {', '.join(known) or 'none'}")
    codec: Codec = made(type_name, **options)
    return codec


class TopicEncoder:
    """The messages of one topic to frames of the codecs of its types. It raises no UnfitError."""

    def __init__(self, topic: CodedTopic) -> None:
        self._made: dict[int, Encoder] = {n: codec.encoder() for n, codec in topic.codecs.items()}
        self._missing = topic.missing

    def encode(self, message: bytes, budget: int | None = None, key: bool = False) -> Coded:
        said = self._missing
        for number, encoder in self._made.items():
            try:
                coded = encoder.encode(message, budget and budget - 1, key)
            except OtherKindError as error:
                said = said or str(error)
                continue
            except UnfitError as error:
                said = str(error)
                continue
            return coded._replace(data=bytes([number]) + coded.data, said=coded.said or said)
        raise AssertionError("the exact codec takes every message")

    def confirmed(self, name: int) -> None:
        for encoder in self._made.values():
            encoder.confirmed(name)


class TopicDecoder:
    """Frames back to messages. Its memory is that of one decoder of each codec of the topic."""

    def __init__(self, topic: CodedTopic, max_size: int) -> None:
        self._topic, self._max_size = topic, max_size
        self._made: dict[int, Decoder] = {}
        self.size: tuple[int, int] | None = None
        """Width and height of the newest message; None for one that is no resized picture."""

    @property
    def held(self) -> int:
        """Bytes of messages that later frames may refer to."""
        return sum(getattr(decoder, "held", 0) for decoder in self._made.values())

    def decode(self, data: bytes) -> bytes:
        number = data[0] if data else 0
        if not data or number not in self._topic.codecs:
            raise DamagedError(f"damaged frame: no codec {number} for {self._topic.type_name}")
        if not self._topic.makes(number):
            raise DamagedError(f"frame of a {self._topic.codecs[number].output} where {self._topic.output} comes out")
        if number not in self._made:
            self._made[number] = self._topic.codecs[number].decoder(self._max_size)
        decoder = self._made[number]
        message = decoder.decode(data[1:])
        self.size = getattr(decoder, "size", None)
        return message
