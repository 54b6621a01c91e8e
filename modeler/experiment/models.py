"""Models of runs against true surfaces, compared with models of the same frames fused with their true poses."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Literal, final

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.evaluation import SurfaceErrors, TrueSurface, align_to_model, rotation_error_deg, surface_errors
from modeler.fusion import Fuser
from modeler.types import Array, InputError, ObjectModel, RayImage

Poses = Literal["run", "true"]
Over = Literal["seen", "whole"]


@final
@dataclass(frozen=True)
class ModelScore:
    """How far one model is from the true surface."""

    run: str
    """The run."""
    poses: Poses
    """Of whose poses the model is made: the run's own, or the true ones."""
    over: Over
    """What of the true surface has to be there: what the frames saw, or all."""
    frames: int
    """Number of views with a true pose."""
    rotation_error_deg: float
    """Largest rotation error of a pose, after the object is aligned with the true model by all frames together."""
    accuracy_mm: float
    """Mean distance from the model to the true surface."""
    completeness_mm: float
    """Mean distance from the true surface to the model."""
    accurate_3mm: float
    """Share of the model within 3 mm of the true surface."""
    complete_3mm: float
    """Share of the true surface within 3 mm of the model."""
    f_3mm: float
    """Their harmonic mean."""
    accurate_5mm: float
    """Share of the model within 5 mm of the true surface."""
    complete_5mm: float
    """Share of the true surface within 5 mm of the model."""
    f_5mm: float
    """Their harmonic mean."""


@final
@dataclass(frozen=True, eq=False)
class Modelled:
    """A run to be judged."""

    name: str
    """Of the run."""
    model: ObjectModel
    """As the run made it."""
    views: Mapping[int, RayImage]
    """What it is made of, by frame number."""
    trajectory: Mapping[int, Array]
    """Its object_from_camera (4, 4) by frame number."""
    camera_from_model: Mapping[int, Array]
    """The true poses (4, 4) by frame number."""
    truth: tuple[Array, npt.NDArray[np.int64]]
    """Vertices (v, 3) in m and triangles (t, 3) of the true surface."""


@final
@dataclass(frozen=True, eq=False)
class _Candidate:
    """One model to be compared with the truth."""

    poses: Poses
    """Of whose poses it is made."""
    model: ObjectModel
    """As it is made, in its object frame."""
    model_from_object: Array
    """(4, 4) aligns it with the true model."""
    model_from_camera: Mapping[int, Array]
    """Its poses (4, 4), so align_to_model, by frame number."""


def model_scores(modelled: Modelled, fuser: Fuser, seed: int) -> list[ModelScore]:
    """Compare a run's model, and one that `fuser` makes of the same frames with their true poses, with the truth.

    Args:
        modelled: the run.
        fuser: makes the other model.
        seed: of the points drawn on the surfaces.

    Raises:
        InputError: where no view has a true pose, or a model or the truth has no surface.
    """
    frames = [frame for frame in modelled.trajectory if frame in modelled.camera_from_model and frame in modelled.views]
    if not frames:
        raise InputError(f"{modelled.name}: none of its frames has a true pose; is scene_gt.json of another sequence?")
    try:
        surface = TrueSurface.of(*modelled.truth, np.random.default_rng([seed, 0]))
    except ValueError:
        raise InputError(f"{modelled.name}: the true mesh of its object has no area; give that of a surface") from None
    seen = surface.seen((modelled.views[frame].frame, modelled.camera_from_model[frame]) for frame in frames)
    scores: list[ModelScore] = []
    for candidate in _candidates(modelled, frames, fuser):
        rng = np.random.default_rng([seed, 1])  # the same for both, so that their difference is that of the models
        vertices_m = se3.transform(candidate.model_from_object, candidate.model.vertices_m)
        try:
            errors = surface_errors(vertices_m, candidate.model.triangles, surface, rng)
        except ValueError:
            whose = "its model" if candidate.poses == "run" else "what its frames give with their true poses"
            raise InputError(f"{modelled.name}: {whose} has no surface; build it from more frames") from None
        scores += [
            _score(modelled, candidate, "seen", errors.over(seen)),
            _score(modelled, candidate, "whole", errors),
        ]
    return scores


def _candidates(modelled: Modelled, frames: Sequence[int], fuser: Fuser) -> tuple[_Candidate, _Candidate]:
    """Return the run's own model and the one of true poses."""
    true_poses = {frame: se3.inverse(modelled.camera_from_model[frame]) for frame in frames}
    model_from_object = align_to_model(modelled.trajectory, modelled.camera_from_model)
    own_poses = {frame: model_from_object @ modelled.trajectory[frame] for frame in frames}
    reference = fuser.fuse({frame: modelled.views[frame] for frame in frames}, true_poses)
    return (
        _Candidate("run", modelled.model, model_from_object, own_poses),
        _Candidate("true", reference, np.eye(4), true_poses),
    )


def _score(modelled: Modelled, candidate: _Candidate, over: Over, errors: SurfaceErrors) -> ModelScore:
    poses = candidate.model_from_camera
    return ModelScore(
        run=modelled.name,
        poses=candidate.poses,
        over=over,
        frames=len(poses),
        rotation_error_deg=max(
            rotation_error_deg(poses[frame], se3.inverse(modelled.camera_from_model[frame])) for frame in poses
        ),
        accuracy_mm=1e3 * errors.accuracy_m,
        completeness_mm=1e3 * errors.completeness_m,
        accurate_3mm=errors.accurate(3e-3),
        complete_3mm=errors.complete(3e-3),
        f_3mm=errors.f_score(3e-3),
        accurate_5mm=errors.accurate(5e-3),
        complete_5mm=errors.complete(5e-3),
        f_5mm=errors.f_score(5e-3),
    )


def models_json(scores: Sequence[ModelScore], seed: int) -> str:
    """Return scores as JSON."""
    return json.dumps({"schema": 1, "seed": seed, "models": [asdict(score) for score in scores]}, indent=1) + "\n"


def models_csv(scores: Sequence[ModelScore]) -> str:
    """Return scores as CSV, a field a column."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [f.name for f in fields(ModelScore)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(score) for score in scores)
    return text.getvalue()
