"""Speed and accuracy on the bundled sequences against a committed baseline: `make bench`.

Times are ratios to a fixed piece of work done in the same run, so that they carry over between machines. A number that
is worse than the baseline by more than its tolerance fails the run. `--update` writes a new baseline: do that on
purpose, on an idle machine, and say why in the commit.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import stats

from modeler import se3
from modeler.experiment import Experiment, summaries
from modeler.fusion import Fuser
from modeler.priors import TablePrior
from modeler.rays import Sensor
from modeler.registration import IcpRegistrar, VisibilityRegistrar
from modeler.segmentation import Segmenter, telling
from modeler.types import Frame
from sequences import bundled, open_sequence

BASELINE = Path(__file__).with_name("bench_baseline.json")
OBJECTS = ("box", "flashlight", "tube")
TIME_TOLERANCE = 1.5  # a busy neighbour, another processor
TRUE_MEDIAN_NEES = float(stats.chi2(6).median())
ERROR_TOLERANCE = 1.15  # the same seed gives the same errors but for the last bits of another machine's arithmetic


def measured() -> Iterator[tuple[str, float, float]]:
    """Yield the name, value and tolerance of each number; lower is better for all."""
    work_s = seconds(reference_work)
    yield from ((name, value / work_s, TIME_TOLERANCE) for name, value in steps_s())
    for name in OBJECTS:
        experiment = Experiment({"visibility": VisibilityRegistrar(), "icp": IcpRegistrar()}, TablePrior())
        rows = {row.method: row for row in summaries(experiment.trials(open_sequence(bundled(name))), 16.2)}
        ours = rows["visibility"]
        yield f"{name}: median rotation error (deg)", ours.rotation_error_deg[1], ERROR_TOLERANCE
        yield f"{name}: largest rotation error (deg)", ours.rotation_error_deg[3], ERROR_TOLERANCE
        yield f"{name}: median translation error (mm)", ours.translation_error_mm, ERROR_TOLERANCE
        yield f"{name}: |ln(median NEES / 5.35)|", abs(np.log(ours.median_nees / TRUE_MEDIAN_NEES)), ERROR_TOLERANCE
        yield f"{name}: time of a pair (work)", ours.seconds / work_s, TIME_TOLERANCE


def steps_s() -> Iterator[tuple[str, float]]:
    """Yield the seconds that the steps around registration take."""
    sequence = open_sequence(bundled("box"))
    truth, noise = sequence.truth(), sequence.sensor()
    assert truth is not None
    assert noise is not None
    frames = [replace(frame, mask=None) for frame in sequence]
    segmenter, sensor, fuser = Segmenter(), Sensor(*noise), Fuser()
    told: list[Frame] = [frames[sequence.indices.index(index)] for index in telling(sequence.indices)]
    scene = segmenter.scene(told)
    found = segmenter.segment(frames[3], scene)
    yield "learning a scene (work)", seconds(lambda: segmenter.scene(told))
    yield "segmenting a frame (work)", seconds(lambda: segmenter.segment(frames[3], scene))
    masked = replace(frames[3], mask=found.mask)
    yield "making a view (work)", seconds(lambda: sensor.ray_image(masked, found.plane))
    views = {frame.index: sensor.ray_image(frame) for frame in sequence}
    poses = {index: se3.inverse(pose) for index, pose in truth.items()}
    yield "merging 14 views (work)", seconds(lambda: fuser.preview(views, poses))
    yield "meshing 14 views (work)", seconds(lambda: fuser.fuse(views, poses))


def seconds(work: Callable[[], object], repeats: int = 3) -> float:
    """Return the shortest of some wall times, after one run to warm up."""
    work()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return min(times)


def reference_work() -> None:
    """Do what takes about a tenth of a second: sorting and gathering, as much of the package's own work is."""
    values = np.random.default_rng(0).random(500_000)
    for _ in range(2):
        np.sort(values[np.argsort(values)[::-1]])


def main() -> int:
    """Print a table and return 1 where a number is worse than the baseline allows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--update", action="store_true", help="write a new baseline")
    update = parser.parse_args().update
    baseline = json.loads(BASELINE.read_text()) if BASELINE.exists() else {}
    found, worse = {}, []
    print(f"{'':<42}{'now':>10}{'baseline':>10}{'ratio':>8}")
    for name, value, tolerance in measured():
        found[name] = float(f"{value:.4g}")
        before = baseline.get(name)
        ratio = float("nan") if not before else value / before
        if ratio > tolerance:
            worse.append(name)
        mark = f"  worse than {tolerance:g}" if ratio > tolerance else ""
        print(
            f"{name:<42}{value:>10.4g}{'-' if before is None else f'{before:.4g}':>10}{ratio:>8.2f}{mark}", flush=True
        )
    if update:
        BASELINE.write_text(json.dumps(found, indent=1) + "\n")
        return 0
    missing = baseline.keys() ^ found.keys()
    if missing:
        print(f"not in both, run again with --update: {', '.join(sorted(missing))}", file=sys.stderr)
    return 1 if worse or missing else 0


if __name__ == "__main__":
    sys.exit(main())
