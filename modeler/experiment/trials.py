"""One pair of frames registered by one method, how far that is from the truth, and many of them summed up."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, final

import numpy as np

from modeler.evaluation import coverage, nees, rotation_error_deg, translation_error_m
from modeler.types import Array, Posterior


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


class Quantiles(NamedTuple):
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


@final
@dataclass(frozen=True)
class Summary:
    """The trials of one method on one sequence at one offset. Quantiles are over those that have an error."""

    sequence: str
    """Name of the sequence."""
    method: str
    """Name of the method."""
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
    """Return a row for each sequence, offset and method, in the order in which they appear.

    Args:
        trials: to summarise.
        success_deg: rotation error below which one counts as right.
        loops: whether the trials of a row are the steps round a closed turn, in order.
    """
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
