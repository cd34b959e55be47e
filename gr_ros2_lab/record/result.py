"""`result.json`: the result of an experiment, as values and as a file.

Invariants: a number that does not apply is null, never NaN and never invented; the file appears whole or not at all;
reading returns what was written, and refuses any other file with one line that says why. Keys that this version does
not know are ignored when reading, so that results of later versions can still be tabulated.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import asdict, field
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from gr_ros2.core.errors import ConfigError
from gr_ros2.core.files import write_text, write_whole
from gr_ros2.observe.result import READ, Count, Number, TopicResult

RESULT_FILE = "result.json"


@dataclass(frozen=True, config=READ)
class LatenessResult:
    """How late the computer was in a run that follows the wall clock; see :mod:`gr_ros2_lab.run.runner`.

    :param worst_s: greatest lateness, s, by part: ``threads``, ``gate``
    :param moments: number of times that a part was late by 50 ms or more
    :param share: share of the run's time that these moments cover
    :param lost: messages submitted that did not arrive and are not in flight
    :param lost_after: how many of those were submitted in such a moment or within a second after it
    :param sent, sent_after: the same counts for all messages submitted
    """

    worst_s: dict[str, Number]
    moments: Count
    share: Number
    lost: Count
    lost_after: Count
    sent: Count
    sent_after: Count


@dataclass(frozen=True, config=READ)
class ReceiverResult:
    """The topics at a further receiver of the same sender.

    :param number: from 2; the topics of the first receiver are in the result itself
    :param name: of a robot that receives from several; '' for a receiver without name
    :param packets, phy: as in the result, of the senders that this receiver can hear
    """

    number: Count
    topics: tuple[TopicResult, ...]
    name: str = ""
    packets: dict[str, Any] = field(default_factory=dict)
    phy: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ChangeResult:
    """What somebody has changed during a run, by a slider of the dashboard for example.

    :param t: s since the first message could be submitted
    :param setting: its name, as in ``config``, or ``transmit`` of all robots
    """

    t: Number
    setting: str
    value: bool | float | None


@dataclass(frozen=True, config=READ)
class Result:
    """One experiment.

    :param duration_s: s during which messages were submitted
    :param config: every setting of the scenario
    :param packets: counts by name: sent, received, crc_failed, malformed, …
    :param phy: name, channels (one per direction), sample_rate, runs_on (what processed the samples), airtime_s (of one
        packet), airtime_per_message_s and airtime_per_byte_s (of all packets sent, per delivered message and byte),
        bytes_per_message (of all packets sent, per delivered message), airtime_of_kinds_s (of new packets, repairs,
        reports, hellos), airtime_of_senders_s (the same by source id), air_span_s (first to last packet),
        half_snr_db (SNR at which half of the longest packets arrive in theory), …
    :param wall_s: s the run took by the wall clock, drain included
    :param interrupted: the run was stopped before its end
    :param counters: of the blocks, by name: what was dropped and why
    :param lateness: None where the run's clock waits for the computer
    :param incomplete: other outputs of the run that are not complete, such as a capture on a full disk: one line each,
        with the reason and how much is missing. The numbers of this result are complete in any case.
    :param receivers: further receivers of the same sender
    :param changes: what was changed while it ran, in order; ``config`` has what was set at the start
    :param task: how well robots did what they were to do together, by the names that the task gives
    """

    scenario: str
    seed: int
    duration_s: Number
    config: dict[str, Any]
    topics: tuple[TopicResult, ...]
    packets: dict[str, Any]
    phy: dict[str, Any]
    wall_s: Number | None = None
    interrupted: bool = False
    counters: dict[str, Any] = field(default_factory=dict)
    lateness: LatenessResult | None = None
    incomplete: tuple[str, ...] = ()
    receivers: tuple[ReceiverResult, ...] = ()
    task: dict[str, Number | None] = field(default_factory=dict)
    changes: tuple[ChangeResult, ...] = ()


@dataclass(frozen=True)
class AirUse:
    """What packets of one kind used.

    :param kind: new, repair, report or hello
    :param share: of the airtime of all packets sent, 0..1; of their number for a PHY without samples
    """

    kind: str
    packets: int
    share: float


def air_uses(result: Result) -> list[AirUse]:
    """What the air was used for; [] for a run in which all packets carried new messages."""
    packets = {name[4:]: count for name, count in result.packets.items() if name.startswith("air_")}
    spent = result.phy.get("airtime_of_kinds_s") or packets
    total = sum(spent.values()) or 1
    return [AirUse(kind, count, spent.get(kind, 0) / total) for kind, count in packets.items()]


def topic_numbers(topic: TopicResult, fates: Iterable[str]) -> dict[str, Any]:
    """Every number of a topic as a column of a table.

    :param fates: ledger fates that get a column each
    """
    values = asdict(topic)
    for name in ("latency_s", "age_s"):
        values.update({f"{name[:-2]}_{key}_s": value for key, value in values.pop(name).items()})
    ledger = values.pop("ledger")
    del values["latency_cdf_s"], values["hops"]
    return {**values, "relayed": relayed(topic), **{f"ledger_{fate}": ledger.get(fate, 0) for fate in fates}}


def relayed(topic: TopicResult) -> int:
    """Messages delivered that came over other robots."""
    return sum(count for hops, count in topic.hops.items() if hops != "0")


def write_result(result: Result, path: str | Path) -> Path:
    """Write the file, or ``result.json`` in a folder.

    :raises ConfigError: when it cannot be written
    """
    path = Path(path)
    if path.is_dir():
        path /= RESULT_FILE
    values = _finite(TypeAdapter(Result).dump_python(result, mode="python", warnings=False))
    text = json.dumps(values, indent=2, allow_nan=False, default=str) + "\n"
    return write_whole(path, text, write_text)


def read_result(path: str | Path) -> Result:
    """Read the file, or the ``result.json`` of a folder.

    :raises ConfigError: when it is missing, damaged, half-written or not a result; says where
    """
    path = Path(path)
    if path.is_dir():
        path /= RESULT_FILE
    try:
        values = json.loads(path.read_bytes().decode("utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: damaged or half-written, no JSON ({error}); run the experiment again") from error
    try:
        return TypeAdapter(Result).validate_python(values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"]) or "the whole file"
        message = first["msg"].removeprefix("Value error, ")
        raise ConfigError(f"{path}: no result of an experiment ({where}: {message})") from error


def _finite(value: Any) -> Any:
    """The same value with None in place of numbers that are not finite, and Python numbers in place of numpy's."""
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    if hasattr(value, "item") and callable(value.item):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
