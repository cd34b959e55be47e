"""Describes errors in settings in one line: key, value, what is allowed, and what the key is for.

Invariant: a value that a union refuses gives one complaint, however many members the union has.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import is_dataclass
from typing import Any, get_args, get_origin, get_type_hints

from gr_ros2.settings.fields import AUTO, members, settings_of

_KINDS = {
    "bool": "true or false",
    "complex": "a number such as 0.5 or 0.5+0.2j",
    "dataclass": "keys and values",
    "dict": "keys and values",
    "float": "a number",
    "int": "a whole number",
    "list": "a list",
    "string": "a text",
    "tuple": "a list",
}
"""The expected kind of value in words, by pydantic's name of the error."""
OLD_NAMES = {
    "ros_source": "write robot, topics and graph, and beside them what the block had",
    "ros_sink": "write publish and graph, and beside them what the block had",
    "namespace": "write robot, or graph.namespace where it has another name",
    "robot_id": "write robot",
    "topic_options": "write topics, or publish.topics, as a mapping of names to options",
    "namespace_format": "write publish.as",
    "frame_prefix": "write publish.frame_prefix",
    "merge_tf": "write publish.merge_tf",
    "middleware": "write graph.middleware",
    "domain_id": "write graph.domain_id",
    "localhost_only": "write graph.localhost_only",
    "use_sim_time": "write graph.use_sim_time",
    "subscriber_depth": "write graph.depth",
    "publisher_depth": "write publish.depth",
    "dst_id": "write to of each topic",
    "dictionaries": "nodes announce the structure of their types",
    "version": "a link speaks version 1; version 0 is that of the paper's blocks, in a scenario paper: {}",
    "back": "write robots: 2, and paths where the channels differ",
    "reports": "write robots: [{}, {topics: []}], and paths where the channels differ",
    "receivers": "write robots: [{}, {topics: []}, {topics: []}], and paths where the channels differ",
    **dict.fromkeys(
        ("packet_loss_warn", "packet_loss_error", "message_loss_warn", "message_loss_error"),
        "write loss: [warning, error]",
    ),
    **dict.fromkeys(("latency_warn_s", "latency_error_s"), "write latency_s: [warning, error]"),
    **dict.fromkeys(("age_warn_s", "age_error_s"), "write age_s: [warning, error]"),
    **dict.fromkeys(("silence_warn_s", "silence_error_s"), "write silence_s: [warning, error]"),
    **dict.fromkeys(("odom_linear_noise", "odom_angular_noise"), "write odom_noise: [m/s, rad/s]"),
}
"""What says now what a setting of another name said."""
_LIKE_AUTO: tuple[Any, ...] = (None, -1, 0, "", [])
"""Values that elsewhere often mean what ``auto`` means here."""


def explain(cls: type[Any], items: Sequence[Any], where: str = "") -> str:
    """Complaints of pydantic in one line.

    :param cls: the settings class
    :param items: ``ValidationError.errors()``
    :param where: name of the settings in errors, for instance the file name
    """
    prefix = f"{where}: " if where else ""
    places: dict[tuple[str, ...], list[Any]] = {}
    owners = {}
    for item in items:
        keys, owner = _place(cls, item["loc"])
        places.setdefault(keys, []).append(item)
        owners[keys] = owner
    # A wrong value at the top level that several parts inherit is reported once, not for every part.
    top = [(keys, group[0]["input"]) for keys, group in places.items() if len(keys) == 1]
    groups = {
        keys: group for keys, group in places.items() if len(keys) == 1 or (keys[-1:], group[0]["input"]) not in top
    }
    complaints = {keys: _complaint(keys, owners[keys], group) for keys, group in groups.items()}
    # What both ends of a link share is refused at the first one.
    once = {text.removeprefix(f"{'.'.join(keys)}: "): text for keys, text in reversed(complaints.items())}
    return "; ".join(prefix + text for text in reversed(once.values()))


def _place(cls: type[Any], loc: Sequence[Any]) -> tuple[tuple[str, ...], type[Any] | None]:
    """The keys that lead to a place, and the settings class of the last key. A union member's name is not a key."""
    keys: list[str] = []
    owner: Any = None
    kinds: tuple[Any, ...] = (cls,)
    for part in loc:
        kinds = tuple(kind for kind in kinds if kind is not type(None))
        if len(kinds) > 1:
            kinds = ()  # pydantic does not say which member it is in a form that can be used here
            continue
        owner = kinds[0] if kinds and is_dataclass(kinds[0]) else None
        keys.append(str(part))
        if owner is not None:
            kinds = members(get_type_hints(owner, include_extras=True).get(part))
        else:
            kinds = members(_inside(kinds[0])) if kinds else ()
    return tuple(keys), owner


def _inside(kind: Any) -> Any:
    """The type of the entries of a mapping or a list; None of anything else."""
    if get_origin(kind) in (dict, Mapping):
        return get_args(kind)[-1]
    return get_args(kind)[0] if get_origin(kind) in (tuple, list) else None


def _complaint(keys: tuple[str, ...], owner: type[Any] | None, group: Sequence[Any]) -> str:
    key, item = ".".join(keys), group[0]
    if not key:
        return str(item["msg"]).removeprefix("Value error, ")
    owners: dict[Any, tuple[str, ...]] = {} if owner is None else {owner: (), **getattr(owner, "also", {})}
    known = [setting.name for one, but in owners.items() for setting in settings_of(one) if setting.name not in but]
    if item["type"] in ("unexpected_keyword_argument", "extra_forbidden"):
        if keys[-1] in OLD_NAMES:
            return f"{key} is no setting any more: {OLD_NAMES[keys[-1]]} (docs/reference/parameters.md)"
        return f"unknown key {key}" + (f"; known are {', '.join(known)}" if known else "")
    setting = next((found for found in settings_of(owner) if found.name == keys[-1]), None) if owner else None
    purpose = re.split(r"[.;](?: |$)", setting.meaning.replace("``", ""))[0] if setting else ""  # its first sentence
    purpose = f" ({purpose})" if purpose else ""
    if item["type"] in ("missing", "missing_argument"):
        return f"{key} is missing{purpose}"
    secret = keys[-1] == "key"  # a key by mistake must not be shown
    value = "" if secret or isinstance(item["input"], Mapping) else f" = {item['input']!r}"
    if item["type"] == "value_error":  # the setting has words of its own
        return f"{key}{value}: {_asked(item, purpose)}"
    if setting is not None and setting.derives and not isinstance(item["input"], bool) and item["input"] in _LIKE_AUTO:
        return f"{key}{value}: write {AUTO}{purpose}"
    ranges = [_asked(one, purpose) for one in group if one["type"] != "literal_error"][:1]
    choices = [f"must be {_either(setting.choices)}"] if setting is not None and setting.choices else []
    return f"{key}{value}: {', or '.join([*ranges, *choices]).replace(', or must be', ', or')}"


def _either(choices: Sequence[Any]) -> str:
    *others, last = map(repr, choices)
    return f"{', '.join(others)} or {last}" if others else last


def _asked(item: Any, purpose: str) -> str:
    """What pydantic expects, in our words.

    :param purpose: what the setting is for; it is given if the value is of the wrong kind
    """
    kind, _, problem = item["type"].partition("_")
    if kind in _KINDS and problem in ("type", "parsing", "str_parsing", "from_float"):
        return f"must be {_KINDS[kind]}{purpose}"
    message = str(item["msg"]).removeprefix("Value error, ")
    asked = re.fullmatch(r"\w+ should (.+?)(?: after validation.*)?", message)
    return f"must {asked[1]}" if asked else f"{message[0].lower()}{message[1:]}"
