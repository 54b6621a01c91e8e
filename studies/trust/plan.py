"""The runs of the study: shape, motion, given metadata and fault, drawn from half and number alone."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from typing import Final, Literal, final

import numpy as np

from modeler.composition.options import PriorOptions
from modeler.priors.table import WOBBLE_DEG, WOBBLE_M
from modeler.sequences.rendering.cameras import DepthSensor
from modeler.sequences.rendering.recipe import Places, Recipe, Tabletop, Turntable
from studies.calibration.specimens import SPECIMENS, Symmetry, load_specimen
from studies.trust.faults import FAULTS, Fault
from studies.trust.stage import WIDTH_PX, Stage, posed

Half = Literal["tuning", "held-out"]
HALVES: Final[tuple[Half, ...]] = ("tuning", "held-out")
SOUND: Final = "no fault"
"""Of a run without a fault."""
SHIFT_M: Final = 0.02
"""Mean shift of an object that is pushed: half of the least limit of a prior."""


def shapes(half: Half, *symmetries: Symmetry) -> tuple[str, ...]:
    """Return the names of the shapes of a half: even and odd checksums of the names."""
    return tuple(
        specimen.recipe
        for specimen in SPECIMENS
        if specimen.symmetry in symmetries and zlib.crc32(specimen.recipe.encode()) % 2 == HALVES.index(half)
    )


@final
@dataclass(frozen=True)
class Plan:
    """One run."""

    half: Half
    """Whether limits may be settled on it."""
    number: int
    """Within its half: even numbers have no fault."""

    @property
    def fault(self) -> str:
        """Name of the fault, or `SOUND`."""
        return SOUND if self._fault is None else self._fault.name

    @property
    def _fault(self) -> Fault | None:
        return FAULTS[self.number // 2 % len(FAULTS)] if self.number % 2 else None

    @property
    def seed(self) -> int:
        """Of motion, noise and registration."""
        return int(np.random.SeedSequence([HALVES.index(self.half), self.number]).generate_state(1)[0])

    def stage(self) -> Stage:
        """Return the recording and its metadata."""
        rng, fault = np.random.default_rng(self.seed), self._fault
        symmetries = ("asymmetric", "n-fold") if fault is None else fault.symmetries
        name, other = rng.choice(shapes(self.half, *symmetries), 2, replace=False)
        stage = sound(viewed(load_specimen(str(name)), rng, self.seed), rng)
        if fault is None:
            return stage
        return fault.put(stage, viewed(load_specimen(str(other)), rng, self.seed), rng)


def viewed(recipe: Recipe, rng: np.random.Generator, seed: int) -> Recipe:
    """Return a recipe turned at random and seen by a small camera from a random height and distance."""
    x_deg, y_deg, z_deg = recipe.rest_rotation_deg
    share = WIDTH_PX / recipe.view.width
    view = replace(
        recipe.view,
        width=WIDTH_PX,
        height=WIDTH_PX * 3 // 4,
        focal_px=share * recipe.view.focal_px,
        distance_m=float(rng.uniform(0.6, 0.75)),
        elevation_deg=float(rng.uniform(25.0, 45.0)),
    )
    return replace(
        recipe,
        seed=seed,
        rest_rotation_deg=(x_deg, y_deg, z_deg + float(rng.uniform(0.0, 360.0))),
        view=view,
        sensor=coarser(recipe.sensor, share),
        colour="none",
        pattern=None,
        masks=True,
    )


def coarser(sensor: DepthSensor | None, share: float) -> DepthSensor | None:
    """Return a sensor whose errors in m and rad are the same where images have fewer pixels."""
    if sensor is None or sensor.disparity is None or sensor.jitter is None:
        return sensor
    disparity, jitter = sensor.disparity, sensor.jitter
    return replace(
        sensor,
        disparity=replace(disparity, sigma_px=share * disparity.sigma_px, quantum_px=share * disparity.quantum_px),
        jitter=replace(jitter, sigma_px=share * jitter.sigma_px),
    )


def sound(recipe: Recipe, rng: np.random.Generator) -> Stage:
    """Return a stage without fault: a full turn by hand or turntable in two of three, else a part of one."""
    frames, step_deg = ((13, 30.0), (17, 22.5), (8, 22.0))[int(rng.integers(3))]
    prior = str(rng.choice(["table", "table", "general", "turntable"]))
    masks = bool(rng.integers(2))
    if prior == "turntable":
        offset_m = tuple(float(x) for x in rng.uniform(-0.02, 0.02, 2))
        trajectory = Turntable(
            frames, step_deg, 0.5, (offset_m[0], offset_m[1]), wobble_deg=WOBBLE_DEG, wobble_m=WOBBLE_M
        )
        options = PriorOptions(prior=prior, step_deg=step_deg, step_sigma_deg=1.0)
    else:
        trajectory = Tabletop(frames, step_deg, shift_m=SHIFT_M, wobble_deg=WOBBLE_DEG, wobble_m=WOBBLE_M)
        options = PriorOptions(prior=prior)
    places = posed(trajectory, int(rng.integers(2**31)))
    return Stage(replace(recipe, trajectory=Places(tuple(places))), options, masks)
