"""Find symmetries of shapes of known class: `python -m studies symmetries`.

Takes shapes of the calibration study, as many of each class, as true meshes with noise or, with --built, as models that
are built from rendered images of a full turn on a turntable. Prints a table of the results, and a line of JSON per
shape to stderr. The status is 1 if more than one shape in twelve is misclassified, or if a symmetry is claimed of a
shape that has none.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import trimesh
from scipy import ndimage

import modeler
from modeler.export.placing import upright
from modeler.fusion import Symmetries, SymmetryFinder
from modeler.sequences.rendering import RenderedSequence
from modeler.sequences.rendering.recipe import Recipe, Turntable
from studies.calibration.specimens import SPECIMENS, Specimen, load_specimen
from studies.results.tables import FOLDER, markdown, record

EACH: Final = 15
"""Shapes of each class."""
NOISE_M: Final = 4e-4
"""Standard deviation of the places of a true mesh."""
GRAIN_M: Final = 5e-3
"""Distance over which that noise is even."""
FRAMES: Final = 15
STEP_DEG: Final = 24.0
DISTANCE_M: Final = 0.6
_FOUND: Final = ("none", "n-fold", "revolution")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m studies symmetries", description=__doc__)
    parser.add_argument("--each", type=int, default=EACH, help="shapes of each of the four classes")
    parser.add_argument("--half", choices=("tuning", "held-out"), default="tuning", help="of the calibration study")
    parser.add_argument("--built", action="store_true", help="build the models instead of taking true meshes")
    parser.add_argument("--record", action="store_true", help="put what is found of built models into the results")
    options = parser.parse_args(arguments)
    if options.record and not (options.built and options.half == "tuning" and options.each == EACH):
        parser.error("the results are of built models of the tuning half: --record goes with --built alone")
    by_class: dict[str, list[Specimen]] = {}
    for specimen in SPECIMENS:
        if specimen.half == options.half:
            by_class.setdefault(specimen.symmetry, []).append(specimen)
    counts: Counter[tuple[str, str]] = Counter()
    for specimen in (one for shapes in by_class.values() for one in shapes[: options.each]):
        began_s = time.monotonic()
        found = _of_built(load_specimen(specimen.recipe)) if options.built else _of_mesh(load_specimen(specimen.recipe))
        told = _class(found)
        counts[specimen.symmetry, told] += 1
        row = {
            "shape": specimen.recipe,
            "class": specimen.symmetry,
            "found": told,
            "discrete": len(found.discrete),
            "continuous": len(found.continuous),
            "in_part": len(found.seen_in_part),
            "tolerance_mm": round(1000.0 * found.tolerance_m, 2),
            "seconds": round(time.monotonic() - began_s, 1),
        }
        print(json.dumps(row), file=sys.stderr, flush=True)
    rows = _rows(counts)
    print(markdown(("", *_FOUND), rows))
    if options.record:
        record(FOLDER / "symmetries.json", rows)
    invented = sum(n for (known, told), n in counts.items() if _expected(known) == "none" and told != "none")
    right = sum(n for (known, told), n in counts.items() if _expected(known) == told)
    return 0 if invented == 0 and 12 * right >= 11 * counts.total() else 1


def _of_mesh(recipe: Recipe) -> Symmetries:
    """Return the symmetries of the true surface, all of it seen with noise."""
    mesh = RenderedSequence(recipe).model()
    vertices, triangles = trimesh.remesh.subdivide_to_size(mesh.vertices_m, mesh.triangles, max_edge=0.005)[:2]
    # As even as the noise of fused surfaces: noise of each vertex by itself would turn the normals of slivers.
    cells = ((vertices - vertices.min(axis=0)) / GRAIN_M).T
    field = np.random.default_rng(0).normal(size=(3, *(np.ceil(cells.max(axis=1)).astype(int) + 2)))
    noisy = vertices + NOISE_M * np.stack([ndimage.map_coordinates(along, cells, order=1) for along in field], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    return SymmetryFinder().find(noisy, triangles, up=up, sigma_m=NOISE_M, closed=True)


def _of_built(recipe: Recipe) -> Symmetries:
    """Return the symmetries of a model that is built from a full turn on a turntable whose step is known."""
    turn = Turntable(frames=FRAMES, step_deg=STEP_DEG, step_sigma_deg=0.5, offset_m=(0.015, 0.015))
    sequence = RenderedSequence(replace(recipe, trajectory=turn, view=replace(recipe.view, distance_m=DISTANCE_M)))
    frames = [sequence.frame(index) for index in sequence.indices]
    builder = modeler.Modeler(prior=modeler.TurntablePrior(step_deg=STEP_DEG, step_sigma_deg=1.0))
    steps = [event for event in builder.run(frames, builder.segmenter.scene(frames)) if isinstance(event, modeler.Step)]
    model = steps[-1].model
    assert model is not None
    first = steps[-1].views[min(steps[-1].views)]
    return SymmetryFinder().find_in(model, -upright(first)[:, 1])


def _class(found: Symmetries) -> str:
    """Return the class of a shape by what was found: of a lying body of revolution only the side that was seen."""
    if found.continuous or found.seen_in_part:
        return "revolution"
    return "n-fold" if found.discrete else "none"


def _expected(symmetry: str) -> str:
    """Return what is to be found of a class of the study."""
    return "none" if symmetry in ("asymmetric", "near-symmetric") else symmetry


def _rows(counts: Counter[tuple[str, str]]) -> list[tuple[str | int, ...]]:
    """Return how many shapes of each class were put into which."""
    known = dict.fromkeys(one for one, _ in counts)
    return [(one, *(counts[one, found] for found in _FOUND)) for one in known]


if __name__ == "__main__":
    sys.exit(main())
