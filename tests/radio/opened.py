"""Front ends with a stand-in for what they open, which keeps what it is told."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from types import SimpleNamespace
from typing import Any
from unittest import mock

from gr_ros2.core.errors import RadioError
from gr_ros2.phy import PHY
from gr_ros2.radio import FRONT_ENDS
from gr_ros2.radio.audio_bursts import CARD_RATE
from gr_ros2.radio.front_end import FrontEnd

RATE = 1e6
ANTENNAS = ("LEFT", "RIGHT")
Said = list[tuple[Any, ...]]


class Driver:
    """A block of a driver: each call is kept, and ``get_…`` gives what was ``set_…``."""

    def __init__(self, said: Said) -> None:
        self._said, self._set = said, {"get_samp_rate": RATE}

    def __getattr__(self, name: str) -> Callable[..., Any]:
        return lambda *values: self._answer(name, values)

    def _answer(self, name: str, values: tuple[Any, ...]) -> Any:
        if name.startswith("set_"):
            self._said.append((name, *map(str, values)))
            self._set[name.replace("set_", "get_")] = max([v for v in values if isinstance(v, float)], default=0.0)
            return None
        if name == "get_gain_range":
            return SimpleNamespace(**{key: lambda of=of: of for key, of in RANGE.items()})
        if name == "get_time_now":
            return SimpleNamespace(get_real_secs=lambda: 0.0)
        return ANTENNAS if name in ("get_antennas", "list_antennas") else self._set.get(name, False)


RANGE = {"start": -100.0, "stop": 100.0, "step": 1.0, "minimum": -100.0, "maximum": 100.0}


class SoapyDriver:
    """In place of :class:`gr_ros2.radio.soapy_sink.SoapySink`."""

    sample_rate = RATE
    trouble = ""

    def __init__(self, said: Said, *values: Any) -> None:
        self._said = said
        said.append(("SoapySink", *map(str, values)))

    def antennas(self) -> tuple[str, ...]:
        return ANTENNAS

    def gains(self) -> tuple[float, float, float]:
        return -100.0, 100.0, 1.0

    def device_time(self) -> None:
        return None

    def tune(self, frequency: float, gain: float, bandwidth: float, antenna: str) -> None:
        self.frequency, self.gain = frequency, gain
        self._said.append(("tune", frequency, gain, bandwidth, antenna))

    def close(self) -> None:
        pass


class Sound:
    """In place of what opens a sound device; it has no blocks."""

    ahead_s = 0.1

    def __init__(self, said: Said, name: str, *values: Any, **named: Any) -> None:
        self._said = said
        said.append((name, *map(str, values), *(str(named[key]) for key in sorted(named) if key != "begun")))

    def counters(self) -> dict[str, int]:
        return {"clipped": 0}

    def key(self, _: Any) -> None:
        pass

    def close(self) -> None:
        pass


@contextmanager
def drivers(said: Said) -> Iterator[None]:
    """Nothing is opened meanwhile; what would be opened is told."""

    def block(*values: Any, **_: Any) -> Driver:
        said.append(tuple(map(str, values)))
        return Driver(said)

    def stream(_: str, device: str, baud: int, framing: Any) -> Any:
        tried = list(framing.feed(framing.frame(b"packet")))
        said.append((device, baud, framing.frame(b"packet"), tried))
        raise RadioError("not opened here")

    def datagrams(listen: str, send_to: Any, *_: Any) -> Any:
        said.append((listen, tuple(send_to)))
        raise RadioError("not opened here")

    with ExitStack() as stack:
        for place, stand_in in (
            ("soapy.SoapySink", lambda *values: SoapyDriver(said, *values)),
            ("soapy.soapy.source", block),
            ("uhd.uhd.usrp_sink", lambda args, *_: block(args)),
            ("uhd.uhd.usrp_source", lambda args, *_: block(args)),
            ("pluto.iio.fmcomms2_sink_fc32", block),
            ("pluto.iio.fmcomms2_source_fc32", block),
            ("pluto.PlutoFrontEnd._check_settings", lambda *_: None),
            ("audio.look_again", lambda: None),
            ("audio.Speaker", lambda *values, **named: Sound(said, "speaker", *values, **named)),
            ("audio.Microphone", lambda *values: Sound(said, "microphone", *values)),
            ("audio.Keyer", lambda *values: Sound(said, "key", *values)),
            ("kiss.open_stream", stream),
            ("serial.open_stream", stream),
            ("udp.Datagrams", datagrams),
        ):
            importlib.import_module(f"gr_ros2.radio.{place.partition('.')[0]}")
            stack.enter_context(mock.patch(f"gr_ros2.radio.{place}", stand_in))
        yield


def opened(name: str, options: Mapping[str, Any]) -> tuple[Any, ...]:
    """What a front end tells its device, says where it sends, makes of its samples, and how long a packet lasts."""
    kind: type[FrontEnd] = FRONT_ENDS.load(name)
    rate = CARD_RATE / 2 if name == "audio" else RATE
    phy = PHY.load("modem")(64, bit_rate=9600) if kind.carries_packets else PHY.load("psk")(64, rate)
    said: Said = []
    with drivers(said):
        try:
            front_end = kind(phy, **options)
        except RadioError as error:
            return said, str(error), kind.airtime_with(phy, kind.Options(**options))
        try:
            return said, kind.on_air(options), type(front_end.source).__name__, front_end.airtime(), front_end.ahead()
        finally:
            front_end.close()
