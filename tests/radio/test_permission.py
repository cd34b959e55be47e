"""Who may send: a radio asks for a word, and for a key; a link that only receives sends nothing."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.phy.flowgraph import Flowgraph
from gr_ros2.radio import FRONT_ENDS
from gr_ros2.radio.permission import permitted
from gr_ros2.radio.radio import make_radio
from gr_ros2.state.keys import new_key_file
from tests.gr.probe import Probe
from tests.radio.cables import SerialCable
from tests.radio.robots import Robot, config
from tests.waiting import wait_for

SERIAL = {"name": "serial", "device": "/dev/ttyUSB0"}
UDP = {"name": "udp", "listen": "127.0.0.1:5001", "send_to": ["127.0.0.1:5002"]}
MODEM = {"name": "modem", "options": {"bit_rate": 1e6}}


def may_send(front_end: dict[str, Any], **values: Any) -> bool:
    link = config(1, front_end, **{"phy": MODEM, **values})
    front_end_class = FRONT_ENDS.load(link.front_end_name)
    return permitted(link.transmit, front_end_class, link.front_end_options, guarded=bool(link.key) or link.open)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (
            {"transmit": "auto"},
            "serial sends at the frequency and power that the radio is set to: say once that it may",
        ),
        ({"transmit": True, "open": False}, "there is no key: anybody could read, forge and replay"),
    ],
)
def test_a_radio_asks_first(values: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        may_send(SERIAL, **values)


def test_a_word_and_a_key_are_enough_and_what_is_no_radio_asks_for_neither(tmp_path: Path) -> None:
    new_key_file(tmp_path / "fleet.key")
    assert may_send(SERIAL, transmit=True, key=str(tmp_path / "fleet.key"))
    assert may_send(SERIAL, transmit=True, open=True)
    assert may_send(UDP, transmit="auto", open=False)
    assert not may_send(SERIAL, transmit=False, open=False)
    assert not may_send(UDP, transmit=False)


def test_the_power_is_said_where_it_is_known() -> None:
    pytest.importorskip("gnuradio.iio")
    told = FRONT_ENDS.load("pluto").on_air({"frequency": 433.2e6, "gain_tx": -10, "level": 0.1})
    assert told == "at 433,200,000 Hz with gain_tx -10 dB, level 0.1, about -23 dBm"


def test_a_link_that_only_receives_hears_and_sends_nothing(tmp_path: Path) -> None:
    with SerialCable(tmp_path) as cable:
        ends = [{"name": "serial", "device": str(end), "half_duplex": False} for end in cable.ends]
        common = {"phy": MODEM}
        with (
            Robot(1, ends[0], state=str(tmp_path / "1"), **common) as one,
            Robot(2, ends[1], hears=(1,), state=str(tmp_path / "2"), transmit=False, **common) as two,
        ):
            wait_for(lambda: two.link.stats()["peers"], "a hello")
            said = one.say(1, 2, 3)
            wait_for(lambda: two.heard == said, "the messages")
            assert two.link.stats()["packets"]["out"] == 0
            assert two.link.source.stats()["topics"] == {}
            assert one.link.stats()["peers"] == []


def test_who_only_receives_binds_no_address_over_zeromq_and_switches_nothing_on(tmp_path: Path) -> None:
    ends = [f"ipc://{tmp_path}/{name}" for name in "ab"]
    common = {"phy": {"name": "psk", "sample_rate": 1e6}}
    one = {"name": "zmq", "bind": ends[0], "connect": [ends[1]]}
    two = {"name": "zmq", "bind": ends[1], "connect": [ends[0]]}
    with (
        Robot(1, one, state=str(tmp_path / "1"), **common) as first,
        Robot(2, two, hears=(1,), state=str(tmp_path / "2"), transmit=False, **common) as second,
        Robot(3, two, hears=(1,), state=str(tmp_path / "3"), transmit=False, **common) as third,
    ):
        said: list[bytes] = []
        wait_for(lambda: second.link.stats()["peers"] and third.link.stats()["peers"], "a hello")
        said += first.say(1)
        wait_for(lambda: second.heard == third.heard == said, "the message at both")
        assert first.counters()["bursts_in"] == 0
        with pytest.raises(ConfigError, match="front_end zmq: it only receives, and has no open transmitter"):
            second.link.transmit(on=True)
        second.link.transmit(on=False)
        assert not (tmp_path / "b").exists()


def test_a_radio_of_grc_asks_too(tmp_path: Path) -> None:
    with SerialCable(tmp_path) as cable:
        modem = {"phy": "modem", "packet_len": 64, "front_end": "serial", "device": str(cable.ends[0])}
        with pytest.raises(ConfigError, match=r"serial sends .*: say once that it may, .* in the block of GRC"):
            make_radio(**modem)
        for word in (True, False):
            radio = make_radio(**modem, transmit=word)
            assert radio.transmits is word
            radio.close()


def test_a_radio_of_grc_sends_what_a_key_seals(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Its link is another block, so what it may send is decided packet by packet."""
    sealed, clear = bytes([0x18]) + bytes(30), bytes([0x10]) + bytes(30)
    top = Flowgraph("test", "test")
    with SerialCable(tmp_path) as cable, ExitStack() as closing:
        sends = []
        for end, is_open in zip(cable.ends, (False, True), strict=True):
            modem = {"phy": "modem", "packet_len": 64, "phy_options": {"bit_rate": 1e6}, "front_end": "serial"}
            radio = make_radio(**modem, device=str(end), transmit=True, open=is_open, half_duplex=False)
            closing.callback(radio.close)
            probe = Probe()
            top.msg_connect((probe, "pdus"), (radio, "pdus"))
            top.msg_connect((radio, "pdus"), (probe, "pdus"))
            sends.append((probe, radio))
        closing.callback(top.stop)
        top.start()
        for probe, _ in sends:
            for packet in (clear, sealed, clear):
                probe.post(packet)
        (guarded, radio), (anybody, _) = sends
        wait_for(lambda: anybody.packets == [sealed], "what the key seals")
        wait_for(lambda: guarded.packets == [clear, sealed, clear], "everything")
        wait_for(lambda: radio.gate.account()["refused"] == {"not_sealed": 2}, "the count")
    assert caplog.text.count("there is no key: anybody could read, forge and replay its packets") == 1


def test_a_band_holds_in_grc_as_in_a_link(tmp_path: Path) -> None:
    modem: dict[str, Any] = {"phy": "modem", "packet_len": 64, "phy_options": {"bit_rate": 9600}, "front_end": "serial"}
    with pytest.raises(ConfigError, match=r"not within the 868 to 868\.6 MHz"):
        make_radio("psk", 64, 1e6, "uhd", frequency=433.2e6, transmit=True, airtime_limit="eu868", robot_id=1)
    with pytest.raises(ConfigError, match="a station says its callsign in clear"):
        make_radio(**modem, device="/dev/ttyUSB0", transmit=True, airtime_limit="amateur", robot_id=1)
    with pytest.raises(ConfigError, match="whose account is it"):
        make_radio("psk", 64, 1e6, "zmq", airtime_limit="eu868", **zmq_ends(tmp_path))
    limited: dict[str, Any] = {
        "airtime_limit": {"duty_cycle": 0.1, "window_s": 100},
        "robot_id": 1,
        "state": str(tmp_path / "robot.json"),
    }
    radio = make_radio("psk", 64, 1e6, "zmq", **limited, **zmq_ends(tmp_path))
    limit = radio.gate._clock.limit
    assert limit is not None
    assert limit.budget == pytest.approx(10)
    assert limit.reserve(0.0, 0.1)
    with pytest.raises(ConfigError, match="another link of this robot uses it"):
        make_radio("psk", 64, 1e6, "zmq", **limited, bind=f"ipc://{tmp_path}/c", connect=(f"ipc://{tmp_path}/b",))
    radio.close()
    again = make_radio("psk", 64, 1e6, "zmq", **limited, **zmq_ends(tmp_path))
    assert again.gate.account()["spent_s"] > 0, "what was reserved counts after a restart"
    again.close()


def zmq_ends(folder: Path) -> dict[str, Any]:
    return {"bind": f"ipc://{folder}/a", "connect": (f"ipc://{folder}/b",)}
