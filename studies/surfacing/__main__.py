"""Compare surfaces with the truth, by us and by Open3D: `python -m studies surfacing`.

Renders eight shapes at 0.7 m, builds each, and fuses the same frames by every method, with the true poses and with
those of the build. Prints a Markdown table of medians over shapes; sequences, runs and surfacing.json, with the figures
of each shape, stay in the folder. Shapes whose rotation the images do not determine are built with the step known. The
status is 1 where our model of a build's own poses has an F-score at 3 mm, over what the frames saw, below 0.95 or more
than 10 % below that of the true poses.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from modeler import se3, sequences
from modeler.cli import main as modeler
from modeler.evaluation import SAMPLES, TrueSurface, align_to_model, sample_surface, surface_errors
from modeler.export import write_atomically
from modeler.fusion import Fuser
from modeler.runs.reopening import reopened
from modeler.sequences import true_mesh
from modeler.types import Array, RayImage
from studies.results.tables import FOLDER, markdown, record
from studies.surfacing.cost import measured
from studies.surfacing.drawing import Scene
from studies.surfacing.methods import METHODS, Surface

SHAPES = ("box", "flashlight", "tube", "bottle", "figurine", "l_bracket", "mug", "teapot")
TURNED = ("--prior", "turntable", "--step-deg", "25", "--step-sigma-deg", "3", "--max-shift-m", "0.05")
"""For shapes whose rotation the images do not determine, or only in part."""
BLIND = ("bottle", "mug")


@dataclass(frozen=True)
class _Figure:
    """A figure of a method, as the table has it."""

    title: str
    """Of its column."""
    decimals: int
    more: bool = False
    """Whether more is better."""


FIGURES: Final = {
    "f_1mm": _Figure("F at 1 mm", 3, more=True),
    "f_2mm": _Figure("2 mm", 3, more=True),
    "f_3mm": _Figure("3 mm", 3, more=True),
    "f_5mm": _Figure("5 mm", 3, more=True),
    "f_share": _Figure("1 % of the size", 3, more=True),
    "accuracy_mm": _Figure("accuracy (mm)", 2),
    "completeness_mm": _Figure("completeness (mm)", 2),
    "angle_deg": _Figure("normals (°)", 1),
    "flatness_mm": _Figure("planes, scatter (mm)", 2),
    "extent_mm": _Figure("box of bounds (mm)", 1),
    "triangles": _Figure("triangles", 0),
    "ms_a_frame": _Figure("processor time a frame (ms)", 0),
    "mb_a_frame": _Figure("memory a frame (MB)", 1),
}
"""By the name that surfacing.json has."""
_SMALL_MM: Final = 0.005
"""Half of the last digit of a distance: what differs by less is level."""
_PLANE: Final = 0.1
"""Least share of the true surface that a plane has whose flatness is measured."""
_NEAR_M: Final = 0.005
"""Distance from a plane within which surface belongs to it."""
_FACING: Final = float(np.cos(np.radians(25.0)))
"""Cosine between normals, likewise."""
_NOISE: Final = "noise over the root of the views"
"""Row of what the flatness of planes would be without smoothing, by the measurements."""
_RECIPES = Path(sequences.__file__).parent / "recipes"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the comparison."""
    parser = argparse.ArgumentParser(prog="python -m studies surfacing", description=__doc__)
    parser.add_argument("--shapes", nargs="+", default=SHAPES, metavar="NAME", help="recipes")
    parser.add_argument("--distance-m", type=float, default=0.7, help="of the camera from the middle of the table")
    parser.add_argument(
        "--out", type=Path, default=Path("runs/surfacing"), help="folder of sequences, runs and results"
    )
    parser.add_argument("--record", action="store_true", help="put the medians into the results")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for shape in options.shapes:
        sequence = _sequence(shape, options.distance_m, options.out)
        run = options.out / f"run_{shape}"
        prior = TURNED if shape in BLIND else ()
        status = modeler(["build", str(sequence), "--out", str(run), "--overwrite", *prior])
        print(f"{shape}: status {status}", file=sys.stderr)
        rows += _rows(shape, run)
    write_atomically(options.out / "surfacing.json", json.dumps(rows, indent=1) + "\n")
    table = _table(rows)
    print(markdown(["", *(figure.title for figure in FIGURES.values())], table))
    if options.record:
        record(FOLDER / "fusion.json", table)
    return 1 if _short(rows) else 0


def _sequence(shape: str, distance_m: float, out: Path) -> Path:
    """Render a shape from a distance, and return the sequence."""
    recipe = json.loads((_RECIPES / f"{shape}.json").read_bytes())
    recipe["view"] = {**recipe.get("view", {}), "distance_m": distance_m}
    file, sequence = out / f"{shape}.json", out / f"seq_{shape}"
    write_atomically(file, json.dumps(recipe))
    if not sequence.exists():
        modeler(["render", str(file), "--out", str(sequence)])
    return sequence


def _rows(name: str, folder: Path) -> list[dict[str, object]]:
    """Return what each method makes of a run's frames, with true poses and the run's own."""
    run = reopened(folder)
    truth = run.parts[0].truth()
    assert truth is not None
    mesh = true_mesh(run.parts[0].sequence)
    surface = TrueSurface.of(mesh.vertices_m, mesh.triangles, np.random.default_rng([0, 0]))
    seen = surface.seen((view.frame, truth[frame]) for frame, view in run.views.items())
    extent_m, planes = np.ptp(surface.vertices_m, axis=0), _planes(surface.vertices_m, surface.triangles)
    size_m = float(extent_m.max())
    model_from_object = align_to_model(run.solution.trajectory, truth)
    own = {frame: model_from_object @ pose for frame, pose in run.solution.trajectory.items()}
    rows = []
    for poses, trajectory in (("true", {frame: se3.inverse(truth[frame]) for frame in run.views}), ("own", own)):
        volume = Fuser().volume(run.views, trajectory)
        for method in METHODS:
            made, seconds, megabytes = _made(method, run.views, trajectory, volume.grid.voxel_m, volume.tau_m)
            errors = surface_errors(*made, surface, np.random.default_rng([0, 1])).over(seen)
            rows.append(
                {
                    "shape": name,
                    "poses": poses,
                    "method": method,
                    **{f"f_{limit}mm": errors.f_score(1e-3 * limit) for limit in (1, 2, 3, 5)},
                    "f_share": errors.f_score(0.01 * size_m),
                    "accuracy_mm": 1e3 * errors.accuracy_m,
                    "completeness_mm": 1e3 * errors.completeness_m,
                    "angle_deg": _angle_deg(made, (surface.vertices_m, surface.triangles)),
                    "flatness_mm": 1e3 * _flatness_m(made, planes),
                    "extent_mm": 1e3 * float(np.abs(np.ptp(made[0], axis=0) - extent_m).max()),
                    "triangles": len(made[1]),
                    "ms_a_frame": 1e3 * seconds / len(run.views),
                    "mb_a_frame": megabytes / len(run.views),
                }
            )
        noise_mm = 1e3 * _noise_m(run.views, trajectory, planes)
        rows.append({"shape": name, "poses": poses, "method": _NOISE, "flatness_mm": noise_mm})
    return rows


def _angle_deg(made: Surface, true: Surface) -> float:
    """Return the median angle between normals of a surface and of the true one, over its area."""
    points_m = sample_surface(*made, SAMPLES, np.random.default_rng([0, 2]))
    one, other = (Scene(*surface).nearest_normals(points_m) for surface in (made, true))
    return float(np.degrees(np.median(np.arccos(np.clip(np.sum(one * other, axis=1), -1.0, 1.0)))))


def _made(
    method: str, views: Mapping[int, RayImage], trajectory: Mapping[int, Array], voxel_m: float, tau_m: float
) -> tuple[Surface, float, float]:
    views = {frame: replace(view, layers={}) for frame, view in views.items()}
    few = dict(list(views.items())[:2])
    return measured(METHODS[method], (views, trajectory, voxel_m, tau_m), (few, trajectory, 3.0 * voxel_m, 3.0 * tau_m))


def _planes(vertices_m: Array, triangles: npt.NDArray[np.int64]) -> Array:
    """Return the planes (p, 4) that have much of a surface: normals, and their products with points on them in m."""
    one, two, three = np.moveaxis(vertices_m[triangles], 1, 0)
    across = np.cross(two - one, three - one)
    areas = np.linalg.norm(across, axis=1)
    normals = across[areas > 0.0] / areas[areas > 0.0, None]
    rows = np.column_stack([normals, np.sum(normals * one[areas > 0.0], axis=1)])
    rounded, number = np.unique(np.round(rows / [0.01, 0.01, 0.01, 1e-4]), axis=0, return_inverse=True)
    shares = np.bincount(number.ravel(), weights=areas[areas > 0.0]) / areas.sum()
    return rounded[shares >= _PLANE] * [0.01, 0.01, 0.01, 1e-4]


def _flatness_m(made: Surface, planes: Array) -> float:
    """Return the scatter of a surface along the normals of true planes, by the median deviation; NaN without any."""
    points_m = sample_surface(*made, SAMPLES, np.random.default_rng([0, 3]))
    normals = Scene(*made).nearest_normals(points_m)
    away = []
    for *normal, offset_m in planes:
        off_m = points_m @ normal - offset_m
        off_m = off_m[(np.abs(off_m) < _NEAR_M) & (normals @ normal > _FACING)]
        away.append(np.abs(off_m - np.median(off_m)) if len(off_m) else off_m)
    away = np.concatenate(away) if away else np.zeros(0)
    return 1.4826 * float(np.median(away)) if len(away) else float("nan")


def _noise_m(views: Mapping[int, RayImage], object_from_camera: Mapping[int, Array], planes: Array) -> float:
    """Return how flat means over the views of a pixel would leave true planes: noise over the root of the views."""
    sigmas_m = []
    for *normal, offset_m in planes:
        information = 0.0
        for frame, view in views.items():
            pose = object_from_camera[frame]
            off_m = se3.transform(pose, view.points_m) @ normal - offset_m
            off_m = off_m[(np.abs(off_m) < _NEAR_M) & (view.normals @ pose[:3, :3].T @ normal > _FACING)]
            if len(off_m) >= _PLANE * len(view.points_m):
                information += 1.0 / (1.4826 * np.median(np.abs(off_m - np.median(off_m)))) ** 2
        if information:
            sigmas_m.append(information**-0.5)
    return float(np.mean(sigmas_m)) if sigmas_m else float("nan")


def _table(rows: Sequence[Mapping[str, object]]) -> list[list[str]]:
    """Return medians over shapes by poses and method, each with the number of shapes on which ours is as good."""
    table = []
    for poses in ("true", "own"):
        for method in (*METHODS, _NOISE):
            cells = [f"{poses} poses: {method}"]
            for name, figure in FIGURES.items():
                us, them = (
                    np.array(
                        [row.get(name, np.nan) for row in rows if (row["poses"], row["method"]) == (poses, which)],
                        dtype=float,
                    )
                    for which in ("ours", method)
                )
                known = np.isfinite(us) & np.isfinite(them)
                behind = (them - us if figure.more else us - them)[known] > _SMALL_MM * (not figure.more)
                count = "" if method == "ours" else f" ({np.sum(~behind)} of {np.sum(known)})"
                if not known.any():
                    cells.append("")
                    continue
                cells.append(f"{np.median(them[known]):.{figure.decimals}f}{count}")
            table.append(cells)
    return table


def _short(rows: Sequence[Mapping[str, object]]) -> list[str]:
    """Return the shapes whose model falls short."""
    scores = {(str(r["shape"]), r["poses"]): float(str(r["f_3mm"])) for r in rows if r["method"] == "ours"}
    return [
        shape
        for shape in dict.fromkeys(shape for shape, _ in scores)
        if scores[shape, "own"] < max(0.95, 0.9 * scores[shape, "true"])
    ]


if __name__ == "__main__":
    sys.exit(main())
