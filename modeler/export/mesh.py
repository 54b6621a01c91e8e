"""The fused mesh in the formats of other programs."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from modeler.export.files import write_atomically
from modeler.export.ply import mesh_ply
from modeler.export.texture import Texture
from modeler.types import Array, InputError, ObjectModel

FORMATS = (".ply", ".obj", ".glb", ".stl")
TEXTURED = (".obj", ".glb")


def mesh_of(source: Path) -> Path:
    """Return the mesh file of a run folder, or the file itself."""
    return source / "model.ply" if source.is_dir() else source


def format_of(out: Path) -> str:
    """Return the ending that selects the format.

    Raises:
        InputError: where it is none.
    """
    suffix = out.suffix.lower()
    if suffix not in FORMATS:
        what = f"unknown mesh format {suffix!r}" if suffix else "no ending says the mesh format"
        raise InputError(f"{out}: {what}; use {', '.join(FORMATS)}")
    return suffix


def write_mesh(
    model: ObjectModel, out: Path, texture: Texture | None = None, *, object_from_upright: Array | None = None
) -> None:
    """Write a mesh; the ending of `out` selects the format.

    Coordinates stay as they are in every format: metres, in the object frame, x right, y down, z forward in the first
    image. In glTF y is up, so that the node of a GLB turns the mesh: viewers show it as it stood, from the camera's
    side. PLY, OBJ and GLB keep normals and colours, PLY alone what is known of the vertices; STL holds neither.

    Args:
        model: the mesh.
        out: file to write; folders on the way are made. A textured OBJ has an MTL and a PNG file beside it.
        texture: for OBJ and GLB, in place of vertex colours.
        object_from_upright: (3, 3) right, down and forward of the view in which a GLB is shown; None: the camera's own.

    Raises:
        InputError: where the ending is unknown or a file cannot be written.
    """
    suffix = format_of(out)
    if texture is not None and suffix not in TEXTURED:
        raise InputError(f"{out}: {suffix[1:]} holds no texture; use {' or '.join(TEXTURED)}, or leave out --texture")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out.parent}: cannot be made ({error.strerror}); choose another place with --out") from error
    match suffix:
        case ".ply":
            write_atomically(out, mesh_ply(model))
        case ".obj":
            beside = "_".join(out.stem.split())  # many programs take spaces for the end of a name
            if texture is not None:
                write_atomically(out.with_name(f"{beside}.png"), _png(texture))
                write_atomically(out.with_name(f"{beside}.mtl"), _material(f"{beside}.png"))
            write_atomically(out, _obj(model, beside, texture))
        case ".glb":
            write_atomically(out, _glb(model, texture, object_from_upright))
        case _:
            write_atomically(out, _stl(model))


def _png(texture: Texture) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(texture.image).save(buffer, format="PNG")
    return buffer.getvalue()


def _material(image: str) -> str:
    """Return an MTL file with one material, `surface`, that shows an image and nothing else."""
    return f"newmtl surface\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nd 1\nillum 1\nmap_Kd {image}\n"


def _obj(model: ObjectModel, name: str, texture: Texture | None) -> str:
    """Return an OBJ file; colours of vertices follow their coordinates, as most programs read them."""
    lines = [f"# metres, x right, y down, z forward in the first image\no {name}"]
    places = model.vertices_m
    if texture is None and model.vertex_colours is not None:
        places = np.concatenate([places, model.vertex_colours / 255.0], axis=1)
    lines += ["v " + " ".join(f"{number:.7g}" for number in place) for place in places]
    lines += [f"vn {x:.5f} {y:.5f} {z:.5f}" for x, y, z in model.vertex_normals]
    numbers = model.triangles + 1
    if texture is None:
        lines += [f"f {a}//{a} {b}//{b} {c}//{c}" for a, b, c in numbers]
    else:
        lines.insert(1, f"mtllib {name}.mtl\nusemtl surface")
        lines += [f"vt {u:.6f} {v:.6f}" for u, v in texture.uv]
        lines += [f"f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}" for a, b, c in numbers]
    return "\n".join([*lines, ""])


def _glb(model: ObjectModel, texture: Texture | None, object_from_upright: Array | None) -> bytes:
    import trimesh
    from PIL import Image
    from trimesh.exchange import gltf
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    mesh = trimesh.Trimesh(
        model.vertices_m,
        model.triangles,
        vertex_normals=model.vertex_normals,
        vertex_colors=None if texture is not None else model.vertex_colours,
        process=False,
    )
    if texture is not None:
        material = PBRMaterial(
            baseColorTexture=Image.fromarray(texture.image), metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True
        )
        mesh.visual = TextureVisuals(uv=texture.uv, material=material)
    scene = trimesh.Scene()
    turn = np.diag([1.0, -1.0, -1.0, 1.0])  # glTF: y up, and the front towards +z
    if object_from_upright is not None:
        turn[:3, :3] @= object_from_upright.T
    scene.add_geometry(mesh, transform=turn)
    data = gltf.export_glb(scene, include_normals=True)
    assert isinstance(data, bytes)
    return data


def _stl(model: ObjectModel) -> bytes:
    """Return a binary STL file."""
    corners = model.vertices_m[model.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    faces = np.zeros(len(corners), dtype=[("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("spare", "<u2")])
    faces["normal"], faces["corners"] = normals, corners
    return b"binary STL, metres".ljust(80) + np.uint32(len(corners)).tobytes() + faces.tobytes()
