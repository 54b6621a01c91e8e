"""The jobs of a batch: one build each, in a separate process, and their files.

Engines may execute `run` anywhere; its arguments and results are small and plain. Nothing heavy is imported here.
"""

from __future__ import annotations

import fcntl
import glob
import hashlib
import json
import os
import stat
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO, Literal

from modeler.system.processes import environment
from modeler.system.regular_files import PIECE_BYTES

BUILDER = "modeler.cli.one_job"  # module that builds the sequence of a job, in a process of its own
NOTES = ".batch"  # subfolder of a batch with the state of each sequence and the output of its build
TRIES = 2  # how often a sequence that fails is tried: once more, in case the machine was at fault
ENDED = (0, 3)  # statuses of completed builds
Standing = Literal["new", "interrupted", "done", "changed", "other", "failed"]
_MOST = 1 << 31  # of a number in it
_LINE = "modeler: "


@dataclass(frozen=True)
class Job:
    """One sequence to build."""

    name: str
    sequence: str
    """Absolute path."""
    out: str
    """Absolute path of the folder of the batch."""
    arguments: tuple[str, ...] = ()
    """Options of `modeler build`."""
    threads: int = 1
    """Threads of the process that builds it."""
    page: bool = False
    """Whether its report is written as a page, too."""
    again: bool = False
    """Whether it is tried again though it has failed before."""

    @property
    def run(self) -> Path:
        """The run folder."""
        return Path(self.out) / self.name

    @property
    def note(self) -> Path:
        """The file with its state."""
        return Path(self.out) / NOTES / f"{self.name}.json"

    @property
    def log(self) -> Path:
        """The file with the output of its builds; the holder of its lock works on the sequence."""
        return Path(self.out) / NOTES / f"{self.name}.log"


@dataclass(frozen=True)
class Ended:
    """How a job ended."""

    name: str
    """Of the sequence."""
    status: int
    """Exit status of the build: 0, 2, 3; 128 and more: it was killed."""
    line: str = ""
    """Its error line, if it failed."""
    tries: int = 0
    """How often it has failed."""


def files_of(sequence: Path) -> list[Path]:
    """Return the files that a sequence consists of, in order: those below a folder, or a file and its `.json`."""
    if not sequence.is_dir():
        return [path for path in (sequence, sequence.with_suffix(".json")) if path.is_file()]
    found, seen = [], set()
    for folder, inner, names in os.walk(sequence, followlinks=True):
        status = os.stat(folder)
        if (status.st_dev, status.st_ino) in seen:  # links may lead in circles
            inner.clear()
            continue
        seen.add((status.st_dev, status.st_ino))
        inner.sort()
        found += [Path(folder) / name for name in sorted(names)]
    return found


def fingerprint(job: Job, *, content: bool) -> str:
    """Return a digest of the input of a job: of names and bytes, or, at a glance, of names, sizes and times of change.

    Files named by options are included. Unreadable files are represented by their name: the build will report them.
    """
    digest = hashlib.blake2b(digest_size=16)
    named = [Path(value) for option, value in pairwise(job.arguments) if option in ("--sensor", "--camera")]
    for path in (*files_of(Path(job.sequence)), *named):
        digest.update(os.fsencode(os.path.relpath(path, job.sequence)) + b"\0")
        try:
            status = os.stat(path)
            digest.update(f"{status.st_size} ".encode())
            if not content:
                digest.update(f"{status.st_mtime_ns} ".encode())
            elif path.is_file():  # a FIFO might block
                with open(path, "rb") as file:
                    while piece := file.read(PIECE_BYTES):
                        digest.update(piece)
        except OSError as error:
            digest.update(f"{error.errno} ".encode())
    return digest.hexdigest()


def read_note(path: Path) -> dict[str, Any]:
    """Return the state of a sequence; empty without a valid file."""
    from modeler.system.regular_files import read_json
    from modeler.types import InputError

    try:
        note = read_json(path, 1 << 24)
    except InputError:
        return {}
    return note if isinstance(note, dict) and all(_valid(name, value) for name, value in note.items()) else {}


def _valid(name: str, value: object) -> bool:
    """Return whether an entry of a note is one that `write_note` may have written."""
    match value:
        case bool():
            return False
        case int():
            return (name in ("status", "tries") and 0 <= value < _MOST) or name == "seconds"
        case list():
            return name == "arguments" and all(isinstance(word, str) for word in value)
        case dict():
            return name == "record"
        case float():
            return name == "seconds"
        case _:
            return isinstance(value, str) and name in ("sequence", "glance", "content", "line")


def write_note(path: Path, note: dict[str, Any]) -> None:
    """Replace the state of a sequence atomically."""
    part = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}.part")
    part.unlink(missing_ok=True)
    try:
        with open(part, "x") as file:
            file.write(json.dumps(note) + "\n")
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def open_log(path: Path) -> BinaryIO:
    """Open the log of a sequence for appending; what is no regular file there, as a link, is replaced.

    Raises:
        OSError: if it cannot be opened.
    """
    with suppress(FileNotFoundError):
        if not stat.S_ISREG(os.lstat(path).st_mode):
            path.unlink()
    flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    return os.fdopen(os.open(path, flags, 0o666), "ab")


def standing(job: Job, note: dict[str, Any] | None = None) -> Standing:
    """Return the progress of a job from its files."""
    note = read_note(job.note) if note is None else note
    if not note:
        return "new"
    complete = note.get("status") in ENDED
    if complete and not (job.run / "report.json").is_file():
        return "new"  # the run was removed
    alike = note.get("sequence") == job.sequence and note.get("arguments") == list(job.arguments)
    same = alike
    if alike and note.get("glance") != fingerprint(job, content=False):
        same = note.get("content") == fingerprint(job, content=True)  # copied or touched, perhaps
    if not same:
        return "new" if not complete else "changed" if alike else "other"
    if complete:
        return "done"
    return "failed" if note.get("tries", 0) >= TRIES and not job.again else "interrupted"


class Processes:
    """The processes that this one has started and not yet seen the end of."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._running: set[subprocess.Popen[bytes]] = set()
        self._open = True

    def run(self, command: list[str], environment: dict[str, str], log: int) -> int | None:
        """Run a command and return its exit status; None where `ended` ended it.

        Its standard input is a pipe that this process holds open: at the end of it the command knows that this process
        is no more. Ctrl-C at the terminal does not reach it.
        """
        with self._lock:
            if not self._open:
                return None
            process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=log, stderr=log, env=environment, start_new_session=True
            )
            self._running.add(process)
        status = process.wait()
        if process.stdin is not None:
            process.stdin.close()
        with self._lock:
            if process not in self._running:
                return None
            self._running.discard(process)
        return status

    @contextmanager
    def ended(self) -> Iterator[None]:
        """Kill the processes that still run at the end of the block."""
        self._open = True
        try:
            yield
        finally:
            with self._lock:
                self._open = False
                running = list(self._running)
                self._running.clear()
            for process in running:
                process.kill()  # a build that is killed loses the pair under way, and nothing else


PROCESSES = Processes()  # those of this process: engines run jobs in threads of it, or elsewhere


def run(job: Job) -> Ended | None:
    """Build a sequence unless that is done already; None if the process was ended from here.

    Whoever else works on the same sequence is waited for. The process that builds dies with this one.

    Raises:
        OSError: if no file can be written in the folder of the batch.
    """
    job.log.parent.mkdir(parents=True, exist_ok=True)
    with open_log(job.log) as log:
        fcntl.flock(log, fcntl.LOCK_EX)  # shared by the process that builds, also where this one dies before it
        now = standing(job)
        if now in ("done", "failed"):
            return ended(job.name, read_note(job.note))
        for left in job.note.parent.glob(f".{glob.escape(job.note.name)}.*.part"):  # by a kill
            left.unlink(missing_ok=True)
        log.truncate(0)
        command = [sys.executable, "-m", BUILDER, json.dumps(asdict(job))]
        threads = dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "RAYON_NUM_THREADS"), str(job.threads))
        status = PROCESSES.run(command, environment() | threads, log.fileno())
        if status is None:
            return None
        note = read_note(job.note)
        if note.get("status") == status and status in ENDED:
            return ended(job.name, note)
        return write_failure(job, last_line(job.log, status), 128 - status if status < 0 else status)


def write_failure(job: Job, line: str, status: int = 2) -> Ended:
    """Record a (further) failure of a job, and return how it ended.

    Raises:
        OSError: if the note cannot be written.
    """
    job.note.parent.mkdir(parents=True, exist_ok=True)
    note = read_note(job.note)
    tries = note.get("tries", 0) + 1
    note |= {"sequence": job.sequence, "arguments": list(job.arguments), "status": status, "line": line}
    write_note(job.note, note | {"tries": 1 if job.again and tries > TRIES else tries})
    return ended(job.name, read_note(job.note))


def ended(name: str, note: dict[str, Any]) -> Ended:
    """Return how a job ended, from its state."""
    return Ended(name, int(note.get("status", 2)), str(note.get("line", "")), int(note.get("tries", 0)))


def last_line(log: Path, status: int) -> str:
    """Return the last message of a build, or the signal that killed it."""
    if status < 0:
        return f"was killed by signal {-status}; is memory exhausted? See {log}"
    lines = log.read_text(errors="replace").splitlines()
    said = next((line for line in reversed(lines) if line.startswith(_LINE)), "")
    return said.removeprefix(_LINE) or f"ended with status {status} and no message; see {log}"
