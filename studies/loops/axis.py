"""Turntables with an unknown axis: how much estimating it with all poses reduces errors, over many seeds.

`python -m studies loops.axis --shape figurine --seeds 10`. The views show no table, so that each pair's edge
determines the rotation angle, but not the axis. The table goes to stdout.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from modeler import se3
from modeler.evaluation import trajectory_errors, true_motion
from modeler.fusion import Fuser
from modeler.graph import PoseGraph, solve
from modeler.pipeline import Modeler
from modeler.priors import TurntablePrior
from modeler.segmentation import Scene
from modeler.sequences import AbstractSequence
from modeler.sequences.rendering import RenderedSequence
from modeler.sequences.rendering.recipe import Turntable
from modeler.types import Array, Solution, Step
from modeler.views import Sensor
from studies.calibration.specimens import load_specimen
from studies.loops.study import mean_nees

_STEP_DEG, _SIGMA_DEG, _FRAMES = 24.0, 1.0, 15
_FIRST = 4  # pairs that came before the axis was known
_HEADS = ("max °", "rms °", "max mm", "NEES", "first pairs °")


def rendered(shape: str, seed: int, width: int) -> AbstractSequence:
    """Return a turn of an object on a turntable, nearly whole."""
    recipe = load_specimen(shape)
    scale = width / recipe.view.width
    height, focal_px = round(scale * recipe.view.height), scale * recipe.view.focal_px
    view = replace(recipe.view, width=width, height=height, focal_px=focal_px)
    table = Turntable(_FRAMES, _STEP_DEG, _SIGMA_DEG)
    return RenderedSequence(replace(recipe, trajectory=table, view=view, colour="none", pattern=None, seed=seed))


def run(sequence: AbstractSequence, seed: int) -> Step:
    """Build a sequence and return the last step."""
    noise = sequence.sensor()
    maker = Modeler(
        sensor=Sensor() if noise is None else Sensor(noise),
        prior=TurntablePrior(_STEP_DEG, _SIGMA_DEG),
        fuser=Fuser(voxel_m=0.01),
        seed=seed,
    )
    *_, last = maker.run((sequence.frame(index) for index in sequence.indices), Scene())
    assert isinstance(last, Step)
    return last


def figures(solution: Solution, truth: dict[int, Array], step: Step) -> list[float]:
    """Return largest and root mean square rotation error, largest shift, NEES, and the first pairs' mean error."""
    errors = trajectory_errors(solution.trajectory, truth, step.views[min(solution.trajectory)].centroid_m)
    turns = np.array(list(errors.rotation_deg.values()))
    frames = sorted(solution.trajectory)[: _FIRST + 1]
    off = [
        se3.rotation_angle(se3.inverse(true_motion(truth, target, source)) @ solution.relative(target, source))
        for target, source in itertools.pairwise(frames)
    ]
    first_deg = float(np.degrees(np.mean(off)))
    nees = mean_nees(solution, truth) or float("nan")
    return [turns.max(), float(np.sqrt(np.mean(turns**2))), 1e3 * errors.max_translation_m, nees, first_deg]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m studies loops.axis", description=__doc__)
    parser.add_argument("--shape", default="figurine", help="recipe of the rendered object")
    parser.add_argument("--seeds", type=int, default=10, help="how many")
    parser.add_argument("--width", type=int, default=320, help="of the images in px")
    options = parser.parse_args(arguments)
    rows: dict[str, list[list[float]]] = {"pairs alone": [], "with their axis": []}
    print(f"{options.shape:16}" + "".join(head.rjust(15) for head in _HEADS), flush=True)
    for seed in range(options.seeds):
        sequence = rendered(options.shape, seed, options.width)
        truth, step = sequence.truth(), run(sequence, seed)
        assert truth is not None
        alone = solve(PoseGraph(step.edges_so_far, first=min(step.solution.trajectory)), step.solution.trajectory)
        for name, solution in zip(rows, (alone, step.solution), strict=True):
            rows[name].append(figures(solution, truth, step))
    for name, values in rows.items():
        print(f"{name:16}" + "".join(f"{value:15.2f}" for value in np.mean(values, axis=0)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
