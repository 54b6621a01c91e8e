"""What `modeler evaluate` does with finished runs: their models against the true surface."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from modeler.cli.parts import Part
from modeler.cli.reopened import reopened
from modeler.experiment import Modelled, ModelScore, model_scores, models_csv, models_json
from modeler.export import mesh_of, read_model, write_atomically
from modeler.fusion import Fuser
from modeler.types import Array, InputError
from sequences import true_mesh
from sequences.rendering.mesh import Mesh

_SAME_M = 1e-5  # to which files of one surface agree


def is_run(path: Path) -> bool:
    """Return whether a path is a run folder rather than a sequence."""
    return (path / "report.json").is_file()


def evaluate_models(runs: Sequence[Path], out: Path, seed: int) -> tuple[list[ModelScore], list[str]]:
    """Judge the models of runs and write `models.json` and `models.csv` into a folder.

    Args:
        runs: run folders of sequences whose poses and surface are known.
        out: folder, made where there is none.
        seed: of the points drawn on the surfaces.

    Returns:
        The scores, and in a line each which runs could not be judged, and why.

    Raises:
        InputError: where none can be judged, with the reason of the first, or the results cannot be written.
    """
    scores, left_out = [], []
    for path in runs:
        try:
            scores += _scores(path, seed)
        except InputError as error:
            if len(runs) == 1:
                raise
            left_out.append(f"{path} is left out: {str(error).removesuffix('.')}")
    if not scores:
        raise InputError(left_out[0])
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be made ({error.strerror}); choose another folder with --out") from error
    write_atomically(out / "models.json", models_json(scores, seed))
    write_atomically(out / "models.csv", models_csv(scores))
    return scores, left_out


def _scores(path: Path, seed: int) -> list[ModelScore]:
    """Judge the model of one run.

    Raises:
        InputError: where something cannot be read, or is not known.
    """
    run = reopened(path)
    truth, mesh = _truth(path, run.parts)
    modelled = Modelled(
        name=str(path),
        model=read_model(mesh_of(path)),
        views=run.views,
        trajectory=run.solution.trajectory,
        camera_from_model=truth,
        truth=(mesh.vertices_m, mesh.triangles),
    )
    return model_scores(modelled, Fuser(voxel_m=run.report["settings"].get("voxel_m")), seed)


def _truth(run: Path, parts: Sequence[Part]) -> tuple[dict[int, Array], Mesh]:
    """Return the true camera_from_model (4, 4) by frame number, and the true surface.

    Raises:
        InputError: where a part of the run does not know them, or parts that were joined know different surfaces.
    """
    poses: dict[int, Array] = {}
    meshes: list[Mesh] = []
    for part in parts:
        truth = part.truth()
        if truth is None:
            raise InputError(f"{part.sequence.name}: has no ground truth to compare with; add scene_gt.json.")
        poses |= truth
        meshes.append(true_mesh(part.sequence))
    first = meshes[0].vertices_m
    for part, mesh in zip(parts, meshes, strict=True):
        if mesh.vertices_m.shape != first.shape or np.abs(mesh.vertices_m - first).max() > _SAME_M:
            raise InputError(
                f"{run}: {parts[0].sequence.name} and {part.sequence.name}, of which it is joined, have different true "
                "surfaces; evaluate the runs it joins"
            )
    return poses, meshes[0]


def models_table(scores: Sequence[ModelScore]) -> list[tuple[str, ...]]:
    """Return heading and rows of a table of scores."""
    heading = ("model", "poses", "over", "frames", "max deg", "accuracy mm", "completeness mm", "F 3 mm", "F 5 mm")
    return [
        heading,
        *(
            (
                score.run,
                score.poses,
                score.over,
                str(score.frames),
                f"{score.rotation_error_deg:.2f}",
                f"{score.accuracy_mm:.2f}",
                f"{score.completeness_mm:.2f}",
                f"{score.f_3mm:.3f}",
                f"{score.f_5mm:.3f}",
            )
            for score in scores
        ),
    ]
