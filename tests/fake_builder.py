"""Stands in for the process that builds a sequence: pairs that take no time, and a book of which were registered."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

from modeler.batch.jobs import ENDED, Processes, write_note
from modeler.cli.one_job import begin, end_with_the_parent

BOOK = "book.txt"
"""Lines `name pair pid`, one a registration, in the folder of the batch."""


PATIENCE_S = 60.0
_STARTED = """
import sys
from modeler.batch import jobs
from modeler.cli import main
jobs.BUILDER = "fake_builder"
sys.exit(main(sys.argv[1:]))
"""


def sequence(folder: Path, *, pairs: int = 3, status: int = 0, pause_s: float = 0.0, fails: int = 0) -> Path:
    """Make a sequence that ends with a status once it has failed so often.

    Args:
        folder: where.
        pairs: how many it has.
        status: how its build ends.
        pause_s: how long a pair takes.
        fails: how often the build is killed before.
    """
    folder.mkdir(parents=True)
    given = {"pairs": pairs, "status": status, "pause_s": pause_s, "fails": fails}
    (folder / "given.json").write_text(json.dumps(given))
    return folder


def book(out: Path) -> list[tuple[str, int]]:
    """Return the registrations of a batch in order: name and pair."""
    lines = (out / BOOK).read_text().splitlines() if (out / BOOK).exists() else []
    return [(line.split()[0], int(line.split()[1])) for line in lines]


def started(*arguments: object) -> subprocess.Popen[str]:
    """Start a batch, whose builds this file stands in for, in a process of its own."""
    command = [sys.executable, "-c", _STARTED, "batch", *map(str, arguments)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)


def wait_for(condition: Callable[[], object]) -> None:
    """Return when a condition comes true."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def build(words: str, say: Callable[[str], object]) -> int:
    """Build the sequence of a job (JSON), and return the status with which a process would end."""
    job, note = begin(words)
    given = json.loads((Path(job.sequence) / "given.json").read_text())
    (job.run / ".pairs").mkdir(parents=True, exist_ok=True)
    for pair in range(given["pairs"]):
        kept = job.run / ".pairs" / f"{pair}"
        if kept.exists():
            continue
        with open(Path(job.out) / BOOK, "a") as lines:
            lines.write(f"{job.name} {pair} {os.getpid()}\n")
        time.sleep(given["pause_s"])
        kept.touch()
    failed = job.run / "failed"
    failures = len(failed.read_text()) if failed.exists() else 0
    if failures < given["fails"]:
        failed.write_text("x" * (failures + 1))
        return -signal.SIGABRT
    status = int(given["status"])
    if status in ENDED:
        (job.run / "report.json").write_text("{}")
        record = {"trustworthy": status == 0, "reasons": [] if status == 0 else ["made up"], "frames": 4}
        write_note(job.note, {**note, "status": status, "record": record})
    else:
        say(f"modeler: {job.sequence}: cannot be built\n")
    return status


def run_here(_: Processes, command: list[str], environment: dict[str, str], log: int) -> int:
    """Do in this process what `Processes.run` has another do."""
    return build(command[-1], lambda line: os.write(log, line.encode()))


def main() -> int:
    threading.Thread(target=end_with_the_parent, daemon=True).start()
    status = build(sys.argv[1], sys.stderr.write)
    if status < 0:
        os.kill(os.getpid(), -status)
    return status


if __name__ == "__main__":
    sys.exit(main())
