"""The files of an evaluation: trials as JSON, CSV and a plot, and the errors of models against true surfaces."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.evaluation import SurfaceErrors, TrueSurface, align_to_model, rotation_error_deg, surface_errors
from modeler.experiment.experiment import Experiment, Recorded, Summary, Trial, summaries
from modeler.export import write_atomically
from modeler.export.report import json_value
from modeler.fusion import Fuser
from modeler.types import Array, InputError, ObjectModel, RayImage

Poses = Literal["run", "true"]
Over = Literal["seen", "whole"]


@dataclass(frozen=True)
class ModelScore:
    """How far one model is from the true surface."""

    run: str
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
    """Its poses (4, 4), aligned so, by frame number."""


def model_scores(modelled: Modelled, fuser: Fuser, seed: int) -> list[ModelScore]:
    """Compare a run's model, and one that `fuser` makes of the same frames with their true poses, with the truth.

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


def write_models(scores: Sequence[ModelScore], out: Path, seed: int) -> None:
    """Write `models.json` and `models.csv`, a field a column, into a folder, made where there is none."""
    records = [asdict(score) for score in scores]
    _make(out)
    write_atomically(out / "models.json", json.dumps({"schema": 1, "seed": seed, "models": records}, indent=1) + "\n")
    write_atomically(out / "models.csv", _csv([f.name for f in fields(ModelScore)], records))


def _make(out: Path) -> None:
    """Make a folder for results."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be made ({error.strerror}); choose another folder with `out`") from error


def evaluate(
    sequences: Sequence[Recorded],
    experiment: Experiment,
    out: Path,
    *,
    draw: Callable[[Sequence[Trial]], bytes],
    report: Callable[[Trial], None],
) -> list[Summary]:
    """Run an experiment and write `results.json`, `results.csv` and `rotation_errors.png` into a folder.

    Args:
        sequences: with ground truth, or such as are a closed turn where that is the pairing.
        experiment: what to do with each.
        out: folder, made where there is none; the three files of an earlier experiment are replaced at the end.
        draw: makes a PNG of the trials.
        report: called with every trial as soon as it is done, `experiment.size(sequence)` times for each sequence.

    Raises:
        InputError: where a sequence has nothing to be judged by or cannot be read, or `out` cannot be written.
    """
    names = [recorded.name for recorded in sequences]
    for recorded in sequences:
        if names.count(recorded.name) > 1:
            raise InputError(f"two sequences are called {recorded.name!r}; give each a name in its sequence.json.")
        experiment.size(recorded)  # refuses what cannot be judged, before hours are spent on the others
    _make(out)
    trials: list[Trial] = []
    for recorded in sequences:
        for trial in experiment.trials(recorded):
            trials.append(trial)
            report(trial)
    rows = summaries(trials, experiment.success_deg, loops=experiment.pairing.loops)
    write_atomically(out / "results.json", results_json(experiment, trials, rows))
    write_atomically(out / "results.csv", results_csv(trials))
    write_atomically(out / "rotation_errors.png", draw(trials))
    return rows


def results_json(experiment: Experiment, trials: Sequence[Trial], rows: Sequence[Summary]) -> str:
    """Return an experiment, its trials and their summaries as JSON; numbers that are not finite are null."""
    results = {
        "schema": 1,
        "learn": experiment.learn,
        "seed": experiment.seed,
        "prior": repr(experiment.prior),
        "methods": {name: repr(method) for name, method in experiment.methods.items()},
        "pairing": asdict(experiment.pairing),
        "points": experiment.points,
        "success_deg": experiment.success_deg,
        "summaries": [asdict(row) for row in rows],
        "trials": [asdict(trial) for trial in trials],
    }
    return json.dumps(json_value(results), indent=1, allow_nan=False) + "\n"


def results_csv(trials: Sequence[Trial]) -> str:
    """Return the trials as CSV, a field a column but for the estimate; numbers that are not finite are empty."""
    names = [f.name for f in fields(Trial) if f.name != "target_from_source"]
    return _csv(names, (json_value(asdict(trial)) for trial in trials))


def _csv(names: Sequence[str], rows: Iterable[Mapping[str, object]]) -> str:
    """Return some values of rows as a table."""
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n", extrasaction="ignore")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
