"""Does this traffic fit this radio? A forecast from a simulation of the link, and changes that would improve it.

Invariants: a forecast is a simulation of the same scenario, never a formula; the airtime of a packet with new messages
is divided among its entries in proportion to their bytes, so the shares of the topics add up to what these packets
use; each advice contains the forecast it is based on.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from itertools import chain
from statistics import fmean
from typing import Any, get_args

import numpy as np

from gr_ros2.codecs.frames import coded_topic
from gr_ros2.codecs.whole import whole_of
from gr_ros2.compression import LinkCodec
from gr_ros2.core.errors import ConfigError, RunError
from gr_ros2.core.forks import FORKS, load_for_forks
from gr_ros2.core.names import first
from gr_ros2.link import SentPacket
from gr_ros2.link.airtime_limit import sustained
from gr_ros2.link.events import AirKind
from gr_ros2.link.message_codec import FRAME
from gr_ros2.observe.result import TopicResult
from gr_ros2.phy import PHY, configured
from gr_ros2.settings.config import ChannelConfig, SendOptions, replaced
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import Registry, options_of
from gr_ros2.settings.robot import RobotConfig
from gr_ros2_lab.medium.base import Surroundings
from gr_ros2_lab.medium.loss_table import LossCurve
from gr_ros2_lab.medium.measured import SurveyedPlaces
from gr_ros2_lab.medium.positions import Positions
from gr_ros2_lab.report.explain import air_line
from gr_ros2_lab.run.load import make_phy, source_names
from gr_ros2_lab.run.robot_settings import senders_of
from gr_ros2_lab.run.robots import surroundings
from gr_ros2_lab.run.scenario import Scenario, changed
from gr_ros2_lab.run.simulate import Simulated, coupled, offered_by, simulate
from gr_ros2_lab.survey.table import Survey

TRIAL_S = 10.0
"""s of traffic on which changes are tried."""
OVERHEAD_S = 0.0025
"""s that middleware, Python and the OFDM receiver add to the airtime of a message, as measured on two idle cores."""
_WALL_S = 1.7e9
"""s since 1970. A fixed time, so that a plan is the same on every day."""
_PARTS = (1, 2, 3)
"""Numbers of packets per message for which packet lengths are tried."""
_LONGER = 1.2
"""Of packet lengths whose ratio is below this the longest alone is tried. No built-in scenario had other advice with
all of them, which took a fifth more time for the demo."""
_FULL = 0.9
"""Part of the airtime that the messages may take. The rest is for repair, reports, and what comes at once."""
_ROUNDS = 5
"""Most times that cuts are tried, each with what a message cost after the cuts before."""
_LEAST_SHARE, _LEAST_HZ = 0.1, 0.5
"""A topic that would keep less than this part of its messages, or fewer per second, is better left out."""
_YOUNGER = 0.97
"""A topic counts as younger if the ratio of its new age to its age now is below this, and as older above the
inverse."""
_NOTICED_S, _NOTICED_PDR = 0.001, 0.03
"""Differences of the age and of the share delivered up to which a topic counts as unchanged."""
_LIGHTER = 0.95
"""A change that makes nothing worse is proposed if the ratio of the new airtime used to that used now is below this."""


@dataclass(frozen=True)
class FrameForecast:
    """What a topic becomes that is sent as frames, in what others leave of the air.

    :param made: what the newest frame is, in words
    :param rate_hz: frames/s sent
    :param kbit_s: of the frames, without headers
    """

    made: str
    rate_hz: float
    kbit_s: float


@dataclass(frozen=True)
class TopicForecast:
    """One topic.

    :param offered_hz: messages/s given to the source
    :param wanted_hz: of those the messages/s that its ``max_rate`` lets pass
    :param message_bytes: mean, serialized
    :param air_bytes: mean per message on the air, coded where the link compresses, without headers
    :param src_id: of the robot that sends it
    :param load: part of the airtime allowed, to all robots that share it, that all its messages would take, at the mean
        cost of those sent
    :param share: part of the airtime that its new messages used; above 1 is possible where the source is not
        paced
    :param rate_hz: messages/s delivered
    """

    topic: str
    src_id: int
    offered_hz: float
    wanted_hz: float
    message_bytes: float
    air_bytes: float
    load: float
    share: float
    rate_hz: float
    result: TopicResult
    frames: FrameForecast | None = None
    """None for a topic whose messages all leave; the load of any other is its share."""


@dataclass(frozen=True)
class Forecast:
    """The predicted behaviour of a scenario.

    :param airtime_s: of one packet
    :param capacity: packets/s the radio carries
    :param used: part of the airtime that is used, 0..1; of the busiest channel, where each robot has its own
    :param air_bytes_per_message: packet bytes on the air per message delivered, PAD and headers included
    :param allowed: part of the airtime that may be used, 0..1; loads are parts of this
    :param shared: whether all robots use one channel
    """

    packet_len: int
    airtime_s: float
    capacity: float
    used: float
    air_bytes_per_message: float | None
    allowed: float
    shared: bool
    topics: tuple[TopicForecast, ...]
    air: Mapping[str, float] = field(default_factory=dict)
    """Packets per message sent, by their purpose: new messages, repair, reports, hellos."""
    in_use: str = ""
    """Which part of the time the air is in use, and for what: a sentence as in the report of a run."""

    @property
    def load(self) -> float:
        """Part of the airtime allowed that all messages would take, on the busiest channel; above 1 they do not fit.
        Topics that are sent as frames always fit: they take what is left."""
        channels: Counter[int] = Counter()
        for topic in self.topics:
            if topic.frames is not None:
                continue
            channels[0 if self.shared else topic.src_id] += topic.load  # type: ignore[assignment]
        return max(channels.values(), default=0.0)


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
    :param used: airtime used now, and with the change if that is to it as in the first seconds, 0..1
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
    def more(self) -> float:
        """By how much the share of messages that arrive rises: weighted mean over the topics, 0 where none does."""
        weight = sum(effect.weight for effect in self.effects)
        rises = [effect.weight * (effect.pdr[1] - effect.pdr[0]) for effect in self.effects if effect.more]
        return sum(rises) / weight if weight else 0.0

    @property
    def worth_it(self) -> bool:
        """Whether to propose the change. Either topics become younger on average, and the younger ones have more
        weight than the older ones; or the change saves airtime and makes nothing worse."""
        younger = sum(effect.weight for effect in self.effects if effect.younger)
        older = sum(effect.weight for effect in self.effects if effect.older)
        if younger > older and self.gain > -np.log(_YOUNGER):
            return True
        return self.harmless and self.used[1] < _LIGHTER * self.used[0]


@dataclass(frozen=True)
class Cut:
    """Less traffic on one topic.

    :param topic: its name, or which one it is of every robot
    :param rate_hz: messages/s of a robot that remain; 0 = the topic is left out
    :param settings: of this cut and those before it, as on the command line
    :param load: of all topics after this cut and those before it, see :attr:`Forecast.load`
    """

    topic: str
    rate_hz: float
    settings: tuple[str, ...]
    load: float


class Planner:
    """Forecasts for one scenario and variants of it, with the same messages.

    :param registry: None takes the scenario's
    :raises ConfigError: for version 0, a PHY that takes no airtime, or a scenario that cannot be set up
    """

    def __init__(self, scenario: Scenario, registry: Registry | None = None) -> None:
        if not PHY.load(scenario.phy.name).has_airtime:
            raise ConfigError(f"phy.name = {scenario.phy.name!r}: takes no airtime, so everything fits; set a radio")
        if scenario.paper is not None:
            raise ConfigError("paper: version 0 has nothing to choose by, as the paper has it; leave it out for a plan")
        if not scenario.simulated:
            # Robots then use wall-clock stamps. These large numbers take one byte more in coded messages.
            scenario = replace(scenario, sim=replaced(scenario.sim, start_time_s=_WALL_S))
        self._whole = scenario
        self.scenario = coupled(scenario)
        self.registry = registry or scenario.load_registry()
        self.phy = make_phy(self.scenario, self.registry)
        self._messages = [list(messages) for messages in offered_by(self.scenario, self.registry)]
        if not any(self._messages):
            asked = ", ".join(first(topic.name for topic in self.registry))
            raise ConfigError(
                f"source = {scenario.source!r}: has no message of {asked}; set other topics, or record them again"
            )
        self._rows: dict[str, str] = {}
        self._weights: dict[str, float] = {}
        self._framed: set[int] = set()
        """Topics of pictures and clouds that are sent as frames."""
        for robot in senders_of(self.scenario.all_robots):
            options = self.registry.with_options(robot.options)
            for name, topic_id in source_names(robot, self.registry).items():
                topic = options[topic_id]
                self._rows[name], self._weights[name] = topic.name, topic.options.weight
                if robot.compression and coded_topic(topic) is not None:
                    self._framed.add(topic_id)
        self._coded: dict[tuple[int, bytes], bytes] = {}
        """Messages as they are on the air, by topic id and payload."""
        self._remembering: _Remembering | None = None
        self._now: Forecast | None = None
        self._begun: Generator[Forecast, None, None] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """For another process: of what was found here so far the coded messages alone."""
        kept = {name: value for name, value in vars(self).items() if name != "_around"}
        return {**kept, "_remembering": None, "_now": None, "_begun": None}

    def begin(self) -> None:
        """Have other processes try all changes from the first :meth:`forecast` on, for :meth:`advice`."""
        scenarios = [scenario for _, scenario in self._trials()]
        self._begun = _on_all_processors(self._forecast, [self.scenario, *scenarios])

    def forecast(self) -> Forecast:
        """The scenario as it is."""
        if self._now is None:
            self._now = self._forecast(self.scenario) if self._begun is None else next(self._begun)
        return self._now

    @property
    def task(self) -> str:
        """What the robots of the scenario do on what they hear, which no forecast tries; '' where they do nothing."""
        return self._whole.task

    def range_m(self, pdr: float) -> float | None:
        """Distance up to which a share of the packets arrives, without walls, shadowing and others on the channel.

        None where levels do not follow from positions.
        """
        around = self._around
        if not isinstance(around, Positions) or not self.phy.has_samples:
            return None
        curve = LossCurve(self.phy.on_mcs(0), ChannelConfig())
        snrs_db = np.arange(curve.low_db, curve.high_db, 0.1)
        return around.range_m(float(snrs_db[np.argmax(curve.pdr(snrs_db) >= pdr)]))

    @property
    def survey(self) -> Survey | None:
        """What says the channel between places; None where nothing was measured there."""
        return self._around.survey if isinstance(self._around, SurveyedPlaces) else None

    @cached_property
    def _around(self) -> Surroundings:
        return surroundings(self._whole, self.phy.sample_rate)

    def advice(
        self, lengths: bool = True, tell: Callable[[int, int], object] = lambda _done, _of: None
    ) -> list[Advice]:
        """Single changes that make topics younger or save airtime. Changes that make no topic worse come first; within
        each group those after which more arrives, then the best.

        Each change is tried on the first seconds of the traffic, and compared with the present settings on the same
        seconds.

        :param lengths: whether other packet lengths are tried
        :param tell: called with the number of forecasts made, and that of all of them
        """
        self.forecast()
        trials = [(setting, scenario) for setting, scenario in self._trials() if lengths or "packet_len" not in setting]
        forecasts = self._begun or _on_all_processors(self._forecast, [scenario for _, scenario in trials])
        made: list[Forecast] = []
        for _, forecast in zip(trials, forecasts, strict=False):  # lengths come last
            made.append(forecast)
            tell(len(made), len(trials))
        forecasts.close()
        self._begun = None
        tried = [
            self._compared(setting, made[0], then) for (setting, _), then in zip(trials[1:], made[1:], strict=True)
        ]
        proposed = [advice for advice in tried if advice.worth_it]
        return sorted(proposed, key=lambda advice: (not advice.harmless, -advice.more, -advice.gain, advice.used[1]))

    def _compared(self, setting: str, now: Forecast, then: Forecast) -> Advice:
        """The effect of a change on each topic."""
        effects = tuple(
            Effect(
                before.topic,
                self._weights[before.topic],
                (_age(before.result), _age(after.result)),
                (before.result.pdr or 0.0, after.result.pdr or 0.0),
            )
            for before, after in zip(now.topics, then.topics, strict=True)
            if before.result.sent
        )
        used = self.forecast().used
        return Advice(setting, then, (used, min(used * then.used / now.used, 1.0) if now.used else then.used), effects)

    def _trials(self) -> Iterator[tuple[str, Scenario]]:
        """The first seconds as they are, and with each change; the settings that make it."""
        base = replace(self.scenario, duration_s=min(self.scenario.duration_s or TRIAL_S, TRIAL_S))
        yield "", base
        if not base.compresses:
            yield "compression=true", _sending(base, lambda own: replace(own, compression=True))
        if base.first.packet_rate == 0:
            yield "packet_rate=auto", _sending(base, lambda own: replace(own, packet_rate=AUTO))
        if base.duplex == "half" and len(senders_of(base.all_robots)) > 1 and base.medium == "exclusive":
            yield "medium=slots", replace(base, medium="slots")
        for packet_len in self._packet_lens():
            yield f"packet_len={packet_len}", _with_packet_len(base, packet_len)

    def _packet_lens(self) -> list[int]:
        """Packet lengths such that the messages of one of the topics fit into one packet, or into a few equal parts."""
        wire = self.scenario.wire_format
        sizes: dict[int, list[int]] = {}
        for message in chain(*self._messages):
            if message.topic_id in self._framed:
                continue  # cut to what there is
            sizes.setdefault(message.topic_id, []).append(self._size(message.topic_id, message.payload))
        largest = max((max(values) for values in sizes.values()), default=0)
        lens = set()
        for values in sizes.values():
            most = sorted(values)[int(0.99 * (len(values) - 1))]
            lens |= {wire.packed_len([-(-most // parts)]) for parts in _PARTS}
        usable = range(wire.min_packet_len, wire.max_packet_len + 1)
        tried: list[int] = []
        for packet_len in sorted(lens - {self.scenario.packet_len}, reverse=True):
            fits = packet_len in usable and largest <= wire.largest_message(packet_len)
            if fits and (not tried or packet_len * _LONGER <= tried[-1]):
                tried.append(packet_len)
        return tried[::-1]

    def cuts(self) -> list[Cut]:
        """What to send less of until the rest fits, the heaviest topic first; [] if it fits.

        The air is shared out by weight (max-min fairness): a topic that needs less than its share keeps all of its
        messages, every other one is limited to its share.
        """
        forecast = self.forecast()
        steps: list[tuple[Scenario, Cut]] = []
        offered, loads = self._demand(forecast)
        cost = {row: loads[row] / hz for row, hz in offered.items()}
        load = forecast.load
        for _ in range(_ROUNDS):
            if load <= 1:
                break
            rates = self._fair_rates({name: (cost[name] * hz, hz) for name, hz in offered.items()})
            steps = list(
                self._applied({name: rates[name] for name in sorted(rates, key=lambda n: -cost[n] * offered[n])})
            )
            if not steps:
                break
            # A message costs more where fewer others share its packets.
            last = self._forecast(steps[-1][0])
            load = last.load
            there, loads = self._demand(last)  # with what found no place before
            offered = there | offered
            kept = {row: own / (rates.get(row) or offered[row]) for row, own in loads.items()}
            cost |= {name: max(cost.get(name, 0.0), own) for name, own in kept.items()}
        between = _on_all_processors(self._forecast, [scenario for scenario, _ in steps[:-1]])
        then = [*(forecast.load for forecast in between), load]
        return [replace(cut, load=after) for (_, cut), after in zip(steps, then, strict=False)]

    def _demand(self, forecast: Forecast) -> tuple[dict[str, float], dict[str, float]]:
        """Messages/s that a robot offers, and the load of its channel, by rows of the registry."""
        rows: dict[str, list[TopicForecast]] = {}
        for topic in forecast.topics:
            if topic.load and topic.frames is None:
                rows.setdefault(self._rows[topic.topic], []).append(topic)
        offered = {row: fmean(topic.offered_hz for topic in topics) for row, topics in rows.items()}
        together = sum if forecast.shared else max
        return offered, {row: together(topic.load for topic in topics) for row, topics in rows.items()}

    def _fair_rates(self, topics: Mapping[str, tuple[float, float]]) -> dict[str, float]:
        """Messages/s of the topics that have to be cut, 0 for those that are left out.

        :param topics: by row of the registry: load of a channel, and messages/s of each robot
        """
        kept = dict(topics)
        while True:
            level = _fair_level([(load, self._weight(name)) for name, (load, _) in kept.items()])
            rates = {
                name: _round_rate(hz * level * self._weight(name) / load)
                for name, (load, hz) in kept.items()
                if load > level * self._weight(name)
            }
            tiny = [name for name, hz in rates.items() if hz < max(_LEAST_HZ, _LEAST_SHARE * kept[name][1])]
            tiny = [name for name in tiny if kept[name][1] > _LEAST_HZ]  # a map is sent, however long it takes
            if not tiny:
                return {**dict.fromkeys(topics.keys() - kept.keys(), 0.0), **{n: hz for n, hz in rates.items() if hz}}
            del kept[max(tiny, key=lambda name: kept[name][0])]

    def _applied(self, rates: Mapping[str, float]) -> Iterator[tuple[Scenario, Cut]]:
        """Each cut, its load not known yet, and the scenario with it and those before it."""
        scenario = self.scenario
        settings: list[str] = []
        for row, rate_hz in rates.items():
            if rate_hz:
                settings.append(f"topics.{row}.max_rate={rate_hz:g}")
                scenario = _sending(scenario, partial(_limited, row=row, rate_hz=rate_hz))
            else:
                scenario = _sending(scenario, partial(_without, row=row))
                left = [self.registry.chosen(robot.words) for robot in senders_of(scenario.all_robots)]
                if not all(left):
                    return
                settings.append(f"topics.-{row}=")
            names = [name for name, other in self._rows.items() if other == row]
            topic = names[0] if len(names) == 1 else f"{row} of every robot"
            yield scenario, Cut(topic, rate_hz, tuple(settings), np.nan)

    def _weight(self, row: str) -> float:
        """Of a topic of all robots together."""
        return sum(weight for name, weight in self._weights.items() if self._rows[name] == row)

    def _codec(self, compression: bool) -> _Remembering | None:
        if not compression:
            return None
        if self._remembering is None:
            self._remembering = _Remembering(self.registry, self._coded)
        return self._remembering

    def _size(self, topic_id: int, payload: bytes) -> int:
        """Bytes of a message on the air, without headers."""
        codec = self._codec(self.scenario.compresses)
        return len(payload) if codec is None else len(codec.encode(topic_id, payload))

    def _forecast(self, scenario: Scenario) -> Forecast:
        robots = senders_of(scenario.all_robots)
        phy = configured(scenario.phy, scenario.packet_len, self.phy.sample_rate)
        airtime_of = cache(phy.airtime)
        codec = self._codec(scenario.compresses)
        rule = scenario.airtime.rule
        shared = scenario.duplex == "half"
        allowed = 1.0 if rule is None else min(1.0, (len(robots) if shared else 1) * sustained(rule))
        duration = scenario.duration_s or self._messages[0][-1].t
        topic_ids: dict[tuple[int, str], int] = {}
        rates_hz: dict[tuple[int, int], float] = {}
        payloads: dict[tuple[int, int], list[bytes]] = {}
        messages = []
        for robot, own in zip(robots, self._messages, strict=True):
            src_id, options = robot.robot_id, self.registry.with_options(robot.options)
            for name, topic_id in source_names(robot, self.registry).items():
                topic_ids[src_id, name] = topic_id
                rates_hz[src_id, topic_id] = options[topic_id].options.max_rate or np.inf
                payloads[src_id, topic_id] = []
            messages.append([m for m in own if m.t <= duration and (src_id, m.topic_id) in payloads])
            for message in messages[-1]:
                payloads[src_id, message.topic_id].append(message.payload)
        shares: Counter[tuple[int, int]] = Counter()
        sent_bytes = 0
        senders: dict[str, Counter[str]] = {}

        wire = scenario.wire_format

        def share(sent: SentPacket) -> None:
            nonlocal sent_bytes
            own_airtime = airtime_of(len(sent.data))
            if sent.now <= duration:  # what is sent later has all air for itself
                senders.setdefault(str(sent.src_id), Counter())[sent.kind] += own_airtime  # type: ignore[assignment]
            sent_bytes += len(sent.data)
            if sent.kind != "new":
                return
            layout = wire.layout(sent.packet, scenario.packet_len, len(sent.data))
            whole = sum(span.size for span in layout if span.entry is not None)
            for span in layout:
                if span.entry is not None:
                    key = sent.src_id, span.entry.topic_id
                    shares[key] += own_airtime * span.size / whole  # type: ignore[assignment]

        run = simulate(
            scenario,
            registry=self.registry,
            phy=phy,
            messages=[iter(own) for own in messages],
            codec=codec,
            on_packet=share,
            overhead_s=OVERHEAD_S,
        )
        topics = []
        for result in run.topics:
            topic_id = topic_ids[result.src_id, result.topic]
            key = result.src_id, topic_id
            mine = payloads[key]
            cost = shares[key] / max(run.stats[result.src_id].sent[topic_id], 1)
            made = run.frames.get(key)
            fits = made is not None and topic_id in self._framed
            if made is not None:
                sizes = [made["bytes"] / max(made["frames"], 1)]
            else:
                sizes = [len(payload) if codec is None else len(codec.encode(topic_id, payload)) for payload in mine]
            topics.append(
                TopicForecast(
                    topic=result.topic,
                    src_id=result.src_id,
                    offered_hz=len(mine) / duration,
                    wanted_hz=(wanted_hz := min(len(mine) / duration, rates_hz[key])),
                    message_bytes=float(np.mean([len(payload) for payload in mine])) if mine else 0.0,
                    air_bytes=float(np.mean(sizes)) if mine else 0.0,
                    load=(shares[key] / duration if fits else cost * wanted_hz) / allowed,
                    share=shares[key] / duration,
                    rate_hz=result.delivered / duration,
                    result=result,
                    frames=FrameForecast(made["made"], made["frames"] / duration, 8e-3 * made["bytes"] / duration)
                    if made is not None and fits
                    else None,
                )
            )
        delivered = sum(topic.result.delivered for topic in topics)
        spent = [float(kinds.total()) for kinds in senders.values()]
        sending = {str(robot.robot_id) for robot in robots}
        return Forecast(
            packet_len=scenario.packet_len,
            airtime_s=phy.airtime(),
            capacity=allowed / phy.airtime(),
            used=min((sum(spent) if shared else max(spent, default=0.0)) / duration, 1.0),
            air_bytes_per_message=sent_bytes / delivered if delivered else None,
            allowed=allowed,
            shared=shared,
            topics=tuple(topics),
            air=_air(run),
            in_use=air_line(senders, duration, sending, shared=shared) if senders else "",
        )


class _Remembering(LinkCodec):
    """A codec with a cache: it codes each message only once, for all forecasts.

    :param coded: what has been coded already, by topic id and payload
    """

    def __init__(self, registry: Registry, coded: dict[tuple[int, bytes], bytes]) -> None:
        super().__init__(registry, whole=whole_of)
        self._coded = coded
        self._decoded: dict[tuple[int, bytes], bytes] = {}

    def encode(self, topic_id: int, payload: bytes) -> bytes:
        coded = self._coded.get((topic_id, payload))
        if coded is None:
            coded = self._coded[topic_id, payload] = super().encode(topic_id, payload)
        return coded

    def decode(self, topic_id: int, coded: bytes) -> bytes:
        if coded[:1] == FRAME:  # of a chain, which no announcement has told this codec, since it is the sender's too
            return coded[1:]
        payload = self._decoded.get((topic_id, coded))
        if payload is None:
            payload = self._decoded[topic_id, coded] = super().decode(topic_id, coded)
        return payload


def _on_all_processors(
    work: Callable[[Scenario], Forecast], scenarios: Sequence[Scenario]
) -> Generator[Forecast, None, None]:
    """The same as ``map``, by other processes. Forks would have the locks of this one's threads, and wait for ever.

    :raises RunError: for a process that was ended from outside
    """
    processors = min(len(os.sched_getaffinity(0)), len(scenarios))
    if processors < 2:
        yield from map(work, scenarios)
        return
    prepare_processes()
    pool = ProcessPoolExecutor(processors, FORKS, _begin_process, (work,))
    try:
        yield from pool.map(_process, scenarios)
    except BrokenProcessPool as error:
        raise RunError("a process that made a forecast was ended; free memory, and try again") from error
    finally:
        pool.shutdown(cancel_futures=True)


def prepare_processes() -> None:
    """Begin to load what other processes need, which takes a second, while this one goes on."""
    load_for_forks(__name__)


def _begin_process(work: Callable[[Scenario], Forecast]) -> None:
    _work.append(work)


_work: list[Callable[[Scenario], Forecast]] = []
"""What a forked process is for."""


def _process(scenario: Scenario) -> Forecast:
    return _work[0](scenario)


def _sending(scenario: Scenario, change: Callable[[RobotConfig], RobotConfig]) -> Scenario:
    return changed(scenario, RobotConfig, lambda robot: change(robot) if robot.sends else robot)


def _limited(robot: RobotConfig, *, row: str, rate_hz: float) -> RobotConfig:
    options = replaced(options_of(row, robot.topics, SendOptions()), max_rate=rate_hz)
    return replace(robot, topics={**robot.topics, row: options})


def _without(robot: RobotConfig, *, row: str) -> RobotConfig:
    return replace(robot, topics={**robot.topics, f"-{row}": SendOptions()})


def _with_packet_len(scenario: Scenario, packet_len: int) -> Scenario:
    return changed(scenario, RobotConfig, lambda robot: replace(robot, packet_len=packet_len))


def _fair_level(loads: Sequence[tuple[float, float]]) -> float:
    """Airtime per weight, so that the topics fill ``_FULL`` of the air if none takes more than that.

    :param loads: what each topic would take, and its weight
    """
    room, weight = _FULL, sum(weight for _, weight in loads)
    for load, own in sorted(loads, key=lambda pair: pair[0] / pair[1]):
        if load > room / weight * own:
            return room / weight
        room, weight = room - load, weight - own
    return np.inf


def _round_rate(rate_hz: float) -> float:
    """The next lower of 1, 2, 5, 10, 20, … messages/s."""
    decade = 10.0 ** np.floor(np.log10(rate_hz)) if rate_hz > 0 else 0.0
    return float(max((step * decade for step in (1, 2, 5) if step * decade <= rate_hz), default=0.0))


def _air(run: Simulated) -> dict[str, float]:
    """Packets per message sent by their purpose, those of all robots."""
    packets = {kind: run.packets.get(f"air_{kind}", 0) for kind in get_args(AirKind)}
    messages = max(sum(stats.sent.total() for stats in run.stats.values()), 1)
    return {kind: count / messages for kind, count in packets.items()} if any(packets.values()) else {}


def _age(result: TopicResult) -> float:
    """Mean age, s, or the latency of a topic that sends once. A topic that never arrives counts as TRIAL_S."""
    age = result.age_s.mean if result.sent > 1 else result.latency_s.max
    return TRIAL_S if age is None else max(age, _NOTICED_S)
