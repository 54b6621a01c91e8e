"""The pairs of views of the study: rendered ones under known truth, the dragon's scans, and recordings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Final, final

import numpy as np

from modeler.evaluation import true_motion
from modeler.priors import GeneralPrior, TablePrior
from modeler.segmentation import Segmenter, scene_frames
from modeler.sequences import open_sequence
from modeler.sequences.rendering import RenderedSequence
from modeler.types import AbstractPoseDensity, Array, Outcome, RayImage
from modeler.views import Sensor
from studies.calibration.specimens import SPECIMENS, load_specimen
from studies.calibration.study import CONDITIONS, Condition, rendered_views, staged

SHARED: Final = Path(__file__).resolve().parents[3] / "shared" / "data"
RECORDINGS: Final = {"cap": "table", "kleenex": "table", "bear": "general", "dragon": "general"}
"""Recordings with known poses, and the prior of their steps."""
ORDINARY: Final = ("0", "1", "2", "3")
"""Blocks of pairs such as runs have: shapes of the calibration study, scans of the dragon, steps of recordings."""
BLOCKS: Final = (*ORDINARY, "hard")
"""All blocks; the pairs of the last have little surface in common."""
_SHAPES, _HARD_SHAPES = 20, 18  # rendered pairs of a block
_PRIORS: Final = {"general": GeneralPrior(), "table": TablePrior()}
_OF_HARD: Final = GeneralPrior(max_rotation_deg=95.0, max_offset_m=0.08)
_OF_DRAGON: Final = GeneralPrior(max_rotation_deg=110.0, max_offset_m=0.09)


@final
@dataclass(frozen=True, eq=False)
class Case:
    """One pair of views with one prior."""

    group: str
    """`shapes`, `hard`, `far` (the dragon) or `recordings`."""
    name: str
    """Shape or recording."""
    symmetry: str
    """Of the shape; empty for the others."""
    prior: str
    source: RayImage
    target: RayImage
    density: AbstractPoseDensity
    """What the prior says."""
    truth: Array
    """(4, 4) target_from_source."""
    seed: int

    @property
    def key(self) -> str:
        """Return what names the case."""
        return f"{self.group}/{self.name}/{self.source.index}-{self.target.index}/{self.prior}"


def cases(block: str) -> Iterator[Case]:
    """Yield the cases of a block whose true motion the prior allows; recordings if available."""
    return (case for case in _cases(block) if np.isfinite(case.density.log_density(case.truth[None])[0]))


def _cases(block: str) -> Iterator[Case]:
    recorded = SHARED.exists()
    if block == "hard":
        yield from _hard()
        yield from _far(0, (4,), every=2) if recorded else ()
        return
    number, every = ORDINARY.index(block), len(ORDINARY)
    yield from _shapes(number)
    if recorded:
        yield from _far(number, (1, 2, 3), every=every)
        for name in RECORDINGS:
            yield from _steps(name, number, every=every)


def _shapes(block: int) -> Iterator[Case]:
    """Yield pairs of tuning shapes, as many of each symmetry, none in two blocks."""
    rng = np.random.default_rng(18)
    by_symmetry: dict[str, list[str]] = {}
    for specimen in SPECIMENS:
        if specimen.half == "tuning":
            by_symmetry.setdefault(specimen.symmetry, []).append(specimen.recipe)
    each = _SHAPES // len(by_symmetry)
    for symmetry, names in by_symmetry.items():
        order = rng.permutation(len(names))
        conditions = np.resize(rng.permutation(len(CONDITIONS)), len(names))
        for place in range(block * each, (block + 1) * each):
            name, number = names[order[place]], int(conditions[place])
            seed = int(np.random.SeedSequence([18, load_specimen(name).seed, number]).generate_state(1)[0])
            source, target, truth = _rendered(name, CONDITIONS[number], seed)
            for prior_name, prior in _PRIORS.items():
                density = prior.between(source, target)
                yield Case("shapes", name, symmetry, prior_name, source, target, density, truth, seed)


def _hard() -> Iterator[Case]:
    """Yield pairs of shapes without symmetry, turned so far that little surface is seen twice, under a wide prior."""
    rng = np.random.default_rng(19)
    names = [specimen.recipe for specimen in SPECIMENS if specimen.half == "tuning" and "symm" in specimen.symmetry]
    for place, chosen in enumerate(rng.choice(len(names), _HARD_SHAPES, replace=False)):
        name, step_deg = names[chosen], (45.0, 60.0, 75.0)[place % 3]
        seed = int(np.random.SeedSequence([19, load_specimen(name).seed]).generate_state(1)[0])
        source, target, truth = _rendered(name, Condition(step_deg=step_deg), seed)
        density = _OF_HARD.between(source, target)
        yield Case("hard", f"{name} {step_deg:g}°", "asymmetric", "general", source, target, density, truth, seed)


def _rendered(name: str, condition: Condition, seed: int) -> tuple[RayImage, RayImage, Array]:
    """Return the two views of a rendered pair, the later first, and the true motion."""
    sequence = RenderedSequence(staged(load_specimen(name), condition, frames=2, seed=seed))
    views, (earlier, later) = rendered_views(sequence), sequence.indices
    return views[later], views[earlier], true_motion(sequence.truth(), earlier, later)


def _far(first: int, offsets: Sequence[int], *, every: int) -> Iterator[Case]:
    """Yield pairs of the dragon's scans the given number of steps of 24° apart, under a wide prior."""
    views, poses = recorded_views("dragon"), open_sequence(SHARED / "dragon").truth()
    assert poses is not None
    numbers = sorted(views)
    for offset in offsets:
        for position in range(first, len(numbers), every):
            source, target = numbers[position], numbers[(position + offset) % len(numbers)]
            density = _OF_DRAGON.between(views[source], views[target])
            truth, name = true_motion(poses, target, source), f"dragon {24 * offset}°"
            yield Case("far", name, "", "general", views[source], views[target], density, truth, position)


def _steps(name: str, first: int, *, every: int) -> Iterator[Case]:
    """Yield pairs of neighbouring frames of a recording."""
    views, poses = recorded_views(name), open_sequence(SHARED / name).truth()
    assert poses is not None
    known, prior = [index for index in views if index in poses], _PRIORS[RECORDINGS[name]]
    for target, source in list(pairwise(known))[first::every]:
        density, truth = prior.between(views[source], views[target]), true_motion(poses, target, source)
        yield Case("recordings", name, "", RECORDINGS[name], views[source], views[target], density, truth, source)


def recorded_views(name: str) -> dict[int, RayImage]:
    """Return the views of a recording, by frame number; without those in which no object was found."""
    sequence, segmenter, views = open_sequence(SHARED / name), Segmenter(), {}
    noise = sequence.sensor()
    scene = segmenter.scene([sequence.frame(index) for index in scene_frames(sequence.indices)])
    sensor = (Sensor() if noise is None else Sensor(noise)).measured(scene.range_noise)
    for index in sequence.indices:
        found = segmenter.segment(sequence.frame(index), scene)
        if found.outcome in (Outcome.CONVERGED, Outcome.UNSURE_MASK):
            views[index] = sensor.ray_image(replace(sequence.frame(index), mask=found.mask), found.plane)
    return views
