"""The model of a run against the true surface and the true poses."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from modeler.experiment import Modelled, ModelScore, model_scores
from modeler.export import mesh_of, read_model
from modeler.fusion import Fuser
from modeler.runs.reopening import Part, reopened
from modeler.sequences import true_mesh
from modeler.sequences.meshes import Mesh
from modeler.types import Array, InputError

_SAME_M = 1e-5  # to which files of one surface agree


def scores_of(path: Path, seed: int) -> list[ModelScore]:
    """Judge the model of one run.

    Raises:
        InputError: if something cannot be read, or is not known.
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
    """Return the true camera_from_model (4, 4) by frame number, and the true surface."""
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
        if mesh.vertices_m.shape != first.shape or abs(mesh.vertices_m - first).max() > _SAME_M:
            raise InputError(
                f"{run}: {parts[0].sequence.name} and {part.sequence.name}, of which it is joined, have different true "
                "surfaces; evaluate the runs it joins"
            )
    return poses, meshes[0]
