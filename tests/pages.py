"""README and guide, taken apart into what a reader may try: commands, files and Python."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from source_trees import ROOT

DOCS: Final = ROOT / "docs"
GUIDE: Final = (
    "capture build studio result export next track many python cameras priors pairs render troubleshooting files"
).split()
PAGES: Final = {"README": ROOT / "README.md"} | {name: DOCS / f"{name}.md" for name in ("index", *GUIDE)}
"""File by name of each page whose commands are tried."""
_FENCE: Final = re.compile(r'^```(\w+)(?: title="([^"]+)")?\n(.*?)^```$', re.MULTILINE | re.DOTALL)


class Command(NamedTuple):
    """A line of a shell."""

    line: str


class File(NamedTuple):
    """A file that the page shows, by its path in the folder in which the reader works."""

    path: str
    text: str


class Snippet(NamedTuple):
    """Python, which goes on from that before it on the page."""

    code: str


def steps(page: Path) -> Iterator[Command | File | Snippet]:
    """Yield what a page asks a reader to do, in order."""
    for language, path, text in _FENCE.findall(page.read_text()):
        if path:
            yield File(path, text)
        elif language == "python":
            yield Snippet(text)
        elif language == "sh":
            for line in re.sub(r"\\\n\s*", "", text).splitlines():
                if command := line.split(" #")[0].strip():
                    yield Command(command)


def commands(page: Path) -> list[str]:
    """Return the lines for a shell on a page."""
    return [step.line for step in steps(page) if isinstance(step, Command)]
