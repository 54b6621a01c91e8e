"""Where the likelihood is high, found by climbing it from all over the prior."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.kernels import mixture
from modeler.registration.pair import PairLikelihood
from modeler.types import AbstractPoseDensity, Array


@dataclass(frozen=True)
class Stage:
    """How places are looked at on one stage of the way up."""

    blur: float
    """Of the surfaces, as a share of the object's size."""
    stride: int
    """Every so manieth point counts."""
    climbers: int
    """At most so many go on from here."""

    def thinned(self, share: float) -> Stage:
        """Return the stage with a share (0..1) of the climbers."""
        return replace(self, climbers=int(np.ceil(share * self.climbers)))


@dataclass(frozen=True)
class Climb:
    """Climbers set out from many places, and the lower ones are left behind while the surfaces become sharper.

    Descent to matching surface leads to where most of it matches. Where two views have little of it in common,
    what either saw to be empty says more, and the truth has next to no surface to be led by. So each climber tries
    steps in all directions and takes the best, if it leads up (Rechenberg's (1 + λ) strategy). Steps are drawn as wide
    as matching surface leaves each direction open, so that climbers go along a contact rather than into it. They become
    longer where they lead up, and shorter where none does.
    """

    looks: int = 10_000
    """Motions drawn from the prior."""
    first: Stage = Stage(0.25, 8, 1000)
    """How they are looked at."""
    stages: tuple[Stage, ...] = (Stage(0.12, 8, 500), Stage(0.06, 4, 150), Stage(0.03, 2, 60), Stage(0.015, 2, 40))
    """The way up."""
    apart: float = 0.4
    """Of climbers nearer to each other than so many standard deviations of a basin, the highest goes on."""
    rounds: int = 10
    """Steps of each climber on each stage."""
    tries: int = 6
    """Steps tried for each that is taken."""
    local_points: float = 40.0
    """Number of independent measurements that all points are worth when they tell how wide steps are drawn."""
    step: float = 0.7
    """Length of the first steps, in standard deviations of each direction."""
    growth: float = 1.2
    """Of steps, after one that led up."""
    decay: float = 0.8
    """Of steps, after none did."""

    def thinned(self, share: float) -> Climb:
        """Return a climb with a share (0..1) of the looks and the climbers, for a prior that leaves less to look at."""
        return replace(
            self,
            looks=int(np.ceil(share * self.looks)),
            first=self.first.thinned(share),
            stages=tuple(stage.thinned(share) for stage in self.stages),
        )

    def places(
        self,
        pair: PairLikelihood,
        density: AbstractPoseDensity,
        basin: Array,
        rng: np.random.Generator,
        *,
        effective_points: float,
    ) -> Array:
        """Return high places (n, 4, 4) that are possible, the highest first.

        Args:
            pair: the two views.
            density: where to climb.
            basin: (6,) standard deviations of the basin of a place, beyond which no step is drawn.
            rng: source of all randomness.
            effective_points: most independent measurements that all points are worth, see `PairLikelihood.independent`.
        """
        poses, stage = density.sample(self.looks, rng), self.first
        height = partial(_height, pair, density, effective_points)
        for following in self.stages:
            poses = self._ahead(pair, poses, height(stage, poses), basin, stage.climbers)
            stage = following
            poses = self._up(pair, poses, self._spreads(pair, poses, basin, stage.blur), partial(height, stage), rng)
        return self._ahead(pair, poses, height(stage, poses), basin, stage.climbers)

    def onward(
        self,
        pair: PairLikelihood,
        density: AbstractPoseDensity,
        poses: Array,
        basin: Array,
        rng: np.random.Generator,
        *,
        effective_points: float,
    ) -> Array:
        """Return where climbers arrive that set out from places (n, 4, 4) already found; as `places`."""
        stage = self.stages[-1]
        height = partial(_height, pair, density, effective_points, stage)
        return self._up(pair, poses, self._spreads(pair, poses, basin, stage.blur), height, rng)

    def _ahead(self, pair: PairLikelihood, poses: Array, heights: Array, basin: Array, most: int) -> Array:
        """Return the highest of poses (n, 4, 4), one of each neighbourhood."""
        ordered = poses[np.argsort(-heights, kind="stable")]
        return ordered[mixture.uncrowded(se3.rows(ordered), self.apart * basin, pair.centre_m, 1, most)]

    def _spreads(self, pair: PairLikelihood, poses: Array, basin: Array, blur: float) -> Array:
        """Return roots (n, 6, 6) of the covariances of ξ about the centre that matching surface leaves poses."""
        _, matrices = pair.normal_equations(poses, blur * pair.size_m, stride=2)
        held = self.local_points / pair.points * matrices + np.diag(basin**-2.0)
        return np.asarray(np.linalg.cholesky(np.linalg.inv(held)), dtype=np.float64)

    def _up(
        self,
        pair: PairLikelihood,
        poses: Array,
        spreads: Array,
        height: Callable[[Array], Array],
        rng: np.random.Generator,
    ) -> Array:
        """Return where climbers from poses (n, 4, 4) arrive."""
        count, poses, heights = len(poses), poses.copy(), height(poses)
        step, everyone = np.full(count, self.step), np.arange(count)
        for _ in range(self.rounds):
            draws = rng.normal(size=(count, self.tries, 6, 1)) * step[:, None, None, None]
            xi = (spreads[:, None] @ draws).reshape(-1, 6)
            tried = se3.moved(np.repeat(poses, self.tries, axis=0), xi, pair.centre_m)
            reached = height(tried).reshape(count, self.tries)
            best = np.argmax(reached, axis=1)
            higher: npt.NDArray[np.bool_] = reached[everyone, best] > heights
            poses[higher] = tried.reshape(count, self.tries, 4, 4)[everyone, best][higher]
            heights = np.maximum(heights, reached[everyone, best])
            step *= np.where(higher, self.growth, self.decay)
        return poses


def _height(
    pair: PairLikelihood, density: AbstractPoseDensity, effective_points: float, stage: Stage, poses: Array
) -> Array:
    """Return how high (n,) poses (n, 4, 4) lie (nats); -inf where motion is known not to lead."""
    heights, possible = np.full(len(poses), -np.inf), np.isfinite(density.log_evidence(poses))
    if possible.any():
        heights[possible] = pair.tempered(
            poses[possible], stage.blur * pair.size_m, effective_points=effective_points, stride=stage.stride
        )
    return heights
