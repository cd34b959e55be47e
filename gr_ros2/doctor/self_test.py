"""The self-test: what is installed does its work here, from samples and back, without a radio, a clock or ROS.

Invariant: every PHY that is installed is tried by its own transmitter and receiver; nothing outside
this process is used, and the same packets are sent every time.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from queue import Empty, Queue
from random import Random

from gr_ros2.core.errors import BackendMissingError, GrRos2Error
from gr_ros2.doctor.finding import Check, Finding
from gr_ros2.grc.path import example, grc_path
from gr_ros2.middleware import Qos
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.phy import PHY, Phy, configured
from gr_ros2.radio.config import load_link
from gr_ros2.settings.config import ChannelConfig, PhyConfig

PACKETS = 8
_BYTES = 64
_RATE = 1e6
_SEED = 1
_PATIENCE_S = 10.0
_REMEDY = "install gr-ros2 again; if it stays, report it with the output of `gr-ros2 doctor`"
EXAMPLES = (
    "direct_loopback.grc",
    "file_radio.grc",
    "gfsk_loopback.grc",
    "lora_loopback.grc",
    "ofdm_loopback.grc",
    "psk_loopback.grc",
    "topics.csv",
)
LINKS = ("link-sim.yaml", "link-udp.yaml", "link-zmq-1.yaml", "link-zmq-2.yaml")


def loopbacks() -> Iterator[Finding]:
    """Packets through the transmitter and receiver of each PHY, without noise."""
    for name in PHY:
        what = f"phy {name}"
        try:
            PHY.modules(name)
            phy = configured(PhyConfig(name=name), _BYTES, _RATE)
        except BackendMissingError as error:
            yield Finding(what, "note", f"not tried: {error.__cause__}", PHY[name].requires if name in PHY.own else "")
            continue
        if not phy.has_samples:
            yield Finding(what, "note", "not tried: it has no samples")
            continue
        try:
            yield _loopback(what, phy)
        except GrRos2Error as error:
            yield Finding(what, "failed", str(error), _REMEDY)


def _loopback(what: str, phy: Phy) -> Finding:
    from gr_ros2.phy.measure import deliver, record

    began = time.monotonic()
    recording = record(phy, PACKETS, seed=_SEED)
    arrived = deliver(phy, recording, ChannelConfig())
    text = f"{len(arrived)} of {PACKETS} packets came back in {time.monotonic() - began:.1f} s; runs on {phy.runs_on()}"
    if arrived == list(recording.packets):
        return Finding(what, "ok", text)
    return Finding(what, "failed", f"{text}; without noise all of them come back unaltered", _REMEDY)


def graph() -> Finding:
    """A message from a publisher to a subscription, over the middleware that needs nothing."""
    sent = Random(_SEED).randbytes(_BYTES)
    came: Queue[bytes] = Queue()
    qos = Qos("reliable", None, 1)
    with MemoryMiddleware() as graph:
        graph.subscribe("/self_test", "std_msgs/msg/String", qos, came.put)
        graph.advertise("/self_test", "std_msgs/msg/String", qos).publish(sent)
        try:
            received = came.get(timeout=_PATIENCE_S)
        except Empty:
            return Finding("message", "failed", f"nothing came within {_PATIENCE_S:g} s", _REMEDY)
    if received == sent:
        return Finding("message", "ok", "a message came from a publisher to a subscription")
    return Finding("message", "failed", "the message came altered", _REMEDY)


def examples() -> Iterator[Finding]:
    """The example flowgraphs and links, and the descriptions of the blocks."""
    try:
        for name in EXAMPLES:
            example(name)
        links = [load_link(example(name)) for name in LINKS]
    except GrRos2Error as error:
        yield Finding("examples", "failed", str(error), _REMEDY)
        return
    yield Finding("examples", "ok", f"{len(EXAMPLES)} files found, {len(links)} links read")
    blocks = len(list(grc_path().glob("*.block.yml")))
    if blocks:
        yield Finding("GRC blocks", "ok", f"{blocks} in {grc_path()}")
    else:
        yield Finding("GRC blocks", "failed", f"none in {grc_path()}", _REMEDY)


SELF_TEST: tuple[Check, ...] = (
    Check("Self-test", "phy", loopbacks),
    Check("Self-test", "message", graph),
    Check("Self-test", "examples", examples),
)
