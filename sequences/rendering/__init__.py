"""Synthetic sequences: rays cast at the object and its surroundings, seen by a depth camera with noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.sequences.base import AbstractSequence, span
from modeler.sequences.bop import write_bop
from modeler.sequences.meshes import Caster, Hits, Mesh, outer_surface, ply_bytes
from modeler.sequences.rendering.cameras import EXACT, DepthSensor, Exposure, LitMesh, Photography
from modeler.sequences.rendering.labels import LabelledMesh
from modeler.sequences.rendering.recipe import Hand, Mosaic, Recipe
from modeler.sequences.rendering.shapes import Box, placement
from modeler.types import Array, Camera, Frame, InputError, SensorNoise

_WALL_THICKNESS_M = 0.05  # any: only its front is seen


def surroundings(recipe: Recipe) -> Mesh:
    """Return table and wall in the table frame."""
    meshes = [Mesh.single(np.zeros((0, 3)), np.zeros((0, 3), np.int64))]
    if recipe.table is not None:
        table = recipe.table
        slab = Box((*table.size_m, table.thickness_m)).mesh().painted(table.rgb)
        meshes.append(slab.moved(placement((0.0, 0.0, -table.thickness_m / 2.0), (0.0, 0.0, 0.0))))
    if recipe.wall is not None:
        wall = recipe.wall
        slab = Box((wall.size_m[0], _WALL_THICKNESS_M, wall.size_m[1])).mesh().painted(wall.rgb)
        meshes.append(slab.moved(placement((0.0, wall.distance_m + _WALL_THICKNESS_M / 2.0, 0.0), (0.0, 0.0, 0.0))))
    return Mesh.joined(meshes)


def mosaic_shade(points_m: Array, mosaic: Mosaic) -> Array:
    """Return how bright (n,) a mosaic is at points (n, 3) of the model frame."""
    # The shift keeps faces of usual sizes off the borders of cells, where rounding would decide.
    cell = np.floor(points_m / mosaic.cell_m + np.array([0.37, 0.41, 0.43])).astype(np.int64).astype(np.uint64)
    code = cell[:, 0] * np.uint64(73856093) ^ cell[:, 1] * np.uint64(19349663) ^ cell[:, 2] * np.uint64(83492791)
    code = (code ^ (code >> np.uint64(13))) * np.uint64(0x9E3779B97F4A7C15)
    return 1.0 - mosaic.contrast * (code >> np.uint64(40)).astype(np.float64) / 2.0**24


_MOTION, _READINGS, _FRAMES, _PHOTOGRAPHS, _SHIFTS = range(5)  # keys of the seed's branches


@dataclass(frozen=True)
class RenderedSequence(AbstractSequence):
    """A sequence that is rendered as it is read; the same recipe gives the same frames."""

    recipe: Recipe

    @property
    def name(self) -> str:
        return self.recipe.name

    @property
    def indices(self) -> tuple[int, ...]:
        return tuple(range(len(self._camera_from_model)))

    def frame(self, index: int) -> Frame:
        """Return the frame with number `index`, with mask and, where the recipe asks for it, colour."""
        if index not in self.indices:
            raise InputError(f"sequence {self.name!r} has no frame {index}; its frames are {span(self.indices)}.")
        recipe, camera = self.recipe, self.recipe.view.camera()
        jitter_rng, sensor_rng = self._rng(_FRAMES, index).spawn(2)
        nominal = np.stack([*camera.rays(), np.ones((camera.height, camera.width))], axis=-1)
        looked, on_object = self._look(index, self._jittered(nominal, camera, jitter_rng))
        exposure = Exposure(looked.depth_m, looked.incidence_rad, self._shadowed(index, looked))
        depth_m = self._sensor.measure(exposure, recipe.view.focal_px, sensor_rng)
        colour = None if recipe.colour == "none" else self._coloured(index, nominal)
        mask = on_object if recipe.masks else None
        return Frame(index, index * recipe.period_s, depth_m, camera, mask, colour)

    def truth(self) -> dict[int, Array]:
        return dict(enumerate(self._camera_from_model))

    def sensor(self) -> SensorNoise:
        """Return the camera's noise at the distance of the object."""
        view, photography = self.recipe.view, self.recipe.photography
        shift_px = 0.0 if photography is None else np.sqrt(2.0) * photography.shift_px
        sigmas = self._sensor.sigmas(view.distance_m, view.focal_px, self.recipe.depth_unit_mm / 1000.0)
        # 0.1: colours interpolated along the rays of depth, by hand.
        return SensorNoise(*sigmas, float(np.hypot(shift_px, 0.1)), sigma_focal=0.0)

    @property
    def motion(self) -> Mapping[str, Any] | None:
        return self.recipe.trajectory.motion()

    def model(self) -> Mesh:
        """Return the true outer surface in the model frame, in m."""
        return outer_surface(self._mesh)

    def robot_readings(self) -> Array | None:
        """Return camera_from_hand (n, 4, 4) as the robot reads it; None if no robot holds the object."""
        trajectory = self.recipe.trajectory
        if not isinstance(trajectory, Hand) or trajectory.robot is None:
            return None
        return trajectory.robot.camera_from_hand(self._camera_from_model, self._rng(_READINGS))

    def _rng(self, *branch: int) -> np.random.Generator:
        return np.random.default_rng((self.recipe.seed, *branch))

    @property
    def _sensor(self) -> DepthSensor:
        return EXACT if self.recipe.sensor is None else self.recipe.sensor

    @cached_property
    def _mesh(self) -> Mesh:
        return self.recipe.object.mesh()

    @cached_property
    def _casters(self) -> tuple[Caster, Caster]:
        """Return the object in its model frame, and its surroundings in the camera frame."""
        return Caster(self._mesh), Caster(surroundings(self.recipe).moved(self.recipe.view.camera_from_table()))

    @cached_property
    def _lit(self) -> tuple[LitMesh, LitMesh]:
        """Return the object in its model frame, and its surroundings in the camera frame."""
        thing, around = self._casters
        label = self.recipe.label
        if label is None:
            return LitMesh(thing.mesh), LitMesh(around.mesh)
        view, photography = self.recipe.view, self.recipe.photography
        assert photography is not None
        sample_m = view.distance_m / view.focal_px / photography.samples
        return LitMesh(thing.mesh, LabelledMesh(label, thing.mesh, sample_m)), LitMesh(around.mesh)

    @cached_property
    def _camera_from_model(self) -> Array:
        recipe, turned_over = self.recipe, self.recipe.turned_over
        object_from_model, centre_m = self._resting(recipe.rest_rotation_deg)
        table_from_object = recipe.trajectory.table_from_object(centre_m, self._rng(_MOTION))
        rests = np.tile(object_from_model, (len(table_from_object), 1, 1))
        if turned_over is not None:
            rests[turned_over.at :] = self._resting(turned_over.rest_rotation_deg)[0]
        return recipe.view.camera_from_table() @ table_from_object @ rests

    def _resting(self, rotation_deg: tuple[float, float, float]) -> tuple[Array, Array]:
        """Return object_from_model (4, 4) of the object set on the table, and its centre (3,) there."""
        vertices_m = self._mesh.moved(placement((0.0, 0.0, 0.0), rotation_deg)).vertices_m
        low, high = vertices_m.min(axis=0), vertices_m.max(axis=0)
        middle = 0.5 * (low + high)
        resting = placement((-middle[0], -middle[1], -low[2]), rotation_deg)
        return resting, np.array([0.0, 0.0, middle[2] - low[2]])

    def _jittered(self, rays: Array, camera: Camera, rng: np.random.Generator) -> Array:
        if self._sensor.jitter is None:
            return rays
        along_w, along_h = self._sensor.jitter.offsets_px((camera.height, camera.width), rng)
        return rays + np.stack([along_w / camera.fx, along_h / camera.fy, np.zeros_like(along_w)], axis=-1)

    def _look(self, index: int, rays: Array) -> tuple[Hits, npt.NDArray[np.bool_]]:
        """Return the first hits of camera rays (h, w, 3), and where they are on the object."""
        on_thing, behind, first = self._met(index, rays)
        return on_thing.over(behind, first), first

    def _met(self, index: int, rays: Array) -> tuple[Hits, Hits, npt.NDArray[np.bool_]]:
        """Return the hits of rays (h, w, 3) on the object and its surroundings, and where the object is first."""
        thing, around = self._casters
        on_thing, behind = thing.cast(rays, self._camera_from_model[index]), around.cast(rays, np.eye(4))
        first = on_thing.depth_m < np.where(np.isnan(behind.depth_m), np.inf, behind.depth_m)
        return on_thing, behind, first

    def _shadowed(self, index: int, looked: Hits) -> npt.NDArray[np.bool_]:
        if not self._sensor.shadow:
            return np.zeros(looked.depth_m.shape, bool)
        projector_m = np.array([self._sensor.baseline_m, 0.0, 0.0])
        thing, around = self._casters
        by_thing = thing.blocks(projector_m, looked.points_m, self._camera_from_model[index])
        return by_thing | around.blocks(projector_m, looked.points_m, np.eye(4))

    def _coloured(self, index: int, rays: Array) -> npt.NDArray[np.uint8]:
        """Return the colour image (h, w, 3) seen along rays (h, w, 3) through the pixels' middles."""
        photography = self.recipe.photography
        if photography is None:
            return self._painted(index, rays)
        steps = ((np.arange(photography.samples) + 0.5) / photography.samples - 0.5) / self.recipe.view.focal_px
        shift = photography.shift_px / self.recipe.view.focal_px * self._rng(_SHIFTS, index).normal(size=2)
        offsets = [np.array([along_w + shift[0], along_h + shift[1], 0.0]) for along_w in steps for along_h in steps]
        light = sum((self._light(index, rays + offset, photography) for offset in offsets), np.zeros_like(rays))
        return photography.image(light / len(offsets), self._rng(_PHOTOGRAPHS, index))

    def _light(self, index: int, rays: Array, photography: Photography) -> Array:
        """Return the light (h, w, 3) that comes along rays (h, w, 3)."""
        on_thing, behind, first = self._met(index, rays)
        light = np.zeros_like(rays)
        thing, around = self._lit
        for lit, hits, seen, camera_from_mesh in (
            (thing, on_thing, first, self._camera_from_model[index]),
            (around, behind, ~first & np.isfinite(behind.depth_m), np.eye(4)),
        ):
            light[seen] = lit.light(photography, hits, seen, camera_from_mesh)
        return light

    def _painted(self, index: int, rays: Array) -> npt.NDArray[np.uint8]:
        """Return the colour image (h, w, 3), lit from the camera."""
        looked, on_object = self._look(index, rays)
        light = 0.35 + 0.65 * np.cos(looked.incidence_rad)
        if self.recipe.pattern is not None:
            model_from_camera = se3.inverse(self._camera_from_model[index])
            painted = mosaic_shade(se3.transform(model_from_camera, looked.points_m[on_object]), self.recipe.pattern)
            light[on_object] *= painted
        lit = np.where(np.isnan(looked.depth_m)[..., None], 0.0, looked.albedo * light[..., None])
        return np.rint(np.clip(np.nan_to_num(lit), 0.0, 255.0)).astype(np.uint8)


def render(
    recipe: Recipe, folder: Path, through: Callable[[AbstractSequence], AbstractSequence] = lambda sequence: sequence
) -> None:
    """Write the sequence of a recipe as a BOP scene folder, with the true surface as `model.ply`.

    Raises:
        InputError: if the folder is not empty or cannot be written.
    """
    sequence = RenderedSequence(recipe)
    files = {"model.ply": ply_bytes(sequence.model())}
    readings = sequence.robot_readings()
    if readings is not None:
        files["robot.txt"] = _tum_bytes(readings, recipe.period_s)
    write_bop(
        folder,
        through(sequence),
        sequence.truth(),
        {
            "name": recipe.name,
            "sensor": sequence.sensor()._asdict(),
            **({} if sequence.motion is None else {"motion": sequence.motion}),
            "ground_truth": "exact",
            "source": "rendered",
            "license": "MIT",
        },
        depth_scale_mm=recipe.depth_unit_mm,
        colour_suffix=f".{recipe.colour}",
        files=files,
    )


def _tum_bytes(poses: Array, period_s: float) -> bytes:
    """Return poses (n, 4, 4) as lines `time tx ty tz qx qy qz qw`."""
    lines = ["# time_s and camera_from_hand: tx ty tz qx qy qz qw"]
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    for index, (pose, quaternion) in enumerate(zip(poses, quaternions, strict=True)):
        lines.append(" ".join(f"{value:.9f}" for value in (index * period_s, *pose[:3, 3], *quaternion)))
    return ("\n".join(lines) + "\n").encode()
