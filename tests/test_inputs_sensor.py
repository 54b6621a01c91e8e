"""Measuring a camera's noise on rendered scenes, whose noise is known."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from modeler.cli import main
from modeler.sequences import CalibratedSequence, NoiseModel, bundled, open_sequence, read_noise, write_bop
from modeler.sequences.calibrated import noise_text, object_distance_m
from modeler.sequences.noise_calibration import Calibration, borders, calibrate, pooled_px
from modeler.sequences.rendering import RenderedSequence
from modeler.sequences.rendering.cameras import gaussian_field
from modeler.sequences.rendering.recipe import Tabletop, load_recipe
from modeler.types import Frame, InputError

FRAMES = 5
MODEL = NoiseModel(0.5, 500.0, 1e-4, (3e-6, 4e-7, 1e-8))


@pytest.fixture(scope="module")
def still() -> RenderedSequence:
    """A box on a table before a wall; nothing moves."""
    recipe = load_recipe("box")
    stays = Tabletop(frames=FRAMES, step_deg=0.0, step_sigma_deg=0.0, shift_m=0.0, start_deg=20.0)
    view = dataclasses.replace(recipe.view, width=480, height=360, focal_px=430.0)
    return RenderedSequence(dataclasses.replace(recipe, trajectory=stays, view=view, colour="none", name="still"))


@pytest.fixture(scope="module")
def still_folder(still: RenderedSequence, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("still") / "still"
    bare = [Frame(frame.index, frame.time_s, frame.depth_m, frame.camera) for frame in still]
    write_bop(folder, bare, meta={"name": "still"}, depth_scale_mm=0.1)
    return folder


@pytest.fixture(scope="module")
def measured(still_folder: Path) -> Calibration:
    return calibrate(open_sequence(still_folder))


def test_noise_along_the_ray_is_that_of_the_renderer(still: RenderedSequence, measured: Calibration) -> None:
    camera = still.recipe.sensor
    focal_baseline = still.recipe.view.focal_px * abs(camera.baseline_m)
    off = []
    for one in measured.bins:
        slope = (one.angle_rad / (np.pi / 2.0 - one.angle_rad)) ** 2
        noise_px = camera.disparity.sigma_px * (1.0 + camera.disparity.slope_gain * slope)
        true_m = one.distance_m**2 / focal_baseline * np.hypot(noise_px, camera.disparity.quantum_px / np.sqrt(12.0))
        modelled_m = float(measured.model.sigma_r_m(one.distance_m, one.angle_rad))
        off.append((np.sqrt(one.variance_m2) / true_m, modelled_m / true_m))
    assert len(off) > 8
    np.testing.assert_allclose(off, 1.0, atol=0.15)
    assert max(one.distance_m for one in measured.bins) > 1.4 * min(one.distance_m for one in measured.bins)


def test_noise_across_the_ray_is_that_of_the_renderer(still: RenderedSequence, measured: Calibration) -> None:
    """Up to a fifth more: borders waver by mixed pixels too, which the renderer's figure leaves out."""
    true_px = still.sensor()[0] * still.recipe.view.focal_px
    assert true_px <= measured.model.lateral_px <= 1.2 * true_px


@pytest.mark.parametrize("sigma_px", [0.3, 1.0])
@pytest.mark.parametrize("tilt", [0.0, 0.4, -0.8, 1.0, 3.0])
def test_borders_waver_as_much_as_they_are_made_to(sigma_px: float, tilt: float) -> None:
    """A half plane before another, whose border is shifted along its normal by noise that neighbours share."""
    rng = np.random.default_rng(5)
    rows, columns = np.mgrid[0:160, 0:160].astype(np.float64)
    frames = []
    for _ in range(30):
        shift = sigma_px * gaussian_field((160, 160), 4.0, rng)
        distance = ((columns - 80.3) + tilt * (rows - 80.0)) / np.hypot(1.0, tilt) - shift
        frames.append(np.where(distance < 0.0, 0.8, 1.2))
    depth_m = np.stack(frames)
    found = borders(depth_m, np.median(depth_m, axis=0))
    pooled = pooled_px(found)
    steep = min(abs(tilt), 1.0 / max(abs(tilt), 1e-9))  # along the axis on which it is measured
    expected = np.hypot(sigma_px, np.sqrt(1.0 / 12.0 / (1.0 + steep**2)))
    assert pooled == pytest.approx(expected, rel=0.25)


def test_a_scene_that_moves_or_shows_too_little_is_refused() -> None:
    box = open_sequence(bundled("box"))
    with pytest.raises(InputError, match="of the image moves"):
        calibrate(box)
    with pytest.raises(InputError, match="has 2 frames; record at least 3"):
        calibrate(box.select(frames=slice(0, 2)))


def test_what_is_stored_is_what_is_used(
    still_folder: Path, measured: Calibration, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "my camera.json"
    assert main(["calibrate-sensor", str(still_folder), "--out", str(path)]) == 0
    said = capsys.readouterr()
    assert "across the ray" in said.out
    assert said.err.startswith("modeler: at ")
    stored = read_noise(path)
    assert stored == measured.model
    record = json.loads(path.read_text())
    assert record["frames"] == FRAMES
    assert len(record["along"]) == len(measured.bins)
    converted = ["convert", str(bundled("box")), "--frames", "0:2", "--out", str(tmp_path / "b")]
    assert main([*converted, "--sensor", str(path)]) == 0
    noise = open_sequence(tmp_path / "b").sensor()
    box = open_sequence(bundled("box"))
    assert noise[:2] == pytest.approx(stored.at(object_distance_m(box.frame(0))))


def test_a_sequence_takes_the_noise_that_was_measured() -> None:
    whole = open_sequence(bundled("box"))
    sensed = CalibratedSequence(whole, MODEL)
    assert sensed.sensor()[:2] == MODEL.at(object_distance_m(whole.frame(0)))
    part = sensed.select(every=5)
    assert part.indices == (0, 5, 10)
    assert part.sensor() == sensed.sensor()
    assert [frame.index for frame in part] == [0, 5, 10]
    assert part.truth() is not None
    assert not part.live


def test_noise_grows_with_distance_and_slope() -> None:
    distance_m = np.linspace(0.3, 3.0, 20)
    assert (np.diff(MODEL.sigma_r_m(distance_m)) > 0.0).all()
    assert (np.diff(MODEL.sigma_r_m(1.0, np.radians(np.arange(0, 85, 5)))) > 0.0).all()
    assert MODEL.sigma_r_m(1.0, np.pi / 2.0) == MODEL.sigma_r_m(1.0, np.radians(85.0))
    assert MODEL.sigma_wh() == 0.001


@pytest.mark.parametrize(
    "change",
    [
        lambda noise: noise.pop("growth"),
        lambda noise: noise.update(growth=[1e-6, 0.0]),
        lambda noise: noise.update(growth=[1e-6, 0.0, "x"]),
        lambda noise: noise.update(lateral_px=-1),
        lambda noise: noise.update(focal_px=float("nan")),
        lambda noise: noise.update(floor_m=10**400),
    ],
)
def test_a_file_that_says_something_else_is_one_line(
    tmp_path: Path, refusal: Callable[..., str], change: Callable[[dict], object]
) -> None:
    tree = json.loads(noise_text(MODEL, {}))
    path = tmp_path / "noise.json"
    path.write_text(json.dumps(tree))
    assert read_noise(path) == MODEL
    change(tree["noise"])
    path.write_text(json.dumps(tree))
    assert str(path) in refusal("build", bundled("box"), "--sensor", path, "--out", tmp_path / "run")
    assert not (tmp_path / "run").exists()
