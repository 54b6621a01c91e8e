"""Rendered sequences: exact depth is exact, truth is true, and the same recipe gives the same bytes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from modeler import se3
from modeler.sequences import bundled, open_sequence
from modeler.sequences.meshes import Mesh
from modeler.sequences.rendering import RenderedSequence, render
from modeler.sequences.rendering.cameras import (
    EXACT,
    DepthSensor,
    DisparityNoise,
    Exposure,
    GrazingLoss,
    LateralJitter,
    MixedPixels,
    RandomLoss,
)
from modeler.sequences.rendering.recipe import (
    Hand,
    Mosaic,
    Place,
    Places,
    Recipe,
    RobotReadings,
    Table,
    Viewpoint,
    Wall,
    load_recipe,
)
from modeler.sequences.rendering.shapes import AnyShape, Box, Compound, Part, Sphere
from modeler.types import Camera, Frame, InputError
from studies.calibration.specimens import load_specimen

SMALL = Viewpoint(160, 120, 144.0)
NAMES = ("box", "flashlight", "tube", "mug", "figurine", "two_fold", "l_bracket", "held")


def points_m(frame: Frame, where: np.ndarray) -> np.ndarray:
    w, h = frame.camera.rays()
    return np.stack([w, h, np.ones_like(w)], axis=-1)[where] * frame.depth_m[where][:, None].astype(np.float64)


def small(name: str, **changes: object) -> Recipe:
    recipe = load_specimen(name)
    view = replace(recipe.view, width=160, height=120, focal_px=144.0)
    return replace(recipe, view=view, **changes)  # type: ignore[arg-type]


def distances_m(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """Distance of points (n, 3) to the nearest triangle."""
    scene = o3d.t.geometry.RaycastingScene()
    corners, triangles = mesh.vertices_m.astype(np.float32), mesh.triangles.astype(np.uint32)
    scene.add_triangles(o3d.core.Tensor.from_numpy(corners), o3d.core.Tensor.from_numpy(triangles))
    return scene.compute_distance(o3d.core.Tensor.from_numpy(points.astype(np.float32))).numpy()


def box_depth_m(camera: Camera, model_from_camera: np.ndarray, size_m: np.ndarray) -> np.ndarray:
    """Depth (h, w) of a box by clipping each ray at three slabs; NaN where it is missed."""
    w, h = camera.rays()
    rays = np.stack([w, h, np.ones_like(w)], axis=-1) @ model_from_camera[:3, :3].T
    near, far = ((side * size_m / 2 - model_from_camera[:3, 3]) / rays for side in (-1, 1))
    enter, leave = np.minimum(near, far).max(axis=-1), np.maximum(near, far).min(axis=-1)
    return np.where(enter < leave, enter, np.nan)


def test_exact_depth_is_that_of_the_box() -> None:
    size_m = (0.13, 0.075, 0.18)
    recipe = Recipe(Box(size_m), view=SMALL, table=None, sensor=None, trajectory=Hand(6))
    sequence = RenderedSequence(recipe)
    for index, pose in sequence.truth().items():
        frame = sequence.frame(index)
        expected_m = box_depth_m(frame.camera, se3.inverse(pose), np.array(size_m))
        both = frame.mask & np.isfinite(expected_m)
        assert np.sum(frame.mask != np.isfinite(expected_m)) <= 3  # rays that graze an edge
        assert both.sum() > 300
        np.testing.assert_allclose(frame.depth_m[both], expected_m[both], rtol=0, atol=2e-6)
        assert np.isnan(frame.depth_m[~frame.mask]).all()


def test_exact_depth_is_that_of_table_and_wall() -> None:
    recipe = Recipe(Sphere(0.03), view=SMALL, table=Table((0.4, 0.4)), wall=Wall(0.5), sensor=None)
    frame = RenderedSequence(recipe).frame(0)
    around = ~frame.mask & np.isfinite(frame.depth_m)
    seen = se3.transform(se3.inverse(recipe.view.camera_from_table()), points_m(frame, around))
    on_wall, on_table = np.abs(seen[:, 1] - 0.5) < 1e-5, np.abs(seen[:, 2]) < 1e-5
    on_front = np.abs(seen[:, 1] + 0.2) < 1e-5
    assert (on_wall | on_table | on_front).all()
    assert min(on_wall.sum(), on_table.sum()) > 500
    assert np.abs(seen[on_table][:, :2]).max() < 0.2 + 1e-5


@pytest.mark.parametrize("name", NAMES)
def test_truth_carries_every_frame_onto_the_model(name: str) -> None:
    recipe = small(name, sensor=None)
    sequence = RenderedSequence(recipe)
    model, truth = sequence.model(), sequence.truth()
    for index in (0, 1, 7):
        frame = sequence.frame(index)
        assert frame.mask is not None
        in_model = se3.transform(se3.inverse(truth[index]), points_m(frame, frame.mask))[::3]
        assert len(in_model) > 30
        # On long thin triangles the search for the nearest point, not the ray, is wrong by up to 0.07 mm.
        assert distances_m(model, in_model).max() < 1e-4


def test_noise_does_not_move_the_surface() -> None:
    recipe = load_recipe("box")
    sequence = RenderedSequence(recipe)
    frame, exact = sequence.frame(0), RenderedSequence(replace(recipe, sensor=None)).frame(0)
    assert frame.mask is not None
    assert exact.mask is not None
    both = frame.mask & exact.mask & np.isfinite(frame.depth_m)
    error_m = frame.depth_m[both] - exact.depth_m[both]
    assert np.abs(np.median(error_m)) < 2e-4
    # Half of a Gaussian lies within 0.67 sigma; the object is nearer and farther than 0.8 m, and it slopes.
    assert 0.8 < np.median(np.abs(error_m)) / (0.67 * sequence.sensor().along_ray_m(0.8)) < 1.4


def turned(name: str, angle_deg: float, **changes: object) -> RenderedSequence:
    """Return a shape at one place: twice as it is, and once turned about the vertical."""
    place, there = Place((0.01, 0.02, 0.0)), Place((0.01, 0.02, 0.0), (0.0, 0.0, angle_deg))
    return RenderedSequence(replace(load_specimen(name), trajectory=Places((place, place, there)), **changes))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "name", ["can", *(pytest.param(name, marks=pytest.mark.slow) for name in ("goblet", "soup_plate"))]
)
def test_a_shape_of_revolution_looks_the_same_however_it_is_turned(name: str) -> None:
    exact, _, there = turned(name, 137.0, sensor=None)
    assert exact.mask is not None
    assert there.mask is not None
    both = exact.mask & there.mask
    assert np.sum(exact.mask != there.mask) < 0.01 * both.sum()  # facets
    moved_m = np.abs(there.depth_m - exact.depth_m)[both]
    assert np.median(moved_m) < 2e-5
    assert np.mean(moved_m > 1e-3) < 0.01  # on edges

    first, again, other = (frame.depth_m for frame in turned(name, 137.0))
    noise_m, difference_m = (np.abs(depth_m - first)[both] for depth_m in (again, other))
    assert np.mean(np.isnan(difference_m)) == pytest.approx(np.mean(np.isnan(noise_m)), abs=0.01)
    for share in (0.5, 0.9):
        assert np.nanquantile(difference_m, share) == pytest.approx(np.nanquantile(noise_m, share), rel=0.1)


def test_a_box_does_not_look_the_same_when_it_is_turned() -> None:
    first, again, other = turned("box", 137.0)
    noise_m, difference_m = (np.abs(frame.depth_m - first.depth_m)[first.mask] for frame in (again, other))
    assert np.nanmedian(difference_m) > 5.0 * np.nanmedian(noise_m)


def same_frame(first: Frame, second: Frame) -> bool:
    pairs = ((first.depth_m, second.depth_m), (first.mask, second.mask), (first.colour, second.colour))
    return all(
        a is b or (a is not None and b is not None and np.array_equal(a, b, equal_nan=a.dtype == np.float32))
        for a, b in pairs
    )


@pytest.mark.parametrize("name", ["box", "tin"])
def test_a_seed_decides_everything_and_the_order_of_reading_nothing(name: str) -> None:
    """With plain colours, and with photographs."""
    recipe = small(name, colour="png")
    forwards = list(RenderedSequence(recipe).select(every=5))
    sequence = RenderedSequence(recipe)
    backwards = [sequence.frame(index) for index in (10, 5, 0)][::-1]
    assert all(same_frame(a, b) for a, b in zip(forwards, backwards, strict=True))
    other = RenderedSequence(replace(recipe, seed=recipe.seed + 1))
    assert not same_frame(forwards[0], other.frame(0))
    assert not np.array_equal(other.truth()[1], sequence.truth()[1])


def test_colour_follows_the_object() -> None:
    recipe = Recipe(
        Compound((Part(Box((0.13, 0.075, 0.18)), rgb=(220, 60, 40)),)),
        view=SMALL,
        sensor=None,
        colour="png",
        trajectory=Places((Place(), Place((0.02, 0.01, 0.0), (0.0, 0.0, 20.0)))),
        pattern=Mosaic(0.03, 0.7),
    )
    sequence, truth = RenderedSequence(recipe), RenderedSequence(recipe).truth()
    first, second = sequence.frame(0), sequence.frame(1)
    assert first.mask is not None
    assert (first.colour[first.mask][:, 0] > first.colour[first.mask][:, 2]).all()  # reddish
    carried = se3.transform(truth[1] @ se3.inverse(truth[0]), points_m(first, first.mask))
    u = np.rint(second.camera.fx * carried[:, 0] / carried[:, 2] + second.camera.cx).astype(int)
    v = np.rint(second.camera.fy * carried[:, 1] / carried[:, 2] + second.camera.cy).astype(int)
    seen = second.mask[v, u] & (np.abs(second.depth_m[v, u] - carried[:, 2]) < 3e-3)
    red = first.colour[first.mask][seen][:, 0].astype(float), second.colour[v, u][seen][:, 0].astype(float)
    assert np.corrcoef(*red)[0, 1] > 0.8
    assert RenderedSequence(replace(recipe, colour="none")).frame(0).colour is None


def test_what_is_rendered_is_what_is_read(tmp_path: Path) -> None:
    recipe = small("held", colour="png", trajectory=Hand(3, robot=RobotReadings(0.0, 0.0)))
    render(recipe, tmp_path / "s")
    read, rendered = open_sequence(tmp_path / "s"), RenderedSequence(recipe)
    assert (read.name, read.indices, read.motion) == (rendered.name, rendered.indices, rendered.motion)
    assert read.sensor() == rendered.sensor()
    read_truth = read.truth()
    for a, b in zip(read, rendered, strict=True):
        np.testing.assert_allclose(a.depth_m, b.depth_m, atol=0.5e-4 + 1e-6)
        np.testing.assert_array_equal(a.mask, b.mask)  # type: ignore[arg-type]
        np.testing.assert_array_equal(a.colour, b.colour)  # type: ignore[arg-type]
        assert (a.time_s, a.camera) == (b.time_s, b.camera)
        np.testing.assert_allclose(read_truth[a.index], rendered.truth()[a.index], atol=1e-12)
    lines = [line.split() for line in read.robot_path.read_text().splitlines() if not line.startswith("#")]
    assert [float(line[0]) for line in lines] == [frame.time_s for frame in rendered]
    shifts_m = np.array([[float(value) for value in line[1:4]] for line in lines])
    np.testing.assert_allclose(shifts_m, [pose[:3, 3] for pose in rendered.truth().values()], atol=1e-8)


@pytest.mark.parametrize("name", ["box", "flashlight", "tube"])
def test_bundled_sequences_are_what_their_recipes_render(name: str) -> None:
    """One frame is rendered anew.

    Bytes are not compared: Embree picks its instruction set at run time, so that a ray which grazes an edge, or noise
    on the border of two steps of disparity, may fall either way on another machine.
    """
    sequence, rendered = open_sequence(bundled(name)), RenderedSequence(load_recipe(name))
    assert len(sequence) == 14
    truth = sequence.truth()
    for index, pose in rendered.truth().items():
        np.testing.assert_allclose(truth[index], pose, atol=1e-9)
    stored, fresh = sequence.frame(6), rendered.frame(6)
    same = np.isclose(stored.depth_m, fresh.depth_m, atol=0.5e-4 + 1e-6, rtol=0, equal_nan=True)
    assert np.mean(~same) < 1e-3
    assert np.mean(stored.mask != fresh.mask) < 1e-4
    assert (stored.colour is None) == (fresh.colour is None) == (name != "box")


def test_bundled_sequences_are_small_and_complete() -> None:
    folders = [bundled(name) for name in ("box", "flashlight", "tube")]
    assert sum(path.stat().st_size for folder in folders for path in folder.rglob("*.*")) < 5_000_000
    for folder in folders:
        sequence = open_sequence(folder)
        assert sequence.model_path is not None
        assert sequence.motion["kind"] == "table"
        truth = sequence.truth()
        turned_deg = [
            np.degrees(float(se3.rotation_angle(truth[i + 1] @ se3.inverse(truth[i])))) for i in sequence.indices[:-1]
        ]
        assert 20 < np.mean(turned_deg) < 30
    with pytest.raises(InputError, match="box, flashlight, tube"):
        bundled("teapot")


def test_there_is_no_frame_beyond_the_last() -> None:
    with pytest.raises(InputError, match="0 to 13, 14 frames"):
        RenderedSequence(small("box")).frame(14)


def test_a_folder_of_the_name_of_a_recipe_is_not_taken_for_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tube").mkdir()  # as `modeler render tube --out tube` makes it
    assert load_recipe("tube").name == "tube"
    (tmp_path / "teapott").mkdir()
    with pytest.raises(InputError, match="teapott: "):
        load_recipe("teapott")


# The depth camera: each effect does what its parameters say, and nothing when it is left out.


FOCAL_PX, BASELINE_M = 575.0, 0.075
SHAPE = (240, 320)
VIEW = Viewpoint(160, 120, 144.0)
KINECT = DepthSensor()


def exposure(depth_m: np.ndarray | float, incidence_deg: float = 0.0) -> Exposure:
    full_m = np.broadcast_to(depth_m, SHAPE).astype(np.float64)
    return Exposure(full_m, np.full(SHAPE, np.radians(incidence_deg)), np.zeros(SHAPE, bool))


def measured(sensor: DepthSensor, seen: Exposure, seed: int = 0) -> np.ndarray:
    return sensor.measure(seen, FOCAL_PX, np.random.default_rng(seed)).astype(np.float64)


def only(**effects: object) -> DepthSensor:
    return replace(EXACT, baseline_m=BASELINE_M, **effects)  # type: ignore[arg-type]


def test_without_effects_depth_is_left_as_it_is() -> None:
    rng = np.random.default_rng(0)
    depth_m = rng.uniform(0.1, 9.0, SHAPE)
    depth_m[rng.random(SHAPE) < 0.1] = np.nan
    seen = Exposure(depth_m, rng.uniform(0, np.pi / 2, SHAPE), rng.random(SHAPE) < 0.5)
    np.testing.assert_array_equal(measured(EXACT, seen), depth_m.astype(np.float32))


@pytest.mark.parametrize("depth_m", [0.6, 0.8, 1.6])
@pytest.mark.parametrize("correlation_px", [0.0, 1.0])
def test_noise_is_as_strong_as_it_says(depth_m: float, correlation_px: float) -> None:
    noise = DisparityNoise(0.07, 0.0, correlation_px)
    error_m = measured(only(disparity=noise), exposure(depth_m)) - depth_m
    expected_m = depth_m**2 / (FOCAL_PX * BASELINE_M) * 0.07
    assert error_m.std() == pytest.approx(expected_m, rel=0.03)
    assert noise.sigma_m(depth_m, FOCAL_PX * BASELINE_M) == pytest.approx(expected_m)
    assert abs(error_m.mean()) < 0.05 * expected_m
    neighbours = np.corrcoef(error_m[:, :-1].ravel(), error_m[:, 1:].ravel())[0, 1]
    # Of a field smoothed by a Gaussian of width s, neighbours at d share exp(-d² / 4s²).
    assert neighbours == pytest.approx(0.0 if correlation_px == 0.0 else np.exp(-0.25), abs=0.03)


def test_the_default_is_a_kinect_at_arms_length() -> None:
    sigma_wh, sigma_r_m = KINECT.sigmas(0.8, FOCAL_PX, 1e-4)
    ramp_m = 0.8 + np.linspace(-0.01, 0.01, SHAPE[1])[None]  # over several steps of disparity
    quiet = only(disparity=DisparityNoise())
    error_m = measured(quiet, exposure(ramp_m)) - ramp_m
    assert 1.0e-3 < sigma_r_m < 1.5e-3
    assert error_m.std() == pytest.approx(sigma_r_m, rel=0.05)
    assert 0.3 / FOCAL_PX < sigma_wh < 1.0 / FOCAL_PX


def test_disparity_comes_in_steps() -> None:
    depth_m = measured(only(disparity=DisparityNoise(0.2, 0.125)), exposure(0.8))
    steps = FOCAL_PX * BASELINE_M / depth_m / 0.125
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-3)
    assert len(np.unique(np.rint(steps))) > 5


def test_noise_grows_on_slopes() -> None:
    noise = only(disparity=DisparityNoise(0.07, 0.0, 0.0, slope_gain=0.075))
    flat_m, steep_m = (np.std(measured(noise, exposure(0.8, angle))) for angle in (0.0, 75.0))
    slope = np.radians(75.0)
    assert steep_m / flat_m == pytest.approx(1 + 0.075 * (slope / (np.pi / 2 - slope)) ** 2, rel=0.02)


def test_jitter_is_as_wide_as_it_says_and_shared_by_neighbours() -> None:
    along_w, along_h = LateralJitter(0.4, 1.5).offsets_px((400, 600), np.random.default_rng(0))
    for offsets in (along_w, along_h):
        assert offsets.std() == pytest.approx(0.4, rel=0.03)
        assert np.corrcoef(offsets[1:].ravel(), offsets[:-1].ravel())[0, 1] > 0.8
    assert abs(np.corrcoef(along_w.ravel(), along_h.ravel())[0, 1]) < 0.05


def test_grazing_surfaces_are_lost_and_others_are_not() -> None:
    sensor = only(grazing=GrazingLoss(70.0, 88.0))
    lost = [np.isnan(measured(sensor, exposure(0.8, angle))).mean() for angle in (0.0, 69.9, 79.0, 88.0)]
    assert lost[0] == lost[1] == 0.0
    assert lost[2] == pytest.approx(0.5, abs=0.02)
    assert lost[3] == 1.0


def test_pixels_mix_at_borders_only_and_stay_between() -> None:
    depth_m = np.where(np.arange(SHAPE[1]) < 160, 0.8, 1.1)
    mixed = measured(only(mixed=MixedPixels(0.5, 0.02)), exposure(depth_m))
    moved = np.abs(mixed - depth_m) > 1e-6
    assert not moved[:, :159].any()
    assert not moved[:, 161:].any()
    assert moved[:, 159:161].mean() == pytest.approx(0.5, abs=0.07)
    assert mixed.min() >= np.float32(0.8)
    assert mixed.max() <= np.float32(1.1)
    slope_m = np.broadcast_to(0.8 + 0.0005 * np.arange(SHAPE[1]), SHAPE)
    np.testing.assert_allclose(measured(only(mixed=MixedPixels(1.0, 0.02)), exposure(slope_m)), slope_m, atol=1e-6)


def test_a_share_of_pixels_is_lost_anywhere() -> None:
    lost = np.isnan(measured(only(loss=RandomLoss(0.05, 0.0)), exposure(0.8)))
    assert lost.mean() == pytest.approx(0.05, abs=0.005)


def test_depth_out_of_range_is_not_measured() -> None:
    depth_m = np.linspace(0.1, 5.0, SHAPE[1])
    seen = np.isfinite(measured(only(min_range_m=0.4, max_range_m=3.5), exposure(depth_m)))
    np.testing.assert_array_equal(seen[0], (depth_m >= 0.4) & (depth_m <= 3.5))


@pytest.mark.parametrize("off", ["jitter", "mixed", "disparity", "grazing", "loss"])
def test_leaving_one_effect_out_leaves_the_others_as_they_were(off: str) -> None:
    everything, without = (measured(one, exposure(0.8, 75.0)) for one in (KINECT, replace(KINECT, **{off: None})))
    both = np.isfinite(everything) & np.isfinite(without)
    assert both.sum() > 1000
    assert np.array_equal(everything[both], without[both]) == (off != "disparity")
    if off in ("disparity", "jitter", "mixed"):
        np.testing.assert_array_equal(np.isfinite(everything), np.isfinite(without))


# --- in the renderer ---


def scene(thing: AnyShape, sensor: DepthSensor | None) -> RenderedSequence:
    """A thing 0.8 m in front of the camera, which looks along the horizontal."""
    view = replace(VIEW, elevation_deg=0.0, look_height_m=0.0)
    trajectory = Places((Place((0.0, 0.0, -0.15)),))
    return RenderedSequence(Recipe(thing, view=view, table=None, sensor=sensor, trajectory=trajectory))


def test_the_projector_throws_a_shadow_as_wide_as_the_disparities_differ() -> None:
    plate, back = Box((0.1, 0.002, 0.3)), Box((2.0, 0.002, 2.0))
    parts = Compound((Part(plate), Part(back, offset_m=(0.0, 0.3, 0.0))))
    near_m, far_m = 0.8 - 0.151, 0.8 - 0.151 + 0.3  # the compound is centred; its plates are 2 mm thick
    for baseline_m in (0.075, -0.075):
        sensor = replace(EXACT, baseline_m=baseline_m, shadow=True)
        sequence = RenderedSequence(replace(scene(parts, sensor).recipe, trajectory=Places((Place((0.0, 0.0, -1.0)),))))
        lost = np.isnan(sequence.frame(0).depth_m[60])
        expected_px = VIEW.focal_px * abs(baseline_m) * (1 / near_m - 1 / far_m)
        assert lost.sum() == pytest.approx(expected_px, abs=1.01)
        columns = np.nonzero(lost)[0]
        assert np.ptp(columns) + 1 == len(columns)  # one band
        on_left = columns.mean() < VIEW.camera().cx
        assert on_left == (baseline_m > 0)  # light from the right leaves the left in the dark
        lit = RenderedSequence(replace(sequence.recipe, sensor=replace(sensor, shadow=False)))
        assert not np.isnan(lit.frame(0).depth_m[60]).any()


def test_jitter_alone_moves_borders_but_not_a_plate_that_faces_the_camera() -> None:
    plate = Box((0.2, 0.01, 0.3))
    exact = scene(plate, None).frame(0)
    moved = scene(plate, replace(EXACT, jitter=LateralJitter(0.5, 1.5))).frame(0)
    both = np.isfinite(exact.depth_m) & np.isfinite(moved.depth_m)
    np.testing.assert_allclose(moved.depth_m[both], exact.depth_m[both], atol=1e-6)
    changed = np.isfinite(exact.depth_m) != np.isfinite(moved.depth_m)
    assert changed.any()
    rows, columns = np.nonzero(changed)
    edges_px = VIEW.camera().cx + np.array([-1, 1]) * VIEW.focal_px * 0.1 / (0.8 - 0.005)
    at_side = np.abs(columns[:, None] - edges_px).min(axis=1) < 3
    lines_px = VIEW.camera().cy + np.array([-1, 1]) * VIEW.focal_px * 0.15 / (0.8 - 0.005)
    at_end = np.abs(rows[:, None] - lines_px).min(axis=1) < 3
    assert (at_side | at_end).all()
