"""Meshes and photographs that other packages ship, from their wheels, and shapes of our own, gathered into one file.

    pip download --no-deps robosuite==1.5.2 metaworld==3.1.1 pyvista==0.49.1 scikit-image==0.26.0 warp-lang
    python -m studies whole.things *.whl --out things.npz

Needs MuJoCo, which puts the parts of Meta-World's objects together, and usd-core for Warp's. Licences: robosuite,
Meta-World and PyVista MIT, scikit-image BSD 3-clause, Warp Apache 2.0.
"""

from __future__ import annotations

import argparse
import io
import sys
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, final

import numpy as np
import numpy.typing as npt

from modeler.types import Array

if TYPE_CHECKING:
    import trimesh

_TRIANGLES: Final = 4000
"""Of a mesh at most: 0.5 % of its size apart, as fine as the images."""
_OWN: Final = 16
"""Shapes of each kind that no package ships."""
_PICTURE_PX: Final = 192
"""Side of a photograph: the images have no more pixels on an object."""
_WHOLE: Final = {
    "robosuite": (
        "bullet_data/baxter_description/meshes/head/H0.stl",
        "bullet_data/baxter_description/meshes/lower_elbow/E1.stl",
        "bullet_data/baxter_description/meshes/lower_forearm/W1.stl",
        "bullet_data/baxter_description/meshes/upper_shoulder/S0.stl",
        "bullet_data/baxter_description/meshes/wrist/W2.stl",
        "bullet_data/baxter_description/meshes/torso/base_link_collision.stl",
        "bullet_data/panda_description/meshes/collision/hand.stl",
        "bullet_data/panda_description/meshes/collision/link0.stl",
        "bullet_data/panda_description/meshes/collision/link5.stl",
        "bullet_data/panda_description/meshes/collision/link6.stl",
        "bullet_data/sawyer_description/meshes/base.stl",
        "bullet_data/sawyer_description/meshes/l0.stl",
        "bullet_data/sawyer_description/meshes/l1.stl",
        "bullet_data/sawyer_description/meshes/l3.stl",
        "bullet_data/sawyer_description/meshes/l4.stl",
        "bullet_data/sawyer_description/meshes/l6.stl",
        "bases/meshes/rethink_minimal_mount/pedestal_vis.stl",
        "bases/meshes/omron_mobile_base/omron_2.obj",
        "objects/meshes/bottle.stl",
        "objects/meshes/bread.stl",
        "objects/meshes/can.stl",
        "objects/meshes/cereal.stl",
        "objects/meshes/handles.stl",
        "objects/meshes/lemon.stl",
        "objects/meshes/milk.stl",
    ),
    "pyvista": ("examples/airplane.ply", "examples/ant.ply", "examples/nut.ply"),
    "warp": ("examples/assets/bear.usd", "examples/assets/bunny.usd", "examples/assets/rocks.usd"),
}
"""Files of meshes by package, without the folders that all share."""
_FOLDERS: Final = {"robosuite": "robosuite/models/assets/", "pyvista": "pyvista/", "warp": "warp/"}
_ROOM: Final = ("world", "tablelink", "RetainingWall")
"""Bodies around Meta-World's objects."""
_PICTURES: Final = {
    "skimage/data/": (
        "astronaut.png",
        "brick.png",
        "chelsea.png",
        "coffee.png",
        "coins.png",
        "grass.png",
        "gravel.png",
        "hubble_deep_field.jpg",
        "ihc.png",
        "moon.png",
        "motorcycle_left.png",
        "page.png",
        "retina.jpg",
        "rocket.jpg",
    ),
    "robosuite/models/assets/textures/": (
        "bread.png",
        "can.png",
        "cereal.png",
        "dark-wood.png",
        "gray-felt.png",
        "lemon.png",
        "light-wood.png",
        "soda.png",
        "steel-scratched.png",
        "wood-tiles.png",
    ),
}
"""Files of photographs by folder."""


@final
@dataclass(frozen=True, eq=False)
class Thing:
    """A mesh of size 1, standing on z = 0 over the origin."""

    name: str
    """Package and file."""
    vertices: Array
    """(v, 3) with the largest extent 1."""
    triangles: npt.NDArray[np.int64]
    """(t, 3) vertex numbers."""

    @staticmethod
    def of(name: str, vertices: Array, triangles: npt.NDArray[np.int64]) -> Thing:
        """Return a mesh scaled and put in its place."""
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        foot = np.array([*(0.5 * (low + high))[:2], low[2]])
        return Thing(name, (vertices - foot) / (high - low).max(), np.asarray(triangles, np.int64))


def read(path: Path) -> tuple[list[Thing], list[npt.NDArray[np.uint8]]]:
    """Return the meshes and photographs (h, w, 3) of a file."""
    with np.load(path) as found:
        names = [key.removeprefix("vertices: ") for key in found.files if key.startswith("vertices: ")]
        things = [
            Thing(name, found[f"vertices: {name}"].astype(np.float64), found[f"triangles: {name}"].astype(np.int64))
            for name in sorted(names)
        ]
        return things, list(found["pictures"])


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the file."""
    parser = argparse.ArgumentParser(
        prog="python -m studies whole.things",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("wheels", nargs="+", type=Path, metavar="WHEEL")
    parser.add_argument("--out", type=Path, required=True, help="file to write")
    options = parser.parse_args(arguments)
    from studies.whole.shapes import KINDS

    arrays: dict[str, npt.NDArray[np.generic]] = {}
    pictures = []
    for path in sorted(options.wheels):
        with zipfile.ZipFile(path) as wheel, tempfile.TemporaryDirectory() as folder:
            for name, mesh in _meshes(wheel, Path(folder)):
                thing = _small(name, mesh)
                arrays[f"vertices: {name}"] = thing.vertices.astype(np.float32)
                arrays[f"triangles: {name}"] = thing.triangles.astype(np.uint16)
            pictures += list(_pictures(wheel))
    for number in range(_OWN):
        for kind, shape in KINDS.items():
            thing = _small(f"own/{kind} {number:02}", shape(np.random.default_rng([number, len(kind)])))
            arrays[f"vertices: {thing.name}"] = thing.vertices.astype(np.float32)
            arrays[f"triangles: {thing.name}"] = thing.triangles.astype(np.uint16)
    np.savez_compressed(options.out, allow_pickle=False, pictures=np.stack(pictures), **arrays)
    print(f"{options.out}: {len(arrays) // 2} meshes, {len(pictures)} photographs, {options.out.stat().st_size} bytes")
    return 0


def _meshes(wheel: zipfile.ZipFile, folder: Path) -> Iterator[tuple[str, trimesh.Trimesh]]:
    """Yield the meshes of a wheel by name; the folder is empty, for what has to be unpacked."""
    import trimesh

    present = set(wheel.namelist())
    for package, files in _WHOLE.items():
        for file in files:
            path = _FOLDERS[package] + file
            if path not in present:
                continue
            if path.endswith(".usd"):
                found = _of_usd(Path(wheel.extract(path, folder)))
            else:
                kind = path.rsplit(".", 1)[1]
                found = trimesh.load_mesh(io.BytesIO(wheel.read(path)), file_type=kind)
                assert isinstance(found, trimesh.Trimesh)
            yield f"{package}/{file.rsplit('/', 1)[1].split('.')[0]}", found
    if "metaworld/assets/objects/mug.xml" in present:
        wheel.extractall(folder, [name for name in present if name.startswith("metaworld/assets/")])
        yield from _put_together(folder / "metaworld" / "assets" / "objects")


def _of_usd(path: Path) -> trimesh.Trimesh:
    """Return the largest mesh of a file of OpenUSD, z up."""
    import trimesh

    usd: Any = import_module("pxr.Usd")
    geometry: Any = import_module("pxr.UsdGeom")
    found = []
    stage = usd.Stage.Open(str(path))  # its prims do not outlive it
    for prim in stage.Traverse():
        if not prim.IsA(geometry.Mesh):
            continue
        mesh = geometry.Mesh(prim)
        counts = np.array(mesh.GetFaceVertexCountsAttr().Get())
        corners = np.array(mesh.GetFaceVertexIndicesAttr().Get())
        starts = np.cumsum(counts) - counts
        fans = [corners[[s, s + k, s + k + 1]] for s, n in zip(starts, counts, strict=True) for k in range(1, n - 1)]
        found.append(trimesh.Trimesh(np.array(mesh.GetPointsAttr().Get())[:, [2, 0, 1]], np.array(fans)))
    return max(found, key=lambda mesh: len(mesh.faces))


def _put_together(folder: Path) -> Iterator[tuple[str, trimesh.Trimesh]]:
    """Yield the objects of Meta-World, of meshes and simple bodies as MuJoCo places them, by name."""
    from studies.whole.shapes import joined

    mujoco: Any = import_module("mujoco")
    for path in sorted(folder.glob("*.xml")):
        try:
            model = mujoco.MjModel.from_xml_path(str(path))
        except ValueError as error:  # what MuJoCo no longer reads
            print(f"{path.name}: left out: {str(error).splitlines()[0]}", file=sys.stderr)
            continue
        state = mujoco.MjData(model)
        mujoco.mj_forward(model, state)
        parts = []
        for geom in range(model.ngeom):
            root = model.body(model.body_rootid[model.geom_bodyid[geom]]).name
            if model.geom_group[geom] >= 3 or root in _ROOM:  # 3 and more: shapes for collisions only
                continue
            part = _part(model, geom)
            if part is None:
                continue
            world_from_part = np.eye(4)
            world_from_part[:3, :3] = state.geom_xmat[geom].reshape(3, 3)
            world_from_part[:3, 3] = state.geom_xpos[geom]
            part.apply_transform(world_from_part)
            parts.append(part)
        if parts:
            yield f"metaworld/{path.stem}", joined(parts)


def _part(model: Any, geom: int) -> trimesh.Trimesh | None:
    """Return the mesh of a part in its own frame; None for planes."""
    import trimesh

    mujoco: Any = import_module("mujoco")
    kinds = mujoco.mjtGeom
    size = model.geom_size[geom]
    match model.geom_type[geom]:
        case kinds.mjGEOM_MESH:
            mesh = model.geom_dataid[geom]
            first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
            start, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
            return trimesh.Trimesh(
                model.mesh_vert[first : first + count].copy(), model.mesh_face[start : start + faces].copy()
            )
        case kinds.mjGEOM_BOX:
            return trimesh.creation.box(2.0 * size)
        case kinds.mjGEOM_CYLINDER:
            return trimesh.creation.cylinder(size[0], 2.0 * size[1])
        case kinds.mjGEOM_CAPSULE:
            return trimesh.creation.capsule(height=2.0 * size[1], radius=size[0])
        case kinds.mjGEOM_SPHERE:
            return trimesh.creation.icosphere(3, size[0])
        case _:
            return None


def _small(name: str, mesh: trimesh.Trimesh) -> Thing:
    """Return a mesh with few triangles."""
    import open3d as o3d

    mesh.merge_vertices()
    plain = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices), o3d.utility.Vector3iVector(np.asarray(mesh.faces))
    )
    if len(mesh.faces) > _TRIANGLES:
        plain = plain.simplify_quadric_decimation(_TRIANGLES)
    return Thing.of(name, np.asarray(plain.vertices), np.asarray(plain.triangles))


def _pictures(wheel: zipfile.ZipFile) -> Iterator[npt.NDArray[np.uint8]]:
    """Yield the photographs of a wheel, square."""
    from PIL import Image, ImageOps

    present = set(wheel.namelist())
    for folder, files in _PICTURES.items():
        for file in files:
            if folder + file in present:
                image = Image.open(io.BytesIO(wheel.read(folder + file))).convert("RGB")
                yield np.asarray(ImageOps.fit(image, (_PICTURE_PX, _PICTURE_PX)))


if __name__ == "__main__":
    sys.exit(main())
