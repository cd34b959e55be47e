"""What a check says: how it stands, in a line, and the command that mends it.

Invariant: a check that cannot be made is a finding too, and never ends the others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal

State = Literal["ok", "note", "warning", "failed"]
"""``note``: an optional part that is not there, or what nobody needs to mend; ``warning``: a link runs, and worse than
it could; ``failed``: it does not run, or not rightly."""


@dataclass(frozen=True)
class Finding:
    """The answer to one question.

    :param what: was looked at, in a word or two
    :param state: how it stands
    :param text: one line
    :param remedy: the command or setting that mends it, '' = nothing to mend
    """

    what: str
    state: State
    text: str
    remedy: str = ""


@dataclass(frozen=True)
class Check:
    """One row of the table.

    :param group: heading under which its findings stand
    :param name: what it looks at; a check that fails by itself is called so
    :param look: gives its findings
    """

    group: str
    name: str
    look: Callable[[], Finding | Iterable[Finding]]

    def findings(self) -> list[Finding]:
        """What it finds."""
        try:
            found = self.look()
            return [found] if isinstance(found, Finding) else list(found)
        except Exception as error:  # noqa: BLE001 - a broken package may raise anything, and the other checks go on
            return [Finding(self.name, "warning", f"could not be looked at ({type(error).__name__}: {error})")]
