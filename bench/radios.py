"""Two radios under one endpoint: what two like ones carry beside one, what is late or lost when one falls silent, and
what a topic bound to a slow one costs the others.

Both robots run in this process. Their radios are modems of 100 kbit/s, the slow one of 10 kbit/s, whose datagrams pass
wires of this module that can be cut: then nothing comes through, and nobody is told.
"""

from __future__ import annotations

import random
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import pairwise, product
from pathlib import Path
from statistics import mean, median
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from bench.live import DOMAINS
from bench.rows import Row
from gr_ros2.middleware import Qos
from gr_ros2.middleware.base import Reliability
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.radio.config import link_from
from gr_ros2.radio.robot_link import RobotLink
from tests.domains import free_ports

REPEATS, MEASURED_S = 3, 8.0
FAST, SLOW = 100_000, 10_000
LIKE = {"left": FAST, "right": FAST}
UNLIKE = {"left": FAST, "right": SLOW}
COMMANDS_HZ, ODOM_HZ = 20.0, 20.0
LENGTHS = {0: 2000, 80: 150, 120: 150}
"""Bytes of a message on the slow radio, by the step of 160 in which it is said: of eleven packets and of one."""
_TWIST, _BYTES = "geometry_msgs/msg/Twist", "std_msgs/msg/String"
_CDR = bytes((0, 1, 0, 0))


def radios() -> list[Row]:
    """Throughput of two radios over that of one, and pauses and losses when one of two is cut."""
    pauses = [_pause() for _ in range(REPEATS)]
    ratios: dict[Reliability, list[float]] = {"reliable": [], "best_effort": []}
    for reliability, found in ratios.items():
        for _ in range(REPEATS):
            one, two = _throughput({"left": FAST}, reliability), _throughput(LIKE, reliability)
            found.append(two / one)
    bound = [_bound() for _ in range(REPEATS)]
    alone = median(_age_alone() for _ in range(REPEATS))
    command, odometry, lost = (max(values) for values in zip(*pauses, strict=True))
    return [
        *(
            Row(f"two like radios: throughput over that of one, {word}", median(found), "", "≥", 1.8, "{:.2f}")
            for word, found in ratios.items()
        ),
        Row("one of two cut: longest pause of commands", command * 1e3, "ms", "≤", 200, note="one each 50 ms"),
        Row("one of two cut: longest pause of odometry", odometry * 1e3, "ms", note="one each 50 ms"),
        Row("one of two cut: reliable messages lost", lost, "", "=", 0),
        Row(
            "a topic bound to a slow radio: mean age of reliable ones on the fast one, over that without it",
            median(each.beside for each in bound) / alone,
            *("", "≤", 1.1, "{:.2f}"),
        ),
        Row(
            "the same: mean age of its own messages, of 1 and of 11 packets, over their airtime",
            median(each.over_airtime for each in bound),
            *("", "≤", 2.5, "{:.2f}"),
            note="copies take every second turn",
        ),
        Row("the same: messages lost, of either", max(each.lost for each in bound), "", "=", 0),
        Row("the same: repairs of its packets, of all", max(each.repairs for each in bound) * 100, "%", "≤", 5),
    ]


class _Bound(NamedTuple):
    """What was found of a topic bound to a slow radio.

    :param beside: mean age of reliable messages on the fast one, s
    :param over_airtime: mean age of its own messages, over the airtime of their packets
    :param lost: messages of either that did not come
    :param repairs: share of repairs of all packets that it took
    """

    beside: float
    over_airtime: float
    lost: int
    repairs: float


class _Wire:
    """Carries datagrams from one port to another until it is cut."""

    def __init__(self, there: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self.port, self.cut, self._there = self._socket.getsockname()[1], False, there
        self._over = False
        self._thread = threading.Thread(target=self._carry, daemon=True)
        self._thread.start()

    def _carry(self) -> None:
        while not self._over:
            if select.select([self._socket], [], [], 0.05)[0]:
                data = self._socket.recv(65536)
                if not self.cut:
                    self._socket.sendto(data, ("127.0.0.1", self._there))

    def close(self) -> None:
        self._over = True
        self._thread.join()
        self._socket.close()


class _Pair:
    """Robot 1, which sends, and robot 2, with what it hears and when."""

    def __init__(self, links: list[RobotLink], near: MemoryMiddleware, wires: dict[str, list[_Wire]]) -> None:
        self.links, self.near, self.wires = links, near, wires
        self.heard: dict[str, list[tuple[float, bytes]]] = {"cmd_vel": [], "odom": [], "data": [], "report": []}


def _keep(kept: list[tuple[float, bytes]], payload: bytes) -> None:
    kept.append((time.monotonic(), payload))


@contextmanager
def _pair(rates: Mapping[str, int], **values: Any) -> Iterator[_Pair]:
    names = tuple(rates)
    with TemporaryDirectory() as folder, ExitStack() as stack:
        ports = dict(zip(product((1, 2), names), free_ports(2 * len(names)), strict=True))
        wires: dict[str, list[_Wire]] = {name: [] for name in names}
        links = []
        for number in (1, 2):
            each: list[dict[str, Any]] = []
            for name in names:
                wire = _Wire(ports[3 - number, name])
                stack.callback(wire.close)
                wires[name].append(wire)
                listen, to = str(ports[number, name]), [f"127.0.0.1:{wire.port}"]
                phy = {"name": "modem", "options": {"bit_rate": rates[name]}}
                each.append({"name": name, "phy": phy, "front_end": {"name": "udp", "listen": listen, "send_to": to}})
            radio = {"radios": each} if len(each) > 1 else {"phy": each[0]["phy"], "front_end": each[0]["front_end"]}
            graph = {"middleware": "memory", "domain_id": DOMAINS[number - 1]}
            own = {"robot": f"/robot_{number}", "graph": graph, "state": str(Path(folder) / str(number))}
            links.append(RobotLink(link_from({**own, **radio, "compression": False, **values})))
        near, far = (MemoryMiddleware(domain_id=domain) for domain in DOMAINS)
        pair = _Pair(links, near, wires)
        for graph_ in (near, far):
            stack.callback(graph_.close)
        for topic, kept in pair.heard.items():
            type_name = _TWIST if topic == "cmd_vel" else _BYTES
            far.subscribe(
                f"/rx_robot_1/{topic}",
                type_name,
                Qos("reliable", "volatile", 0),
                partial(_keep, kept),
            )
        for link in links:
            stack.enter_context(link)
        yield pair


def _text(number: int, length: int) -> bytes:
    """A std_msgs/String that begins with a number; the rest nobody can compress."""
    body = b"%08d" % number + random.Random(number).randbytes(length - 9).replace(b"\0", b"\1") + b"\0"
    return _CDR + struct.pack("<I", length) + body


def _throughput(rates: Mapping[str, int], reliability: Reliability) -> float:
    """Bytes/s that robot 2 gets of a topic that always waits."""
    with _pair(rates) as pair:
        data = pair.near.advertise("/robot_1/data", _BYTES, Qos(reliability, "volatile", 50))
        number, end = 0, time.monotonic() + 3.0 + MEASURED_S
        while (now := time.monotonic()) < end:
            with pair.links[0].end.lock:
                waiting = sum(pair.links[0].end.endpoint.messages.queued().values())
            if waiting < 20:
                data.publish(_text(number, 1000))
                number += 1
            else:
                time.sleep(0.005)
        came = [payload for at, payload in pair.heard["data"] if now - MEASURED_S <= at]
        if number < 20 or len(came) < 10:
            raise SystemExit(f"bench radios: {len(came)} of {number} messages over {' and '.join(rates)}")
        return sum(map(len, came)) / MEASURED_S


def _pause() -> tuple[float, float, int]:
    """Longest pauses of commands and of odometry around the time at which one of two radios is cut, s, and how many
    reliable messages did not come at all."""
    with _pair(LIKE) as pair:
        command = pair.near.advertise("/robot_1/cmd_vel", _TWIST, Qos("reliable", "volatile", 1))
        odometry = pair.near.advertise("/robot_1/odom", _BYTES, Qos("best_effort", "volatile", 1))
        data = pair.near.advertise("/robot_1/data", _BYTES, Qos("reliable", "volatile", 0))
        _wait_for_topics(pair, command.publish, odometry.publish, data.publish)
        begin, step, cut_at = time.monotonic(), 0, 6.0
        said = set()
        while (now := time.monotonic() - begin) < cut_at + MEASURED_S:
            if now >= cut_at:
                for wire in pair.wires["left"]:
                    wire.cut = True
            command.publish(_CDR + random.Random(step).randbytes(48))
            odometry.publish(_text(step, 300))
            if step % 10 == 0:
                said.add(message := _text(step, 400))
                data.publish(message)
            step += 1
            time.sleep(max(0.0, begin + step / COMMANDS_HZ - time.monotonic()))
        patience = time.monotonic() + 30
        while (lost := said - {payload for _, payload in pair.heard["data"]}) and time.monotonic() < patience:
            time.sleep(0.05)
        longest = []
        for topic in ("cmd_vel", "odom"):
            times = [at - begin for at, _ in pair.heard[topic] if at - begin > cut_at - 1]
            if len(times) < MEASURED_S * COMMANDS_HZ / 2:
                raise SystemExit(f"bench radios: {len(times)} messages of {topic} came")
            longest.append(max(after - before for before, after in pairwise(times)))
        return longest[0], longest[1], len(lost)


def _age_alone() -> float:
    """Mean age of reliable messages on the fast radio, s, where nothing is bound to the slow one."""
    with _pair(UNLIKE, topics={"auto": {}, "-report": {}}) as pair:
        return mean(_talk(pair)[0].values())


def _bound() -> _Bound:
    """The same where a topic is bound to the slow one."""
    with _pair(UNLIKE, topics={"auto": {}, "report": {"via": "right"}}) as pair:
        ages, slow, said, repairs = _talk(pair)
        over = [slow[key] / _airtime(len(key)) for key in slow]
        return _Bound(mean(ages.values()), mean(over), said - len(ages) - len(slow), repairs)


def _airtime(length: int) -> float:
    """s that a message of so many bytes takes on the slow radio at least."""
    packets = -(-length // 200)
    return (length + packets * 20) * 8 / SLOW


def _talk(pair: _Pair) -> tuple[dict[bytes, float], dict[bytes, float], int, float]:
    """Talk on three topics, and on one that may be bound to the slow radio: ages of its messages and of those of a
    reliable topic beside it, s, how many were said, and the share of repairs on the slow radio."""
    command = pair.near.advertise("/robot_1/cmd_vel", _TWIST, Qos("reliable", "volatile", 1))
    odometry = pair.near.advertise("/robot_1/odom", _BYTES, Qos("best_effort", "volatile", 1))
    data = pair.near.advertise("/robot_1/data", _BYTES, Qos("reliable", "volatile", 0))
    report = pair.near.advertise("/robot_1/report", _BYTES, Qos("reliable", "volatile", 0))
    bound = "report" in pair.links[0].config.topics
    others = [report.publish] if bound else []
    _wait_for_topics(pair, command.publish, odometry.publish, data.publish, *others)
    begin, step = time.monotonic() + 2.0, -40
    said: dict[str, dict[bytes, float]] = {"data": {}, "report": {}}
    before = _packets(pair)
    while time.monotonic() < begin + 2 * MEASURED_S:
        now = time.monotonic()
        command.publish(_CDR + random.Random(step).randbytes(48))
        odometry.publish(_text(abs(step), 300))
        if step == 0:
            before = _packets(pair)
        if step >= 0 and step % 2 == 0:
            said["data"][message := _text(step, 400)] = now
            data.publish(message)
        if step >= 0 and step % 160 in LENGTHS:
            said["report"][message := _text(step, LENGTHS[step % 160])] = now
            report.publish(message)
        step += 1
        time.sleep(max(0.0, begin + step / COMMANDS_HZ - time.monotonic()))
    wanted = {"data": said["data"], "report": said["report"] if bound else {}}
    patience = time.monotonic() + 30
    while time.monotonic() < patience:
        came = {topic: {payload: at for at, payload in list(pair.heard[topic])} for topic in wanted}
        if all(came[topic].keys() >= wanted[topic].keys() for topic in wanted):
            break
        time.sleep(0.05)
    ages = {t: {m: came[t][m] - at for m, at in wanted[t].items() if m in came[t]} for t in wanted}
    after = _packets(pair)
    repairs = (after[1] - before[1]) / max(after[0] - before[0], 1)
    return ages["data"], ages["report"], sum(map(len, wanted.values())), repairs


def _packets(pair: _Pair) -> tuple[int, int]:
    """Packets of what is bound to the slow radio, and repairs among them."""
    bound = pair.links[0].stats()["radios"]["right"].get("bound") or {"packets": 0, "repairs": 0}
    return bound["packets"], bound["repairs"]


def _wait_for_topics(pair: _Pair, *publish: Callable[[bytes], None]) -> None:
    """Publish until the link has found every topic on the graph."""
    patience = time.monotonic() + 30
    while sum(topic["submitted"] > 0 for topic in pair.links[0].stats()["source"]["topics"].values()) < len(publish):
        if time.monotonic() > patience:
            raise SystemExit("bench radios: the link does not find its topics")
        for each in publish:
            each(_text(0, 48))
        time.sleep(0.1)
