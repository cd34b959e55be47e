"""A Pluto without hardware: what libiio's server says on the network, with what is sent coming back as received.

Invariants: settings are texts that are kept as written and read back, except where told otherwise; samples received
come at the sample rate, noise where nothing was sent.
"""

from __future__ import annotations

import os
import socketserver
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import IO

import numpy as np

PHY, TX, RX = "ad9361-phy", "cf-ad9361-dds-core-lpc", "cf-ad9361-lpc"
_PORT = 30431
"""Of libiio's server; versions before 0.24 know no other."""
_INVALID = -22
"""What Linux says of a value out of range."""
_SAMPLE = np.dtype("<i2")
_CHANNELS = {
    PHY: {
        ("altvoltage0", True): {"frequency": "out_altvoltage0_RX_LO_frequency"},
        ("altvoltage1", True): {"frequency": "out_altvoltage1_TX_LO_frequency"},
        ("voltage0", True): {
            "hardwaregain": "out_voltage0_hardwaregain",
            "rf_bandwidth": "out_voltage_rf_bandwidth",
            "sampling_frequency": "out_voltage_sampling_frequency",
        },
        ("voltage0", False): {
            "hardwaregain": "in_voltage0_hardwaregain",
            "gain_control_mode": "in_voltage0_gain_control_mode",
            "sampling_frequency": "in_voltage_sampling_frequency",
            "quadrature_tracking_en": "in_voltage_quadrature_tracking_en",
            "rf_dc_offset_tracking_en": "in_voltage_rf_dc_offset_tracking_en",
            "bb_dc_offset_tracking_en": "in_voltage_bb_dc_offset_tracking_en",
        },
    },
    TX: {("voltage0", True): {"sampling_frequency": "out_voltage_sampling_frequency"}, ("voltage1", True): {}},
    RX: {("voltage0", False): {"sampling_frequency": "in_voltage_sampling_frequency"}, ("voltage1", False): {}},
}
_ATTRIBUTES = {PHY: ("in_out_voltage_filter_fir_en", "filter_fir_config", "tx_path_rates")}
_ELEMENTS = {
    "context": (),
    "device": ("id", "name"),
    "channel": ("id", "type"),
    "scan-element": ("index", "format"),
    "attribute": ("name", "filename"),
    "debug-attribute": ("name",),
}
"""Of the XML, with their attributes: libiio complains of what is not declared."""
_FORMATS = {TX: "le:S16/16&gt;&gt;0", RX: "le:S12/16&gt;&gt;0"}
Key = tuple[str, ...]
"""Where a setting is: device, INPUT or OUTPUT and channel where it is a channel's, its name."""


def _description() -> str:
    """The context, as libiio's XML has it."""
    lines = ['<?xml version="1.0" encoding="utf-8"?><!DOCTYPE context [']
    for element, names in _ELEMENTS.items():
        lines.append(f"<!ELEMENT {element} ANY>")
        lines += [f"<!ATTLIST {element} {name} CDATA #IMPLIED>" for name in names]
    lines.append("]><context>")
    for device, channels in _CHANNELS.items():
        lines.append(f'<device id="{device}" name="{device}">')
        for number, ((channel, output), attributes) in enumerate(channels.items()):
            lines.append(f'<channel id="{channel}" type="{"output" if output else "input"}">')
            if device in _FORMATS:
                lines.append(f'<scan-element index="{number}" format="{_FORMATS[device]}"/>')
            lines += [f'<attribute name="{name}" filename="{file}"/>' for name, file in attributes.items()]
            lines.append("</channel>")
        lines += [f'<attribute name="{name}"/>' for name in _ATTRIBUTES.get(device, ())]
        lines.append('<debug-attribute name="direct_reg_access"/></device>')
    return "".join([*lines, "</context>"])


def _at_some_address(listen: Callable[[str], socketserver.TCPServer]) -> socketserver.TCPServer:
    """A server at an address of this machine where no other test's is."""
    for number in range(100):
        try:
            return listen(f"127.0.{1 + os.getpid() % 250}.{1 + number}")
        except OSError:
            continue
    raise RuntimeError(f"port {_PORT} is taken at a hundred addresses of this machine")


class Pluto:
    """Listens while in a ``with`` statement.

    :param limits: (lowest, highest) of settings; a value outside is refused, as Linux does, and the old one stays
    :ivar settings: as written, by where they are
    :ivar bursts: samples of each buffer sent
    """

    def __init__(self, **limits: tuple[float, float]) -> None:
        self.settings: dict[Key, str] = {
            (PHY, "OUTPUT", "altvoltage0", "frequency"): "2400000000",
            (PHY, "OUTPUT", "altvoltage1", "frequency"): "2450000000",
            (PHY, "OUTPUT", "voltage0", "hardwaregain"): "-10.000000 dB",
            (PHY, "INPUT", "voltage0", "hardwaregain"): "71.000000 dB",
            (PHY, "tx_path_rates"): "BBPLL:983040000 DAC:122880000 T2:61440000 T1:30720000 TF:15360000 TXSAMP:3840000",
        }
        self.bursts: list[int] = []
        self._limits = limits
        self._air = bytearray()
        self._lock = threading.Lock()
        pluto = self

        class Handler(socketserver.StreamRequestHandler):
            disable_nagle_algorithm = True

            def handle(self) -> None:
                _Session(pluto, self.rfile, self.wfile).run()

        class Server(socketserver.ThreadingTCPServer):
            daemon_threads = True

        self._server = _at_some_address(lambda address: Server((address, _PORT), Handler))
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True)

    @property
    def uri(self) -> str:
        """Where it is, for ``args``."""
        return f"ip:{self._server.server_address[0]}"

    def write(self, key: Key, value: str) -> int:
        """Take a setting, as Linux does; what it answers."""
        low, high = self._limits.get(key[-1], (float("-inf"), float("inf")))
        if key[-1] in self._limits and not low <= float(value) <= high:
            return _INVALID
        self.settings[key] = f"{float(value):.6f} dB" if key[-1] == "hardwaregain" else value
        if key[-1] == "sampling_frequency":
            # One clock for both directions.
            for device, direction in ((PHY, "INPUT"), (PHY, "OUTPUT"), (RX, "INPUT"), (TX, "OUTPUT")):
                self.settings[device, direction, "voltage0", "sampling_frequency"] = value
        return len(value)

    def send(self, samples: bytes) -> None:
        """Put a buffer on the air: 16 bits there, 12 bits come back."""
        values = np.frombuffer(samples, _SAMPLE)
        with self._lock:
            self.bursts.append(len(values) // 2)
            self._air += (values >> 4).astype(_SAMPLE).tobytes()

    def receive(self, size: int) -> bytes:
        """So many bytes of what is on the air."""
        noise = np.random.default_rng(1).normal(0, 4, size // 2).astype(_SAMPLE)
        with self._lock:
            heard, self._air = self._air[:size], self._air[size:]
        noise[: len(heard) // 2] += np.frombuffer(heard, _SAMPLE)
        return noise.tobytes()

    def seconds(self, size: int) -> float:
        """s that so many bytes received take."""
        return size / 4 / float(self.settings.get((PHY, "INPUT", "voltage0", "sampling_frequency"), "1e6"))

    def __enter__(self) -> Pluto:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.shutdown()
        self._server.server_close()


class _Session:
    """One connection: commands in, one line each; a number out, and what it counts."""

    def __init__(self, pluto: Pluto, requests: IO[bytes], answers: IO[bytes]) -> None:
        self._pluto = pluto
        self._requests, self._answers = requests, answers
        self._mask = "00000003"
        self._due = 0.0

    def run(self) -> None:
        commands: dict[str, Callable[[list[str]], None]] = {
            "VERSION": lambda _words: self._say("0.24.0000000"),
            "PRINT": lambda _words: self._give(_description().encode()),
            "READ": self._read,
            "WRITE": self._write,
            "OPEN": self._open,
            "READBUF": self._receive,
            "WRITEBUF": self._send,
        }
        try:
            while words := self._requests.readline().decode().split():
                if words[0] == "EXIT":
                    return
                if words[0] == "ZPRINT":
                    self._say(_INVALID)
                else:
                    commands.get(words[0], lambda _words: self._say(0))(words[1:])
        except OSError:  # it left
            return

    def _say(self, answer: object) -> None:
        self._answers.write(f"{answer}\n".encode())

    def _give(self, content: bytes) -> None:
        self._say(len(content))
        self._answers.write(content + b"\n")

    def _read(self, words: list[str]) -> None:
        self._give(self._pluto.settings.get(tuple(words), "0").encode())

    def _write(self, words: list[str]) -> None:
        value = self._requests.read(int(words[-1])).rstrip(b"\0").decode()
        self._say(self._pluto.write(tuple(words[:-1]), value))

    def _open(self, words: list[str]) -> None:
        self._mask = words[2]
        self._due = time.monotonic()
        self._say(0)

    def _receive(self, words: list[str]) -> None:
        size = int(words[1])
        self._due += self._pluto.seconds(size)
        time.sleep(max(0.0, self._due - time.monotonic()))
        self._say(size)
        self._say(self._mask)
        self._answers.write(self._pluto.receive(size))

    def _send(self, words: list[str]) -> None:
        size = int(words[1])
        self._say(0)
        self._pluto.send(self._requests.read(size))
        self._say(size)
