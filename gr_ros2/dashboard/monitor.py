"""What all viewers of a dashboard share: the observed run, its newest snapshot, and the settings of its channel.

Invariants: there is one state per run for all viewers. A setting of a viewer acts on the running flowgraph at once, and
all viewers see it. A setting that the link refuses changes nothing, and the reason is shown.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from threading import Lock
from typing import Any

import numpy as np
import numpy.typing as npt

from gr_ros2.core.arrays import Floats
from gr_ros2.core.errors import GrRos2Error
from gr_ros2.dashboard.state import DashboardState
from gr_ros2.dashboard.views import Snapshot
from gr_ros2.dashboard.windows import RATE_S
from gr_ros2.link.events import ReceiverEvent, SenderEvent
from gr_ros2.link.lateness import Lateness
from gr_ros2.observe.observers import Change, LiveLink, LiveRun, Wishes
from gr_ros2.observe.result import RunResult
from gr_ros2.radio.occupancy import Occupancy, busy_words, in_parts
from gr_ros2.settings.config import ChannelConfig

TICK_S = 0.5
"""s between two snapshots."""
_LOOKS = 200
"""Newest looks at the received signal that say where the band is busy: 20 s."""
_NEWEST = 200
"""Late moments that are looked at: more do not fit into the last seconds."""
BINS = 256
_SMOOTHING = 0.25
"""Weight of new samples in the running average."""
_FLOOR = 1e-12


class Spectrum:
    """Averaged power over frequency.

    :param sample_rate: samples/s
    """

    def __init__(self, sample_rate: float) -> None:
        self.frequencies: Floats = np.fft.fftshift(np.fft.fftfreq(BINS, 1 / sample_rate))
        """Hz from the centre, ascending."""
        self._window = np.hanning(BINS)
        self._power: Floats | None = None

    def add(self, samples: npt.NDArray[np.complex64]) -> None:
        """Add consecutive samples, in blocks of ``BINS``. An incomplete block is ignored, and one with a sample that is
        no finite number."""
        blocks = samples[: len(samples) // BINS * BINS].reshape(-1, BINS)
        blocks = blocks[np.isfinite(blocks).all(axis=1)]
        if not len(blocks):
            return
        power = (np.abs(np.fft.fftshift(np.fft.fft(blocks * self._window), axes=1)) ** 2).mean(axis=0)
        self._power = power if self._power is None else self._power + _SMOOTHING * (power - self._power)

    def decibels(self) -> Floats | None:
        """Power of each bin relative to the strongest one, dB; None before the first samples."""
        if self._power is None:
            return None
        decibels: Floats = 10 * np.log10(np.maximum(self._power / max(self._power.max(), _FLOOR), _FLOOR))
        return decibels


@dataclass(frozen=True)
class RadioView:
    """The radio side of a link at one moment.

    :param channel: settings of the channel at that moment, None without a run
    :param transmits: whether every link may send
    :param has_samples: whether the PHY has samples, so that noise and frequency offset can be set
    :param changeable: whether there is a channel that can be changed
    :param backlog: packets between source and antenna
    :param snr_db: SNR of the newest packets received, dB over the sampled band; None if the PHY does not measure it
    :param frequencies: frequency of each power in ``spectrum_db``, Hz; None if there is no signal
    :param symbols: equalised payload symbols, None if the PHY gives none
    :param busy: which frequencies were busy lately, and for which share of the time; '' if that is not known
    """

    channel: ChannelConfig | None = None
    transmits: bool = True
    has_samples: bool = False
    changeable: bool = False
    backlog: int | None = None
    snr_db: float | None = None
    frequencies: Floats | None = None
    spectrum_db: Floats | None = None
    symbols: npt.NDArray[np.complex64] | None = None
    busy: str = ""


@dataclass(frozen=True)
class AskedView:
    """What is asked for from afar.

    :param offers: what each robot that is heard offers, as far as it was asked and has answered
    :param lines: the wishes of this robot, and those of others here, one line each
    """

    offers: Mapping[int, list[dict[str, Any]]]
    lines: tuple[str, ...]


class RunMonitor:
    """A :class:`gr_ros2.observe.observers.RunObserver` that keeps a snapshot for others to draw."""

    name = "dashboard"
    instruments = True

    def __init__(self) -> None:
        self.snapshot = Snapshot()
        self.radio = RadioView()
        self.asked: AskedView | None = None
        """None where nobody can be asked."""
        self.refused = ""
        """Why the last change to the channel was not made; '' if it was."""
        self._run: LiveRun | None = None
        self._state: DashboardState | None = None
        self._spectrum: Spectrum | None = None
        self._occupancy: Occupancy | None = None
        """Of the newest samples; None where they are those of bursts alone."""
        self._newest: npt.NDArray[np.complex64] = np.empty(0, np.complex64)
        self._ticking = Lock()

    # -- the run's side -----------------------------------------------------------------------------------------

    def run_started(self, run: LiveRun) -> None:
        sampled = [link.phy for link in run.links if link.phy.has_samples]  # a run in simulated time has no link
        self._spectrum = Spectrum(sampled[0].sample_rate) if sampled else None
        self._occupancy = Occupancy(_LOOKS) if sampled and run.hears_always else None
        self._state = DashboardState(
            run.registry,
            run.topics,
            run.packet_len,
            name=run.name,
            duration_s=run.duration_s,
            ledger=run.fates,
            tick_s=TICK_S,
            airtime=run.airtime,
            received_as=run.received_as,
            senders=run.heard,
        )
        for src_id, name, topic in run.announced():
            self._state.subscribed(src_id, [(name, topic)])
        self._run = run
        self.refused = ""

    def run_ended(self, result: RunResult | None) -> None:
        if self._state is not None:
            whole = self._run is not None and self._run.fates is not None
            self._state.finish(result, failed=result is None and whole)
            self.tick()
        with self._ticking:
            self._run = None  # its flowgraph may be freed

    def sender_event(self, src_id: int, event: SenderEvent) -> None:
        if self._state is not None:
            self._state.sender_event(src_id, event)

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:
        if self._state is not None:
            self._state.receiver_event(event, now)

    # -- the viewers' side --------------------------------------------------------------------------------------

    def look(self) -> None:
        """Add the newest samples of the received signal to the spectrum."""
        run, spectrum = self._run, self._spectrum
        samples = None if run is None or spectrum is None else run.links[0].samples()
        if spectrum is None or samples is None or np.array_equal(samples, self._newest, equal_nan=True):
            return
        self._newest = samples
        spectrum.add(samples)
        if self._occupancy is not None:
            self._occupancy.add(samples)

    def tick(self) -> Snapshot:
        """Make the next snapshot. Without a run, the last snapshot stays."""
        with self._ticking:
            if self._run is not None and self._state is not None:
                self._tick(self._run, self._state)
        return self.snapshot

    def _busy(self, sample_rate: float) -> str:
        found = None if self._occupancy is None else self._occupancy.found()
        return "" if found is None else busy_words(in_parts(found, sample_rate, 0.0), 1e3, "kHz")

    def _tick(self, run: LiveRun, state: DashboardState) -> None:
        for src_id, source in run.sources.items():
            state.subscribed(src_id, source.subscriptions.named())
        queued = {
            (src_id, topic["topic_id"]): topic["queued"]
            for src_id, source in run.sources.items()
            for topic in source.stats()["topics"].values()
        }
        now, links = run.clock(), run.links
        snr_db = links[0].snr_db if links else None
        late_s = max((_late_s(link.gate_lateness(), now) for link in links), default=0.0)
        snapshot = state.tick(now, queued, snr_db=snr_db, late_s=late_s, told=run.alarms(), clocks=run.clocks())
        if run.wishes is not None:
            told = run.wishes.stats()
            lines = tuple(wish["words"] for wish in (*told["wanted"], *told["wants"]))
            self.asked = AskedView(run.wishes.known(), lines)
        self.snapshot = snapshot if run.team is None else replace(snapshot, team=run.team())
        if not links:
            return
        spectrum = self._spectrum
        counts = [link.counts() for link in run.links]
        self.radio = RadioView(
            channel=run.links[0].channel,
            transmits=all(link.transmits for link in run.links),
            has_samples=run.links[0].phy.has_samples,
            backlog=sum(count.backlog + max(count.passed - count.transmitted, 0) for count in counts),
            snr_db=snr_db,
            changeable=run.links[0].changeable,
            frequencies=None if spectrum is None else spectrum.frequencies,
            spectrum_db=None if spectrum is None else spectrum.decibels(),
            symbols=run.links[0].symbols(),
            busy=self._busy(run.links[0].phy.sample_rate),
        )

    @property
    def channel(self) -> ChannelConfig | None:
        """The current settings of the channel. After a run, its last settings; None before the first run."""
        run = self._run
        return self.radio.channel if run is None or not run.links else run.links[0].channel

    @property
    def wishes(self) -> Wishes | None:
        """What asks other robots; None where nobody can be asked."""
        return None if self._run is None else self._run.wishes

    def set_snr_db(self, snr_db: float | None) -> None:
        """Set the SNR of every link, dB; None = no noise."""
        self._change("channel.snr_db", snr_db, lambda link: link.set_snr_db(snr_db))

    def set_frequency_offset(self, offset: float) -> None:
        """Set the carrier frequency offset of every link, as a fraction of the sample rate."""
        self._change("channel.frequency_offset", offset, lambda link: link.set_frequency_offset(offset))

    def set_packet_loss(self, probability: float) -> None:
        """Set the loss probability of whole packets on every link, 0..1."""
        self._change("channel.packet_loss", probability, lambda link: link.set_packet_loss(probability))

    def transmit(self, on: bool) -> None:
        """Switch sending of every link off, at once, or on again."""
        self._change("transmit", on, lambda link: link.transmit(on=on))

    def _change(self, setting: str, value: float | bool | None, change: Callable[[LiveLink], None]) -> None:
        self.refused = ""
        try:
            run = self._run
            for link in () if run is None else run.links:
                change(link)
            if run is not None and run.links:
                run.changed(Change(run.clock(), setting, value))
                if self._state is not None:
                    self._state.changed(run.clock())
            if run is not None and not run.links:
                self.refused = "a run on simulated time has no channel to change"
        except GrRos2Error as error:
            self.refused = str(error)


def _late_s(lateness: Lateness | None, now: float) -> float:
    """The longest delay in the last seconds, s."""
    moments = [] if lateness is None else lateness.moments[-_NEWEST:]
    return max((happened - due for due, happened in moments if happened > now - RATE_S), default=0.0)
