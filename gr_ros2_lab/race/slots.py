"""gr-ros2 in the race of teams: whole endpoints in slots on one channel, in simulated time.

The channel is that of the peers: the same PHY, sample rate and airtimes, the same losses for each receiver by itself.
But medium access is not free: a slot lasts as long as the longest packet and a guard, packets carry its block, and
packets that overlap are lost.

Invariants: as the peers, the robots begin to send at once, and the recordings begin when all have heard all; what a
host and its ROS graphs add is added to each delivery.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from math import inf

from gr_ros2.link import Delivered, SentPacket
from gr_ros2.link.airtime import LEAD_S
from gr_ros2.settings.registry import Registry
from gr_ros2_lab.race.contenders import Contender
from gr_ros2_lab.race.links import LinkLog, LinkReport
from gr_ros2_lab.race.measure import Observed, RaceSender, RaceStream
from gr_ros2_lab.race.race_settings import DRAIN_S, MATCH_S, PHY_NAME, Condition, RaceSettings
from gr_ros2_lab.run.load import make_phy
from gr_ros2_lab.run.scenario import Scenario, scenario_from
from gr_ros2_lab.run.simulate import Offered, Simulation

HOST_S = LEAD_S + 0.002
"""s that are added to each delivery: a link composes a packet so long before its slot; and what two hops over DDS and
Python add to the airtime in the race of two robots (``race --peers gr-ros2 --loss 0``: 3.7 ms in the median, 1.7 ms of
airtime; 8.1 ms and 6.7 ms at a load of 200 %).
"""
_TOPIC = "race"
_QUIET_S = 3.0
"""s. When no message has arrived for this time, no more are expected."""


def run_slots(
    settings: RaceSettings, senders: Sequence[RaceSender], condition: Condition, contender: Contender
) -> Observed:
    """Run a cell of a contender that is gr-ros2.

    :raises ConfigError: for a ``packet_len`` that carries nothing
    """
    start = _Run(settings, senders, condition, contender)
    met = start.play(0.0, until_all_heard=True)
    begin = min(met, MATCH_S)
    run = _Run(settings, senders, condition, contender)
    run.play(begin)
    t_sent = [sender.sent(begin + sender.recording.phase_s) for sender in senders]
    streams = [
        RaceStream(senders[origin].identity, t_sent[origin], heard) for (origin, _), heard in sorted(run.heard.items())
    ]
    busy = os.getloadavg()[0] / (os.cpu_count() or 1)
    return Observed(0.0, met < inf, streams, LinkReport(run.log, LinkLog(), run.drops), busy)


class _Run:
    """One run of all robots.

    :ivar heard: what arrived, by sender and receiver
    :ivar log: the packets sent until the last message was offered or delivered; later ones carry none of the recordings
    :ivar drops: packets that were not received, by reason, each receiver counted
    """

    def __init__(
        self, settings: RaceSettings, senders: Sequence[RaceSender], condition: Condition, contender: Contender
    ) -> None:
        self._settings, self._senders = settings, senders
        self._condition, self._contender = condition, contender
        robots = range(len(senders))
        self.heard: dict[tuple[int, int], list[tuple[float, bytes]]] = {
            (origin, receiver): [] for receiver in robots for origin in robots if origin != receiver
        }
        self.log = LinkLog()
        self.drops: dict[str, int] = {}

    def play(self, begin: float, *, until_all_heard: bool = False) -> float:
        """Run to the end.

        :param begin: of the recordings, s after the robots have begun to send
        :param until_all_heard: end as soon as all robots have a message of all others
        :return: when that was, s; infinite if it was not
        """
        offered = [self._offered(sender, begin) for sender in self._senders]
        last = max(messages[-1].t for messages in offered)
        scenario = self._scenario(MATCH_S if until_all_heard else last)
        registry = Registry.from_rows([(_TOPIC, self._senders[0].recording.type_name)])
        phy = make_phy(scenario, registry)
        run = Simulation(scenario, registry, phy, messages=[iter(messages) for messages in offered], ideal=True)
        places = {robot.src_id: robot.number for robot in run.robots}
        silent, newest, met = set(self.heard), 0.0, inf
        sent: list[tuple[float, int]] = []
        for now, robot, event in run.events():
            if isinstance(event, SentPacket):
                sent.append((now, len(event.data)))
            elif isinstance(event, Delivered):
                pair = places[event.src_id], robot.number
                self.heard[pair].append((now + HOST_S, event.payload))
                newest = now
                silent.discard(pair)
            if not silent:
                met = min(met, now)
            if met < inf and until_all_heard:
                break
            if now > max(last, newest) + _QUIET_S or now > last + DRAIN_S:
                break
        for now, size in sent:
            if now <= max(last, newest):
                self.log.note(now, size, phy.airtime(size))
        reasons = {"on_air": "packet_loss", "collision": "collision", "sending": "sending"}
        self.drops = {name: run.medium.lost.total(reason) for name, reason in reasons.items()}
        return met

    def _offered(self, sender: RaceSender, begin: float) -> list[Offered]:
        recording = sender.recording
        times = sender.sent(begin + recording.phase_s)
        return [Offered(t, 0, payload) for t, payload in zip(times, recording.payloads, strict=True)]

    def _scenario(self, duration_s: float) -> Scenario:
        queue = self._contender.settings.get("queue")
        options = {"topics": {"auto": None, _TOPIC: {"queue": queue}}} if queue else {}
        return scenario_from(
            {
                "name": "race",
                "registry": _TOPIC,  # the table itself is handed over
                "robots": len(self._senders),
                "duplex": "half",
                "medium": "slots",
                "time": "packets",
                "packet_len": self._settings.packet_len,
                "phy": {"name": PHY_NAME, "sample_rate": self._condition.sample_rate},
                "channel": {"packet_loss": self._condition.loss},
                **options,
                "duration_s": duration_s,
                "drain_s": DRAIN_S,
                "seed": self._settings.seed,
            }
        )
