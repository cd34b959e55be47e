"""Two links over a medium process on one frequency, both ways at 35 Hz of odometry: slots beside `exclusive`."""

from __future__ import annotations

import threading
import time
from collections import Counter
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from bench.rows import Row
from gr_ros2.middleware import Qos
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.radio.config import link_from
from gr_ros2.radio.robot_link import RobotLink
from gr_ros2.settings.config import build
from gr_ros2.settings.files import REGISTRY_DIR
from gr_ros2_lab.medium.process import MediumConfig, MediumProcess
from gr_ros2_lab.sim.fleet import Fleet
from gr_ros2_lab.sim.sim_settings import SimSettings

RATE_HZ, SECONDS, DRAIN_S = 35.0, 20.0, 2.0
PHY = {"name": "ofdm", "sample_rate": 300_000}
PACKET_LEN = 96
ODOMETRY = "nav_msgs/msg/Odometry"


def shared() -> list[Row]:
    """PDR of each way; the messages keep the time of the medium, which waits for this computer."""
    rows = []
    for medium in ("slots", "exclusive"):
        (there, back), counted = _run(medium)
        share = counted["overlapping"] / max(1, counted["bursts"])
        note = f"the other way {back:.3f}; {100 * share:.0f} % of {counted['bursts']} bursts overlapped"
        what = f"two links on one frequency, {RATE_HZ:g} Hz odometry, {medium}: PDR of the worse way"
        rows.append(Row(what, there, "", "≥" if medium == "slots" else None, 0.99, "{:.3f}", note))
    return rows


def _run(medium: str) -> tuple[tuple[float, float], Counter[str]]:
    with TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        ends = [{"connect": f"ipc://{folder}/robot{n}", "bind": f"ipc://{folder}/medium{n}"} for n in (1, 2)]
        values = {"phy": PHY, "packet_len": PACKET_LEN, "robots": ends, "channel": {"snr_db": 20.0}}
        process = MediumProcess(build(MediumConfig, values))
        stack.callback(process.close)
        over = threading.Event()
        thread = threading.Thread(target=process.run, kwargs={"over": over})
        thread.start()
        stack.callback(thread.join)
        stack.callback(over.set)
        heard: Counter[int] = Counter()
        publishers: dict[str, Any] = {}
        links = []
        for number, addresses in enumerate(ends, 1):
            graph = stack.enter_context(MemoryMiddleware(domain_id=number))
            publishers[f"/robot_{number}/odom"] = graph.advertise(f"/robot_{number}/odom", ODOMETRY, Qos())
            graph.subscribe(f"/rx_robot_{3 - number}/odom", ODOMETRY, Qos(depth=0), partial(_count, heard, 3 - number))
            links.append(RobotLink(_link(number, medium, addresses, folder), middleware=graph))
            stack.callback(links[-1].stop)
        for link in links:
            link.start()
        clock = links[0].front_end.clock
        sent: Counter[str] = Counter()
        begin = clock()
        fleet = Fleet(SimSettings(robots=2, odom_rate=RATE_HZ))
        for message in fleet.messages(SECONDS, topics=publishers):
            while clock() < begin + message.t:
                time.sleep(1e-3)
            publishers[message.topic].publish(message.payload)
            sent[message.topic] += 1
        while clock() < begin + SECONDS + DRAIN_S and sum(heard.values()) < sent.total():
            time.sleep(1e-2)
        shares = sorted(heard[number] / sent[f"/robot_{number}/odom"] for number in (1, 2))
        return (shares[0], shares[1]), process.counted


def _count(heard: Counter[int], number: int, _payload: bytes) -> None:
    heard[number] += 1


def _link(number: int, medium: str, addresses: dict[str, str], folder: Path) -> Any:
    end = {"middleware": "memory", "domain_id": number}
    values = {
        "registry": str(REGISTRY_DIR / "odom.csv"),
        "packet_len": PACKET_LEN,
        "phy": PHY,
        "medium": medium,
        "state": str(folder / f"{number}.json"),
        "front_end": {
            "name": "zmq",
            "bind": addresses["connect"],
            "connect": [addresses["bind"]],
            "medium_process": "lockstep",
        },
        "robot": f"/robot_{number}",
        "graph": end,
    }
    return link_from(values)
