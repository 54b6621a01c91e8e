"""One run from its plan to figures: what exit status it ends with, and whether its model is wrong."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Final, Protocol, final

import numpy as np

from modeler import se3
from modeler.composition import compose
from modeler.composition.compose import comes_back
from modeler.composition.options import MethodOptions, ObjectOptions, PriorOptions
from modeler.evaluation import TrueSurface, align_to_model, rotation_error_deg, surface_errors, true_motion
from modeler.export.report import RunMeta, report_of
from modeler.sequences import AbstractSequence
from modeler.sequences.meshes import Mesh
from modeler.types import AbstractRegistrar, Array, BoolArray, Frame, InputError, ObjectModel, Step
from studies.trust.plan import Half, Plan
from studies.trust.stage import Recorded

MAX_DEG: Final = 3.0
"""Rotation error of a pose from which on a model is called wrong."""
MAX_M: Final = 0.005
"""Error of the object's place in a pose from which on it is."""
MIN_F: Final = 0.9
"""F-score at `MAX_M` below which it is."""
_SAMPLES: Final = 20_000  # on each surface: a share of 0.9 is then known to 0.002


@final
@dataclass(frozen=True)
class Outcome:
    """What a run came to."""

    half: Half
    """Of the study."""
    number: int
    """Within the half."""
    fault: str
    """Name of its fault, or "no fault"."""
    shape: str
    """Name of the object's recipe."""
    prior: str
    """As given."""
    masks: bool
    """Whether there were any."""
    frames: int
    """Number of frames."""
    placed: int
    """Number of those in the model."""
    status: int
    """With which `modeler build` ends: 0, 2 or 3."""
    codes: tuple[str, ...]
    """Of what speaks against the model."""
    evidence: Mapping[str, tuple[float | None, float | None]]
    """Value and limit by name."""
    error_deg: float | None
    """Largest rotation error of a pose against the first; None if some have no truth or none was placed."""
    error_m: float | None
    """Largest error of the object's place, likewise."""
    f_score: float | None
    """Of the mesh against what the frames saw, at `MAX_M`; None without a mesh."""
    seconds: float
    """Wall time of the run without rendering."""

    @property
    def wrong(self) -> bool:
        """Whether the model is wrong; so is one that is not there, or holds frames of another object."""
        if self.error_deg is None or self.error_m is None or self.f_score is None:
            return True
        return self.error_deg > MAX_DEG or self.error_m > MAX_M or self.f_score < MIN_F

    def values(self) -> dict[str, Any]:
        """Return the figures as JSON holds them."""
        return {**asdict(self), "wrong": self.wrong}

    @staticmethod
    def of(values: Mapping[str, Any]) -> Outcome:
        """Return what JSON held."""
        return Outcome(**{field.name: values[field.name] for field in fields(Outcome)})


class WithTruth(Protocol):
    """What was recorded, and what is true of it."""

    def frame(self, index: int) -> Frame:
        """Return a frame as the user has it."""
        ...

    def true_frame(self, index: int) -> Frame:
        """Return it without errors, with the object's mask."""
        ...

    def truth(self) -> dict[int, Array]:
        """Return the true camera_from_model (4, 4) by frame number."""
        ...

    def model(self) -> Mesh:
        """Return the true surface."""
        ...


Look = Callable[[Plan, Recorded, Step | None], None]


def outcome(plan: Plan, look: Look = lambda plan, recorded, step: None) -> Outcome:
    """Build the model of a plan as `modeler build` does, without recording, and evaluate it.

    Args:
        plan: of the run.
        look: receives the plan, the recording, and the last step; None if the input was refused.
    """
    stage = plan.stage()
    recorded = Recorded(stage)
    count, options = len(recorded.indices), stage.options
    began = time.perf_counter()
    step, report = None, {}
    try:
        step, report = built(recorded, options, plan.seed)
    except InputError as error:
        report = {"trustworthy": False, "reason_codes": [f"refused: {error}"], "evidence": {}}
    seconds = time.perf_counter() - began
    look(plan, recorded, step)
    error_deg, error_m = (None, None) if step is None else pose_errors(recorded, step)
    return Outcome(
        half=plan.half,
        number=plan.number,
        fault=plan.fault,
        shape=recorded.name,
        prior=str(options.prior),
        masks=stage.masks,
        frames=count,
        placed=0 if step is None else len(step.solution.trajectory),
        status=2 if step is None else 0 if report["trustworthy"] else 3,
        codes=tuple(report["reason_codes"]),
        evidence={name: (figure["value"], figure["limit"]) for name, figure in report["evidence"].items()},
        error_deg=error_deg,
        error_m=error_m,
        f_score=None if step is None or step.model is None else f_score(recorded, step.model, step.solution.trajectory),
        seconds=seconds,
    )


def built(
    recorded: AbstractSequence,
    options: PriorOptions,
    seed: int,
    registrar: Callable[[AbstractRegistrar], AbstractRegistrar] = lambda method: method,
) -> tuple[Step, dict[str, Any]]:
    """Build a model as `modeler build` does, without recording, and return the last step and the report.

    Args:
        recorded: the sequence.
        options: what is known of the motion.
        seed: of the registration.
        registrar: returns what registers pairs in place of the method.

    Raises:
        InputError: if the input cannot be used.
    """
    modeler = compose.modeler(recorded, options, MethodOptions(seed=seed), ObjectOptions())
    modeler = replace(modeler, registrar=registrar(modeler.registrar))
    scene = compose.scene(modeler, recorded)
    closes = comes_back(recorded, modeler.prior, modeler.closer.max_angle_deg)
    *_, last = modeler.run(recorded, scene, closure_expected=closes)
    assert isinstance(last, Step)
    return last, report_of(last, RunMeta(recorded.name, seed, str(options.prior)))


def pose_errors(recorded: WithTruth, step: Step) -> tuple[float | None, float | None]:
    """Return the largest errors of a run's poses relative to the first: rotation in degrees, position in m.

    The position is that of a frame's surface in the object: measured with the given depth scale and intrinsics,
    compared with the true surface.

    None if a frame in the model shows another object, or none is in it.
    """
    trajectory, truth = step.solution.trajectory, recorded.truth()
    if not trajectory or any(frame not in truth for frame in trajectory):
        return None, None
    first, worst_deg, worst_m = min(trajectory), 0.0, 0.0
    said_m, true_m = {}, {}
    for frame in trajectory:
        mask = recorded.true_frame(frame).mask
        assert mask is not None
        said = _centroid_m(recorded.frame(frame), mask)
        there = _centroid_m(recorded.true_frame(frame), mask)
        estimate = se3.inverse(trajectory[first]) @ trajectory[frame]
        motion = true_motion(truth, first, frame)
        said_m[frame], true_m[frame] = (
            se3.transform(pose, point[None])[0] for pose, point in ((estimate, said), (motion, there))
        )
        worst_deg = max(worst_deg, rotation_error_deg(estimate, motion))
    for frame in trajectory:
        apart_m = (said_m[frame] - said_m[first]) - (true_m[frame] - true_m[first])
        worst_m = max(worst_m, float(np.linalg.norm(apart_m)))
    return worst_deg, worst_m


def _centroid_m(frame: Frame, mask: BoolArray) -> Array:
    """Return the mean (3,) of what a frame measured within a mask (h, w); NaN where it measured nothing."""
    w, h = frame.camera.rays()
    measured = mask & np.isfinite(frame.depth_m)
    if not measured.any():
        return np.full(3, np.nan)
    depth_m = frame.depth_m[measured].astype(np.float64)
    return np.stack([w[measured] * depth_m, h[measured] * depth_m, depth_m], axis=1).mean(axis=0)


def f_score(
    recorded: WithTruth, model: ObjectModel, trajectory: Mapping[int, Array], within_m: float = MAX_M
) -> float | None:
    """Return the F-score at a distance of a mesh against what the frames saw of the object.

    The mesh is laid on the true surface by its poses, or nearer by iterated closest points: whoever uses it has no
    frames that say where it belongs.
    """
    truth = recorded.truth()
    if not len(model.triangles) or not set(trajectory) & set(truth):
        return None
    mesh = recorded.model()
    rng = np.random.default_rng(0)
    surface = TrueSurface.of(mesh.vertices_m, mesh.triangles, rng, _SAMPLES)
    seen = surface.seen((recorded.true_frame(frame), truth[frame]) for frame in truth)
    if not seen.any():
        return None
    placed = align_to_model(trajectory, truth)
    scores = []
    for model_from_object in (placed, _nearer(placed, model.vertices_m, surface.points_m)):
        vertices_m = se3.transform(model_from_object, model.vertices_m)
        errors = surface_errors(vertices_m, model.triangles, surface, np.random.default_rng(0))
        scores.append(errors.over(seen).f_score(within_m))
    return max(scores)


def _nearer(model_from_object: Array, vertices_m: Array, points_m: Array) -> Array:
    """Return model_from_object (4, 4) after closest points within 3 cm."""
    import open3d as o3d

    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)) for points in (vertices_m, points_m)]
    icp = o3d.pipelines.registration.registration_icp(*clouds, 0.03, model_from_object)
    return np.asarray(icp.transformation)
