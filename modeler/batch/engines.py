"""Engines of a batch, any `concurrent.futures.Executor`, and jobs on them until each has ended."""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
import shutil
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from threading import Lock
from typing import Any, TypeVar

from modeler.batch.jobs import PROCESSES, TRIES, Ended, Job, read_note, run, write_failure
from modeler.system.processes import check_installed, cores, environment
from modeler.types import InputError

T = TypeVar("T")

JOB_BYTES = 3 << 29  # memory of one build with its recording: most need half of it
_QUEUED = 100  # jobs in a Slurm queue at a time, unless --workers is given
_PATIENCE_S = 30  # for a scheduler to answer


def free_bytes() -> int:
    """Return how much memory is left, for this machine and for the control group of this process."""
    pages = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    with contextlib.suppress(OSError, ValueError):  # on Linux, including caches that can be freed
        lines = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        pages = int(lines["MemAvailable"].split()[0]) * 1024
    with contextlib.suppress(OSError, ValueError):  # "max": no limit
        group = Path("/sys/fs/cgroup")
        pages = min(pages, int((group / "memory.max").read_text()) - int((group / "memory.current").read_text()))
    return pages


def usual_workers() -> int:
    """Return how many builds fit: one a core, as long as there is memory for them."""
    return max(1, min(cores(), free_bytes() // JOB_BYTES))


def check_engine(name: str) -> None:
    """Reject unknown names of engines."""
    kind, _, what = name.partition(":")
    if name != "processes" and not what:
        raise InputError(
            f"`executor` {name} is unknown; give processes, dask:ADDRESS, slurm:FOLDER, or module:callable for your own"
        )
    package = {"dask": "distributed", "slurm": "submitit"}.get(kind)
    if package is not None:
        check_installed(package, package, kind)


def is_here(name: str) -> bool:
    """Return whether the engine runs jobs in threads of this process, and on this machine."""
    return name == "processes"


def threads_of(name: str, workers: int) -> int:
    """Return the number of threads of each build: the local cores are shared; elsewhere a slot has one."""
    return max(1, cores() // workers) if is_here(name) else 1


@contextlib.contextmanager
def engine(name: str, workers: int | None) -> Iterator[Executor]:
    """Open an engine for the block, and close it without starting its remaining jobs.

    Args:
        name: `processes`, `dask:ADDRESS`, `slurm:FOLDER`, or `module:callable`, called with the number of workers.
        workers: how many jobs at a time; None: as many as fit.

    Raises:
        InputError: if there is no answer, or the callable returns no executor.
    """
    kind, _, what = name.partition(":")
    if name == "processes":
        executor: Executor = ThreadPoolExecutor(workers or usual_workers())
    elif kind == "dask":
        with _dask(what) as executor:
            yield executor
        return
    elif kind == "slurm":
        executor = SubmititExecutor(_slurm(Path(what)), workers or (_QUEUED if _has_slurm() else usual_workers()))
    else:
        executor = _own(name, kind, what, workers)
    try:
        yield executor
    finally:
        executor.shutdown(wait=False, cancel_futures=True)


@contextlib.contextmanager
def _dask(address: str) -> Iterator[Executor]:
    """Open an existing cluster through its executor interface."""
    distributed = importlib.import_module("distributed")
    for name in logging.root.manager.loggerDict:
        if name.startswith("distributed"):  # each has its own level; we report errors
            logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        distributed.comm.get_address_host(address)  # a client that was begun with nonsense would linger
        client = distributed.Client(address, timeout=_PATIENCE_S, set_as_default=False)
    except (OSError, ValueError) as error:  # TimeoutError is an OSError
        raise InputError(f"`executor` dask:{address}: no scheduler answers there ({error}); start one") from None
    try:
        yield client.get_executor(pure=False)  # a job that is tried again is no result that is known
    finally:
        with contextlib.suppress(Exception):  # a scheduler that is gone needs no farewell
            client.close(timeout=5)


def _slurm(folder: Path) -> Any:
    """Return submitit's executor, for Slurm where that is there, else for this machine."""
    os.environ.update(environment())  # that of the jobs
    executor = importlib.import_module("submitit").AutoExecutor(
        folder=folder, cluster="slurm" if _has_slurm() else "local"
    )
    executor.update_parameters(name="modeler", cpus_per_task=1, mem_gb=JOB_BYTES / 2**30, timeout_min=60)
    return executor


def _has_slurm() -> bool:
    return shutil.which("srun") is not None


class SubmititExecutor(Executor):
    """Jobs of submitit as futures: a thread waits for each that is in the queue."""

    def __init__(self, jobs: Any, queued: int) -> None:
        """Take submitit's executor, and how many jobs may be in the queue at a time."""
        self._jobs, self._waiting = jobs, ThreadPoolExecutor(queued)
        self._begun: set[Any] = set()
        self._one_by_one = Lock()

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """Queue a call once there is room."""
        return self._waiting.submit(self._result, fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Accept no more jobs; remove queued ones if `cancel_futures` is set."""
        self._waiting.shutdown(wait=False, cancel_futures=cancel_futures)
        for job in [*self._begun] if cancel_futures else ():
            job.cancel(check=False)
        self._waiting.shutdown(wait=wait)

    def _result(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> T:
        with self._one_by_one:
            job = self._jobs.submit(fn, *args, **kwargs)
        self._begun.add(job)
        try:
            return job.result()
        finally:
            self._begun.discard(job)


def _own(name: str, module: str, attribute: str, workers: int | None) -> Executor:
    """Return the executor that a callable of the user's makes."""
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        executor = getattr(importlib.import_module(module), attribute)(workers)
    except Exception as error:  # whatever a user's module raises
        raise InputError(
            f"`executor` {name}: cannot be created ({type(error).__name__}: {error}); correct it"
        ) from error
    if not isinstance(executor, Executor):
        raise InputError(f"`executor` {name}: returns no concurrent.futures.Executor; derive it from that class")
    return executor


_RETURNS_S = 120.0  # time to wait for a lost engine, until a network is back


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
            if losses[job.name] <= 3:
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
    given_up_s = time.monotonic() + 60.0  # a shared disk may lag: NFS keeps folders for so long (acdirmax)
    while read_note(job.note).get("status") != one.status and time.monotonic() < given_up_s:
        time.sleep(0.2)
