"""Numbers and packets as HTML.

Invariants: every text that comes from outside is escaped. A number that does not apply is a dash. The attribute
``data-value`` holds the exact value beside the rounded one.
"""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from typing import get_args

from gr_ros2.dashboard.packets import NO_COLOUR
from gr_ros2.dashboard.views import PacketView, Snapshot, SpanView, TopicView
from gr_ros2.link.events import AirKind
from gr_ros2.link.fates import Fate, fate_order
from gr_ros2.observe.colours import COLOURS, fate_colour, ink_on
from gr_ros2.observe.team import PairView
from gr_ros2.wire import BROADCAST, QOS_NAMES

Number = float | int | None

_GREY = "#9aa5b1"
_PHASES = {"waiting": "waiting for messages", "running": "live", "ended": "ended", "failed": "failed"}
_STATES = {"up": "live", "degraded": "live · degraded", "down": "live · link down", "late": "live · computer late"}


def colour(place: int) -> str:
    """Colour of the topic at this place of the palette."""
    return _GREY if place == NO_COLOUR else COLOURS[place % len(COLOURS)]


def tiles_html(snapshot: Snapshot) -> str:
    """The top line: is it up, what is lost, what is old, what is the air used for."""
    time = f"{snapshot.elapsed_s:.1f} s" + (f" of {snapshot.duration_s:g} s" if snapshot.duration_s else "")
    phase, received = state_text(snapshot), "old" if snapshot.old else ""
    oldest, busy = snapshot.oldest, snapshot.busy_now
    age = None if oldest is None else oldest.age_now_s
    tiles = [
        _tile("phase", phase, snapshot.name or "no run", css=f"phase {snapshot.phase} {snapshot.verdict}"),
        _tile("elapsed", time, "time"),
        _number("pdr", snapshot.pdr, "{:.3f}", "delivered / sent", f"main {snapshot.delivery}"),
        _number("lost", snapshot.lost_now, "{:.1%}", "packets lost on the way, last 5 s", received),
        _number("oldest", age, "{:.2f} s", "age" if oldest is None else f"age of {oldest.name}, the oldest"),
        _number("busy", busy, "{:.1%}", "of the air used"),
    ]
    return f'<div class="tiles">{"".join(tiles)}</div>'


def counters_html(snapshot: Snapshot, backlog: int | None, snr_db: float | None) -> str:
    """All other counters.

    :param backlog: packets between source and antenna
    :param snr_db: SNR of the received packets, dB
    """
    sent_now, received_now = snapshot.packets_now
    sent, received = (f"{snapshot.packets.get(name, 0):,} in all" for name in ("sent", "received"))
    refused = sum(count for name, count in snapshot.packets.items() if name.startswith("rejected_"))
    ago, old = (f", {snapshot.silent_s:.0f} s ago", "old") if snapshot.old else ("", "")
    tiles = [
        _number("sent", snapshot.sent, "{:,}", "messages sent"),
        _number("delivered", snapshot.delivered, "{:,}", "delivered"),
        _number("packets_sent", sent_now, "{:.0f}/s", f"packets out, {sent}"),
        _number("packets_received", received_now, "{:.0f}/s", f"packets in, {received}"),
        _number("refused", refused, "{:,}", "packets refused"),
        _number("backlog", backlog, "{:,}", "packets queued in the PHY"),
        _number("snr", snr_db, "{:.1f} dB", f"SNR received{ago}", old),
    ]
    return f'<div class="tiles">{"".join([*tiles, *_repair_tiles(snapshot)])}</div>'


def state_text(snapshot: Snapshot) -> str:
    """The state of the run or link in words."""
    return _STATES.get(snapshot.state, _PHASES[snapshot.phase])


def alarms_html(snapshot: Snapshot) -> str:
    """What is wrong now."""
    lines = "".join(f"<li>{escape(alarm)}</li>" for alarm in snapshot.alarms)
    return f"<ul class=alarms>{lines}</ul>" if lines else ""


def heard_html(snapshot: Snapshot) -> str:
    """The robots heard, and when last."""
    if not snapshot.heard:
        return '<div class="note">no robot has been heard yet</div>'
    told = [
        (robot, way_text(robot.hops, robot.over), "" if robot.clock is None else robot.clock.words)
        for robot in snapshot.heard
    ]
    ways, clocks = any(way for _, way, _ in told), any(clock for *_, clock in told)  # empty columns take width alone
    rows = "".join(
        f'<tr data-robot="{robot.src_id}"><th scope="row" class="name">robot {robot.src_id}</th>'
        f'<td data-field="silent">{robot.silent_s:.1f}</td><td data-field="packets">{robot.packets:,}</td>'
        + f'<td data-field="way">{way}</td>' * ways
        + f'<td data-field="clock">{clock}</td>' * clocks
        + "</tr>"
        for robot, way, clock in told
    )
    return (
        '<table class="heard"><thead><tr><th scope="col" class="name">robot</th><th scope="col">heard [s ago]</th>'
        '<th scope="col">packets</th>'
        + '<th scope="col">messages come</th>' * ways
        + '<th scope="col">its clock is ahead</th>' * clocks
        + f"</tr></thead><tbody>{rows}</tbody></table>"
    )


def team_html(snapshot: Snapshot) -> str:
    """Who hears whom: share of the packets of the last seconds, and SNR; or over whom the other's messages come."""
    team = snapshot.team
    if team is None:
        return ""
    head = "".join(f'<th scope="col">of robot {other}</th>' for other in team.robots)
    rows = ""
    for one in team.robots:
        cells = "".join(
            f'<td data-pair="{one} {other}">{_hears(team.pairs.get((one, other)))}</td>' for other in team.robots
        )
        rows += f'<tr><th scope="row" class="name">robot {one} hears</th>{cells}</tr>'
    return f'<table class="heard"><thead><tr><th scope="col"></th>{head}</tr></thead><tbody>{rows}</tbody></table>'


def _hears(pair: PairView | None) -> str:
    if pair is None or (pair.share is None and not pair.hops):
        return "–"
    if pair.hops and not pair.share:
        return way_text(pair.hops, pair.over)
    return f"{pair.share:.0%}" + ("" if pair.snr_db is None else f", {pair.snr_db:.0f} dB")


def way_text(hops: int, over: int | None) -> str:
    """How messages of a robot come: ``over 3, hop 2``, '' from the robot itself."""
    return f"over {over}, hop {hops}" if hops else ""


def _repair_tiles(snapshot: Snapshot) -> list[str]:
    """What repair did, and what the packets sent were for; [] on a link that repairs nothing."""
    air = {kind: snapshot.packets[f"air_{kind}"] for kind in get_args(AirKind) if f"air_{kind}" in snapshot.packets}
    if not air:
        return []
    total = sum(air.values())
    return [
        _number("repaired", snapshot.in_fate(Fate.REPAIRED), "{:,}", "delivered after repair"),
        _number("given_up", snapshot.in_fate(Fate.GIVEN_UP), "{:,}", "given up"),
        *(_number(f"air_{kind}", n / total, "{:.0%}", f"of packets out: {kind}") for kind, n in air.items()),
    ]


def _tile(name: str, text: str, label: str, value: Number = None, css: str = "") -> str:
    data = "" if value is None else f' data-value="{value!r}"'
    return f'<div class="tile {css}"><b data-field="{name}"{data}>{escape(text)}</b><span>{escape(label)}</span></div>'


def _number(name: str, value: Number, form: str, label: str, css: str = "") -> str:
    """A tile with a number, in a format of :meth:`str.format`."""
    return _tile(name, _text(value, form.format), label, value, css)


def _text(value: Number, write: Callable[[float], str]) -> str:
    return "–" if value is None else write(value)


def _ms(value: float) -> str:
    return f"{value * 1000:,.1f}" if abs(value) < 10 else f"{value * 1000:,.0f}"


_Column = tuple[str, str, Callable[[TopicView], Number], Callable[[float], str]]
_COUNT, _RATIO, _S, _METRES = "{:,.0f}".format, "{:.3f}".format, "{:.2f}".format, "{:.3f} m".format


def _latency(name: str) -> Callable[[TopicView], Number]:
    def read(topic: TopicView) -> Number:
        value: Number = getattr(topic.latency_s, name, None)
        return value

    return read


_GROUPS: tuple[tuple[str, tuple[_Column, ...]], ...] = (
    (
        "messages",
        (
            ("sent", "sent", lambda topic: topic.sent if topic.goes else None, _COUNT),
            ("delivered", "delivered", lambda topic: topic.delivered if topic.comes else None, _COUNT),
        ),
    ),
    (
        "PDR",
        (
            ("pdr", "all", lambda topic: topic.pdr, _RATIO),
            ("pdr_now", "last 5 s", lambda topic: topic.pdr_now, _RATIO),
        ),
    ),
    ("goodput", (("goodput_Bps", "B/s", lambda topic: topic.goodput_Bps if topic.comes else None, _COUNT),)),
    ("latency [ms]", tuple((f"latency_{q}", q, _latency(q), _ms) for q in ("p50", "p95", "p99", "max"))),
    (
        "age [s]",
        (
            ("age_now", "now", lambda topic: topic.age_now_s, _S),
            ("age_mean", "mean", lambda topic: topic.age_mean_s, _S),
            ("age_peak", "peak", lambda topic: topic.age_peak_s, _S),
        ),
    ),
    ("queue", (("queued", "now", lambda topic: topic.queued, _COUNT),)),
)


def topics_html(snapshot: Snapshot) -> str:
    """One line per topic, with the ledger as a bar."""
    if not snapshot.topics:
        return '<div class="note">waiting for the first message of a topic</div>'
    fates = fate_order([topic.ledger for topic in snapshot.topics])
    groups = "".join(f'<th scope="colgroup" colspan="{len(columns)}">{name}</th>' for name, columns in _GROUPS)
    heads = "".join(f'<th scope="col">{column[1]}</th>' for _, columns in _GROUPS for column in columns)
    body = "".join(_topic_row(topic, fates) for topic in snapshot.topics)
    legend = "".join(
        f'<span class="key"><i style="background:{fate_colour(fate)}"></i>{escape(fate.replace("_", " "))}</span>'
        for fate in fates
    )
    return (
        f'<table class="topics"><thead><tr><th class="name" rowspan="2">topic</th>{groups}'
        f'<th class="ledger">where every message is <span class="keys">{legend}</span></th></tr>'
        f"<tr>{heads}<th></th></tr></thead><tbody>{body}</tbody></table>"
    )


def _topic_row(topic: TopicView, fates: list[str]) -> str:
    cells = ""
    for _, columns in _GROUPS:
        for place, (name, _head, read, write) in enumerate(columns):
            value = read(topic)
            first = ' class="first"' if place == 0 else ""
            data = "" if value is None else f' data-value="{value!r}"'
            cells += f'<td{first} data-field="{name}"{data}>{_text(value, write)}</td>'
    bar = "".join(
        f'<i data-fate="{escape(fate)}" data-value="{count}" title="{escape(fate)}: {count}" '
        f'style="flex:{count};{_filled(fate_colour(fate))}">{count if count * 12 > topic.sent else ""}</i>'
        for fate in fates
        if (count := topic.ledger.get(fate, 0))
    )
    if (unknown := topic.sent - sum(topic.ledger.values())) > 0:  # only the other end knows
        bar += f'<i style="flex:{unknown}"></i>'
    return (
        f'<tr data-topic="{escape(topic.name)}"><td class="name"><i style="background:{colour(topic.colour)}"></i>'
        f'{escape(topic.name)}</td>{cells}<td class="first ledger"><div class="bar">{bar}</div></td></tr>'
    )


def _filled(ink: str) -> str:
    return f"background:{ink};color:{ink_on(ink)}"


def paths_html(snapshot: Snapshot) -> str:
    """The path error as a number, for each topic with positions. The map cannot show it."""
    final = {topic.name: topic for topic in snapshot.topics}
    lines = []
    for path in snapshot.paths:
        topic = final.get(path.name)
        text = [f"error now <b>{_text(path.error_m, _METRES)}</b>"]
        if topic is not None and topic.path_error_m is not None:
            text = [
                f"path error <b>{_text(topic.path_error_m, _METRES)}</b>",
                f"RMS error at equal times <b>{_text(topic.rms_error_m, _METRES)}</b>",
            ]
        lines.append(f'<div data-topic="{escape(path.name)}">{escape(path.name)}: {", ".join(text)}</div>')
    return f'<div class="paths">{"".join(lines) or "no topic carries positions"}</div>'


def packets_html(snapshot: Snapshot) -> str:
    """The last packets, newest first, each with its bytes drawn to scale."""
    lines = []
    for packet in reversed(snapshot.last_packets):
        lines.append(_packet(packet))
        if packet.missing:
            lines.append(f'<div class="gap">{packet.missing} missing</div>')
    head = (
        '<div class="packet head"><span>time</span><span>ver</span><span>from → to</span><span>seq</span>'
        "<span>hop</span><span>QoS</span><span>flags</span><span>E</span>"
        "<span>header · topic ids · entries (topic, id, index/total, bytes) · PAD · CRC</span></div>"
    )
    return f'<div class="packets">{head}{"".join(lines) or "<div class=gap>no packet yet</div>"}</div>'


def _packet(view: PacketView) -> str:
    time, packet = f"{view.t:.3f}", view.packet
    if packet is None:
        return (
            f'<div class="packet refused"><span>{time}</span><span></span><span></span><span></span><span></span>'
            f'<span></span><span></span><span></span><div class="bytes"><i style="flex:1">{escape(view.refused)}</i>'
            "</div></div>"
        )
    flags = ("C" if packet.compressed else "") + ("E" if packet.encrypted else "") or "–"
    to = "all" if packet.dst_id == BROADCAST else str(packet.dst_id)
    return (
        f'<div class="packet"><span>{time}</span><span>{packet.version}</span><span>{packet.src_id} → {to}</span>'
        f"<span>{packet.seq}</span><span>{packet.hop}</span><span>{QOS_NAMES[packet.qos]}</span><span>{flags}</span>"
        f'<span>{len(packet.entries)}</span><div class="bytes">{"".join(map(_span, view.spans))}</div></div>'
    )


def _span(span: SpanView) -> str:
    fill = f";{_filled(colour(span.colour))}" if span.text else ""
    return f'<i class="{span.kind}" style="flex:{span.size}{fill}">{escape(span.text)}</i>'
