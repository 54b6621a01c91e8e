"""Smoothing of meshes: where views know the surface badly, and along the seam with what is made up."""

import numpy as np
import pytest
import trimesh

from modeler.fusion import meshing, watertight
from modeler.types import Array

RADIUS_M, NOISE_M = 0.05, 0.0004
BALL = trimesh.creation.icosphere(5, RADIUS_M)
TRIANGLES = np.asarray(BALL.faces, dtype=np.int64)
EDGE_M = float(np.mean(BALL.edges_unique_length))


def rough(rng: np.random.Generator) -> Array:
    """Return the ball's vertices, off along their normals."""
    return np.asarray(BALL.vertices * (1.0 + rng.normal(0.0, NOISE_M / RADIUS_M, (len(BALL.vertices), 1))))


def off_m(vertices_m: Array) -> Array:
    return np.linalg.norm(vertices_m, axis=1) - RADIUS_M


def test_only_vertices_asked_for_are_smoothed_and_nothing_shrinks(rng: np.random.Generator) -> None:
    vertices_m = rough(rng)
    before_m = vertices_m.copy()
    only = vertices_m[:, 2] > 0.0
    smooth_m = meshing.taubin_smoothed(vertices_m, TRIANGLES, meshing.WEAK_PASSES, only)
    np.testing.assert_array_equal(smooth_m[~only], before_m[~only])
    np.testing.assert_array_equal(vertices_m, before_m)
    assert off_m(smooth_m[only]).std() < 0.5 * off_m(before_m[only]).std()
    assert abs(off_m(smooth_m[only]).mean()) < 1e-3 * RADIUS_M
    everywhere_m = meshing.taubin_smoothed(vertices_m, TRIANGLES, 3)
    np.testing.assert_allclose(
        meshing.taubin_smoothed(vertices_m, TRIANGLES, 3, np.ones_like(only)), everywhere_m, atol=1e-12
    )


def test_grown_marks_reach_as_many_rings_as_asked() -> None:
    one = np.zeros(len(BALL.vertices), dtype=bool)
    one[0] = True
    np.testing.assert_array_equal(meshing.dilated(one, TRIANGLES, 0), one)
    ring = meshing.dilated(one, TRIANGLES, 1)
    assert set(np.flatnonzero(ring)) == {0, *BALL.vertex_neighbors[0]}
    np.testing.assert_array_equal(meshing.dilated(one, TRIANGLES, 2), meshing.dilated(ring, TRIANGLES, 1))


@pytest.mark.parametrize("weak_above_m", [np.inf, 0.03])
def test_crumbs_along_the_seam_and_where_views_know_little_are_smoothed(
    rng: np.random.Generator, weak_above_m: float
) -> None:
    """The upper half was seen, with crumbs along the equator."""
    vertices_m = rough(rng)
    crumbs = (np.abs(vertices_m[:, 2]) < 2.0 * EDGE_M) & (rng.random(len(vertices_m)) < 0.3)
    vertices_m[crumbs] *= 1.0 + 0.5 * EDGE_M / RADIUS_M
    seen_m = vertices_m[vertices_m[:, 2] > 0.0]
    weak = seen_m[:, 2] > weak_above_m
    found_m, triangles, shown = watertight.cleaned(vertices_m, TRIANGLES, seen_m, weak, voxel_m=0.5 * EDGE_M, passes=0)
    np.testing.assert_array_equal(np.sort(triangles), np.sort(TRIANGLES))
    np.testing.assert_array_equal(shown, vertices_m[:, 2] > 0.0)
    equator = np.abs(vertices_m[:, 2]) < EDGE_M
    assert off_m(found_m[equator]).std() < 0.5 * off_m(vertices_m[equator]).std()
    top, between = vertices_m[:, 2] > 0.035, (vertices_m[:, 2] > 0.015) & (vertices_m[:, 2] < 0.025)
    np.testing.assert_array_equal(found_m[between], vertices_m[between])
    if np.isinf(weak_above_m):
        np.testing.assert_array_equal(found_m[top], vertices_m[top])
    else:
        assert off_m(found_m[top]).std() < 0.5 * off_m(vertices_m[top]).std()
