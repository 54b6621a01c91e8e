"""Times of registration, ours and Open3D's, pair by pair on the same frames."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from unittest.mock import patch

import numba
import numpy as np

from modeler.baselines import PaperRegistrar
from modeler.evaluation import rotation_error_deg, true_motion
from modeler.kernels import scores
from modeler.kernels.point_likelihood import Projection
from modeler.priors import GeneralPrior, TablePrior
from modeler.registration import VisibilityLikelihood, VisibilityRegistrar
from modeler.segmentation import Segmenter, scene_frames
from modeler.sequences import AbstractSequence, bundled, open_sequence
from modeler.types import AbstractPrior, Array, Frame, Plane, RayImage, SensorNoise
from modeler.views import Sensor
from studies.bench import reference

SEQUENCES = ("box", "flashlight", "tube")
PRIORS: dict[str, AbstractPrior] = {"general": GeneralPrior(), "table": TablePrior()}
PAPER_SAMPLES = 1e8
PAPER_SHORTEST_S = 2.0  # a shorter run says too little of the rate


@dataclass(frozen=True)
class Timing:
    """One pair by one method."""

    sequence: str
    source: int
    method: str
    seconds: float
    """Preparation of the new frame and registration."""
    preparation_s: float
    error_deg: float
    effective_samples: float = float("nan")
    evaluations: int = 0
    """Points looked up under a pose."""
    kernel_s: float = 0.0
    """Time in the likelihood's kernel, in a run of its own."""
    counted_s: float = 0.0
    """Time of that run."""


@dataclass(frozen=True, eq=False)
class Method:
    """How a frame is made ready, and two ready frames registered."""

    prepare: Callable[[Frame, Plane | None], object]
    register: Callable[[object, object], tuple[Array, float]]


def methods(sensor: Sensor) -> dict[str, Method]:
    """Return our method with either prior, and Open3D's."""

    def ours(prior: AbstractPrior, *, colour: bool = False) -> Method:
        registrar = VisibilityRegistrar(VisibilityLikelihood(colour=colour))

        def register(source: object, target: object) -> tuple[Array, float]:
            assert isinstance(source, RayImage)
            assert isinstance(target, RayImage)
            rng = np.random.default_rng([0, source.index, target.index])
            found = registrar.register(source, target, prior.between(source, target), rng=rng)
            return found.pose.mean, found.effective_samples

        return Method(sensor.ray_image, register)

    return {
        **{f"visibility {name}": ours(prior) for name, prior in PRIORS.items()},
        "visibility table, colour": ours(PRIORS["table"], colour=True),
        "Open3D ICP": Method(
            lambda frame, _: reference.icp_view(frame),
            lambda source, target: (reference.icp(source, target), float("nan")),  # pyright: ignore[reportArgumentType]
        ),
        "Open3D FPFH+RANSAC+ICP": Method(
            lambda frame, _: reference.feature_view(frame),
            lambda source, target: (reference.fpfh_icp(source, target), float("nan")),  # pyright: ignore[reportArgumentType]
        ),
    }


def timings(pairs: int | None) -> Iterator[Timing]:
    """Yield the times of every method on consecutive frames: methods alternate within a pair, in turning order.

    Args:
        pairs: at most so many a sequence, spread over it; None = all.
    """
    for name in SEQUENCES:
        sequence = open_sequence(bundled(name))
        frames, sensor = segmented(sequence), Sensor(sequence.sensor() or SensorNoise())
        truth = sequence.truth()
        assert truth is not None
        table = methods(sensor)
        order, ready = list(table), dict[tuple[str, int], object]()
        steps = np.arange(len(frames) - 1)
        if pairs is not None and pairs < len(steps):
            steps = steps[np.linspace(0, len(steps) - 1, pairs).round().astype(int)]
        for turn, step in enumerate([steps[0], *steps]):  # the first pair twice: once to warm up
            (target, target_plane), (source, source_plane) = frames[step], frames[step + 1]
            motion = true_motion(truth, target.index, source.index)
            for method in order[turn % len(order) :] + order[: turn % len(order)]:
                way = table[method]
                known = ready.get((method, target.index))
                of_target = way.prepare(target, target_plane) if known is None else known
                began = time.perf_counter()
                of_source = way.prepare(source, source_plane)
                prepared = time.perf_counter()
                pose, effective = way.register(of_source, of_target)
                ended = time.perf_counter()
                ready[method, source.index] = of_source  # the next pair's target
                if turn == 0:
                    continue
                timing = Timing(
                    name,
                    source.index,
                    method,
                    ended - began,
                    prepared - began,
                    rotation_error_deg(pose, motion),
                    effective,
                )
                if method.startswith("visibility") and turn == 1:
                    counts = _counted(lambda way=way, pair=(of_source, of_target): way.register(*pair))
                    timing = replace(timing, evaluations=counts[0], kernel_s=counts[1], counted_s=counts[2])
                yield timing


def paper_seconds() -> float:
    """Return the seconds that the paper's brute force takes for 10⁸ samples of the general prior, by its rate."""
    sequence = open_sequence(bundled("box"))
    frames, sensor = segmented(sequence), Sensor(sequence.sensor() or SensorNoise())
    source, target = (sensor.ray_image(*frames[k]) for k in (1, 0))
    density = PRIORS["general"].between(source, target)
    samples = 100_000
    PaperRegistrar(samples=1000).register(source, target, density, rng=np.random.default_rng(0))
    while True:
        began = time.perf_counter()
        PaperRegistrar(samples=samples).register(source, target, density, rng=np.random.default_rng(0))
        taken = time.perf_counter() - began
        if taken > PAPER_SHORTEST_S or samples >= PAPER_SAMPLES:
            return taken / samples * PAPER_SAMPLES
        samples = min(4 * samples, int(PAPER_SAMPLES))


def cores() -> int:
    """Return the threads that kernels use."""
    return numba.get_num_threads()


def segmented(sequence: AbstractSequence, most: int | None = None) -> list[tuple[Frame, Plane | None]]:
    """Return all or the first frames with masks, and the support plane in each: neither is part of what is timed."""
    segmenter = Segmenter()
    frames = [sequence.frame(index) for index in sequence.indices[:most]]
    scene = segmenter.scene([sequence.frame(index) for index in scene_frames(sequence.indices)])
    found = [segmenter.segment(frame, scene) for frame in frames]
    return [(replace(frame, mask=look.mask), look.plane) for frame, look in zip(frames, found, strict=True)]


def _counted(work: Callable[[], object]) -> tuple[int, float, float]:
    """Return how many points some work looks up in the visibility kernel, the time spent there, and in all."""
    kernel = scores.scores
    count, spent_s = 0, 0.0

    def counting(poses: Array, forward: Projection, backward: Projection, *others: object) -> Array:
        nonlocal count, spent_s
        began = time.perf_counter()
        result = kernel(poses, forward, backward, *others)
        spent_s += time.perf_counter() - began
        count += len(poses) * (forward.points.shape[1] + backward.points.shape[1])
        return result

    with patch.object(scores, "scores", counting):
        began = time.perf_counter()
        work()
        return count, spent_s, time.perf_counter() - began
