"""One job of a batch in a process of its own: `python -m modeler.cli.one_job JOB`, JOB in JSON.

It ends with its standard input, that is, with the process that started it.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from modeler.batch.jobs import Job


def main() -> int:
    """Build the sequence of a job, and note the result; the exit status is that of the build."""
    began_s = time.perf_counter()
    threading.Thread(target=end_with_the_parent, daemon=True).start()
    from modeler.batch.jobs import ENDED, write_note
    from modeler.cli import main as command

    job, note = begin(sys.argv[1])
    status = command(["build", job.sequence, "--out", str(job.run), "--resume", *job.arguments])
    if status in ENDED:
        from modeler.batch.models import record_of

        if job.page:
            command(["report", str(job.run), "--overwrite"])
        ended = {"status": status, "seconds": time.perf_counter() - began_s}
        write_note(job.note, {**note, **ended, "record": record_of(job.run)})
    return status


def begin(words: str) -> tuple[Job, dict[str, Any]]:
    """Return a job and its initial note, which is written; results of builds with other options are deleted."""
    from modeler.batch.jobs import Job, fingerprint, read_note, standing, write_note

    values = json.loads(words)
    job = Job(**{**values, "arguments": tuple(values["arguments"])})
    before = read_note(job.note)
    now = standing(job, before)
    if now in ("changed", "other"):
        from modeler.export import RunFolder, locked

        # Frames that have not changed need not be registered.
        resumes = now == "changed" and RunFolder(job.run).is_sound
        with locked(job.run):
            RunFolder.open(job.run, overwrite=not resumes, resume=resumes)
    note = {
        "sequence": job.sequence,
        "arguments": list(job.arguments),
        "glance": fingerprint(job, content=False),
        "content": fingerprint(job, content=True),
        "tries": before.get("tries", 0) if now == "interrupted" else 0,
    }
    write_note(job.note, note)
    return job, note


def end_with_the_parent() -> None:
    """End this process at the end of its standard input."""
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGKILL)  # as if both had been killed: files on disk are complete


if __name__ == "__main__":
    sys.exit(main())
