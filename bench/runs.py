"""Whole experiments: real DDS on two domains, real GNU Radio, a real recording."""

from __future__ import annotations

import time
from pathlib import Path
from tempfile import TemporaryDirectory

from bench.rows import Row
from gr_ros2.middleware.bag_files import read_bag
from gr_ros2_lab.record.result import Result
from gr_ros2_lab.run.runner import DELIVERED_BAG, run_scenario
from gr_ros2_lab.run.scenario import load_scenario
from tests.recordings import DRIVES

DRIVE = DRIVES[-1]
"""The recorded drive where it is, else that of the simulator."""
DOMAINS = ["robots.0.graph.domain_id=97", "robots.1.graph.domain_id=98"]
PACED = ["packet_rate=auto", "drain_s=5", "queue_depth=100"]
"""What `paper-ofdm` needs in order not to be overdriven, beside a sample rate that carries it."""
DDS_PADDING = 3


def _run(name: str, overrides: list[str], out: Path, duration_s: float | None = None) -> Result:
    return run_scenario(load_scenario(name, [*DOMAINS, *overrides], duration_s=duration_s), out / "run").result


def _delivery(what: str, result: Result) -> list[Row]:
    """PDR over all topics, and messages that arrived altered."""
    sent = sum(topic.sent for topic in result.topics)
    delivered = sum(topic.delivered for topic in result.topics)
    lost = {
        fate: sum(topic.ledger.get(fate, 0) for topic in result.topics)
        for topic in result.topics
        for fate in topic.ledger
        if fate != "delivered"
    }
    latency = result.topics[0].latency_s.p50
    note = f"{delivered} of {sent} messages, {result.packets['sent'] / result.duration_s:,.0f} packets/s"
    note += f", p50 {latency * 1e3:.1f} ms" if latency is not None else ""
    note += "".join(f", {count} {row}" for row, count in lost.items() if count)
    altered = sum(topic.corrupt for topic in result.topics)
    return [
        Row(f"{what}: PDR", delivered / max(sent, 1), "", "=", 1.0, "{:.4f}", note),
        Row(f"{what}: altered messages", altered, "", "=", 0),
    ]


def direct() -> list[Row]:
    """The paper's direct loopback as it is."""
    with TemporaryDirectory() as folder:
        return _delivery("paper-direct", _run("paper-direct", [], Path(folder)))


def fast() -> list[Row]:
    """The same at 500 Hz for 10 s."""
    with TemporaryDirectory() as folder:
        result = _run("paper-direct", ["sim.odom_rate=500"], Path(folder), 10.0)
    return _delivery("paper-direct at 500 Hz", result)


def ofdm() -> list[Row]:
    """The paper's OFDM loopback, at a sample rate that carries 120 % of what is offered."""
    with TemporaryDirectory() as folder:
        result = _run("paper-ofdm", [*PACED, "phy.sample_rate=auto"], Path(folder), 15.0)
    return _delivery(f"OFDM at {result.phy['sample_rate']:,.0f} samples/s", result)


def recording() -> list[Row]:
    """The whole recorded drive over OFDM, as fast as the link takes it."""
    recorded = list(read_bag(DRIVE.path, DRIVE.names))
    seconds = (recorded[-1].stamp_ns - recorded[0].stamp_ns) * 1e-9
    with TemporaryDirectory() as folder:
        registry = DRIVE.write_registry(Path(folder) / "drive.csv")
        overrides = [
            f"registry={registry}",
            f"source=bag:{DRIVE.path}",
            "bag_speed=0",
            "duration_s=0",
        ]
        overrides += [*PACED, "packet_len=220", "phy.sample_rate=1e6"]
        begin = time.monotonic()
        result = _run("paper-ofdm", overrides, Path(folder))
        took = time.monotonic() - begin
        differing = 0
        for name in DRIVE.topics:
            sent = [one.payload for one in recorded if one.topic == f"/robot_1/{name}"]
            got = [one.payload for one in read_bag(Path(folder) / "run" / DELIVERED_BAG, [f"/rx_robot_1/{name}"])]
            differing += abs(len(sent) - len(got)) + sum(not _same(*pair) for pair in zip(got, sent, strict=False))
    return [
        *_delivery(f"{DRIVE.path.name}, {seconds:.0f} s, over OFDM", result),
        Row("recorded drive: messages that differ from the recording", differing, "", "=", 0),
        Row("recorded drive: speed", seconds / took, "× real time", form="{:.1f}", note=f"{took:.1f} s in all"),
    ]


def _same(got: bytes, sent: bytes) -> bool:
    rest = got[len(sent) :]
    return got.startswith(sent) and len(rest) <= DDS_PADDING and not rest.strip(b"\0")
