"""The fused mesh in the formats of other programs: simplified, textured, or coloured by its uncertainty."""

from __future__ import annotations

import ctypes
import uuid
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from modeler import se3
from modeler.export.files import mesh_ply, write_atomically
from modeler.export.placing import CAMERA_AXES
from modeler.system.pictures import encoded, linear_light, raycaster, tensor
from modeler.system.processes import check_installed
from modeler.types import Array, BoolArray, InputError, ObjectModel, area_vectors_m2, areas_m2

FORMATS = (".ply", ".obj", ".glb", ".stl", ".3mf")
TEXTURED = (".obj", ".glb")
AS_GIVEN: Final = se3.Y_UP
"""For a mesh whose y axis is already up: reverses the rotation to glTF's axes."""

Tint = Literal["views", "sigma"]
MADE_UP_RGB: Final = (230, 90, 200)  # of unobserved, interpolated surface, wherever it is shown
MOST_SIGMA_M: Final = 2e-3  # standard deviation at the end of the scale

_SHARE = 0.5  # of vertices' sd by which triangles may be off: as an error of its own, it would add an eighth to the sd
_MERGED = 8  # triangles around an edge, fewest that a collapse merges; the library counts each once for every corner


def mesh_of(source: Path) -> Path:
    """Return the mesh file of a run folder, or the file itself."""
    return source / "model.ply" if source.is_dir() else source


def format_of(out: Path) -> str:
    """Return the ending that selects the format.

    Raises:
        InputError: if it is none, or the library that writes it is not installed.
    """
    suffix = out.suffix.lower()
    if suffix not in FORMATS:
        what = f"unknown mesh format {suffix!r}" if suffix else "no suffix selects the mesh format"
        raise InputError(f"{out}: {what}; use {', '.join(FORMATS)}")
    if suffix == ".3mf":
        check_installed("lib3mf", "lib3mf", "3mf")
    return suffix


def files_of(out: Path, *, textured: bool = False) -> tuple[Path, ...]:
    """Return the files that `write_mesh` writes.

    These are `out`, of a textured mesh the image of what views saw, and of a textured OBJ its material and its image.
    """
    if not textured:
        return (out,)
    stem = "_".join(out.stem.split())  # many programs take spaces for the end of a name
    seen = out.with_name(f"{stem}_seen.png")
    if out.suffix.lower() != ".obj":
        return out, seen
    return out, seen, out.with_name(f"{stem}.mtl"), out.with_name(f"{stem}.png")


def write_mesh(
    model: ObjectModel,
    out: Path,
    texture: Texture | None = None,
    *,
    object_from_upright: Array | None = None,
    axes: str = CAMERA_AXES,
    unit: Literal["m", "mm"] = "m",
) -> None:
    """Write a mesh; the suffix of `out` selects the format.

    Coordinates stay as they are in every format. In glTF y is up, so that the node of a GLB turns a mesh that is
    given in the camera's axes: viewers show it upright, from the camera's side. PLY, OBJ and GLB keep normals and
    colours, 3MF colours, only PLY has properties of the vertices; STL has none of them.

    Args:
        model: the mesh.
        out: file to write; missing folders are created. A textured OBJ also has an MTL and a PNG file, and textured
            meshes an image NAME_seen.png: white where views saw the texture, black where its colours are filled in.
        texture: for OBJ and GLB, in place of vertex colours.
        object_from_upright: (3, 3) right, down and forward of the view in which a GLB is shown; None: the camera's own;
            `AS_GIVEN`: the node of a GLB does not turn the mesh.
        axes: description of the axes, for formats with comments.
        unit: of the coordinates as they are given.

    Raises:
        InputError: if the suffix is unknown or a file cannot be written.
    """
    suffix = format_of(out)
    if texture is not None and suffix not in TEXTURED:
        raise InputError(f"{out}: {suffix[1:]} has no textures; use {' or '.join(TEXTURED)}, or leave out the texture")
    if texture is not None:
        write_atomically(files_of(out, textured=True)[1], encoded(255 * texture.seen.astype(np.uint8), "PNG"))
    match suffix:
        case ".ply":
            write_atomically(out, mesh_ply(model))
        case ".obj":
            if texture is not None:
                _, _, material, image = files_of(out, textured=True)
                write_atomically(image, encoded(texture.image, "PNG"))
                shown = f"newmtl surface\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nd 1\nillum 1\nmap_Kd {image.name}\n"
                write_atomically(material, shown)
            write_atomically(out, _obj(model, "_".join(out.stem.split()), texture, f"{unit}, {axes}"))
        case ".3mf":
            write_atomically(out, _3mf(model, unit))
        case ".glb":
            write_atomically(out, _glb(model, texture, object_from_upright))
        case _:
            write_atomically(out, _stl(model, unit))


def _obj(model: ObjectModel, name: str, texture: Texture | None, header: str) -> str:
    """Return an OBJ file; colours of vertices follow their coordinates, as most programs read them."""
    lines = [f"# {header}\no {name}"]
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
    """Return a GLB file: one matt material, and the texture or, as glTF has them, linear colours of vertices."""
    import trimesh
    from PIL import Image
    from trimesh.exchange import gltf
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    mesh = trimesh.Trimesh(model.vertices_m, model.triangles, vertex_normals=model.vertex_normals, process=False)
    material = PBRMaterial(metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True)
    if texture is not None:
        material.baseColorTexture = Image.fromarray(texture.image)
    elif model.vertex_colours is not None:
        mesh.vertex_attributes["_COLOR_0"] = linear_rgb(model.vertex_colours).astype(np.float32)
    mesh.visual = TextureVisuals(uv=None if texture is None else texture.uv, material=material)
    scene = trimesh.Scene()
    turn = se3.Y_UP if object_from_upright is None else se3.Y_UP @ object_from_upright.T  # the front towards +z
    scene.add_geometry(mesh, transform=se3.rigid(turn, np.zeros(3)))
    data = gltf.export_glb(scene, include_normals=True, tree_postprocessor=_with_colours)
    assert isinstance(data, bytes)
    return data


def _with_colours(tree: dict[str, Any]) -> None:
    """Make the attribute `_COLOR_0` of a glTF tree its colours; the library would round them to 8 bits."""
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            attributes = primitive["attributes"]
            if "_COLOR_0" in attributes:
                attributes["COLOR_0"] = attributes.pop("_COLOR_0")


def linear_rgb(colours: npt.NDArray[np.uint8]) -> Array:
    """Return linear intensities (n, 3), 0 to 1, of sRGB colours (n, 3) from 0 to 255."""
    return linear_light(colours / 255.0)


def _3mf(model: ObjectModel, unit: Literal["m", "mm"]) -> bytes:
    """Return a 3MF file with its unit stated; each corner has its vertex's colour, which 3MF has in sRGB."""
    import lib3mf  # pyright: ignore[reportMissingImports]

    content: Any = lib3mf.get_wrapper().CreateModel()
    content.SetUnit(lib3mf.ModelUnit.Meter if unit == "m" else lib3mf.ModelUnit.MilliMeter)
    solid = content.AddMeshObject()
    solid.SetGeometry(
        [lib3mf.Position((ctypes.c_float * 3)(*place)) for place in model.vertices_m.tolist()],
        [lib3mf.Triangle((ctypes.c_uint32 * 3)(*corners)) for corners in model.triangles.tolist()],
    )
    if model.vertex_colours is not None:
        group = content.AddColorGroup()
        colours, used = np.unique(model.vertex_colours, axis=0, return_inverse=True)
        numbers = np.array([group.AddColor(lib3mf.Color(*colour, 255)) for colour in colours.tolist()])
        resource, three = group.GetResourceID(), ctypes.c_uint32 * 3
        corners = numbers[used.ravel()[model.triangles]]
        solid.SetAllTriangleProperties([lib3mf.TriangleProperties(resource, three(*ids)) for ids in corners.tolist()])
        solid.SetObjectLevelProperty(resource, int(numbers[0]))
    item = content.AddBuildItem(solid, lib3mf.get_wrapper().GetIdentityTransform())
    for number, owner in enumerate((content.SetBuildUUID, solid.SetUUID, item.SetUUID)):
        owner(str(uuid.UUID(int=number + 1)))  # they are random otherwise
    writer = content.QueryWriter("3mf")
    writer.SetDecimalPrecision(9)
    return bytes(writer.WriteToBuffer())


def _stl(model: ObjectModel, unit: str) -> bytes:
    corners = model.vertices_m[model.triangles]
    normals = area_vectors_m2(model.vertices_m, model.triangles)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    faces = np.zeros(len(corners), dtype=[("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("spare", "<u2")])
    faces["normal"], faces["corners"] = normals, corners
    return f"binary STL, {unit}".encode().ljust(80) + np.uint32(len(corners)).tobytes() + faces.tobytes()


def simplified(model: ObjectModel, triangles: int | None = None) -> ObjectModel:
    """Return the model with fewer triangles, closed where it was closed.

    Edges are collapsed in the order of the least quadric error (Garland and Heckbert 1997, "Surface simplification
    using quadric error metrics"). Colours, views and deviations are those of the nearest old vertex.

    Args:
        model: the mesh.
        triangles: at most so many; None: as few as surface allows that may move by half of its standard deviation.
            Its root mean square over the smallest region that is merged, by the median vertex; over larger regions,
            it is less in proportion to the square root of their area. A model without deviations stays as it is.

    Raises:
        InputError: if the number is too small for a solid.
    """
    import open3d as o3d

    if triangles is not None and triangles < 4:
        raise InputError(f"{triangles} triangles are too few for a solid; at least 4 are needed")
    error = np.inf if triangles is not None else _largest_error(model)
    if not error > 0.0 or len(model.triangles) <= (triangles or 4):
        return model
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(model.vertices_m), o3d.utility.Vector3iVector(model.triangles.astype(np.int32))
    )
    closed = not len(mesh.get_non_manifold_edges(allow_boundary_edges=False))
    fewer = mesh
    for share in (1.0, 0.98, 0.95, 0.9, 0.8):  # until no edge of three triangles is left
        if triangles is None:
            # Rims weigh 100: with 1, the bundled box's moves by 0.6 mm (99 %), with 100 by 0.25, with 1,000 by 0.12.
            fewer = mesh.simplify_quadric_decimation(4, share * error, 100.0)
        else:
            fewer = mesh.simplify_quadric_decimation(int(share * triangles))
        fewer.remove_degenerate_triangles()
        fewer.remove_unreferenced_vertices()
        if not len(fewer.get_non_manifold_edges(allow_boundary_edges=not closed)):
            break
    fewer.compute_vertex_normals()
    vertices_m = np.asarray(fewer.vertices)
    if not len(fewer.triangles):
        raise InputError(f"{triangles} triangles are too few for this mesh; allow more")
    _, nearest = KDTree(model.vertices_m).query(vertices_m)
    return replace(
        model,
        vertices_m=vertices_m,
        triangles=np.asarray(fewer.triangles, dtype=np.int64),
        vertex_normals=np.asarray(fewer.vertex_normals),
        **_of_vertices(model, np.asarray(nearest)),
    )


def _of_vertices(model: ObjectModel, numbers: npt.NDArray[np.integer]) -> dict[str, np.ndarray | None]:
    """Return colours, views and deviations of some vertices (n,) as fields of a model."""
    known = {name: getattr(model, name) for name in ("vertex_colours", "vertex_views", "vertex_sigmas_m")}
    return {name: None if values is None else values[numbers] for name, values in known.items()}


def _largest_error(model: ObjectModel) -> float:
    """Return the quadric error in m⁴, squared distances times areas, that the deviations allow; 0 without any."""
    sigmas_m = np.zeros(0) if model.vertex_sigmas_m is None else model.vertex_sigmas_m
    sigmas_m = sigmas_m[np.isfinite(sigmas_m)]
    if not len(sigmas_m) or not len(model.triangles):
        return 0.0
    area_m2 = float(areas_m2(model.vertices_m, model.triangles).mean())
    return 3.0 * _MERGED * area_m2 * (_SHARE * float(np.median(sigmas_m))) ** 2


def tinted(model: ObjectModel, tint: Tint) -> ObjectModel:
    """Return the model with vertices coloured by their uncertainty; interpolated surface is pink.

    Args:
        model: with `vertex_views` and `vertex_sigmas_m`.
        tint: "views": number of views that observed a vertex, dark = 1, yellow = 12 and more. "sigma": its standard
            deviation, dark = 0, yellow = 2 mm and more.

    Raises:
        InputError: if the model does not have them.
    """
    views, sigmas_m = model.vertex_views, model.vertex_sigmas_m
    if views is None or sigmas_m is None:
        raise InputError("the model has no view counts of its vertices; build it again with this version")
    rgb = sigma_rgb(sigmas_m) if tint == "sigma" else _scale_rgb(views / 12)  # 12 at the end of the scale
    rgb[views == 0] = MADE_UP_RGB
    return replace(model, vertex_colours=np.rint(rgb).astype(np.uint8))


def sigma_rgb(sigmas_m: Array) -> Array:
    """Return colours (v, 3) of standard deviations (v,), from dark (0) to yellow (`MOST_SIGMA_M` and more).

    Interpolated surface, which has none, is pink.
    """
    rgb = _scale_rgb(np.where(np.isfinite(sigmas_m), sigmas_m, 0.0) / MOST_SIGMA_M)
    rgb[~np.isfinite(sigmas_m)] = MADE_UP_RGB
    return rgb


def _scale_rgb(shares: Array) -> Array:
    """Return colours (v, 3), 0 to 255, of places (v,) on the scale, 0 to 1."""
    from matplotlib import colormaps

    return 255.0 * colormaps["cividis"](np.clip(shares, 0.0, 1.0))[:, :3]


PADDING_PX = 4  # charts keep this distance, so that colours do not bleed when the image is shrunk
TRIANGLES = 8_000  # of a mesh whose detail is in the image, at most
PIECE = 1_000  # triangles that are unwrapped at once: the time grows with more than the square of their number

Paint = Callable[[Array, Array, npt.NDArray[np.uint8]], tuple[npt.NDArray[np.uint8], BoolArray]]
"""From points (n, 3) and normals (n, 3) in the object frame, and RGB (n, 3) of the vertices there, to RGB (n, 3) and
whether views saw it (n,)."""


@dataclass(frozen=True, eq=False)
class Texture:
    """Where the vertices of a mesh lie in an image."""

    uv: Array
    """(v, 2) places in the image, 0..1: u to the right, v upwards from the lower edge."""
    image: npt.NDArray[np.uint8]
    """(h, w, 3) RGB."""
    seen: BoolArray
    """(h, w) whether a view with colour saw the surface there; elsewhere its colours are filled in from around."""
    texel_m: float
    """Side of a pixel of the image on the surface."""


def textured(model: ObjectModel, paint: Paint, side_px: int) -> tuple[ObjectModel, Texture]:
    """Return the model with vertices doubled along seams, and its texture."""
    import xatlas

    # Approximately: packing determines how much of the image charts fill, some 60 %.
    texel_m = float(np.sqrt(areas_m2(model.vertices_m, model.triangles).sum() / 0.6)) / side_px
    atlas = xatlas.Atlas()
    # In texels and from the origin: the library compares lengths with constants.
    texels = ((model.vertices_m - model.vertices_m.mean(axis=0)) / texel_m).astype(np.float32)
    used = []
    for piece in _pieces(model.vertices_m[model.triangles].mean(axis=1), PIECE):
        vertices, triangles = np.unique(model.triangles[piece], return_inverse=True)
        atlas.add_mesh(texels[vertices], triangles.reshape(-1, 3).astype(np.uint32))
        used.append(vertices)
    charts, packing = xatlas.ChartOptions(), xatlas.PackOptions()
    packing.texels_per_unit, packing.padding, packing.bilinear = 1.0, PADDING_PX, True
    atlas.generate(charts, packing)
    parts = [atlas[number] for number in range(len(used))]
    origin = np.concatenate([vertices[part[0]] for vertices, part in zip(used, parts, strict=True)])
    starts = np.cumsum([0, *(len(part[0]) for part in parts)])
    triangles = np.concatenate([part[1] + start for part, start in zip(parts, starts, strict=False)])
    places = np.concatenate([part[2] for part in parts])
    wrapped = replace(
        model,
        vertices_m=model.vertices_m[origin],
        triangles=triangles.astype(np.int64),
        vertex_normals=model.vertex_normals[origin],
        **_of_vertices(model, origin),
    )
    packed = max(atlas.width, atlas.height)
    shares = places.astype(np.float64) * np.array([atlas.width, atlas.height]) / packed
    image, seen = _baked(wrapped, shares * side_px, side_px, paint)
    uv = np.stack([shares[:, 0], 1.0 - shares[:, 1]], axis=1)
    return wrapped, Texture(uv, image, seen, texel_m * packed / side_px)


def _pieces(centres_m: Array, most: int) -> list[npt.NDArray[np.int64]]:
    """Return the numbers of triangles in compact pieces of limited size, given their centres (t, 3)."""
    waiting, pieces = [np.arange(len(centres_m))], []
    while waiting:
        piece = waiting.pop()
        if len(piece) <= most:
            pieces.append(piece)
            continue
        axis = int(np.argmax(np.ptp(centres_m[piece], axis=0)))
        order = piece[np.argsort(centres_m[piece, axis], kind="stable")]
        waiting += [order[: len(order) // 2], order[len(order) // 2 :]]
    return pieces


def _baked(model: ObjectModel, places_px: Array, side_px: int, paint: Paint) -> tuple[npt.NDArray[np.uint8], BoolArray]:
    """Return the image (s, s, 3): every pixel in or next to a chart shows the point of the surface nearest to it.

    And which pixels (s, s) show what views saw.

    Args:
        model: the mesh.
        places_px: (v, 2) column and row of its vertices, pixel centres at halves.
        side_px: s.
        paint: gives points their colours.
    """
    flat = np.concatenate([places_px, np.zeros((len(places_px), 1))], axis=1)
    columns, rows = np.meshgrid(np.arange(side_px) + 0.5, np.arange(side_px) + 0.5)
    pixels = np.stack([columns, rows, np.zeros_like(rows)], axis=-1).reshape(-1, 3).astype(np.float32)
    found = raycaster(flat, model.triangles).compute_closest_points(tensor(pixels))
    off = np.linalg.norm(found["points"].numpy() - pixels, axis=1)
    near = off <= PADDING_PX
    triangle = model.triangles[found["primitive_ids"].numpy()[near].astype(np.int64)]
    second, third = found["primitive_uvs"].numpy()[near].astype(np.float64).T
    shares = np.stack([1.0 - second - third, second, third], axis=1)
    points = np.einsum("nk,nkc->nc", shares, model.vertices_m[triangle])
    normals = np.einsum("nk,nkc->nc", shares, model.vertex_normals[triangle])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    at_vertices = np.full_like(model.vertices_m, 128.0) if model.vertex_colours is None else model.vertex_colours
    between = np.rint(np.einsum("nk,nkc->nc", shares, at_vertices[triangle])).astype(np.uint8)
    colours, known = paint(points, normals, between)
    seen = np.zeros(len(pixels), dtype=bool)
    seen[near] = known
    image = np.full((len(pixels), 3), np.rint(colours.mean(axis=0)) if len(colours) else 128, dtype=np.uint8)
    image[near] = colours
    return image.reshape(side_px, side_px, 3), seen.reshape(side_px, side_px)
