"""`report.json`: inputs, results and trustworthiness of a run."""

from __future__ import annotations

import math
import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields
from importlib import metadata
from typing import Any

import numpy as np

from modeler import se3
from modeler.types import (
    Array,
    ColourAlignment,
    Edge,
    FrameRecord,
    OptimisationOutlier,
    PoseGaussian,
    Posterior,
    RayImage,
    Solution,
    Step,
    explain,
    loop_closure_error,
    loops_closed,
)
from modeler.verdict import judged
from modeler.verdict.spreads import total_depth_scale_sigma

_PACKAGES = ("modeler", "gtsam", "numba", "numpy", "open3d", "scipy")
_FREE_RAD = np.radians(8.0)  # twice this is the usual step between views: whether there was one, the edge does not say
_OF_FRAME = tuple(entry.name for entry in fields(FrameRecord))  # `asdict` would take as long as all else
_ALIKE = np.cos(np.radians(25.0))  # nearer than this, a direction goes by the name of another


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        with suppress(metadata.PackageNotFoundError):  # modelling does without Open3D
            found[name] = metadata.version(name)
    return found


@dataclass(frozen=True)
class RunMeta:
    """Contents of a report besides the results."""

    sequence: str
    """Name or path of the sequence."""
    seed: int
    """Seed of every random number."""
    prior: str
    """Name of the prior."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Every other option that the results depend on, as JSON values."""
    camera: Mapping[str, float | str] | None = None
    """Estimate of the camera, as in report.json: `focal_factor`, `focal_factor_sigma`, `depth_scale`,
    `depth_scale_sigma` and `told_by`; None: the given one is exact."""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Wall time in s by part of the program."""
    digests: Mapping[int, str] = field(default_factory=dict)
    """Of the images and the camera of each frame, by its number; empty where they are not known beforehand."""
    scene_frames: Sequence[int] = ()
    """Numbers of the frames that the scene was learned from."""
    versions: Mapping[str, str] = field(default_factory=_versions)
    """Version by package."""
    advice: Callable[[Mapping[str, Any]], Sequence[str]] = lambda _: ()
    """From a report to what to do about a model that cannot be trusted, in words."""


def report_of(step: Step, meta: RunMeta) -> dict[str, Any]:
    """Return the report after a step, in values that JSON holds: numbers that are not finite are None."""
    solution, views, covariances = step.solution, dict(step.views), dict(step.solution.covariances.items())
    if step.view is not None:  # also where the frame was left out
        views[step.frame.index] = step.view
    verdict = step.verdict or judged(step)
    first = views.get(min(solution.trajectory, default=-1))  # whose camera frame is the object's
    support = None if first is None else first.plane
    report = {
        "schema": 2,  # docs/files.md
        "sequence": meta.sequence,
        "seed": meta.seed,
        "prior": meta.prior,
        "settings": dict(meta.settings),
        "versions": dict(meta.versions),
        "seconds": dict(meta.seconds),
        "scene_frames": list(meta.scene_frames),
        "digests": {str(index): digest for index, digest in meta.digests.items()},
        "complete": step.last and "interrupted" not in verdict.codes,
        "closed": loops_closed([edge for edge in step.edges_so_far if solution.takes_part(edge)]) > 0,
        "loop": _loop(step.edges_so_far, solution, views),
        "camera": _camera(meta.camera, solution, views),
        "trustworthy": verdict.trustworthy,
        "tolerance_m": verdict.tolerance_m,
        "trusted_to_m": verdict.trusted_to_m,
        "reasons": verdict.reasons,
        "reason_codes": verdict.codes,
        "evidence": {name: {**asdict(check), "holds": check.holds} for name, check in verdict.checks.items()},
        "colour": None if verdict.colour is None else _colour(verdict.colour),
        "contradicted": {
            str(frame): {
                "size": views[frame].frame.depth_m.shape,
                "surface": found.surface.astype(int),
                "free": found.free.astype(int),
            }
            for frame, found in verdict.contradicted.items()
        },
        "up": None if support is None else support.normal,
        "support_offset_m": None if support is None else support.offset_m,
        "frames": [{name: getattr(frame, name) for name in _OF_FRAME} for frame in step.frames_so_far],
    }
    poses = [
        {"id": frame, "object_from_camera": pose, "covariance": covariances[frame]}
        for frame, pose in sorted(solution.trajectory.items())
    ]
    edges = [edge_record(edge, solution, views.get(edge.source)) for edge in step.edges_so_far]
    report = {**json_value(report), "edges": edges, "poses": json_value(poses)}
    return {**report, "remedies": list(meta.advice(report)) if step.last and not verdict.trustworthy else []}


def _camera(
    given: Mapping[str, float | str] | None, solution: Solution, views: Mapping[int, RayImage]
) -> dict[str, Any] | None:
    """Return the estimate of the camera; None if the given one is exact. That of an earlier run of its views stays."""
    focal = solution.focal
    if focal is None or (given is not None and "factor_in_run" in given):
        return None if given is None else dict(given)
    before = {"focal_factor": 1.0, "depth_scale": 1.0, "depth_scale_sigma": 0.0} if given is None else given
    in_run = math.exp(focal.log_factor)
    root = views.get(min(solution.trajectory, default=-1))
    return {
        "focal_factor": in_run * float(before["focal_factor"]),
        "focal_factor_sigma": focal.sigma,
        "depth_scale": before["depth_scale"],
        "depth_scale_sigma": total_depth_scale_sigma(float(before["depth_scale_sigma"]), focal),
        "told_by": focal.determined_by,
        "given_sds": abs(focal.log_factor) / focal.prior_sigma,
        "factor_in_run": in_run,  # beyond the file of a camera
        "fx_px": None if root is None else root.frame.camera.fx,
        "loops": focal.loops,
        "sigmas_before": focal.sigmas_before,
        "sigmas_after": focal.sigmas_after,
    }


def _colour(found: ColourAlignment) -> dict[str, Any]:
    """Return where colour is against depth."""
    scale, sigmas = math.exp(found.mean[2]), np.sqrt(np.diag(found.covariance))
    return {
        "shift_px": found.mean[:2],
        "shift_sigma_px": sigmas[:2],
        "scale": scale,
        "scale_sigma": scale * sigmas[2],
        "covariance": found.covariance.ravel(),
        "flip": found.flip,
        "frames": found.frames,
    }


def _loop(
    edges: Sequence[Edge], solution: Solution, views: Mapping[int, RayImage]
) -> dict[str, float | int | list[int]] | None:
    """Return by how much the chain of consecutive edges missed the closure that spans most of it; None without one."""
    error = loop_closure_error(edges, solution, {frame: view.centroid_m for frame, view in views.items()})
    if error is None or not math.isfinite(error.sigmas):
        return None
    return {
        "frames": [error.target, error.source],
        "edges": error.edges,
        "opening_deg": float(np.degrees(error.rotation_rad)),
        "opening_m": error.translation_m,
        "sigmas": error.sigmas,
    }


def edge_record(
    edge: Edge, solution: Solution, view: RayImage | None = None, *, sigma_focal: float = 0.0
) -> dict[str, Any]:
    """Return an edge as JSON values of the report.

    Args:
        edge: with its acceptance.
        solution: the poses, which may contradict it.
        view: the edge's source, used to name undetermined directions; None: only by the camera.
        sigma_focal: standard deviation of the focal length's logarithm, if the solution has no estimate of it.
    """
    sigma_focal = sigma_focal if solution.focal is None else solution.focal.sigma
    posterior = edge.posterior
    outlier = edge in solution.outliers
    left = solution.mode_weights.get((edge.source, edge.target)) if edge.accepted else None
    record = {
        "source": posterior.source,
        "target": posterior.target,
        "kind": edge.kind,
        "accepted": solution.takes_part(edge),
        "outcome": posterior.outcome.label,
        "reason": explain(OptimisationOutlier() if outlier else edge.reason),
        **_pose_record(posterior.pose, sigma_focal),
        "beyond": list(posterior.beyond),
        "undetermined": undetermined(posterior, view),
        "modes": [
            {
                "weight": mode.weight,
                "weight_in_graph": None if left is None else left[k],  # that all edges together leave to it
                **_pose_record(mode.pose, sigma_focal),
            }
            for k, mode in enumerate(posterior.modes)
        ],
        "effective_samples": posterior.effective_samples,
        "pareto_k": posterior.pareto_k,
        "log_evidence": posterior.log_marginal_likelihood,
        "overlap": posterior.overlap,
        "colour_correlation": posterior.colour_correlation,
        "independent_colours": posterior.independent_colours,
        "seconds": posterior.seconds,
    }
    return json_value(record)


def _pose_record(pose: PoseGaussian, sigma_focal: float) -> dict[str, Any]:
    """Return a pose as the report has it: its covariance is marginal over the focal length."""
    return {
        "target_from_source": pose.mean,
        "covariance": pose.widened(sigma_focal).covariance,
        "covariance_given_camera": pose.covariance,
        "by_focal": pose.by_focal,  # ξ by the logarithm of the focal length
    }


def json_value(value: Any) -> Any:
    """Return a JSON value: matrices row by row, None for numbers that are not finite."""
    if isinstance(value, Mapping):
        return {key: json_value(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray):
        plain = value.ravel().tolist()
        return plain if np.isfinite(value).all() else json_value(plain)
    if isinstance(value, list | tuple):
        return [json_value(entry) for entry in value]
    if isinstance(value, np.generic):
        return json_value(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def undetermined(posterior: Posterior, view: RayImage | None = None) -> list[str]:
    """Name the directions of a motion that the data do not determine, the freest first; none where all are.

    Of a posterior with several modes the heaviest is described first, then where the others lie.

    Args:
        posterior: of target_from_source.
        view: the source view, by which directions are named; None: by the camera alone, and turns only.
    """
    modes = posterior.modes if len(posterior.modes) > 1 else ()
    pose = modes[0].pose if modes else posterior.pose
    if not np.isfinite(pose.covariance).all():
        return []
    return [*_free(pose, view), *_elsewhere(posterior, view)]


def _free(pose: PoseGaussian, view: RayImage | None) -> Iterator[str]:
    """Yield the directions in which one Gaussian is wide."""
    sigmas_rad, axes = _principal(pose.covariance[:3, :3])
    if sigmas_rad[-1] > _FREE_RAD:
        yield f"free to turn about any axis: {_degrees(sigmas_rad[-1])} sd and more"
    else:
        for sigma_rad, axis in zip(sigmas_rad, axes, strict=True):
            if sigma_rad > _FREE_RAD:
                yield f"free to turn about {_name(axis, view)}: {_degrees(sigma_rad)} sd"
    if view is None or not len(view.points_m):
        return
    of_centre = se3.covariance_about(pose.covariance, view.centroid_m)[3:, 3:]  # how the object's middle moves
    sigmas_m, axes = _principal(of_centre)
    for sigma_m, axis in zip(sigmas_m, axes, strict=True):
        if sigma_m > 0.01:  # surfaces of a hand-sized object are then visibly apart
            yield f"free to shift along {_name(axis, view)}: {1000.0 * sigma_m:.0f} mm sd"


def _elsewhere(posterior: Posterior, view: RayImage | None) -> Iterator[str]:
    """Yield where the lighter modes lie, as seen from the heaviest."""
    if not posterior.modes:
        return
    first, *others = posterior.modes
    against = f"against {_percent(first.weight)}"
    nearby: list[str] = []
    for mode in others:
        xi = se3.log(se3.inverse(first.pose.mean) @ mode.pose.mean)
        angle_rad, share = float(np.linalg.norm(xi[:3])), _percent(mode.weight)
        if angle_rad > _FREE_RAD:
            about = _name(xi[:3] / angle_rad, view)
            yield f"perhaps turned by {_degrees(angle_rad)} more about {about}: {share} {against}"
        else:
            nearby.append(share)
    if nearby:
        yield f"perhaps elsewhere nearby: {', '.join(nearby)} {against}"


def _principal(covariance: Array) -> tuple[Array, Array]:
    """Return standard deviations (3,) and their directions (3, 3) as rows, largest first."""
    variances, vectors = np.linalg.eigh(covariance)
    return np.sqrt(np.maximum(variances[::-1], 0.0)), np.asarray(vectors.T[::-1], dtype=np.float64)


def _name(direction: Array, view: RayImage | None) -> str:
    """Return the name of a unit direction (3,) of the source camera frame, of either sign."""
    for name, known in _directions(view):
        if abs(float(direction @ known)) >= _ALIKE:
            return name
    direction = direction if direction[int(np.argmax(np.abs(direction)))] > 0.0 else -direction
    x, y, z = np.round(direction, 2) + 0.0  # no minus before a zero
    return f"the direction ({x:.2f}, {y:.2f}, {z:.2f}) of the camera"


def _directions(view: RayImage | None) -> Iterator[tuple[str, Array]]:
    """Yield named unit directions (3,), those that say most first."""
    if view is not None and len(view.points_m) > 3:
        lengths, axes = _principal(np.cov(view.points_m.T))
        if lengths[0] > 1.5 * lengths[1]:  # then it has an axis of its own
            yield "its own axis", axes[0]
    if view is not None and view.plane is not None:
        yield "the table's normal", view.plane.normal
    yield "the viewing direction", np.array([0.0, 0.0, 1.0])
    yield "the camera's vertical", np.array([0.0, 1.0, 0.0])
    yield "the camera's horizontal", np.array([1.0, 0.0, 0.0])


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def _degrees(angle_rad: float) -> str:
    return f"{np.degrees(angle_rad):.0f}°"
