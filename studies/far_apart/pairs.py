"""The pairs of the study: rendered shapes one to four steps of 25° apart, and recordings with known poses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Literal, final

import numpy as np

from modeler.evaluation import rotation_error_deg, true_motion
from modeler.priors import GeneralPrior
from modeler.sequences import open_sequence
from modeler.sequences.rendering import RenderedSequence
from modeler.types import AbstractPoseDensity, Array, RayImage
from studies.ablation.pairs import SHARED, recorded_views
from studies.calibration.specimens import Half, load_specimen
from studies.calibration.study import Condition, rendered_views, staged

Limits = Literal["given", "none", "default"]
"""Prior of the motion: limits that contain it, wide limits, or the defaults."""

STEPS: Final = 4
STEP_DEG: Final = 25.0
SHAPES: Final[dict[Half, tuple[str, ...]]] = {
    "tuning": ("l_bracket", "rubber_duck", "toy_car", "watering_can", "stapler", "mug", "telephone", "box"),
    "held-out": ("elephant", "jigsaw", "grand_piano", "tow_truck", "parrot", "dustpan", "tankard", "hatchet"),
}
"""Shapes that look different from every side, a near-symmetric one and, to tune on, one with two-fold symmetry."""
RECORDINGS: Final[dict[str, tuple[int, tuple[int, ...]]]] = {
    "bear": (2, (1, 2)),
    "dog_upright": (1, (1, 2)),
    "cap": (5, (1, 2, 3)),
    "dragon": (4, (1, 2, 3, 4)),
}
"""Every how many-th frame is a target, and how many frames before the source it lies."""
_RIGHT_DEG: Final = {"dragon": 16.2, "dog_upright": 16.2}


@final
@dataclass(frozen=True, eq=False)
class Pair:
    """Two views and the motion between them."""

    group: str
    """`shapes`, or a recording's name."""
    name: str
    """The shape, or the recording."""
    steps: int
    """How many steps lie between the views."""
    source: RayImage
    target: RayImage
    truth: Array
    """(4, 4) target_from_source."""

    @property
    def turn_deg(self) -> float:
        """Angle of the rotation between the views."""
        return rotation_error_deg(np.eye(4), self.truth)

    @property
    def right_deg(self) -> float:
        """Rotation error under which an answer is right: 5°, or as literature has it."""
        return _RIGHT_DEG.get(self.group, 5.0)

    def density(self, limits: Limits) -> AbstractPoseDensity:
        """Return the prior of the motion for given or wide limits."""
        if limits == "given":
            reach_deg = 50.0 if self.turn_deg < 40.0 else min(self.turn_deg + 20.0, 180.0)
            return GeneralPrior(reach_deg, 0.09).between(self.source, self.target)
        return GeneralPrior(180.0, 0.2).between(self.source, self.target)


def pairs(half: Half, *, every: int = 1) -> Iterator[Pair]:
    """Yield pairs of the shapes of a half and, to tune on, of recordings; every n-th of the targets."""
    for name in SHAPES[half]:
        yield from _of("shapes", name, _rendered(name), range(1, STEPS + 1), ())
    if half == "tuning" and SHARED.exists():
        for name, (gap, offsets) in RECORDINGS.items():
            yield from _of(name, name, _recorded(name), offsets, range(0, 100, gap * every))


Views = tuple[dict[int, RayImage], dict[int, Array]]


def _of(group: str, name: str, views: Views, offsets: Sequence[int], targets: Sequence[int]) -> Iterator[Pair]:
    """Yield pairs of views the given number of steps apart, of the first target where none are given."""
    images, poses = views
    numbers = [number for number in sorted(images) if number in poses]
    for place in targets or (0,):
        for steps in offsets:
            if place + steps < len(numbers):
                target, source = numbers[place], numbers[place + steps]
                truth = true_motion(poses, target, source)
                yield Pair(group, name, steps, images[source], images[target], truth)


def _rendered(name: str) -> Views:
    recipe = load_specimen(name)
    seed = int(np.random.SeedSequence([23, recipe.seed]).generate_state(1)[0])
    sequence = RenderedSequence(staged(recipe, Condition(step_deg=STEP_DEG), frames=STEPS + 1, seed=seed))
    return rendered_views(sequence), sequence.truth()


def _recorded(name: str) -> Views:
    poses = open_sequence(SHARED / name).truth()
    assert poses is not None
    return recorded_views(name), poses
