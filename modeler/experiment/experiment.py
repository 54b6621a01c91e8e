"""The same pairs of frames registered by several methods with the same prior, their errors and summaries."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import NamedTuple, Protocol, TypeVar

import numpy as np

from modeler.evaluation import coverage, nees, rotation_error_deg, translation_error_m, true_motion
from modeler.pipeline import Registrations, prepare, without_limits
from modeler.segmentation import Scene, Segmenter, scene_frames
from modeler.types import (
    AbstractPoseDensity,
    AbstractPrior,
    AbstractRegistrar,
    Array,
    Edge,
    Frame,
    InputError,
    Outcome,
    Posterior,
    RayImage,
    SensorNoise,
    Solution,
    Stated,
)
from modeler.views import Sensor

_Seen = TypeVar("_Seen")
_SPARSE_STREAM = 1  # the random stream that thins frame k is [seed, k, this]; pairs draw from [seed, source, target]


class Recorded(Protocol):
    """Frames with metadata and ground truth, as provided by the readers of sequences."""

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

    def sensor(self) -> SensorNoise | None:
        """Return the noise of its camera, where it is known."""
        ...


class Pair(NamedTuple):
    """Two frames, one to be registered to the other."""

    source: int
    target: int
    offset: int
    """Frames from one to the other, in the order of the sequence."""


@dataclass(frozen=True)
class Pairing:
    """Which frames are registered with each other."""

    offsets: tuple[int, ...] = (1,)
    """How many frames source and target are apart, in the order of the sequence; each offset is a table."""
    both_ways: bool = False
    """Register each pair in both directions, not only the later frame to the earlier."""
    closed: bool = False
    """The sequence is a full turn: its last frame is followed by its first."""

    @property
    def loops(self) -> bool:
        """Whether each frame is registered to the one before it all the way round: together they should do nothing."""
        return self.closed and not self.both_ways and self.offsets == (1,)

    def pairs(self, indices: Sequence[int]) -> Iterator[Pair]:
        """Yield every pair of these frame numbers, offset by offset."""
        count = len(indices)
        for offset in self.offsets:
            for position in range(count if self.closed else count - offset):
                earlier, later = indices[position], indices[(position + offset) % count]
                if earlier != later:
                    yield Pair(later, earlier, offset)
                    if self.both_ways:
                        yield Pair(earlier, later, offset)


@dataclass(frozen=True, eq=False)
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
    """Surface points of each view that are kept, drawn at random; None = all (paper: very sparse clouds). What the
    images show of empty space stays."""
    success_deg: float = 16.2
    """Rotation error below which a registration counts as right (Jian and Vemuri 2011)."""
    learn: bool = False
    """Whether the prior learns from the pairs before, as in a build: the unknown axis of a turntable."""
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
        indices, poses = self._frames(recorded), recorded.truth()
        ready = self._viewing(recorded, indices)
        trusted: dict[str, list[Edge]] = {name: [] for name in self.methods}
        for pair, source, target in viewed(self.pairing.pairs(indices), ready):
            truth = None if poses is None else true_motion(poses, pair.target, pair.source)
            why_lost = next((view.label for view in (source, target) if isinstance(view, Outcome)), "")
            for name, method in self.methods.items():
                blank = _blank(recorded.name, name, pair, truth)
                if isinstance(source, Outcome) or isinstance(target, Outcome):
                    yield replace(blank, outcome=why_lost)
                    continue
                answer = self._registered(method, source, target, trusted[name])
                if isinstance(answer, str):
                    yield replace(blank, outcome=answer)
                    continue
                if self.learn and answer.usable:
                    lasting = answer.without_samples()
                    trusted[name].append(
                        Edge(lasting, "odometry", accepted=True, reason=Stated("the method reports success"))
                    )
                yield blank.answered(answer, truth, source.centroid_m)

    def _frames(self, recorded: Recorded) -> tuple[int, ...]:
        truth = recorded.truth()
        if truth is None and self.pairing.loops:
            return recorded.indices
        if truth is None:
            raise InputError(
                f"{recorded.name}: has no ground truth to compare with; add scene_gt.json, or judge the loop of a full "
                "turn by `closed`."
            )
        return tuple(index for index in recorded.indices if index in truth)

    def _viewing(self, recorded: Recorded, indices: Sequence[int]) -> Callable[[int], RayImage | Outcome]:
        """Return a function that prepares the view of a frame, or the reason if there is none."""
        noise = recorded.sensor()
        scene = self.segmenter.scene([recorded.frame(index) for index in scene_frames(indices)])
        sensor = Sensor(SensorNoise(sigma_r_m=None) if noise is None else noise).measured(scene.range_noise)
        return lambda index: self._view(recorded.frame(index), scene, sensor)

    def _view(self, frame: Frame, scene: Scene, sensor: Sensor) -> RayImage | Outcome:
        """Return a frame prepared for registration, as sparse as the experiment has it, or why it cannot be."""
        prepared = prepare(frame, scene, self.segmenter, sensor)
        if prepared.view is None:
            return prepared.failure
        if self.points is None:
            return prepared.view
        rng = np.random.default_rng([self.seed, frame.index, _SPARSE_STREAM])
        return sparse_view(prepared.view, self.points, rng)

    def _registered(
        self, method: AbstractRegistrar, source: RayImage, target: RayImage, trusted: Sequence[Edge]
    ) -> Posterior | str:
        """Return a method's answer, as `Modeler.register` gives it, or why the prior has none to begin with."""
        try:
            prior = self.prior.learned(Solution(), trusted) if self.learn else self.prior
            density = prior.between(source, target)
        except InputError as error:
            return str(error)

        def attempt(known: AbstractPoseDensity) -> Posterior:
            return Registrations(method, self.seed).register(source, target, known)

        within = attempt(density)
        return without_limits(within, prior, lambda unlimited: attempt(unlimited.between(source, target)))


def _blank(sequence: str, method: str, pair: Pair, truth: Array | None) -> Trial:
    """Return a trial that has not been made, with the true rotation where it is known."""
    blank = Trial(sequence, method, pair.offset, pair.source, pair.target, outcome="", usable=False)
    return blank if truth is None else replace(blank, rotation_deg=rotation_error_deg(np.eye(4), truth))


def viewed(pairs: Iterable[Pair], view: Callable[[int], _Seen]) -> Iterator[tuple[Pair, _Seen, _Seen]]:
    """Yield pairs with the views of source and target.

    A view is made when it is first asked for and let go after the last pair of the same offset that has it, so that of
    a sequence however long about as many are kept as the offset counts frames; of a closed one, twice as many.
    """
    for _, group in groupby(pairs, key=lambda pair: pair.offset):
        together = list(group)
        last = {frame: number for number, pair in enumerate(together) for frame in (pair.source, pair.target)}
        kept: dict[int, _Seen] = {}
        for number, pair in enumerate(together):
            for frame in sorted((pair.source, pair.target)):
                if frame not in kept:
                    kept[frame] = view(frame)
            yield pair, kept[pair.source], kept[pair.target]
            for frame in (pair.source, pair.target):
                if last[frame] == number:
                    del kept[frame]


def sparse_view(view: RayImage, count: int, rng: np.random.Generator) -> RayImage:
    """Return a view with at most `count` of its surface points; its images stay whole."""
    total = len(view.points_m)
    kept = np.sort(rng.permutation(total)[:count])
    layers = {name: layer[kept] if layer.shape == (total,) else layer for name, layer in view.layers.items()}
    return replace(
        view, points_m=view.points_m[kept], normals=view.normals[kept], pixels=view.pixels[kept], layers=layers
    )


@dataclass(frozen=True)
class Trial:
    """One pair registered by one method. What does not exist is NaN: a failed view has no error."""

    sequence: str
    method: str
    offset: int
    """Frames from one to the other."""
    source: int
    target: int
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
    """Squared error in units of the estimated covariance; 6 on average if that is calibrated."""
    sigma_deg: float = math.nan
    """Root mean square rotation error that the covariance predicts."""
    overlap: float = math.nan
    """Share of surface seen in both views, as the method has it."""
    seconds: float = math.nan
    """Wall time of the registration."""
    target_from_source: tuple[float, ...] = ()
    """The estimate, 16 numbers by row; empty where there is none."""

    def answered(self, posterior: Posterior, truth: Array | None, centroid_m: Array) -> Trial:
        """Return the trial with a method's answer, and its errors where the truth is known.

        Args:
            posterior: the answer.
            truth: target_from_source (4, 4).
            centroid_m: (3,) of the object in the source's camera frame, where shifts are measured.
        """
        trial = replace(
            self,
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


@dataclass(frozen=True)
class Quantiles:
    """How errors are spread; NaN where there is none."""

    lower_quartile: float
    median: float
    upper_quartile: float
    ninth_decile: float
    largest: float

    @staticmethod
    def of(values: Array) -> Quantiles:
        """Return the quantiles of numbers (n,)."""
        shares = (0.25, 0.5, 0.75, 0.9, 1.0)
        return Quantiles(*(float(np.quantile(values, share)) if len(values) else math.nan for share in shares))


@dataclass(frozen=True)
class Summary:
    """The trials of one method on one sequence at one offset. Quantiles are over those that have an error."""

    sequence: str
    method: str
    offset: int
    """Frames from one to the other."""
    pairs: int
    """Number of trials."""
    usable: int
    """How many the method stands by."""
    successes: int | None
    """How many rotation errors are below the limit of success, whether the method stands by them or not; None where
    the truth is not known."""
    rotation_error_deg: Quantiles
    """Of the angle between estimate and truth."""
    translation_error_mm: Quantiles
    """Of the distance at the object's centroid between estimate and truth."""
    nees: float
    """Mean; 6 where covariances are true."""
    median_nees: float
    """Median; 5.3 where covariances are true."""
    inside_95: float
    """Share of truths inside the region of 95 %."""
    seconds: float
    """Median."""
    loop_deg: float = math.nan
    """Rotation that is left of all steps round a closed turn; 0 where they are right. NaN where that was not asked."""
    turned_deg: float = math.nan
    """Rotation of those steps one by one, summed up: 360 where a steady turn was followed, much less where steps stuck,
    much more where some were flipped."""


def summaries(trials: Iterable[Trial], success_deg: float, *, loops: bool = False) -> list[Summary]:
    """Return a row for each sequence, offset and method, in the order in which they appear."""
    groups: dict[tuple[str, int, str], list[Trial]] = {}
    for trial in trials:
        groups.setdefault((trial.sequence, trial.offset, trial.method), []).append(trial)
    return [_summary(members, success_deg, loops) for members in groups.values()]


def _summary(trials: Sequence[Trial], success_deg: float, loops: bool) -> Summary:
    rotation_deg, squares = _known(t.rotation_error_deg for t in trials), _known(t.nees for t in trials)
    loop_deg, turned_deg = _once_round(trials) if loops else (math.nan, math.nan)
    return Summary(
        sequence=trials[0].sequence,
        method=trials[0].method,
        offset=trials[0].offset,
        pairs=len(trials),
        usable=sum(trial.usable for trial in trials),
        successes=None if math.isnan(trials[0].rotation_deg) else int(np.sum(rotation_deg < success_deg)),
        rotation_error_deg=Quantiles.of(rotation_deg),
        translation_error_mm=Quantiles.of(_known(t.translation_error_mm for t in trials)),
        nees=float(np.mean(squares)) if len(squares) else math.nan,
        median_nees=Quantiles.of(squares).median,
        inside_95=coverage(squares)[0.95],
        seconds=Quantiles.of(_known(t.seconds for t in trials)).median,
        loop_deg=loop_deg,
        turned_deg=turned_deg,
    )


def _known(values: Iterable[float]) -> Array:
    """Return those of some numbers that exist."""
    return np.array([value for value in values if math.isfinite(value)])


def _once_round(trials: Sequence[Trial]) -> tuple[float, float]:
    """Return by how many degrees all steps turn, together and one by one; NaN where a step is missing."""
    if not all(trial.target_from_source for trial in trials):
        return math.nan, math.nan
    steps = [np.array(trial.target_from_source).reshape(4, 4) for trial in trials]
    left = functools.reduce(np.matmul, steps)
    return rotation_error_deg(left, np.eye(4)), sum(rotation_error_deg(step, np.eye(4)) for step in steps)
