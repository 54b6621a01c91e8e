"""Jobs on an engine, until each has ended."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Executor, Future
from queue import SimpleQueue

from modeler.batch.engines import engine
from modeler.batch.jobs import PROCESSES, TRIES, Ended, Job, read_note, run, write_failure
from modeler.types import InputError

_LOSSES = 3  # how often an engine may lose a job
_RETURNS_S = 120.0  # time to wait for a lost engine
_LAGS_S = 60.0  # that a shared disk may show what other machines wrote: NFS keeps folders for so long (acdirmax)


def results(
    jobs: Sequence[Job],
    engine_name: str,
    workers: int | None,
    opened: Callable[[], None],
    say: Callable[[str], None],
) -> Iterator[Ended]:
    """Yield the end of each job as it occurs; a lost engine is awaited.

    Args:
        jobs: to run.
        engine_name: see `engine`.
        workers: how many at a time; None: as many as fit.
        opened: called once the engine is open.
        say: receives what happens to the engine, in words.

    Raises:
        InputError: if it cannot be opened, or does not come back.
    """
    waiting, losses = {job.name: job for job in jobs}, Counter[str]()
    given_up_s = 0.0
    while waiting:
        try:
            with engine(engine_name, workers) as executor, PROCESSES.ended():
                if not given_up_s:
                    opened()
                yield from _until_lost(executor, waiting, losses)
        except InputError:
            if time.monotonic() > given_up_s:
                raise
            time.sleep(1.0)
            continue
        if waiting:
            say("the connection to the engine was lost: waiting for it")
            given_up_s = time.monotonic() + _RETURNS_S


def _until_lost(executor: Executor, waiting: dict[str, Job], losses: Counter[str]) -> Iterator[Ended]:
    """Yield how jobs ended, and take them off those that wait; return early where the engine is lost."""
    ended: SimpleQueue[tuple[Job, Future[Ended | None]]] = SimpleQueue()

    def submit(job: Job) -> None:
        executor.submit(run, job).add_done_callback(lambda future: ended.put((job, future)))

    for job in waiting.values():
        submit(job)
    while waiting:
        job, future = ended.get()
        try:
            one = future.result()
        except Exception as error:  # whatever an engine raises
            losses[job.name] += 1
            if losses[job.name] <= _LOSSES:
                if isinstance(error, CancelledError):
                    return
                submit(job)
                continue
            one = write_failure(job, f"the engine lost it ({type(error).__name__}: {error})")
        if one is None:
            continue
        if one.status not in (0, 3) and one.tries < TRIES:
            submit(job)
            continue
        _await_note(job, one)
        del waiting[job.name]
        yield one


def _await_note(job: Job, one: Ended) -> None:
    """Wait until the state that a job wrote, perhaps elsewhere, is seen here, from where models are listed."""
    given_up_s = time.monotonic() + _LAGS_S
    while read_note(job.note).get("status") != one.status and time.monotonic() < given_up_s:
        time.sleep(0.2)
