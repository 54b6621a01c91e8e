"""A drawn capture as a sequence: rays cast by Open3D, photographs as print, and the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final, final

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.composition.options import PriorOptions
from modeler.sequences import AbstractSequence
from modeler.types import (
    CALIBRATED_FOCAL,
    MULTIPATH,
    NOMINAL_FOCAL,
    Array,
    BoolArray,
    Camera,
    Frame,
    SensorNoise,
)
from studies.whole.cameras import KINDS, Lens, Seen
from studies.whole.plan import Factors, motion, signed_step_deg
from studies.whole.things import Thing

if TYPE_CHECKING:
    import open3d as o3d

Faces = tuple[Array, npt.NDArray[np.int64]]
"""Vertices (v, 3) in m, and the triangles (t, 3) between them."""
_FAR: Final = 8.0
"""Distances of the object beyond which a camera that is set to it measures nothing."""
_OBJECT, _BELOW, _BEHIND, _HAND = range(4)
_BESIDE: Final = ((0.0, 0.0), (-0.25, -0.25), (-0.25, 0.25), (0.25, -0.25), (0.25, 0.25))
"""Places within a pixel: the middle, and four for pixels that mix what they see."""
_CROSS: Final = ndimage.generate_binary_structure(2, 1)


@final
@dataclass(frozen=True, eq=False)
class Capture(AbstractSequence):
    """What is given to the user, and the truth."""

    factors: Factors
    """What was drawn."""
    seed: int
    """Of motion and noise."""
    things: Sequence[Thing]
    """All meshes, by name."""
    pictures: Sequence[npt.NDArray[np.uint8]]
    """All photographs (h, w, 3)."""

    @property
    def name(self) -> str:
        """Name of the mesh."""
        return self.factors.thing

    @property
    def indices(self) -> tuple[int, ...]:
        """Frame numbers from 0."""
        return tuple(range(self.factors.frames))

    def sensor(self) -> SensorNoise | None:
        """Return what is known of the camera's kind and focal length; None if nothing is."""
        drawn = self.factors
        told = drawn.kind_told and drawn.camera == "time of flight"
        if not told and drawn.intrinsics != "device":
            return None
        focal = CALIBRATED_FOCAL if drawn.intrinsics == "device" else NOMINAL_FOCAL
        return SensorNoise(sigma_r_m=None, sigma_focal=focal, sigma_multipath=MULTIPATH["tof"] if told else 0.0)

    def truth(self) -> dict[int, Array]:
        """Return the true camera_from_model (4, 4) by frame number."""
        return {index: self._camera_from_support_in(index) @ self._support_from_object(index) for index in self.indices}

    def frame(self, index: int) -> Frame:
        """Return a frame as it is handed over."""
        return self._frames[index]

    def options(self) -> PriorOptions:
        """Return what is given of the motion."""
        drawn = self.factors
        if not drawn.told:
            return PriorOptions()
        stepped = drawn.steps == "even" and drawn.order != "halves swapped"
        if stepped and drawn.support in ("turntable", "nothing"):
            step_deg = round(signed_step_deg(drawn, self._motion[0]), 1)
            return PriorOptions(prior="turntable", step_deg=step_deg, step_sigma_deg=1.0)
        if drawn.support in ("table", "turntable"):
            return PriorOptions(prior="table", max_rotation_deg=self._most_deg)
        return PriorOptions(prior="general", max_rotation_deg=self._most_deg)

    @property
    def _most_deg(self) -> float:
        """A round figure above all turns from frame to frame, as people tell it."""
        return float(min(180.0, 10.0 * np.ceil(1.2 * self._motion[1].max() / 10.0)))

    @cached_property
    def _motion(self) -> tuple[Array, Array]:
        return motion(self.factors, np.random.default_rng([self.seed, 1]))

    @cached_property
    def mesh(self) -> Thing:
        """The object, in m."""
        named = next(thing for thing in self.things if thing.name == self.factors.thing)
        stretched = Thing.of(named.name, named.vertices * self.factors.stretch, named.triangles)
        vertices_m = self.factors.size_m * stretched.vertices
        if self.factors.support == "hand":  # it turns about its middle
            vertices_m = vertices_m - 0.5 * (vertices_m.min(axis=0) + vertices_m.max(axis=0))
        return Thing(named.name, vertices_m, named.triangles)

    @property
    def camera(self) -> Camera:
        """The true camera."""
        width, focal_px = self.factors.width_px, self.factors.focal_px
        height = 3 * width // 4
        return Camera(width, height, focal_px, focal_px, 0.5 * width - 0.5, 0.5 * height - 0.5)

    @cached_property
    def _camera_from_support(self) -> Array:
        drawn = self.factors
        e, up = np.radians(drawn.elevation_deg), np.array([0.0, 0.0, 1.0])
        ahead = np.array([0.0, np.cos(e), -np.sin(e)])
        right = np.cross(ahead, up) / np.linalg.norm(np.cross(ahead, up))
        axes = np.stack([right, np.cross(ahead, right), ahead])
        axes = Rotation.from_rotvec([0.0, 0.0, np.radians(drawn.roll_deg)]).as_matrix() @ axes
        vertices_m = self.mesh.vertices
        middle_m = np.array([0.0, 0.0, 0.5 * (vertices_m[:, 2].min() + vertices_m[:, 2].max())])
        offset_m = np.array([0.0, 0.0, drawn.distance_m])
        if drawn.cut:
            half_m = 0.5 * np.array([1.0, 0.75]) * drawn.width_px * drawn.distance_m / drawn.focal_px
            extent_m = np.abs(vertices_m[:, :2]).max() if not drawn.cut_below else 0.5 * np.ptp(vertices_m[:, 2])
            side = int(drawn.cut_below)
            offset_m[side] = (half_m[side] - extent_m + drawn.cut * drawn.size_m) * (1.0 if drawn.cut_below else -1.0)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = axes, offset_m - axes @ middle_m
        return pose

    def _camera_from_support_in(self, index: int) -> Array:
        """Return the pose (4, 4) of the support in a frame; a hand that leads the camera round it is never steady."""
        if not self.factors.led_round:
            return self._camera_from_support
        rng, distance_m = np.random.default_rng([self.seed, 5, index]), self.factors.distance_m
        middle_m = np.array([0.0, 0.0, distance_m])
        shake = se3.exp(np.array([*np.radians(rng.normal(0.0, [5.0, 2.0, 3.0])), 0.0, 0.0, 0.0]))
        shake[:3, 3] = middle_m - shake[:3, :3] @ middle_m + distance_m * rng.normal(0.0, [0.03, 0.03, 0.05])
        return shake @ self._camera_from_support @ self._motion[0][index] @ se3.inverse(self._motion[0][0])

    def _support_from_object(self, index: int) -> Array:
        return self._motion[0][0 if self.factors.led_round else index]

    @cached_property
    def _frames(self) -> tuple[Frame, ...]:
        return tuple(self._shot(index) for index in self.indices)

    def _shot(self, index: int) -> Frame:
        import open3d as o3d

        drawn, camera = self.factors, self.camera
        rng = np.random.default_rng([self.seed, 2, index])
        fixed = np.random.default_rng([self.seed, 3])
        scene, owners = self._scene(index, rng)
        hits = [self._cast(scene, camera, beside) for beside in _BESIDE]
        # Rays are scaled to depth 1.
        distances_m = np.stack([hit["t_hit"] for hit in hits], axis=2).astype(np.float64)
        distances_m[~np.isfinite(distances_m)] = np.nan
        first = hits[0]
        owner = np.where(np.isfinite(first["t_hit"]), owners[np.minimum(first["geometry_ids"], len(owners) - 1)], -1)
        rays = np.stack([*camera.rays(), np.ones((camera.height, camera.width))], axis=2)
        normals = first["primitive_normals"].astype(np.float64)
        facing = np.abs((normals * rays).sum(axis=2)) / np.linalg.norm(rays, axis=2)
        points_m: Array = rays * np.nan_to_num(distances_m[..., :1])

        def shadowed(right_m: float) -> BoolArray:
            towards = np.array([right_m, 0.0, 0.0]) - points_m
            start_m = points_m + 0.002 * towards
            lines = np.concatenate([start_m, 0.998 * towards], axis=2).astype(np.float32)
            return scene.test_occlusions(o3d.core.Tensor.from_numpy(lines), tnear=0.0, tfar=1.0).numpy()

        seen = Seen(distances_m[..., 0], distances_m[..., 1:], np.where(owner >= 0, facing, 0.0), shadowed)
        lens = Lens(drawn.focal_px, drawn.distance_m, drawn.noise * drawn.distance_m, drawn.bias)
        depth_m = KINDS[drawn.camera](seen, lens, fixed, rng)
        depth_m = np.where(depth_m < _FAR * drawn.distance_m, depth_m, np.nan)
        depth_m = drawn.unit_m * np.rint(depth_m / drawn.unit_m)
        focal_px = drawn.focal_px * np.exp(drawn.focal_error)
        given = Camera(camera.width, camera.height, focal_px, focal_px, camera.cx, camera.cy)
        colour = None if drawn.colour == "none" else self._painted(index, owner, points_m, normals, rng)
        mask = self._mask(owner == _OBJECT)
        occluder = owner == _HAND if mask is not None and drawn.support == "hand" else None
        return Frame(index, float(index), depth_m.astype(np.float32), given, mask, colour, occluder)

    def _mask(self, own: BoolArray) -> BoolArray | None:
        """Return the mask (h, w) that is handed over."""
        match self.factors.masks:
            case "exact":
                return own
            case "thin":
                return np.asarray(ndimage.binary_erosion(own, _CROSS, 2), bool)
            case "loose":
                return np.asarray(ndimage.binary_dilation(own, _CROSS, 2), bool)
            case _:
                return None

    def _scene(self, index: int, rng: np.random.Generator) -> tuple[o3d.t.geometry.RaycastingScene, Array]:
        """Return what is before the camera, in camera coordinates, and whose each of its meshes is."""
        import open3d as o3d

        drawn, size_m = self.factors, self.factors.size_m
        parts = [(_OBJECT, self.mesh.vertices, self.mesh.triangles, self._support_from_object(index))]
        if drawn.led_round:
            parts += self._beside()
        if drawn.support in ("table", "turntable"):
            table = _quad(([-5.0, -5.0, 0.0], [10.0, 0.0, 0.0], [0.0, 10.0, 0.0]), size_m)
            parts.append((_BELOW, *table, np.eye(4)))
        if drawn.wall:
            away = 0.5 + drawn.wall + (0.2 if drawn.support == "table" else 0.1)
            wall = _quad(([-15.0, away, -15.0], [30.0, 0.0, 0.0], [0.0, 0.0, 30.0]), size_m)
            parts.append((_BEHIND, *wall, np.eye(4)))
        if drawn.support == "hand":
            pose = self._motion[0][index].copy()
            pose[:3, :3] = Rotation.from_rotvec(rng.normal(0.0, 0.1, 3)).as_matrix()
            parts.append((_HAND, *_forearm(size_m), pose))
        scene, owners = o3d.t.geometry.RaycastingScene(), []
        for owner, vertices_m, triangles, support_from_part in parts:
            camera_from_part = self._camera_from_support_in(index) @ support_from_part
            scene.add_triangles(
                o3d.core.Tensor.from_numpy(se3.transform(camera_from_part, vertices_m).astype(np.float32)),
                o3d.core.Tensor.from_numpy(np.ascontiguousarray(triangles, dtype=np.uint32)),
            )
            owners.append(owner)
        return scene, np.array(owners)

    def _beside(self) -> list[tuple[int, Array, npt.NDArray[np.int64], Array]]:
        """Return three other things on the table: whose they are, vertices, triangles, and pose over the support."""
        rng, size_m, found = np.random.default_rng([self.seed, 6]), self.factors.size_m, []
        for thing in rng.choice(np.array([*self.things], dtype=object), 3):
            angle, away_m = rng.uniform(0.0, 2.0 * np.pi), size_m * rng.uniform(1.3, 2.2)
            place = se3.translation(np.array([away_m * np.cos(angle), away_m * np.sin(angle), 0.0]))
            found.append((_BEHIND, size_m * rng.uniform(0.4, 0.9) * thing.vertices, thing.triangles, place))
        return found

    @staticmethod
    def _cast(
        scene: o3d.t.geometry.RaycastingScene, camera: Camera, beside: tuple[float, float]
    ) -> dict[str, npt.NDArray[np.generic]]:
        """Cast a ray a pixel, off its middle by a part of a pixel."""
        import open3d as o3d

        w, h = camera.rays()
        ahead = np.stack([w + beside[0] / camera.fx, h + beside[1] / camera.fy, np.ones_like(w)], axis=2)
        rays = np.concatenate([np.zeros_like(ahead), ahead], axis=2).astype(np.float32)
        return {name: value.numpy() for name, value in scene.cast_rays(o3d.core.Tensor.from_numpy(rays)).items()}

    def _painted(
        self, index: int, owner: Array, points_m: Array, normals: Array, rng: np.random.Generator
    ) -> npt.NDArray[np.uint8]:
        """Return the colour image (h, w, 3)."""
        drawn = self.factors
        image = np.full((*owner.shape, 3), 20.0)
        still = self._camera_from_support_in(index)
        frames = {_OBJECT: still @ self._support_from_object(index)}
        for kind in (_OBJECT, _BELOW, _BEHIND, _HAND):
            own = owner == kind
            part_from_camera = se3.inverse(frames.get(kind, still))
            places = se3.transform(part_from_camera, points_m[own]) / drawn.size_m
            directions = normals[own] @ part_from_camera[:3, :3].T
            if kind == _HAND:
                image[own] = (205.0, 160.0, 130.0)
            elif kind == _OBJECT and drawn.colour == "plain":
                image[own] = np.random.default_rng([self.seed, 4]).uniform(60.0, 230.0, 3)
            else:
                repeats = 1.5 if kind == _OBJECT else 0.4
                image[own] = printed(self.pictures[drawn.pictures[kind]], repeats * places, directions)
        towards = np.where((normals * points_m).sum(axis=2, keepdims=True) > 0.0, -normals, normals)
        lamp = np.array([0.4, -0.7, -0.6]) / np.linalg.norm([0.4, -0.7, -0.6])
        shading = 0.5 + 0.5 * np.maximum(towards @ lamp, 0.0)
        gain = 1.0 + 0.03 * rng.normal()
        noisy = gain * image * shading[..., None] + rng.normal(0.0, 3.0, image.shape)
        return np.clip(noisy, 0.0, 255.0).astype(np.uint8)


def printed(picture: npt.NDArray[np.uint8], places: Array, directions: Array) -> Array:
    """Return the colours (n, 3) of places (n, 3) on which a photograph lies from the side that they face (n, 3)."""
    side = np.abs(directions).argmax(axis=1)
    across = np.array([[1, 2], [0, 2], [0, 1]])[side]
    at = np.take_along_axis(places, across, axis=1)
    height, width = picture.shape[:2]
    corners = np.stack([(-at[:, 1] % 1.0) * height, (at[:, 0] % 1.0) * width])
    bands = [ndimage.map_coordinates(picture[..., k].astype(float), corners, order=1, mode="wrap") for k in range(3)]
    return np.stack(bands, axis=1)


def _quad(sides: Sequence[Sequence[float]], size_m: float) -> Faces:
    """Return a rectangle of two triangles from a corner and two sides, given in sizes of the object."""
    corner_m, along_m, across_m = size_m * np.array(sides)
    vertices_m = np.stack([corner_m, corner_m + along_m, corner_m + along_m + across_m, corner_m + across_m])
    return vertices_m, np.array([[0, 1, 2], [0, 2, 3]])


def _forearm(size_m: float) -> Faces:
    """Return a hand that reaches to the object's middle from the right, below and in front: palm, arm and fingers."""
    reach_m = 0.3 * size_m
    palm_m = np.array([reach_m + 0.03, -0.1 * size_m, -0.3 * size_m])
    elbow_m = palm_m + np.array([0.22, -0.05, -0.12])
    rods = [(palm_m, elbow_m, 0.035)]
    for finger in range(4):
        tip_m = np.array([-0.05 * size_m, (0.12 * finger - 0.3) * size_m, (0.1 * finger - 0.35) * size_m])
        rods.append((palm_m, tip_m, 0.009))
    meshes = [_rod(*rod) for rod in rods]
    counts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    triangles = [own + first for (_, own), first in zip(meshes, counts, strict=False)]
    return np.concatenate([vertices for vertices, _ in meshes]), np.concatenate(triangles)


def _rod(start_m: Array, end_m: Array, radius_m: float, sides: int = 16) -> Faces:
    """Return a rod that ends in points."""
    along = (end_m - start_m) / np.linalg.norm(end_m - start_m)
    right = np.cross(along, [0.3, 0.9, 0.1])
    right /= np.linalg.norm(right)
    angles = np.arange(sides) * 2.0 * np.pi / sides
    ring = radius_m * (np.cos(angles)[:, None] * right + np.sin(angles)[:, None] * np.cross(along, right))
    ends = np.stack([start_m - radius_m * along, end_m + radius_m * along])
    vertices_m = np.concatenate([start_m + ring, end_m + ring, ends])
    a = np.arange(sides)
    b = (a + 1) % sides
    first, last = np.full(sides, 2 * sides), np.full(sides, 2 * sides + 1)
    faces = [(a, b, a + sides), (b, b + sides, a + sides), (b, a, first), (a + sides, b + sides, last)]
    return vertices_m, np.concatenate([np.stack(face, axis=1) for face in faces])
