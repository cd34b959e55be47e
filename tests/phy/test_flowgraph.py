"""A flowgraph starts, or says in a line why not, and stops at any moment."""

from __future__ import annotations

import gc
import weakref
from pathlib import Path

import pytest
from gnuradio import blocks, gr

from gr_ros2.core.errors import PhyError
from gr_ros2.phy import PHY
from gr_ros2.phy.flowgraph import Flowgraph
from gr_ros2.phy.measure import deliver, record
from gr_ros2.settings.config import ChannelConfig
from tests.gr.probe import Probe
from tests.waiting import wait_for


def test_what_gnu_radio_refuses_is_named() -> None:
    graph = Flowgraph("test", "link two")
    graph.connect(blocks.null_source(gr.sizeof_gr_complex), blocks.copy(gr.sizeof_gr_complex))
    with pytest.raises(PhyError, match=r"^link two: the flowgraph does not start \(.*insufficient connected output"):
        graph.start()
    graph.stop()


def test_it_runs_within_a_with_statement() -> None:
    sink = blocks.null_sink(gr.sizeof_gr_complex)
    graph = Flowgraph("test", "link two")
    graph.connect(blocks.null_source(gr.sizeof_gr_complex), sink)
    graph.stop()
    with graph as running:
        assert running is graph
        wait_for(lambda: sink.nitems_read(0) > 0, "samples")
    passed = sink.nitems_read(0)
    graph.stop()
    assert sink.nitems_read(0) == passed


def test_a_block_that_is_connected_is_not_collected_as_garbage() -> None:
    """It would be: it has a message handler, which refers to it. GNU Radio would go on to call it, and crash."""

    def wired() -> tuple[Flowgraph, weakref.ref[Probe]]:
        graph, one, two = Flowgraph("test", "test"), Probe(), Probe()
        graph.msg_connect((one, "pdus"), (two, "pdus"))
        graph.msg_connect(two, "pdus", one, "pdus")
        return graph, weakref.ref(one)

    graph, block = wired()
    with graph:
        gc.collect()
        found = block()
        assert found is not None
        found.post(b"x")
        del found
    del graph
    gc.collect()
    assert block() is None


def segments() -> int:
    """Shared memory segments that this process holds, of the 4096 a system has."""
    gc.collect()
    return sum("SYSV" in line for line in Path("/proc/self/maps").read_text().splitlines())


@pytest.mark.slow
@pytest.mark.parametrize(("name", "options"), [("psk", {}), ("ofdm", {"detection_threshold": "stock"})])
def test_flowgraphs_that_are_over_hold_no_shared_memory(name: str, options: dict[str, str]) -> None:
    phy = PHY.load(name)(64, 1e6, **options)
    recording = record(phy, 2)

    def use(times: int) -> int:
        for _ in range(times):
            assert deliver(phy, recording, ChannelConfig()) == recording.packets
        return segments()

    # The last few of our blocks are held for a while, and with them what is in front of them.
    after_some = use(20 if options else 40)
    assert use(10) <= after_some
