"""One radio of a link: a PHY with a front end, opened as its settings say, which may vanish and come back.

Invariant: what it has counted before its device vanished is counted on.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import cached_property, partial
from math import inf
from typing import Any

from gr_ros2.core.watch import Watch
from gr_ros2.link.airtime_limit import AirtimeLimit
from gr_ros2.link.bond import Bond
from gr_ros2.radio import FRONT_ENDS
from gr_ros2.radio.config import LinkConfig, OwnRadio
from gr_ros2.radio.front_end import FrontEnd
from gr_ros2.radio.limits import open_limit
from gr_ros2.radio.permission import permitted
from gr_ros2.radio.radio import Radio

_SENT = ("packets", "entries", "payload_bytes", "repeats")
_CAME = ("packets", "repeats", "repaired", "publish_failed")
"""Counters of the two halves of a link that are sums over its endpoints."""
_RETRY_S = 1.0
"""s between two attempts to open a device that has vanished."""


class OneRadio:
    """See the module.

    :param link: the link's configuration, with what all its radios share
    :param own: settings of this radio
    :param number: which radio of the link it is, from 0 on; each has an airtime account of its own
    :param front_end: opens the front end, given the PHY and ``transmits``; None: the one that ``own`` names
    :param instrumented, on_ready: see :class:`Radio`
    :param closing: closes what is opened here
    :raises ConfigError: when the parts do not fit together
    :raises RadioError: when the front end cannot be opened
    :ivar sends: whether it may send at all
    :ivar retry_at: when a device that has vanished is tried again, s; infinite while there is one
    :ivar gone: its device has vanished for good
    :ivar pacing: watches the thread that paces its packets
    """

    def __init__(
        self,
        link: LinkConfig,
        own: OwnRadio,
        number: int = 0,
        *,
        front_end: Callable[..., FrontEnd] | None = None,
        instrumented: bool = False,
        on_ready: Callable[[bool], None] | None = None,
        closing: ExitStack,
    ) -> None:
        self.own, self.name, self._link, self._number = own, own.called, link, number
        self._instrumented, self._on_ready, self._closing = instrumented, on_ready, closing
        self.retry_at, self.gone, self.pacing = inf, False, Watch()
        self._interruptions = self._passed_before = 0
        self._worked = False
        """Whether the front end has worked once; if not, nothing has vanished."""
        self.phy = own.made_phy(link.packet_len)
        self.sends = link.direction != "receive"
        if front_end is None:
            kind: type[FrontEnd] = FRONT_ENDS.load(own.front_end_name)
            guarded = bool(link.key) or link.open
            self.sends = self.sends and permitted(link.transmit, kind, own.front_end_options, guarded=guarded)
            front_end = partial(kind, **own.front_end_options)
        self._make = front_end
        self.open()
        closing.callback(self.close)

    def open(self) -> None:
        """Open the front end, and make the radio around it.

        :raises RadioError: when it cannot be opened
        """
        self.front_end = self._make(self.phy, transmits=self.sends)
        try:
            self.radio = Radio(
                self.phy,
                self.front_end,
                channel=self._link.channel,
                record=self._link.record,
                limit=self._limit,
                listens=self.own.airtime.listen_before_send and self.sends,
                on_ready=self._on_ready,
                instrumented=self._instrumented,
            )
        except BaseException:
            self.front_end.close()
            raise

    def close(self) -> None:
        """Release device, sockets and files. The flowgraph must have stopped."""
        self.radio.close()

    @property
    def open_again(self) -> bool:
        """Whether a device that has vanished can be waited for."""
        return self.front_end.may_return and self._worked

    def check(self, now: float) -> None:
        """Check the device.

        :param now: s, monotonic
        :raises RadioError: when it gives or takes no more samples
        """
        self.front_end.check(now)
        self._worked = True

    def lose(self, now: float) -> None:
        """The device has vanished, and the flowgraph has stopped: close it, and wait for it."""
        self._interruptions += 1
        self._passed_before += self.radio.counts().passed
        self.radio.close()
        self.retry_at = now + _RETRY_S

    def retry(self, now: float) -> None:
        """Open the device again, if it is there.

        :raises RadioError: when it is not
        """
        transmits = self.radio.gate.account()["transmits"]
        self.retry_at = now + _RETRY_S
        self.open()
        self.retry_at = inf
        if not transmits:
            self.radio.transmit(on=False)

    @cached_property
    def _limit(self) -> AirtimeLimit | None:
        """What limits the airtime, with what earlier starts of this robot have sent."""
        if not self.sends:
            return None
        longest, now = self.front_end.airtime(), self.front_end.clock()
        robot, state, closing = self._link.robot_id, self._link.state, self._closing
        return open_limit(
            self.own.airtime, longest, now, robot_id=robot, state=state, radio=self._number, closing=closing
        )

    def stats(self) -> dict[str, Any]:
        """A snapshot: packets to and from the air, the PHY, the counters of the front end, and the airtime."""
        phy, counts, front_end = self.phy, self.radio.counts(), self.front_end.counters()
        vanished = {"interruptions": self._interruptions} if self._interruptions else {}
        return {
            "packets": {
                "out": self._passed_before + counts.passed,
                "backlog": counts.backlog,
                "refused": self.radio.refused,
                "damaged": self.radio.damaged,
                "foreign": self.radio.foreign,
                "dropped": dict(counts.losses),
            },
            "phy": {
                "name": phy.name,
                "sample_rate": phy.sample_rate if phy.has_samples else None,
                "airtime_s": self.front_end.airtime(),
                "snr_db": self.radio.snr_db,
                "rssi_dbm": self.front_end.rssi_dbm,
            },
            "front_end": {
                "name": self.front_end.name,
                "passed": front_end.passed,
                "lost": {**front_end.lost, **vanished, **self.radio.recorded()},
            },
            "airtime": self.radio.gate.account(),
        }


def together(bond: Bond, radios: Sequence[OneRadio], each: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The statistics of several radios as those of one, and of each by itself as ``radios``.

    :param each: what each says
    """
    packets, accounts = ([stats[part] for stats in each] for part in ("packets", "airtime"))
    counted = {name: _sum(packets, name) for name in ("out", "backlog", "refused", "damaged", "foreign")}
    tightest = max(accounts, key=lambda account: account.get("waits_s", -1.0))
    parts = {
        part: {
            f"{radio.name}: {name}": count
            for radio, stats in zip(radios, each, strict=True)
            for name, count in stats["front_end"][part].items()
        }
        for part in ("passed", "lost")
    }
    own = {
        radio.name: {
            **stats,
            "present": bond.present[number],
            "carries": bond.carries[number],
            "apart": number in bond.apart,
            "heard": bond.heard(number),
            **{name: getattr(bond, name)[number] for name in ("sent", "copied", "skipped", "came", "copies")},
        }
        for number, (radio, stats) in enumerate(zip(radios, each, strict=True))
    }
    return {
        "packets": {**counted, "in": packets[0]["in"], "dropped": _merged(packets, "dropped")},
        "phy": each[bond.carries.index(True)]["phy"],
        "front_end": {"name": " and ".join(own), **parts},
        "airtime": {
            **tightest,
            "transmits": any(account["transmits"] for account in accounts),
            "sent_s": _sum(accounts, "sent_s"),
            "refused": _merged(accounts, "refused"),
        },
        "radios": own,
    }


def join_bound(
    halves: dict[str, dict[str, Any]], radios: Mapping[str, Any], names: Sequence[str], bound: Mapping[int, Any]
) -> None:
    """Count what goes over one radio alone too: its packets, topics and services, and of each of several radios what is
    bound to it.

    :param halves: the statistics of both halves of the link, its ``calls``, ``backfill`` and ``wishes``
    :param names: of the radios
    :param bound: what the endpoints that have one radio alone say, by its number
    """
    for number, stats in bound.items():
        source, sink = halves["source"], halves["sink"]
        for part in ("calls", "backfill", "wishes"):
            halves[part] = _added(halves[part], stats[part])
        source["air"] = dict(Counter(source["air"]) + Counter(stats["source"]["air"]))
        for half, counters in (("source", _SENT), ("sink", _CAME)):
            for name in counters:
                halves[half][name] += stats[half][name]
        source["topics"] = {**source["topics"], **stats["source"]["topics"]}
        source["unmatched"] = [*source["unmatched"], *stats["source"]["unmatched"]]
        sink["topics"] = {**sink["topics"], **stats["sink"]["topics"]}
        sink["rejected"] = dict(Counter(sink["rejected"]) + Counter(stats["sink"]["rejected"]))
        sink["dropped"] = dict(Counter(sink["dropped"]) + Counter(stats["sink"]["dropped"]))
        if "radios" in radios:
            topics = stats["source"]["topics"]
            radios["radios"][names[number]]["phy"].update(stats["rate"])
            radios["radios"][names[number]]["bound"] = {
                "topics": sorted(topics),
                "waiting": sum(topic["queued"] for topic in topics.values()),
                "heard": stats["heard"],
                "packets": stats["source"]["packets"],
                "repairs": stats["source"]["air"].get("repair", 0),
            }


def _sum(parts: Sequence[Mapping[str, Any]], name: str) -> Any:
    return sum(part[name] for part in parts)


def _added(one: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """Counters, lists and counters by name, of two parts together; either may be empty."""
    found = {**other, **one}
    for name in one.keys() & other.keys():
        both = one[name], other[name]
        if isinstance(both[0], Mapping):
            found[name] = dict(Counter(both[0]) + Counter(both[1]))
        else:
            found[name] = sorted(both[0] + both[1], key=str) if isinstance(both[0], list) else both[0] + both[1]
    return found


def _merged(parts: Sequence[Mapping[str, Any]], name: str) -> dict[str, int]:
    """Counts by reason, of all parts together."""
    return dict(sum((Counter(part[name]) for part in parts), Counter()))
