"""The code blocks of the documentation: what a reader copies.

A block's info string says what it is. ``sh``: command lines, or, where some begin with ``$``, those lines and what they
print. ``yaml file=NAME``: a whole file, which commands of the same page use. ``yaml part-of=KIND.KEY``: settings that
belong at KEY (nothing: the top level) of a link, a scenario or a sweep. ``python``: a program. ``text``: neither.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
_FENCE = re.compile(r"^```(?P<info>[^\n`]*)\n(?P<text>.*?)^```$", re.M | re.S)


@dataclass(frozen=True)
class Block:
    """One code block: the page, the line its text begins at, its language, its further words, its text."""

    page: str
    line: int
    language: str
    about: str
    text: str

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"


def blocks(*languages: str) -> Iterator[Block]:
    """The blocks of all pages in these languages, page by page."""
    for page in PAGES:
        content = page.read_text(encoding="utf-8")
        for match in _FENCE.finditer(content):
            language, _, about = match["info"].partition(" ")
            if not languages or language in languages:
                line = content.count("\n", 0, match.start("text")) + 1
                yield Block(page.relative_to(ROOT).as_posix(), line, language, about.strip(), match["text"])


def commands(block: Block) -> Iterator[list[str]]:
    """The command lines of a block, as a shell would split them; variables set in front are left out."""
    lines = block.text.replace("\\\n", " ").splitlines()
    prompted = [line[2:] for line in lines if line.startswith("$ ")]
    for line in prompted or lines:
        for part in line.split(" && "):
            words = shlex.split(part, comments=True)
            while words and re.fullmatch(r"[A-Z_]+=\S*", words[0]):
                words.pop(0)
            if words:
                yield words
