"""The `ofdm` PHY: the frames of GNU Radio's OFDM blocks, sent and received by this package's modem or by those blocks.

Invariant: both implementations send the same samples for the same packet, except for the number in the header. They
take the same time, except for the gap. This does not hold for packets whose CRC-32 does not fit the stock header. Our
frames are only as long as needed unless ``lengths`` is ``fixed``; the stock receiver understands them as well.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from gr_ros2.core.errors import ConfigError
from gr_ros2.link.rate import Mcs
from gr_ros2.phy.base import BurstCarrier, PacketReceiver, PacketTransceiver, PacketTransmitter, Phy
from gr_ros2.phy.burst_blocks import STOCK, BurstOptions, BurstPhy
from gr_ros2.phy.ofdm_layout import CRC_LEN, OfdmLayout, point_power
from gr_ros2.phy.ofdm_modem import AdaptiveOfdmModem, OfdmModem
from gr_ros2.phy.theory import coded_success, half_point, packet_success, psk_symbol_error, qam_symbol_error
from gr_ros2.settings.fields import AUTO, Auto

if TYPE_CHECKING:
    from gr_ros2.phy.ofdm_stock import StockFrame

RateName = Literal["bpsk-cc", "qpsk-cc", "8psk-cc", "16qam-cc", "64qam-cc", "16qam", "64qam"]
RATES: dict[str, tuple[str, str, float]] = {
    "bpsk-cc": ("bpsk", "cc", 2.4),
    "qpsk-cc": ("qpsk", "cc", 2.4),
    "8psk-cc": ("8psk", "cc", 3.1),
    "16qam-cc": ("16qam", "cc", 3.0),
    "64qam-cc": ("64qam", "cc", 3.4),
    "16qam": ("16qam", "none", 0.1),
    "64qam": ("64qam", "none", 0.3),
}
"""Payload modulation and code of each MCS, the most robust one first; and how many dB more it needs for half of its
packets than ``computed_pdr`` says, as measured for packets of 220 B. For the code that is a bound."""
_WIDTH_DB = {"cc": 0.4, "none": 0.5}


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class OfdmOptions(BurstOptions):
    """Settings of this PHY beside packet length and sample rate, and those of every burst PHY."""

    payload_modulation: Literal["bpsk", "qpsk", "8psk", "16qam", "64qam"] = "bpsk"
    """of the payload symbols; preamble and header are BPSK always"""
    fft_len: Annotated[Literal[64, 128, 256, 512], Field(title="FFT length (carriers)")] = 64
    """carriers, used or not; about 13 of 16 are used"""
    cp_len: Annotated[int, Field(ge=16, le=256, title="Cyclic prefix (samples)")] | Auto = AUTO
    """samples of the cyclic prefix, a quarter to a half of `fft_len`; auto = a quarter"""
    carriers: Annotated[int, Field(ge=17, le=255, title="Carriers to either side")] | Auto = AUTO
    """how far either side of the middle carrier data and pilots go, below half of `fft_len`; auto = 26 of 64"""
    pilots: Annotated[tuple[int, ...] | Auto, Field(title="Pilot carriers")] = AUTO
    """carriers by which phase is followed; auto = (-21, -7, 7, 21), spread over a larger `fft_len`"""
    scramble: Annotated[bool, Field(title="Scrambling")] = False
    """scramble header and payload bits, against high peaks where data has many zeros"""
    detection_threshold: Annotated[float, Field(ge=0.05, le=0.95)] | Literal["stock"] | Auto = AUTO
    """of the preamble's metric (Schmidl and Cox), 0.05..0.95; auto = what noise passes once in 1000 samples, ``stock``
    = GNU Radio's own blocks and their 0.9, which need 5 to 7 dB more SNR"""
    rate: Literal["fixed", "adaptive"] = "fixed"
    """`adaptive` = the sender chooses modulation and code of each packet by what receivers report, instead of
    `payload_modulation` and `fec`. The same at both ends"""
    rates: Annotated[tuple[RateName, ...], Field(min_length=1)] | Auto = AUTO
    """what `adaptive` may choose from, the most robust first; auto = bpsk-cc, qpsk-cc, 8psk-cc, 16qam-cc, 64qam-cc,
    16qam, 64qam"""


class OfdmPhy(BurstPhy):
    """OFDM, for channels with echoes: by default FFT 64, cyclic prefix 16, 48 data carriers, BPSK, CRC-32 per frame.

    Carrier offset up to four carriers, clocks within 300 ppm, and a movement in air of 1 m/s.

    :param options: see :class:`OfdmOptions`
    :raises ConfigError: for an option that is unknown or out of range
    """

    name = "ofdm"
    Options = OfdmOptions

    def __init__(self, packet_len: int, sample_rate: float, **options: Any) -> None:
        super().__init__(packet_len, sample_rate, **options)
        chosen: OfdmOptions = self.options
        fft_len = chosen.fft_len
        cp_len = fft_len // 4 if chosen.cp_len == AUTO else chosen.cp_len
        if not fft_len <= 4 * cp_len <= 2 * fft_len:
            raise ConfigError(
                f"phy ofdm: cp_len = {cp_len}: {fft_len // 4} to {fft_len // 2} samples with fft_len = {fft_len}"
            )
        edge = None if chosen.carriers == AUTO else chosen.carriers
        pilots = None if chosen.pilots == AUTO else chosen.pilots
        self._rates = self._adaptive(options) if chosen.rate == "adaptive" else ()
        self.layout = OfdmLayout(fft_len, cp_len, chosen.payload_modulation, chosen.scramble, edge, pilots)
        self._stock: StockFrame | None = None
        threshold = chosen.detection_threshold
        if threshold == "stock":
            self._stock = self._checked_stock()
            self.gap = self._stock.gap
        elif self._rates:
            self.layout = self._rates[0].layout
            self.modem: OfdmModem = AdaptiveOfdmModem([phy.modem_of(mcs) for mcs, phy in enumerate(self._rates)])
        else:
            self.modem = self.modem_of(None)

    def modem_of(self, mcs: int | None) -> OfdmModem:
        """The modem of our own receiver.

        :param mcs: number that the header carries, see :class:`OfdmModem`
        """
        layout, threshold = self.layout, self.options.detection_threshold
        mask = layout.mask(self.packet_len + layout.fill(self.packet_len) + CRC_LEN)
        bits = layout.bits_per_carrier
        carriers = bits * len(layout.data[0]), bits
        frames = self.frames(order="little", multiple=layout.multiple, mask=mask, mcs=mcs, carriers=carriers)
        return OfdmModem(frames, layout, None if threshold == AUTO else threshold, mcs)

    def _adaptive(self, options: dict[str, Any]) -> tuple[OfdmPhy, ...]:
        chosen, default = self.options, OfdmOptions()
        for name in ("payload_modulation", "fec", "detection_threshold"):
            value = getattr(chosen, name)
            if value != getattr(default, name) and (name != "detection_threshold" or value == "stock"):
                raise ConfigError(
                    f"phy ofdm: {name} = {value!r} with rate: adaptive, which chooses modulation and code for our own "
                    "receiver; leave it out, or set rate to fixed"
                )
        if chosen.lengths == "fixed":
            raise ConfigError(
                "phy ofdm: lengths = 'fixed' with rate: adaptive, whose bursts differ in length; leave lengths out, or "
                "set rate to fixed"
            )
        names = self._names()
        if list(names) != [name for name in RATES if name in names]:
            raise ConfigError(f"phy ofdm: rates = {names}: each once, the most robust one first: {', '.join(RATES)}")
        fixed = {**options, "rate": "fixed", "rates": AUTO}
        made = (dict(zip(("payload_modulation", "fec"), RATES[name][:2], strict=True)) for name in names)
        return tuple(OfdmPhy(self.packet_len, self.sample_rate, **{**fixed, **mcs}) for mcs in made)

    def pad_all(self) -> None:
        if self._rates:
            raise ConfigError(
                "phy ofdm: rate = 'adaptive' sends bursts of different lengths, and this front end needs them all of "
                "one length; set rate to fixed, or choose another front end"
            )
        super().pad_all()

    def _names(self) -> tuple[str, ...]:
        chosen: OfdmOptions = self.options
        return tuple(RATES) if chosen.rates == AUTO else chosen.rates

    @property
    def mcs_table(self) -> tuple[Mcs, ...]:
        table = []
        for name, phy in zip(self._names(), self._rates, strict=False):
            _, fec, loss_db = RATES[name]
            table.append(Mcs(name, phy.airtime(), half_point(phy.computed_pdr) + loss_db, _WIDTH_DB[fec]))
        return tuple(table)

    @property
    def rates(self) -> tuple[Phy, ...]:
        return self._rates or (self,)

    def _checked_stock(self) -> StockFrame:
        from gr_ros2.phy.ofdm_stock import StockFrame  # here, as below: 14 MB that only `stock` needs

        chosen, symbol = self.options, self.layout.symbol_samples
        if chosen.fec != "none":
            raise ConfigError(
                f"phy ofdm: fec = {chosen.fec!r}: the stock receiver gives no soft bits; leave detection_threshold out"
            )
        least = symbol + self.layout.fft_len // 2
        gap = 2 * symbol if chosen.gap == AUTO else chosen.gap
        if gap < least:
            raise ConfigError(f"phy ofdm: gap = {gap}: below {least} the last packet stays in the stock receiver")
        return StockFrame(self.layout, self.packet_len, gap)

    def frame_bits(self) -> int:
        """Payload bits of the longest frame, CRC-32, filling and coding included."""
        return self.modem.frames.bits(self.packet_len) if self._stock is None else self._stock.bits

    @property
    def any_length(self) -> bool:
        return self._stock is None and super().any_length

    def airtime_samples(self, packet_len: int | None = None) -> int:
        return super().airtime_samples(packet_len) if self._stock is None else self._stock.airtime_samples

    def burst_power(self) -> float:
        return self.layout.power(self.frame_bits())

    def computed_pdr(self, snr_db: float) -> float:
        if self._rates:
            return self._rates[0].computed_pdr(snr_db)
        noise = self.burst_power() / 10 ** (snr_db / 10)
        snr = point_power(self.options.payload_modulation) * self.options.fft_len / noise
        if self._stock is None and self.modem.frames.coded:
            bits = self.modem.frames.data_bits(self.packet_len)
            return coded_success(self.modem.constellation.points, snr, bits, self.frame_bits())
        order = 1 << self.layout.bits_per_carrier
        error = psk_symbol_error(order, snr) if order <= 8 else qam_symbol_error(order, snr)
        return packet_success(error, self.frame_bits() // self.layout.bits_per_carrier)

    def runs_on(self) -> str:
        return super().runs_on() if self._stock is None else STOCK

    def leaves_tags(self) -> bool:
        return self._stock is not None

    def prefer_latency(self) -> None:
        if self._stock is not None:
            from gr_ros2.phy.ofdm_stock import idle_spinning_threads

            idle_spinning_threads()

    def transmitter(self) -> PacketTransmitter:
        if self._stock is None:
            return super().transmitter()
        from gr_ros2.phy.ofdm_stock import StockTransmitter

        return StockTransmitter(self._stock)

    def receiver(self) -> PacketReceiver:
        if self._stock is None:
            return super().receiver()
        from gr_ros2.phy.ofdm_stock import StockReceiver

        return StockReceiver(self._stock)

    def transceiver(self, carrier: BurstCarrier) -> PacketTransceiver | None:
        return super().transceiver(carrier) if self._stock is None else None
