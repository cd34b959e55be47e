"""Describes each field of a settings class: meaning, default, range, choices, label.

Invariant: everything that shows settings (error messages, docs/reference/parameters.md, GRC, ROS parameters) reads them
here. A new setting is therefore one field of a dataclass and the docstring behind it. Docstrings are read from the
source when somebody asks. pydantic reads them when a class is made, so that a link starts 5 ms later for each class.
"""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache
from itertools import pairwise
from textwrap import dedent
from types import NoneType, UnionType
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin, get_type_hints

from annotated_types import Ge, Gt, Le, Lt
from pydantic.fields import FieldInfo

Auto = Literal["auto"]
AUTO: Final = "auto"
"""The value of a setting that is derived from others or chosen by a device; the setting's meaning says how."""


REQUIRED: Final = object()
"""Stands for the default of a setting that has none."""

_UNITS = {"s": "s", "hz": "Hz", "db": "dB", "m": "m", "len": "bytes"}
"""Unit of a setting, by the last part of its name."""


@dataclass(frozen=True)
class Setting:
    """One field of a settings class.

    :param name: name in files, of the command line and of ROS parameters
    :param attribute: name of the field, which may be a name that Python keeps for itself, with ``_``
    :param hint: its type, with annotations
    :param default: ``REQUIRED`` if it has none
    :param owner: its class
    :param title: label in plain words, with the unit of a number in brackets
    :param choices: all texts and numbers that are allowed, or the words allowed besides its range, such as ``auto``
    :param suggested: suggested values; other values are allowed too
    :param least: smallest allowed number; None if there is no such limit
    :param most: largest allowed number; None if there is no such limit
    :param above: numbers must be above this; None if there is no such limit
    :param below: numbers must be below this; None if there is no such limit
    """

    name: str
    attribute: str
    hint: Any
    default: Any
    owner: type[Any]
    title: str
    choices: tuple[Any, ...] = ()
    suggested: tuple[Any, ...] = ()
    least: float | None = None
    most: float | None = None
    above: float | None = None
    below: float | None = None

    @property
    def meaning(self) -> str:
        """Text of its docstring, in its class or a base class."""
        return meanings(self.owner).get(self.attribute, "")

    @property
    def explained(self) -> str:
        """Its meaning in plain text."""
        return self.meaning.replace("``", "")

    @property
    def derives(self) -> bool:
        """Whether it may be ``auto``, whatever the default."""
        return AUTO in (self.default, *self.choices)

    @property
    def optional(self) -> bool:
        """Whether it may be null, which means that there is no value."""
        return NoneType in members(self.hint)

    @property
    def limits(self) -> tuple[str, str]:
        """Text before and after a name in an expression of its range, ``0 <= `` and `` < 255``; '' without a limit."""
        low = f"{self.above!r} < " if self.above is not None else ""
        high = f" < {self.below!r}" if self.below is not None else ""
        low = f"{self.least!r} <= " if self.least is not None else low
        return low, f" <= {self.most!r}" if self.most is not None else high

    @property
    def kinds(self) -> tuple[Any, ...]:
        """The types that it may have in addition to its choices, without annotations: ``(int,)``, ``(str,)``."""
        return tuple(kind for kind in members(self.hint) if get_origin(kind) is not Literal and kind is not NoneType)


_FOUND: dict[type[Any], list[Setting]] = {}
"""The settings of each class that was asked for."""


def settings_of(cls: type[Any]) -> Sequence[Setting]:
    """Every field of a settings class, in their order."""
    if cls not in _FOUND:
        called, hints = titles(cls), get_type_hints(cls, include_extras=True)
        _FOUND[cls] = [_setting(item, hints[item.name], cls, called) for item in fields(cls)]
    return _FOUND[cls]


def _setting(item: Any, hint: Any, owner: type[Any], called: Mapping[str, str]) -> Setting:
    marks = list(_marks(hint))
    bounds = [bound for mark in marks for bound in getattr(mark, "metadata", [mark])]
    about = [mark for mark in marks if isinstance(mark, FieldInfo)]
    default = item.default
    if isinstance(default, FieldInfo):
        default = default.get_default(call_default_factory=True)
    if default is MISSING or type(default).__name__ == "PydanticUndefinedType":
        default = REQUIRED
    return Setting(
        item.name.removesuffix("_"),
        item.name,
        hint,
        default,
        owner,
        called.get(item.name) or label(item.name),
        tuple(value for kind in members(hint) if get_origin(kind) is Literal for value in get_args(kind)),
        tuple(value for mark in about for value in mark.examples or ()),
        next((bound.ge for bound in bounds if isinstance(bound, Ge)), None),  # type: ignore[arg-type]
        next((bound.le for bound in bounds if isinstance(bound, Le)), None),  # type: ignore[arg-type]
        next((bound.gt for bound in bounds if isinstance(bound, Gt)), None),  # type: ignore[arg-type]
        next((bound.lt for bound in bounds if isinstance(bound, Lt)), None),  # type: ignore[arg-type]
    )


def label(name: str) -> str:
    """A setting's name in words: ``flush_timeout_s`` as ``Flush timeout (s)``."""
    words, _, end = name.rpartition("_")
    if words and end in _UNITS:
        return f"{words.replace('_', ' ').capitalize()} ({_UNITS[end]})"
    return name.replace("_", " ").capitalize()


def meanings(cls: type[Any]) -> dict[str, str]:
    """The docstring of each setting of a class and its bases, one line each, the one nearest to the class."""
    return {name: text for part in reversed(cls.__mro__) if is_dataclass(part) for name, text in _own(part).items()}


@cache
def _own(cls: type[Any]) -> dict[str, str]:
    """The docstrings behind the fields of a class alone."""
    (body,) = ast.parse(dedent(inspect.getsource(cls))).body
    assert isinstance(body, ast.ClassDef)
    found = {}
    for field, behind in pairwise(body.body):
        if isinstance(field, ast.AnnAssign) and isinstance(behind, ast.Expr) and isinstance(field.target, ast.Name):
            text = ast.literal_eval(behind.value)
            found[field.target.id] = " ".join(text.split())
    return found


def titles(cls: type[Any]) -> dict[str, str]:
    """The labels that a settings class and its bases give with ``Field(title=…)``."""
    return {
        name: mark.title
        for part in reversed(cls.__mro__)
        for name, hint in get_type_hints(part, include_extras=True).items()
        for mark in _marks(hint)
        if isinstance(mark, FieldInfo) and mark.title
    }


def members(hint: Any) -> tuple[Any, ...]:
    """The types that a type is made of: the members of a union; otherwise the type itself, without annotations."""
    if get_origin(hint) is Annotated:
        return members(get_args(hint)[0])
    if get_origin(hint) in (Union, UnionType):
        return tuple(kind for part in get_args(hint) for kind in members(part))
    return (hint,)


def _marks(hint: Any) -> Iterator[Any]:
    """The annotations, at any depth of a union."""
    if get_origin(hint) is Annotated:
        inner, *marks = get_args(hint)
        yield from marks
        yield from _marks(inner)
    elif get_origin(hint) in (Union, UnionType):
        for part in get_args(hint):
            yield from _marks(part)
