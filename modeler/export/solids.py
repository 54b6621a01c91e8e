"""Models as solid bodies: mass, inertia, convex parts, and MJCF (MuJoCo), URDF and SDF (Gazebo) for simulators."""

from __future__ import annotations

import importlib
import importlib.util
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from modeler.export.files import write_atomically
from modeler.export.mesh import simplified
from modeler.system.processes import install_command
from modeler.types import Array, InputError, ObjectModel, area_vectors_m2, areas_m2

HULL_TRIANGLES = 500  # most triangles of a convex part; a ball then loses 3 % of its volume
# For CoACD: of a bear of 0.13 m, 1500 triangles became 15 parts with 5 % more volume in 9 s on two busy cores; with its
# own settings and 8000 triangles, 70 parts in five minutes.
_SEARCH: Mapping[str, Any] = {"threshold": 0.08, "resolution": 800, "mcts_nodes": 10, "mcts_iterations": 30}


@dataclass(frozen=True, eq=False)
class Body:
    """Physical properties of a rigid body of uniform density."""

    mass_kg: float
    centre_m: Array
    """(3,) centre of mass in the frame of the mesh."""
    inertia_kg_m2: Array
    """(3, 3) moments of inertia about the centre of mass, along the axes of the mesh."""
    volume_m3: float


def body_of(model: ObjectModel, *, density_kg_m3: float, mass_kg: float | None = None) -> Body:
    """Return mass, centre and inertia of the solid that a closed mesh encloses, by integrals over its volume.

    Args:
        model: with a closed mesh.
        density_kg_m3: mass per volume.
        mass_kg: mass, where it is known: the density then follows from it.

    Raises:
        InputError: if the mesh encloses no volume.
    """
    import trimesh

    mesh = trimesh.Trimesh(model.vertices_m, model.triangles, process=False)
    if not mesh.is_watertight or not mesh.is_winding_consistent or mesh.volume <= 0.0:
        raise InputError("the closed mesh encloses no volume; more views are needed for a solid")
    mesh.density = density_kg_m3 if mass_kg is None else mass_kg / mesh.volume
    found = mesh.mass_properties
    return Body(
        float(found.mass), np.asarray(found.center_mass, float), np.asarray(found.inertia, float), float(mesh.volume)
    )


def is_possible_inertia(inertia: Array) -> bool:
    """Return whether a body can have such moments (3, 3): positive, none larger than the sum of the others."""
    moments = np.linalg.eigvalsh(inertia)
    return bool(moments[0] > 0.0 and moments[2] <= (moments[0] + moments[1]) * (1.0 + 1e-9))


@dataclass(frozen=True, eq=False)
class ConvexParts:
    """Convex meshes that together stand for a body in collisions."""

    meshes: tuple[tuple[Array, npt.NDArray[np.int64]], ...]
    """Vertices (v, 3) in m and triangles (t, 3) of each."""
    method: str
    """How they were found, in words."""


def convex_parts(model: ObjectModel) -> ConvexParts:
    """Return convex parts of a closed mesh: by CoACD where it is installed, else one convex hull.

    CoACD: Wei et al. 2022, "Approximate convex decomposition for 3D meshes with collision-aware concavity and tree
    search".
    """
    if importlib.util.find_spec("coacd") is None:
        hull = _hull(model.vertices_m)
        return ConvexParts((hull,), f"one convex hull, as CoACD is not installed ({install_command('physics')})")
    import coacd  # pyright: ignore[reportMissingImports]

    coacd.set_log_level("error")
    coarse = simplified(model, 1_500)
    mesh = coacd.Mesh(coarse.vertices_m, coarse.triangles.astype(np.int32))
    found = coacd.run_coacd(mesh, seed=0, **_SEARCH)
    parts = tuple(_hull(np.asarray(vertices, dtype=np.float64)) for vertices, _ in found)
    return ConvexParts(parts, f"{len(parts)} convex part{'s' if len(parts) != 1 else ''} by CoACD")


def _hull(points_m: Array) -> tuple[Array, npt.NDArray[np.int64]]:
    """Return the convex hull of points (n, 3), simplified to `HULL_TRIANGLES`: vertices and triangles."""
    import open3d as o3d
    import trimesh

    hull = trimesh.convex.convex_hull(points_m)
    if len(hull.faces) > HULL_TRIANGLES:
        fine = o3d.geometry.TriangleMesh(
            o3d.utility.Vector3dVector(hull.vertices), o3d.utility.Vector3iVector(hull.faces.astype(np.int32))
        )
        coarse = fine.simplify_quadric_decimation(HULL_TRIANGLES)
        hull = trimesh.convex.convex_hull(np.asarray(coarse.vertices))
    return np.asarray(hull.vertices, dtype=np.float64), np.asarray(hull.faces, dtype=np.int64)


def without_degenerate(model: ObjectModel) -> ObjectModel:
    """Return the model without triangles that have no area."""
    kept = areas_m2(model.vertices_m, model.triangles) > 1e-12  # (1 µm)², below the resolution of a 32-bit file at 10 m
    return model if kept.all() else replace(model, triangles=model.triangles[kept])


def with_flat_bottom(model: ObjectModel, laid_m: float | None) -> ObjectModel:
    """Return a closed mesh, z up, that stands flat on the plane z = 0; its topology stays.

    Args:
        model: closed, with its base about z = 0.
        laid_m: vertices less than this above a support at z = 0, or below it, are moved onto it; a voxel, within which
            closed bottoms follow the support. None: no support was seen, and the object is cut 2 % of its height above
            its lowest vertex.
    """
    height_m = model.vertices_m[:, 2]
    if laid_m is None:
        level_m = onto_m = float(height_m.min() + 0.02 * np.ptp(height_m))
    else:
        level_m, onto_m = laid_m, 0.0
    vertices_m = model.vertices_m.copy()
    vertices_m[height_m < level_m, 2] = onto_m
    vertices_m[:, 2] -= onto_m
    return replace(model, vertices_m=vertices_m)


def bottom_area_m2(vertices_m: Array, triangles: npt.NDArray[np.int64]) -> float:
    """Return the area of the triangles that lie in the plane z = 0 and face down."""
    flat = triangles[np.all(np.abs(vertices_m[triangles][:, :, 2]) < 1e-7, axis=1)]
    return max(0.0, -float(area_vectors_m2(vertices_m, flat)[:, 2].sum()))


FRICTION: Final = (0.8, 0.005, 0.0001)
"""Sliding, torsional (m) and rolling (m): of wood or cardboard on a table; MuJoCo's defaults but for the first."""
MOST_TRIANGLES: Final = 200_000  # MuJoCo refuses meshes with more


MUJOCO_SCENE: Final = "scene.xml"  # file of the model on a plane
GAZEBO: Final = ("model.sdf", "model.config")  # files of the model, and of what Gazebo's list of models says of it


@dataclass(frozen=True)
class PhysicsFiles:
    """Where the parts of a model for simulators lie in its folder."""

    folder: Path
    """The folder; the model goes by its name."""
    coloured: bool
    """Whether the visual mesh has a texture."""

    @property
    def name(self) -> str:
        """Name of the body, in letters that every program takes."""
        return re.sub(r"[^A-Za-z0-9_]+", "_", self.folder.resolve().name).strip("_") or "object"

    @property
    def visual(self) -> Path:
        """The mesh that is shown."""
        return self.folder / "visual.obj"

    @property
    def texture(self) -> Path:
        """The image around it."""
        return self.folder / "visual.png"

    def model(self, suffix: str) -> Path:
        """Return the model in the format of a suffix: `.xml` (MuJoCo), `.urdf` or `.usd`."""
        return self.folder / f"{self.name}{suffix}"

    def part(self, number: int) -> Path:
        """Return a convex part."""
        return self.folder / f"part_{number:03d}.obj"


def write_parts(files: PhysicsFiles, parts: ConvexParts) -> None:
    """Write convex parts as OBJ files without normals."""
    for number, (vertices_m, triangles) in enumerate(parts.meshes):
        lines = [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in vertices_m]
        lines += [f"f {a} {b} {c}" for a, b, c in triangles + 1]
        write_atomically(files.part(number), "\n".join([*lines, ""]))


def write_mjcf(files: PhysicsFiles, body: Body, parts: ConvexParts) -> None:
    """Write the object as a free body, and a scene that puts it on a plane."""
    name, count = files.name, len(parts.meshes)
    xx, yy, zz, xy, xz, yz = _six(body.inertia_kg_m2)
    friction = _numbers(np.array(FRICTION))
    texture = (
        f'    <texture name="{name}" type="2d" file="{files.texture.name}"/>\n'
        f'    <material name="{name}" texture="{name}"/>\n'
    )
    part_assets = "".join(f'    <mesh name="{name}_{k}" file="{files.part(k).name}"/>\n' for k in range(count))
    geoms = "".join(
        f'      <geom type="mesh" mesh="{name}_{k}" group="3" friction="{friction}"/>\n' for k in range(count)
    )
    look = f'material="{name}"' if files.coloured else 'rgba="0.7 0.7 0.7 1"'
    write_atomically(
        files.model(".xml"),
        f'<mujoco model="{name}">\n'
        "  <asset>\n"
        f"{texture if files.coloured else ''}"
        f'    <mesh name="{name}_visual" file="{files.visual.name}"/>\n'
        f"{part_assets}"
        "  </asset>\n"
        "  <worldbody>\n"
        f'    <body name="{name}" pos="0 0 {drop_height_m(parts):.6g}">\n'
        "      <freejoint/>\n"
        f'      <inertial pos="{_numbers(body.centre_m)}" mass="{body.mass_kg:.8g}"'
        f' fullinertia="{_numbers(np.array([xx, yy, zz, xy, xz, yz]))}"/>\n'
        f'      <geom type="mesh" mesh="{name}_visual" {look} contype="0" conaffinity="0" group="2"/>\n'
        f"{geoms}"
        "    </body>\n"
        "  </worldbody>\n"
        "</mujoco>\n",
    )
    write_atomically(
        files.folder / MUJOCO_SCENE,
        f'<mujoco model="{name} on a plane">\n'
        f'  <include file="{files.model(".xml").name}"/>\n'
        "  <worldbody>\n"
        '    <light pos="0 0 1.5" dir="0 0 -1" directional="true"/>\n'
        '    <geom name="ground" type="plane" size="0 0 0.05" rgba="0.4 0.45 0.5 1"/>\n'
        "  </worldbody>\n"
        "</mujoco>\n",
    )


def write_urdf(files: PhysicsFiles, body: Body, parts: ConvexParts) -> None:
    """Write the object as a robot of one link."""
    xx, yy, zz, xy, xz, yz = (f"{value:.8g}" for value in _six(body.inertia_kg_m2))
    collisions = "".join(
        f'    <collision><geometry><mesh filename="{files.part(k).name}"/></geometry></collision>\n'
        for k in range(len(parts.meshes))
    )
    write_atomically(
        files.model(".urdf"),
        '<?xml version="1.0"?>\n'
        f'<robot name="{files.name}">\n'
        f'  <link name="{files.name}">\n'
        "    <!-- PyBullet reads contact; other programs pass over it -->\n"
        f'    <contact><lateral_friction value="{FRICTION[0]:g}"/><spinning_friction value="{FRICTION[1]:g}"/>'
        f'<rolling_friction value="{FRICTION[2]:g}"/></contact>\n'
        "    <inertial>\n"
        f'      <origin xyz="{_numbers(body.centre_m)}" rpy="0 0 0"/>\n'
        f'      <mass value="{body.mass_kg:.8g}"/>\n'
        f'      <inertia ixx="{xx}" ixy="{xy}" ixz="{xz}" iyy="{yy}" iyz="{yz}" izz="{zz}"/>\n'
        "    </inertial>\n"
        f'    <visual><geometry><mesh filename="{files.visual.name}"/></geometry></visual>\n'
        f"{collisions}"
        "  </link>\n"
        "</robot>\n",
    )


def write_sdf(files: PhysicsFiles, body: Body, parts: ConvexParts) -> None:
    """Write the object as a model of Gazebo: SDF with its `model.config`. Meshes are found relative to it."""
    name = files.name
    xx, yy, zz, xy, xz, yz = (f"{value:.8g}" for value in _six(body.inertia_kg_m2))
    mesh = "<geometry><mesh><uri>{}</uri></mesh></geometry>".format
    friction = f"<surface><friction><ode><mu>{FRICTION[0]:g}</mu><mu2>{FRICTION[0]:g}</mu2></ode></friction></surface>"
    collisions = "".join(
        f'      <collision name="part_{k:03d}">{mesh(files.part(k).name)}{friction}</collision>\n'
        for k in range(len(parts.meshes))
    )
    write_atomically(
        files.folder / GAZEBO[0],
        '<?xml version="1.0"?>\n'
        '<sdf version="1.7">\n'
        f'  <model name="{name}">\n'
        '    <link name="link">\n'
        "      <inertial>\n"
        f"        <pose>{_numbers(body.centre_m)} 0 0 0</pose>\n"
        f"        <mass>{body.mass_kg:.8g}</mass>\n"
        f"        <inertia><ixx>{xx}</ixx><ixy>{xy}</ixy><ixz>{xz}</ixz>"
        f"<iyy>{yy}</iyy><iyz>{yz}</iyz><izz>{zz}</izz></inertia>\n"
        "      </inertial>\n"
        f'      <visual name="visual">{mesh(files.visual.name)}</visual>\n'
        f"{collisions}"
        "    </link>\n"
        "  </model>\n"
        "</sdf>\n",
    )
    write_atomically(
        files.folder / GAZEBO[1],
        '<?xml version="1.0"?>\n'
        "<model>\n"
        f"  <name>{name}</name>\n"
        "  <version>1.0</version>\n"
        f'  <sdf version="1.7">{GAZEBO[0]}</sdf>\n'
        "</model>\n",
    )


def _six(inertia: Array) -> tuple[float, ...]:
    """Return xx, yy, zz, xy, xz, yz of a symmetric matrix (3, 3)."""
    return tuple(float(inertia[place]) for place in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))


def _numbers(values: Array) -> str:
    return " ".join(f"{value:.8g}" for value in values)


@dataclass(frozen=True)
class Settled:
    """How an object came to rest on a plane."""

    program: str
    """Simulator with its version."""
    speed_m_s: float
    """Speed at the end."""
    shift_m: float
    """How far its centre of mass moved sideways."""
    tilt_deg: float
    """How far its z axis turned away from where it was."""

    @property
    def words(self) -> str:
        """The same in a sentence."""
        rest = "at rest" if self.at_rest else f"still moving at {1000.0 * self.speed_m_s:.0f} mm/s"
        return (
            f"{self.program} loads it; on a plane it is {rest} after 2 s, "
            f"{1000.0 * self.shift_m:.1f} mm aside and {self.tilt_deg:.1f}° tilted"
        )

    @property
    def at_rest(self) -> bool:
        """Whether it no longer moves by more than contact solvers jitter."""
        return self.speed_m_s < 0.01


def settled_in_mujoco(scene: Path) -> Settled:
    """Load a scene in MuJoCo and let the object come to rest; `Checks.attempt` takes what this raises."""
    mujoco: Any = importlib.import_module("mujoco")  # its types are known only where it is installed

    model = mujoco.MjModel.from_xml_path(str(scene))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    start = data.xipos[1].copy()
    upright = data.xmat[1].reshape(3, 3)[:, 2].copy()
    for _ in range(round(2.0 / model.opt.timestep)):
        mujoco.mj_step(model, data)
    shift = data.xipos[1] - start
    axis = data.xmat[1].reshape(3, 3)[:, 2]
    speed = float(np.linalg.norm(data.qvel[:3]))
    return Settled(f"MuJoCo {mujoco.__version__}", speed, float(np.hypot(*shift[:2])), _angle_deg(upright, axis))


def settled_in_pybullet(urdf: Path, drop_m: float) -> Settled:
    """Load a URDF in PyBullet, at a height, and let it come to rest; `Checks.attempt` takes what this raises."""
    import pybullet  # pyright: ignore[reportMissingImports]

    client = pybullet.connect(pybullet.DIRECT)
    try:
        pybullet.setGravity(0.0, 0.0, -9.81, physicsClientId=client)
        plane = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
        pybullet.createMultiBody(0.0, plane, physicsClientId=client)
        try:
            body = pybullet.loadURDF(
                str(urdf), [0.0, 0.0, drop_m], flags=pybullet.URDF_USE_INERTIA_FROM_FILE, physicsClientId=client
            )
        except pybullet.error as error:
            raise ValueError(str(error)) from error
        start, turn = pybullet.getBasePositionAndOrientation(body, physicsClientId=client)
        upright = np.reshape(pybullet.getMatrixFromQuaternion(turn), (3, 3))[:, 2]
        for _ in range(2 * 240):
            pybullet.stepSimulation(physicsClientId=client)
        place, turn = pybullet.getBasePositionAndOrientation(body, physicsClientId=client)
        axis = np.reshape(pybullet.getMatrixFromQuaternion(turn), (3, 3))[:, 2]
        speed = float(np.linalg.norm(pybullet.getBaseVelocity(body, physicsClientId=client)[0]))
        shift = np.subtract(place, start)
    finally:
        pybullet.disconnect(physicsClientId=client)
    return Settled("PyBullet", speed, float(np.hypot(*shift[:2])), _angle_deg(upright, axis))


def drop_height_m(parts: ConvexParts) -> float:
    """Return the height of the origin at which the lowest vertex of the parts is just above the ground."""
    return 0.001 - min(float(vertices_m[:, 2].min()) for vertices_m, _ in parts.meshes)


def _angle_deg(one: Array, other: Array) -> float:
    return float(np.degrees(np.arccos(np.clip(one @ other, -1.0, 1.0))))
