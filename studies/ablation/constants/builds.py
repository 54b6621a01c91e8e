"""The stage of registration, graph and closures: whole builds, whose pairs are registered once for equal priors."""

from __future__ import annotations

import numpy as np

from modeler import se3
from modeler.evaluation import rotation_error_deg, true_motion
from modeler.fusion import Fuser
from modeler.pipeline import Modeler
from modeler.priors import AutoPrior, TurntablePrior
from modeler.registration import VisibilityRegistrar
from modeler.types import NOMINAL_FOCAL, SensorNoise, Solution, Step
from modeler.views import Sensor
from studies.ablation.constants.inputs import Figures, Footage, Recalling, digest


def poses(footage: Footage) -> Figures:
    """Build with the masks given and a coarse model; pairs that are registered already are looked up."""
    last = run(footage)
    figures = _figures(last, footage)
    figures["digest"] = digest(
        [(frame, pose, last.solution.covariances[frame]) for frame, pose in sorted(last.solution.trajectory.items())]
    ).hex()[:12]
    return figures


def run(footage: Footage) -> Step:
    """Return the last step of a build."""
    modeler = Modeler(
        sensor=Sensor() if footage.is_focal_exact else Sensor(SensorNoise(sigma_focal=NOMINAL_FOCAL)),
        prior=AutoPrior() if footage.step_deg is None else TurntablePrior(footage.step_deg, axis_sigma_deg=30.0),
        registrar=Recalling(VisibilityRegistrar()),
        fuser=Fuser(max_voxels=24**3),
    )
    last = None
    for event in modeler.run(footage.masked, modeler.segmenter.scene(footage.masked)):
        last = event if isinstance(event, Step) else last
    assert last is not None
    return last


def _figures(last: Step, footage: Footage) -> Figures:
    solution: Solution = last.solution
    edges = last.edges_so_far
    figures: Figures = {
        "placed": float(len(solution.trajectory)),
        "edges": float(len(edges)),
        "taking_part": float(sum(solution.takes_part(edge) for edge in edges)),
        "focal": 0.0 if solution.focal is None else solution.focal.log_factor,
    }
    sigmas = [np.sqrt(np.trace(solution.covariances[frame][:3, :3])) for frame in solution.trajectory]
    figures["sigma_deg"] = float(np.degrees(np.median(sigmas)))
    truth = footage.truth
    if truth is not None:
        frames = [frame for frame in sorted(solution.trajectory) if frame in truth]
        first = frames[0]
        errors = [
            rotation_error_deg(
                se3.inverse(solution.trajectory[first]) @ solution.trajectory[frame],
                true_motion(truth, first, frame),
            )
            for frame in frames[1:]
        ]
        figures["error_deg"] = float(np.mean(errors)) if errors else 0.0
    return figures
