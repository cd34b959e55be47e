"""What comes out with some settings: samples, levels, topics on a graph, files and pages.

Invariant: equal settings give equal outcomes, so that two that differ tell of the settings.
"""

from __future__ import annotations

import functools
import json
import random
import re
import socket
import sys
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType, SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
from click.testing import CliRunner
from gnuradio import blocks, gr

from gr_ros2.gr import RosLink
from gr_ros2.gr.factory import Start, make_endpoint, start_of
from gr_ros2.link.air import Air
from gr_ros2.middleware import Qos
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.phy import PHY
from gr_ros2.phy.channel import Channel
from gr_ros2.phy.measure import SampleRecording, deliver, modulated, record
from gr_ros2.phy.threads import run_flowgraph
from gr_ros2.radio import FRONT_ENDS
from gr_ros2.radio.config import link_from
from gr_ros2.radio.robot_link import RobotLink
from gr_ros2.settings.config import ChannelConfig, build
from gr_ros2.settings.registry import Registry
from gr_ros2.settings.robot import RobotConfig, robot_from
from gr_ros2_lab.cli.run import run
from gr_ros2_lab.race.contenders import CONTENDERS
from gr_ros2_lab.race.measure import Identity, RaceSender
from gr_ros2_lab.race.race_settings import RaceSettings, beside, conditions, read_recordings
from gr_ros2_lab.race.slots import run_slots
from gr_ros2_lab.run.robots import surroundings
from gr_ros2_lab.run.scenario import load_scenario
from gr_ros2_lab.sim.fleet import Fleet
from gr_ros2_lab.sim.sim_settings import SimSettings
from gr_ros2_lab.study.sweep.figures import curves_figure, heat_figure
from gr_ros2_lab.study.sweep.summaries import rows_of, summaries
from tests.domains import free_domains, free_ports
from tests.gr.probe import Probe
from tests.lab.study.sweeps import plan
from tests.lab.study.test_sweep_summaries import IMU, ODOM, results, topic
from tests.waiting import wait_for

PACKETS = [random.Random(length).randbytes(length) for length in (64, 20, 64)]


@functools.cache
def sent(phy: str, **options: Any) -> bytes:
    """The samples of three packets."""
    made = PHY.load(phy)(64, 1e6, **options)
    fixed = [packet.ljust(64) for packet in PACKETS] if not made.any_length else PACKETS
    return modulated(made, fixed).samples.tobytes()


@functools.cache
def rates(phy: str, **options: Any) -> list[str]:
    """What an adaptive rate may choose from."""
    return [mcs.name for mcs in PHY.load(phy)(64, 1e6, **options).mcs_table]


def heard(phy: str, **options: Any) -> list[bytes]:
    """The packets that a receiver finds in noise."""
    made = PHY.load(phy)(64, 1e6, **options)
    return deliver(made, record(made, 10), ChannelConfig(snr_db=5.0, seed=1))


def lasting(phy: str, **options: Any) -> float:
    """s that a packet is on the air."""
    return PHY.load(phy)(64, 1e6, **options).airtime()


def wifi(**options: Any) -> tuple[Any, ...]:
    """What Wi-Fi without its module asks of it, and how long a packet lasts."""
    said: list[Any] = []

    def told(*values: Any) -> Any:
        said.append(values)
        raise StopIteration

    with mock.patch.dict(sys.modules, {"ieee802_11": SimpleNamespace(sync_short=told)}):
        phy = PHY.load("wifi")(64, 1e7, **options)
        with suppress(StopIteration):
            phy.receiver()
        return said, phy.airtime(), phy.airtime(20)


@functools.cache
def _recorded() -> SampleRecording:
    return record(PHY.load("psk")(64, 1e6), 3)


def impaired(**channel: Any) -> bytes:
    """Samples after a channel."""
    phy, top, sink = PHY.load("psk")(64, 1e6), gr.top_block(), blocks.vector_sink_c()
    top.connect(blocks.vector_source_c(_recorded().samples), Channel(ChannelConfig(**channel), phy), sink)
    run_flowgraph(top)
    return np.array(sink.data(), np.complex64).tobytes()


@functools.cache
def levels(*settings: str) -> list[Any]:
    """SNR at which four robots hear the first, at some times."""
    words = ["robots=4", "gains_db=null", *(f"channel.{setting}" for setting in settings)]
    around = surroundings(load_scenario("two-robots-half-duplex", words), 1e6)
    return [str(around.hearers(0, now)) for now in (0.0, 2.0, 4.0, 8.0)]


def reached(*settings: str) -> list[Any]:
    """At which SNR two robots on one channel hear each other."""
    around = surroundings(load_scenario("two-robots-half-duplex", settings), 1e6)
    return [str(around.hearers(number, 0.0)) for number in range(2)]


def published(**settings: Any) -> tuple[Any, ...]:
    """Topics, QoS and a message that a robot publishes."""
    rows = Registry.from_rows({"odom": "nav_msgs/Odometry"})
    end = make_endpoint(RobotConfig(robot=1, packet_len=1500), rows, air=Air(hears=False), start=Start())
    (message,) = (m.payload for m in Fleet(SimSettings(odom_rate=1.0)).messages(0.9, 0.0, ["/robot_1/odom"]))
    end.messages.submit(0, message, 0.0)
    packets = []
    while (packet := end.next_packet(0.0)) is not None:
        packets.append(packet.data)
    graph, other = (MemoryMiddleware(domain_id=domain) for domain in (GRAPH, GRAPH + 1))
    values = {"robot": 2, "direction": "receive", "graph_domain_id": GRAPH, "packet_len": 1500, **settings}
    link = RosLink(robot_from(graph_middleware="memory", **values), start=Start())
    sink = link.sink
    probe, top, came = Probe(), gr.top_block(), list[bytes]()
    top.msg_connect((probe, "pdus"), (sink, "pdus"))
    top.start()
    try:
        for data in packets:
            probe.post(data)
        wait_for(lambda: any(topic["delivered"] for topic in sink.stats()["topics"].values()), "the message")
        found = [(one.topic, str(one)) for one in graph.discover()]
        for name, _ in found:
            graph.subscribe(name, "nav_msgs/msg/Odometry", Qos(), came.append)
        for data in packets and _again(end, message):
            probe.post(data)
        wait_for(lambda: came or not found, "the message on the graph")
        return found, came[:1], [str(one) for one in other.discover()]
    finally:
        top.stop()
        top.wait()
        for one in (link, graph, other):
            one.close()


def _again(end: Any, message: bytes) -> list[bytes]:
    end.messages.submit(0, message, 1.0)
    made = []
    while (packet := end.next_packet(1.0)) is not None:
        made.append(packet.data)
    return made


GRAPH = free_domains(2)[0]


def kept(**settings: Any) -> list[str]:
    """Files that the start of a robot leaves, ``{}`` in a setting for the folder."""
    with TemporaryDirectory() as folder, mock.patch.dict("os.environ", {"XDG_STATE_HOME": folder}):
        own = {name: value.format(folder) for name, value in settings.items()}
        start_of(RobotConfig(robot=1, **own)).close()
        return sorted(path.name for path in Path(folder).rglob("*.json"))


def drawn(**changes: Any) -> list[Any]:
    """What a sweep would run, and what its figures and their captions show of made-up results."""
    with TemporaryDirectory() as folder:
        made = plan(Path(folder), **changes)
    told = results(made, topic(ODOM, 10, 5, 0.1), topic(IMU, 10, 7, 0.4))
    found = summaries(made, rows_of(made, told))
    shown = []
    for figure in (curves_figure(made, found), heat_figure(made, found)):
        for axes in figure[0].axes if figure is not None else ():
            data = [line.get_xydata().tolist() for line in axes.lines]
            shown.append((axes.get_title(), axes.get_xlabel(), axes.get_ylabel(), data))
    return [[str(cell.runs) for cell in made.cells], shown]


@functools.cache
def prepared(**changes: Any) -> list[Any]:
    """What is carried in a race, and under which conditions."""
    settings = build(RaceSettings, {"duration_s": 0.2, **changes})
    with TemporaryDirectory() as folder:
        recordings = read_recordings(settings, Path(folder))
        others = beside(settings, Path(folder), "gr-ros2")
    return [conditions(settings, recordings), [(one.topic, one.due, one.payloads) for one in [*recordings, *others]]]


@functools.cache
def raced(**changes: Any) -> list[Any]:
    """What robots in slots hear of each other in a race at its first load and loss."""
    values = {"robots": 2, "duration_s": 0.2, "loss": (0.05,), "load": (4.0,), **changes}
    settings = build(RaceSettings, values)
    with TemporaryDirectory() as folder:
        recordings = read_recordings(settings, Path(folder))
    senders = [RaceSender(recording, Identity(recording)) for recording in recordings]
    seen = run_slots(settings, senders, conditions(settings, recordings)[0], CONTENDERS["gr-ros2"])
    return [seen.matched, [(str(stream.t_sent), str(stream.heard)) for stream in seen.streams]]


def guarded(front_end: str, options: Mapping[str, Any]) -> float:
    """s that a packet takes of the time of a front end."""
    kind = FRONT_ENDS.load(front_end)
    phy = PHY.load("modem")(64) if kind.carries_packets else PHY.load("psk")(64, 1e6)
    return kind.airtime_with(phy, kind.Options(**options), 64)


def linked(front_end: str = "udp", *, options: Mapping[str, Any] = MappingProxyType({}), **changes: Any) -> Any:
    """What a link is called, whether it sends, relays, has slots, and hears nothing while it sends.

    :param options: of the front end
    """
    with ExitStack() as stack:
        server = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        folder = stack.enter_context(TemporaryDirectory())
        own: Any = {"device": f"tcp://127.0.0.1:{server.getsockname()[1]}"}
        if front_end == "udp":
            own = {"listen": str(*free_ports(1)), "send_to": ["127.0.0.1:9"]}
        values = {
            "phy": {"name": "modem"},
            "front_end": {"name": front_end, **own, **options},
            "transmit": True,
            "open": True,
            "state": f"{folder}/state",
            "robot": 1,
            "graph": {"middleware": "memory"},
            **changes,
        }
        link = RobotLink(link_from(values))
        stack.callback(link.stop)
        told, settings = link.stats(), link.end.endpoint.settings  # type: ignore[attr-defined]
        return told["name"], told["airtime"]["transmits"], settings.relay, settings.shares, settings.half_duplex


@functools.cache
def printed(*settings: str) -> str:
    """What `gr-ros2 run` says of a run in simulated time, but for numbers and places."""
    with TemporaryDirectory() as folder:
        words = [f"--set={setting}" for setting in ("time=packets", "duration_s=0.2", *settings)]
        output = CliRunner().invoke(run, ["paper-direct", "--out", folder, *words]).output
        return re.sub(r"[\d.]+", "", output.replace(folder, ""))


def replayed(**options: Any) -> tuple[Any, ...]:
    """Files that front end `file` leaves, and how many samples of a recording it gives in a short time."""
    phy = PHY.load("psk")(64, 1e6)
    with TemporaryDirectory() as folder:
        kind = FRONT_ENDS.load("file")
        _recorded().samples.tofile(f"{folder}/heard.sigmf-data")
        about = {"core:datatype": "cf32_le", "core:sample_rate": 1e6, "core:version": "1.0.0"}
        meta = {"global": about, "captures": [{"core:sample_start": 0}], "annotations": []}
        Path(f"{folder}/heard.sigmf-meta").write_text(json.dumps(meta))
        own = {name: value.format(folder) if isinstance(value, str) else value for name, value in options.items()}
        front_end = kind(phy, **own)
        given, clock = 0, iter(np.arange(0.0, 1.0, 1e-4))
        time = SimpleNamespace(monotonic=lambda: float(next(clock)), sleep=lambda _: None)
        with mock.patch("gr_ros2.radio.file.time", time):
            for _ in range(20):
                if front_end.source is None or (count := front_end.source.work([], [np.zeros(500, np.complex64)])) < 0:
                    break
                given += count
        front_end.close()
        return sorted(path.name for path in Path(folder).iterdir()), given
