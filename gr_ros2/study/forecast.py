"""Does this traffic fit this radio? A forecast from a simulation of the link, and changes that would improve it.

Invariants: a forecast is a simulation of the same scenario, never a formula; the airtime of a packet is divided among
its entries in proportion to their bytes, so the shares of the topics add up to the airtime used; each advice contains
the forecast it is based on.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, get_args

import numpy as np

from gr_ros2.core.errors import ConfigError
from gr_ros2.gr.ends import message_codec
from gr_ros2.link import SentPacket
from gr_ros2.link.events import AirKind
from gr_ros2.link.message_codec import MessageCodec
from gr_ros2.phy import PHY, configured
from gr_ros2.record.result import TopicResult
from gr_ros2.run.load import make_phy, source_names
from gr_ros2.run.scenario import Scenario
from gr_ros2.run.simulate import Simulated, offered, simulate
from gr_ros2.settings.config import replaced
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import Topic

TRIAL_S = 10.0
"""s of traffic on which changes are tried."""
OVERHEAD_S = 0.0025
"""s that middleware, Python and the OFDM receiver add to the airtime of a message, as measured on two idle cores."""
_WALL_S = 1.7e9
"""s since 1970. A fixed time, so that a plan is the same on every day."""
_PARTS = (1, 2, 3)
"""Numbers of packets per message for which packet lengths are tried."""
_YOUNGER = 0.97
"""A topic counts as younger if the ratio of its new age to its age now is below this, and as older above the
inverse."""
_NOTICED_S, _NOTICED_PDR = 0.001, 0.03
"""Differences of the age and of the share delivered up to which a topic counts as unchanged."""
_LIGHTER = 0.95
"""A change that makes nothing worse is proposed if the ratio of the new airtime used to that used now is below this."""


@dataclass(frozen=True)
class TopicForecast:
    """One topic.

    :param offered_hz: messages/s given to the source
    :param message_bytes: mean, serialized
    :param air_bytes: mean per message on the air, coded where the link compresses, without headers
    :param load: part of the airtime that all its messages would take, at the mean cost of those sent; 1 = all airtime
    :param share: part of the airtime of the packets that left the source; above 1 is possible where the source is not
        paced
    :param rate_hz: messages/s delivered
    """

    topic: str
    offered_hz: float
    message_bytes: float
    air_bytes: float
    load: float
    share: float
    rate_hz: float
    result: TopicResult


@dataclass(frozen=True)
class Forecast:
    """The predicted behaviour of a scenario.

    :param airtime_s: of one packet
    :param capacity: packets/s the radio carries
    :param used: part of the airtime that is used, 0..1
    :param air_bytes_per_message: packet bytes on the air per message delivered, PAD and headers included
    :param pad: part of the packets' bytes that is PAD
    """

    packet_len: int
    airtime_s: float
    capacity: float
    used: float
    air_bytes_per_message: float | None
    pad: float
    topics: tuple[TopicForecast, ...]
    air: Mapping[str, float] = field(default_factory=dict)
    """Packets per message sent, by their purpose: new messages, repair, reports, hellos."""

    @property
    def load(self) -> float:
        """Part of the airtime that all messages would take; 1 = all airtime, above 1 they do not fit."""
        return sum(topic.load for topic in self.topics)


@dataclass(frozen=True)
class Effect:
    """The effect of a change of settings on one topic.

    :param weight: of the topic, as it is configured
    :param age_s: now, and with the change: mean age, s, or the latency of a topic that sends once. A topic that never
        arrives counts as ``TRIAL_S``
    :param pdr: now, and with the change: share of its messages that arrive, 0..1
    """

    topic: str
    weight: float
    age_s: tuple[float, float]
    pdr: tuple[float, float]

    @property
    def younger(self) -> bool:
        """Whether the age decreases by more than the thresholds."""
        before, after = self.age_s
        return after < _YOUNGER * before and before - after > _NOTICED_S

    @property
    def older(self) -> bool:
        """Whether the age increases by more than the thresholds."""
        before, after = self.age_s
        return before < _YOUNGER * after and after - before > _NOTICED_S

    @property
    def fewer(self) -> bool:
        """Whether the share of messages that arrive decreases."""
        return self.pdr[0] - self.pdr[1] > _NOTICED_PDR

    @property
    def more(self) -> bool:
        """Whether the share of messages that arrive increases."""
        return self.pdr[1] - self.pdr[0] > _NOTICED_PDR


@dataclass(frozen=True)
class Advice:
    """A change of settings, as on the command line, and its effects.

    :param setting: one or more ``key=value``, with spaces between them
    :param forecast: with the change
    :param used: airtime used now and with the change, 0..1
    :param effects: on every topic that sends
    """

    setting: str
    forecast: Forecast
    used: tuple[float, float]
    effects: tuple[Effect, ...]

    @property
    def harmless(self) -> bool:
        """Whether no topic becomes older and no topic loses more messages."""
        return not any(effect.older or effect.fewer for effect in self.effects)

    @property
    def gain(self) -> float:
        """How much younger the topics become: weighted mean of the logarithms of the ratios of their ages; 0 = no
        change."""
        weight = sum(effect.weight for effect in self.effects)
        gains = [effect.weight * np.log(effect.age_s[0] / effect.age_s[1]) for effect in self.effects]
        return float(sum(gains) / weight) if weight else 0.0

    @property
    def worth_it(self) -> bool:
        """Whether to propose the change. Either topics become younger on average, and the younger ones have more
        weight than the older ones; or the change saves airtime and makes nothing worse."""
        younger = sum(effect.weight for effect in self.effects if effect.younger)
        older = sum(effect.weight for effect in self.effects if effect.older)
        if younger > older and self.gain > -np.log(_YOUNGER):
            return True
        return self.harmless and self.used[1] < _LIGHTER * self.used[0]


class Planner:
    """Forecasts for one scenario and variants of it, with the same messages.

    :raises ConfigError: for version 0, a PHY that takes no airtime, or a scenario that cannot be set up
    """

    def __init__(self, scenario: Scenario) -> None:
        if not PHY.load(scenario.phy.name).has_airtime:
            raise ConfigError(f"phy.name = {scenario.phy.name!r}: takes no airtime, so everything fits; set a radio")
        if not scenario.version:
            raise ConfigError("version = 0: has nothing to choose by, as the paper has it; set version: 1 for a plan")
        if not scenario.simulated:
            # Robots then use wall-clock stamps. These large numbers take one byte more in coded messages.
            scenario = replace(scenario, sim=replaced(scenario.sim, start_time_s=_WALL_S))
        self.scenario = scenario
        self.registry = scenario.load_registry()
        self.phy = make_phy(scenario, self.registry)
        self._messages = list(offered(scenario, self.registry))
        if not self._messages:
            raise ConfigError(f"source = {scenario.source!r}: has nothing on the registered topics; set other topics")
        self._remembering: _Remembering | None = None

    def forecast(self) -> Forecast:
        """The scenario as it is."""
        return self._forecast(self.scenario)

    def advice(self) -> list[Advice]:
        """Single changes that make topics younger or save airtime. Changes that make no topic worse come first; within
        each group the best comes first.

        Each change is tried on the first seconds of the traffic, and compared with the present settings on the same
        seconds.
        """
        base = replace(self.scenario, duration_s=min(self.scenario.duration_s or TRIAL_S, TRIAL_S))
        now = self._forecast(base)
        tried = [self._compared(setting, now, self._forecast(variant)) for setting, variant in self._variants(base)]
        proposed = [advice for advice in tried if advice.worth_it]
        return sorted(proposed, key=lambda advice: (not advice.harmless, -advice.gain, advice.forecast.used))

    def _compared(self, setting: str, now: Forecast, then: Forecast) -> Advice:
        """The effect of a change on each topic."""
        registry = self.registry.with_options(self.scenario.ros_source.topic_options)
        weights = {
            name: registry[topic_id].options.weight for name, topic_id in source_names(self.scenario, registry).items()
        }
        effects = tuple(
            Effect(
                before.topic,
                weights[before.topic],
                (_age(before.result), _age(after.result)),
                (before.result.pdr or 0.0, after.result.pdr or 0.0),
            )
            for before, after in zip(now.topics, then.topics, strict=True)
            if before.result.sent
        )
        return Advice(setting, then, (now.used, then.used), effects)

    def _variants(self, base: Scenario) -> Iterator[tuple[str, Scenario]]:
        source, sink = base.ros_source, base.ros_sink
        if not source.compresses:
            yield "ros_source.compression=true", replace(base, ros_source=replace(source, compression=True))
        if source.packet_rate == 0:
            yield "ros_source.packet_rate=auto", replace(base, ros_source=replace(source, packet_rate=AUTO))
        for packet_len in self._packet_lens():
            yield (
                f"packet_len={packet_len}",
                replace(
                    base,
                    packet_len=packet_len,
                    ros_source=replace(source, packet_len=packet_len),
                    ros_sink=replace(sink, packet_len=packet_len),
                ),
            )

    def _packet_lens(self) -> list[int]:
        """Packet lengths such that the messages of one of the topics fit into one packet, or into a few equal parts."""
        source = self.scenario.ros_source
        wire = source.wire_format
        sizes: dict[int, list[int]] = {}
        for message in self._messages:
            sizes.setdefault(message.topic_id, []).append(self._size(message.topic_id, message.payload))
        largest = max(max(values) for values in sizes.values())
        lens = set()
        for values in sizes.values():
            most = sorted(values)[int(0.99 * (len(values) - 1))]
            lens |= {wire.packed_len([-(-most // parts)]) for parts in _PARTS}
        lens.discard(self.scenario.packet_len)
        usable = range(max(wire.packed_len([source.min_fragment]), wire.min_packet_len), wire.max_packet_len + 1)
        return sorted(
            packet_len for packet_len in lens if packet_len in usable and largest <= wire.largest_message(packet_len)
        )

    def _codec(self, compression: bool) -> _Remembering | None:
        if not compression:
            return None
        if self._remembering is None:
            self._remembering = _Remembering(message_codec(self.scenario.ros_source.dictionaries, self.registry))
        return self._remembering

    def _size(self, topic_id: int, payload: bytes) -> int:
        """Bytes of a message on the air, without headers."""
        codec = self._codec(self.scenario.ros_source.compresses)
        return len(payload) if codec is None else len(codec.encode(topic_id, payload))

    def _forecast(self, scenario: Scenario) -> Forecast:
        phy = configured(scenario.phy, scenario.packet_len, self.phy.sample_rate)
        airtime = phy.airtime()
        codec = self._codec(scenario.ros_source.compresses)
        duration = scenario.duration_s or self._messages[-1].t
        messages = [message for message in self._messages if message.t <= duration]
        shares: Counter[int] = Counter()
        padded = sent_bytes = 0
        spent = 0.0

        wire = scenario.ros_source.wire_format

        def share(sent: SentPacket) -> None:
            nonlocal padded, sent_bytes, spent
            own_airtime = phy.airtime(len(sent.data))
            spent += own_airtime
            sent_bytes += len(sent.data)
            layout = wire.layout(sent.packet, scenario.packet_len, len(sent.data))
            padded += sum(span.size for span in layout if span.kind == "pad")
            whole = sum(span.size for span in layout if span.entry is not None)
            for span in layout:
                if span.entry is not None:
                    shares[span.entry.topic_id] += own_airtime * span.size / whole  # type: ignore[assignment]

        run = simulate(scenario, phy=phy, messages=iter(messages), codec=codec, on_packet=share, overhead_s=OVERHEAD_S)
        names = source_names(scenario, self.registry)
        topics = []
        for result in run.topics:
            topic_id = names[result.topic]
            mine = [message.payload for message in messages if message.topic_id == topic_id]
            cost = shares[topic_id] / max(run.stats.sent[topic_id], 1)
            sizes = [len(payload) if codec is None else len(codec.encode(topic_id, payload)) for payload in mine]
            topics.append(
                TopicForecast(
                    topic=result.topic,
                    offered_hz=len(mine) / duration,
                    message_bytes=float(np.mean([len(payload) for payload in mine])) if mine else 0.0,
                    air_bytes=float(np.mean(sizes)) if mine else 0.0,
                    load=cost * len(mine) / duration,
                    share=shares[topic_id] / duration,
                    rate_hz=result.delivered / duration,
                    result=result,
                )
            )
        delivered = sum(topic.result.delivered for topic in topics)
        return Forecast(
            packet_len=scenario.packet_len,
            airtime_s=airtime,
            capacity=1 / airtime,
            used=min(spent / duration, 1.0),
            air_bytes_per_message=sent_bytes / delivered if delivered else None,
            pad=padded / sent_bytes if sent_bytes else 0.0,
            topics=tuple(topics),
            air=_air(run),
        )


class _Remembering:
    """A codec with a cache: it codes each message only once, for all forecasts."""

    def __init__(self, codec: MessageCodec) -> None:
        self._codec = codec
        self._coded: dict[tuple[int, bytes], bytes] = {}
        self._decoded: dict[tuple[int, bytes], bytes] = {}

    def add(self, topic: Topic) -> None:
        self._codec.add(topic)

    def learn(self, type_name: str, definitions: Mapping[str, Any]) -> None:
        self._codec.learn(type_name, definitions)

    def announcement(self, topic_id: int) -> str:
        return self._codec.announcement(topic_id)

    def lacks(self, topic_id: int, coded: bytes) -> bool:
        return self._codec.lacks(topic_id, coded)

    def canonical(self, topic_id: int, payload: bytes) -> bytes:
        return self._codec.canonical(topic_id, payload)

    def encode(self, topic_id: int, payload: bytes) -> bytes:
        coded = self._coded.get((topic_id, payload))
        if coded is None:
            coded = self._coded[topic_id, payload] = self._codec.encode(topic_id, payload)
        return coded

    def decode(self, topic_id: int, coded: bytes) -> bytes:
        payload = self._decoded.get((topic_id, coded))
        if payload is None:
            payload = self._decoded[topic_id, coded] = self._codec.decode(topic_id, coded)
        return payload


def _air(run: Simulated) -> dict[str, float]:
    """Packets per message sent by their purpose, those of all robots."""
    packets = {kind: run.packets.get(f"air_{kind}", 0) for kind in get_args(AirKind)}
    messages = max(sum(run.stats.sent.values()), 1)
    return {kind: count / messages for kind, count in packets.items()} if any(packets.values()) else {}


def _age(result: TopicResult) -> float:
    """Mean age, s, or the latency of a topic that sends once. A topic that never arrives counts as TRIAL_S."""
    age = result.age_s.mean if result.sent > 1 else result.latency_s.max
    return TRIAL_S if age is None else max(age, _NOTICED_S)
