"""An object on a table before the renderer's camera, which is moved step by step."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.sequences.meshes import Mesh
from modeler.sequences.rendering import RenderedSequence
from modeler.sequences.rendering.recipe import Place, Places, Recipe
from modeler.types import Array, Frame


@final
@dataclass(frozen=True)
class Stage:
    """An object on a table before the camera. A value: `moved` makes the next."""

    recipe: Recipe
    """The object and the camera; its trajectory is not used."""
    poses: tuple[Place, ...] = (Place(),)
    """The poses so far, the object's now last."""

    @property
    def sequence(self) -> RenderedSequence:
        """Return the frames so far."""
        return RenderedSequence(replace(self.recipe, trajectory=Places(self.poses)))

    def frame(self) -> Frame:
        """Return the current frame."""
        return self.sequence.frame(len(self.poses) - 1)

    def truth(self) -> dict[int, Array]:
        """Return the true camera_from_model (4, 4) of each frame so far."""
        return self.sequence.truth()

    def model(self) -> Mesh:
        """Return the true surface in the model frame."""
        return self.sequence.model()

    def moved(self, new_from_last: Array) -> Stage:
        """Return the stage after a motion (4, 4) of the object in the camera's coordinates."""
        camera_from_table = self.recipe.view.camera_from_table()
        motion = se3.inverse(camera_from_table) @ new_from_last @ camera_from_table
        return replace(self, poses=(*self.poses, place_of(motion @ matrix_of(self.poses[-1]))))

    def moved_on_table(self, turn_deg: float, shift_m: tuple[float, float]) -> Stage:
        """Return the stage after a turn about the object's own upright axis and a shift on the table, in m."""
        pose = matrix_of(self.poses[-1])
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
        moved = pose.copy()
        moved[:3, :3] = turn[:3, :3] @ pose[:3, :3]
        moved[:2, 3] += shift_m
        return replace(self, poses=(*self.poses, place_of(moved)))


def matrix_of(place: Place) -> Array:
    """Return the pose (4, 4) of a place."""
    pose = se3.translation(np.array(place.offset_m))
    pose[:3, :3] = Rotation.from_euler("xyz", place.rotation_deg, degrees=True).as_matrix()
    return pose


def place_of(pose: Array) -> Place:
    """Return the place of a pose (4, 4)."""
    x, y, z = (float(value) for value in pose[:3, 3])
    a, b, c = (float(value) for value in Rotation.from_matrix(pose[:3, :3]).as_euler("xyz", degrees=True))
    return Place((x, y, z), (a, b, c))
