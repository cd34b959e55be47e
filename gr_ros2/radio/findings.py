"""What a link can say about the other ends: who they are, whether they match, and why nothing is understood.

Invariants: only counters and what other ends have told are read. "Nothing" is said only if the receiver detects
nothing: a signal, bytes or packets that cannot be used are named, with what they usually mean.
"""

from __future__ import annotations

import hashlib
import json
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from gr_ros2 import __version__
from gr_ros2.gr.health import LOCKED
from gr_ros2.gr.live_end import LiveEnd
from gr_ros2.link.endpoint import OpenEndpoint
from gr_ros2.phy import Phy
from gr_ros2.radio.config import LinkConfig, OwnRadio
from gr_ros2.state.keys import read_key_file

_FORMAT = {
    "length": "longer or shorter than packets can be here: set the same packet_len",
    "version": "of another version of the wire format: update gr-ros2 at every end",
    "crc": "damaged, or of a link with another packet_len",
    "entry_bounds": "not readable: set the same packet_len",
    "entry_kind": "not readable: set the same packet_len",
}
_KEYS = ("no_key", "not_sealed", "wrong_key")
_ENERGY = ("energy", "bursts_in")
_NO_PACKETS = ("malformed", "too_long")
_TUNED = re.compile(r"sends at (\S+) Hz, receives at (\S+) Hz")
"""In the text of ``about``."""
_RADIO = re.compile(r"; radio (.+?) ([0-9a-f]{8}) (\d+)(?=;)")
"""There too, for each of several radios: its name, a number for the settings of its PHY, and its packet_len. What is
cut off at the end of a packet tells nothing."""
_SAME_FREQUENCY = 1e-4
"""Relative difference below which two frequencies are the same: clocks may be 100 ppm apart."""


def about(config: LinkConfig, phys: Sequence[Phy], radio: OwnRadio | None = None) -> dict[str, Any]:
    """What this end tells those who ask: ``packet_len``, numbers for settings of the PHY and for the key, a text.

    :param phys: that of each radio
    :param radio: the only one that those have who ask; None: all of the link
    """
    radios = config.own_radios if radio is None else (radio,)
    packet_len = config.packet_len if radio is None else radio.packet_len
    options = [
        {
            "name": phy.name,
            "options": repr(phy.options),
            "rate": phy.sample_rate if phy.has_samples else 0,
            **({} if own.packet_len == packet_len else {"packet_len": own.packet_len}),
        }
        for phy, own in zip(phys, radios, strict=True)
    ]
    digest = zlib.crc32(json.dumps(options, sort_keys=True).encode()) if phys[1:] else _digest(options[0])
    key = int.from_bytes(hashlib.sha256(read_key_file(config.key)[0]).digest()[:4], "big") if config.key else 0
    names = ", ".join(f"{phy.name} {phy.sample_rate:g}" if phy.has_samples else phy.name for phy in phys)
    if phys[1:]:
        for own, told in zip(radios, options, strict=True):
            names += f"; radio {own.called} {_digest(told):08x} {own.packet_len}"
        names += ";"
    front_end = radios[0].front_end_options
    sends = front_end.get("frequency")
    receives = front_end.get("frequency_rx", sends)
    tuned = "" if sends is None or phys[1:] else f", sends at {sends} Hz, receives at {receives} Hz"
    text = f"{__version__} {names}{tuned}"
    return {"packet_len": packet_len, "phy": digest, "key": key, "text": text}


def _digest(options: Mapping[str, Any]) -> int:
    """A number for the settings of a PHY, whatever the length of packets."""
    told = {name: value for name, value in options.items() if name != "packet_len"}
    return zlib.crc32(json.dumps(told, sort_keys=True).encode())


def introduce(
    live: LiveEnd[OpenEndpoint], told: Mapping[str, Any], snr_db: Callable[[], float | None], wall_s: float
) -> None:
    """From now on, tell those who ask what this end is, what time it has, and how well it receives.

    :param wall_s: see :func:`set_wall`; 0 = unknown
    """
    pings = live.endpoint.pings
    pings.introduce(**told)
    pings.snr_db, pings.wall_s = snr_db, wall_s


def peers(live: LiveEnd[OpenEndpoint], now: float) -> list[dict[str, Any]]:
    """The robots that were heard; the one heard last comes first."""
    with live.lock:
        found = live.endpoint.peers(now)
        clocks = {peer.robot: live.endpoint.clock_of(peer.robot, now) for peer in found}
    told = {robot: None if clock is None else clock._asdict() for robot, clock in clocks.items()}
    return [
        {**asdict(peer), "start": f"{peer.start:016x}", "clock": told[peer.robot]}
        for peer in sorted(found, key=lambda peer: peer.heard_s)
    ]


def set_wall(live: LiveEnd[OpenEndpoint], wall_s: float) -> None:
    """From now on this computer's clock is so many s ahead of that of the link."""
    with live.lock:
        if (pings := getattr(live.endpoint, "pings", None)) is not None:  # the paper's robots ask nothing
            pings.wall_s = wall_s


def ping(live: LiveEnd[OpenEndpoint], robot: int, now: float, *, anew: bool = False) -> dict[str, Any]:
    """Ask a robot, and say what has come of all questions to it so far.

    :param anew: forget the earlier ones
    :raises ConfigError: for a number that no robot has
    """
    with live.lock:
        pings = live.endpoint.pings
        told = pings.put(robot, now, anew=anew)
        snrs = {peer.robot: peer.snr_db for peer in live.endpoint.peers(now)}
        live.rouse()
    only = pings.snr_db() if list(snrs) == [robot] else None  # where no other robot's packet may be the newest
    snr_db = only if snrs.get(robot) is None else snrs[robot]
    return {**told, "robot": robot, "heard": sorted(snrs), "snr_here_db": snr_db}


def differences(own: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """What does not match between this end and another one, which has told what it is."""
    found = _radios_differ(own, other)
    if other["key"] != own["key"]:
        found.append(f"key {other['key']:08x} there, {own['key']:08x} here; copy one file to both ends")
    here_hz, there_hz = _TUNED.search(own["text"]), _TUNED.search(other["text"])
    if here_hz is not None and there_hz is not None:
        for sends, receives, sender, receiver in (
            (there_hz[1], here_hz[2], "the other end", "this end"),
            (here_hz[1], there_hz[2], "this end", "the other end"),
        ):
            if abs(float(sends) - float(receives)) > _SAME_FREQUENCY * float(sends):
                found.append(
                    f"{sender} sends at {sends} Hz, and {receiver} receives at {receives} Hz; set frequency there to "
                    "frequency_rx here, and the other way round"
                )
    version = other["text"].partition(" ")[0]
    if version and not __version__.startswith(version):
        found.append(f"gr-ros2 {version} there and {__version__} here")
    return found


_SET = "has other settings there; set the same name, sample_rate and options at both ends"


def _radios_differ(own: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """What does not match between the PHYs and packets of two ends. Of several radios those of one name are compared;
    one that only one of the ends has is not missed. One alone may be any of several."""
    here, there = _radios(own), _radios(other)
    differ = _packets_differ("", other["packet_len"], own["packet_len"])
    if (here is None) == (there is None):
        ours, theirs = here or {}, there or {}
        shared = sorted(ours.keys() & theirs.keys())
        found = [f"phy of radio {name} {_SET}" for name in shared if ours[name][0] != theirs[name][0]]
        found += differ
        for name in shared:
            found += _packets_differ(f"radio {name}: ", theirs[name][1], ours[name][1])
        return found + [f"phy {_SET}"] * (here is None and other["phy"] != own["phy"])
    one, several = (own, there) if here is None else (other, here)
    like = {packet_len for phy, packet_len in (several or {}).values() if phy == one["phy"]}
    if several and not like:
        return [f"no radio has the phy of the other end: phy {_SET}"]
    return differ if several and one["packet_len"] not in like else []


def _packets_differ(where: str, there: int, here: int) -> list[str]:
    return [f"{where}packet_len is {there} there and {here} here; set the same at both ends"] * (there != here)


def _radios(end: Mapping[str, Any]) -> dict[str, tuple[int, int]] | None:
    """Settings of the PHY and packet_len of each of several radios, as far as they are known; None for one alone."""
    text = str(end["text"])
    if "," not in text.partition(", sends at")[0]:
        return None
    return {name: (int(phy, 16), int(packet_len)) for name, phy, packet_len in _RADIO.findall(text)}


OUTRUN = ("superseded", "queue_bound", "stale", "cannot_complete")
"""Reasons to drop a message that did not find its turn."""


def same_id(robot: int, rejected: Mapping[str, int]) -> str | None:
    """One line if another robot sends under this robot's id, which both are told.

    :param rejected: packets that were refused, by kind of error
    """
    if not rejected.get("same_id"):
        return None
    return f"another robot sends as robot {robot}, which is this one; give one of them another number"


def doubled(heard: Sequence[Mapping[str, Any]]) -> list[str]:
    """One line for each robot that is heard or reached over others, and is two.

    :param heard: the robots, as :func:`peers` returns them
    """
    return [
        f"two robots send as robot {peer['robot']}, and what comes out mixes both: give one of them another number "
        "(or a recording of an earlier start of it is on the air)"
        for peer in heard
        if peer["doubled"]
    ]


def unheard(robot: int, heard: Sequence[int]) -> str:
    """One line for a robot that hears others, of which none hears it."""
    named = ", ".join(str(other) for other in heard)
    return (
        f"nobody hears robot {robot}: it hears robot {named}, and none of them names it; is its transmitter on, and "
        "strong enough?"
    )


def outrun(before: Mapping[str, int], topics: Mapping[str, Any]) -> tuple[str | None, dict[str, int]]:
    """One line with the topics that grow old because the channel carries less than they offer, and what to compare with
    at the next look.

    :param before: messages of each topic that did not find their turn, at the look before
    :param topics: counters of the source, by topic
    """
    now = {
        name: sum(topic["refused"].get(reason, 0) for reason in OUTRUN)
        for name, topic in topics.items()
        if not topic["frames"]  # pictures are left out on purpose
    }
    old = sorted(name for name, count in now.items() if count > before.get(name, 0))
    if not old:
        return None, now
    return (
        f"the channel is fuller than it can carry: {', '.join(old)} grow old, since messages are replaced or dropped "
        "before their turn; send less (max_rate, topics), or raise phy.sample_rate"
    ), now


def heard_nobody(stats: Mapping[str, Any]) -> list[str]:
    """Why no other robot is heard, from the counters of the receiver: one line for each sign, nearest first."""
    found = []
    for reason, count in stats["sink"]["rejected"].items():
        meaning = LOCKED.get(reason) or _FORMAT.get(reason, reason)
        meaning += "; copy one key file to both ends" if reason in _KEYS else ""
        found.append(f"{count} packets refused: {meaning}")
    early = stats["sink"]["dropped"].get("early", 0)
    if early:
        found.append(
            f"{early} packets wait for a hello, which says how to open them, or for the proof that the other end hears "
            "this one"
        )
    if damaged := stats["packets"]["damaged"]:
        found.append(
            f"{damaged} bursts found, with errors: too weak, overlapped, or of another phy, options or packet_len"
        )
    counters = _counters(stats)
    no_packets = sum(counters.get(name, 0) for name in _NO_PACKETS)
    if no_packets:
        found.append(f"{no_packets} frames that are no packets: another baud rate, framing or packet_len")
    if foreign := stats["packets"]["foreign"] + counters.get("foreign", 0):
        found.append(f"{foreign} frames of others: another network, callsign or address")
    energy = signals(stats)
    if energy and not found:
        found.append(
            f"a signal was there {energy} times, and no packet in it: the other end has another phy, sample_rate or "
            "options, or it is somebody else"
        )
    if wrong := counters.get("wrong_rate", 0):
        found.append(f"{wrong} bursts at another sample rate: set the same phy.sample_rate at both ends")
    return found or [
        "nothing: no signal and no bytes. Is the other end switched on, and are frequency and cable right?"
    ]


def signals(stats: Mapping[str, Any]) -> int:
    """How often the front end had a signal, whatever it was."""
    return sum(_counters(stats).get(name, 0) for name in _ENERGY)


def _counters(stats: Mapping[str, Any]) -> dict[str, int]:
    return {**stats["front_end"]["passed"], **stats["front_end"]["lost"]}


def compared(config: LinkConfig, other: LinkConfig) -> list[str]:
    """What does not match between the settings of this end and those of another one, which need not be heard."""
    described = [about(each, [own.made_phy(each.packet_len) for own in each.own_radios]) for each in (config, other)]
    found = differences(*described)
    if config.robot_id == other.robot_id:
        found.append(f"both are robot {config.robot_id}; set another robot at one")
    return found


def in_words(peer: Mapping[str, Any]) -> str:
    """The figures of a peer that was asked, in words."""
    times, parts = peer["round_trip_s"], []
    if times["p50"] is not None:
        parts.append(f"round trip {times['p50'] * 1e3:.0f} ms (p99 {times['p99'] * 1e3:.0f} ms)")
    if peer["lost_there"] is not None:
        parts.append(f"{peer['answered']} of {peer['asked']} answered")
        parts.append(f"lost {peer['lost_there']} there, {peer['lost_back']} back")
    else:
        parts.append(f"{peer['asked']} asked, none answered")
        if (heard := peer.get("heard")) is not None and peer["robot"] not in heard:
            parts.append("it is not heard" + (f", heard are {', '.join(map(str, heard))}" if heard else ""))
    snrs = [("here", peer["snr_here_db"]), ("there", peer["snr_there_db"])]
    if any(snr is not None for _, snr in snrs):
        parts.append("SNR " + ", ".join(f"{snr:.1f} dB {where}" for where, snr in snrs if snr is not None))
    if "mcs" in peer:
        parts.append(f"rate {peer['mcs']}")
    if peer["clock_s"] is not None:
        ahead = "ahead of" if peer["clock_s"] >= 0 else "behind"
        error = f"± {peer['clock_error_s'] * 1e3:.1f} ms"
        parts.append(f"its clock is {abs(peer['clock_s']) * 1e3:.1f} ms {ahead} this one ({error})")
    return "; ".join(parts)
