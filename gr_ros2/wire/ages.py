"""Ages on the wire: floating-point numbers of eight bits in steps of ``AGE_STEP_S``.

A code c < 16 is c steps, and any other c is (16 + c mod 16) * 2^(c div 16 - 1) steps. So an age is exact to 10 ms or to
1 part in 16. 255 is an age that is greater or unknown, or no limit. An age is rounded up and a limit down, at every
hop: nothing seems younger than it is.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from math import inf

AGE_STEP_S = 0.01
NO_AGE = 255
"""Code of an age that is greater than all others or unknown, and of no limit."""
_STEPS = [code if code < 16 else (16 + code % 16) << (code // 16 - 1) for code in range(NO_AGE)]
"""The ages for which codes stand, in steps."""


def age_code(age_s: float) -> int:
    """The code of an age in s; what it stands for is not less."""
    return bisect_left(_STEPS, age_s / AGE_STEP_S)


def limit_code(limit_s: float) -> int:
    """The code of the age in s at which a message is of no more use, infinite for none; what it stands for is not
    greater."""
    return NO_AGE if limit_s == inf else max(bisect_right(_STEPS, limit_s / AGE_STEP_S) - 1, 0)


def age_of(code: int) -> float:
    """The age in s for which a code stands; infinite for ``NO_AGE``."""
    return inf if code == NO_AGE else _STEPS[code] * AGE_STEP_S


def age_in_words(code: int) -> str:
    """An age as people read it."""
    return f"more than {age_of(NO_AGE - 1):g} s" if code == NO_AGE else f"{age_of(code):g} s"
