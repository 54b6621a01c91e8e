"""What a posterior leaves open, said in words, and how it stands in the report."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rings import OBJECT_M, edge, measured, ring, spin, turntable

from modeler import se3
from modeler.export import edge_record, g2o_text
from modeler.export.reading import edges_of
from modeler.export.report import undetermined
from modeler.graph import PoseGraph, solve
from modeler.types import Array, Camera, Frame, Mode, Outcome, Plane, PoseGaussian, Posterior, RayImage, Solution

NORMAL = np.array([0.0, -np.sqrt(0.75), -0.5])


def _view(sizes_m: tuple[float, float, float], *, axis: Array | None = None, plane: bool = True) -> RayImage:
    """An ellipsoid of points whose long side lies along `axis`, on a table that slopes away from the camera."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(400, 3)) * np.array(sizes_m)
    if axis is not None:
        first = axis / np.linalg.norm(axis)
        second = np.linalg.svd(first[None])[2][1]
        points = points @ np.stack([first, second, np.cross(first, second)])
    points = points - points.mean(axis=0) + OBJECT_M
    frame = Frame(0, 0.0, np.full((2, 2), 0.8, dtype=np.float32), Camera(2, 2, 500.0, 500.0, 0.5, 0.5))
    table = Plane(NORMAL, 0.9, 0.01, 0.001) if plane else None
    pixels = np.zeros((len(points), 2), dtype=np.int64)
    return RayImage(frame, table, 0.001, 0.001, points, np.zeros_like(points), pixels)


def _posterior(sigmas_rad: Array, sigmas_m: Array, axes: Array | None = None) -> Posterior:
    """A posterior whose errors, about the object's middle, have these standard deviations along rows of axes."""
    axes = np.eye(3) if axes is None else axes
    about = np.zeros((6, 6))
    about[:3, :3], about[3:, 3:] = (axes.T @ np.diag(np.square(s)) @ axes for s in (sigmas_rad, sigmas_m))
    adjoint = se3.adjoint(se3.translation(OBJECT_M))
    pose = PoseGaussian(se3.exp(np.array([0.0, 0.4, 0.0, -0.3, 0.0, 0.1])), adjoint @ about @ adjoint.T)
    return Posterior(1, 0, pose, Outcome.CONVERGED, overlap=0.8)


def _frame_of(axis: Array) -> Array:
    first = axis / np.linalg.norm(axis)
    second = np.linalg.svd(first[None])[2][1]
    return np.stack([first, second, np.cross(first, second)]).astype(np.float64)


SURE_RAD, SURE_M = np.radians([1.0, 1.0, 1.0]), np.array([1e-3, 1e-3, 1e-3])


def test_nothing_is_said_where_all_is_determined() -> None:
    assert undetermined(_posterior(SURE_RAD, SURE_M), _view((0.05, 0.05, 0.05))) == []
    assert undetermined(_posterior(SURE_RAD, SURE_M)) == []


def test_a_tube_is_free_to_turn_about_its_own_axis() -> None:
    along = np.array([1.0, 0.2, 0.3])
    posterior = _posterior(np.radians([31.0, 1.0, 2.0]), SURE_M, _frame_of(along))
    assert undetermined(posterior, _view((0.08, 0.02, 0.02), axis=along)) == ["free to turn about its own axis: 31° sd"]


@pytest.mark.parametrize(
    ("axis", "words"),
    [
        (NORMAL, "the table's normal"),
        (-NORMAL, "the table's normal"),
        (np.array([0.0, 0.1, 1.0]), "the viewing direction"),
        (np.array([1.0, 0.0, 0.1]), "the camera's horizontal"),
        (np.array([0.8, 0.0, -1.0]), "the direction (-0.62, 0.00, 0.78) of the camera"),
    ],
)
def test_an_axis_goes_by_what_a_person_sees(axis: Array, words: str) -> None:
    posterior = _posterior(np.radians([12.0, 1.0, 2.0]), SURE_M, _frame_of(axis))
    assert undetermined(posterior, _view((0.03, 0.03, 0.03))) == [f"free to turn about {words}: 12° sd"]


def test_camera_is_named_where_no_view_is_at_hand() -> None:
    posterior = _posterior(np.radians([1.0, 1.0, 20.0]), np.array([0.05, 1e-3, 1e-3]))
    assert undetermined(posterior) == ["free to turn about the viewing direction: 20° sd"]


def test_shift_is_of_the_object_not_of_the_camera() -> None:
    """A free turn about the object moves a far camera by metres, and the object not at all."""
    turned = _posterior(np.radians([1.0, 1.0, 30.0]), SURE_M)
    assert undetermined(turned, _view((0.03, 0.03, 0.03), plane=False)) == [
        "free to turn about the viewing direction: 30° sd"
    ]
    shifted = _posterior(SURE_RAD, np.array([1e-3, 1e-3, 0.021]))
    assert undetermined(shifted, _view((0.03, 0.03, 0.03), plane=False)) == [
        "free to shift along the viewing direction: 21 mm sd"
    ]


def test_a_ball_is_free_to_turn_at_all() -> None:
    posterior = _posterior(np.radians([40.0, 30.0, 20.0]), SURE_M)
    assert undetermined(posterior, _view((0.03, 0.03, 0.03))) == ["free to turn about any axis: 20° sd and more"]


def _two_modes() -> Posterior:
    sure = _posterior(SURE_RAD, SURE_M)
    turned = PoseGaussian(sure.pose.mean @ spin(np.pi / 2 * NORMAL), sure.pose.covariance)
    modes = (Mode(0.7, sure.pose), Mode(0.3, turned))
    wide = PoseGaussian(sure.pose.mean, sure.pose.covariance + 0.3 * np.eye(6))
    return replace(sure, pose=wide, modes=modes)


def test_modes_are_told_apart_instead_of_called_free() -> None:
    assert undetermined(_two_modes(), _view((0.03, 0.03, 0.03))) == [
        "perhaps turned by 90° more about the table's normal: 30 % against 70 %"
    ]


def test_modes_that_lie_near_each_other_are_told_in_one_line() -> None:
    sure = _two_modes()
    near = PoseGaussian(sure.modes[0].pose.mean @ spin(np.radians(2.0) * NORMAL), sure.modes[0].pose.covariance)
    heaviest, turned = (replace(mode, weight=weight) for mode, weight in zip(sure.modes, (0.4, 0.3), strict=True))
    several = replace(sure, modes=(heaviest, Mode(0.2, near), turned, Mode(0.1, near)))
    assert undetermined(several, _view((0.03, 0.03, 0.03))) == [
        "perhaps turned by 90° more about the table's normal: 30 % against 40 %",
        "perhaps elsewhere nearby: 20 %, 10 % against 40 %",
    ]


def test_report_holds_modes_words_and_what_the_graph_made_of_them() -> None:
    posterior = _two_modes()
    judged = edge(0, 1, posterior.pose, modes=posterior.modes)
    pinned = edge(0, 1, posterior.modes[1].pose, "closure")
    for closures, wanted in (((), [0.7, 0.3]), ((pinned,), [0.0, 1.0])):
        record = edge_record(judged, solve(PoseGraph((judged, *closures)), {}), _view((0.03, 0.03, 0.03)))
        assert len(record["undetermined"]) == 1
        assert [mode["weight"] for mode in record["modes"]] == [0.7, 0.3]
        np.testing.assert_allclose([mode["weight_in_graph"] for mode in record["modes"]], wanted, atol=1e-6)
        np.testing.assert_array_equal(record["modes"][1]["target_from_source"], posterior.modes[1].pose.mean.ravel())
        back = edges_of({"edges": [record]})[0].posterior
        assert [mode.weight for mode in back.modes] == [0.7, 0.3]
        for mode, other in zip(back.modes, posterior.modes, strict=True):
            np.testing.assert_array_equal(mode.pose.mean, other.pose.mean)
            np.testing.assert_array_equal(mode.pose.covariance, other.pose.covariance)
    left_out = edge_record(replace(judged, accepted=False), Solution())
    assert [mode["weight_in_graph"] for mode in left_out["modes"]] == [None, None]
    plain = edge_record(edge(0, 1, posterior.modes[0].pose), Solution())
    assert (plain["modes"], plain["undetermined"]) == ([], [])


def test_report_of_a_run_without_modes_is_read_back() -> None:
    record = edge_record(edge(0, 1, _posterior(SURE_RAD, SURE_M).pose), Solution())
    del record["modes"]
    assert edges_of({"edges": [record]})[0].posterior.modes == ()


def test_graph_file_holds_the_mode_that_was_chosen() -> None:
    rng = np.random.default_rng(1)
    graph, _ = ring(6, rng, [(0, 5)])
    first = graph.edges[2]
    true = measured(turntable(6), first.target, first.source, rng)
    wrong = PoseGaussian(true.mean @ se3.exp(np.array([0.0, 1.5, 0.0, 0.0, 0.0, 0.0])), true.covariance)
    several = edge(first.target, first.source, wrong, modes=[Mode(0.6, wrong), Mode(0.4, true)])
    graph = PoseGraph((*graph.edges[:2], several, *graph.edges[3:]))
    text = g2o_text(graph.edges, solve(graph, {}))
    (line,) = [
        line for line in text.splitlines() if line.startswith(f"EDGE_SE3:QUAT {several.target} {several.source}")
    ]
    np.testing.assert_allclose(np.array(line.split()[3:6], dtype=np.float64), true.mean[:3, 3])


def test_a_posterior_that_is_not_finite_leaves_nothing_to_name():
    broken = Posterior(0, 1, PoseGaussian(np.eye(4), np.full((6, 6), np.nan)), Outcome.DEGENERATE, 0.0)
    assert undetermined(broken) == []
