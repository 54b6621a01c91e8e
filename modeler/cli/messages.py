"""Which messages a command prints, and the file that keeps them all: `-v`, `-q` and `--log FILE`."""

from __future__ import annotations

import contextlib
import logging
import os
import platform
import re
import shlex
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Final, TextIO

HELP: Final = (
    "All commands take -v (print each step), -q (errors only) and --log FILE (keep all messages with their times)."
)
_OURS: Final = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d")
_FORMAT: Final = "%Y-%m-%dT%H:%M:%S"


class Wrong(Exception):
    """Options of messages that cannot be followed, in one line."""


@dataclass
class Messages:
    """Messages from the level `least` on are printed; `file` takes all of them."""

    least: int = logging.INFO
    """As in `logging`: DEBUG for each step, INFO, ERROR."""
    path: Path | None = None
    """File to append to."""
    file: TextIO | None = field(default=None, repr=False)
    """The same, opened."""

    def note(self, line: str, level: int) -> bool:
        """Keep a line, and return whether it is to be printed."""
        if self.file is not None:
            with contextlib.suppress(OSError, ValueError):  # a full disk harms no result
                self.file.write(f"{time.strftime(_FORMAT)} {logging.getLevelName(level).lower()}: {line}\n")
                self.file.flush()
        return level >= self.least


MESSAGES: Final = Messages()  # of this process, for the command that runs


def split(arguments: Sequence[str]) -> tuple[Messages, list[str]]:
    """Return what the options of messages say, and the other arguments; `Wrong` if options contradict each other."""
    levels, path, rest = set[int](), None, list[str]()
    words = iter(arguments)
    for word in words:
        match word:
            case "-v" | "--verbose":
                levels.add(logging.DEBUG)
            case "-q" | "--quiet":
                levels.add(logging.ERROR)
            case "--log":
                path = next(words, "")
            case _ if word.startswith("--log="):
                path = word.partition("=")[2]
            case _:
                rest.append(word)
    if len(levels) > 1:
        raise Wrong("-v and -q contradict each other; give one of them")
    if path == "":
        raise Wrong("--log lacks its file; name one")
    return Messages(levels.pop() if levels else logging.INFO, None if path is None else Path(path)), rest


@contextlib.contextmanager
def kept(asked: Messages, arguments: Sequence[str]) -> Iterator[None]:
    """Print and keep the messages of the block as asked; `Wrong` if the file is not, or cannot be, such a log."""
    before = MESSAGES.least, MESSAGES.file
    MESSAGES.least, MESSAGES.file = asked.least, None if asked.path is None else _opened(asked.path)
    for handler in logging.root.handlers:
        handler.setLevel(max(logging.WARNING, asked.least))
    began = datetime.now()
    try:
        if MESSAGES.file is not None:
            MESSAGES.note(f"$ modeler {shlex.join(arguments)}", logging.INFO)
            MESSAGES.note(f"in {os.getcwd()}, Python {platform.python_version()}, {platform.platform()}", logging.DEBUG)
        yield
    finally:
        if MESSAGES.file is not None:
            MESSAGES.note(f"ended after {(datetime.now() - began).total_seconds():.1f} s", logging.DEBUG)
            with contextlib.suppress(OSError):
                MESSAGES.file.close()
        MESSAGES.least, MESSAGES.file = before
        for handler in logging.root.handlers:
            handler.setLevel(logging.NOTSET)


def _opened(path: Path) -> TextIO:
    """Open a log to append to."""
    try:
        if os.path.lexists(path):
            if not path.is_file():
                raise Wrong(f"{path}: is no regular file; choose another --log")
            with path.open(encoding="utf-8", errors="replace") as file:
                head = file.read(len("2026-01-01T00:00:00"))
            if head and not _OURS.fullmatch(head):
                raise Wrong(f"{path}: exists already and is no log of modeler; choose another --log")
        return path.open("a", encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        raise Wrong(f"{path}: cannot be written ({error.strerror}); choose another --log") from error


class ToLog(logging.Handler):
    """Keeps what libraries log."""

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a record."""
        if MESSAGES.file is not None:
            MESSAGES.note(f"{record.name}: {record.getMessage()}", record.levelno)
