"""One case from its frames to figures."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from modeler import se3
from modeler.closure import Closer
from modeler.evaluation import nees, trajectory_errors, true_motion
from modeler.fusion import Fuser
from modeler.graph import PoseGraph, solve
from modeler.pipeline import Modeler
from modeler.priors import GeneralPrior, TablePrior
from modeler.registration import VisibilityRegistrar
from modeler.segmentation import Segmenter, scene_frames
from modeler.types import Array, Edge, PoseGaussian, Solution, Step
from modeler.views import Sensor
from studies.loops.cases import Case
from studies.loops.known import Known
from studies.loops.lies import Lying

_PAGE_BYTES = 4096


@dataclass(frozen=True)
class Result:
    """What a case came to.

    Before = with the edges alone that placed the frames: the chain of neighbours in time, what bridges a gap, and where
    nothing does, what found the frames after it again. After = with every accepted edge.
    """

    name: str
    frames: int
    joined: int
    registrations: int
    closures: int
    """Accepted edges that close a loop."""
    spanning: int
    """Accepted edges beyond the chain that do not."""
    rejected: int
    before_deg: float | None
    """Largest rotation error over the trajectory, where the truth is known."""
    after_deg: float | None
    before_mm: float | None
    """Largest translation error at the object."""
    after_mm: float | None
    nees_before: float | None
    """NEES of the poses but the first, an average a degree of freedom: 1 where covariances are true."""
    nees_after: float | None
    turned_deg: float
    """Rotation summed over the chain."""
    residual_before_deg: float | None
    """Median angle between accepted closures and what the poses say."""
    residual_after_deg: float | None
    seconds: float
    """Processor time."""
    peak_mib: float

    def values(self) -> dict[str, object]:
        """Return the figures as JSON holds them."""
        return asdict(self)


def modeler(case: Case, closer: Closer, seed: int, *, true_motions: bool = False, lies: float = 0.0) -> Modeler:
    """Return the loop for a case; its model is coarse, as it is not used."""
    noise = case.sequence.sensor()
    truth = case.truth() if true_motions else None
    registrar = VisibilityRegistrar() if truth is None else Known(truth)
    return Modeler(
        segmenter=Segmenter(),
        sensor=Sensor() if noise is None else Sensor(noise),
        prior=TablePrior() if case.prior == "table" else GeneralPrior(),
        registrar=Lying(registrar, lies) if lies else registrar,
        closer=closer,
        fuser=Fuser(voxel_m=0.01),
        seed=seed,
    )


def run(maker: Modeler, case: Case, report: Callable[[Step, float, float], None]) -> Result:
    """Build a case and return its figures; `report` receives each step, its processor time and memory."""
    indices = case.sequence.indices
    scene = maker.segmenter.scene([case.sequence.frame(index) for index in scene_frames(indices)])
    began = time.process_time()
    before, peak_mib, registrations, step = began, 0.0, 0, None
    for event in maker.run(case.frames(), scene):
        if not isinstance(event, Step):
            continue
        step, now = event, time.process_time()
        peak_mib = max(peak_mib, memory_mib())
        registrations += len(step.posteriors)
        report(step, now - before, memory_mib())
        before = now
    assert step is not None
    return _figures(case, replace(step, make_model=lambda: None), registrations, time.process_time() - began, peak_mib)


def _figures(case: Case, step: Step, registrations: int, seconds: float, peak_mib: float) -> Result:
    solution, placed, truth = step.solution, _placed(step), case.truth()
    taking_part = [edge for edge in step.edges_so_far if edge.accepted and edge not in step.solution.outliers]
    loops = [edge for edge in taking_part if edge.kind == "closure"]
    errors: list[float | None] = [None] * 6
    if truth is not None and solution.trajectory and all(frame in truth for frame in solution.trajectory):
        centroid_m = step.views[min(solution.trajectory)].centroid_m
        chain, whole = (trajectory_errors(s.trajectory, truth, centroid_m) for s in (placed, solution))
        errors = [
            chain.max_rotation_deg,
            whole.max_rotation_deg,
            1e3 * chain.max_translation_m,
            1e3 * whole.max_translation_m,
            mean_nees(placed, truth),
            mean_nees(solution, truth),
        ]
    measured = {(edge.target, edge.source): edge.posterior.pose.mean for edge in loops}
    return Result(
        name=case.name,
        frames=len(case.sequence.indices),
        joined=len(solution.trajectory),
        registrations=registrations,
        closures=len(loops),
        spanning=max(len(taking_part) - len(loops) - (len(solution.trajectory) - 1), 0),
        rejected=len(step.edges_so_far) - len(taking_part),
        before_deg=errors[0],
        after_deg=errors[1],
        before_mm=errors[2],
        after_mm=errors[3],
        nees_before=errors[4],
        nees_after=errors[5],
        turned_deg=_turned_deg(placed.trajectory),
        residual_before_deg=_residual_deg(measured, placed.trajectory),
        residual_after_deg=_residual_deg(measured, solution.trajectory),
        seconds=seconds,
        peak_mib=peak_mib,
    )


def _placed(step: Step) -> Solution:
    """Return the solution of the edges alone that placed the frames."""
    placed: dict[int, Edge] = {}
    for edge in step.edges_so_far:
        if edge.accepted:
            placed.setdefault(edge.source, edge)
    first = next(iter(step.solution.trajectory))
    return solve(PoseGraph(tuple(placed.values()), first=first), {})


def mean_nees(solution: Solution, truth: Mapping[int, Array]) -> float | None:
    """Return the mean NEES of the poses relative to the first, a degree of freedom."""
    first, *others = solution.trajectory
    values = [
        nees(PoseGaussian(solution.trajectory[k], solution.covariances[k]), true_motion(truth, first, k))
        for k in others
    ]
    return float(np.mean(values)) / 6.0 if values else None


def _turned_deg(trajectory: Mapping[int, Array]) -> float:
    """Return the rotation summed over the frames, one after the other."""
    poses = [trajectory[frame] for frame in sorted(trajectory)]
    steps = [se3.inverse(one) @ other for one, other in itertools.pairwise(poses)]
    return float(np.degrees(sum(float(se3.rotation_angle(step)) for step in steps)))


def _residual_deg(measured: Mapping[tuple[int, int], Array], poses: Mapping[int, Array]) -> float | None:
    if not measured:
        return None
    apart = [se3.inverse(se3.inverse(poses[t]) @ poses[s]) @ motion for (t, s), motion in measured.items()]
    return float(np.median(np.degrees(se3.rotation_angle(np.stack(apart)))))


def memory_mib() -> float:
    """Return the memory that this process holds."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * _PAGE_BYTES / 2**20
