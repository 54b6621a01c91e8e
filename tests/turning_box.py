"""A made-up run for tests of sinks: a box turned on a table in front of a camera, seen in exact depth images."""

import itertools
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from tabletop import Box

from modeler import se3
from modeler.types import (
    Array,
    BoolArray,
    Camera,
    Edge,
    EdgeKind,
    Failed,
    Frame,
    FrameRecord,
    ObjectModel,
    Outcome,
    PoseGaussian,
    Posterior,
    RayImage,
    Segmentation,
    Solution,
    Stated,
    Step,
)
from modeler.views import Sensor

COUNT, LOST = 6, 3
"""Frames of the run that tests share, and which of them is lost."""
HALF_M = np.array([0.06, 0.09, 0.04])
CENTRE_M = np.array([0.02, 0.0, 0.8])
STEP_RAD = np.deg2rad(25.0)
SIGMAS = np.array([0.004, 0.012, 0.004, 0.0015, 0.001, 0.002])  # of the pose about the object's centre
_CARRIED = se3.adjoint(se3.translation(CENTRE_M))
COVARIANCE = _CARRIED @ np.diag(SIGMAS**2) @ _CARRIED.T
FACE_RGB = np.array([[200, 60, 50], [60, 160, 70], [60, 90, 200], [220, 190, 60], [160, 70, 170], [70, 180, 190]])


def steps(count: int = 5, *, width: int = 96, lost: int | None = None, colour: bool = True) -> Iterator[Step]:
    """Yield `count` steps; frame `lost` is not registered, and the last one closes the loop with one edge rejected."""
    rng = np.random.default_rng(3)
    views: dict[int, RayImage] = {}
    edges: list[Edge] = []
    records: list[FrameRecord] = []
    chain: dict[int, Array] = {}
    covariances: dict[int, Array] = {}
    for index in range(count):
        frame, mask, view = _view(index, width, rng, colour=colour)
        last = index == count - 1
        posteriors, judged = _registrations(index, views, view, lost=index == lost, closing=last)
        if index != lost:
            chain[index] = np.eye(4) if not views else chain[judged[0].target] @ judged[0].posterior.pose.mean
            grown = 0.25 if last else index
            covariances[index] = COVARIANCE * grown + 1e-10 * np.eye(6)
            views[index] = view
        edges += judged
        trajectory = {k: object_from_camera(k) for k in chain}
        found = index != lost
        step = Step(
            frame=frame,
            segmentation=Segmentation(mask, None, Outcome.CONVERGED),
            view=view,
            posteriors=tuple(posteriors),
            edges=tuple(judged),
            left_out=None if found else Failed(Outcome.NO_OVERLAP),
            solution=Solution(trajectory, dict(covariances), dict(chain)),
            make_model=partial(_model, dict(views), trajectory, colour=colour),
            edges_so_far=tuple(edges),
            views=dict(views),
            last=last,
        )
        records.append(step.record)
        yield replace(step, frames_so_far=tuple(records))


def object_from_camera(index: int) -> Array:
    """Return the true pose (4, 4) of the camera at a frame, the object frame being the camera's at frame 0."""
    turn = se3.exp(np.array([0.0, index * STEP_RAD, 0.0, 0.0, 0.0, 0.0]))
    return se3.translation(CENTRE_M) @ se3.inverse(turn) @ se3.translation(-CENTRE_M)


def _registrations(
    index: int, views: dict[int, RayImage], view: RayImage, *, lost: bool, closing: bool
) -> tuple[list[Posterior], list[Edge]]:
    """Return what registering a frame brought: odometry, and on the last frame two closures, one of them bad."""
    if not views:
        return [], []
    previous, first = max(views), min(views)
    wanted: list[tuple[int, EdgeKind, bool]] = [(previous, "odometry", not lost)]
    if closing and not lost:
        middle = sorted(views)[len(views) // 2]
        wanted.extend(((first, "closure", True), (middle, "closure", False)))
    posteriors, edges = [], []
    for target, kind, accepted in wanted:
        truth = se3.inverse(object_from_camera(target)) @ object_from_camera(index)
        drift = _CARRIED @ np.array([0.0, 0.01, 0.0, 0.0, 0.0, 0.0])
        inflated = 1.0 + 0.1 * index
        posterior = Posterior(
            source=index,
            target=target,
            pose=PoseGaussian(truth @ se3.exp(drift), inflated * COVARIANCE),
            outcome=Outcome.CONVERGED if accepted else Outcome.NO_OVERLAP,
            overlap=0.8 - 0.03 * index,
            effective_samples=700.0 - 20 * index,
            seconds=0.2 + 0.01 * index,
        )
        posteriors.append(posterior)
        edges.append(
            Edge(posterior, kind, accepted, Stated("converged" if accepted else "disagrees with the graph by 5 sd"))
        )
    return posteriors, edges


def _view(index: int, width: int, rng: np.random.Generator, *, colour: bool) -> tuple[Frame, BoolArray, RayImage]:
    """Return frame, mask and view of the box on a table at a frame, with a little noise along the ray."""
    height = 3 * width // 4
    focal_px = 0.9 * width
    camera = Camera(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)
    w, h = camera.rays()
    rays = np.stack([w, h, np.ones_like(w)], axis=-1).reshape(-1, 3)
    camera_from_box = se3.inverse(object_from_camera(index)) @ se3.translation(CENTRE_M)
    origin = se3.inverse(camera_from_box)[:3, 3]
    directions = rays @ camera_from_box[:3, :3]
    near, outwards = Box((HALF_M[0], HALF_M[1], HALF_M[2])).cast(origin, directions)
    hit, axis, sign = np.isfinite(near), np.abs(outwards).argmax(axis=1), outwards.sum(axis=1)
    with np.errstate(divide="ignore"):
        table = (CENTRE_M[1] + HALF_M[1]) / rays[:, 1]
    depth = np.where(hit, near, np.where((table > 0) & (table < 2.0), table, 2.0))
    depth = depth + 0.001 * rng.standard_normal(len(depth))
    checks = 0.75 + 0.25 * (np.floor((origin + depth[:, None] * directions) / 0.025).sum(axis=1) % 2)
    rgb = np.where(hit[:, None], FACE_RGB[2 * axis + (sign > 0)] * checks[:, None], 90).astype(np.uint8)
    mask = hit.reshape(height, width)
    depth_m = depth.reshape(height, width).astype(np.float32)
    depth_m[: height // 20] = np.nan
    frame = Frame(index, float(index), depth_m, camera, colour=rgb.reshape(height, width, 3) if colour else None)
    view = Sensor().ray_image(replace(frame, mask=mask))
    return frame, mask, view


def _model(views: dict[int, RayImage], trajectory: dict[int, Array], *, colour: bool) -> ObjectModel | None:
    """Return the merged views and the box as mesh."""
    if not views:
        return None
    points = np.concatenate([se3.transform(trajectory[k], view.points_m) for k, view in views.items()])
    normals = np.concatenate([view.normals @ trajectory[k][:3, :3].T for k, view in views.items()])
    seen = [view.frame.colour[tuple(view.pixels.T)] for view in views.values() if view.frame.colour is not None]
    corners = CENTRE_M + HALF_M * np.array(list(itertools.product((-1, 1), repeat=3)))
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([(a, b, c) for a, b, c, _ in quads] + [(a, c, d) for a, _, c, d in quads])
    outward = corners - CENTRE_M
    return ObjectModel(
        points_m=points,
        normals=normals,
        colours=np.concatenate(seen) if colour else None,
        vertices_m=corners,
        triangles=triangles,
        vertex_normals=outward / np.linalg.norm(outward, axis=1, keepdims=True),
        vertex_colours=np.full((8, 3), 180, dtype=np.uint8) if colour else None,
    )
