"""Focal lengths estimated from loops, against the truth: `python -m studies loops.focal_lengths`.

Each shape is pushed about a table for a full turn; its given intrinsics have an error of 2 to 8 %. The table has the
estimate of the run relative to the true focal length, its standard deviation, the loop closure errors before and after
in standard deviations, and the estimate of `modeler calibrate-camera` from the run (again).
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from modeler.closure import Closer
from modeler.export import write_atomically
from modeler.graph.focal import FocalCalibrator
from modeler.segmentation import scene_frames
from modeler.sequences import FocalFactor, RefocusedSequence
from modeler.types import Step
from studies.calibration.specimens import SPECIMENS
from studies.loops.cases import Case
from studies.loops.covariances import pushed
from studies.loops.study import modeler

_ERRORS = (-0.08, -0.06, -0.05, -0.03, -0.02, 0.02, 0.03, 0.05, 0.06, 0.08)
_SEED = 3  # of the choice of shapes
_FINDERS = ("found", "again")  # the run, and calibrate-camera after it
_GOAL = 0.01


def row(shape: str, error: float, options: argparse.Namespace) -> dict[str, Any]:
    """Build one sequence and return its estimates."""
    true = pushed(shape, options.seed, options.frames, options.step_deg)
    true_px = true.frame(true.indices[0]).camera.fx
    stated = RefocusedSequence(true, FocalFactor(1.0 + error, true_px))
    case = Case(shape, stated, "table")
    maker = modeler(case, Closer(), options.seed)
    noise = maker.sensor.noise._replace(sigma_focal=options.sigma)
    maker = replace(maker, sensor=replace(maker.sensor, noise=noise))
    scene = maker.segmenter.scene([stated.frame(index) for index in scene_frames(stated.indices)])
    *_, last = maker.run(case.frames(), scene)
    assert isinstance(last, Step)
    found, calibrator = last.solution.focal, FocalCalibrator()
    assert found is not None
    again = calibrator.estimate(last.views, last.edges_so_far, maker.sensor, maker.register, maker.prior)
    stated_factor = found.factor * (1.0 + error)
    return {
        "shape": shape,
        "stated": 1.0 + error,
        "found": stated_factor,
        "sigma": found.sigma,
        "sigmas_before": found.sigmas_before,
        "sigmas_after": found.sigmas_after,
        "told_by": found.determined_by,
        "again": stated_factor * again.factor,
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m studies loops.focal_lengths", description=__doc__)
    parser.add_argument("--shapes", nargs="+", metavar="NAME", help="only these; default: ten asymmetric ones")
    parser.add_argument("--seed", type=int, default=0, help="of poses, noise and registration")
    parser.add_argument("--sigma", type=float, default=0.05, help="standard deviation of focal lengths that is stated")
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--step-deg", type=float, default=24.0, help="mean turn from frame to frame")
    parser.add_argument("--out", type=Path, default=Path("runs/focal_lengths.json"), help="file of the results")
    options = parser.parse_args(arguments)
    known = [one.recipe for one in SPECIMENS if one.half == "tuning" and one.symmetry == "asymmetric"]
    chosen = np.random.default_rng(_SEED).choice(known, len(_ERRORS), replace=False)
    shapes = options.shapes or [str(shape) for shape in chosen]
    rows = []
    print(
        f"{'shape':24}{'stated':>8}{'found':>8}{'± %':>6}{'sd':>6}{'before':>8}{'after':>7}{'again':>8}  by",
        flush=True,
    )
    for place, shape in enumerate(shapes):
        one = row(shape, _ERRORS[place % len(_ERRORS)], options)
        rows.append(one)
        off = np.log(one["found"]) / one["sigma"]
        print(
            f"{shape:24}{one['stated']:8.3f}{one['found']:8.4f}{100.0 * one['sigma']:6.2f}{off:6.1f}"
            f"{one['sigmas_before']:8.2f}{one['sigmas_after']:7.2f}{one['again']:8.4f}  {one['told_by']}",
            flush=True,
        )
    good, again = (sum(abs(np.log(one[by])) < _GOAL and one["told_by"] == "loop" for one in rows) for by in _FINDERS)
    print(f"within 1 %: {good} of {len(rows)} by the run, {again} by calibrate-camera")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(options.out, json.dumps(rows) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
