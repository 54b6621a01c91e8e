"""Shift and scale of colour against depth are estimated by print, within their covariance."""

from functools import cache

import numpy as np
import pytest
from scipy import ndimage
from scipy.special import chdtri
from slow_cases import quick_first
from tabletop import recoloured
from test_colour_fit import ANGLES_DEG, from_above, printed
from test_verdict import CAMERA, poses_of

from modeler import se3
from modeler.sequences import bundled, open_sequence
from modeler.types import Array, ColourAlignment, RayImage
from modeler.verdict.colour_alignment import colour_alignment
from modeler.verdict.colour_fit import Comparison
from modeler.views import Sensor

PLACES = (
    np.zeros(3),
    np.array([1.3, -0.6, 0.004]),
    np.array([-0.4, 1.1, -0.012]),
    np.array([0.7, 0.3, 0.02]),
    np.array([-1.6, -1.2, 0.0]),
)
"""Shift right and down in px, and logarithm of the scale."""


def moved(views: dict[int, RayImage], place: Array) -> dict[int, RayImage]:
    """Return views with colour elsewhere."""
    found = {}
    for index, view in views.items():
        image = np.asarray(view.frame.colour, dtype=np.float64)
        middle, scale = 0.5 * (np.array(image.shape[:2]) - 1.0), np.exp(place[2])
        offset = middle - (middle + place[1::-1]) / scale
        parts = [
            ndimage.affine_transform(part, np.full(2, 1.0 / scale), offset, mode="nearest")
            for part in np.moveaxis(image, 2, 0)
        ]
        found[index] = recoloured(view, np.clip(np.stack(parts, axis=2), 0, 255))
    return found


def estimate(views: dict[int, RayImage], poses: dict[int, Array]) -> ColourAlignment:
    compared = Comparison.of(views, poses)
    assert compared is not None
    return colour_alignment(compared, compared.fit().displacement)


def square(found: ColourAlignment, place: Array) -> float:
    """Return the squared error in units of the covariance."""
    error = found.mean - place
    return float(error @ np.linalg.solve(found.covariance, error))


@cache
def box() -> tuple[dict[int, RayImage], dict[int, Array]]:
    """Return views of half a turn of the bundled sequence that has colour, and true poses."""
    sequence = open_sequence(bundled("box"))
    noise, truth = sequence.sensor(), sequence.truth()
    assert noise is not None
    assert truth is not None
    sensor = Sensor(noise)
    views = {index: sensor.ray_image(sequence.frame(index)) for index in sequence.indices[:8]}
    return views, {index: se3.inverse(truth[index]) for index in views}


@pytest.mark.parametrize("place", quick_first(PLACES, 2))
def test_the_estimate_of_a_sequence_is_within_its_covariance(place: Array) -> None:
    views, poses = box()
    found = estimate(moved(views, place), poses)
    assert square(found, place) < chdtri(3, 0.01)
    assert np.all(np.sqrt(np.diag(found.covariance)) < (0.3, 0.3, 0.01))


@pytest.mark.parametrize("above_deg", [0.0, 35.0])
def test_squared_errors_are_those_of_the_covariance(above_deg: float) -> None:
    views = printed(above_deg=above_deg)
    poses = {index: se3.inverse(from_above(angle_deg, above_deg)) for index, angle_deg in enumerate(ANGLES_DEG)}
    squares = [square(estimate(moved(views, place), poses), place) for place in PLACES]
    assert np.mean(squares) < chdtri(3, 0.01)  # the same print: not independent


def test_a_large_shift_is_refined_from_where_the_search_finds_it() -> None:
    place = np.array([8.3, 0.0, 0.1])
    found = estimate(moved(printed(), place), poses_of(ANGLES_DEG))
    assert square(found, place) < chdtri(3, 0.01)
    assert np.sqrt(found.covariance[0, 0]) < 0.5


def test_without_print_the_prior_stays() -> None:
    flat = {index: recoloured(view, np.full(view.frame.depth_m.shape, 120.0)) for index, view in printed().items()}
    found = estimate(flat, poses_of(ANGLES_DEG))
    width = CAMERA.width
    np.testing.assert_array_equal(found.mean, 0.0)
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), (0.06 * width, 0.04 * width, 0.175))


def test_noise_before_a_pattern_tells_little() -> None:
    found = estimate(printed(0.0, noise=8.0), poses_of(ANGLES_DEG))
    assert square(found, np.zeros(3)) < chdtri(3, 0.01)
    assert np.all(np.sqrt(np.diag(found.covariance)) > (1.0, 1.0, 0.05))


def test_a_shift_along_the_axis_of_upright_surface_is_hardly_observable() -> None:
    """All views show the same print there, but for perspective."""
    found = estimate(printed(axes_m=(0.04, 5.0, 0.04)), poses_of(ANGLES_DEG))
    across_px, along_px, _ = np.sqrt(np.diag(found.covariance))
    assert square(found, np.zeros(3)) < chdtri(3, 0.01)
    assert along_px > 5.0 * across_px
