"""A rendered scene before it is recorded: the object, its surroundings, and the user's metadata."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np
from scipy.spatial.transform import Rotation

from modeler.composition.options import PriorOptions
from modeler.sequences import AbstractSequence
from modeler.sequences.meshes import Mesh
from modeler.sequences.rendering import RenderedSequence
from modeler.sequences.rendering.recipe import AnyTrajectory, Place, Places, Recipe
from modeler.types import Array, BoolArray, Frame

WIDTH_PX = 320
"""Of the images: half of a Kinect's, so that a run takes seconds."""


def posed(trajectory: AnyTrajectory, seed: int) -> list[Place]:
    """Return the poses of a trajectory one by one."""
    poses = trajectory.table_from_object(np.zeros(3), np.random.default_rng(seed))
    turns_deg = Rotation.from_matrix(poses[:, :3, :3]).as_euler("xyz", degrees=True)
    return [
        Place((float(x), float(y), float(z)), (float(a), float(b), float(c)))
        for (x, y, z), (a, b, c) in zip(poses[:, :3, 3], turns_deg, strict=True)
    ]


@final
@dataclass(frozen=True)
class Stage:
    """What is recorded, and what is said of it."""

    recipe: Recipe
    """The object and how it moves, pose by pose."""
    options: PriorOptions
    """What the user says of the motion."""
    masks: bool = False
    """Whether masks are handed over."""
    later: Recipe | None = None
    """What is in front of the camera from frame `since` on, where that changes; it moves as `recipe` says."""
    since: int = 0
    """Frame number."""
    foreign: bool = False
    """Whether `later` shows another object, of which no frame belongs into the model."""
    others: tuple[Recipe, ...] = ()
    """What else is in view, each with a pose for every frame."""
    mask_of: Callable[[int, BoolArray, Sequence[BoolArray]], BoolArray] = lambda index, own, others: own
    """Returns the mask that is handed over from frame number and the masks (h, w) of object and others."""
    occluder_of: Callable[[int, Sequence[BoolArray]], BoolArray | None] = lambda index, others: None
    """Returns what is handed over as hiding the object (h, w), from frame number and the masks of all others."""
    spoil: Callable[[Sequence[Frame]], Sequence[Frame]] = lambda frames: frames
    """Changes the frames that are handed over."""

    @property
    def places(self) -> tuple[Place, ...]:
        """The pose of the object in every frame."""
        trajectory = self.recipe.trajectory
        assert isinstance(trajectory, Places)
        return trajectory.poses

    def moving(self, places: Sequence[Place]) -> Stage:
        """Return the stage with other poses of the object."""
        return replace(self, recipe=replace(self.recipe, trajectory=Places(tuple(places))))


@final
@dataclass(frozen=True, eq=False)
class Recorded(AbstractSequence):
    """What a stage gives the user, and the truth."""

    stage: Stage
    """What is recorded."""

    @property
    def name(self) -> str:
        """Name of the object's recipe."""
        return self.stage.recipe.name

    @property
    def indices(self) -> tuple[int, ...]:
        """Frame numbers from 0."""
        return tuple(range(len(self._given)))

    def frame(self, index: int) -> Frame:
        """Return a frame as it is handed over."""
        return self._given[index]

    def truth(self) -> dict[int, Array]:
        """Return the true camera_from_model (4, 4) by frame number, without frames of another object."""
        return {
            index: self._shown(index).truth()[index]
            for index in self.indices
            if not (self.stage.foreign and index >= self.stage.since)
        }

    def model(self) -> Mesh:
        """Return the true surface of the object in its model frame, as it is at the start."""
        return self._first.model()

    def true_frame(self, index: int) -> Frame:
        """Return a frame as it would be without a fault of camera, depth or mask."""
        return self._true[index]

    @cached_property
    def _first(self) -> RenderedSequence:
        return RenderedSequence(self.stage.recipe)

    @cached_property
    def _second(self) -> RenderedSequence:
        assert self.stage.later is not None
        return RenderedSequence(replace(self.stage.later, trajectory=self.stage.recipe.trajectory))

    @cached_property
    def _others(self) -> tuple[RenderedSequence, ...]:
        return tuple(RenderedSequence(recipe) for recipe in self.stage.others)

    def _shown(self, index: int) -> RenderedSequence:
        """Return what is in front of the camera at a frame."""
        return self._first if self.stage.later is None or index < self.stage.since else self._second

    @cached_property
    def _layered(self) -> tuple[tuple[Frame, tuple[BoolArray, ...]], ...]:
        """Return every frame with the object's mask, and the masks of all others."""
        return tuple(self._layers(index) for index in self._first.indices)

    @cached_property
    def _true(self) -> tuple[Frame, ...]:
        return tuple(frame for frame, _ in self._layered)

    @cached_property
    def _given(self) -> tuple[Frame, ...]:
        handed = []
        for frame, others in self._layered:
            assert frame.mask is not None
            mask = self.stage.mask_of(frame.index, frame.mask, others) if self.stage.masks else None
            occluder = self.stage.occluder_of(frame.index, others)
            handed.append(replace(frame, mask=mask, occluder=occluder))
        return tuple(self.stage.spoil(handed))

    def _layers(self, index: int) -> tuple[Frame, tuple[BoolArray, ...]]:
        """Return a frame with the nearest of everything in it."""
        frame = self._shown(index).frame(index)
        assert frame.mask is not None
        depth_m, owner = frame.depth_m, np.where(frame.mask, 0, -1)
        for number, other in enumerate(self._others, 1):
            theirs = other.frame(index)
            nearer = np.nan_to_num(theirs.depth_m, nan=np.inf) < np.nan_to_num(depth_m, nan=np.inf)
            depth_m, owner = np.where(nearer, theirs.depth_m, depth_m), np.where(nearer, number, owner)
        masks = tuple(owner == number for number in range(len(self._others) + 1))
        return replace(frame, depth_m=depth_m, mask=masks[0]), masks[1:]
