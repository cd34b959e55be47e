"""GNU Radio's message ports keep every message, once a transmitter of ours has been made."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pmt
import pytest
from gnuradio import gr, pdu

from gr_ros2.phy.ofdm import OfdmPhy
from gr_ros2.phy.threads import lift_message_limit, wait_until_s
from tests.waiting import PATIENCE_S, wait_for

OVER_GNU_RADIOS_LIMIT = 8192 + 2500  # of which 1024 find room behind the port


class KeptAliveSink(gr.sync_block):  # type: ignore[misc]
    """Takes nothing until it is let go."""

    def __init__(self) -> None:
        super().__init__("held_sink", [np.uint8], None)
        self.go = threading.Event()
        self.taken = 0

    def work(self, input_items: list[Any], output_items: list[Any]) -> int:  # noqa: ARG002
        self.go.wait(PATIENCE_S)
        self.taken += len(input_items[0])
        return len(input_items[0])


def test_what_is_due_in_a_thousand_years_can_be_waited_for() -> None:
    assert wait_until_s(None, 5.0) is None
    assert wait_until_s(7.0, 5.0) == 2.0
    assert wait_until_s(4.0, 5.0, least_s=0.1) == 0.1
    for at in (3e10, 1e300, float("inf")):
        assert 0 < (wait_until_s(at, 5.0) or 0) <= threading.TIMEOUT_MAX


def test_a_port_without_a_handler_keeps_all_it_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("GR_CONF_DEFAULT_MAX_MESSAGES", raising=False)
    lift_message_limit()
    length = 64
    flowgraph = gr.top_block()
    to_stream, sink = pdu.pdu_to_tagged_stream(gr.types.byte_t, "length"), KeptAliveSink()
    flowgraph.connect(to_stream, sink)
    flowgraph.start()
    try:
        message = pmt.cons(pmt.PMT_NIL, pmt.init_u8vector(length, [0] * length))
        for _ in range(OVER_GNU_RADIOS_LIMIT):
            to_stream.to_basic_block()._post(pmt.intern("pdus"), message)
        sink.go.set()
        wait_for(lambda: sink.taken >= OVER_GNU_RADIOS_LIMIT * length, "every message")
        assert sink.taken == OVER_GNU_RADIOS_LIMIT * length
    finally:
        sink.go.set()
        flowgraph.stop()
        flowgraph.wait()


def test_a_transmitter_with_such_a_port_asks_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("GR_CONF_DEFAULT_MAX_MESSAGES", raising=False)
    OfdmPhy(packet_len=64, sample_rate=1e5, detection_threshold="stock").transmitter().release()
    assert gr.prefs().get_long("DEFAULT", "max_messages", 100) == -1


def test_a_setting_of_the_users_own_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GR_CONF_DEFAULT_MAX_MESSAGES", "77")
    lift_message_limit()
    assert gr.prefs().get_long("DEFAULT", "max_messages", 100) == 77
