"""A medium in real time that passes packets on as they are: for PHYs without samples, on the wall clock.

Invariant: a packet leaves when its airtime is over, its path has delayed it and all robots have started, in this order,
never earlier.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from math import inf
from typing import Any

from gnuradio import gr

from gr_ros2.link.events import AirPacket
from gr_ros2.phy import Phy
from gr_ros2.phy.pdus import PduPort, packets_of, take_messages
from gr_ros2.phy.threads import KeepsThreadState
from gr_ros2.radio.front_end import FrontEnd
from gr_ros2_lab.medium import Surroundings, make_medium
from gr_ros2_lab.run.live_media import LiveMedium
from gr_ros2_lab.run.scenario import Scenario


class PassedOn(LiveMedium):
    """Passes packets on in real time, each when its airtime and the delay of its path are over."""

    def __init__(self, scenario: Scenario, phy: Phy, around: Surroundings, stack: ExitStack) -> None:
        self.medium = make_medium(around, [phy] * around.robots, samples=False, seed=scenario.seed)
        self._ports: dict[int, _Port] = {}
        self._changed = threading.Condition()
        self._over = False
        self._thread = threading.Thread(target=self._delayed, name="gr-ros2-medium", daemon=True)
        stack.callback(self.stop)

    def front_end(self, number: int) -> Callable[..., FrontEnd]:
        self._ports[number] = _Port(partial(self._take, number))
        return partial(PortFrontEnd, self._ports[number])

    def start(self, robots: int) -> None:  # noqa: ARG002 - nobody has to answer
        self._thread.start()

    @property
    def now(self) -> float:
        return time.monotonic()

    def stop(self) -> None:
        with self._changed:
            self._over = True
            self._changed.notify_all()
        if self._thread.ident is not None:
            self._thread.join()

    def _take(self, number: int, packets: Sequence[AirPacket]) -> None:
        with self._changed:
            for packet in packets:
                self.medium.send(number, packet.data, self.now, 0.0)
            self._pass_on()
            if self.medium.next_due < inf:
                self._changed.notify_all()

    def _pass_on(self) -> None:
        if self._thread.ident is None:
            return  # robots that have not started yet would get nothing
        given: dict[int, list[AirPacket]] = {}
        for reception in self.medium.receptions(self.now):
            given.setdefault(reception.receiver, []).append(reception.packet)
        for receiver, packets in given.items():
            self._ports[receiver].give(packets)

    def _delayed(self) -> None:
        """Pass on those packets that come later."""
        with self._changed:
            while not self._over:
                self._pass_on()
                due = self.medium.next_due
                self._changed.wait(None if due == inf else max(0.0, due - self.now))


class _Port(KeepsThreadState, gr.basic_block):  # type: ignore[misc]
    """Message ports `pdus` in and out: packets to and from a medium.

    :param take: is given all packets that are sent
    """

    def __init__(self, take: Callable[[Sequence[AirPacket]], None]) -> None:
        super().__init__("gr_ros2_packet_medium", None, None)
        self.take = take
        self._port = PduPort(self)
        take_messages(self, "pdus", "_arrive", called="take")

    def start(self) -> bool:
        self._port.find_readers()
        return super().start()

    def give(self, packets: Sequence[AirPacket]) -> None:
        """Packets have been received."""
        self._port.send(packets)

    def _arrive(self, message: Any) -> None:
        self.take(packets_of(message)[0])


class PortFrontEnd(FrontEnd):
    """Hands packets to a medium of this process, and takes packets from it.

    :param port: through which they go
    """

    name = "run"
    any_length = True
    sink = source = None

    def __init__(self, port: _Port, phy: Phy, **options: Any) -> None:
        super().__init__(phy, **options)
        self._port = port

    @classmethod
    def carries(cls, phy: type[Phy]) -> bool:
        return not phy.has_samples

    @property
    def packets(self) -> Any:
        return self._port
