"""The same pairs of frames registered by several methods, with the same prior, beside the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np

from modeler.evaluation import rotation_error_deg, true_motion
from modeler.experiment.pairing import Pair, Pairing
from modeler.experiment.recorded import Recorded
from modeler.experiment.sparse import sparse_frame, sparse_view
from modeler.experiment.trials import Trial
from modeler.experiment.viewed import viewed
from modeler.rays import Sensor
from modeler.segmentation import Scene, Segmenter, telling
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
    Stated,
)

_SPARSE_STREAM = 1  # the random stream that thins frame k is [seed, k, this]; pairs draw from [seed, source, target]


@final
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
                "turn by --closed."
            )
        return tuple(index for index in recorded.indices if index in truth)

    def _viewing(self, recorded: Recorded, indices: Sequence[int]) -> Callable[[int], RayImage | Outcome]:
        """Return what makes the view of a frame, or tells why there is none."""
        noise = recorded.sensor()
        sensor = Sensor() if noise is None else Sensor(*noise)
        scene = self.segmenter.scene([recorded.frame(index) for index in telling(indices)])
        return lambda index: self._view(recorded.frame(index), scene, sensor)

    def _view(self, frame: Frame, scene: Scene, sensor: Sensor) -> RayImage | Outcome:
        """Return a frame made ready, as sparse as the experiment has it, or why it cannot be."""
        found = self.segmenter.segment(frame, scene)
        if found.outcome not in (Outcome.CONVERGED, Outcome.UNSURE_MASK):
            return found.outcome
        frame = replace(frame, mask=found.mask)
        rng = np.random.default_rng([self.seed, frame.index, _SPARSE_STREAM])
        if self.pixels is not None:
            frame = sparse_frame(frame, self.pixels, rng)
        view = sensor.ray_image(frame, found.plane)
        if self.points is not None:
            view = sparse_view(view, self.points, rng)
        return view if len(view.points_m) else Outcome.TOO_FEW_POINTS

    def _registered(
        self, method: AbstractRegistrar, source: RayImage, target: RayImage, trusted: Sequence[Edge]
    ) -> Posterior | str:
        """Return a method's answer, or why the prior has none to begin with.

        Args:
            method: what registers them.
            source: a view.
            target: the view that it is registered to.
            trusted: the answers before that the method stands by, for a prior that learns.
        """
        try:
            prior = self.prior.learned(Solution(), trusted) if self.learn else self.prior
            density = prior.between(source, target)
        except InputError as error:
            return str(error)
        rng = np.random.default_rng([self.seed, source.index, target.index])
        return method.register(source, target, density, rng=rng)


def _blank(sequence: str, method: str, pair: Pair, truth: Array | None) -> Trial:
    """Return a trial that has not been made, with the true rotation where it is known."""
    blank = Trial(sequence, method, pair.offset, pair.source, pair.target, outcome="", usable=False)
    return blank if truth is None else replace(blank, rotation_deg=rotation_error_deg(np.eye(4), truth))
