"""What a GPU is worth: `make bench-gpu`, or `python -m studies bench.gpu`, on a machine with the extra `gpu`.

Each row is the median of some runs after one that warms up, preparation and transfers both ways included, beside the
kernels of Numba on two threads of the same machine.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
import time
from collections.abc import Callable
from functools import partial
from statistics import median

import numba
import numpy as np

from modeler.kernels import gpu, scores
from modeler.kernels.gpu.memory import forget
from modeler.registration import PaperRegistrar, VisibilityLikelihood, VisibilityRegistrar
from modeler.se3 import rows
from modeler.sequences import bundled, open_sequence
from modeler.types import RayImage
from modeler.views import Sensor
from studies.bench import speed

CORES = 2
GOAL_SAMPLES_S, GOAL_PAIRS = 0.1, 50.0
"""Of 10⁸ samples of the general prior, in s; and of a batch of pairs, relative to two cores."""
Timed = Callable[[Callable[[], object]], float]
STARTS, STRIDE = 6000, 8
"""Poses that the search scores first, and the share of points by which: by far its largest call."""


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m studies bench.gpu", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--device", choices=["cuda", "warp-cpu"], default="cuda", help="warp-cpu: to test this program")
    parser.add_argument("--samples", type=int, default=100_000_000, help="of the general prior")
    parser.add_argument("--pairs", type=int, default=1000, help="in one batch")
    parser.add_argument("--runs", type=int, default=3, help="of which the median counts")
    asked = parser.parse_args()
    if asked.device == "cuda" and (fault := gpu.missing()) is not None:
        print(f"bench-gpu: {fault}", file=sys.stderr)
        return 2
    numba.set_num_threads(min(CORES, numba.get_num_threads()))
    wp = gpu.warp()
    print(f"{wp.get_device(gpu.chosen(asked.device, 1)).name}, Warp {wp.__version__}; {CORES} threads of the CPU")
    views = _views(speed.SEQUENCES[0], math.isqrt(asked.pairs) + 2)
    timed = partial(_seconds, asked.runs)
    _samples(asked.device, asked.samples, views, timed)
    _pairs(asked.device, asked.pairs, views, timed)
    _one_pair(asked.device, views, timed)
    return 0


def _samples(device: gpu.Device, samples: int, views: list[RayImage], timed: Timed) -> None:
    """Print what the paper's brute force takes for samples of the general prior, one pair from images to posterior."""
    density = speed.PRIORS["general"].between(views[1], views[0])

    def registered(registrar: PaperRegistrar) -> Callable[[], object]:
        return lambda: registrar.register(views[1], views[0], density, rng=np.random.default_rng(0))

    there_s = timed(registered(PaperRegistrar(samples, device=device)))
    few = min(samples, 10_000_000)
    cpu_s = timed(registered(PaperRegistrar(few, device="cpu"))) * samples / few
    goal = f"; goal {GOAL_SAMPLES_S} s for 100,000,000"
    print(f"{samples:,} samples of the general prior: {there_s:.3f} s, CPU {cpu_s:.3f} s (by its rate){goal}")


def _pairs(device: gpu.Device, count: int, views: list[RayImage], timed: Timed) -> None:
    """Print what scoring the prior's samples of many pairs of a sequence takes, its views sent anew."""
    from modeler.kernels.gpu import visibility

    pairs, poses = [], []
    for number, (source, target) in zip(range(count), itertools.cycle(itertools.permutations(views, 2)), strict=False):
        rng = np.random.default_rng(number)
        pair = VisibilityLikelihood().between(source, target, rng)
        forward, backward = pair.forward, pair.backward
        blur_m = 0.24 * pair.size_m  # as the search begins
        parameters = forward.parameters(blur_m), backward.parameters(blur_m)
        pairs.append((forward.projection(STRIDE), backward.projection(STRIDE), *parameters))
        poses.append(rows(speed.PRIORS["general"].between(source, target).sample(STARTS, rng)))
    every, numbers = np.concatenate(poses), np.repeat(np.arange(count, dtype=np.int32), STARTS)
    found: dict[str, np.ndarray] = {}

    def there() -> None:
        forget()
        found["there"] = visibility.log_likelihoods(every, numbers, pairs, gpu.chosen(device, 1) or "")

    def here() -> None:
        each = zip(poses, pairs, strict=True)
        found["here"] = np.concatenate([scores.scores(some, *pair) for some, pair in each])

    there_s, cpu_s = timed(there), timed(here)
    lookups = sum(STARTS * (pair[0].points.shape[1] + pair[1].points.shape[1]) for pair in pairs)
    tolerance = 1e-4 * lookups / STARTS / count
    same = np.mean(np.abs(found["there"] - found["here"][:, :2])[:, scores.LOG_LIKELIHOOD] < tolerance)
    print(
        f"{count:,} pairs of {STARTS:,} poses, {lookups / 1e6:.0f} M look-ups: {there_s:.3f} s, CPU {cpu_s:.3f} s, "
        f"{cpu_s / there_s:.1f} times; goal {GOAL_PAIRS:.0f} times; {100 * same:.2f} % alike"
    )


def _one_pair(device: gpu.Device, views: list[RayImage], timed: Timed) -> None:
    """Print what one pair takes by the default method, which descends and refines on the CPU."""
    for name, prior in speed.PRIORS.items():
        taken = []
        for where in (device, "cpu"):
            registrar = VisibilityRegistrar(VisibilityLikelihood(device=where))
            density = prior.between(views[1], views[0])
            taken.append(
                timed(
                    lambda registrar=registrar, density=density: registrar.register(
                        views[1], views[0], density, rng=np.random.default_rng(0)
                    )
                )
            )
        print(f"one pair by visibility, {name} prior: {taken[0]:.3f} s, CPU {taken[1]:.3f} s")


def _views(name: str, most: int) -> list[RayImage]:
    """Return the first views, at most so many, of a bundled sequence, prepared."""
    sequence = open_sequence(bundled(name))
    sensor = Sensor(*(sequence.sensor() or ()))
    return [sensor.ray_image(frame, plane) for frame, plane in speed.segmented(sequence, most)]


def _seconds(runs: int, work: Callable[[], object]) -> float:
    """Return the median time of some work in s, after one run that warms up."""
    taken = []
    for _ in range(runs + 1):
        began = time.perf_counter()
        work()
        taken.append(time.perf_counter() - began)
    return median(taken[1:])


if __name__ == "__main__":
    sys.exit(main())
