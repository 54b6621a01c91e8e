"""The rendered scenes: which shape, how it moves, and what else is in view, drawn from half and number alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np
from scipy import ndimage

from modeler import se3
from modeler.composition.options import PriorOptions
from modeler.sequences.rendering import RenderedSequence
from modeler.sequences.rendering.recipe import Place, Places, Recipe, Table, Tabletop, Wall
from modeler.sequences.rendering.shapes import AnyShape, Box, Capsule, Cylinder
from modeler.types import Array, BoolArray, Frame
from studies.calibration.specimens import load_specimen
from studies.trust.plan import HALVES, SHIFT_M, Half, shapes, viewed
from studies.trust.stage import Stage, posed

Rng = np.random.Generator
FRAMES: Final = 10
"""Of a scene."""


def thing(recipe: Recipe, shape: AnyShape, places: Sequence[Place]) -> Recipe:
    """Return something else in the same view, on no table of its own."""
    own = replace(recipe, object=shape, table=None, wall=None, rest_rotation_deg=(0.0, 0.0, 0.0), turned_over=None)
    return replace(own, seed=recipe.seed + 1, trajectory=Places(tuple(places)))


def reach_m(recipe: Recipe) -> tuple[float, float, float]:
    """Return how far an object reaches along x and y from its middle, and up, as it stands."""
    standing = RenderedSequence(replace(recipe, trajectory=Places((Place(),))))
    table_from_model = se3.inverse(recipe.view.camera_from_table()) @ standing.truth()[0]
    x_m, y_m, z_m = se3.transform(table_from_model, standing.model().vertices_m).max(axis=0).tolist()
    return x_m, y_m, z_m


def _radius_m(stage: Stage) -> float:
    """Return how far the object reaches from the middle of the table, wherever it is and however it is turned."""
    x_m, y_m, _ = reach_m(stage.recipe)
    away_m = max(float(np.hypot(*place.offset_m[:2])) for place in stage.places)
    return float(np.hypot(x_m, y_m)) + away_m


def _with(stage: Stage, *others: Recipe) -> Stage:
    return replace(stage, others=(*stage.others, *others))


def bare(stage: Stage, rng: Rng) -> Stage:
    """Nothing else."""
    return stage


def wall(stage: Stage, rng: Rng) -> Stage:
    """A wall 1 to 10 cm behind where the object gets."""
    behind = Wall(_radius_m(stage) + float(rng.uniform(0.01, 0.1)))
    return replace(stage, recipe=replace(stage.recipe, wall=behind))


def clutter(stage: Stage, rng: Rng) -> Stage:
    """Boxes that stand about, 3 to 10 cm off, before and behind."""
    for _ in range(4):
        size_m = rng.uniform(0.03, 0.12, 3)
        angle_rad = float(rng.uniform(0.0, 2.0 * np.pi))
        away_m = _radius_m(stage) + 0.5 * float(np.hypot(*size_m[:2])) + float(rng.uniform(0.03, 0.1))
        at_m = away_m * np.cos(angle_rad), away_m * np.sin(angle_rad), 0.0
        place = Place(at_m, (0.0, 0.0, float(rng.uniform(0.0, 90.0))))
        box = Box((float(size_m[0]), float(size_m[1]), float(size_m[2])))
        stage = _with(stage, thing(stage.recipe, box, [place] * len(stage.places)))
    return stage


def passer_by(stage: Stage, rng: Rng) -> Stage:
    """A person walks past, 30 cm to 1 m behind."""
    behind_m = _radius_m(stage) + 0.15 + float(rng.uniform(0.3, 1.0))
    across_m = np.linspace(-0.8, 0.8, len(stage.places)) * float(rng.choice([-1.0, 1.0]))
    places = [Place((float(x_m), behind_m, -0.9)) for x_m in across_m]
    return _with(stage, thing(stage.recipe, Capsule(0.15, 1.5), places))


def small_table(stage: Stage, rng: Rng) -> Stage:
    """A table that ends 1 to 5 cm from the object, and nothing below or beyond it within 1 m."""
    side_m = 2.0 * (_radius_m(stage) + float(rng.uniform(0.01, 0.05)))
    return replace(stage, recipe=replace(stage.recipe, table=Table((side_m, side_m)), wall=Wall(1.0)))


def low_camera(stage: Stage, rng: Rng) -> Stage:
    """The camera sees the table at 2 to 5 degrees, and a wall 10 to 40 cm behind the object."""
    _, _, height_m = reach_m(stage.recipe)
    view = replace(
        stage.recipe.view, elevation_deg=float(rng.uniform(2.0, 5.0)), look_height_m=0.5 * height_m, distance_m=0.8
    )
    behind = Wall(_radius_m(stage) + float(rng.uniform(0.1, 0.4)))
    return replace(stage, recipe=replace(stage.recipe, view=view, wall=behind))


def dark_parts(stage: Stage, rng: Rng) -> Stage:
    """A fifth to two fifths of the object's surface, in patches of some cm, gives no depth."""
    cell_m, share, keys = float(rng.uniform(0.02, 0.04)), float(rng.uniform(0.2, 0.4)), rng.uniform(0.0, 1.0, 4096)
    truth = RenderedSequence(stage.recipe).truth()

    def spoil(frames: Sequence[Frame]) -> Sequence[Frame]:
        return [_darkened(frame, truth[frame.index], cell_m, keys < share) for frame in frames]

    return replace(stage, spoil=spoil)


def _darkened(frame: Frame, camera_from_model: Array, cell_m: float, dark: BoolArray) -> Frame:
    """Return a frame without depth in the dark cells of space about the model; the table is bright."""
    w, h = frame.camera.rays()
    depth_m = frame.depth_m.astype(np.float64)
    points_m = np.stack([w * depth_m, h * depth_m, depth_m], axis=-1).reshape(-1, 3)
    cells = np.floor(np.nan_to_num(se3.transform(se3.inverse(camera_from_model), points_m)) / cell_m).astype(np.int64)
    numbers = (cells @ np.array([73, 19, 83])) % len(dark)
    own = np.zeros(len(points_m), dtype=bool) if frame.mask is None else frame.mask.ravel()
    lost = ndimage.binary_opening((dark[numbers] & own).reshape(depth_m.shape))
    return replace(frame, depth_m=np.where(lost, np.float32(np.nan), frame.depth_m))


def turntable(stage: Stage, rng: Rng) -> Stage:
    """The object stands on a plate that stands on the table."""
    up_m = float(rng.uniform(0.03, 0.08))
    plate = Cylinder(_radius_m(stage) + float(rng.uniform(0.0, 0.04)), up_m)
    lifted = [Place((*p.offset_m[:2], p.offset_m[2] + up_m), p.rotation_deg) for p in stage.places]
    return _with(stage.moving(lifted), thing(stage.recipe, plate, [Place()] * len(lifted)))


def arm(stage: Stage, rng: Rng, *, radius_m: float = 0.025, shown: Sequence[int] | None = None) -> Stage:
    """A forearm comes from the right before the object in some frames, and touches it now and then."""
    x_m, y_m, height_m = reach_m(stage.recipe)
    shown = sorted(rng.choice(len(stage.places), 3, replace=False).tolist()) if shown is None else shown
    places = []
    for index, place in enumerate(stage.places):
        tip_m, before_m = float(rng.uniform(-0.8, 0.1)) * x_m, max(x_m, y_m) + radius_m
        before_m += float(rng.uniform(-0.02, 0.01))
        at_m = place.offset_m[0] + tip_m, place.offset_m[1] - before_m, height_m * float(rng.uniform(0.5, 0.8))
        away_m = 0.0 if index in shown else 3.0
        turn_deg = 0.0, 90.0 + float(rng.normal(0.0, 5.0)), float(rng.normal(0.0, 8.0))
        places.append(Place((at_m[0] + away_m, at_m[1], at_m[2]), turn_deg))
    return _with(stage, thing(stage.recipe, Capsule(radius_m, 0.8), places))


def everything(stage: Stage, rng: Rng) -> Stage:
    """A low camera, clutter, a passer-by before the wall."""
    stage = clutter(stage, rng)
    _, _, height_m = reach_m(stage.recipe)
    view = replace(stage.recipe.view, elevation_deg=float(rng.uniform(5.0, 15.0)), look_height_m=0.5 * height_m)
    others = tuple(replace(other, view=view) for other in stage.others)
    stage = replace(stage, recipe=replace(stage.recipe, view=view, wall=Wall(2.0)), others=others)
    return passer_by(stage, rng)


KINDS: Final[Mapping[str, Callable[[Stage, Rng], Stage]]] = {
    "bare table": bare,
    "wall close behind": wall,
    "clutter": clutter,
    "person behind": passer_by,
    "table half seen": small_table,
    "low camera": low_camera,
    "parts without depth": dark_parts,
    "plate on the table": turntable,
    "arm before it": arm,
    "low, cluttered, person": everything,
}
"""By name, what else is in view."""


@final
@dataclass(frozen=True)
class Plan:
    """One scene."""

    half: Half
    """Whether the segmenter may be changed by what is seen of it."""
    number: int
    """Within its half; the kinds take turns."""

    @property
    def kind(self) -> str:
        """Name of what else is in view."""
        return tuple(KINDS)[self.number % len(KINDS)]

    def stage(self) -> Stage:
        """Return what is recorded; no mask is handed over."""
        seed = int(np.random.SeedSequence([7, HALVES.index(self.half), self.number]).generate_state(1)[0])
        rng = np.random.default_rng(seed)
        name = str(rng.choice(shapes(self.half, "asymmetric", "near-symmetric", "n-fold", "revolution")))
        recipe = viewed(load_specimen(name), rng, seed)
        step_deg = float(rng.choice([15.0, 25.0, 36.0]))
        places = tuple(posed(Tabletop(FRAMES, step_deg, shift_m=SHIFT_M), seed))
        stage = Stage(replace(recipe, trajectory=Places(places)), PriorOptions(prior="table"))
        return KINDS[self.kind](stage, rng)
