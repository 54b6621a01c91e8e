"""The report has the promised schema, says why a model is not to be trusted, and gives back what was put in."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from made_up import META, made_up_steps, strict_json

from modeler.export import (
    RunFolder,
    RunMeta,
    edges_of,
    poses_of,
)
from modeler.types import (
    Outcome,
    Stated,
    Step,
    explain,
)


def test_report_has_the_promised_schema(tmp_path: Path) -> None:
    run = RunFolder.open(tmp_path)
    for step in made_up_steps():
        run.write(step, META)
    report = strict_json((tmp_path / "report.json").read_text())
    assert report == run.report()
    head = {key: report[key] for key in ("schema", "sequence", "seed", "prior", "seconds")}
    assert head == {"schema": 1, "sequence": "box", "seed": 3, "prior": "table", "seconds": {"total": 1.5}}
    assert {"modeler", "gtsam", "numpy", "python"} <= set(report["versions"])
    assert report["frames"][1] == {"id": 5, "timestamp": 0.5, "points": 5, "outcome": "accepted", "cause": ""}
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


def _spoilt(change: Callable[[Step], Step], meta: RunMeta, path: Path) -> dict[str, Any]:
    run = RunFolder.open(path, overwrite=True)
    return [run.write(change(step), meta) for step in made_up_steps(closure=meta.closure_expected is False)][-1]


def test_report_says_why_a_model_is_not_to_be_trusted(tmp_path: Path) -> None:
    lost = "no overlap: The views share too little surface"
    report = _spoilt(
        lambda step: replace(step, left_out=Stated(lost)) if step.frame.index == 7 else step, META, tmp_path
    )
    assert (report["trustworthy"], report["reasons"]) == (False, [f"frame 7 was left out: {lost}"])

    report = _spoilt(lambda step: step, replace(META, closure_expected=True), tmp_path)
    assert (report["trustworthy"], report["closed"]) == (False, False)
    assert "no loop was closed" in report["reasons"][0]

    def refuse(step: Step) -> Step:
        edges = [
            replace(edge, accepted=edge.kind == "odometry", reason=Stated("it lies")) for edge in step.edges_so_far
        ]
        return replace(step, edges_so_far=tuple(edges))

    report = _spoilt(refuse, META, tmp_path)
    assert report["reasons"] == ["none of 1 closures closed a loop; the last refused, frame 9 on frame 3: it lies"]

    def break_off(step: Step) -> Step:  # 5 -> 7 falls, so that the closure 9 -> 3 is all that holds the rest
        edges = [replace(edge, accepted=(edge.source, edge.target) != (7, 5)) for edge in step.edges_so_far]
        return replace(step, edges_so_far=tuple(edges))

    report = _spoilt(break_off, META, tmp_path)
    assert report["closed"] is False
    assert report["reasons"] == ["what joins the first frames to the last is confirmed by nothing: no loop was closed"]

    def see_little(step: Step) -> Step:
        edges = [replace(edge, posterior=replace(edge.posterior, overlap=0.45)) for edge in step.edges_so_far]
        return replace(step, edges_so_far=tuple(edges))

    report = _spoilt(see_little, META, tmp_path)  # no edge of a loop stands alone
    assert report["reasons"] == []
    run, chain = RunFolder.open(tmp_path, overwrite=True), replace(META, closure_expected=False)
    report = [run.write(see_little(step), chain) for step in made_up_steps(closure=False)][-1]
    assert [reason.partition(" share")[0] for reason in report["reasons"]] == [
        f"frames {frame} and {frame - 2}" for frame in (5, 7, 9)
    ]

    def leave_out(step: Step) -> Step:
        outliers = tuple(edge for edge in step.edges_so_far if edge.kind == "closure")
        return replace(step, solution=replace(step.solution, outliers=outliers))

    report = _spoilt(leave_out, META, tmp_path)
    assert report["closed"] is False
    assert report["edges"][-1]["accepted"] is False
    assert "contradict" in report["edges"][-1]["reason"]
    assert "contradict" in report["reasons"][0]


def test_report_doubts_a_model_some_of_whose_frames_may_be_turned(tmp_path: Path) -> None:
    """A mug whose handle is hidden for some frames: the loop closes, and yet nothing tells how far it turned there."""

    def vague(*frames: int) -> Callable[[Step], Step]:
        def change(step: Step) -> Step:
            spread = np.diag([0.0, np.radians(9.0) ** 2, 0.0, 0.0, 0.0, 0.0])
            sure = step.solution.covariances
            covariances = {frame: sure[frame] + spread * (frame in frames) for frame in step.solution.trajectory}
            return replace(step, solution=replace(step.solution, covariances=covariances))

        return change

    assert _spoilt(vague(), META, tmp_path)["reasons"] == []
    one, some = (_spoilt(vague(*frames), META, tmp_path) for frames in ((7,), (5, 7, 9)))
    assert (one["closed"], one["trustworthy"]) == (True, False)
    assert one["reasons"] == ["frame 7 may be turned by 9° (one standard deviation)"]
    assert some["reasons"][0].endswith("(one standard deviation), 2 more by over 5°")


def test_report_in_the_middle_of_a_run_says_so(tmp_path: Path) -> None:
    run = RunFolder.open(tmp_path)
    report = [run.write(step, META) for step in made_up_steps()[:2]][-1]
    assert (report["complete"], report["trustworthy"]) == (False, False)
    assert "the run has not finished" in report["reasons"]


def test_posteriors_come_back_from_the_report_to_the_bit(tmp_path: Path) -> None:
    run = RunFolder.open(tmp_path)
    step = made_up_steps()[-1]
    rich = replace(
        step.edges_so_far[0].posterior,
        pareto_k=0.31,
        log_evidence=-12.3,
        seconds=0.1,
        outcome=Outcome.AMBIGUOUS,
    )
    edges = (replace(step.edges_so_far[0], posterior=rich), *step.edges_so_far[1:])
    run.write(replace(step, edges_so_far=edges), META)
    report = run.report()
    for edge, back in zip(edges, edges_of(report), strict=True):
        posterior = back.posterior
        assert (back.source, back.target, back.kind) == (edge.source, edge.target, edge.kind)
        assert (back.accepted, explain(back.reason)) == (edge.accepted, explain(edge.reason))
        np.testing.assert_array_equal(posterior.pose.mean, edge.posterior.pose.mean)
        np.testing.assert_array_equal(posterior.pose.covariance, edge.posterior.pose.covariance)
        assert posterior.outcome is edge.posterior.outcome
        for name in ("overlap", "effective_samples", "pareto_k", "log_evidence", "seconds"):
            np.testing.assert_equal(getattr(posterior, name), getattr(edge.posterior, name))
    for frame, pose in poses_of(report).items():
        np.testing.assert_array_equal(pose.mean, step.solution.trajectory[frame])
        np.testing.assert_array_equal(pose.covariance, step.solution.covariances[frame])
