"""The true surface of a sequence's object, where it is known."""

from __future__ import annotations

from pathlib import Path

from modeler.types import InputError
from sequences.base import AbstractSequence
from sequences.bop.sequence import BopSequence
from sequences.files.json_input import read_tree
from sequences.rendering.mesh import Mesh, read_mesh

_MM = 1e-3


def true_mesh(sequence: AbstractSequence) -> Mesh:
    """Return the true surface in m, in the model frame of `sequence.truth()`.

    That is `model.ply` of the sequence, in m, as the renderer writes it; else, of a BOP scene, the model of its object
    in the dataset's `models` folder, in mm.

    Raises:
        InputError: where there is none or it cannot be read.
    """
    if sequence.model_path is not None:
        return read_mesh(sequence.model_path, 1.0)
    if isinstance(sequence, BopSequence):
        found = _of_dataset(sequence.path)
        if found is not None:
            return read_mesh(found, _MM)
    raise InputError(
        f"{sequence.name}: has no true surface to compare with; put model.ply (m) beside its frames, or BOP's models "
        "folder (mm) beside its split"
    )


def _of_dataset(scene: Path) -> Path | None:
    """Return the model of a scene's first object, beside the scene or its split."""
    truth = scene / "scene_gt.json"
    if not truth.is_file():
        return None
    objects = [node.elements() for node in read_tree(truth).frames().values()]
    number = next((first[0].need("obj_id").value for first in objects if first), None)
    if not isinstance(number, int):
        return None
    name, place = f"obj_{number:06d}.ply", scene.resolve()
    candidates = [
        folder / models / name for folder in (place, *place.parents[:2]) for models in ("models", "models_eval")
    ]
    return next((path for path in candidates if path.is_file()), None)
