"""The stage of views and registration: pairs of successive frames, by the masks given."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from modeler.evaluation import nees, rotation_error_deg, true_motion
from modeler.pipeline import Modeler
from modeler.priors import AutoPrior
from modeler.types import NOMINAL_FOCAL, Array, Posterior, SensorNoise
from modeler.views import Sensor
from studies.ablation.constants.inputs import Figures, Footage, digest

_MOST_NEES = 10.0  # of a pair: one far off is to count as an error, not to outweigh the others


def pairs(footages: Sequence[Footage]) -> Figures:
    """Register each frame against the next: usable results, and errors, sd and NEES/3 of their rotations."""
    results = [result for footage in footages for result in _registered(footage)]
    usable = [(found, truth) for found, truth in results if found.usable]
    errors_deg = [rotation_error_deg(found.pose.mean, truth) for found, truth in usable]
    sigmas_deg = [np.degrees(np.sqrt(np.trace(found.pose.covariance[:3, :3]))) for found, _ in usable]
    return {
        "usable": float(len(usable)),
        "error_deg": float(np.median(errors_deg)),
        "largest_deg": float(np.max(errors_deg)),
        "sigma_deg": float(np.median(sigmas_deg)),
        "nees": float(
            np.mean([min(nees(found.pose, truth, slice(0, 3)) / 3.0, _MOST_NEES) for found, truth in usable])
        ),
        "digest": digest([(one.outcome.name, one.pose.mean, one.pose.covariance) for one, _ in results]).hex()[:12],
    }


def _registered(footage: Footage) -> Iterator[tuple[Posterior, Array]]:
    """Yield the posterior of each frame and the next, and the true target_from_source (4, 4)."""
    modeler = Modeler(
        sensor=Sensor() if footage.is_focal_exact else Sensor(SensorNoise(sigma_focal=NOMINAL_FOCAL)),
        prior=AutoPrior(),
    )
    scene = modeler.segmenter.scene(footage.masked)
    views = [modeler.prepare(frame, scene).view for frame in footage.masked]
    assert footage.truth is not None
    for source, target in pairwise(view for view in views if view is not None):
        yield (
            modeler.register(source, target, modeler.prior),
            true_motion(footage.truth, target.index, source.index),
        )
