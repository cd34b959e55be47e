"""A radio as one block: packets cross, what a dashboard does acts, and what a real channel does is not simulated."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from gnuradio import gr

from gr_ros2.core.errors import BackendMissingError, ConfigError, PhyError, RadioError
from gr_ros2.phy.psk import PskPhy
from gr_ros2.radio.radio import Radio, make_radio
from gr_ros2.radio.sigmf import read_recording
from gr_ros2.radio.sim import SimFrontEnd
from gr_ros2.settings.config import ChannelConfig
from tests.gr.probe import Probe
from tests.waiting import wait_for

PACKETS = [bytes([number]) * 64 for number in range(20)]


class Running:
    """A radio between two probes."""

    def __init__(self, radio: Radio) -> None:
        self.radio = radio
        self.source, self.sink = Probe(), Probe()
        self.top = gr.top_block()
        self.top.msg_connect(self.source, "pdus", radio, "pdus")
        self.top.msg_connect(radio, "credit", self.source, "credit")
        self.top.msg_connect(radio, "pdus", self.sink, "pdus")

    def __enter__(self) -> Running:
        self.top.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.top.stop()
        self.top.wait()
        self.radio.close()


def simulated(*, instrumented: bool = False, channel: ChannelConfig | None = None) -> Radio:
    phy = PskPhy(64, 1e6)
    return Radio(phy, SimFrontEnd(phy), channel=channel, instrumented=instrumented)


def test_packets_cross_and_credits_come() -> None:
    with Running(make_radio("psk", 64, 1e6, "sim", {"modulation": "bpsk"})) as running:
        for packet in PACKETS:
            running.source.post(packet)
        wait_for(lambda: running.sink.handled == len(PACKETS), "every packet")
        assert running.sink.packets == PACKETS
        wait_for(lambda: running.source.credits, "a credit")
        counts = running.radio.counts()
        assert (counts.passed, counts.transmitted, counts.backlog) == (len(PACKETS), len(PACKETS), 0)
        assert running.radio.samples() is None


def test_an_instrumented_one_shows_its_signal_and_takes_another_channel() -> None:
    with Running(simulated(instrumented=True)) as running:
        radio = running.radio
        for packet in PACKETS:
            running.source.post(packet)
        wait_for(lambda: running.sink.handled == len(PACKETS), "every packet")
        wait_for(lambda: radio.samples() is not None and radio.symbols() is not None, "signal and symbols")
        radio.set_packet_loss(1.0)
        for packet in PACKETS:
            running.source.post(packet)
        wait_for(lambda: radio.counts().losses.get("packet_loss") == len(PACKETS), "every packet lost")
        assert running.sink.handled == len(PACKETS)
        radio.set_frequency_offset(0.001)
        radio.set_snr_db(30.0)
        assert radio.channel == ChannelConfig(packet_loss=1.0, frequency_offset=0.001, snr_db=30.0)
        with pytest.raises(ConfigError, match="packet_loss"):
            radio.set_packet_loss(2.0)


def test_a_channel_that_is_given_can_be_changed_while_it_runs() -> None:
    with Running(make_radio("psk", 64, 1e6, "sim", channel={"packet_loss": 1.0})) as running:
        radio = running.radio
        for packet in PACKETS:
            running.source.post(packet)
        wait_for(lambda: radio.counts().losses.get("packet_loss") == len(PACKETS), "every packet lost")
        radio.set_packet_loss(0.0)
        radio.set_snr_db(40.0)
        radio.set_frequency_offset(1e-4)
        for packet in PACKETS:
            running.source.post(packet)
        wait_for(lambda: running.sink.handled == len(PACKETS), "every packet")
        assert radio.samples() is None  # no taps, which only a dashboard uses


def test_an_empty_channel_changes_nothing_until_it_is_set() -> None:
    with Running(make_radio("psk", 64, 1e6, "sim", channel={})) as running:
        for packet in PACKETS:
            running.source.post(packet)
        wait_for(lambda: running.sink.packets == PACKETS, "every packet")
        running.radio.set_packet_loss(1.0)
        running.source.post(PACKETS[0])
        wait_for(lambda: running.radio.counts().dropped == 1, "a packet lost")


def test_it_records_what_it_receives_and_finishes_it_without_being_closed(tmp_path: Path) -> None:
    running = Running(make_radio("psk", 64, 1e6, "sim", record=str(tmp_path / "heard")))
    running.top.start()
    for packet in PACKETS:
        running.source.post(packet)
    wait_for(lambda: running.sink.handled == len(PACKETS), "every packet")
    running.top.stop()
    running.top.wait()
    _, samples = read_recording(tmp_path / "heard")
    # The channel model keeps a few of the zeros behind the last packet.
    assert 0 <= len(PACKETS) * running.radio.phy.airtime_samples() - len(samples) < 32
    running.radio.close()


def test_nothing_cannot_be_recorded(tmp_path: Path) -> None:
    path = str(tmp_path / "heard")
    for make in (
        lambda: make_radio("direct", 64, 0.0, "sim", record=path),
        lambda: make_radio("psk", 64, 1e6, "file", write=str(tmp_path / "sent"), record=path),
    ):
        with pytest.raises(ConfigError, match=r"record = .* leave record out"):
            make()


def test_a_radio_that_cannot_be_made_leaves_its_front_end_free(tmp_path: Path) -> None:
    ends = {"bind": f"ipc://{tmp_path}/a", "connect": (f"ipc://{tmp_path}/b",)}
    (tmp_path / "heard.sigmf-data").touch()
    with pytest.raises(ConfigError, match="there is one already"):
        make_radio("psk", 64, 1e6, "zmq", record=str(tmp_path / "heard"), **ends)
    make_radio("psk", 64, 1e6, "zmq", **ends).close()


def test_what_was_not_built_in_cannot_be_changed() -> None:
    radio = make_radio("direct", 64, 0.0, "sim")
    for change in (lambda: radio.set_snr_db(3.0), lambda: radio.set_packet_loss(0.5)):
        with pytest.raises(PhyError, match="front_end sim"):
            change()
    radio.close()


def test_names_and_settings_that_are_wrong() -> None:
    with pytest.raises(ConfigError, match="nosuch"):
        make_radio("nosuch", 64, 1e6, "sim")
    with pytest.raises(ConfigError, match="front_end sim"):
        make_radio("psk", 64, 1e6, "sim", nosuch=1)
    with pytest.raises(ConfigError, match="channel: snr_db = 101"):
        make_radio("psk", 64, 1e6, "sim", channel={"snr_db": 101})
    with pytest.raises((RadioError, BackendMissingError), match="uhd"):
        make_radio("psk", 64, 1e6, "uhd", args="type=none", frequency=433e6, transmit=True)


class _Ears(SimFrontEnd):
    """A front end that can be told that somebody else sends."""

    loud = True

    @property
    def busy(self) -> Callable[[], bool]:
        return lambda: self.loud


def test_a_radio_that_listens_sends_nothing_while_somebody_else_does() -> None:
    phy = PskPhy(64, 1e6)
    front_end = _Ears(phy)
    radio = Radio(phy, front_end, listens=True)
    with Running(radio) as running:
        wait_for(lambda: running.source.credits == 1, "the credit")
        running.source.post(PACKETS[0])
        wait_for(lambda: radio.gate.account()["deferred"] > 3, "a packet that waits")
        assert running.sink.packets == []
        front_end.loud = False
        wait_for(lambda: running.sink.packets == PACKETS[:1], "the packet")


def test_a_front_end_that_measures_no_power_cannot_listen() -> None:
    phy = PskPhy(64, 1e6)
    with pytest.raises(ConfigError, match="listen_before_send: front_end sim measures no power where it sends"):
        Radio(phy, SimFrontEnd(phy), listens=True)
