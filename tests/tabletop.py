"""Convex bodies on a table before a fixed camera, cast exactly: depth, mask, colour and normals of every pixel."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.types import Array, Camera, Frame, RayImage

CAMERA = Camera(width=200, height=160, fx=240.0, fy=240.0, cx=99.5, cy=79.5)
DISTANCE_M = 0.8


@dataclass(frozen=True)
class Box:
    """A box about the origin of the model frame, a colour a face."""

    half_m: tuple[float, float, float]

    def cast(self, origin: Array, along: Array) -> tuple[Array, Array]:
        """Return distances (n,) along rays, inf where they miss, and outward normals (n, 3)."""
        half = np.array(self.half_m)
        with np.errstate(divide="ignore", invalid="ignore"):
            one, two = (-half - origin) / along, (half - origin) / along
        enter, leave = np.fmin(one, two), np.fmax(one, two)
        axis = np.argmax(enter, axis=1)
        near = enter[np.arange(len(along)), axis]
        hit = (near <= leave.min(axis=1)) & (near > 0)
        normals = np.eye(3)[axis] * -np.sign(np.take_along_axis(along, axis[:, None], axis=1))
        return np.where(hit, near, np.inf), normals

    def distance(self, points: Array) -> Array:
        """Return signed distances (n,) of points, positive outside."""
        over = np.abs(points) - np.array(self.half_m)
        return np.linalg.norm(np.maximum(over, 0.0), axis=1) + np.minimum(over.max(axis=1), 0.0)

    @property
    def depth_m(self) -> float:
        """How far the body reaches below its centre."""
        return self.half_m[2]


@dataclass(frozen=True)
class Sphere:
    """A sphere about the origin of the model frame."""

    radius_m: float

    def cast(self, origin: Array, along: Array) -> tuple[Array, Array]:
        """Return distances (n,) along unit rays, inf where they miss, and outward normals (n, 3)."""
        half = along @ origin
        root = half**2 - origin @ origin + self.radius_m**2
        near = -half - np.sqrt(np.maximum(root, 0.0))
        return np.where(root > 0.0, near, np.inf), (origin + near[:, None] * along) / self.radius_m

    def distance(self, points: Array) -> Array:
        """Return signed distances (n,) of points, positive outside."""
        return np.linalg.norm(points, axis=1) - self.radius_m

    @property
    def depth_m(self) -> float:
        """How far the body reaches below its centre."""
        return self.radius_m


Body = Box | Sphere


def paint(normals: Array) -> np.ndarray:
    """Return the RGB (n, 3) of surface by its normal in the model frame."""
    return np.rint(128.0 + 100.0 * normals).astype(np.uint8)


def turntable(count: int, tilt_deg: float = 25.0) -> list[Array]:
    """Return camera_from_model (4, 4) of a body that turns about its z axis, the camera looking down on it."""
    tilt = np.radians(90.0 + tilt_deg)
    upright = se3.translation(np.array([0.0, 0.0, DISTANCE_M])) @ se3.exp(np.array([tilt, 0, 0, 0, 0, 0]))
    return [upright @ se3.exp(np.array([0, 0, 2.0 * np.pi * k / count, 0, 0, 0])) for k in range(count)]


BALL = Sphere(0.06)
BRICK = Box((0.07, 0.05, 0.04))
PLATE = Box((0.06, 0.0025, 0.05))
POSES = turntable(14)


def view(
    body: Body, camera_from_model: Array, index: int, *, rng: np.random.Generator | None = None, table: bool = True
) -> RayImage:
    """Return one view of a body, on a table where one is asked for; with depth noise of 1 mm where `rng` is given."""
    w, h = (side.ravel() for side in CAMERA.rays())
    rays = np.stack([w, h, np.ones_like(w)], axis=1)
    length = np.linalg.norm(rays, axis=1)
    model_from_camera = se3.inverse(camera_from_model)
    along = (rays / length[:, None]) @ model_from_camera[:3, :3].T
    origin = model_from_camera[:3, 3]
    distance, normals = body.cast(origin, along)
    mask = np.isfinite(distance)
    down = (-body.depth_m - origin[2]) / along[:, 2]
    behind = np.where(down > 0.0, down, np.inf) if table else np.full(len(down), np.inf)
    depth = np.minimum(distance, behind) / length
    depth[~np.isfinite(depth)] = np.nan
    sigma_r_m = 1e-3 if rng is not None else 1e-5
    if rng is not None:
        depth = depth + rng.normal(0.0, sigma_r_m, depth.shape)
    shape = (CAMERA.height, CAMERA.width)
    colour = np.where(mask[:, None], paint(normals), 60).astype(np.uint8).reshape(*shape, 3)
    frame = Frame(index, float(index), depth.reshape(shape).astype(np.float32), CAMERA, mask.reshape(shape), colour)
    return seen(frame, (normals @ camera_from_model[:3, :3].T)[mask], sigma_r_m)


def seen(frame: Frame, normals: Array, sigma_r_m: float) -> RayImage:
    """Return a frame as a view whose surface points are all pixels of its mask, with given normals (n, 3)."""
    assert frame.mask is not None
    pixels = np.argwhere(frame.mask)
    w, h = frame.camera.rays()
    depth = frame.depth_m[frame.mask].astype(np.float64)
    points = np.stack([w[frame.mask] * depth, h[frame.mask] * depth, depth], axis=1)
    return RayImage(frame, None, 1e-3, sigma_r_m, points, normals, pixels)


def recoloured(view: RayImage, colour: npt.NDArray[Any] | None) -> RayImage:
    """Return a view with other colours: numbers (h, w, 3) that are rounded, grey levels (h, w), or none."""
    if colour is not None:
        three = colour if colour.ndim == 3 else np.repeat(colour[..., None], 3, axis=2)
        colour = np.rint(three).astype(np.uint8)
    return replace(view, frame=replace(view.frame, colour=colour))


def views(body: Body, poses: list[Array], rng: np.random.Generator | None = None) -> dict[int, RayImage]:
    """Return views of a body by frame number."""
    return {k: view(body, pose, k, rng=rng) for k, pose in enumerate(poses)}


def trajectory(poses: list[Array], object_from_model: Array | None = None) -> dict[int, Array]:
    """Return object_from_camera by frame number; the object frame is the model frame unless one is given."""
    base = np.eye(4) if object_from_model is None else object_from_model
    return {k: base @ se3.inverse(pose) for k, pose in enumerate(poses)}


def visible(body: Body, poses: list[Array]) -> Array:
    """Return points (n, 3) of the model's surface that some view sees, one a pixel."""
    parts = []
    for k, pose in enumerate(poses):
        exact = view(body, pose, k)
        parts.append(se3.transform(se3.inverse(pose), exact.points_m))
    return np.concatenate(parts)


def edge_uses(triangles: np.ndarray) -> np.ndarray:
    """Return how often each edge of a mesh occurs in each direction, as two counts (e, 2)."""
    directed = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges, number = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True)
    forward = directed[:, 0] < directed[:, 1]
    return np.stack([np.bincount(number[forward == side], minlength=len(edges)) for side in (True, False)], axis=1)
