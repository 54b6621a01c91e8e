"""Faults of a recording or of its metadata: one each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np
from scipy import ndimage

from modeler.composition.options import PriorOptions
from modeler.sequences.rendering.recipe import Place, Places, Recipe, Tabletop, Turntable, Wall
from modeler.sequences.rendering.shapes import AnyShape, Box, Capsule, Compound, Part
from modeler.types import BoolArray, Frame
from studies.calibration.specimens import Symmetry
from studies.trust.stage import Stage, posed

Rng = np.random.Generator
Put = Callable[[Stage, Recipe, Rng], Stage]
_DISC = ndimage.iterate_structure(ndimage.generate_binary_structure(2, 1), 1)


def _signed(rng: Rng, least: float, most: float) -> float:
    """Draw a size of either sign."""
    return float(rng.uniform(least, most) * rng.choice([-1.0, 1.0]))


def _span(rng: Rng, count: int) -> range:
    """Draw some frames that follow each other, a fifth to a half of all, behind the first."""
    length = max(int(count * rng.uniform(0.2, 0.5)), 1)
    start = int(rng.integers(1, count - length + 1))
    return range(start, start + length)


def _half_width_m(recipe: Recipe) -> float:
    """Return how far the object reaches from its axis, however it is turned."""
    low, high = (edge(recipe.object.mesh().vertices_m, axis=0) for edge in (np.min, np.max))
    return 0.5 * float(np.linalg.norm((high - low)[:2]))


def _height_m(recipe: Recipe) -> float:
    vertices_m = recipe.object.mesh().vertices_m
    return float(np.ptp(vertices_m[:, 2]))


def _thing(stage: Stage, shape: AnyShape, places: Sequence[Place]) -> Recipe:
    """Return something else in the same view, on no table of its own."""
    own = replace(stage.recipe, object=shape, table=None, wall=None, rest_rotation_deg=(0.0, 0.0, 0.0))
    return replace(own, seed=stage.recipe.seed + 1, trajectory=Places(tuple(places)))


def loose_mask(stage: Stage, other: Recipe, rng: Rng) -> Stage:
    """Masks reach over the rim."""
    steps = int(rng.integers(4, 13))
    return replace(stage, masks=True, mask_of=lambda _, own, __: ndimage.binary_dilation(own, _DISC, steps))


def thin_mask(stage: Stage, other: Recipe, rng: Rng) -> Stage:
    """Masks leave the rim out."""
    steps = int(rng.integers(2, 7))
    return replace(stage, masks=True, mask_of=lambda _, own, __: ndimage.binary_erosion(own, _DISC, steps))


def late_mask(stage: Stage, other: Recipe, rng: Rng) -> Stage:
    """Masks are those of the frames before."""

    def late(frames: Sequence[Frame]) -> Sequence[Frame]:
        before = [frames[0], *frames[:-1]]
        return [replace(frame, mask=earlier.mask) for frame, earlier in zip(frames, before, strict=True)]

    return replace(stage, masks=True, spoil=late)


def other_mask(stage: Stage, other: Recipe, rng: Rng) -> Stage:
    """Masks are those of a neighbouring box, in all frames or in some."""
    count, reach_m = len(stage.places), _half_width_m(stage.recipe)
    size_m = rng.uniform(0.05, 0.12, 3)
    beside = Place((float(rng.choice([-1.0, 1.0])) * (reach_m + 0.13), 0.0, float(size_m[2]) / 2.0))
    box = _thing(stage, Box((float(size_m[0]), float(size_m[1]), float(size_m[2]))), [beside] * count)
    wrong = range(count) if rng.random() < 0.5 else _span(rng, count)

    def mask_of(index: int, own: BoolArray, others: Sequence[BoolArray]) -> BoolArray:
        return others[0] if index in wrong else own

    return replace(stage, masks=True, others=(box,), mask_of=mask_of)


def wall_behind(stage: Stage, other: Recipe, rng: Rng) -> Stage:
    """A wall stands close behind the object, and there are no masks."""
    away_m = max(place.offset_m[1] for place in stage.places) + _half_width_m(stage.recipe)
    wall = Wall(away_m + float(rng.uniform(0.005, 0.04)))
    return replace(stage, masks=False, recipe=replace(stage.recipe, wall=wall))


def box_behind(stage: Stage, other: Recipe, rng: Rng) -> Stage:
    """A box stands close behind the object, and there are no masks."""
    away_m = max(place.offset_m[1] for place in stage.places) + _half_width_m(stage.recipe)
    size_m = (float(rng.uniform(0.1, 0.3)), 0.08, _height_m(stage.recipe) * float(rng.uniform(0.5, 1.5)))
    place = Place((_signed(rng, 0.0, 0.06), away_m + 0.04 + float(rng.uniform(0.003, 0.03)), size_m[2] / 2.0))
    return replace(stage, masks=False, others=(_thing(stage, Box(size_m), [place] * len(stage.places)),))


def person_behind(stage: Stage, other: Recipe, rng: Rng) -> Stage:
    """A person sways close behind the object, and there are no masks."""
    away_m = _half_width_m(stage.recipe) + 0.05 + 0.14 + float(rng.uniform(0.01, 0.15))
    swaying = posed(Tabletop(len(stage.places), 0.0, 3.0, 0.01, 0.02), int(rng.integers(2**31)))
    places = [Place((p.offset_m[0], p.offset_m[1] + away_m, -0.1), p.rotation_deg) for p in swaying]
    return replace(stage, masks=False, others=(_thing(stage, Capsule(0.14, 0.7), places),))


def camera_bumped(stage: Stage, other: Recipe, rng: Rng) -> Stage:
    """The camera is bumped between two frames."""
    view = stage.recipe.view
    bumped = replace(
        view,
        distance_m=view.distance_m + _signed(rng, 0.0, 0.05),
        elevation_deg=view.elevation_deg + _signed(rng, 1.0, 8.0),
    )
    since = int(rng.integers(2, len(stage.places) - 1))
    return replace(stage, later=replace(stage.recipe, view=bumped), since=since)


def replaced(stage: Stage, other: Recipe, rng: Rng) -> Stage:
    """Another object takes the object's place."""
    later = replace(other, view=stage.recipe.view, table=stage.recipe.table)
    return replace(stage, later=later, since=int(rng.integers(3, len(stage.places) - 2)), foreign=True)


def two_objects(stage: Stage, other: Recipe, rng: Rng) -> Stage:
    """Another object moves next to it, in masks too if these are given."""
    apart_m = _half_width_m(stage.recipe) + _half_width_m(other) + 0.02
    side = float(rng.choice([-1.0, 1.0]))
    own = [Place((p.offset_m[0] - side * apart_m / 2.0, *p.offset_m[1:]), p.rotation_deg) for p in stage.places]
    moves = posed(Tabletop(len(own), _signed(rng, 0.0, 30.0), 3.0, 0.01, 0.02), int(rng.integers(2**31)))
    theirs = [Place((p.offset_m[0] + side * apart_m / 2.0, *p.offset_m[1:]), p.rotation_deg) for p in moves]
    both = _thing(stage, other.object, theirs)
    both = replace(both, rest_rotation_deg=other.rest_rotation_deg)
    return replace(stage.moving(own), others=(both,), mask_of=lambda _, own, others: own | others[0])


def hand_in_view(stage: Stage, other: Recipe, rng: Rng) -> Stage:
    """A forearm reaches to the object, in all frames or in some, in masks too where these are handed over."""
    count, reach_m = len(stage.places), _half_width_m(stage.recipe)
    shown = range(count) if rng.random() < 0.5 else _span(rng, count)
    up_m = _height_m(stage.recipe) * float(rng.uniform(0.4, 0.9))
    places = []
    for index in range(count):
        x_m, y_m = reach_m * 0.8 + rng.normal(0.0, 0.006), rng.normal(0.0, 0.006)
        away_m = 0.0 if index in shown else 2.0  # to the right, out of the picture
        places.append(Place((float(x_m) + away_m, float(y_m), up_m), (0.0, 80.0 + float(rng.normal(0.0, 4.0)), 0.0)))
    arm = _thing(stage, Compound((Part(Capsule(0.035, 0.3)),)), places)
    return replace(stage, others=(arm,), mask_of=lambda _, own, others: own | others[0])


def object_still(stage: Stage, other: Recipe, rng: Rng) -> Stage:
    """The object stands still for some frames, or for all."""
    count = len(stage.places)
    still = range(1, count) if rng.random() < 0.25 else _span(rng, count)
    order = [min(k, still.start - 1) if k < still.stop else k - len(still) for k in range(count)]
    return stage.moving([stage.places[k] for k in order])


def wrong_intrinsics(stage: Stage, other: Recipe, rng: Rng) -> Stage:
    """The given focal length is 2 to 10 % too long or too short."""
    factor = 1.0 + _signed(rng, 0.02, 0.1)

    def off(frames: Sequence[Frame]) -> Sequence[Frame]:
        return [
            replace(frame, camera=replace(frame.camera, fx=factor * frame.camera.fx, fy=factor * frame.camera.fy))
            for frame in frames
        ]

    return replace(stage, spoil=off)


def wrong_scale(stage: Stage, other: Recipe, rng: Rng) -> Stage:
    """The given depth scale is 2 to 10 % too large or too small."""
    factor = np.float32(1.0 + _signed(rng, 0.02, 0.1))
    return replace(stage, spoil=lambda frames: [replace(frame, depth_m=factor * frame.depth_m) for frame in frames])


def _turntable(stage: Stage, rng: Rng) -> tuple[Stage, float]:
    """Return the object on a turntable, and its step in degrees."""
    step_deg = float(rng.choice([20.0, 30.0]))
    places = posed(Turntable(13, step_deg, 0.5), int(rng.integers(2**31)))
    return stage.moving(places), step_deg


def wrong_step(stage: Stage, other: Recipe, rng: Rng) -> Stage:
    """The given step of the turntable is 10 to 60 % too large, or as much too small."""
    stage, step_deg = _turntable(stage, rng)
    factor = float(rng.uniform(1.1, 1.6)) ** float(rng.choice([-1.0, 1.0]))
    return replace(stage, options=PriorOptions(prior="turntable", step_deg=step_deg * factor, step_sigma_deg=1.0))


def wrong_sense(stage: Stage, other: Recipe, rng: Rng) -> Stage:
    """The given sign of the turntable's step is wrong."""
    stage, step_deg = _turntable(stage, rng)
    return replace(stage, options=PriorOptions(prior="turntable", step_deg=-step_deg, step_sigma_deg=1.0))


def symmetric(stage: Stage, other: Recipe, rng: Rng) -> Stage:
    """The object is a body of revolution, or nearly one."""
    return stage


def large_steps(stage: Stage, other: Recipe, rng: Rng) -> Stage:
    """The object turns by 55° to 180° from frame to frame."""
    step_deg, turntable = float(rng.uniform(55.0, 180.0)), stage.options.prior == "turntable"
    places = posed(Tabletop(10, step_deg, 3.0, 0.02), int(rng.integers(2**31)))
    return replace(stage.moving(places), options=PriorOptions(prior="table") if turntable else stage.options)


def few_frames(stage: Stage, other: Recipe, rng: Rng) -> Stage:
    """There are two to four frames."""
    return stage.moving(stage.places[: int(rng.integers(2, 5))])


def deformed(stage: Stage, other: Recipe, rng: Rng) -> Stage:
    """The object is stretched or shrunk along one axis by 8 to 25 % between two frames."""
    stretch = [1.0, 1.0, 1.0]
    stretch[int(rng.integers(3))] = float(1.0 + rng.uniform(0.08, 0.25)) ** float(rng.choice([-1.0, 1.0]))
    shape = Compound((Part(stage.recipe.object, stretch=(stretch[0], stretch[1], stretch[2])),))
    since = int(rng.integers(3, len(stage.places) - 2))
    return replace(stage, later=replace(stage.recipe, object=shape), since=since)


@final
@dataclass(frozen=True)
class Fault:
    """A fault, put into a stage that is sound."""

    name: str
    """In words."""
    put: Put
    """From the stage, another object and a generator."""
    symmetries: tuple[Symmetry, ...] = ("asymmetric", "n-fold")
    """Of the object."""


FAULTS: Final = (
    Fault("masks loose", loose_mask),
    Fault("wall behind", wall_behind),
    Fault("intrinsics", wrong_intrinsics),
    Fault("large steps", large_steps),
    Fault("object replaced", replaced),
    Fault("masks thin", thin_mask),
    Fault("box behind", box_behind),
    Fault("depth scale", wrong_scale),
    Fault("wrong step", wrong_step),
    Fault("deformed", deformed),
    Fault("masks late", late_mask),
    Fault("person behind", person_behind),
    Fault("camera bumped", camera_bumped),
    Fault("wrong sign of the step", wrong_sense),
    Fault("two objects", two_objects),
    Fault("masks of another object", other_mask),
    Fault("hand in view", hand_in_view),
    Fault("object still", object_still),
    Fault("symmetric", symmetric, ("near-symmetric", "revolution")),
    Fault("few frames", few_frames),
)
"""In the order in which runs have them."""
