"""The same pairs of frames registered by several methods, and how far each is from the truth."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, final

import numpy as np

from modeler.evaluation import nees, rotation_error_deg, translation_error_m, true_motion
from modeler.experiment.pairing import Pairing
from modeler.rays import Sensor
from modeler.segmentation import Segmenter, telling
from modeler.types import (
    AbstractPrior,
    AbstractRegistrar,
    Array,
    Edge,
    Frame,
    InputError,
    Outcome,
    Posterior,
    RayImage,
    Solution,
)

_SPARSE_STREAM = 1  # the random stream that thins frame k is [seed, k, this]; pairs draw from [seed, source, target]


class Recorded(Protocol):
    """What an experiment needs of a sequence."""

    @property
    def name(self) -> str:
        """What the sequence is called."""
        ...

    @property
    def indices(self) -> tuple[int, ...]:
        """Frame numbers, ascending."""
        ...

    def frame(self, index: int) -> Frame:
        """Return a frame by its number."""
        ...

    def truth(self) -> Mapping[int, Array] | None:
        """Return the true camera_from_model (4, 4) by frame number, where it is known."""
        ...

    def sensor(self) -> tuple[float, float] | None:
        """Return the sensor's noise `(sigma_wh, sigma_r_m)`, where it is known."""
        ...


@final
@dataclass(frozen=True)
class Trial:
    """One pair registered by one method. What does not exist is NaN: a failed view has no error."""

    sequence: str
    """Name of the sequence."""
    method: str
    """Name of the method."""
    offset: int
    """Frames from one to the other."""
    source: int
    """Frame number of the source."""
    target: int
    """Frame number of the target."""
    outcome: str
    """How the registration ended, or why there was none."""
    usable: bool
    """Whether the method stands by its answer."""
    rotation_deg: float = math.nan
    """True rotation between the frames, where it is known."""
    rotation_error_deg: float = math.nan
    """Angle between estimate and truth."""
    translation_error_mm: float = math.nan
    """Distance at the object's centroid between estimate and truth."""
    nees: float = math.nan
    """Squared error in units of the covariance stated; 6 on average where that is true."""
    sigma_deg: float = math.nan
    """Root mean square rotation error that the covariance predicts."""
    overlap: float = math.nan
    """Share of surface seen in both views, as the method has it."""
    seconds: float = math.nan
    """Wall time of the registration."""
    target_from_source: tuple[float, ...] = ()
    """The estimate, 16 numbers by row; empty where there is none."""


@final
@dataclass(frozen=True)
class Experiment:
    """Registers the same pairs by several methods."""

    methods: Mapping[str, AbstractRegistrar]
    """By name."""
    prior: AbstractPrior
    """What is known of the motions before the images are compared."""
    pairing: Pairing = field(default_factory=Pairing)
    """Which frames."""
    segmenter: Segmenter = field(default_factory=Segmenter)
    """Finds the object in frames without masks."""
    points: int | None = None
    """Surface points of each view that are kept, drawn at random; None = all (paper: very sparse clouds).

    What the images show of empty space stays.
    """
    pixels: int | None = None
    """Object pixels of each frame whose depth is kept, drawn at random; None = all. The mask stays."""
    success_deg: float = 16.2
    """Rotation error below which a registration counts as right (Jian and Vemuri 2011)."""
    learn: bool = False
    """Whether the prior learns from the pairs before, as in a build: the axis of a turntable that nobody tells."""
    seed: int = 0
    """Each pair draws from a generator of its own, made from this and the two frame numbers, as in `register`."""

    def size(self, recorded: Recorded) -> int:
        """Return the number of trials on a sequence.

        Raises:
            InputError: where its truth is not known and it is no closed turn either.
        """
        return len(self.methods) * len(list(self.pairing.pairs(self._frames(recorded))))

    def trials(self, recorded: Recorded) -> Iterator[Trial]:
        """Yield what each method makes of each pair.

        Raises:
            InputError: where the truth of the motions is not known and they are no closed turn either, or a frame
                cannot be read.
        """
        indices = self._frames(recorded)
        truth = recorded.truth()
        views = dict(self._views(recorded, indices))
        known: dict[str, list[Edge]] = {name: [] for name in self.methods}
        for source, target, offset in self.pairing.pairs(indices):
            motion = None if truth is None else true_motion(truth, target, source)
            for name, method in self.methods.items():
                blank = Trial(recorded.name, name, offset, source, target, outcome="", usable=False)
                yield self._trial(method, views[source], views[target], blank=blank, truth=motion, known=known[name])

    def _frames(self, recorded: Recorded) -> tuple[int, ...]:
        truth = recorded.truth()
        if truth is None and self.pairing.loops:
            return recorded.indices
        if truth is None:
            raise InputError(
                f"{recorded.name}: has no ground truth to compare with; add scene_gt.json, or judge the loop of a full "
                "turn by --closed."
            )
        return tuple(index for index in recorded.indices if index in truth)

    def _views(self, recorded: Recorded, indices: Sequence[int]) -> Iterator[tuple[int, RayImage | Outcome]]:
        """Yield the views by frame number, or why there is none."""
        noise = recorded.sensor()
        sensor = Sensor() if noise is None else Sensor(*noise)
        scene = self.segmenter.scene([recorded.frame(index) for index in telling(indices)])
        for index in indices:
            frame = recorded.frame(index)
            found = self.segmenter.segment(frame, scene)
            if found.outcome not in (Outcome.CONVERGED, Outcome.UNSURE_MASK):
                yield index, found.outcome
                continue
            frame = replace(frame, mask=found.mask)
            rng = np.random.default_rng([self.seed, index, _SPARSE_STREAM])
            if self.pixels is not None:
                frame = sparse_frame(frame, self.pixels, rng)
            view = sensor.ray_image(frame, found.plane)
            yield index, view if self.points is None else sparse_view(view, self.points, rng)

    def _trial(
        self,
        method: AbstractRegistrar,
        source: RayImage | Outcome,
        target: RayImage | Outcome,
        *,
        blank: Trial,
        truth: Array | None,
        known: list[Edge],
    ) -> Trial:
        if truth is not None:
            blank = replace(blank, rotation_deg=rotation_error_deg(np.eye(4), truth))
        for view in (source, target):
            if isinstance(view, Outcome):
                return replace(blank, outcome=view.label)
            if not len(view.points_m):
                return replace(blank, outcome=Outcome.TOO_FEW_POINTS.label)
        assert isinstance(source, RayImage)
        assert isinstance(target, RayImage)
        try:
            prior = self.prior.learned(Solution(), known) if self.learn else self.prior
            motion = prior.between(source, target)
        except InputError as error:
            return replace(blank, outcome=str(error))
        rng = np.random.default_rng([self.seed, source.index, target.index])
        posterior = method.register(source, target, motion, rng=rng)
        if posterior.usable:
            known.append(Edge(posterior, "odometry", accepted=True, reason="the method stands by it"))
        return _judged(blank, posterior, truth, source.centroid_m)


def _judged(blank: Trial, posterior: Posterior, truth: Array | None, centroid_m: Array) -> Trial:
    trial = replace(
        blank,
        outcome=posterior.outcome.label,
        usable=posterior.usable,
        sigma_deg=float(np.degrees(np.sqrt(np.trace(posterior.pose.covariance[:3, :3])))),
        overlap=posterior.overlap,
        seconds=posterior.seconds,
        target_from_source=tuple(posterior.pose.mean.ravel().tolist()),
    )
    if truth is None:
        return trial
    return replace(
        trial,
        rotation_error_deg=rotation_error_deg(posterior.pose.mean, truth),
        translation_error_mm=1e3 * translation_error_m(posterior.pose.mean, truth, centroid_m),
        nees=nees(posterior.pose, truth),
    )


def sparse_frame(frame: Frame, count: int, rng: np.random.Generator) -> Frame:
    """Return a frame whose mask keeps the depth of at most `count` of its pixels; the others have no measurement.

    Args:
        frame: with its mask.
        count: pixels to keep.
        rng: chooses them.
    """
    assert frame.mask is not None
    measured = np.flatnonzero(frame.mask & np.isfinite(frame.depth_m))
    dropped = rng.permutation(measured)[count:]
    depth_m = frame.depth_m.copy()
    depth_m.flat[dropped] = np.nan
    return replace(frame, depth_m=depth_m)


def sparse_view(view: RayImage, count: int, rng: np.random.Generator) -> RayImage:
    """Return a view with at most `count` of its surface points; its images stay whole.

    Args:
        view: a frame made ready.
        count: points to keep.
        rng: chooses them.
    """
    total = len(view.points_m)
    kept = np.sort(rng.permutation(total)[:count])
    layers = {name: layer[kept] if layer.shape == (total,) else layer for name, layer in view.layers.items()}
    return replace(
        view, points_m=view.points_m[kept], normals=view.normals[kept], pixels=view.pixels[kept], layers=layers
    )
