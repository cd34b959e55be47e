"""A medium process: what several links with front end ``zmq`` make of one simulated channel (`gr-ros2 medium`).

It subscribes to what each robot sends, and publishes to each robot what it receives: the sum of all bursts that reach
it, with their gains, and noise, by :class:`gr_ros2_lab.medium.samples.SampleMedium`. All robots of a configuration use
one channel: bursts that overlap at a receiver disturb each other, and a robot hears nothing while it sends. A run may
give each that sends a channel of its own.

*Lock step* (``time: lockstep``): the process tells every robot the time in steps of ``STEP_S``, and goes on when all of
them have answered that they have sent what begins before. Links take it as their clock. So a machine that is too slow,
or a robot that stands still for a moment, delays everybody and changes nothing. The time never goes faster than real
time. A robot that has not answered for ``GONE_S`` is not waited for until it answers again, whatever else it sends.

*Real time* (``time: real``): a burst begins when it arrives here, and nobody waits for anybody.

Invariants: what a robot sends is refused unless it is a burst at the medium's sample rate; no burst begins in what was
already handed over; a process that is killed and started again continues with the links that are there.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from math import inf, isfinite, nan
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import zmq
from numpy.typing import NDArray
from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from gr_ros2.core.errors import ConfigError
from gr_ros2.core.watch import Watch
from gr_ros2.phy import PHY, configured
from gr_ros2.radio.zmq import HEADER, MAGIC, SAMPLE, WAITING, Address, OwnAddress, open_socket, prepare
from gr_ros2.settings.config import (
    LEVELS,
    STRICT,
    PacketLen,
    PhyConfig,
    Reach,
    Seeded,
    Text,
    Transceiver,
    build,
)
from gr_ros2.settings.effect import refuse_without_effect
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.files import read_settings
from gr_ros2.wire import BROADCAST
from gr_ros2_lab.medium.base import FixedPaths, Surroundings, Transmission
from gr_ros2_lab.medium.gains import all_paths, at_gains
from gr_ros2_lab.medium.measured import measured_channel
from gr_ros2_lab.medium.positions import Motion, Positions
from gr_ros2_lab.medium.samples import SampleMedium

STEP_S = 0.002
"""s of one step. A link in lock step begins its packets at full steps."""
GONE_S = 1.0
"""s without an answer after which a robot is not waited for."""
_AGAIN_S = 0.05
"""s after which the time is told again to robots that have not answered: they may just have connected."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, config=STRICT)
class MediumRobot(Transceiver):
    """A robot whose link uses the medium."""

    connect: Address
    """address at which the link publishes: ``bind`` of its front end"""
    bind: OwnAddress
    """address at which the link hears: ``connect`` of its front end"""
    position: tuple[float, float] | None = None
    """where it is, x and y in m; needed where levels follow from positions or a survey"""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class MediumConfig(Reach, Seeded):
    """A medium process and its robots."""

    name: Text = "medium"
    """what errors and the first line call it"""
    phy: PhyConfig
    """physical layer and sample rate, those of the links"""
    packet_len: PacketLen = 64
    """bytes, that of the links"""
    robots: Annotated[tuple[MediumRobot, ...], Field(min_length=2, max_length=BROADCAST)]
    """those that share the channel"""
    time: Literal["lockstep", "real"] = "lockstep"
    """lockstep = links take the medium's clock, and it waits for them; real = nobody waits"""
    conditions: ClassVar[Any] = LEVELS

    @model_validator(mode="after")
    def _fits(self) -> MediumConfig:
        placed = [robot.position is not None for robot in self.robots]
        if self.phy.name not in PHY:
            raise ValueError(f"phy.name = {self.phy.name!r}: no such phy; known are {', '.join(PHY)}")
        if self.phy.sample_rate == AUTO:
            raise ValueError("phy.sample_rate = auto: a medium needs one, the same as the links")
        told = self.channel.from_positions or bool(self.channel.trace)
        if (self.channel.from_positions and not all(placed)) or (any(placed) and not (all(placed) and told)):
            raise ValueError("robots: position is for all robots together with channel.from: positions, or a survey")
        self.check_levels(len(self.robots))
        if self.channel.loses_packets:
            raise ValueError("channel: a medium of samples loses no whole packets; leave these settings out")
        addresses = [address for robot in self.robots for address in (robot.connect, robot.bind)]
        for address, times in Counter(addresses).items():
            if times > 1:
                raise ValueError(f"robots: address {address} stands there twice")
        refuse_without_effect(self)
        return self

    def around(self) -> Surroundings:
        """Who hears whom, and how well."""
        assert self.phy.sample_rate != AUTO
        levels, bandwidth = [self.channel.levels(robot) for robot in self.robots], float(self.phy.sample_rate)
        paths = all_paths(self.channel, len(self.robots), leveled=self.gains_db is not None)
        paths = at_gains(paths, self.gains_db, levels, bandwidth)
        if (measured := measured_channel(self.channel, paths, lambda _: self._stand(), samples=True)) is not None:
            return measured
        if not self.channel.from_positions:
            return FixedPaths(paths)
        powers, figures = zip(*levels, strict=True)
        return Positions(self.channel, self._stand(), bandwidth, powers, figures, paths=paths)

    def _stand(self) -> Motion:
        places = [robot.position for robot in self.robots]
        if None in places:
            raise ConfigError("robots: the trace is a survey, so each needs its position")
        there = np.array(places, float)
        return lambda _: (there, np.zeros_like(there))


def load_medium(path: str | Path, overrides: Sequence[str] = ()) -> MediumConfig:
    """Read the YAML file of a medium process.

    :param overrides: `key=value` with dotted keys and YAML values, in this order
    :raises ConfigError: when there is no such file, or a setting is wrong
    """
    if not Path(path).is_file():
        raise ConfigError(f"medium {str(path)!r}: no such file")
    return build(MediumConfig, read_settings(Path(path), overrides), str(path))


class _Link:
    """The two sockets to one robot's link.

    :ivar answered: newest time that it has answered, s; -inf before the first
    :ivar waited_for: whether it answers, so that the time waits for it
    :ivar gone_at: when it was last given up, s of the medium
    :ivar heard: s, monotonic, when something of it came last
    :ivar sends: whether a burst has come since its last answer, or since it was given up
    :ivar unanswered: for how long that has been so
    """

    def __init__(self, context: Any, robot: MediumRobot, samples: int, stack: ExitStack) -> None:
        addresses = (robot.bind, robot.connect)
        self.publisher, self.subscriber = (stack.enter_context(context.socket(kind)) for kind in (zmq.PUB, zmq.SUB))
        for socket in (self.publisher, self.subscriber):
            prepare(socket, WAITING, samples, addresses)
        open_socket(self.publisher.bind, "bind", robot.bind, "medium")
        self.subscriber.subscribe(b"")
        open_socket(self.subscriber.connect, "connect", robot.connect, "medium")
        self.answered = self.gone_at = self.heard = -inf
        self.waited_for = self.sends = False
        self.unanswered = Watch(_AGAIN_S)
        self.number = 0


class MediumProcess:
    """Receives bursts of links, and publishes to each what it hears.

    :param clock: s, monotonic
    :param around: who hears whom; None: as the configuration says
    :param shared: whether all robots use one channel
    :raises ConfigError: for a PHY whose bursts cannot be summed here
    :raises RadioError: when an address cannot be used
    :ivar counted: ``bursts``: from the robots; ``overlapping``: those that began while another robot sent;
        ``malformed``, ``wrong_rate``: refused messages; ``waited``: steps for which a robot was waited for in vain;
        ``unanswered``: times ``GONE_S`` in which a robot sent and did not answer the time
    :ivar medium: says what reaches whom
    :ivar lost_s: s by which its clock is behind real time, in lock step: robots or this process were late
    """

    def __init__(
        self,
        config: MediumConfig,
        clock: Callable[[], float] = time.monotonic,
        around: Surroundings | None = None,
        *,
        shared: bool = True,
    ) -> None:
        self.config, self._clock = config, clock
        assert config.phy.sample_rate != AUTO
        phy = configured(config.phy, config.packet_len, config.phy.sample_rate)
        if shared and phy.burst_modem is None:
            raise ConfigError(
                f"phy {phy.name}: a medium process needs one of this package's modems: ofdm, psk, gfsk, lora"
            )
        self.counted: Counter[str] = Counter()
        self._said: set[tuple[str, int]] = set()
        self._rate = phy.sample_rate
        self._longest = phy.airtime_samples()
        self.medium = SampleMedium(
            around or config.around(), [phy] * len(config.robots), shared=shared, seed=config.seed
        )
        self._id = int.from_bytes(os.urandom(4), "little")
        self._now = self._handed = 0.0
        self.lost_s = 0.0
        self._began = clock()
        self._busy = [0.0] * len(config.robots)
        """s until which each robot sends."""
        self._stack = ExitStack()
        try:
            context = self._stack.enter_context(zmq.Context())
            self._links = [_Link(context, robot, self._longest, self._stack) for robot in config.robots]
            self._poller = zmq.Poller()
            for link in self._links:
                self._poller.register(link.subscriber, zmq.POLLIN)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close all sockets. Idempotent."""
        self._stack.close()

    @property
    def now(self) -> float:
        """s on its clock."""
        return self._now

    @property
    def robots(self) -> int:
        """Number of robots that are there."""
        now = self._clock()
        return sum(now - link.heard < GONE_S for link in self._links)

    def run(self, duration_s: float = inf, over: threading.Event | None = None) -> None:
        """Carry bursts for so many s, or until ``over`` is set."""
        self._began = begin = self._clock()
        while self._clock() - begin < duration_s and not (over is not None and over.is_set()):
            if self.config.time == "real":
                self._take(STEP_S)
                self._now = self._clock() - begin
            else:
                self._step()
            self._hand_over()

    def _step(self) -> None:
        """Tell the time of the next step, and wait until all have answered."""
        self._now += STEP_S
        told, patience = -inf, Watch(_AGAIN_S)
        waiting = [link for link in self._links if link.waited_for]
        while True:
            now = self._clock()
            if now - told >= _AGAIN_S:
                told = now
                for link in self._links:
                    if link.answered < self._now:
                        self._send(link, self._now, b"")
            late = any(link.answered < self._now for link in waiting) and patience.age(inf, now) < GONE_S
            left = self._began + self._now - now
            if not late and left <= 0:
                break
            self._take(min(max(left, 0.0), _AGAIN_S) if not late else _AGAIN_S)
        for link in waiting:
            if link.answered < self._now:
                self.counted["waited"] += 1
                link.waited_for, link.sends, link.gone_at = False, False, self._now
        for number, link in enumerate(self._links):
            if link.unanswered.still_s(link.sends or None, now) >= GONE_S:
                link.sends = False
                self._refuse(
                    "unanswered",
                    number,
                    "it sends and does not answer the time, so nobody waits for it; set medium_process: lockstep at "
                    "its front end",
                )
        lost_s = max(0.0, -left - STEP_S)  # it is not made up for
        self._began += lost_s
        self.lost_s += lost_s

    def _take(self, timeout_s: float) -> None:
        """Take what robots send, until something has come or the time is over."""
        for socket, _ in self._poller.poll(max(1, round(timeout_s * 1e3)) if timeout_s else 0):
            number = next(n for n, link in enumerate(self._links) if link.subscriber is socket)
            while True:
                try:
                    message = socket.recv(zmq.NOBLOCK)
                except zmq.Again:
                    break
                self._arrived(number, message)

    def _arrived(self, number: int, message: bytes) -> None:
        size = len(message) - HEADER.size
        if size < 0 or size % SAMPLE.itemsize or message[: len(MAGIC)] != MAGIC:
            self._refuse("malformed", number, f"a message of {len(message)} bytes is no burst of samples")
            return
        _, _, _, rate, at = HEADER.unpack_from(message)
        if rate != self._rate:
            self._refuse("wrong_rate", number, f"it sends {rate:g} samples/s, not {self._rate:g}")
            return
        link = self._links[number]
        link.heard = self._clock()
        if size:
            samples = np.frombuffer(message, SAMPLE, offset=HEADER.size).astype(np.complex64, copy=False)
            self._burst(number, samples, at)
        elif isfinite(at):
            link.answered, link.sends = min(at, self._now), False
            link.waited_for |= link.answered >= link.gone_at

    def _burst(self, number: int, samples: NDArray[np.complex64], at: float) -> None:
        if not isfinite(np.vdot(samples, samples).real):  # also where a receiver's gain would make it infinite
            self._refuse("malformed", number, "a burst's energy is no finite number")
            return
        self._links[number].sends = self.config.time == "lockstep"
        earliest = self._now if self.config.time == "real" else self._handed
        told = at if isfinite(at) and at < self._now + GONE_S else self._now  # what the robot knew as it sent
        start = max(told, earliest, self._busy[number])  # a robot sends one burst after the other
        end = start + len(samples) / self._rate
        self.counted["bursts"] += 1
        self.counted["overlapping"] += any(until > start for n, until in enumerate(self._busy) if n != number)
        self._busy[number] = max(self._busy[number], end)
        self.medium.transmit(Transmission(number, self.counted["bursts"], b"", start, end), samples)

    def _hand_over(self) -> None:
        """Give every robot what has reached it."""
        for number, link in enumerate(self._links):
            for start, samples in self.medium.received(number, self._now):
                for first in range(0, len(samples), self._longest):
                    part = samples[first : first + self._longest]
                    at = nan if self.config.time == "real" else start + first / self._rate
                    self._send(link, at, part.astype(SAMPLE, copy=False).tobytes())
                    link.number += 1
        self._handed = self._now

    def _send(self, link: _Link, at: float, samples: bytes) -> None:
        link.publisher.send(HEADER.pack(MAGIC, self._id, link.number, self._rate, at) + samples, zmq.NOBLOCK)

    def _refuse(self, name: str, number: int, problem: str) -> None:
        self.counted[name] += 1
        if (name, number) not in self._said:
            self._said.add((name, number))
            _log.warning("medium: robot %d: %s", number + 1, problem)
