"""Colour of surface that several views see agrees where it is aligned to depth, and where it is not, this is said."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy import ndimage
from slow_cases import quick_first
from tabletop import recoloured
from test_inputs_plain_errors import colour_as
from test_verdict import AXES_M, CAMERA, MIDDLE, poses_of, seen, turned, views_of, whole_run

from modeler import se3
from modeler.export import RunMeta, report_of
from modeler.kernels.photometric import displaced_correlations
from modeler.types import FLIPS, Array, Flip, RayImage, Step, Verdict
from modeler.verdict import judged
from modeler.verdict.colour_fit import ColourFit, Comparison, Displacement

ANGLES_DEG = [20.0 * k for k in range(8)]


def from_above(angle_deg: float, above_deg: float) -> Array:
    """Return camera_from_object (4, 4) of `turned` for a camera that looks down on it."""
    tilt = se3.exp(np.array([np.radians(above_deg), 0.0, 0.0, 0.0, 0.0, 0.0]))
    return np.asarray(MIDDLE @ tilt @ se3.inverse(MIDDLE) @ turned(angle_deg))


@cache
def printed(
    contrast: float = 1.0,
    *,
    noise: float = 1.0,
    above_deg: float = 0.0,
    angles_deg: tuple[float, ...] = tuple(ANGLES_DEG),
    axes_m: tuple[float, ...] = tuple(AXES_M),
) -> dict[int, RayImage]:
    """Return views of an ellipsoid with a print, before a wall with a pattern of its own."""
    rng = np.random.default_rng(5)
    poses = [from_above(angle_deg, above_deg) for angle_deg in angles_deg]
    views = {index: seen(index, pose, axes_m=np.array(axes_m)) for index, pose in enumerate(poses)}
    waves, phases = rng.normal(scale=350.0, size=(20, 3)), rng.uniform(0.0, 2.0 * np.pi, 20)
    wall = 100.0 + 30.0 * ndimage.gaussian_filter(rng.normal(size=(CAMERA.height, CAMERA.width)), 2.0) / 0.14
    for index, view in views.items():
        points_m = se3.transform(se3.inverse(poses[index]), view.points_m)
        image = wall.copy()
        image[view.pixels[:, 0], view.pixels[:, 1]] = 120.0 + 12.0 * contrast * np.sum(
            np.sin(points_m @ waves.T + phases), axis=1
        )
        image += noise * rng.normal(size=image.shape)
        views[index] = recoloured(view, np.clip(image, 0, 255))
    return views


def changed(views: dict[int, RayImage], **how: object) -> dict[int, RayImage]:
    """Return views with colour as another camera shows it."""
    given = {"mirrored": False, "scale": 1.0, "shift_px": (0.0, 0.0)} | how
    return {k: recoloured(view, colour_as(view.frame.colour, **given)) for k, view in views.items()}  # pyright: ignore[reportArgumentType]


def colour_fit(views: Mapping[int, RayImage], trajectory: Mapping[int, Array]) -> ColourFit:
    compared = Comparison.of(views, trajectory)
    return compared.fit()


def test_aligned_colour_fits() -> None:
    fit = colour_fit(printed(), poses_of(ANGLES_DEG))
    assert fit.correlation > 0.8
    assert fit.displacement == Displacement()
    assert fit.check.holds


@pytest.mark.parametrize(
    ("how", "across", "scale", "shift_px"),
    quick_first(
        [
            ({"scale": 1.25, "shift_px": (-6.0, 2.0)}, 1.0, 1.25, (-6.0, 2.0)),
            ({"mirrored": True}, -1.0, 1.0, (0.0, 0.0)),
            ({"shift_px": (8.0, 0.0)}, 1.0, 1.0, (8.0, 0.0)),
            ({"scale": 0.8}, 1.0, 0.8, (0.0, 0.0)),
        ],
        1,
    ),
)
def test_displaced_colour_is_found(
    how: dict[str, object], across: float, scale: float, shift_px: tuple[float, float]
) -> None:
    """What is up is hardly observable where all rotation is about the vertical, and the body is symmetric."""
    fit = colour_fit(changed(printed(), **how), poses_of(ANGLES_DEG))
    assert not fit.check.holds
    assert FLIPS[fit.displacement.flip][0] == across
    assert fit.displacement.scale == pytest.approx(scale, abs=0.06)
    assert fit.displacement.shift_px[0] == pytest.approx(shift_px[0], abs=2.0)


@pytest.mark.parametrize("flip", quick_first(flip for flip in FLIPS if flip))
def test_colour_that_is_turned_over_is_found(flip: Flip) -> None:
    views, poses = printed(above_deg=35.0), [from_above(angle_deg, 35.0) for angle_deg in ANGLES_DEG]
    across, down = map(int, FLIPS[flip])
    turned_over = {k: recoloured(view, view.frame.colour[::down, ::across]) for k, view in views.items()}
    fit = colour_fit(turned_over, {index: se3.inverse(pose) for index, pose in enumerate(poses)})
    assert not fit.check.holds
    assert str(fit.displacement) == f"is {flip}"


def test_colour_of_the_frame_before_is_found() -> None:
    views = printed()
    late = {k: recoloured(view, views[max(k - 1, 0)].frame.colour) for k, view in views.items()}
    fit = colour_fit(late, poses_of(ANGLES_DEG))
    assert not fit.check.holds
    assert str(fit.displacement) == "is of the frame before"


@pytest.mark.parametrize("noise", quick_first([8.0, 0.0]))
def test_a_plain_object_before_a_pattern_contradicts_nothing(noise: float) -> None:
    fit = colour_fit(printed(0.0, noise=noise), poses_of(ANGLES_DEG))
    assert fit.check.holds


def test_a_pattern_that_stands_still_is_not_taken_for_print() -> None:
    """Between views that hardly move in the image it agrees, however plain the object is."""
    rng, angles_deg, views = np.random.default_rng(5), [6.5 * k for k in range(8)], {}
    wall = np.full((CAMERA.height, CAMERA.width), 120.0)
    wall[:, 91:110] += 200.0 * ndimage.gaussian_filter(rng.normal(size=(CAMERA.height, 19)), 2.0)
    for index, angle_deg in enumerate(angles_deg):
        view = seen(index, turned(angle_deg), axes_m=np.full(3, 0.03))
        image = np.where(np.asarray(view.frame.mask), 120.0, wall) + 4.0 * rng.normal(size=wall.shape)
        views[index] = recoloured(view, np.clip(image, 0, 255))
    fit = colour_fit(views, poses_of(angles_deg))
    assert fit.check.holds


def test_without_colour_or_shared_surface_nothing_is_said() -> None:
    assert Comparison.of(views_of(ANGLES_DEG), poses_of(ANGLES_DEG)) is None
    apart = [0.0, 90.0, 180.0]
    assert Comparison.of({k: printed()[k] for k in range(3)}, poses_of(apart)) is None


def test_a_run_with_colour_of_another_camera_is_not_trusted(monkeypatch: pytest.MonkeyPatch) -> None:
    """The report says where its colour is."""
    reports = []

    def reported(step: Step, **given: Any) -> Verdict:
        verdict = judged(step, **given)
        reports.append(report_of(replace(step, verdict=verdict), RunMeta("run", 0, "table")))
        return verdict

    views = changed(printed(), shift_px=(10.0, 0.0))
    monkeypatch.setattr("test_verdict.views_of", lambda angles_deg: {k: views[k] for k in range(len(angles_deg))})
    monkeypatch.setattr("test_verdict.judged", reported)
    codes, holds = whole_run(ANGLES_DEG)
    assert "colour_misaligned" in codes
    assert holds["colour_fit"] is False
    found = reports[0]["colour"]
    assert found["shift_px"][0] == pytest.approx(10.0, abs=3.0 * found["shift_sigma_px"][0])
    assert found["scale"] == pytest.approx(1.0, abs=3.0 * found["scale_sigma"])
    assert max(found["shift_sigma_px"]) < 0.5
    assert (found["flip"], found["frames"], len(found["covariance"])) == ("", 0, 9)
    assert "(shift (" in reports[0]["reasons"][reports[0]["reason_codes"].index("colour_misaligned")]


def test_correlations_are_those_of_interpolated_values(rng: np.random.Generator) -> None:
    images = rng.normal(size=(2, 30, 40))
    places = rng.uniform((8.0, 8.0) * 2, (30.0, 20.0) * 2, (50, 4))
    shift = Displacement(1.1, (1.5, -0.7), "mirrored")
    found = displaced_correlations(images, np.array([[0, 1]]), np.array([0, 50]), places, shift.row()[None])
    middle, values = np.array([19.5, 14.5]), []
    for image, at in zip(images, (places[:, :2], places[:, 2:]), strict=True):
        column, row = (middle + FLIPS[shift.flip] * (shift.scale * (at - middle) + shift.shift_px)).T
        values.append(ndimage.map_coordinates(image, [row, column], order=1))
    assert found[0, 0] == pytest.approx(np.corrcoef(*values)[0, 1])
