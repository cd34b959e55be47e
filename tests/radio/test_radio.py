"""A radio as one block: packets cross, what a dashboard does acts, and what a real channel does is not simulated."""

from __future__ import annotations

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gnuradio import gr

from gr_ros2.config import ChannelConfig
from gr_ros2.errors import BackendMissingError, ConfigError, RadioError
from gr_ros2.phy.psk import PskPhy
from gr_ros2.radio.radio import Radio, make_radio
from gr_ros2.radio.sim import SimFrontEnd
from tests.gr.probe import Probe, wait_for

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


def test_what_was_not_built_in_cannot_be_changed() -> None:
    radio = make_radio("direct", 64, 0.0, "sim")
    for change in (lambda: radio.set_snr_db(3.0), lambda: radio.set_packet_loss(0.5)):
        with pytest.raises(RadioError, match="front_end sim"):
            change()
    radio.close()


def test_names_and_settings_that_are_wrong() -> None:
    with pytest.raises(ConfigError, match="nosuch"):
        make_radio("nosuch", 64, 1e6, "sim")
    with pytest.raises(ConfigError, match="front_end sim"):
        make_radio("psk", 64, 1e6, "sim", nosuch=1)
    with pytest.raises((RadioError, BackendMissingError), match="uhd"):
        make_radio("psk", 64, 1e6, "uhd", args="type=none", frequency=433e6)
