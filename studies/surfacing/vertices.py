"""Whether vertices are as far off as their standard deviations say: `python -m studies surfacing.vertices`.

Shapes pushed about a table for a full turn are filmed by modelled depth cameras (`calibration.depth_cameras`) whose
given focal length has an error of 2 % standard deviation, and built with default settings. Meshes are laid on the true
surface by a rigid motion. For each run: mean squared error of vertices over their variance, its median relative to that
of a normal variable, the share of vertices within 1.96 standard deviations, and root mean squares of error and stated
standard deviation, of all runs and of those that end with status 0. As an error of the focal length moves all
vertices of a run at once, the mean of a few runs says little.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

import numpy as np
import open3d as o3d

from modeler import se3
from modeler.composition.options import PriorOptions
from modeler.evaluation import align_to_model
from modeler.export import write_atomically
from modeler.sequences.meshes import Mesh
from modeler.types import Array
from studies.loops.cameras import asked, filmed_by
from studies.results.tables import FOLDER, markdown, record
from studies.trust.study import built

TITLES: Final = ("", "shapes", "NEES, mean (range)", "median", "within 1.96 sd", "error, stated (mm)")
_NORMAL_MEDIAN: Final = 0.4549  # of the square of a normal variable
_PLACES: Final = 4000  # vertices by which a mesh is laid on the truth
_ROUNDS: Final = 15


@final
@dataclass(frozen=True)
class Row:
    """A run's figures, as in the table."""

    camera: str
    shape: str
    trusted: bool
    nees: float
    median: float
    covered: float
    error_mm: float
    stated_mm: float


def row(name: str, shape: str, seed: int, frames: int, step_deg: float) -> Row:
    """Build a sequence and compare its vertices with the truth."""
    filmed = filmed_by(name, shape, seed, frames, step_deg)
    step, report = built(filmed, PriorOptions(), seed)
    model = step.model
    assert model is not None
    assert model.vertex_sigmas_m is not None
    seen = np.isfinite(model.vertex_sigmas_m)
    off_m = errors_m(model.vertices_m[seen], filmed.model(), align_to_model(step.solution.trajectory, filmed.truth()))
    squares = (off_m / model.vertex_sigmas_m[seen]) ** 2
    return Row(
        name,
        shape,
        bool(report["trustworthy"]),
        float(squares.mean()),
        float(np.median(squares)) / _NORMAL_MEDIAN,
        float(np.mean(squares < 1.96**2)),
        1e3 * float(np.sqrt(np.mean(off_m**2))),
        1e3 * float(np.sqrt(np.mean(model.vertex_sigmas_m[seen] ** 2))),
    )


def errors_m(vertices_m: Array, truth: Mesh, model_from_object: Array) -> Array:
    """Return distances (v,) of vertices from a true surface on which they are laid, from a first guess, by ICP."""
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    tensor = o3d.core.Tensor.from_numpy
    scene.add_triangles(tensor(truth.vertices_m.astype(np.float32)), tensor(truth.triangles.astype(np.uint32)))
    some_m = np.random.default_rng(0).permutation(vertices_m)[:_PLACES]
    for _ in range(_ROUNDS):
        points_m = se3.transform(model_from_object, some_m)
        nearest = scene.compute_closest_points(tensor(points_m.astype(np.float32)), nthreads=1)
        normals = nearest["primitive_normals"].numpy().astype(np.float64)
        gap_m = np.sum((nearest["points"].numpy() - points_m) * normals, axis=1)
        kept = np.abs(gap_m) < 4.0 * np.median(np.abs(gap_m))
        centre_m = points_m.mean(axis=0)
        rows = np.concatenate([np.cross(points_m - centre_m, normals), normals], axis=1)
        xi = np.linalg.lstsq(rows[kept], gap_m[kept], rcond=None)[0]
        model_from_object = se3.translation(centre_m) @ se3.exp(xi) @ se3.translation(-centre_m) @ model_from_object
    laid_m = se3.transform(model_from_object, vertices_m)
    return scene.compute_distance(tensor(laid_m.astype(np.float32)), nthreads=1).numpy().astype(np.float64)


def table(rows: Sequence[Row]) -> list[list[str]]:
    """Return means over the shapes of each camera, of all and of those that end with 0; of the NEES also its range."""
    lines = []
    for name in dict.fromkeys(one.camera for one in rows):
        own = [one for one in rows if one.camera == name]
        for which, some in (("all", own), ("status 0", [one for one in own if one.trusted])):
            if not some:
                continue
            nees, median, covered, error_mm, stated_mm = np.mean(
                [[one.nees, one.median, one.covered, one.error_mm, one.stated_mm] for one in some], axis=0
            )
            least, most = min(one.nees for one in some), max(one.nees for one in some)
            lines.append(
                [
                    f"{name}, {which}",
                    str(len(some)),
                    f"{nees:.2f} ({least:.1f} to {most:.1f})",
                    f"{median:.2f}",
                    f"{covered:.0%}".replace("%", " %"),
                    f"{error_mm:.2f}, {stated_mm:.2f}",
                ]
            )
    return lines


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    options = asked(
        "surfacing.vertices", __doc__, arguments, per_class=1, out=Path("runs/vertices.json"), recorded=True
    )
    rows = []
    for name in options.cameras:
        for shape in options.shapes:
            rows.append(row(name, shape, options.seed, options.frames, options.step_deg))
            print(rows[-1], file=sys.stderr, flush=True)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(options.out, json.dumps([vars(one) for one in rows], indent=1) + "\n")
    made = table(rows)
    print(markdown(TITLES, made))
    if options.record:
        record(FOLDER / "vertices.json", made)
    return 0


if __name__ == "__main__":
    sys.exit(main())
