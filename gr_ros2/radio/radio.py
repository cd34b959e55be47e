"""PHY and front end as one GNU Radio block: packets to the air and back.

Invariants: packets leave at the pace of the air, and each credit asks for one packet just before it is due. Neither
direction waits for the other. Received samples can be impaired only if the channel is not a real one; a part that was
not built in costs nothing, and its settings cannot be changed.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gnuradio import gr

from gr_ros2.core.errors import ConfigError, PhyError
from gr_ros2.link.airtime_limit import AirtimeLimit
from gr_ros2.link.lateness import Lateness
from gr_ros2.phy import PHY, Phy
from gr_ros2.phy.airtime import AirtimeGate
from gr_ros2.phy.base import PacketReceiver, PacketTransceiver, PacketTransmitter, SymbolSource
from gr_ros2.phy.burst_blocks import BurstSink
from gr_ros2.phy.channel import BurstChannel, Channel, PacketLoss
from gr_ros2.phy.flowgraph import HierBlock
from gr_ros2.phy.tap import Samples, Tap
from gr_ros2.radio import FRONT_ENDS
from gr_ros2.radio.front_end import FrontEnd
from gr_ros2.radio.limits import open_limit
from gr_ros2.radio.permission import SealedOnly, check_band, permitted
from gr_ros2.radio.sigmf import SigmfRecorder, SigmfRecording
from gr_ros2.settings.config import ChannelConfig, airtime_from, build, replaced
from gr_ros2.settings.fields import AUTO, Auto

_LEAST_WAIT_S = 0.001
"""s after which a channel that was not clear is listened to again, at least."""
_SAMPLES_SHOWN = 1024
"""Samples of one snapshot of the received signal."""


@dataclass(frozen=True)
class LinkCounts:
    """Packets at each place of a radio, since the start.

    :param passed: packets that the gate let through
    :param backlog: packets in the gate, waiting for the channel or occupying it
    :param transmitted: packets that left the transmitter as samples
    :param received: packets that came out of the receiver, if they are counted
    :param losses: packets dropped on purpose after the receiver, by the channel's setting that caused it
    """

    passed: int
    backlog: int
    transmitted: int
    received: int
    losses: Mapping[str, int]

    @property
    def dropped(self) -> int:
        """Packets dropped on purpose, whatever the setting."""
        return sum(self.losses.values())


class Radio(HierBlock):
    """Message ports `pdus` in, `pdus` out and `credit` out (see :class:`gr_ros2.gr.sending.SendingBlock`).

    :param phy: converts packets to samples and back
    :param front_end: carries the samples; ``close`` closes it too
    :param channel: impairments of what is received, for front ends without a radio
    :param record: SigMF recording to write of all samples received, '' = none
    :param limit: what limits the airtime; None = nothing
    :param listens: whether each packet waits until nobody else is heard
    :param admits: whether a packet may be sent at all, by its bytes; None: every one
    :param changeable: add a channel that can be changed while running, if the front end has no radio
    :param on_ready: called with whether the device takes packets, whenever that has changed, as far as it can be asked
    :param instrumented: add parts for a dashboard: a channel that can be changed, and taps for spectrum and
        constellation
    :param shows: have two further ports for a window, where the PHY has samples: the received signal, a complex
        stream, and `points`, the constellation, a message port on which burst PHYs send
    :raises ConfigError: for a channel that this PHY or front end cannot have, or a recording without samples
    :raises RadioError: when the recording cannot be written
    :ivar channel: the current impairments
    :ivar gate: lets packets pass at the pace of the air
    """

    _transmitter: PacketTransmitter | None = None
    _faded: Channel | BurstChannel | None = None
    _receiver: PacketReceiver | None = None
    _loss: PacketLoss | None = None
    _tap: SymbolSource | None = None
    _symbols: SymbolSource | None = None

    def __init__(
        self,
        phy: Phy,
        front_end: FrontEnd,
        *,
        channel: ChannelConfig | None = None,
        record: str = "",
        limit: AirtimeLimit | None = None,
        listens: bool = False,
        admits: Callable[[bytes], bool] | None = None,
        on_ready: Callable[[bool], None] | None = None,
        changeable: bool = False,
        instrumented: bool = False,
        shows: bool = False,
    ) -> None:
        self._shows = shows and phy.has_samples
        signal = gr.io_signature(1, 1, gr.sizeof_gr_complex) if self._shows else gr.io_signature(0, 0, 0)
        super().__init__("gr_ros2_radio", gr.io_signature(0, 0, 0), signal)
        if shows:
            self.message_port_register_hier_out("points")
        for register in (self.message_port_register_hier_in, self.message_port_register_hier_out):
            register("pdus")
        self.message_port_register_hier_out("credit")
        self.phy, self.front_end = phy, front_end
        self.closing = ExitStack()
        """What :meth:`close` closes besides."""
        self.channel = ChannelConfig() if channel is None else channel
        phy.check_channel(self.channel)
        if front_end.has_radio and self.channel != ChannelConfig():
            raise ConfigError(f"channel: front_end {front_end.name} has a real one; leave channel out")
        if record and (front_end.source is None or not phy.has_samples):
            raise ConfigError(
                f"record = {record!r}: front_end {front_end.name} gives no samples with phy {phy.name} and these "
                "settings; leave record out"
            )
        self._simulated = (changeable or instrumented) and not front_end.has_radio
        self._recorder: SigmfRecorder | None = None
        airtime_of = front_end.airtime if phy.any_length else None
        self.gate = AirtimeGate(
            front_end.airtime(),
            airtime_of=airtime_of,
            ahead=front_end.ahead(),
            limit=limit,
            timed=front_end.clock_offset is not None,
            listens=_Listener(front_end) if listens else None,
            ready=front_end.ready if front_end.ready is None or on_ready is None else _Ready(front_end.ready, on_ready),
            admits=admits,
            clock=front_end.clock,
        )
        if not front_end.transmits:
            self.gate.transmit(on=False)
        front_end.follow(self.at_rest)
        self.msg_connect(self, "pdus", self.gate, "pdus")
        self.msg_connect(self.gate, "credit", self, "credit")
        last: Any = self.gate
        if front_end.packets is not None:
            last = self._follow(last, front_end.packets)
        elif phy.has_samples:
            whole = None
            if front_end.bursts is not None and self.channel.on_samples().keys() <= BurstChannel.settings:
                whole = None if record or shows else phy.transceiver(front_end.bursts)
            if whole is None:
                self._connect_samples(record, instrumented)
            else:
                self._connect_bursts(whole, instrumented)
            last = self._receiver
        if last is None:
            return
        if self.channel.loses_packets or self._simulated:
            self._loss = PacketLoss(self.channel)
            last = self._follow(last, self._loss)
        self._follow(last, self)

    def counts(self) -> LinkCounts:
        """A snapshot."""
        passed = self.gate.passed
        return LinkCounts(
            passed=passed,
            backlog=self.gate.backlog,
            transmitted=passed if self._transmitter is None else self._transmitter.packets_sent(),
            received=0 if self._loss is None else self._loss.received,
            losses={} if self._loss is None else self._loss.dropped,
        )

    def gate_lateness(self) -> Lateness:
        """Delays of the gate."""
        return self.gate.lateness

    @property
    def changeable(self) -> bool:
        """Whether a channel was built in that can be changed while it runs."""
        return self._loss is not None

    def samples(self) -> Samples | None:
        """Newest samples at the receiver's antenna, after the channel; None without a tap, or if no samples arrived."""
        return None if self._tap is None else self._tap.samples()

    def symbols(self) -> Samples | None:
        """Newest equalised payload symbols; None if there is no tap, or the PHY shows none."""
        return None if self._symbols is None else self._symbols.samples()

    @property
    def snr_db(self) -> float | None:
        """SNR of the newest packets received, dB over the sampled band; None before the first, or if the PHY does not
        measure it."""
        return None if self._receiver is None else self._receiver.snr_db

    def set_snr_db(self, snr_db: float | None) -> None:
        """Set the SNR of the received signal, dB, None = no noise; see :meth:`Channel.set_snr_db`.

        :raises ConfigError: out of range
        :raises PhyError: if no simulated channel was built in
        """
        self._change("snr_db", snr_db, self._faded)

    def set_frequency_offset(self, frequency_offset: float) -> None:
        """Set the carrier frequency offset of the received signal, fraction of the sample rate; likewise."""
        self._change("frequency_offset", frequency_offset, self._faded)

    def set_packet_loss(self, probability: float) -> None:
        """Set the probability that a received packet is dropped; likewise."""
        self._change("packet_loss", probability, self._loss)

    def _change(self, setting: str, value: float | None, part: Any) -> None:
        if part is None:
            raise PhyError(
                f"{setting}: front_end {self.front_end.name} was started without a simulated channel that can change "
                f"it; set channel.{setting} before the start, where the PHY supports it"
            )
        channel = replaced(self.channel, **{setting: value})
        getattr(part, f"set_{setting}")(value)
        self.channel = channel

    def at_rest(self) -> int | None:
        """How many packets the front end gets as samples, of those that have passed; None while one is due."""
        passed = self.gate.at_rest()
        return None if passed is None else passed - self.refused

    def _connect_bursts(self, whole: PacketTransceiver, instrumented: bool) -> None:
        self._transmitter = self._receiver = whole
        if self.channel.on_samples() or self._simulated:
            whole.channel = self._faded = BurstChannel(self.channel, self.phy)
        if instrumented:
            self._tap, self._symbols = whole.tap_samples(_SAMPLES_SHOWN), whole.tap_symbols()
        self._follow(self.gate, whole)

    def _connect_samples(self, record: str, instrumented: bool) -> None:
        """Connect the transmitter to the front end, and the front end to the receiver, where they exist."""
        front_end = self.front_end
        front_end.wire(self)
        if front_end.sink is not None:
            self._transmitter = self.phy.transmitter()
            self.connect(self._follow(self.gate, self._transmitter), front_end.sink)
        if front_end.source is None:
            return
        heard = front_end.source
        # The channel also stops tags.
        if (front_end.loops_back and self.phy.leaves_tags()) or self.channel.on_samples() or self._simulated:
            heard = self._faded = Channel(self.channel, self.phy)
            self.connect(front_end.source, heard)
        receiver = self._receiver = self.phy.receiver()
        self.connect(heard, receiver)
        if instrumented:
            self._tap, self._symbols = Tap(_SAMPLES_SHOWN), receiver.tap_symbols()
            self.connect(heard, self._tap)
        if front_end.clock_offset is not None:
            receiver.follow_clock(front_end.clock_offset)
        if self._shows:
            self.connect(heard, self)
            if isinstance(receiver, BurstSink):
                self.msg_connect(receiver, "points", self, "points")
        if record:
            frequency = front_end.receive_frequency
            about = SigmfRecording(
                self.phy.sample_rate, frequency, f"received by {front_end.name}, phy {self.phy.name}"
            )
            self._recorder = SigmfRecorder(Path(record), about)
            self.connect(heard, self._recorder)

    def _follow(self, packets: Any, block: Any) -> Any:
        """Connect a block's port `pdus` to that of another block; returns the block."""
        self.msg_connect(packets, "pdus", block, "pdus")
        return block

    def close(self) -> None:
        """Release device, sockets, files and memory. The flowgraph must have stopped or never run. Idempotent."""
        # A device is released only with its blocks.
        for hier_block in (self._transmitter, self._receiver, self):
            if hier_block is not None:
                hier_block.release()
        if self._recorder is not None:
            self._recorder.close()
        self.front_end.close()
        self.closing.close()

    def drain(self) -> None:
        """Wait for what GNU Radio still holds of the packets sent, where a front end keeps them. Call this before the
        flowgraph stops."""
        self.front_end.drain(self.gate.passed - self.refused)

    @property
    def transmits(self) -> bool:
        """Whether packets may pass the gate."""
        return self.gate.transmits

    def transmit(self, *, on: bool) -> None:
        """Switch sending off, at once for all packets that have not reached the device, or on again.

        :raises ConfigError: where it only receives
        """
        if on and not self.front_end.transmits:
            raise ConfigError(
                f"front_end {self.front_end.name}: it only receives, and has no open transmitter; start it again with "
                "--transmit, or transmit: true"
            )
        self.gate.transmit(on=on)

    def recorded(self) -> dict[str, int]:
        """Numbers of samples. ``unrecorded``: not in the recording, for example because the disk is full. Empty if
        there is no recording."""
        return {} if self._recorder is None else {"unrecorded": self._recorder.failed}

    def incomplete(self) -> list[str]:
        """What the recording lacks and why, as one line. Empty if nothing is missing, or if there is no recording."""
        return [] if self._recorder is None else self._recorder.incomplete()

    @property
    def refused(self) -> int:
        """Number of PDUs that the transmitter could not take."""
        return 0 if self._transmitter is None else self._transmitter.refused

    @property
    def damaged(self) -> int:
        """Number of received packets that were damaged, as far as the PHY reports it."""
        return 0 if self._receiver is None else self._receiver.damaged

    @property
    def foreign(self) -> int:
        """Number of whole frames received that are not packets of this link, as far as the PHY tells them."""
        return 0 if self._receiver is None else self._receiver.foreign


class _Ready:
    """Whether a device takes packets, which somebody learns whenever it has changed."""

    def __init__(self, ready: Callable[[], bool], changed: Callable[[bool], None]) -> None:
        self._ready, self._changed, self._was = ready, changed, True

    def __call__(self) -> bool:
        ready = self._ready()
        if ready != self._was:
            self._was = ready
            self._changed(ready)
        return ready


class _Listener:
    """s after which to listen again; 0 if the channel is clear. Of two robots that wait for the end of a third one's
    packet, one begins first: the time is random, up to that of a packet.

    :raises ConfigError: for a front end that cannot listen
    """

    def __init__(self, front_end: FrontEnd) -> None:
        if front_end.busy is None:
            raise ConfigError(
                f"airtime.listen_before_send: front_end {front_end.name} measures no power where it sends, with these "
                "settings; take a front end of an SDR with half_duplex: true and one frequency, or leave it out"
            )
        self._busy, self._rng = front_end.busy, random.Random()
        self._most = max(front_end.airtime(), 2 * _LEAST_WAIT_S)

    def __call__(self) -> float:
        return self._rng.uniform(_LEAST_WAIT_S, self._most) if self._busy() else 0.0


def make_radio(
    phy: str,
    packet_len: int,
    sample_rate: float = 0.0,
    front_end: str = "sim",
    phy_options: dict[str, Any] | None = None,
    *,
    channel: Mapping[str, Any] | None = None,
    record: str = "",
    transmit: bool | Auto = AUTO,
    open: bool = False,
    airtime_limit: str | Mapping[str, Any] = "",
    robot_id: int | Auto = AUTO,
    state: str = "",
    shows: bool = False,
    **options: Any,
) -> Radio:
    """Make a radio from the names of its parts, as GRC does.

    :param phy: a name of ``gr_ros2.phy.PHY``
    :param packet_len: bytes on the wire
    :param sample_rate: samples/s; ignored by a PHY without samples
    :param front_end: a name of ``gr_ros2.radio.FRONT_ENDS``
    :param phy_options: further settings of the PHY
    :param channel: settings of :class:`gr_ros2.settings.config.ChannelConfig`, for front ends without a radio. If they
        are given, even empty, they can be changed while the radio runs
    :param record: SigMF recording to write of all samples received, '' = none
    :param transmit: whether it may send: auto = yes, where no radio is connected; a radio needs True
    :param open: a radio also sends packets that no key seals, which anybody can read, forge and replay
    :param airtime_limit: how much it may send: name of a band, or settings of
        :class:`gr_ros2.settings.airtime.AirtimeConfig`; '' = no limit
    :param robot_id: with ``airtime_limit``: the robot whose account this is, as for its link
    :param state: with ``airtime_limit``: that robot's state file, beside which the account is; '' = the usual one
    :param shows: see :class:`Radio`
    :param options: settings of the front end
    :raises ConfigError: for an unknown name or setting, or a value out of range; for a radio that nobody has allowed
        to send
    :raises RadioError: when the front end cannot be opened, or the recording cannot be written
    """
    modem: Phy = PHY.load(phy)(packet_len, sample_rate, **(phy_options or {}))
    impairments = build(ChannelConfig, channel or {}, "channel")
    limits = airtime_from(airtime_limit)
    kind: type[FrontEnd] = FRONT_ENDS.load(front_end)
    sends = permitted(transmit, kind, options)
    check_band(limits, options, modem.sample_rate if modem.has_samples else 0.0)
    with ExitStack() as undo:
        opened = kind(modem, transmits=sends, **options)
        undo.callback(opened.close)
        limit = None
        if sends:
            longest, now = opened.airtime(), opened.clock()
            limit = open_limit(limits, longest, now, robot_id=robot_id, state=state, closing=undo)
        radio = Radio(
            modem,
            opened,
            channel=impairments,
            record=record,
            limit=limit,
            listens=limits.listen_before_send and sends,
            admits=SealedOnly(kind, options) if kind.asks(options) and not open else None,
            changeable=channel is not None,
            shows=shows,
        )
        radio.closing = undo.pop_all()
        return radio
