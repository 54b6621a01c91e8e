"""`modeler calibrate-camera`: the focal length from the loops of a run."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from modeler.cli.console import say
from modeler.cli.options import MovedOptions

if TYPE_CHECKING:
    from modeler.types import FocalLength


_OPEN = 0.005  # of sizes: less is not reported


@dataclass(frozen=True)
class CalibrateCamera:
    """Estimate a depth camera's focal length from a run in which the object came back to its first view.

    A wrong focal length makes all rotations too small or too large, so that a full turn does not close. Depth with too
    flat a relief, as from smoothing and hole filling, has the same effect: loops cannot separate the two, and the size
    of the model depends on which it is. Steps and spans of a partial turn determine the focal length, too, but less.
    `modeler build SEQUENCE --camera FILE` uses the result for any sequence of the same camera.
    """

    run_folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """Run folder of `modeler build`, of a full turn. Its loop may have been rejected as contradicting the chain; its
    consecutive pairs must be right."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """JSON file to write."""
    overwrite: bool = False
    """Replace an existing file."""
    known: Literal["neither", "focal-length", "depth"] = "neither"
    """What is accurate in the sequence: focal-length (a calibrated camera; the depth is wrong) or depth (unfiltered;
    the focal length is nominal). neither: half of the error is attributed to each, and a model that may be wrong by
    more than 5 mm for this reason is not trusted."""
    moved: MovedOptions = field(default_factory=MovedOptions)

    def run(self) -> int:
        """Estimate the focal length and store it; status 3 if no loop determines it.

        Raises:
            InputError: if the run cannot be used or the file cannot be written.
        """
        from modeler.cli.inputs import reopened
        from modeler.cli.outputs import check_files, run_inputs
        from modeler.export import write_atomically
        from modeler.graph.self_calibration import FocalCalibrator
        from modeler.sequences import FocalFactor
        from modeler.types import InputError

        check_files([self.out], run_inputs([self.run_folder], self.moved.sequence), overwrite=self.overwrite)
        run = reopened(self.run_folder, self.moved.sequence)
        part, *others = run.parts
        if others:
            raise InputError(f"{self.run_folder}: joins several runs; calibrate with one of them")
        modeler = part.modeler()
        found = FocalCalibrator().estimate(run.views, run.edges, run.sensor, modeler.register, modeler.prior)
        used_px = run.views[min(run.views)].frame.camera.fx
        factor = found.factor * (run.report.get("camera") or {}).get("focal_factor", 1.0)
        share = {"neither": 0.5, "focal-length": 1.0, "depth": 0.0}[self.known]
        open_by = abs(math.log(factor)) if self.known == "neither" else 0.0
        given_px = used_px * found.factor / factor
        result = FocalFactor(factor, given_px, factor**share, 0.5 * open_by, found.sigma, found.told_by)
        open_sds = {"sigmas_before": found.sigmas_before, "sigmas_after": found.sigmas_after} if found.loops else {}
        facts = {"sigmas_before": None, "sigmas_after": None, **open_sds, "loops": found.loops}
        write_atomically(self.out, result.text({**facts, "fx_px": found.factor * used_px, "run": str(self.run_folder)}))
        say(f"{_said(found, used_px, given_px)}: {self.out}")
        if found.told_by == "loop" and result.depth_scale_sigma >= _OPEN:
            say(
                f"or the relief of the depth is wrong by {100.0 * open_by:.0f} %; sizes are known only to "
                f"{100.0 * result.depth_scale_sigma:.0f} %: give --known to say which of the two is accurate"
            )
        return 0 if found.told_by == "loop" else 3


def _said(found: FocalLength, used_px: float, given_px: float) -> str:
    from modeler.cli.advice import focal_length_found, graph_cycles

    if found.told_by == "prior" and found.loops:
        return (
            f"{graph_cycles(found.loops)} do not determine the focal length: closure error of "
            f"{found.sigmas_before:.1f} sd as given, "
            f"{found.sigmas_after:.1f} sd with the best one; if this is large, an edge is wrong: see the worst pairs "
            "in the run's report"
        )
    if found.told_by == "prior":
        return (
            "no loop determines the focal length; turn the object fully, with overlapping steps, and use a motion "
            "prior (--prior table)"
        )
    focal_px = used_px * found.factor
    before = "as given" if f"{used_px:.1f}" == f"{given_px:.1f}" else f"with the run's {used_px:.1f} px"
    sds = found.sigmas_after, found.sigmas_before
    return focal_length_found((focal_px, focal_px * found.sigma), given_px, found.loops, sds, before)
