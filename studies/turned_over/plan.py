"""The recordings of the study: shape, second resting pose, and what the camera sees in between."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal, final

import numpy as np
import trimesh
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from modeler.composition.options import PriorOptions
from modeler.priors.table import WOBBLE_DEG, WOBBLE_M
from modeler.sequences.rendering import RenderedSequence
from modeler.sequences.rendering.recipe import Place, Places, Recipe, Tabletop, TurnedOver, Turntable
from modeler.sequences.rendering.shapes import MeshFile
from modeler.types import Array
from studies.calibration.specimens import load_specimen
from studies.scenes.plan import arm
from studies.trust.plan import HALVES, SHIFT_M, Half, viewed
from studies.trust.stage import Stage, posed

Gap = Literal["jump", "nothing", "hand"]
GAPS: Final[tuple[Gap, ...]] = ("jump", "nothing", "hand")
"""Between the two postures: no frame; frames without the object; frames in which a hand turns it before the camera."""
SHAPES: Final[dict[Half, tuple[str, ...]]] = {
    "tuning": ("l_bracket", "rubber_duck", "toy_car", "stapler", "mug"),
    "held-out": ("elephant", "grand_piano", "tow_truck", "tankard", "hatchet"),
}
"""Shapes that look different from every side, and one of each half that does so only by its handle."""
RECORDINGS: Final = 10
"""Of a half: two of each shape."""
FRAMES: Final = 13
"""Of each posture: a full turn in steps of 30°, and the first view again."""
_GAP_FRAMES: Final = 3
_LEAST_TURN_DEG: Final = 60.0  # between the postures: with less the table's normal in the object hardly changes


@final
@dataclass(frozen=True)
class Plan:
    """One recording."""

    half: Half
    """Whether methods may be tuned on it."""
    number: int
    """Within its half."""
    models: tuple[Path, ...] = ()
    """Mesh files to render instead of shapes: models of captures."""

    @property
    def shape(self) -> str:
        """Name of the object's recipe, or of its file."""
        names = tuple(path.stem for path in self.models) or SHAPES[self.half]
        return names[self.number % len(names)]

    @property
    def gap(self) -> Gap:
        """What is seen between the postures."""
        return GAPS[self.number % len(GAPS)]

    @property
    def seed(self) -> int:
        """Of motion, noise and registration."""
        return int(np.random.SeedSequence([24, HALVES.index(self.half), self.number]).generate_state(1)[0])

    @property
    def fault(self) -> str:
        """Return the gap, for tables."""
        return self.gap

    @property
    def gap_frames(self) -> range:
        """Numbers of the frames between the postures."""
        return range(FRAMES, FRAMES if self.gap == "jump" else FRAMES + _GAP_FRAMES)

    def stage(self) -> Stage:
        """Return the recording and its metadata."""
        recipe = load_specimen(SHAPES[self.half][0] if self.models else self.shape)
        if self.models:
            model = MeshFile(self.models[self.number % len(self.models)])
            recipe = replace(recipe, object=model, rest_rotation_deg=(0.0, 0.0, 0.0))
        return turned_over(viewed(recipe, np.random.default_rng(self.seed), self.seed), self)


def turned_over(recipe: Recipe, plan: Plan) -> Stage:
    """Return the stage on which an object stands for a full turn, and then lies for another."""
    rng = np.random.default_rng([plan.seed, 1])
    prior = ("table", "turntable", "table", "general")[plan.number % 4]
    before, after = (_turn(prior, int(rng.integers(2**31))) for _ in range(2))
    between = [_held_up(rng) if plan.gap == "hand" else Place((3.0, 0.0, 0.0)) for _ in plan.gap_frames]
    at = FRAMES + len(between)
    recipe = replace(
        recipe,
        trajectory=Places((*before, *between, *after)),
        turned_over=TurnedOver(at, lying_deg(recipe, rng)),
    )
    options = PriorOptions(prior=prior)
    if prior == "turntable":
        options = replace(options, step_deg=30.0, step_sigma_deg=1.0)
    stage = Stage(recipe, options, masks=bool(rng.integers(2)))
    return arm(stage, rng, shown=plan.gap_frames) if plan.gap == "hand" else stage


def _turn(prior: str, seed: int) -> list[Place]:
    """Return the poses of a full turn."""
    if prior == "turntable":
        return posed(Turntable(FRAMES, 30.0, 0.5, (0.01, 0.01), wobble_deg=WOBBLE_DEG, wobble_m=WOBBLE_M), seed)
    return posed(Tabletop(FRAMES, 30.0, shift_m=SHIFT_M, wobble_deg=WOBBLE_DEG, wobble_m=WOBBLE_M), seed)


def _held_up(rng: np.random.Generator) -> Place:
    """Return a pose above the table."""
    x_deg, y_deg, z_deg = rng.uniform(-60.0, 60.0, 3).tolist()
    return Place((0.0, 0.0, 0.05), (x_deg, y_deg, z_deg))


def lying_deg(recipe: Recipe, rng: np.random.Generator) -> tuple[float, float, float]:
    """Return a different resting pose of an object, turned about the vertical at random."""
    standing = Rotation.from_euler("xyz", recipe.rest_rotation_deg, degrees=True).as_matrix()
    down, areas_m2 = _rests(RenderedSequence(recipe).model().vertices_m)
    away = np.degrees(np.arccos(np.clip(-down @ standing[2], -1.0, 1.0))) >= _LEAST_TURN_DEG
    likely = np.where(away, areas_m2, 0.0)
    chosen = down[int(rng.choice(len(down), p=likely / likely.sum()))]
    pose = Rotation.align_vectors([[0.0, 0.0, -1.0]], [chosen])[0].as_matrix()
    spin = Rotation.from_euler("z", rng.uniform(0.0, 360.0), degrees=True).as_matrix()
    x_deg, y_deg, z_deg = Rotation.from_matrix(spin @ pose).as_euler("xyz", degrees=True).tolist()
    return x_deg, y_deg, z_deg


def _rests(vertices_m: Array) -> tuple[Array, Array]:
    """Return which directions (n, 3) of the model may point down for it to rest, and the areas (n,) it then rests on.

    It does on a face of its convex hull that has the hull's centre of mass above it.
    """
    hull = trimesh.Trimesh(vertices_m, ConvexHull(vertices_m).simplices).convex_hull
    down, areas_m2 = [], []
    for normal in np.unique(np.round(hull.face_normals, 2), axis=0):
        direction = normal / np.linalg.norm(normal)
        heights_m = hull.vertices @ direction
        touching = hull.vertices[heights_m > heights_m.max() - 1e-3]  # softer than steel, and so is the table
        if len(touching) < 3:
            continue
        plane = np.linalg.svd(direction[None])[2][1:]
        foot = ConvexHull(touching @ plane.T)
        if np.all(foot.equations @ np.append(plane @ hull.center_mass, 1.0) < 0.0):
            down.append(direction)
            areas_m2.append(foot.volume)  # in two dimensions
    return np.array(down), np.array(areas_m2)
