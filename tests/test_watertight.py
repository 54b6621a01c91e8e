"""Watertight models of what stands on a table: made-up surface ends there."""

from dataclasses import replace

import numpy as np
import pytest
import tabletop
import trimesh

from modeler import se3
from modeler.fusion import Fuser, FusionVolume, watertight
from modeler.types import Array, Plane

VOXEL_M = 0.0025
FUSER = Fuser(voxel_m=VOXEL_M)
BRICK = tabletop.Box((0.07, 0.05, 0.04))
POSES = tabletop.turntable(14)


def plane(camera_from_model: Array, height_m: float = -BRICK.half_m[2]) -> Plane:
    """Return a level plane of the model frame as a camera sees it."""
    normal = camera_from_model[:3, 2]
    return Plane(normal, float(-normal @ (camera_from_model[:3, 3] + height_m * normal)), 0.005, 0.001)


def volume_of(planes: list[Plane], object_from_model: Array | None = None) -> FusionVolume:
    views = tabletop.views(BRICK, POSES)
    views = {k: replace(view, plane=planes[k]) for k, view in views.items()}
    return FUSER.volume(views, tabletop.trajectory(POSES, object_from_model))


def support_planes_of(volume: FusionVolume) -> Array:
    return watertight.support_planes(volume.views, volume.grid.corners_m, volume.tau_m)


@pytest.mark.parametrize("seed", range(2))
def test_a_watertight_model_stands_on_its_table(seed: int) -> None:
    rng = np.random.default_rng(seed)
    object_from_model = se3.exp(rng.normal(size=6) * [1, 1, 1, 0.1, 0.1, 0.1])
    model = volume_of([plane(pose) for pose in POSES], object_from_model).model(watertight=True)
    mesh = trimesh.Trimesh(model.vertices_m, model.triangles, process=False)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(8.0 * np.prod(BRICK.half_m), rel=0.01)
    vertices_m = se3.transform(se3.inverse(object_from_model), model.vertices_m)
    assert model.vertex_views is not None
    under = (np.abs(vertices_m[:, :2]) < 0.04).all(axis=1) & (vertices_m[:, 2] < 0.0)
    assert (model.vertex_views[under] == 0).all()
    np.testing.assert_allclose(vertices_m[under, 2], -BRICK.half_m[2], atol=0.5 * VOXEL_M)
    assert vertices_m[:, 2].min() > -BRICK.half_m[2] - 0.25 * VOXEL_M  # smoothing rounds edges


def test_planes_that_are_alike_are_one_table_and_one_view_makes_none() -> None:
    rng = np.random.default_rng(0)
    planes = [plane(pose, -BRICK.half_m[2] + rng.normal(0.0, 3e-4)) for pose in POSES]
    (table,) = support_planes_of(volume_of(planes))
    np.testing.assert_allclose(table, [0.0, 0.0, 1.0, BRICK.half_m[2]], atol=3e-4)
    wrong = replace(planes[5], offset_m=planes[5].offset_m - 0.03)
    (same,) = support_planes_of(volume_of([*planes[:5], wrong, *planes[6:]]))
    np.testing.assert_allclose(same, table, atol=3e-4)


def test_an_object_that_lay_two_ways_stood_on_two_tables() -> None:
    on_end = [
        Plane(pose[:3, 0], float(-pose[:3, 0] @ (pose[:3, 3] - 0.07 * pose[:3, 0])), 0.005, 1e-3) for pose in POSES
    ]
    found = support_planes_of(volume_of([plane(pose) if k < 9 else on_end[k] for k, pose in enumerate(POSES)]))
    np.testing.assert_allclose(found, [[0.0, 0.0, 1.0, 0.04], [1.0, 0.0, 0.0, 0.07]], atol=1e-9)


def test_what_reaches_below_a_plane_does_not_stand_on_it() -> None:
    volume = volume_of([plane(pose, -0.02) for pose in POSES])
    assert len(support_planes_of(volume)) == 0
    low_m = volume.model(watertight=True).vertices_m[:, 2].min()
    assert low_m < -0.035
