"""Laws of the figures of models: a surface against itself, moved, halved, and what of it frames saw."""

import numpy as np
import pytest
import trimesh
from scipy import stats

from modeler import se3
from modeler.evaluation import SurfaceErrors, TrueSurface, sample_surface, surface_errors
from modeler.types import Array, Camera, Frame

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


def _parts(mesh: trimesh.Trimesh) -> tuple[Array, np.ndarray]:
    return np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int64)


def _plate(width_m: float = 0.1) -> tuple[Array, np.ndarray]:
    corners = np.array([[0.0, 0.0, 0.0], [width_m, 0.0, 0.0], [width_m, 0.1, 0.0], [0.0, 0.1, 0.0]])
    return corners, np.array([[0, 1, 2], [0, 2, 3]])


def _errors(mesh: tuple[Array, np.ndarray], truth: tuple[Array, np.ndarray]) -> SurfaceErrors:
    surface = TrueSurface.of(*truth, np.random.default_rng(0), count=4000)
    return surface_errors(*mesh, surface, np.random.default_rng(1))


@pytest.mark.parametrize("seed", range(3))
def test_a_mesh_against_itself_scores_one_wherever_it_lies(seed: int) -> None:
    rng = np.random.default_rng(seed)
    vertices, triangles = _parts(trimesh.creation.icosphere(subdivisions=2, radius=0.05))
    vertices = se3.transform(se3.exp(rng.normal(size=6)), vertices * rng.uniform(0.5, 2.0, size=3))
    errors = _errors((vertices, triangles), (vertices, triangles))
    assert errors.accuracy_m < 1e-6
    assert errors.completeness_m < 1e-6
    assert errors.accurate(1e-5) == errors.complete(1e-5) == errors.f_score(1e-5) == 1.0


def test_shifted_by_ten_millimetres_scores_nothing_at_three() -> None:
    corners, triangles = _plate()
    errors = _errors((corners + np.array([0.0, 0.0, 0.01]), triangles), (corners, triangles))
    assert (errors.accuracy_m, errors.completeness_m) == pytest.approx((0.01, 0.01))
    assert errors.accurate(0.003) == errors.complete(0.003) == errors.f_score(0.003) == 0.0
    assert errors.f_score(0.0101) == 1.0
    ball, faces = _parts(trimesh.creation.icosphere(subdivisions=3, radius=0.05))
    assert _errors((1.2 * ball, faces), (ball, faces)).f_score(0.003) == 0.0  # 10 mm too large all round


def test_half_a_mesh_is_accurate_and_half_complete() -> None:
    errors = _errors(_plate(0.05), _plate())
    assert errors.accurate(1e-5) == 1.0
    assert errors.complete(1e-5) == pytest.approx(0.5, abs=0.03)
    assert errors.f_score(1e-5) == pytest.approx(2.0 / 3.0, abs=0.03)
    # Far points count with their distance: the mean over the missing half is half its width.
    assert errors.completeness_m == pytest.approx(0.5 * 0.025, abs=1e-3)
    mirrored = _errors(_plate(), _plate(0.05))
    assert mirrored.complete(1e-5) == 1.0
    assert mirrored.accurate(1e-5) == pytest.approx(0.5, abs=0.03)


def test_distances_do_not_depend_on_how_finely_a_mesh_is_cut() -> None:
    coarse = trimesh.creation.box(extents=(0.1, 0.2, 0.05))
    fine = coarse.subdivide().subdivide().subdivide()
    errors = _errors(_parts(fine), _parts(coarse))
    assert max(errors.accuracy_m, errors.completeness_m) < 1e-6


def test_over_what_was_seen_nothing_else_has_to_be_there() -> None:
    surface = TrueSurface.of(*_plate(), np.random.default_rng(0), count=4000)
    errors = surface_errors(*_plate(0.05), surface, np.random.default_rng(1))
    seen = surface.points_m[:, 0] <= 0.05
    assert errors.over(seen).complete(1e-5) == 1.0
    assert errors.over(~seen).complete(1e-5) == 0.0
    assert errors.over(seen).accuracy_m == errors.accuracy_m


def _frame(depth_m: Array, mask: np.ndarray | None = None) -> Frame:
    return Frame(0, 0.0, depth_m.astype(np.float32), CAMERA, mask, None)


def test_frames_see_what_faces_them_where_they_measured() -> None:
    box = TrueSurface.of(*_parts(trimesh.creation.box(extents=(0.1, 0.1, 0.1))), np.random.default_rng(0), 6000)
    pose = se3.translation(np.array([0.0, 0.0, 0.5]))
    depth_m = np.full((CAMERA.height, CAMERA.width), 0.45)
    near = np.isclose(box.points_m[:, 2], -0.05, atol=1e-9)
    np.testing.assert_array_equal(box.seen([(_frame(depth_m), pose)]), near)
    # From behind the far side, both together, and nothing from no frame.
    turned = pose @ se3.exp(np.array([0.0, np.pi, 0.0, 0.0, 0.0, 0.0]))
    far = np.isclose(box.points_m[:, 2], 0.05, atol=1e-9)
    np.testing.assert_array_equal(box.seen([(_frame(depth_m), pose), (_frame(depth_m), turned)]), near | far)
    assert not box.seen([]).any()
    # Pixels without depth, or of something else, show nothing of the object.
    left = np.broadcast_to(np.arange(CAMERA.width) < 32, depth_m.shape)
    holes = np.where(left, depth_m, np.nan)
    for frame in (_frame(holes), _frame(depth_m, left.copy())):
        np.testing.assert_array_equal(box.seen([(frame, pose)]), near & (box.points_m[:, 0] <= 0.0))
    away = se3.translation(np.array([0.0, 0.0, -0.5]))
    assert not box.seen([(_frame(depth_m), away)]).any()


def test_samples_lie_on_the_surface_and_spread_by_area() -> None:
    box = trimesh.creation.box(extents=(0.1, 0.2, 0.4))
    vertices, triangles = np.asarray(box.vertices), np.asarray(box.faces, dtype=np.int64)
    count = 20_000
    points = sample_surface(vertices, triangles, count, np.random.default_rng(9))
    half = np.array([0.05, 0.1, 0.2])
    assert np.all(np.abs(points) <= half + 1e-12)
    on_side = np.isclose(np.abs(points), half)
    assert np.all(on_side.any(axis=1))
    areas = 2.0 * np.array([0.2 * 0.4, 0.1 * 0.4, 0.1 * 0.2])
    share = areas / areas.sum()
    sides = np.argmax(on_side, axis=1)
    observed = np.bincount(sides, minlength=3)
    assert stats.chisquare(observed, share * count).pvalue > 1e-3
    # Even within a side, too: the two coordinates of the largest are uniform.
    for axis in (1, 2):
        coordinate = points[sides == 0, axis] / half[axis]
        assert stats.kstest(coordinate, stats.uniform(-1.0, 2.0).cdf).pvalue > 1e-3
    again = sample_surface(vertices, triangles, count, np.random.default_rng(9))
    np.testing.assert_array_equal(points, again)
    with pytest.raises(ValueError, match="area"):
        sample_surface(np.zeros((3, 3)), np.array([[0, 1, 2]]), 5, np.random.default_rng(0))
