"""Surfaces and colours of held-out views: `python -m studies surfacing.captures RUN...`.

Cross-validation over the views of a run: each fold leaves out every FOLDS-th view, fuses the rest with the run's poses,
and compares the mesh with each left-out view. Prints a Markdown table, a row for each run and method: the share of the
object's pixels that violate free space, the share of surface observed by other views too that is missing, the distance
of surfaces and the angle between their normals, colour differences (of our textures, of 255, one gain for the view; as
they are, and with the shading of the view's lamps put back), gradient differences per pixel (seams that are not in the
images, blurred print); and for the mesh of all views its triangles, the length of its boundaries, and false surface on
the support.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter, sobel

from modeler import se3
from modeler.export import write_atomically
from modeler.fusion import Fuser, FusionVolume, meshing
from modeler.fusion.depth_views import free_of
from modeler.kernels.photometric import harmonics_of
from modeler.runs.reopening import Reopened, reopened
from modeler.types import Array, BoolArray, RayImage, areas_m2
from studies.surfacing.drawing import Scene
from studies.surfacing.methods import Surface, open3d_poisson, open3d_tsdf

FOLDS = 5
MARGIN_PX = 2  # free space of a pixel ends at the least depth around it: depth is mixed along outlines
BLUR_PX = 1.0  # of colours before gradients, against pixel noise
FLAT_RAD = 0.5  # of the support's normal: what lies so flat and low is its surface


Method = Callable[[FusionVolume, Mapping[int, RayImage], Mapping[int, Array]], Surface]


def ours(volume: FusionVolume, views: Mapping[int, RayImage], poses: Mapping[int, Array]) -> Surface:
    """Fuse as `modeler build` does."""
    del views, poses
    model = volume.model()
    return model.vertices_m, model.triangles


def tsdf(volume: FusionVolume, views: Mapping[int, RayImage], poses: Mapping[int, Array]) -> Surface:
    """Integrate with Open3D, on our voxels and band; as in ours, a single view suffices for surface."""
    return open3d_tsdf(views, poses, volume.grid.voxel_m, volume.tau_m, above=0.5)


def poisson(volume: FusionVolume, views: Mapping[int, RayImage], poses: Mapping[int, Array]) -> Surface:
    """Reconstruct the merged cloud with Open3D."""
    return open3d_poisson(views, poses, volume.grid.voxel_m, volume.tau_m)


METHODS: dict[str, Method] = {"ours": ours, "Open3D TSDF": tsdf, "Open3D Poisson": poisson}


def figures_of(run: Reopened, method: str, folds: int, measured: int) -> dict[str, float]:
    """Return the means of all figures over a run's views, each of the first `measured` folds left out once."""
    whole, rows = run.volume(Fuser()), []
    poses = run.solution.trajectory
    frames = sorted(frame for frame in run.views if frame in poses)
    for fold in range(min(folds, measured, len(frames))):
        out = frames[fold::folds]
        rest = {frame: run.views[frame] for frame in frames if frame not in out}
        volume = replace(run, views=rest).volume(Fuser())
        mesh = METHODS[method](volume, rest, poses)
        rows += [compared(mesh, volume, run.views[frame], poses[frame], whole.near_m) for frame in out]
    means = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    mesh = METHODS[method](whole, run.views, poses)
    return means | {"triangles": len(mesh[1])} | tidiness(mesh, run, whole)


def compared(
    mesh: Surface, volume: FusionVolume, view: RayImage, object_from_camera: Array, near_m: float
) -> dict[str, float]:
    """Return the differences between a mesh and a view that was not part of it or its volume."""
    frame, scene = view.frame, Scene(*mesh)
    drawn = scene.seen(frame.camera, object_from_camera)
    mask = np.isfinite(frame.depth_m) & (frame.depth_m > 0.0)
    mask = mask if frame.mask is None else mask & frame.mask
    through = drawn.hit & (drawn.depth_m + 2.0 * near_m < free_of(frame.depth_m, MARGIN_PX))
    points_m, normals = se3.transform(object_from_camera, view.points_m), view.normals @ object_from_camera[:3, :3].T
    here = tuple(view.pixels.T)
    beyond_m = drawn.depth_m[here] - view.points_m[:, 2]
    seen = volume.support(points_m, normals).views > 0
    same = np.abs(beyond_m) < 2.0 * near_m
    corners = mesh[0][mesh[1][drawn.triangle[here][same]]]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    cosines = np.sum(across * normals[same], axis=1) / np.maximum(np.linalg.norm(across, axis=1), 1e-30)
    figures = {
        "through": float(np.count_nonzero(through)) / max(1, np.count_nonzero(mask)),
        "missing": float(np.mean(beyond_m[seen] > 2.0 * near_m)),
        "apart_mm": 1e3 * float(np.median(np.abs(beyond_m[same]))),
        "angle_deg": float(np.median(np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))))),
    }
    if frame.colour is None:
        return figures
    matched = np.zeros(drawn.hit.shape, dtype=bool)
    matched[tuple(part[same & seen] for part in here)] = True
    normals = scene.of(drawn, meshing.normals_of(*mesh))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    shown_m, unseen = scene.of(drawn, mesh[0]), np.zeros(normals.shape, dtype=np.uint8)
    matched[drawn.hit] &= volume.support(shown_m, normals).coloured
    painted = np.zeros((*drawn.hit.shape, 3))
    painted[drawn.hit], _ = volume.texture_colours(shown_m, normals, unseen)
    lamps = np.ones(painted.shape)
    lamps[drawn.hit] = np.exp(-harmonics_of(normals @ object_from_camera[:3, :3], np.eye(4)) @ volume.exposure.shading)
    for name, shown in (("", painted), ("_lit", painted * lamps)):
        gains = np.median(np.log(shown[matched] + 1.0) - np.log(frame.colour[matched] + 1.0), axis=0)
        off = (shown * np.exp(-gains) - frame.colour) * matched[..., None]
        figures[f"colour{name}"] = float(np.abs(off[matched]).mean())
        figures[f"gradient{name}"] = _slope(off, matched)
    return figures


def _slope(values: Array, where: BoolArray) -> float:
    """Return the mean gradient of an image (h, w, c) a pixel, away from the rim of where it is known."""
    known = gaussian_filter(where.astype(np.float64), BLUR_PX)
    smooth = gaussian_filter(values, (BLUR_PX, BLUR_PX, 0.0)) / np.maximum(known, 1e-3)[..., None]
    return float((np.hypot(sobel(smooth, axis=0), sobel(smooth, axis=1)) / 8.0)[known > 0.95].mean())


def tidiness(mesh: Surface, run: Reopened, volume: FusionVolume) -> dict[str, float]:
    """Return the length of a mesh's boundaries in cm, its area, and that on the support in cm²."""
    vertices_m, triangles = mesh
    edges = meshing.boundary_edges(triangles)
    length_m = np.linalg.norm(vertices_m[edges[:, 0]] - vertices_m[edges[:, 1]], axis=1).sum()
    areas = areas_m2(vertices_m, triangles)
    figures = {"boundary_cm": 1e2 * float(length_m), "area_cm2": 1e4 * float(areas.sum())}
    up, offset_m = run.report.get("up"), run.report.get("support_offset_m")
    if up is None or offset_m is None:
        return figures
    corners = vertices_m[triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = across @ np.array(up) > np.cos(FLAT_RAD) * np.linalg.norm(across, axis=1)
    low = corners.mean(axis=1) @ np.array(up) + offset_m < volume.near_m
    return figures | {"table_cm2": 1e4 * float(areas[flat & low].sum())}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the comparison."""
    parser = argparse.ArgumentParser(prog="python -m studies surfacing.captures", description=__doc__)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="run folders")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--folds", type=int, default=FOLDS)
    parser.add_argument("--measured", type=int, default=FOLDS, metavar="N", help="leave out only the first N folds")
    parser.add_argument("--out", type=Path, default=None, help="JSON to write")
    options = parser.parse_args(arguments)
    rows = []
    for folder in options.runs:
        run = reopened(folder)
        for method in options.methods:
            rows.append(
                {"run": folder.name, "method": method, **figures_of(run, method, options.folds, options.measured)}
            )
            print(json.dumps(rows[-1]), file=sys.stderr)
    if options.out is not None:
        write_atomically(options.out, json.dumps(rows, indent=1) + "\n")
    print(_table(rows))
    return 0


def _table(rows: Sequence[Mapping[str, object]]) -> str:
    heads = (
        "free-space violations",
        "missing",
        "distance",
        "normals",
        "triangles",
        "colour",
        "same, lit",
        "gradient",
        "boundaries",
        "on the support",
    )
    lines = ["| | | " + " | ".join(heads) + " |", "|---" * (2 + len(heads)) + "|"]
    forms = {
        "through": "{:.2%}",
        "missing": "{:.2%}",
        "apart_mm": "{:.2f} mm",
        "angle_deg": "{:.1f}°",
        "triangles": "{:.0f}",
        "colour": "{:.1f}",
        "colour_lit": "{:.1f}",
        "gradient_lit": "{:.1f}",
        "boundary_cm": "{:.0f} cm",
        "table_cm2": "{:.1f} cm²",
    }
    for row in rows:
        cells = [form.format(float(str(row[name]))) if name in row else "-" for name, form in forms.items()]
        lines.append("| " + " | ".join([str(row["run"]), str(row["method"]), *cells]) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
