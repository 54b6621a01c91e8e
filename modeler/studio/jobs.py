"""Commands in processes of their own, which outlive a server that is killed, and how far they are."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from modeler.export import write_atomically

POLL_S: Final = 0.25  # between looks at what runs: words and bars need to be no fresher
_LINE: Final = re.compile(r"(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d) (\w+): (.*)")
_FRAME: Final = re.compile(r"frames? \d+(?: to (\d+))?(?:: (\d+ joined.*);| (?:is|are) left out)")
_COUNT: Final = re.compile(r"registering more pairs: (\d+) of (\d+)")
_STARTED: Final = re.compile(r"frame \d+")
# Shares of a build's time: its pass over the frames takes 1 / 2.6 (`modeler.cli.console`), fusing and writing a tenth.
_FRAMES_END, _PAIRS_END = 0.4, 0.9


@dataclass(frozen=True)
class Progress:
    """How far a command is."""

    share: float | None = None
    """Of its work (0..1); None: unknown."""
    left_s: float | None = None
    """Until it ends; None: unknown."""
    words: str = "starting"
    """What it does."""


@dataclass
class Job:
    """A command of modeler."""

    words: tuple[str, ...]
    """Its arguments, from the command's name on."""
    log: Path
    """File of its messages."""
    title: str
    """What it does, for people."""
    pid: int | None = None
    """Number of its process, once started, also by a server before this one."""
    frames: int = 0
    """Number of frames that it goes through; 0: it has no such count."""
    unshown: tuple[str, ...] = ()
    """More arguments, of no matter for the result."""
    stopping: bool = False
    """Whether it was asked to end."""
    _process: subprocess.Popen[bytes] | None = field(default=None, repr=False)

    @property
    def line(self) -> str:
        """The command line that does the same."""
        return shlex.join(("modeler", *self.words))

    @property
    def out(self) -> Path:
        """File of what it writes to stdout."""
        return self.log.with_suffix(".out")

    def start(self) -> None:
        """Start it, its messages to an empty file."""
        self.log.parent.mkdir(parents=True, exist_ok=True)
        self.log.unlink(missing_ok=True)
        command = [sys.executable, "-m", "modeler", *self.words, *self.unshown, "-v", "--log", str(self.log)]
        with self.out.open("wb") as out:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=subprocess.DEVNULL,  # the log has the same
                start_new_session=True,  # Ctrl-C is for the server, which asks in its own way
                env={**os.environ, "PYTHONWARNINGS": "ignore"},
            )
        self.pid = self._process.pid

    def stop(self) -> None:
        """Ask it to end as Ctrl-C does: a build makes the model of the frames so far; a second time at once."""
        self.stopping = True
        if self.pid is not None and self.running:
            with contextlib.suppress(OSError):
                os.kill(self.pid, signal.SIGINT)

    @property
    def running(self) -> bool:
        """Whether it has been started and has not ended."""
        if self._process is not None:
            return self._process.poll() is None
        if self.pid is None:
            return False
        with contextlib.suppress(OSError):  # one that was started by a server before this one
            words = Path(f"/proc/{self.pid}/cmdline").read_bytes()
            if not words:  # it has ended, or is being started at this moment
                time.sleep(0.05)
                words = Path(f"/proc/{self.pid}/cmdline").read_bytes()
            return os.fsencode(self.log) in words
        return False

    @property
    def status(self) -> int | None:
        """Exit status; None while it runs, and where another server saw it."""
        return None if self._process is None else self._process.poll()

    def messages(self) -> list[tuple[str, str, str]]:
        """Return time, level and words of each message so far."""
        try:
            text = self.log.read_text(errors="replace")
        except OSError:
            return []
        found = filter(None, map(_LINE.fullmatch, text.splitlines()))
        return [(match[1], match[2], match[3]) for match in found]

    def said(self) -> list[str]:
        """Return the words of its messages, without those about the command itself."""
        return [words for _, _, words in self.messages() if not words.startswith(("$ ", "in ", "ended after"))]

    @property
    def failure(self) -> str | None:
        """Why it ended without a result, in its own words; None if it did not."""
        if self.running or self.status in (0, 3) or self._process is None:
            return None
        errors = [words for _, level, words in self.messages() if level == "error"]
        if errors:
            return errors[-1]
        return "stopped" if self.stopping else f"ended unexpectedly, with status {self.status}; try it in a terminal"

    def progress(self) -> Progress:
        """Return how far it is, as its messages tell."""
        words = ["starting", *self.said()][-1]
        if not self.frames:
            return Progress(words=words)
        began, done, share = None, 0, None
        for when, _, line in self.messages():
            if _STARTED.match(line):
                began = began or when
            if (found := _FRAME.match(line)) is not None:
                done += 1
                words = f"frame {done} of {self.frames}, {found[2]}" if found[2] else line
                share = _FRAMES_END * min(done / self.frames, 1.0)
            elif (counted := _COUNT.match(line)) is not None:
                share = _FRAMES_END + (_PAIRS_END - _FRAMES_END) * int(counted[1]) / max(int(counted[2]), 1)
                words = line
            elif line in ("choosing more pairs", "registering more pairs"):
                share, words = _FRAMES_END, line
            elif line == "fusing the model":
                share, words = _PAIRS_END, line
        if self.stopping:
            words = "finishing with the frames so far"
        if began is None or not share or share < 0.05:
            return Progress(share, None, words)
        passed_s = time.time() - datetime.fromisoformat(began).timestamp()
        return Progress(share, max(passed_s, 0.0) * (1.0 - share) / share, words)


@dataclass
class Queue:
    """Jobs, one after another: a machine builds one model at a time."""

    file: Path
    """Where the running job is noted, for the server after this one."""
    waiting: list[Job] = field(default_factory=list)
    """Not started yet, in order."""
    current: Job | None = None
    """The one that runs."""
    last: Job | None = None
    """The one that ended last."""

    def __post_init__(self) -> None:
        """Take over what a server before this one has started, and what is to follow."""
        with contextlib.suppress(OSError, ValueError, TypeError, KeyError):
            found = [_read(one) for one in json.loads(self.file.read_text())]
            self.waiting = [job for job in found if job.pid is None]
            self.current = next((job for job in found if job.pid is not None), None)

    def add(self, jobs: Sequence[Job]) -> None:
        """Have jobs done, each if the one before it has succeeded."""
        self.waiting += jobs
        self.advance()

    def advance(self) -> bool:
        """Start the next job if none runs; return whether one has just ended."""
        ended = self.current is not None and not self.current.running
        if ended:
            self.last, self.current = self.current, None
            if self.last is not None and self.last.failure is not None:
                self.waiting.clear()
        if self.current is None and self.waiting:
            self.current = self.waiting.pop(0)
            self.current.start()
        elif not ended:
            return False
        jobs = [*([] if self.current is None else [self.current]), *self.waiting]
        names = ("words", "title", "pid", "frames")
        kept = [{"log": str(job.log), **{name: getattr(job, name) for name in names}} for job in jobs]
        write_atomically(self.file, json.dumps(kept) + "\n")
        return ended

    def stop(self) -> None:
        """Ask the running job to end."""
        if self.current is not None:
            self.current.stop()


def _read(record: dict[str, Any]) -> Job:
    words, log = tuple(map(str, record["words"])), Path(record["log"])
    return Job(words, log, str(record["title"]), record["pid"], int(record["frames"]))
