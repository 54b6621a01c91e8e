"""A model for simulators: MJCF (MuJoCo) and URDF, with meshes, mass, inertia, convex parts and friction."""

from __future__ import annotations

import importlib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from modeler.export.files import write_atomically
from modeler.export.solids import Body, ConvexParts
from modeler.types import Array

FRICTION: Final = (0.8, 0.005, 0.0001)
"""Sliding, torsional (m) and rolling (m): of wood or cardboard on a table; MuJoCo's defaults but for the first."""
MOST_TRIANGLES: Final = 200_000
"""MuJoCo refuses meshes with more."""
_DROP_M = 1e-3  # height above the ground at which the object starts in the scene


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

    @property
    def mjcf(self) -> Path:
        """The model for MuJoCo."""
        return self.folder / f"{self.name}.xml"

    @property
    def scene(self) -> Path:
        """The model on a plane, for MuJoCo."""
        return self.folder / "scene.xml"

    @property
    def urdf(self) -> Path:
        """The model as URDF."""
        return self.folder / f"{self.name}.urdf"

    def part(self, number: int) -> Path:
        """Return a convex part."""
        return self.folder / f"part_{number:03d}.obj"


def write_parts(files: PhysicsFiles, parts: ConvexParts) -> None:
    """Write convex parts as OBJ files without normals.

    Raises:
        InputError: if a file cannot be written.
    """
    for number, (vertices_m, triangles) in enumerate(parts.meshes):
        lines = [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in vertices_m]
        lines += [f"f {a} {b} {c}" for a, b, c in triangles + 1]
        write_atomically(files.part(number), "\n".join([*lines, ""]))


def write_mjcf(files: PhysicsFiles, body: Body, parts: ConvexParts) -> None:
    """Write the object as a free body, and a scene that puts it on a plane.

    Raises:
        InputError: if a file cannot be written.
    """
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
        files.mjcf,
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
        files.scene,
        f'<mujoco model="{name} on a plane">\n'
        f'  <include file="{files.mjcf.name}"/>\n'
        "  <worldbody>\n"
        '    <light pos="0 0 1.5" dir="0 0 -1" directional="true"/>\n'
        '    <geom name="ground" type="plane" size="0 0 0.05" rgba="0.4 0.45 0.5 1"/>\n'
        "  </worldbody>\n"
        "</mujoco>\n",
    )


def write_urdf(files: PhysicsFiles, body: Body, parts: ConvexParts) -> None:
    """Write the object as a robot of one link.

    Raises:
        InputError: if the file cannot be written.
    """
    xx, yy, zz, xy, xz, yz = (f"{value:.8g}" for value in _six(body.inertia_kg_m2))
    collisions = "".join(
        f'    <collision><geometry><mesh filename="{files.part(k).name}"/></geometry></collision>\n'
        for k in range(len(parts.meshes))
    )
    write_atomically(
        files.urdf,
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


_SECONDS = 2.0


def settled_in_mujoco(scene: Path) -> Settled:
    """Load a scene in MuJoCo and let the object come to rest.

    Raises:
        ImportError: if MuJoCo is not installed.
        ValueError: if it rejects the file.
    """
    mujoco: Any = importlib.import_module("mujoco")  # its types are known only where it is installed

    model = mujoco.MjModel.from_xml_path(str(scene))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    start = data.xipos[1].copy()
    upright = data.xmat[1].reshape(3, 3)[:, 2].copy()
    for _ in range(round(_SECONDS / model.opt.timestep)):
        mujoco.mj_step(model, data)
    shift = data.xipos[1] - start
    axis = data.xmat[1].reshape(3, 3)[:, 2]
    speed = float(np.linalg.norm(data.qvel[:3]))
    return Settled(f"MuJoCo {mujoco.__version__}", speed, float(np.hypot(*shift[:2])), _angle_deg(upright, axis))


def settled_in_pybullet(urdf: Path, drop_m: float) -> Settled:
    """Load a URDF in PyBullet and let the object come to rest.

    Args:
        urdf: the file.
        drop_m: height of the link's origin at which it starts.

    Raises:
        ImportError: if PyBullet is not installed.
        ValueError: if it rejects the file.
    """
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
        for _ in range(round(_SECONDS * 240.0)):
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
    return _DROP_M - min(float(vertices_m[:, 2].min()) for vertices_m, _ in parts.meshes)


def _angle_deg(one: Array, other: Array) -> float:
    return float(np.degrees(np.arccos(np.clip(one @ other, -1.0, 1.0))))
