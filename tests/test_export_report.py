"""The report: its schema, why a model is not trusted, what a posterior leaves open; what was put in comes back."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ring_graphs import OBJECT_M, edge, spin
from run_builders import META, made_up_steps, strict_json, with_records

from modeler import se3
from modeler.export import RunFolder, edge_record, edges_of, poses_of
from modeler.export.report import undetermined
from modeler.graph import PoseGraph, solve
from modeler.types import (
    Array,
    Camera,
    Frame,
    Mode,
    Outcome,
    Plane,
    PoseGaussian,
    Posterior,
    RayImage,
    Solution,
    Stated,
    Step,
    explain,
)
from modeler.verdict import judged


def test_report_has_the_promised_schema(tmp_path: Path) -> None:
    run = RunFolder.open(tmp_path)
    for step in made_up_steps():
        run.write(step, META)
    report = strict_json((tmp_path / "report.json").read_text())
    assert report == run.report()
    head = {key: report[key] for key in ("schema", "sequence", "seed", "prior", "seconds")}
    assert head == {"schema": 2, "sequence": "box", "seed": 3, "prior": "table", "seconds": {"total": 1.5}}
    assert {"modeler", "gtsam", "numpy", "python"} <= set(report["versions"])
    assert report["frames"][1] == {
        "id": 5, "timestamp": 0.5, "points": 5, "outcome": "accepted", "cause": "", "mask": "converged"
    }  # fmt: skip
    assert [edge["kind"] for edge in report["edges"]] == ["odometry"] * 3 + ["closure"]
    edge, posterior = report["edges"][0], made_up_steps()[1].posteriors[0]
    assert {key: edge[key] for key in ("source", "target", "accepted", "outcome", "overlap", "effective_samples")} == {
        "source": 5, "target": 3, "accepted": True, "outcome": "converged", "overlap": 0.81, "effective_samples": 1234.5
    }  # fmt: skip
    assert edge["log_evidence"] is None  # not known, and NaN is no JSON
    assert edge["seconds"] is None
    np.testing.assert_array_equal(np.reshape(edge["target_from_source"], (4, 4)), posterior.pose.mean)
    np.testing.assert_array_equal(np.reshape(edge["covariance"], (6, 6)), posterior.pose.covariance)
    assert [pose["id"] for pose in report["poses"]] == [3, 5, 7, 9]
    for pose in report["poses"]:
        np.linalg.cholesky(np.reshape(pose["covariance"], (6, 6)))
        np.testing.assert_allclose(np.reshape(pose["object_from_camera"], (4, 4))[3], [0, 0, 0, 1])
    assert (report["complete"], report["closed"], report["trustworthy"], report["reasons"]) == (True, True, True, [])


def _spoilt(change: Callable[[Step], Step], path: Path, *, closure: bool = True) -> dict[str, Any]:
    run = RunFolder.open(path, overwrite=True)
    return [run.write(step, META) for step in with_records(map(change, made_up_steps(closure=closure)))][-1]


def test_report_says_why_a_model_is_not_to_be_trusted(tmp_path: Path) -> None:
    lost = "no overlap: The views share too little surface"
    report = _spoilt(lambda step: replace(step, left_out=Stated(lost)) if step.frame.index == 7 else step, tmp_path)
    assert (report["trustworthy"], report["reasons"]) == (False, [f"frame 7 was left out: {lost}"])

    report = _spoilt(lambda step: replace(step, verdict=judged(step, closure_expected=True)), tmp_path, closure=False)
    assert (report["trustworthy"], report["closed"]) == (False, False)
    assert "no loop was closed" in report["reasons"][0]

    def refuse(step: Step) -> Step:
        edges = [
            replace(edge, accepted=edge.kind == "odometry", reason=Stated("it lies")) for edge in step.edges_so_far
        ]
        return replace(step, edges_so_far=tuple(edges))

    report = _spoilt(refuse, tmp_path)
    assert report["reasons"] == ["none of 1 closures closed a loop; the last rejected one, frame 9 on frame 3: it lies"]

    def break_off(step: Step) -> Step:  # 5 -> 7 falls, so that the closure 9 -> 3 is all that holds the rest
        edges = [replace(edge, accepted=(edge.source, edge.target) != (7, 5)) for edge in step.edges_so_far]
        return replace(step, edges_so_far=tuple(edges))

    report = _spoilt(break_off, tmp_path)
    assert report["closed"] is False
    assert report["reasons"] == ["the edge between the first frames and the last is unconfirmed: no loop was closed"]

    def leave_out(step: Step) -> Step:
        outliers = tuple(edge for edge in step.edges_so_far if edge.kind == "closure")
        return replace(step, solution=replace(step.solution, outliers=outliers))

    report = _spoilt(leave_out, tmp_path)
    assert report["closed"] is False
    assert report["edges"][-1]["accepted"] is False
    assert "contradict" in report["edges"][-1]["reason"]
    assert "contradict" in report["reasons"][0]


def test_report_doubts_a_model_some_of_whose_frames_may_be_turned(tmp_path: Path) -> None:
    """A mug whose handle is hidden for some frames: the loop closes, and yet nothing tells how far it turned there."""

    def vague(*frames: int) -> Callable[[Step], Step]:
        def change(step: Step) -> Step:
            spread = np.diag([0.0, np.radians(9.0) ** 2, 0.0, 0.0, 0.0, 0.0])
            about_object = se3.adjoint(se3.translation(np.ones(3)))  # where the views of this run have their points
            spread = about_object @ spread @ about_object.T
            sure = step.solution.covariances
            covariances = {frame: sure[frame] + spread * (frame in frames) for frame in step.solution.trajectory}
            motions = Solution().relative_covariance  # not known: poses are judged relative to the first frame
            solution = replace(step.solution, covariances=covariances, relative_covariance=motions)
            return replace(step, solution=solution)

        return change

    assert _spoilt(vague(), tmp_path)["reasons"] == []
    one, some = (_spoilt(vague(*frames), tmp_path) for frames in ((7,), (5, 7, 9)))
    assert (one["closed"], one["trustworthy"]) == (True, False)
    assert one["reasons"] == ["the rotation of frame 7 is uncertain by 9.0° (one standard deviation)"]
    assert some["reasons"][0].endswith("(one standard deviation), 2 more by over 1.5°")


def test_posteriors_come_back_from_the_report_to_the_bit(tmp_path: Path) -> None:
    run = RunFolder.open(tmp_path)
    step = made_up_steps()[-1]
    rich = replace(
        step.edges_so_far[0].posterior,
        pareto_k=0.31,
        log_marginal_likelihood=-12.3,
        colour_correlation=0.7,
        independent_colours=80.5,
        seconds=0.1,
        outcome=Outcome.AMBIGUOUS,
    )
    edges = (replace(step.edges_so_far[0], posterior=rich), *step.edges_so_far[1:])
    run.write(replace(step, edges_so_far=edges), META)
    report = run.report()
    for sent, back in zip(edges, edges_of(report), strict=True):
        posterior = back.posterior
        assert (back.source, back.target, back.kind) == (sent.source, sent.target, sent.kind)
        assert (back.accepted, explain(back.reason)) == (sent.accepted, explain(sent.reason))
        np.testing.assert_array_equal(posterior.pose.mean, sent.posterior.pose.mean)
        np.testing.assert_array_equal(posterior.pose.covariance, sent.posterior.pose.covariance)
        assert posterior.outcome is sent.posterior.outcome
        for name in (
            "overlap",
            "colour_correlation",
            "independent_colours",
            "effective_samples",
            "pareto_k",
            "log_marginal_likelihood",
            "seconds",
        ):
            np.testing.assert_equal(getattr(posterior, name), getattr(sent.posterior, name))
    for frame, pose in poses_of(report).items():
        np.testing.assert_array_equal(pose.mean, step.solution.trajectory[frame])
        np.testing.assert_array_equal(pose.covariance, step.solution.covariances[frame])


# What a posterior leaves open, said in words, and how it stands in the report.

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


ALONG = np.array([1.0, 0.2, 0.3])
ROUND, LONG = _view((0.03, 0.03, 0.03)), _view((0.08, 0.02, 0.02), axis=ALONG)
WITHOUT_TABLE = _view((0.03, 0.03, 0.03), plane=False)


@pytest.mark.parametrize(
    ("sigmas_deg", "sigmas_mm", "axis", "view", "says"),
    [
        ((1.0, 1.0, 1.0), (1.0, 1.0, 1.0), None, ROUND, None),
        ((1.0, 1.0, 1.0), (1.0, 1.0, 1.0), None, None, None),
        ((31.0, 1.0, 2.0), (1.0, 1.0, 1.0), ALONG, LONG, "free to turn about its own axis: 31° sd"),
        ((12.0, 1.0, 2.0), (1.0, 1.0, 1.0), NORMAL, ROUND, "turn.* the table's normal: 12°"),
        ((12.0, 1.0, 2.0), (1.0, 1.0, 1.0), -NORMAL, ROUND, "turn.* the table's normal: 12°"),
        ((12.0, 1.0, 2.0), (1.0, 1.0, 1.0), (0.0, 0.1, 1.0), ROUND, "turn.* the viewing direction: 12°"),
        ((12.0, 1.0, 2.0), (1.0, 1.0, 1.0), (1.0, 0.0, 0.1), ROUND, "turn.* the camera's horizontal: 12°"),
        (
            (12.0, 1.0, 2.0),
            (1.0, 1.0, 1.0),
            (0.8, 0.0, -1.0),
            ROUND,
            r"turn.* the direction \(-0.62, 0.00, 0.78\) of the camera: 12°",
        ),
        ((40.0, 30.0, 20.0), (1.0, 1.0, 1.0), None, ROUND, "any axis: 20°"),
        # A free turn about the object moves a far camera by metres, and the object not at all.
        ((1.0, 1.0, 30.0), (1.0, 1.0, 1.0), None, WITHOUT_TABLE, "turn.* viewing direction: 30°"),
        ((1.0, 1.0, 1.0), (1.0, 1.0, 21.0), None, WITHOUT_TABLE, "shift.* viewing direction: 21 mm"),
        ((1.0, 1.0, 20.0), (50.0, 1.0, 1.0), None, None, "viewing direction: 20°"),
    ],
)
def test_what_a_posterior_leaves_open_goes_by_what_a_person_sees(
    sigmas_deg: Array, sigmas_mm: Array, axis: Array | None, view: RayImage | None, says: str | None
) -> None:
    axes = None if axis is None else _frame_of(np.array(axis))
    said = undetermined(_posterior(np.radians(sigmas_deg), 1e-3 * np.array(sigmas_mm), axes), view)
    assert len(said) == (says is not None)
    assert says is None or re.search(says, said[0])


def _two_modes() -> Posterior:
    sure = _posterior(SURE_RAD, SURE_M)
    turned = PoseGaussian(sure.pose.mean @ spin(np.pi / 2 * NORMAL), sure.pose.covariance)
    modes = (Mode(0.7, sure.pose), Mode(0.3, turned))
    wide = PoseGaussian(sure.pose.mean, sure.pose.covariance + 0.3 * np.eye(6))
    return replace(sure, pose=wide, modes=modes)


def test_modes_are_kept_apart_instead_of_called_free() -> None:
    (said,) = undetermined(_two_modes(), _view((0.03, 0.03, 0.03)))
    assert [words for words in ("90°", "the table's normal", "30 %", "70 %") if words not in said] == []


def test_modes_that_lie_near_each_other_are_reported_in_one_line() -> None:
    sure = _two_modes()
    near = PoseGaussian(sure.modes[0].pose.mean @ spin(np.radians(2.0) * NORMAL), sure.modes[0].pose.covariance)
    heaviest, turned = (replace(mode, weight=weight) for mode, weight in zip(sure.modes, (0.4, 0.3), strict=True))
    several = replace(sure, modes=(heaviest, Mode(0.2, near), turned, Mode(0.1, near)))
    away, nearby = undetermined(several, _view((0.03, 0.03, 0.03)))
    assert [words for words in ("90°", "the table's normal", "30 %", "40 %") if words not in away] == []
    assert [words for words in ("20 %", "10 %", "40 %") if words not in nearby] == []


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


def test_a_posterior_that_is_not_finite_leaves_nothing_to_name():
    broken = Posterior(0, 1, PoseGaussian(np.eye(4), np.full((6, 6), np.nan)), Outcome.DEGENERATE, 0.0)
    assert undetermined(broken) == []
