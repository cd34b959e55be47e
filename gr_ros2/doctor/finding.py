"""The result of a check: a state, a line of text, and the command that repairs the fault.

Invariant: a check that fails with an error is also a finding, and the other checks continue.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal

State = Literal["ok", "note", "warning", "failed"]
"""``note``: an optional part is missing, or nothing needs a repair; ``warning``: a link runs, but worse than it could;
``failed``: a link does not run, or not correctly."""


@dataclass(frozen=True)
class Finding:
    """The answer to one question.

    :param what: what was checked, in one or two words
    :param state: result of the check
    :param text: one line
    :param remedy: the command or setting that repairs the fault, '' = nothing to repair
    """

    what: str
    state: State
    text: str
    remedy: str = ""


@dataclass(frozen=True)
class Check:
    """One row of the table.

    :param group: heading of its findings
    :param name: what it checks; also the name of the finding when the check itself fails
    :param look: makes the check and returns its findings
    """

    group: str
    name: str
    look: Callable[[], Finding | Iterable[Finding]]

    def findings(self) -> list[Finding]:
        """Make the check and return its findings."""
        try:
            found = self.look()
            return [found] if isinstance(found, Finding) else list(found)
        except Exception as error:  # noqa: BLE001 - a broken package may raise anything, and the other checks go on
            return [Finding(self.name, "warning", f"could not be looked at ({type(error).__name__}: {error})")]
