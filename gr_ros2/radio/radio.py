"""PHY and front end as one GNU Radio block: packets to the air and back.

Laws: packets leave at the pace of the air, and each credit asks for one just before it is due; the two directions share
nothing but the front end, so that one cannot hold up the other; what is received can be impaired and looked at only
where no real channel does it already.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from gnuradio import gr

from gr_ros2.config import ChannelConfig, replaced
from gr_ros2.errors import ConfigError, RadioError
from gr_ros2.phy import PHY, Phy
from gr_ros2.phy.airtime import AirtimeGate
from gr_ros2.phy.channel import Channel, PacketLoss
from gr_ros2.phy.loopback import TAP_SIZE, LinkCounts
from gr_ros2.phy.tap import Samples, Tap
from gr_ros2.radio import FRONT_ENDS
from gr_ros2.radio.front_end import FrontEnd
from gr_ros2.radio.sigmf import Recording, SigmfRecorder


class Radio(gr.hier_block2):  # type: ignore[misc]
    """Message ports `pdus` in, `pdus` out and `credit` out (one message: one more packet may come).

    :param phy: makes samples of packets
    :param front_end: carries the samples; closed with this
    :param channel: impairments of what is received, for front ends without a radio
    :param record: SigMF recording to write of all samples received, '' = none
    :param instrumented: build in what a person at a dashboard uses: a channel that can be changed, and taps for
        spectrum and constellation
    :raises ConfigError: for a channel that this PHY or front end cannot have
    :raises RadioError: when the recording cannot be written
    """

    def __init__(
        self,
        phy: Phy,
        front_end: FrontEnd,
        *,
        channel: ChannelConfig | None = None,
        record: str = "",
        instrumented: bool = False,
    ) -> None:
        super().__init__("gr_ros2_radio", gr.io_signature(0, 0, 0), gr.io_signature(0, 0, 0))
        for register in (self.message_port_register_hier_in, self.message_port_register_hier_out):
            register("pdus")
        self.message_port_register_hier_out("credit")
        self.phy, self.front_end = phy, front_end
        self.channel = ChannelConfig() if channel is None else channel
        phy.check_channel(self.channel)
        if front_end.has_radio and self.channel != ChannelConfig():
            raise ConfigError(f"channel: front_end {front_end.name} has a real one; leave channel out")
        self._instrumented = instrumented
        self._transmitter: Any = None
        self._receiver: Any = None
        self._faded: Channel | None = None
        self._tap: Tap | None = None
        self._symbols: Tap | None = None
        self._recorder: SigmfRecorder | None = None
        impaired = self.channel.loses_packets or (instrumented and not front_end.has_radio)
        self._loss = PacketLoss(self.channel) if impaired else None
        self._gate = AirtimeGate(front_end.airtime(), early=front_end.early())
        self.msg_connect((self, "pdus"), (self._gate, "pdus"))
        self.msg_connect((self._gate, "credit"), (self, "credit"))
        last: Any = self._gate
        if phy.has_samples:
            last = self._connect_samples(record)
        if last is not None and self._loss is not None:
            self.msg_connect((last, "pdus"), (self._loss, "pdus"))
            last = self._loss
        if last is not None:
            self.msg_connect((last, "pdus"), (self, "pdus"))

    def _connect_samples(self, record: str) -> Any:
        """Transmitter to front end, front end to receiver; the receiver, None where nothing is received."""
        front_end = self.front_end
        front_end.wire(self)
        if front_end.sink is not None:
            self._transmitter = self.phy.transmitter()
            self.msg_connect((self._gate, "pdus"), (self._transmitter, "pdus"))
            self.connect(self._transmitter, front_end.sink)
        if front_end.source is None:
            return None
        self._receiver = self.phy.receiver()
        last = front_end.source
        # The channel stops tags too: the transmitter's would overrule what the receiver reads in a packet's header.
        if front_end.loops_back or self.channel.on_samples() or (self._instrumented and not front_end.has_radio):
            self._faded = Channel(self.channel, self.phy)
            self.connect(last, self._faded)
            last = self._faded
        self.connect(last, self._receiver)
        if record:
            frequency = getattr(front_end.options, "receive_frequency", None)
            about = Recording(self.phy.sample_rate, frequency, f"received by {front_end.name}, phy {self.phy.name}")
            self._recorder = SigmfRecorder(Path(record), about)
            self.connect(last, self._recorder)
        if self._instrumented:
            self._tap = Tap(TAP_SIZE)
            self.connect(last, self._tap)
            self._symbols = self._receiver.tap_symbols() if hasattr(self._receiver, "tap_symbols") else None
        return self._receiver

    def close(self) -> None:
        """Give back device, sockets, files and memory. The flowgraph has stopped, or never ran. Idempotent."""
        # A hier block with message ports holds itself, and shared memory segments of which the system has few.
        # And a device is let go with its blocks only.
        for hier_block in (self._transmitter, self._receiver, self):
            if hier_block is not None:
                hier_block.disconnect_all()
        if self._recorder is not None:
            self._recorder.close()
        self.front_end.close()

    def counts(self) -> LinkCounts:
        """A snapshot; ``received`` are packets that came whole."""
        passed = self._gate.passed
        return LinkCounts(
            passed=passed,
            backlog=self._gate.backlog,
            transmitted=passed if self._transmitter is None else self._transmitter.packets_sent(),
            received=0 if self._loss is None else self._loss.received,
            losses={} if self._loss is None else dict(self._loss.dropped),
        )

    @property
    def refused(self) -> int:
        """PDUs the transmitter could not take."""
        return int(getattr(self._transmitter, "refused", 0))

    @property
    def damaged(self) -> int:
        """Packets heard that were not whole, as far as the PHY tells."""
        return int(getattr(self._receiver, "damaged", 0))

    def samples(self) -> Samples | None:
        """Newest samples received; None where there is no tap or nothing came."""
        return None if self._tap is None else self._tap.samples()

    def symbols(self) -> Samples | None:
        """Newest equalised payload symbols, of an instrumented radio whose PHY shows them; otherwise None."""
        return None if self._symbols is None else self._symbols.samples()

    def set_snr_db(self, snr_db: float | None) -> None:
        """Noise on what is received, dB, None = none.

        :raises RadioError: where a real channel does that
        """
        self._changeable("snr_db", self._faded).set_snr_db(snr_db)
        self.channel = replace(self.channel, snr_db=snr_db)

    def set_frequency_offset(self, frequency_offset: float) -> None:
        """Carrier frequency offset of what is received, fraction of the sample rate.

        :raises RadioError: where a real channel does that
        """
        self._changeable("frequency_offset", self._faded).set_frequency_offset(frequency_offset)
        self.channel = replace(self.channel, frequency_offset=frequency_offset)

    def set_packet_loss(self, probability: float) -> None:
        """Probability that a packet received is dropped.

        :raises ConfigError: out of range
        :raises RadioError: where a real channel does that
        """
        loss = self._changeable("packet_loss", self._loss)
        self.channel = replaced(self.channel, packet_loss=probability)
        loss.set_packet_loss(probability)

    def _changeable(self, setting: str, block: Any) -> Any:
        if block is None:
            raise RadioError(f"{setting}: front_end {self.front_end.name} has no simulated channel to change")
        return block


def make_radio(
    phy: str,
    packet_len: int,
    sample_rate: float,
    front_end: str,
    phy_options: dict[str, Any] | None = None,
    **options: Any,
) -> Radio:
    """A radio by the names of its parts, as GRC makes it.

    :param phy: a name of ``gr_ros2.phy.PHY``
    :param packet_len: bytes on the wire
    :param sample_rate: samples/s
    :param front_end: a name of ``gr_ros2.radio.FRONT_ENDS``
    :param phy_options: settings of the PHY beside these
    :param options: settings of the front end
    :raises ConfigError: for an unknown name or setting, or a value out of range
    :raises RadioError: when the front end cannot be opened
    """
    modem: Phy = PHY.load(phy)(packet_len, sample_rate, **(phy_options or {}))
    return Radio(modem, FRONT_ENDS.load(front_end)(modem, **options))
