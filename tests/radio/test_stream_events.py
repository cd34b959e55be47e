"""What a USRP tells is counted by name: messages and tags as GNU Radio makes them, from stand-ins on a real link."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
pytest.importorskip("gnuradio.uhd", reason="needs gr-uhd")

import pmt
from gnuradio import gr, uhd

from gr_ros2.core.errors import RadioError
from gr_ros2.phy.base import LENGTH_TAG
from gr_ros2.radio.robot_link import RobotLink
from tests.radio.robots import RATE, Robot, config
from tests.waiting import wait_for

FRONT_END = {"name": "uhd", "frequency": 433e6, "antenna_tx": "TX/RX", "bandwidth": 1e6}
TROUBLES = ("underflow", "underflow_in_packet", "seq_error", "seq_error_in_burst", "time_error")
HIGHEST, MOST = 6e9, 76.0
"""Hz and dB the stand-ins can do."""
STEP = 2000
"""Samples a call."""
AHEAD_S = 100.0
"""s by which the clock of the stand-ins is ahead."""


class _Usrp:
    """The settings of both stand-ins."""

    def get_samp_rate(self) -> float:
        return RATE

    def get_time_now(self) -> Any:
        return uhd.time_spec_t(time.monotonic() + AHEAD_S)

    def get_antennas(self, channel: int) -> tuple[str, ...]:
        assert channel == 0
        return ("TX/RX", "RX2")

    def set_samp_rate(self, rate: float) -> None:
        assert rate == RATE

    def set_center_freq(self, frequency: float, channel: int) -> None:
        assert channel == 0
        self.frequency = min(frequency, HIGHEST)

    def get_center_freq(self, channel: int) -> float:
        assert channel == 0
        return self.frequency

    def set_gain(self, gain: float, channel: int) -> None:
        assert channel == 0
        self.gain = min(gain, MOST)

    def get_gain(self, channel: int) -> float:
        assert channel == 0
        return round(self.gain)

    def get_gain_range(self, channel: int) -> Any:
        assert channel == 0
        return uhd.meta_range(0, MOST, 1)

    def _set(self, _value: object, channel: int) -> None:
        assert channel == 0

    set_bandwidth = set_antenna = _set


class Sink(_Usrp, gr.sync_block):  # type: ignore[misc]
    """Takes bursts as ``uhd.usrp_sink`` does, by the length tag, and acknowledges each."""

    made: list[Sink]

    def __init__(self, args: str, _stream: object, length_tag: str) -> None:
        super().__init__("stand_in_sink", [np.complex64], None)
        assert (args, length_tag) == ("", LENGTH_TAG)
        self.message_port_register_out(pmt.intern("async_msgs"))
        self.lengths: list[int] = []
        self.left = 0
        self.deaf = False
        self.offered = 0
        self.made.append(self)

    def work(self, input_items: list[Any], output_items: list[Any]) -> int:  # noqa: ARG002
        self.offered += len(input_items[0])
        if self.deaf:
            time.sleep(0.001)
            return 0
        if not self.left:
            (tag,) = self.get_tags_in_window(0, 0, 1, pmt.intern(LENGTH_TAG))
            self.left = pmt.to_long(tag.value)
            self.lengths.append(self.left)
        taken = min(self.left, len(input_items[0]))
        self.left -= taken
        if not self.left:
            self.tell("burst_ack")
        return taken

    def tell(self, *events: str) -> None:
        """One message as ``usrp_sink_impl::async_event_loop`` makes it."""
        codes = pmt.PMT_NIL
        for event in events:
            codes = pmt.list_add(codes, pmt.intern(event))
        value = pmt.dict_add(pmt.make_dict(), pmt.intern("event_code"), codes)
        value = pmt.dict_add(value, pmt.intern("time_spec"), pmt.cons(pmt.from_long(3), pmt.from_double(0.25)))
        value = pmt.dict_add(value, pmt.intern("channel"), pmt.from_uint64(0))
        self.message_port_pub(pmt.intern("async_msgs"), pmt.cons(pmt.intern("uhd_async_msg"), value))


class Source(_Usrp, gr.sync_block):  # type: ignore[misc]
    """Gives silence, tagged as ``usrp_source_impl::work`` tags its first sample and the first after each overflow."""

    made: list[Source]

    def __init__(self, _args: str, _stream: object) -> None:
        super().__init__("stand_in_source", None, [np.complex64])
        self.overflows = 0
        self._marked = -1
        self.made.append(self)

    def work(self, input_items: list[Any], output_items: list[Any]) -> int:  # noqa: ARG002
        time.sleep(0.001)
        if self._marked < self.overflows:
            self._marked += 1
            now = pmt.make_tuple(pmt.from_uint64(3), pmt.from_double(0.25))
            for key, value in (("rx_time", now), ("rx_rate", pmt.from_double(RATE)), ("rx_freq", pmt.from_double(0))):
                self.add_item_tag(0, self.nitems_written(0), pmt.intern(key), value, pmt.intern(self.alias()))
        count = min(STEP, len(output_items[0]))
        output_items[0][:count] = 0
        return count


@pytest.fixture
def stand_ins(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A USRP whose blocks are these."""
    for name, kind in (("usrp_sink", Sink), ("usrp_source", Source)):
        monkeypatch.setattr(kind, "made", [], raising=False)
        monkeypatch.setattr(uhd, name, kind)
    yield
    # Else they hold their flowgraph, with its shared memory.
    Sink.made.clear()
    Source.made.clear()


def look(robot: Robot, now: float) -> None:
    """Whether the device is found well, at a time when samples have come."""
    (source,) = Source.made
    before = source.nitems_written(0)
    wait_for(lambda: source.nitems_written(0) > before + 50 * STEP, "more samples than buffers hold")
    robot.link.front_end.check(now)


@pytest.mark.usefixtures("stand_ins")
def test_whatever_a_usrp_tells_is_counted_by_name() -> None:
    with Robot(1, FRONT_END) as robot:
        (sink,), (source,) = Sink.made, Source.made
        wait_for(lambda: "overflows" in robot.counters(), "the first sample")
        assert {**robot.counters(), "bursts_out": 0} == {  # it may have said already what it is
            **{"clipped": 0, "energy": 0, "overflows": 0},
            **{"bursts_out": 0, "underflows": 0, "sequence_errors": 0, "late": 0},
        }
        robot.say(*range(3))
        wait_for(lambda: robot.silent, "the last packet")
        robot.link.transmit(on=False)
        packets = robot.link.stats()["packets"]["out"]
        wait_for(lambda: robot.counters()["bursts_out"] == packets, "every acknowledgement")
        front_end: Any = robot.link.front_end
        assert front_end.clock_offset() == pytest.approx(-AHEAD_S, abs=AHEAD_S / 10)
        assert sink.lengths == [front_end.layout.total] * packets

        for event in TROUBLES:
            sink.tell(event)
        sink.tell("underflow", "seq_error")
        sink.tell("of a later version")
        source.overflows = 1
        wait_for(lambda: robot.counters()["overflows"] == 1, "the first gap")
        source.overflows = 2
        wait_for(lambda: robot.counters()["overflows"] == 2, "the second")
        wait_for(lambda: "of a later version" in robot.counters(), "the last message")
        expected = {"underflows": 3, "sequence_errors": 3, "late": 1, "of a later version": 1}
        assert {name: robot.counters()[name] for name in expected} == expected


@pytest.mark.usefixtures("stand_ins")
def test_a_usrp_that_only_receives_has_no_transmitter() -> None:
    with Robot(1, {**FRONT_END, "half_duplex": True}, transmit=False) as robot:
        for now in (100.0, 200.0):
            look(robot, now)
        assert Sink.made == []
        assert robot.counters()["overflows"] == 0


@pytest.mark.usefixtures("stand_ins")
def test_a_transmitter_that_takes_nothing_ends_the_link() -> None:
    with Robot(1, FRONT_END) as robot:
        (sink,) = Sink.made
        sink.deaf = True
        robot.say(0)
        wait_for(lambda: sink.offered, "a burst")
        for now in (100.0, 101.0, 102.0):  # as often as a link looks, or it has stood still itself
            look(robot, now)
        with pytest.raises(RadioError, match=r"front_end uhd: .*a burst to send was not taken for 3 s"):
            for now in (103.0, 104.0):
                look(robot, now)


@pytest.mark.usefixtures("stand_ins")
def test_a_transmitter_that_has_nothing_to_send_is_well() -> None:
    with Robot(1, FRONT_END, topics=[], direction="send") as robot:
        for now in (100.0, 200.0, 300.0):
            look(robot, now)
        assert robot.counters()["bursts_out"] == 0


@pytest.mark.usefixtures("stand_ins")
@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"frequency": 7e9}, r"is tuned to 6,000,000,000 Hz, not to 7,000,000,000; set frequency to one"),
        ({"frequency_rx": 7e9}, r"is tuned to 6,000,000,000 Hz, not to 7,000,000,000; set frequency_rx to one"),
        ({"gain_tx": 80}, r"front_end uhd: gain_tx = 80 dB: the device has 0 to 76 dB"),
        ({"gain_rx": -3}, r"front_end uhd: gain_rx = -3 dB: the device has 0 to 76 dB"),
        ({"antenna_rx": "RX9"}, r"front_end uhd: antenna_rx = 'RX9': the device has TX/RX, RX2"),
    ],
)
def test_a_usrp_that_is_not_as_asked_is_refused(change: dict[str, Any], said: str) -> None:
    with pytest.raises(RadioError, match=said):
        RobotLink(config(1, {**FRONT_END, **change}))
    with Robot(1, {**FRONT_END, "gain_tx": 10.4}) as robot:
        assert robot.link.front_end.options.gain_tx == 10.4
