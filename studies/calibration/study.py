"""Rendered pairs under several conditions, each registered with every prior by every method, against the truth."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np

from modeler import se3
from modeler.baselines import IcpRegistrar
from modeler.evaluation import about_point, nees, rotation_error_deg, translation_error_m, true_motion
from modeler.priors import GeneralPrior, TablePrior
from modeler.priors.table import WOBBLE_DEG, WOBBLE_M
from modeler.registration import VisibilityLikelihood, VisibilityRegistrar
from modeler.segmentation import Segmenter, scene_frames
from modeler.sequences.rendering import RenderedSequence
from modeler.sequences.rendering.recipe import Recipe, Tabletop, Turntable
from modeler.types import AbstractPrior, AbstractRegistrar, Array, Posterior, RayImage
from modeler.views import Sensor
from studies.calibration.specimens import FRAMES, SPECIMENS, Half, Specimen, Symmetry, load_specimen

OURS, CONTROL = "visibility", "icp"

MEASURES: Mapping[str, slice] = {
    "pose": slice(0, 6),
    "rotation": slice(0, 3),
    "translation": slice(3, 6),
    **{axis: slice(k, k + 1) for k, axis in enumerate(("rx", "ry", "rz", "tx", "ty", "tz"))},
}
"""What of ξ is judged: turns about, and shifts along, the axes of the source camera at the object's centroid."""


@final
@dataclass(frozen=True)
class Condition:
    """How the shapes are seen."""

    distance_m: float = 0.8
    """Distance of the camera."""
    noise: float = 1.0
    """Disparity noise and steps and lateral jitter, as multiples of the first Kinect's."""
    step_deg: float = 25.0
    """Mean turn from frame to frame."""
    shift_px: float = 0.0
    """Standard deviation of the shift of a frame's colours against its depth."""

    def __str__(self) -> str:
        """Return it in words."""
        shifted = f", colours {self.shift_px:g} px" if self.shift_px else ""
        return f"{self.distance_m:g} m, noise x{self.noise:g}, {self.step_deg:g} deg{shifted}"


CONDITIONS = (
    Condition(),
    Condition(distance_m=0.6),
    Condition(distance_m=1.1),
    Condition(noise=0.5),
    Condition(noise=2.0),
    Condition(step_deg=12.0),
    Condition(step_deg=40.0),
)
SHIFTED = tuple(replace(condition, shift_px=0.35) for condition in CONDITIONS)
"""The same with colours that are not aligned: as far, from frame to frame, as those of cameras."""


@final
@dataclass(frozen=True)
class Trial:
    """One pair with one prior by one method."""

    half: Half
    symmetry: Symmetry
    shape: str
    condition: str
    prior: str
    method: str
    source: int
    target: int
    outcome: str
    """How the registration ended; "outside the prior" where the true motion has no density and none was made."""
    usable: bool = False
    """Whether the method stands by its answer; only such answers are judged."""
    rotation_error_deg: float = float("nan")
    translation_error_mm: float = float("nan")
    """At the object's centroid."""
    sigma_deg: float = float("nan")
    """Root mean square rotation error that the covariance predicts."""
    nees: Mapping[str, float] = field(default_factory=dict)
    """By name of the measure."""


OUTSIDE = "outside the prior"


def staged(recipe: Recipe, condition: Condition, *, frames: int, seed: int) -> Recipe:
    """Return a recipe under a condition, the object turned to where the seed has it, with noise of its own.

    Only what is lit by lamps has colour.
    """
    rng = np.random.default_rng(seed)
    x_deg, y_deg, z_deg = recipe.rest_rotation_deg
    trajectory, sensor = recipe.trajectory, recipe.sensor
    assert isinstance(trajectory, Tabletop | Turntable)
    assert sensor is not None
    assert sensor.disparity is not None
    assert sensor.jitter is not None
    noise = condition.noise
    disparity = replace(
        sensor.disparity, sigma_px=noise * sensor.disparity.sigma_px, quantum_px=noise * sensor.disparity.quantum_px
    )
    jitter = replace(sensor.jitter, sigma_px=noise * sensor.jitter.sigma_px)
    # The table prior takes no table for plane. On one that is, tilt and lift come out too wide for no fault of the
    # posterior's: its prior has to describe the world it is judged in.
    wobble = replace(trajectory, wobble_deg=WOBBLE_DEG, wobble_m=WOBBLE_M)
    return replace(
        recipe,
        seed=seed,
        rest_rotation_deg=(x_deg, y_deg, z_deg + rng.uniform(0.0, 360.0)),
        view=replace(recipe.view, distance_m=condition.distance_m),
        trajectory=replace(wobble, frames=frames, step_deg=condition.step_deg),
        sensor=replace(sensor, disparity=disparity, jitter=jitter),
        colour="none" if recipe.photography is None else "png",
        photography=None if recipe.photography is None else replace(recipe.photography, shift_px=condition.shift_px),
    )


@final
@dataclass(frozen=True)
class Study:
    """Every shape under every condition: neighbouring frames, the later registered to the earlier."""

    specimens: tuple[Specimen, ...] = SPECIMENS
    """The shapes."""
    conditions: tuple[Condition, ...] = CONDITIONS
    """How each is seen."""
    frames: int = FRAMES
    """Frames of each shape under each condition: one more than pairs."""
    seed: int = 0
    """Of poses, noise and registration."""
    priors: Mapping[str, AbstractPrior] = field(
        default_factory=lambda: {"general": GeneralPrior(), "table": TablePrior()}
    )
    """By name."""
    methods: Mapping[str, AbstractRegistrar] = field(
        default_factory=lambda: {OURS: VisibilityRegistrar(VisibilityLikelihood(colour=True)), CONTROL: IcpRegistrar()}
    )
    """By name: the one under test, and the negative control with its residual-scaled Hessian."""
    blind: bool = False
    """Whether colour is left out."""

    @property
    def pairs(self) -> int:
        """Number of pairs rendered."""
        return len(self.conditions) * len(self.specimens) * (self.frames - 1)

    def trials(self, specimen: Specimen) -> Iterator[Trial]:
        """Yield what every method makes of every pair of a shape with every prior."""
        recipe = load_specimen(specimen.recipe)
        for number, condition in enumerate(self.conditions):
            seed = int(np.random.SeedSequence([self.seed, recipe.seed, number]).generate_state(1)[0])
            under = staged(recipe, condition, frames=self.frames, seed=seed)
            sequence = RenderedSequence(replace(under, colour="none") if self.blind else under)
            views, truth = rendered_views(sequence), sequence.truth()
            for source, target in zip(sequence.indices[1:], sequence.indices[:-1], strict=True):
                motion = true_motion(truth, target, source)
                yield from self._pair(specimen, condition, (views[source], views[target]), motion, seed)

    def _pair(
        self, specimen: Specimen, condition: Condition, views: tuple[RayImage, RayImage], truth: Array, seed: int
    ) -> Iterator[Trial]:
        source, target = views
        for prior_name, prior in self.priors.items():
            density = prior.between(source, target)
            possible = bool(np.isfinite(density.log_density(truth[None])[0]))
            for method_name, method in self.methods.items():
                blank = Trial(
                    half=specimen.half,
                    symmetry=specimen.symmetry,
                    shape=specimen.recipe,
                    condition=str(condition),
                    prior=prior_name,
                    method=method_name,
                    source=source.index,
                    target=target.index,
                    outcome=OUTSIDE,
                )
                if possible:
                    rng = np.random.default_rng([seed, source.index, target.index])
                    posterior = method.register(source, target, density, rng=rng)
                    yield judged(blank, posterior, truth, source.centroid_m)
                else:
                    yield blank


def rendered_views(sequence: RenderedSequence) -> dict[int, RayImage]:
    """Return the views of a sequence, masked by the truth, by frame number."""
    segmenter = Segmenter()
    frames = {index: sequence.frame(index) for index in sequence.indices}
    scene = segmenter.scene([frames[index] for index in scene_frames(sequence.indices)])
    # By two frames, so that what is made of a pair does not depend on how many there are.
    sensor = Sensor(sequence.sensor()).measured(segmenter.scene([frames[k] for k in sequence.indices[:2]]).range_noise)
    return {index: sensor.ray_image(frame, segmenter.segment(frame, scene).plane) for index, frame in frames.items()}


def judged(blank: Trial, posterior: Posterior, truth: Array, centroid_m: Array) -> Trial:
    """Return a trial with its errors: in all six, and by axis about the object's centroid."""
    estimate, there = about_point(posterior.pose, centroid_m), truth @ se3.translation(centroid_m)
    return replace(
        blank,
        outcome=posterior.outcome.label,
        usable=posterior.usable,
        rotation_error_deg=rotation_error_deg(posterior.pose.mean, truth),
        translation_error_mm=1e3 * translation_error_m(posterior.pose.mean, truth, centroid_m),
        sigma_deg=float(np.degrees(np.sqrt(np.trace(estimate.covariance[:3, :3])))),
        nees={name: nees(estimate, there, components) for name, components in MEASURES.items()},
    )
