"""How far the log marginal likelihoods of wrong registrations lie below those of a run's edges (eq. 9.5).

    python -m studies ablation.evidence [--data FOLDER] [CAPTURE...]

Registers the neighbours of captures with known poses, which give the median, and pairs half a turn or a third of one
apart without limits, most of which find a wrong pose. Prints, for each capture, the largest drop below the median of
right registrations, and the drops of wrong ones that overlap enough to be accepted.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from modeler.closure.consistency import Thresholds
from modeler.evaluation import rotation_error_deg, true_motion
from modeler.pipeline import Modeler
from modeler.priors import AnyMotion, AutoPrior
from modeler.segmentation import scene_frames
from modeler.sequences import open_sequence

_RIGHT_DEG: Final = 5.0
_WRONG_DEG: Final = 15.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the drops of some captures."""
    parser = argparse.ArgumentParser(
        prog="ablation.evidence", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("captures", nargs="*", default=("cap", "kleenex", "dragon", "bear"), metavar="CAPTURE")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), help="captures with known poses")
    options = parser.parse_args(arguments)
    print("| capture | edges | median, nats | scatter | largest drop of right ones | drops of wrong ones |")
    print("|---|---|---|---|---|---|")
    for name in options.captures:
        print(row(options.data / name), flush=True)
    return 0


def row(folder: Path) -> str:
    """Return the row of a capture."""
    sequence, modeler = open_sequence(folder), Modeler(prior=AutoPrior())
    poses = sequence.truth()
    assert poses is not None
    frames = [sequence.frame(index) for index in sequence.indices]
    scene = modeler.segmenter.scene([sequence.frame(index) for index in scene_frames(sequence.indices)])
    modeler = replace(modeler, sensor=modeler.sensor.measured(scene.range_noise))
    prepared = [modeler.prepare(frame, scene).view for frame in frames if frame.index in poses]
    views = [view for view in prepared if view is not None]
    apart = [(views[k], views[(k + len(views) // part) % len(views)]) for part in (2, 3) for k in range(len(views))]
    right, wrong = [], []
    for prior, pairs in ((None, [(one, other) for one, other in pairwise(views)]), (AnyMotion(), apart[::2])):
        for target, source in pairs:
            found = modeler.register(source, target, prior)
            error_deg = rotation_error_deg(found.pose.mean, true_motion(poses, target.index, source.index))
            acceptable = found.usable and found.overlap >= Thresholds.min_overlap
            if prior is None and acceptable and error_deg < _RIGHT_DEG:
                right.append(found.log_marginal_likelihood)
            elif prior is not None and acceptable and error_deg > _WRONG_DEG:
                wrong.append(found.log_marginal_likelihood)
    median = float(np.median(right))
    scatter = 1.4826 * float(np.median(np.abs(np.array(right) - median)))
    drops = " ".join(f"{median - nats:.0f}" for nats in sorted(wrong, reverse=True))
    return f"| {sequence.name} | {len(right)} | {median:.0f} | {scatter:.0f} | {median - min(right):.0f} | {drops} |"


if __name__ == "__main__":
    sys.exit(main())
