"""Topics as chains of frames on a link: cameras, depth, maps, and clouds that fit the air.

:class:`FrameSender` decides when the newest message of each topic is coded and keeps the encoders, whoever runs them:
a thread of a link, or a simulation at once. ``received_frames`` is the other end.

Invariants: sans-IO; encoding needs no lock, and one message of a topic is encoded at a time; every message that is
offered becomes a frame or is refused by name; a message that no codec takes passes exactly, and is named once; one that
cannot be coded ends nothing but itself.
"""

from __future__ import annotations

import logging
from collections import Counter, deque
from collections.abc import Hashable, Iterable, Mapping
from math import inf
from typing import Any, NamedTuple

from gr_ros2.codecs.base import MAX_SIZE, OF_CHAIN, Coded
from gr_ros2.codecs.grid import updated
from gr_ros2.codecs.messages import CLOUD, GRID, GRID_UPDATE
from gr_ros2.codecs.pull import FramePull, Pull, StatePull
from gr_ros2.codecs.topic import CODECS, OFF, CodedTopic, TopicEncoder
from gr_ros2.core.errors import CodecError, ConfigError, DamagedError
from gr_ros2.link.fates import Fate
from gr_ros2.link.frames import FrameSide
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import Topic

CODING_S = 0.008
"""s that coding takes: one of 640 × 480 pixels needs half of it, and the computer has more to do."""
_STATES = {CODECS["grid"].number, CODECS["growing"].number}
"""Codecs of messages of which the newest counts, however old it is."""
MOST_CHAINS = 16
"""Publishers of a topic whose newest messages are kept; with more, those of others than came last are not."""
_STARTS = 2
"""Chains for each of several publishers: one that has started again counts as another."""
_UPDATES = "_updates"
"""End of the name of a topic that says what changes of the map whose name stands before."""
_SECONDS = 2.0
"""s over which what is said of a topic is a mean."""
_log = logging.getLogger(__name__)


class Job(NamedTuple):
    """A message to be encoded.

    :param encoder: whose ``encode`` it is for, without a lock
    :param number, chain: of the topic, for which it is
    :param sent: the topic
    """

    topic_id: int
    pull: Pull
    encoder: TopicEncoder
    number: int
    chain: _Chain
    sent: _Sent

    def run(self) -> Coded | CodecError:
        """The frame, or why there is none."""
        try:
            return self.encoder.encode(self.pull.message, self.pull.budget, self.pull.key)
        except CodecError as error:
            return error
        except (ValueError, OverflowError, MemoryError) as error:  # it contradicts itself
            return CodecError(f"image: {error}")


class Changed(NamedTuple):
    """A map that another message has changed.

    :param topic_id: of that message
    :param made: the map as it is now, or why the message does not fit it
    :param publisher: of the map
    """

    topic_id: int
    map_id: int
    made: bytes | DamagedError
    publisher: Hashable


class _Chain:
    """The messages of one publisher, or of all, of a topic that is sent as frames."""

    def __init__(self, pull: FramePull | StatePull, encoder: TopicEncoder) -> None:
        self.pull, self.encoder = pull, encoder


class _Sent:
    """A topic that is sent as frames.

    :ivar chains: by number, the next whose turn it is first
    :ivar publishers: how many publish it
    """

    def __init__(self, topic: Topic, coded: CodedTopic) -> None:
        self.name = topic.name
        self.is_map = not _STATES.isdisjoint(coded.codecs)
        self.is_cloud = topic.type_name == CLOUD and not self.is_map
        self.is_grid = topic.type_name == GRID and self.is_map
        self.publishers = 1
        self.chains: dict[int, _Chain] = {}
        self._whose: dict[Hashable, int] = {}
        """Chains of those who have published, who published last is the last."""
        self.use(topic, coded)
        self.limit(topic)
        self.said: set[str] = set()
        self.frames = self.failed = self.bytes = 0
        self._lately: deque[tuple[float, int, int]] = deque()
        """When, bytes that came, and bytes of a frame that was sent."""
        self.what = ""

    def use(self, topic: Topic, coded: CodedTopic) -> None:
        """Code from now on so, with a key frame first."""
        self.options, self.cloud, self.coded = _coding(topic.options), topic.options.cloud, coded
        for chain in self.chains.values():
            chain.encoder = coded.encoder()

    def chain_of(self, publisher: Hashable) -> tuple[_Chain, list[_Chain]]:
        """The chain of a publisher of whom a message has come, and those that end, since others have ended or come."""
        if not self.is_map:
            publisher, most = None, 1
        elif self.publishers <= 1:
            most = 1
        else:
            most = min(_STARTS * self.publishers, MOST_CHAINS)
            publisher = object() if publisher is None else publisher  # not known: the newest messages of all are kept
        number, ended = self._whose.pop(publisher, None), []
        while len(self._whose) >= most:
            free = self._whose.pop(next(iter(self._whose)))
            if number is None:
                number = free
            else:
                ended.append(self.chains.pop(free))
        if number is None:
            number = next(free for free in range(MOST_CHAINS) if free not in self.chains)
            pull = (StatePull if self.is_map else FramePull)(period_s=self._period_s, coding_s=CODING_S)
            self.chains[number] = _Chain(pull, self.coded.encoder())
        self._whose[publisher] = number
        return self.chains[number], ended

    @property
    def only(self) -> tuple[Hashable, bytes] | None:
        """The one publisher and its newest message; None if there are more, or none."""
        whose, pulls = list(self._whose), [chain.pull for chain in list(self.chains.values())]
        pull = pulls[0] if len(pulls) == len(whose) == 1 else None
        return (whose[0], pull.newest) if isinstance(pull, StatePull) and pull.newest is not None else None

    def forget(self) -> None:
        """Send nothing of what came so far."""
        self.chains.clear()
        self._whose.clear()

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
        if not self.lives(now):
            return f"{self.name}: no message came in the last {_SECONDS:.0f} s"
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
        self.weight, self._period_s = options.weight, 1 / fps if fps else 0.0
        for chain in self.chains.values():
            chain.pull.period_s = self._period_s


class FrameSender:
    """The topics that one robot sends as frames.

    :param frames: of its endpoint
    """

    def __init__(self, frames: FrameSide) -> None:
        self._frames = frames
        self._sent: dict[int, _Sent] = {}
        self._updates: dict[int, str] = {}
        """Names of the maps whose changes topics say, by topic id."""
        self._became: Counter[int] = Counter()
        """How many messages of these became a part of their map."""

    def add(self, topic: Topic, *, latched: bool = False) -> bool:
        """Send a topic as frames if it is a camera, depth, a latched map or a cloud that is to fit the air, and its
        options do not say otherwise.
        Returns whether it is sent so. For one that is, its options may have changed.

        :param latched: whether its publishers keep their messages for late joiners
        """
        if topic.type_name == GRID_UPDATE and topic.name.endswith(_UPDATES) and topic.options.codec == AUTO:
            self._updates[topic.topic_id] = topic.name.removesuffix(_UPDATES)
        known = self._sent.get(topic.topic_id)
        if known is not None:
            known.limit(topic)
            if known.options != _coding(topic.options) and (changed := coded_topic(topic)) is not None:
                known.use(topic, changed)
                self._begin(topic)
            return True
        coded = coded_topic(topic, latched=(latched or topic.latched) and not self._frames.relayed)
        if coded is None:
            return False
        self._sent[topic.topic_id] = _Sent(topic, coded)
        self._begin(topic)
        return True

    def _begin(self, topic: Topic) -> None:
        output = topic.options.camera.output
        self._frames.begin(topic.topic_id, "" if output == "same" else output)

    def check(self, topic_id: int, options: SendOptions) -> None:
        """Refuse options that cannot change while a topic is sent.

        :raises ConfigError: naming topic and option
        """
        sent = self._sent.get(topic_id)
        if sent is not None and sent.is_map and sent.cloud != options.cloud:
            raise ConfigError(
                f"topic {sent.name}: cloud cannot change while its newest message is kept for late robots"
            )

    def change(self, before: Topic, after: Topic) -> None:
        """A topic has other options, and may have another topic id with them."""
        if before.topic_id in self._updates:
            self._updates[after.topic_id] = self._updates[before.topic_id]
        if not before.as_frames or after.as_frames:
            if before.topic_id in self._sent or before.topic_id != after.topic_id:
                self.add(after)
        elif (sent := self._sent.pop(before.topic_id, None)) is not None:
            self._end(before.topic_id, sent.chains.values(), "the topic's options changed before the air was free")
            self._frames.end(before.topic_id)

    def stop(self, topic_id: int) -> None:
        """Send no further frame of a topic, until it is added again; then a key frame comes first."""
        self._updates.pop(topic_id, None)
        if (sent := self._sent.pop(topic_id, None)) is not None:
            self._end(topic_id, sent.chains.values(), "nobody wanted the topic any more")

    def forget(self, topic_id: int) -> None:
        """Send no message of a topic so far to those who come."""
        if topic_id in self._sent and (sent := self._sent[topic_id]).is_map:
            self._end(topic_id, sent.chains.values(), "its publisher has changed its type")
            sent.forget()

    def follow(self, topic_id: int, publishers: int) -> None:
        """So many publish a topic now."""
        if topic_id in self._sent:
            self._sent[topic_id].publishers = publishers

    def __contains__(self, topic_id: int) -> bool:
        return topic_id in self._sent

    def changed(self, topic_id: int, message: bytes) -> Changed | None:
        """The map that a message changes, if it says what changes of one that is sent as frames and has one publisher;
        None for any other message. Needs no lock. ``take`` has to follow."""
        name = self._updates.get(topic_id)
        for map_id, sent in list(self._sent.items()) if name is not None else ():
            if sent.name == name and sent.is_grid and (only := sent.only) is not None:
                try:
                    return Changed(topic_id, map_id, updated(only[1], message), only[0])
                except DamagedError as error:
                    return Changed(topic_id, map_id, error, only[0])
        return None

    def take(self, changed: Changed, now: float) -> None:
        """A map has changed."""
        if isinstance(changed.made, DamagedError):
            self._frames.refuse(changed.topic_id, Fate.DAMAGED, str(changed.made))
        elif changed.map_id in self._sent:
            self._became[changed.topic_id] += 1
            self.offer(changed.map_id, changed.made, now, changed.publisher)
        else:
            self._frames.refuse(changed.topic_id, Fate.SUPERSEDED, "the options of its map changed")

    def offer(self, topic_id: int, message: bytes, now: float, publisher: Hashable = None) -> None:
        """A message has come.

        :param publisher: whose it is; of a latched topic, the newest of each is kept; None = not known
        """
        sent = self._sent[topic_id]
        sent.note(now, came=len(message))
        chain, ended = sent.chain_of(publisher)
        self._end(topic_id, ended, "its publisher has gone")
        if chain.pull.offer(message, now):
            self._frames.refuse(topic_id, Fate.SUPERSEDED, "a newer one came before the air was free for it")

    def next(self, now: float) -> Job | None:
        """A message that is to be encoded now. ``done`` has to follow."""
        for topic_id, sent in self._sent.items():
            asks, reports = self._frames.asks(topic_id), self._frames.reports
            for number, chain in list(sent.chains.items()):
                if not chain.pull.waits(now, asks, reports):
                    continue
                share = sent.weight / sum(
                    other.weight for other in self._sent.values() if other is sent or other.lives(now)
                )
                pull = chain.pull.pull(now, self._frames.progress(topic_id, now), share)
                if pull is not None:
                    sent.chains[number] = sent.chains.pop(number)  # then it is the turn of the others
                    return Job(topic_id, pull, chain.encoder, number, chain, sent)
        return None

    def done(self, job: Job, made: Coded | CodecError, now: float) -> None:
        """What has become of a message."""
        sent, chain = job.sent, job.chain
        gone = self._sent.get(job.topic_id) is not sent or sent.chains.get(job.number) is not chain
        if job.encoder is not chain.encoder or gone:
            taken = False
            self._frames.refuse(job.topic_id, Fate.SUPERSEDED, "the topic's options changed while it was coded")
        elif isinstance(made, CodecError):
            taken = False
            sent.failed += 1
            self._frames.refuse(job.topic_id, Fate.DAMAGED, str(made))
        elif not (taken := self._taken(job, made, now)) and made.data[0] and not sent.is_map:
            chain.encoder = sent.coded.encoder()  # no frame may follow one that is not sent
        chain.pull.done(None if taken else job.pull)

    def _taken(self, job: Job, made: Coded, now: float) -> bool:
        """Whether a frame is sent. One of which no receiver makes a message is not."""
        sent, size = job.sent, len(job.pull.message)
        if not sent.coded.makes(made.data[0]):
            why = f"{made.said or 'it is no picture'}; it cannot come out as {sent.coded.output}"
            self._frames.refuse(job.topic_id, Fate.UNSUPPORTED, why)
            sent.failed += 1
            if why not in sent.said:
                sent.said.add(why)
                _log.warning("topic %s: is not sent: %s", sent.name, why)
            return False
        if size > MAX_SIZE and (sent.is_map or made.data[0] == 0):
            self._frames.refuse(job.topic_id, Fate.TOO_LARGE, f"{size} bytes; at most {MAX_SIZE}")
        elif self._submit(job, made, now):
            return True
        sent.failed += 1
        if Fate.TOO_LARGE not in sent.said:
            sent.said.add(Fate.TOO_LARGE)
            _log.warning("topic %s: a message of %d bytes is too large to be sent", sent.name, size)
        return False

    def _is_key(self, job: Job, made: Coded) -> bool:
        """Whether what was sent before is of no more use once a frame has left. Of clouds, each of which stands alone,
        all are repaired as long as somebody follows."""
        return job.pull.key if job.sent.is_cloud else made.before is None

    def _submit(self, job: Job, made: Coded, now: float) -> bool:
        """Send a frame. Returns whether it is sent."""
        sent = job.sent
        data = bytes([OF_CHAIN, job.number]) + made.data if job.number else made.data
        key = self._is_key(job, made)
        if not self._frames.submit(job.topic_id, data, job.pull.came, now, key=key, chain=job.number):
            return False
        sent.frames, sent.what, sent.bytes = sent.frames + 1, made.said, sent.bytes + len(data)
        sent.note(now, frame=len(data))
        if sent.is_map:
            job.encoder.confirmed(made.name)  # frames arrive in order
        elif made.data[0] == 0 and made.said not in sent.said:
            sent.said.add(made.said)
            what = "cells" if sent.is_cloud else "pictures"
            _log.warning("topic %s: passes exactly, not as %s: %s", sent.name, what, made.said)
        return True

    def end(self) -> None:
        """Code nothing more: messages that wait are not sent."""
        for topic_id, sent in self._sent.items():
            self._end(topic_id, sent.chains.values(), "sending ended before the air was free for it")

    def _end(self, topic_id: int, chains: Iterable[_Chain], why: str) -> None:
        for chain in chains:
            if chain.pull.end():
                self._frames.refuse(topic_id, Fate.SUPERSEDED, why)

    def stats(self, topic_id: int, now: float) -> dict[str, Any] | None:
        """What is made of a topic: frames so far and their bytes, messages that could not be coded, and in words what
        the newest frame leaves out and what the topic has become lately; None for one that is not sent as frames."""
        sent = self._sent.get(topic_id)
        if sent is None:
            if not self._became[topic_id]:
                return None
            of = self._updates[topic_id]
            said = f"{of}{_UPDATES}: {self._became[topic_id]} messages became part of {of}"
            return {"frames": 0, "bytes": 0, "not_coded": 0, "made": "", "words": said}
        state = self._frames.progress(topic_id, now)
        words = {"made": sent.what, "words": sent.words(now, state.age)}
        return {"frames": sent.frames, "bytes": sent.bytes, "not_coded": sent.failed, **words}


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


def _coding(options: SendOptions) -> tuple[Any, ...]:
    """Options with which another encoder is made."""
    camera = options.camera
    return camera.off, camera.size, camera.output, options.depth_image, options.cloud


def coded_topic(topic: Topic, *, latched: bool = False) -> CodedTopic | None:
    """How a topic is coded as frames; None if it is not. What has to be installed for it is said.

    :param latched: whether its publishers keep their newest messages for late joiners
    """
    states = (*CODECS["grid"].types, *CODECS["growing"].types)
    exact = topic.options.codec == AUTO and not topic.options.cloud.voxel
    if latched and topic.type_name in states and exact:
        return CodedTopic(topic.type_name, {"growing": {}, "cloud": OFF})
    if not topic.as_frames:
        return None
    options, depth = topic.options, topic.options.depth_image
    if topic.type_name == CLOUD:
        cloud = {"voxel": options.cloud.voxel, "range": options.cloud.range, "keep": options.cloud.keep}
        given = {name: value for name, value in cloud.items() if value != AUTO}
        return CodedTopic(CLOUD, {"cloud": given})
    chosen: dict[str, Mapping[str, Any] | str] = {
        "camera": OFF if options.camera.off else {"size": options.camera.size, "output_type": options.camera.output},
        "depth": OFF if depth.off else {"mode": depth.mode, "near": depth.near, "far": depth.far},
    }
    coded = CodedTopic(topic.type_name, chosen)
    if coded.missing:
        _log.warning("topic %s: passes as it is, and is not made small: %s", topic.name, coded.missing)
        return None
    return coded
