"""The fused mesh in the formats of other programs."""

from __future__ import annotations

from pathlib import Path

from modeler.export.files import write_atomically
from modeler.types import InputError

_FORMATS = (".ply", ".obj", ".glb", ".stl")


def export_mesh(source: Path, out: Path) -> None:
    """Convert a fused mesh; the ending of `out` selects the format.

    Coordinates stay as they are in every format: metres, in the object frame, x right, y down, z forward in the first
    image. PLY, OBJ and GLB keep normals and colours; STL holds neither.

    Args:
        source: a run folder, or a PLY file in it.
        out: file to write; folders on the way are made.

    Raises:
        InputError: where there is no mesh, the ending is unknown or the file cannot be written.
    """
    suffix = out.suffix.lower()
    if suffix not in _FORMATS:
        raise InputError(f"{out}: unknown mesh format {suffix or 'without an ending'!r}; use {', '.join(_FORMATS)}")
    path = source / "model.ply" if source.is_dir() else source
    if not path.is_file():
        raise InputError(f"{path}: there is no such mesh; give a run folder in which `modeler build` has finished")
    content = _converted(path, suffix)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out.parent}: cannot be made ({error.strerror}); choose another place with --out") from error
    write_atomically(out, content)


def _converted(path: Path, suffix: str) -> str | bytes:
    """Return the content of a PLY mesh in the format that `suffix` names."""
    import trimesh
    from trimesh.exchange import gltf, obj, stl

    try:
        mesh = trimesh.load(path, process=False)  # load_mesh would drop the normals
    except Exception as error:  # trimesh lets whatever its parser trips over through
        raise InputError(f"{path}: not a mesh that can be read ({error}); build the model again") from error
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise InputError(f"{path}: holds no triangles; more views are needed for a surface")
    match suffix:
        case ".ply":
            return path.read_bytes()
        case ".glb":
            return gltf.export_glb(trimesh.Scene(mesh), include_normals=True)
        case ".obj":
            return obj.export_obj(mesh, include_normals=True)
        case _:
            return stl.export_stl(mesh)
