"""A cluttered table: the object that is sought among others, some of which hide it, seen by the renderer's camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Final, final

import numpy as np
import trimesh

from modeler import se3
from modeler.sequences.meshes import Caster, Mesh, outer_surface
from modeler.sequences.rendering import surroundings
from modeler.sequences.rendering.cameras import DepthSensor, Exposure
from modeler.sequences.rendering.recipe import Viewpoint, builtin_recipes, load_recipe
from modeler.sequences.rendering.shapes import placement
from modeler.types import Array, BoolArray, Frame, ObjectModel, SensorNoise
from studies.calibration.specimens import load_specimen

_SENSOR = DepthSensor()
_UNIT_M = 0.001
_ASIDE = np.linspace(0.0, 1.5, 16)  # places of what hides the object: from before it to where it hides nothing
_NEARER = 0.7  # share of the object's distance at which it is held
VIEW: Final = Viewpoint()
"""The camera, 35° above a table 0.8 m away."""
VIEWS: Final = tuple(
    replace(VIEW, distance_m=distance_m, elevation_deg=elevation_deg)
    for elevation_deg in (35.0, 55.0)
    for distance_m in (0.8, 0.6, 1.1)
)
"""The six cameras of the study."""


@final
@dataclass(frozen=True, eq=False)
class Scene:
    """One image of a table."""

    frame: Frame
    """Depth alone, without a mask."""
    mask: BoolArray
    """(h, w) where the sought object is in front."""
    visible: float
    """Share (0..1) of its pixels that nothing hides; 0 where it is not there."""
    camera_from_model: Array | None
    """(4, 4) the truth; None where it is not there."""


@cache
def shape(name: str) -> Mesh:
    """Return the outer surface of a shape, as it rests on a table about the origin."""
    recipe = load_specimen(name)
    mesh = outer_surface(recipe.object.mesh()).moved(placement((0.0, 0.0, 0.0), recipe.rest_rotation_deg))
    low, high = mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)
    middle = 0.5 * (low + high)
    return mesh.moved(placement((-middle[0], -middle[1], -low[2]), (0.0, 0.0, 0.0)))


@cache
def model_of(name: str) -> ObjectModel:
    """Return the true model of a shape."""
    return exact_model(shape(name).vertices_m, shape(name).triangles)


def exact_model(vertices_m: Array, triangles: np.ndarray) -> ObjectModel:
    """Return a mesh as a model without errors."""
    mesh, empty = trimesh.Trimesh(vertices_m, triangles, process=True), np.zeros((0, 3))
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    return ObjectModel(empty, empty, None, vertices, faces, np.asarray(mesh.vertex_normals, np.float64), None)


def noise(distance_m: float, view: Viewpoint) -> SensorNoise:
    """Return the noise of the camera at a distance."""
    return SensorNoise(*_SENSOR.sigmas(distance_m, view.focal_px, _UNIT_M))


def scene(
    sought: str | None, others: tuple[str, ...], seed: int, *, hidden: float = 0.0, view: Viewpoint = VIEW
) -> Scene:
    """Return an image of shapes that stand on a table, turned and placed as the seed has it.

    Args:
        sought: name of the shape whose truth is returned, in the middle; None: it is not there.
        others: names of those around it.
        seed: of all randomness.
        hidden: share of the object that the first of the others hides, held before it; the rest may, too.
        view: the camera.
    """
    rng = np.random.default_rng(seed)
    camera, camera_from_table = view.camera(), view.camera_from_table()
    rays = np.stack([*camera.rays(), np.ones((camera.height, camera.width))], axis=-1)
    table = surroundings(load_recipe(sorted(builtin_recipes())[0])).moved(camera_from_table)
    placed: list[tuple[Caster, Array]] = [(Caster(table), np.eye(4))]
    whole, seen = np.zeros(rays.shape[:2], dtype=bool), np.zeros(rays.shape[:2], dtype=bool)
    pose: Array | None = None
    reach_m = 0.0 if sought is None else _reach_m(sought)
    around = rng.uniform(0.0, 2.0 * np.pi)
    for number, name in enumerate((sought, *others)):
        if name is None:
            continue
        turn = placement((0.0, 0.0, 0.0), (0.0, 0.0, float(rng.uniform(0.0, 360.0))))
        if number == 0:
            place_m = rng.uniform(-0.03, 0.03, 2)
        elif number == 1 and hidden > 0.0 and pose is not None:  # held between camera and object, to one side
            middle_m = _NEARER * se3.transform(pose, np.array([[0.0, 0.0, _height_m(sought)]]))[0]
            side_m = rng.choice([-1.0, 1.0]) * (reach_m + _reach_m(name)) * np.array([1.0, 0.0, 0.0])
            poses = [camera_from_table @ turn for _ in _ASIDE]
            for one, share in zip(poses, _ASIDE, strict=True):
                one[:3, 3] = middle_m + share * side_m - one[:3, 2] * _height_m(name)
            caster = Caster(shape(name))
            shares = [_share_hidden(placed[1], (caster, one), rays[::4, ::4]) for one in poses]
            placed.append((caster, poses[int(np.argmin(np.abs(np.array(shares) - hidden)))]))
            continue
        else:
            angle = around + 2.0 * np.pi * number / len(others) + rng.uniform(-0.3, 0.3)
            apart_m = reach_m + _reach_m(name) + rng.uniform(0.02, 0.08)
            place_m = apart_m * np.array([np.cos(angle), np.sin(angle)])
        placed.append((Caster(shape(name)), camera_from_table @ se3.translation(np.array([*place_m, 0.0])) @ turn))
        if number == 0:
            pose = placed[-1][1]
    looked, nearest = None, np.full(rays.shape[:2], np.inf)
    for number, (caster, camera_from_mesh) in enumerate(placed):
        hits = caster.cast(rays, camera_from_mesh)
        first = np.where(np.isnan(hits.depth_m), np.inf, hits.depth_m) < nearest
        nearest = np.where(first, hits.depth_m, nearest)
        looked = hits if looked is None else hits.over(looked, first)
        if pose is not None and number == 1:
            whole = np.isfinite(hits.depth_m)
        seen = first if number == 1 and pose is not None else seen & ~first
    assert looked is not None
    lamp_m = np.array([_SENSOR.baseline_m, 0.0, 0.0])
    shadowed = np.zeros(rays.shape[:2], dtype=bool)
    for caster, camera_from_mesh in placed:
        shadowed |= caster.blocks(lamp_m, looked.points_m, camera_from_mesh)
    exposure = Exposure(looked.depth_m, looked.incidence_rad, shadowed)
    depth_m = _SENSOR.measure(exposure, view.focal_px, rng)
    visible = float(np.count_nonzero(seen & whole) / max(np.count_nonzero(whole), 1))
    return Scene(Frame(seed, float(seed), depth_m, camera), seen & whole, visible if pose is not None else 0.0, pose)


def _share_hidden(thing: tuple[Caster, Array], before: tuple[Caster, Array], rays: Array) -> float:
    """Return the share of a thing that another hides, both as casters with camera_from_mesh, seen along rays (…, 3)."""
    far_m, near_m = (caster.cast(rays, pose).depth_m for caster, pose in (thing, before))
    shown = np.isfinite(far_m)
    return float(np.count_nonzero(near_m[shown] < far_m[shown]) / max(np.count_nonzero(shown), 1))


def _height_m(name: str | None) -> float:
    """Return half the height of a shape on the table."""
    return 0.0 if name is None else 0.5 * float(shape(name).vertices_m[:, 2].max())


def _reach_m(name: str) -> float:
    """Return the radius of a shape on the table."""
    return float(np.linalg.norm(shape(name).vertices_m[:, :2], axis=1).max())


def mssd_m(model: ObjectModel, found: Array, truth: Array, symmetries: tuple[Array, ...] = ()) -> float:
    """Return BOP's maximum symmetry-aware surface distance of a pose (4, 4) in m.

    Args:
        model: whose vertices are compared.
        found: camera_from_model.
        truth: camera_from_model.
        symmetries: (4, 4) rotations of the model onto itself, besides none.
    """
    vertices_m = model.vertices_m[:: max(len(model.vertices_m) // 2000, 1)]
    at = se3.transform(found, vertices_m)
    turns = (np.eye(4), *symmetries)
    return float(min(np.linalg.norm(at - se3.transform(truth @ turn, vertices_m), axis=1).max() for turn in turns))
