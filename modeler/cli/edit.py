"""`modeler edit`, `join` and `suggest`: models anew from finished runs, and what to do next."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from modeler.cli.console import as_options, say, trusted_status
from modeler.cli.options import MovedOptions
from modeler.composition.options import SEED, default

if TYPE_CHECKING:
    from modeler.suggestion import Goal
    from modeler.types import Verdict


@dataclass(frozen=True)
class Edit:
    """Take frames out of a finished run, and optimise and fuse the rest without registering again.

    Frames that the run left out can be taken out as well: the verdict is then on those that are left.
    """

    run_folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """Run folder of `modeler build` or `modeler join`."""
    drop: Annotated[str | None, tyro.conf.arg(metavar="N,..."), default("none")] = None
    """Numbers of the frames to take out: 7,12 or ranges 7:10, the end not included."""
    keep: Annotated[str | None, tyro.conf.arg(metavar="N,..."), default("all")] = None
    """Numbers of the frames to keep, instead."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="RUN2"), default("RUN itself, which is replaced")] = None
    """Run folder to create."""
    overwrite: bool = False
    """Replace the results of an earlier run in RUN2."""

    def run(self) -> int:
        """Edit the run; status 3 if the result cannot be trusted; report.json has the reasons."""
        from modeler.export import RunFolder
        from modeler.runs.joining import edit
        from modeler.runs.outputs import check_run_folder, run_inputs
        from modeler.types import InputError

        if (self.drop is None) == (self.keep is None):
            raise InputError("give the frames to take out with --drop, or those to keep with --keep")
        frames = sorted(record["id"] for record in RunFolder(self.run_folder).result()["frames"])
        chosen = _numbers(self.drop or self.keep or "", frames)
        dropped = chosen if self.keep is None else [frame for frame in frames if frame not in chosen]
        out = self.out or self.run_folder
        if out.resolve() != self.run_folder.resolve():
            check_run_folder(out, run_inputs([self.run_folder]), overwrite=self.overwrite)
        if not dropped:
            raise InputError(
                f"{self.run_folder}: no frame would be taken out; name some of {frames[0]} to {frames[-1]}"
            )
        report, verdict, unconnected = edit(self.run_folder, dropped, out, overwrite=self.overwrite)
        left = len(report["poses"])
        say(f"{len(dropped)} of {len(frames)} frames taken out, {left} left: {out}")
        if unconnected:
            say(f"left out, too, as nothing else joins them to the rest: {', '.join(map(str, unconnected))}")
        return _ended(report, verdict, out)


def _numbers(text: str, frames: Sequence[int]) -> list[int]:
    """Return the numbers that a list names, those in ranges only where they are frames."""
    from modeler.types import InputError

    found: list[int] = []
    for part in text.split(","):
        first, colon, end = (piece.strip() for piece in part.partition(":"))
        if not all(piece.isdecimal() or (colon and not piece) for piece in ((first, end) if colon else (first,))):
            raise InputError(f"{text[:99]!r} is no list of frames; write numbers and ranges, such as 7,12 or 7:10,15")
        if colon:
            low, high = int(first or frames[0]), int(end or frames[-1] + 1)
            found += [frame for frame in frames if low <= frame < high]
        else:
            found.append(int(first))
    return found


@dataclass(frozen=True)
class Join:
    """Join two runs of the same object in different postures, so that the model has no hidden side.

    They are joined like the segments of a build before and after the object was laid down differently: the models are
    aligned from many initial rotations, pairs of their views registered, and the frames of both fused into one model in
    the object frame of RUN_A.
    """

    run_a: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN_A")]
    """Run folder of one posture (upright, say)."""
    run_b: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN_B")]
    """Run folder of the other (lying, say)."""
    out: Annotated[Path, tyro.conf.arg(metavar="RUN")]
    """Run folder to create. Frame numbers of RUN_B continue those of RUN_A."""
    overwrite: bool = False
    """Replace the results of an earlier run in the folder."""
    pairs: Annotated[int, tyro.conf.arg(metavar="N")] = 6
    """Number of pairs of views, one of each run, to register."""
    seed: Annotated[int, SEED] = 0
    """Same seed, same machine, same result, to the bit."""

    def run(self) -> int:
        """Join the runs; status 3 if the result cannot be trusted; report.json has the reasons."""
        from modeler.runs.joining import join

        _check(self)
        (best, *others), report, verdict = join(
            self.run_a, self.run_b, self.out, pairs=self.pairs, seed=self.seed, overwrite=self.overwrite
        )
        ways = f", of {len(others) + 1} ways" if others else ""
        say(f"models aligned: {100.0 * best.share:.3g} % likely{ways}")
        frames = len(report["poses"])
        say(f"{best.accepted} of {len(best.edges)} pairs registered, {frames} frames joined: {self.out}")
        return _ended(report, verdict, self.out)


def _ended(report: Mapping[str, Any], verdict: Verdict, out: Path) -> int:
    """Say why a model is not to be trusted and what can be done without another build; return the exit status."""
    from modeler.priors import GeneralPrior
    from modeler.verdict.advice import remedies

    status = trusted_status(verdict)
    for remedy in remedies(report, GeneralPrior()):
        if not remedy.parameters:
            say(as_options(f"{remedy.words}: {remedy.first.format(run=shlex.quote(str(out)))}"))
    return status


def _check(options: Join) -> None:
    """Refuse options out of range, and a folder that holds something."""
    from modeler.export import locked
    from modeler.runs.outputs import check_run_folder, run_inputs
    from modeler.types import InputError

    if options.pairs < 1:
        raise InputError(f"--pairs {options.pairs} is out of range; give at least 1")
    if options.run_a.resolve() == options.run_b.resolve():
        raise InputError(f"RUN_A and RUN_B are both {options.run_a}; name two runs")
    check_run_folder(options.out, run_inputs([options.run_a, options.run_b]), overwrite=options.overwrite)
    if options.out.is_dir():
        with locked(options.out):  # asked now, not only when the work is done
            pass


@dataclass(frozen=True)
class Suggest:
    """Suggest what to do next: the turn, poke or view with the most information on poses and surface.

    Prints a ranked list with the predicted gain of each action, from the model, its uncertainty and unobserved surface.
    With a goal (--until-...), the status is 0 if it is reached, else 3.
    """

    run_folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """Run folder of `modeler build`."""
    candidates: Annotated[Path | None, tyro.conf.arg(metavar="FILE"), default("turns, pokes, laying it down")] = None
    """Possible actions with costs: JSON or TOML, or CSV of poses (docs/next.md)."""
    until_sigma_mm: Annotated[float | None, tyro.conf.arg(metavar="MM"), default("none")] = None
    """Goal: largest standard deviation of the surface of a view, from noise and pose."""
    until_seen: Annotated[float | None, tyro.conf.arg(metavar="SHARE"), default("none")] = None
    """Goal: share (0 to 1) of the surface visible by turns on the table that was observed."""
    until_pose_deg: Annotated[float | None, tyro.conf.arg(metavar="DEG"), default("none")] = None
    """Goal: largest standard deviation of a pose's rotation."""
    all: bool = False
    """List all actions, not only the best."""
    json: bool = False
    """Write the list as JSON, for programs."""
    moved: MovedOptions = field(default_factory=MovedOptions)

    def run(self) -> int:
        """Print the list; status 3 if a goal was given and is not reached."""
        from modeler.composition.candidate_file import read_candidates
        from modeler.runs.reopening import reopened
        from modeler.suggestion import suggest
        from modeler.types import InputError

        goal = self._goal()
        given = None if self.candidates is None else read_candidates(self.candidates)
        run = reopened(self.run_folder, self.moved.sequence, say)
        part, *others = run.parts
        if others:
            raise InputError(f"{self.run_folder}: joins several runs; give one of them")
        found = suggest(part.modeler().belief(run.views, run.solution, run.edges), given, goal)
        if self.json:
            print(json.dumps([each.record() for each in found.ranked], allow_nan=False, indent=1))
        else:
            shown = found.ranked if self.all else found.best
            for each in () if found.reached else shown:
                print(each.words)
        if given is not None and found.excluded:
            say(f"{found.excluded} of {len(given)} candidates are excluded by the run's prior, or show nothing")
        trusted = bool(run.report["trustworthy"])
        if not trusted:
            reason = next(iter(run.report.get("reasons") or ()), "see its report.json")
            say(f"the run is not to be trusted, and so neither are these predictions: {reason}")
        if goal is None:
            say(found.summary)
            return 0
        doubt = "" if trusted else ", but the run cannot be trusted (see its report.json)"
        say(f"goal reached{doubt}: {found.summary}" if found.reached else f"goal not reached: {found.summary}")
        return 0 if found.reached and trusted else 3

    def _goal(self) -> Goal | None:
        """Return the goal that the user gave."""
        from modeler.suggestion import Goal
        from modeler.types import InputError

        limits = {"mm": self.until_sigma_mm, "deg": self.until_pose_deg, "share": self.until_seen}
        names = {"mm": "--until-sigma-mm", "deg": "--until-pose-deg", "share": "--until-seen"}
        for unit, value in limits.items():
            largest = 1.0 if unit == "share" else math.inf
            if value is not None and not (0.0 < value <= largest and math.isfinite(value)):
                wanted = "a share above 0 and up to 1" if unit == "share" else f"a positive number of {unit}"
                raise InputError(f"{names[unit]} {value:g} is out of range; give {wanted}")
        if all(value is None for value in limits.values()):
            return None
        return Goal(
            pose_deg=math.inf if self.until_pose_deg is None else self.until_pose_deg,
            seen=0.0 if self.until_seen is None else self.until_seen,
            sigma_m=None if self.until_sigma_mm is None else 1e-3 * self.until_sigma_mm,
        )
