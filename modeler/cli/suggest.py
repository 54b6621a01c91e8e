"""`modeler suggest`: what to do next."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from modeler.cli.console import say
from modeler.cli.options import MovedOptions
from modeler.composition.options import default

if TYPE_CHECKING:
    from modeler.suggestion import Goal


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
