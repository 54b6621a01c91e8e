"""What is recorded: a printed object turned on a table, and whether a model of it is right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, final

import numpy as np

from modeler import se3
from modeler.evaluation import align_to_model, rotation_error_deg, true_motion
from modeler.sequences.meshes import Mesh
from modeler.sequences.rendering import RenderedSequence
from modeler.sequences.rendering.recipe import Recipe, Table, Tabletop
from modeler.sequences.rendering.shapes import Box
from modeler.types import Array, Frame, ObjectModel
from studies.calibration.specimens import SPECIMENS, load_specimen, printed
from studies.trust.plan import viewed
from studies.trust.study import MAX_DEG, MAX_M, MIN_F, f_score

FRAMES: Final = 15
STEP_DEG: Final = 24.0
"""A whole turn, in steps as people take them."""
MAX_COLOUR: Final = 25.0
"""Mean error of a model's colours, of 255, from which on they are wrong: those of another camera, resized, gave 44."""
SIZES: Final[Mapping[str, tuple[tuple[float, float, float], float, float]]] = {
    "person": ((0.5, 0.35, 1.7), 3.0, 0.8),
    "chair": ((0.6, 0.55, 0.9), 2.0, 0.4),
    "backpack": ((0.35, 0.22, 0.45), 1.3, 0.2),
    "phone": ((0.075, 0.008, 0.15), 0.5, 0.07),
    "book": ((0.21, 0.15, 0.02), 0.6, 0.01),
}
"""Size of a box, distance of the camera and height of the point looked at, in m."""


@final
@dataclass(frozen=True, eq=False)
class Scene:
    """Frames before anybody saves them, and the truth."""

    rendered: RenderedSequence
    """The object on its table."""
    corner_px: tuple[int, int] = (0, 0)
    """Columns and rows that are cut off on the left and above, so that the principal point is off the middle."""

    @property
    def indices(self) -> tuple[int, ...]:
        """Frame numbers from 0."""
        return self.rendered.indices

    def frame(self, index: int) -> Frame:
        """Return a frame with the object's mask."""
        return self.frames[index]

    true_frame = frame

    @cached_property
    def frames(self) -> tuple[Frame, ...]:
        """All frames."""
        return tuple(map(self._cut, self.rendered))

    def truth(self) -> dict[int, Array]:
        """Return the true camera_from_model (4, 4) by frame number."""
        return self.rendered.truth()

    def model(self) -> Mesh:
        """Return the true surface."""
        return self.rendered.model()

    def _cut(self, frame: Frame) -> Frame:
        left, top = self.corner_px
        camera = frame.camera
        camera = replace(
            camera,
            width=camera.width - left,
            height=camera.height - top,
            cx=camera.cx - left,
            cy=camera.cy - top,
        )
        assert frame.mask is not None
        assert frame.colour is not None
        depth_m, mask, colour = (image[top:, left:].copy() for image in (frame.depth_m, frame.mask, frame.colour))
        return replace(frame, depth_m=depth_m, camera=camera, mask=mask, colour=colour)


def drawn(rng: np.random.Generator, *, sizes: bool) -> Scene:
    """Return a scene: shape, size, print, lamps, focal length, offset of the principal point, distance and motion.

    Args:
        rng: draws it.
        sizes: whether the object is as small, large or flat as a phone, a person or a book.
    """
    seed, shift_m = int(rng.integers(2**31)), 0.02
    if sizes:
        size_m, distance_m, look_m = SIZES[str(rng.choice([*SIZES]))]
        factor = float(rng.uniform(0.9, 1.1))
        thing = Recipe(
            object=Box(tuple(factor * side * float(rng.uniform(0.95, 1.05)) for side in size_m)),  # type: ignore[arg-type]
            table=Table((max(4.0 * size_m[0], 0.6), max(4.0 * size_m[0], 0.8))),
        )
        view = replace(viewed(thing, rng, seed).view, distance_m=factor * distance_m, look_height_m=factor * look_m)
        recipe = replace(viewed(thing, rng, seed), view=view, depth_unit_mm=1.0 if distance_m > 1.0 else 0.1)
        shift_m = 0.05 if distance_m > 1.0 else 0.02
    elif rng.random() < 0.5:
        side_m = rng.uniform(0.06, 0.13, 3)
        recipe = viewed(Recipe(object=Box((float(side_m[0]), float(side_m[1]), float(side_m[2])))), rng, seed)
        recipe = replace(recipe, table=Table((0.64, 0.84)))
    else:
        names = [each.recipe for each in SPECIMENS if each.symmetry in ("asymmetric", "n-fold")]
        recipe = viewed(load_specimen(str(rng.choice(names))), rng, seed)
    focal_px = recipe.view.focal_px * float(rng.uniform(0.85, 1.2))
    recipe = replace(printed(recipe, 1.0), view=replace(recipe.view, focal_px=focal_px))
    trajectory = Tabletop(FRAMES, STEP_DEG, 1.0, shift_m=shift_m, reach_m=2.0 * shift_m)
    corner_px = (int(rng.integers(0, 16)), int(rng.integers(0, 12)))
    return Scene(RenderedSequence(replace(recipe, trajectory=trajectory)), corner_px)


@final
@dataclass(frozen=True)
class Errors:
    """Of a model against the truth."""

    rotation_deg: float | None
    """Largest of a pose against the first; None without two poses."""
    f_score: float | None
    """Of the mesh at the tolerance, or 5 mm; None without a mesh."""
    colour: float | None
    """Mean absolute error of the vertices' colours, of 255; None without."""

    @property
    def right(self) -> bool:
        """Whether all are small."""
        if self.rotation_deg is None or self.f_score is None:
            return False
        return self.rotation_deg <= MAX_DEG and self.f_score >= MIN_F and (self.colour or 0.0) <= MAX_COLOUR


def errors(
    scene: Scene, model: ObjectModel | None, poses: Mapping[int, Array], shown: Sequence[int], tolerance_m: float
) -> Errors:
    """Compare a run with the truth.

    Args:
        scene: what was recorded.
        model: of the run.
        poses: object_from_camera (4, 4) by place among the frames of the input.
        shown: frame number of the scene by place.
        tolerance_m: that of the run.
    """
    truth = scene.truth()
    if len(poses) < 2:
        return Errors(None, None, None)
    first = min(poses)
    worst_deg = max(
        rotation_error_deg(se3.inverse(poses[first]) @ pose, true_motion(truth, shown[first], shown[place]))
        for place, pose in poses.items()
    )
    if model is None or not len(model.triangles):
        return Errors(worst_deg, None, None)
    trajectory = {shown[place]: pose for place, pose in poses.items()}
    score = f_score(scene, model, trajectory, max(MAX_M, tolerance_m))
    return Errors(worst_deg, score, _colour_error(scene, model, align_to_model(trajectory, truth)))


def _colour_error(scene: Scene, model: ObjectModel, model_from_object: Array) -> float | None:
    """Return the mean error of the vertices' colours against the frames that see them from the front."""
    if model.vertex_colours is None:
        return None
    total, count = 0.0, 0
    points_m = se3.transform(model_from_object, model.vertices_m)
    normals = model.vertex_normals @ model_from_object[:3, :3].T
    for frame in scene.frames:
        pose, camera = scene.truth()[frame.index], frame.camera
        seen_m = se3.transform(pose, points_m)
        columns = np.rint(seen_m[:, 0] / seen_m[:, 2] * camera.fx + camera.cx).astype(int)
        rows = np.rint(seen_m[:, 1] / seen_m[:, 2] * camera.fy + camera.cy).astype(int)
        facing = ((normals @ pose[:3, :3].T) * seen_m).sum(axis=1) < -0.5 * np.linalg.norm(seen_m, axis=1)
        inside = facing & (columns >= 0) & (rows >= 0) & (columns < camera.width) & (rows < camera.height)
        at = np.flatnonzero(inside)
        near = np.abs(frame.depth_m[rows[at], columns[at]] - seen_m[at, 2]) < 2.0 * MAX_M
        at = at[near]
        assert frame.colour is not None
        off = np.abs(frame.colour[rows[at], columns[at]].astype(float) - model.vertex_colours[at])
        total, count = total + float(off.sum()), count + off.size
    return total / count if count else None
