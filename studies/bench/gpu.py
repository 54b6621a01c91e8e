"""What a GPU is worth: `make bench-gpu`, or `python -m studies bench.gpu`, on a machine with the extra `gpu`.

Each row is the median of some runs after one that warms up, preparation and transfers both ways included, beside the
kernels of Numba on two threads of the same machine.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from functools import partial
from statistics import median

import numba
import numpy as np

from modeler.baselines import PaperRegistrar
from modeler.kernels import gpu
from modeler.sequences import bundled, open_sequence
from modeler.types import RayImage, SensorNoise
from modeler.views import Sensor
from studies.bench import speed

CORES = 2
GOAL_SAMPLES_S = 0.1
"""Of 10⁸ samples of the general prior, in s."""
Timed = Callable[[Callable[[], object]], float]


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m studies bench.gpu", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--device", choices=["cuda", "warp-cpu"], default="cuda", help="warp-cpu: to test this program")
    parser.add_argument("--samples", type=int, default=100_000_000, help="of the general prior")
    parser.add_argument("--runs", type=int, default=3, help="of which the median counts")
    asked = parser.parse_args()
    if asked.device == "cuda" and (fault := gpu.missing()) is not None:
        print(f"bench-gpu: {fault}", file=sys.stderr)
        return 2
    numba.set_num_threads(min(CORES, numba.get_num_threads()))
    wp = gpu.warp()
    print(f"{wp.get_device(gpu.chosen(asked.device, 1)).name}, Warp {wp.__version__}; {CORES} threads of the CPU")
    views = _views(speed.SEQUENCES[0], 2)
    timed = partial(_seconds, asked.runs)
    _samples(asked.device, asked.samples, views, timed)
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


def _views(name: str, most: int) -> list[RayImage]:
    """Return the first views, at most so many, of a bundled sequence, prepared."""
    sequence = open_sequence(bundled(name))
    sensor = Sensor(sequence.sensor() or SensorNoise())
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
