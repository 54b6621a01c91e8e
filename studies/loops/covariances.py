"""Covariances of whole runs against the truth, by shape and by class: `python -m studies loops.covariances`.

A hand pushes each shape about a table that wobbles as the prior assumes, 14 frames at about 25°, a closed turn.
Evaluated are poses relative to the first frame, motions between neighbours, and motions over five frames: NEES,
an average per degree of freedom, 1 for calibrated covariances, and the coverage of the 95 % region. Errors within one
run are correlated: few runs are not conclusive. The table goes to stdout, covariances.json into a folder.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import stats

from modeler.closure import Closer
from modeler.evaluation import nees, true_motion
from modeler.export import write_atomically
from modeler.priors.table import WOBBLE_DEG, WOBBLE_M
from modeler.segmentation import scene_frames
from modeler.sequences.rendering import RenderedSequence
from modeler.sequences.rendering.recipe import Tabletop
from modeler.types import Array, Solution, Step
from studies.calibration.specimens import SPECIMENS, load_specimen
from studies.loops.cases import Case
from studies.loops.study import modeler

_FAR = 5  # frames
_KINDS = ("pose", "near", "far")


def pushed(shape: str, seed: int, frames: int, step_deg: float) -> RenderedSequence:
    """Return a rendered sequence of a shape that stands on the table as the seed has it."""
    recipe = load_specimen(shape)
    x_deg, y_deg, z_deg = recipe.rest_rotation_deg
    turned_deg = float(np.random.default_rng([seed, 5]).uniform(0.0, 360.0))
    trajectory = Tabletop(frames=frames, step_deg=step_deg, wobble_deg=WOBBLE_DEG, wobble_m=WOBBLE_M)
    rest = (x_deg, y_deg, z_deg + turned_deg)
    plain = replace(recipe, seed=1000 + seed, rest_rotation_deg=rest, colour="none", pattern=None)
    return RenderedSequence(replace(plain, trajectory=trajectory))


def judged(solution: Solution, camera_from_model: Mapping[int, Array]) -> dict[str, list[float]]:
    """Return NEES of motions between frames of a solution, by kind."""
    first, *others = frames = list(solution.trajectory)
    ordered = sorted(frames)
    pairs = {
        "pose": [(first, frame) for frame in others],
        "near": list(itertools.pairwise(ordered)),
        "far": [(frame, ordered[(place + _FAR) % len(ordered)]) for place, frame in enumerate(ordered)],
    }
    return {
        kind: [
            nees(solution.relative_gaussian(target, source), true_motion(camera_from_model, target, source))
            for target, source in some
            if target != source
        ]
        for kind, some in pairs.items()
    }


def run(shape: str, seed: int, frames: int, step_deg: float, prior: str) -> dict[str, list[float]]:
    """Build a sequence and return NEES by kind."""
    case = Case(shape, pushed(shape, seed, frames, step_deg), prior)
    maker, truth, indices = modeler(case, Closer(), seed), case.truth(), case.sequence.indices
    assert truth is not None
    scene = maker.segmenter.scene([case.sequence.frame(index) for index in scene_frames(indices)])
    *_, last = maker.run(case.frames(), scene)
    assert isinstance(last, Step)
    return judged(last.solution, truth)


def row(name: str, found: Sequence[Mapping[str, Sequence[float]]]) -> str:
    """Return a line of the table: NEES a degree of freedom and coverage by kind."""
    radius = float(stats.chi2(6).ppf(0.95))
    cells = [name.ljust(22)]
    for kind in _KINDS:
        values = np.concatenate([runs[kind] for runs in found])
        cells.append(f"{np.mean(values) / 6.0:10.2f}{100.0 * np.mean(values <= radius):6.0f} %")
    return "".join(cells)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m studies loops.covariances", description=__doc__)
    parser.add_argument("--half", choices=("tuning", "held-out"), default="tuning", help="of the calibration's shapes")
    parser.add_argument("--shapes", nargs="+", metavar="NAME", help="only these")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="of poses, noise and registration")
    parser.add_argument("--frames", type=int, default=14)
    parser.add_argument("--step-deg", type=float, default=25.0, help="mean turn from frame to frame")
    parser.add_argument("--prior", choices=("general", "table"), default="table")
    parser.add_argument("--out", type=Path, default=Path("runs/covariances"), help="folder of the results")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    specimens = [one for one in SPECIMENS if one.half == options.half]
    specimens = [one for one in specimens if not options.shapes or one.recipe in options.shapes]
    print(" " * 22 + "".join(f"{kind + ': NEES/6':>12}{'95 %':>6}" for kind in _KINDS), flush=True)
    found: dict[str, dict[str, list[dict[str, list[float]]]]] = {}
    for specimen in specimens:
        shape = specimen.recipe
        runs = [run(shape, seed, options.frames, options.step_deg, options.prior) for seed in options.seeds]
        found.setdefault(specimen.symmetry, {})[shape] = runs
        print(row(shape, runs), flush=True)
    for symmetry, shapes in found.items():
        print(row(symmetry, [some for runs in shapes.values() for some in runs]))
    print(row("all", [some for shapes in found.values() for runs in shapes.values() for some in runs]))
    write_atomically(options.out / "covariances.json", json.dumps(found) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
