"""`modeler batch`: many sequences to models, on any engine."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from modeler.cli.console import bar, say
from modeler.cli.options import AbstractBuild
from modeler.composition.options import default

if TYPE_CHECKING:
    from modeler.batch.jobs import Ended, Job

_OVER = ("done", "failed")
_LISTED = 20  # sequences without a good model that are listed individually


@dataclass(frozen=True)
class Batch(AbstractBuild):
    """Build models of many sequences, each into its own run folder below DIR, and list them in DIR/models.parquet.

    The options of `modeler build` apply to every sequence. When repeated, the same command skips finished sequences,
    resumes interrupted ones and those with other frames than before, and retries those that failed once. Ctrl-C, or a
    kill, loses only the pair in progress of each sequence.

    Exit status: 0 if every model can be trusted, 3 if some cannot or are missing, 2 for wrong usage.
    """

    sequences: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(metavar="SEQUENCE...", help_behavior_hint="(or --manifest)"),
    ] = ()
    """Sequences in any format that `modeler build` takes."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = field(kw_only=True)
    """Folder for the run folders and the list of models."""
    manifest: Annotated[Path | None, tyro.conf.arg(metavar="FILE.csv"), default("none")] = None
    """Table of sequences: a column `sequence`, optionally `name` for the run folder, and any option of `modeler build`
    as a column, for that row alone: prior, step-deg, frames, ..."""
    executor: Annotated[str, tyro.conf.arg(metavar="ENGINE")] = "processes"
    """processes: on this machine. dask:ADDRESS: on the Dask cluster of that scheduler.
    slurm:FOLDER: Slurm jobs, with files in FOLDER; local processes without Slurm.
    module:callable: the concurrent.futures.Executor that the callable returns for --workers."""
    workers: Annotated[int | None, tyro.conf.arg(metavar="N"), default("as cores and memory allow")] = None
    """Number of sequences at a time (Slurm: in the queue); a cluster has its own number."""
    overwrite: bool = False
    """Build sequences again that were built with other options."""
    again: bool = False
    """Retry sequences that failed twice."""
    pages: bool = False
    """Also write the HTML report of each model (some 10 s each)."""

    def run(self) -> int:
        """Build the remaining sequences, and list all.

        Raises:
            InputError: if options, the manifest, the engine or the folder cannot be used.
            KeyboardInterrupt: after the finished sequences have been listed.
        """
        from modeler.batch.engines import check_engine, is_here, results
        from modeler.batch.jobs import ended, read_note, standing
        from modeler.batch.models import write_models
        from modeler.export import locked
        from modeler.runs.compiling import compile_kernels
        from modeler.runs.outputs import check_folder
        from modeler.types import InputError

        if self.workers is not None and self.workers < 1:
            raise InputError(f"--workers {self.workers} is out of range; give a whole number from 1")
        check_engine(self.executor)
        check_folder(self.out, self.sequences)
        with locked(self.out):
            jobs = _jobs(self)
            check_folder(self.out, [Path(job.sequence) for job in jobs])
            stands = {job: standing(job) for job in jobs}
            others, changed = (
                [job.name for job, how in stands.items() if how == kind] for kind in ("other", "changed")
            )
            if others and not self.overwrite:
                raise InputError(
                    f"{self.out / others[0]}: was built with other options, as were {len(others)} in all; give "
                    "--overwrite to build these again, or choose another --out"
                )
            if changed:
                say(f"the input of {_some(changed)} has changed since: only pairs that are new are registered")
            ends = [ended(job.name, read_note(job.note)) for job in jobs if stands[job] in _OVER]
            waiting = [job for job in jobs if stands[job] not in _OVER]
            stand = Counter(stands.values())
            words = f"{stand['done']} done, {stand['failed']} failed twice, {stand['interrupted']} to be resumed"
            begun = stand["new"] + stand["changed"] + stand["other"]
            words = f"{len(jobs)} {_sequences(len(jobs))}: {words}, {begun} to be built"
            if not waiting:
                say(words)
            elif is_here(self.executor):
                compile_kernels(say)  # once, not in every build
            try:
                with bar() as progress:
                    task = progress.add_task("", total=len(jobs), completed=len(ends))
                    for one in results(waiting, self.executor, self.workers, lambda: say(words), say):
                        ends.append(one)
                        progress.update(task, advance=1, description=one.name)
            finally:
                write_models(self.out)
        return _summarise(self, ends)


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:_LISTED]) + (f" and {len(names) - _LISTED} more" if len(names) > _LISTED else "")


def _sequences(count: int) -> str:
    return "sequence" if count == 1 else "sequences"


def _jobs(options: Batch) -> list[Job]:
    """Return a job for each sequence, in order, each with a name of its own."""
    from modeler.batch.engines import threads_of, usual_workers
    from modeler.batch.jobs import Job
    from modeler.cli.manifest import Row, named, read_manifest
    from modeler.types import InputError

    common = options.arguments()
    rows = [Row(path, f"{path}") for path in options.sequences]
    if options.manifest is not None:
        rows += read_manifest(options.manifest, common)
    if not rows:
        raise InputError("no sequence to build; name at least one, or give --manifest FILE.csv")
    workers = options.workers or usual_workers()
    return [
        Job(
            name,
            str(row.sequence.absolute()),
            str(options.out.absolute()),
            (*common, *row.arguments),
            threads=threads_of(options.executor, min(workers, len(rows))),
            page=options.pages,
            again=options.again,
        )
        for name, row in named(rows, options.out).items()
    ]


def _summarise(options: Batch, ends: Sequence[Ended]) -> int:
    """Print a summary of the sequences, and return the exit status."""
    good = sum(one.status == 0 for one in ends)
    doubtful = sum(one.status == 3 for one in ends)
    others = [one for one in ends if one.status not in (0, 3)]
    for one in others[:_LISTED]:
        say(f"{one.name} failed: {one.line}")
    more = f" ({len(others) - _LISTED} more are listed there)" if len(others) > _LISTED else ""
    failed = f"{len(others)} {_sequences(len(others))} failed{more}"
    say(f"{good} of {len(ends)} models can be trusted, {doubtful} cannot, {failed}: {options.out / 'models.parquet'}")
    return 0 if good == len(ends) else 3
