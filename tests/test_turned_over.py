"""An object that is put down otherwise on the way: its segments are found, joined and judged."""

import signal
from collections.abc import Mapping
from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tabletop
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.cli.build import _events
from modeler.cli.console import Interrupt
from modeler.closure import Closer, MapView
from modeler.evaluation import rotation_error_deg, true_motion
from modeler.export import PairCache, Pairs
from modeler.graph import PoseGraph, Smoother, solve
from modeler.graph.axis import steps_of
from modeler.graph.pose_graph import Factor
from modeler.pipeline import Modeler
from modeler.pipeline.correcting import contradicting, most_crossed
from modeler.pipeline.joining import Alignment, Joiner, Segment
from modeler.pipeline.run import Run
from modeler.pipeline.state import State
from modeler.priors import TablePrior
from modeler.registration import VisibilityLikelihood, VisibilityRegistrar
from modeler.segmentation import Scene
from modeler.sequences.rendering import RenderedSequence
from modeler.sequences.rendering.cameras import DepthSensor
from modeler.sequences.rendering.recipe import Recipe, Table, Tabletop, TurnedOver, Viewpoint
from modeler.sequences.rendering.shapes import Box, Capsule, Compound, Part, Sphere
from modeler.types import (
    Array,
    Edge,
    EdgeKind,
    ElsewhereThanSegments,
    Event,
    JoinsSegments,
    OpenRotation,
    Outcome,
    PoseGaussian,
    Posterior,
    RayImage,
    Searching,
    SensorNoise,
    Solution,
    Stated,
    Step,
    segments,
)
from modeler.verdict.evidence import other_modes
from modeler.views import Sensor
from studies.trust.plan import coarser

LOPSIDED = Compound(
    (
        Part(Box((0.09, 0.06, 0.04))),
        Part(Sphere(0.022), offset_m=(0.03, 0.01, 0.03)),
        Part(Capsule(0.01, 0.06), offset_m=(-0.03, -0.02, 0.03), rotation_deg=(30.0, 0.0, 20.0)),
    )
)
POSTURE = 4
"""Frames of each posture."""
RECIPE = Recipe(
    LOPSIDED,
    "lopsided",
    3,
    turned_over=TurnedOver(POSTURE, (-90.0, 0.0, 0.0)),
    view=Viewpoint(200, 150, 260.0, 0.55, look_height_m=0.03),
    table=Table((0.5, 0.5)),
    sensor=coarser(DepthSensor(), 0.5),
    trajectory=Tabletop(2 * POSTURE, 25.0, 1.0, shift_m=0.005),
)


def edge(
    source: int, target: int, kind: EdgeKind = "odometry", pose: Array | None = None, covariance: Array | None = None
) -> Edge:
    gaussian = PoseGaussian(np.eye(4) if pose is None else pose, 1e-6 * np.eye(6) if covariance is None else covariance)
    return Edge(Posterior(source, target, gaussian, Outcome.CONVERGED, overlap=0.8), kind, True, Stated("made up"))


def brick_views(poses: list[Array]) -> dict[int, RayImage]:
    sensor = Sensor(SensorNoise(1e-3, 1e-3))
    return {k: sensor.ray_image(view.frame) for k, view in tabletop.views(tabletop.BRICK, poses).items()}


def shifted(views: dict[int, RayImage], by: int) -> dict[int, RayImage]:
    """Return views as if their frames had higher numbers."""
    return {k + by: replace(view, frame=replace(view.frame, index=k + by)) for k, view in views.items()}


def test_a_recipe_puts_the_object_down_otherwise_and_it_stands_on_the_table() -> None:
    sequence = RenderedSequence(RECIPE)
    table_from_camera = se3.inverse(RECIPE.view.camera_from_table())
    tops = []
    for index, pose in sequence.truth().items():
        standing = se3.transform(table_from_camera @ pose, RECIPE.object.mesh().vertices_m)
        assert abs(standing[:, 2].min()) < 1e-9, index
        tops.append(standing[:, 2].max())
    np.testing.assert_allclose(tops[:POSTURE], tops[0])
    np.testing.assert_allclose(tops[POSTURE:], tops[-1])
    assert abs(tops[0] - tops[-1]) > 0.005


def test_both_postures_make_one_model_and_the_table_ties_neither_to_the_other() -> None:
    sequence = RenderedSequence(RECIPE)
    modeler = Modeler(prior=TablePrior(), sensor=Sensor(sequence.sensor()), closer=Closer(max_relocations=0))
    steps = [event for event in modeler.run(sequence, Scene()) if isinstance(event, Step)]
    last, truth = steps[-1], sequence.truth()
    lost = {step.frame.index for step in steps if step.left_out is not None}
    assert lost == set(range(POSTURE, 2 * POSTURE))  # at first
    assert {step.frame.index for step in steps if step.accepted} == set(truth)
    for frame, pose in last.solution.trajectory.items():
        assert rotation_error_deg(pose, true_motion(truth, 0, frame)) < 3.0
    segment_of = segments([one for one in last.edges_so_far if last.solution.takes_part(one)])
    assert [segment_of[frame] for frame in range(2 * POSTURE)] == POSTURE * [0] + POSTURE * [1]
    joins = [one for one in last.edges_so_far if one.kind == "join" and last.solution.takes_part(one)]
    assert len(joins) >= 2
    assert other_modes(joins, last.solution, last.views, 0.005).value < 1e-3


def test_a_brick_may_lie_either_way_round_and_that_is_said() -> None:
    poses = tabletop.turntable(12)
    views, placed = brick_views(poses), tabletop.trajectory(poses)
    halves = range(0, 12, 2), range(1, 12, 2)  # no image is in both: noise would tell which way it lies
    one, other = (Segment({k: views[k] for k in half}, Solution({k: placed[k] for k in half}), ()) for half in halves)
    halfway = se3.exp(np.array([0.0, 0.0, np.pi, 0.0, 0.0, 0.0]))
    quarter = se3.exp(np.array([0.0, 0.0, 0.5 * np.pi, 0.0, 0.0, 0.0]))
    ways = [Alignment(pose) for pose in (quarter, np.eye(4), halfway)]
    found = Joiner().weighted(one, other, ways)
    assert [Joiner().is_consistent(one, other, way) for way in found] == [True, True, False]
    assert 0.05 < found[0].share < 0.95
    assert found[1].share > 0.05
    assert found[2].share < 1e-6
    np.testing.assert_array_equal(found[2].target_from_source, quarter)
    why = JoinsSegments(found[0].share, 180.0)
    joins = [replace(edge(6, 0, "join"), reason=why), replace(edge(7, 1, "join"), reason=why)]
    assert not other_modes(joins, Solution(), {}, 0.005).holds


@pytest.mark.parametrize("bend", [1.0, 1.02, 1.05])
def test_a_right_alignment_does_not_pay_for_poses_that_err_within_segments(bend: float) -> None:
    """Pairs that share surface pay for them; an alignment that shares less must not be the likelier for it."""
    poses = tabletop.turntable(6)
    views = brick_views(poses)
    true = tabletop.trajectory(poses)
    bent = {k: true[0] @ se3.exp(bend * se3.log(se3.inverse(true[0]) @ pose)) for k, pose in true.items()}
    parts = Segment(views, Solution(bent), ()), Segment(shifted(views, 6), Solution({k + 6: bent[k] for k in bent}), ())
    assert Joiner().likelihoods(*parts, [Alignment(np.eye(4))])[0] > 0.0


def printed_views(poses: list[Array]) -> dict[int, RayImage]:
    """Return views of a brick with print."""
    rng, sensor = np.random.default_rng(0), Sensor(SensorNoise(1e-3, 1e-3))
    waves, phases = rng.normal(scale=300.0, size=(20, 3)), rng.uniform(0.0, 2.0 * np.pi, 20)
    views = {}
    for k, one in tabletop.views(tabletop.BRICK, poses).items():
        grey = np.full(one.frame.depth_m.shape, 60.0)
        on_body_m = se3.transform(se3.inverse(poses[k]), one.points_m)
        grey[tuple(one.pixels.T)] = 120.0 + 12.0 * np.sum(np.sin(on_body_m @ waves.T + phases), axis=1)
        grey = np.clip(grey + rng.normal(size=grey.shape), 0.0, 255.0)
        views[k] = sensor.ray_image(tabletop.recoloured(one, grey).frame)
    return views


@pytest.mark.parametrize(("first", "last"), [(range(9), range(6, 15)), (range(3), range(4, 7))])
def test_sessions_that_share_few_views_are_held_against_pairs_that_share_as_little(first: range, last: range) -> None:
    """Print that agrees gains much in near views; views of two sessions are farther apart than those of one."""
    poses = tabletop.turntable(16)
    views, true = printed_views(poses), tabletop.trajectory(poses)
    parts = (
        Segment({k: views[k] for k in first}, Solution({k: true[k] for k in first}), ()),
        Segment(shifted({k: views[k] for k in last}, 16), Solution({k + 16: true[k] for k in last}), ()),
    )
    turns = [np.zeros(6), *np.pi * np.eye(6)[[0, 2]]]  # a brick fits its hull upside down and the other way round
    found = [Joiner().is_consistent(*parts, Alignment(se3.exp(turn))) for turn in turns]
    assert found == [True, False, False]


def test_sessions_that_are_bent_are_compared_as_they_are_once_joined() -> None:
    """Steps that are 2 % too long add up along a session; upside down, less surface is shared that suffers by it."""
    poses = tabletop.turntable(16)
    views, true = printed_views(poses), tabletop.trajectory(poses)
    bent = {0: true[0]}
    for k in range(15):
        bent[k + 1] = bent[k] @ se3.exp(1.02 * se3.log(se3.inverse(true[k]) @ true[k + 1]))
    about_body = np.diag(np.repeat([8e-3, 1e-3], 3) ** 2)
    bent_parts = []
    for offset, frames in ((0, range(9)), (16, range(6, 15))):
        steps = []
        for k in frames[:-1]:
            adjoint = se3.adjoint(se3.inverse(bent[k + 1]))
            covariance = adjoint @ about_body @ adjoint.T
            steps.append(edge(k + 1 + offset, k + offset, "odometry", se3.inverse(bent[k]) @ bent[k + 1], covariance))
        placed = Solution({k + offset: bent[k] for k in frames})
        bent_parts.append(Segment(shifted({k: views[k] for k in frames}, offset), placed, tuple(steps)))
    parts = bent_parts[0], bent_parts[1]
    joiner = Joiner(pairs=4)
    ways = [joiner._registered(*parts, se3.exp(turn)) for turn in [np.pi * np.eye(6)[0], np.zeros(6)]]
    found = joiner.weighted(*parts, ways)
    assert found[0].target_from_source is ways[1].target_from_source
    assert found[0].share > 0.999
    assert joiner.is_consistent(*parts, found[0])
    assert joiner.likelihoods(*parts, [found[0]]) > joiner.likelihoods(*parts, [replace(found[0], trajectory=None)])


@pytest.mark.parametrize(("sigma_deg", "accepted"), [(1.0, True), (5.0, False)])
def test_a_rotation_that_the_alignment_alone_bounds_joins_nothing(sigma_deg: float, accepted: bool) -> None:
    """A mug whose handle is hidden: the pair would repeat whatever the alignment of the models said."""
    pose = tabletop.turntable(6)[0]
    view = Sensor(SensorNoise(1e-3, 1e-3)).ray_image(tabletop.view(tabletop.BRICK, pose, 0).frame)
    spread = np.diag([1e-6, np.radians(sigma_deg) ** 2, *np.full(4, 1e-6)])
    found = Posterior(0, 0, PoseGaussian(np.eye(4), spread), Outcome.CONVERGED, overlap=0.9)
    judged = Joiner()._judged(found, (view, view), np.eye(4))
    assert judged.accepted is accepted
    assert isinstance(judged.reason, OpenRotation) is not accepted


def test_segments_are_what_hangs_together_without_joins() -> None:
    edges = [edge(1, 0), edge(2, 1), edge(6, 5), edge(5, 2, "join"), edge(6, 0, "join")]
    found = segments(edges)
    assert found[0] == found[1] == found[2] != found[5] == found[6]
    factors = [Factor(one, one.posterior.pose) for one in edges]
    assert steps_of(factors, found) == [(0, 1), (1, 2), (5, 6)]


def test_spans_stay_within_a_segment() -> None:
    turns_deg = [0.0, 25.0, 50.0, 75.0, 5.0, 30.0, 55.0, 80.0]
    poses = tabletop.turntable(72)
    views = {k: tabletop.view(tabletop.BRICK, poses[int(turn / 5.0)], k) for k, turn in enumerate(turns_deg)}
    truth = {k: se3.inverse(poses[int(turn / 5.0)]) for k, turn in enumerate(turns_deg)}
    base = se3.inverse(truth[0])

    def between(source: int, target: int, kind: EdgeKind = "odometry") -> Edge:
        return edge(source, target, kind, se3.inverse(truth[target]) @ truth[source])

    chain = [between(k, k - 1) for k in (1, 2, 3, 5, 6, 7)]
    edges = (*chain, between(4, 0, "join"), between(5, 1, "join"))
    solution = solve(PoseGraph(edges, first=0), {k: base @ pose for k, pose in truth.items()})
    pairs = Closer().span_pairs(MapView(views, solution, edges))
    assert pairs
    assert all((source < 4) == (target < 4) for source, target in pairs)


def test_postures_of_the_study_rest_on_the_table() -> None:
    from studies.turned_over.plan import Plan

    stage = Plan("tuning", 0).stage()
    before, after = (
        Rotation.from_euler("xyz", turns, degrees=True).as_matrix()
        for turns in (stage.recipe.rest_rotation_deg, stage.recipe.turned_over.rest_rotation_deg)
    )
    assert np.degrees(np.arccos(np.clip(before[2] @ after[2], -1.0, 1.0))) > 59.0


def test_alignments_are_judged_by_the_likelihood_of_the_run(tmp_path: Path) -> None:
    depth_alone = VisibilityRegistrar(VisibilityLikelihood(colour=False))
    cached = Modeler(registrar=depth_alone, cache=PairCache(Pairs(tmp_path), {}))
    assert cached.joiner(cached.tracker(State()))._visibility is depth_alone


def misplaced(step_deg: float, turn_rad: float) -> tuple[Run, Mapping[int, Array]]:
    """A run of six frames whose pair of frames 2 and 3 is turned by an angle, and the true poses."""
    table = Tabletop(6, step_deg, 1.0, shift_m=0.005)
    sequence = RenderedSequence(replace(RECIPE, turned_over=None, trajectory=table))
    run = Modeler(prior=TablePrior(), sensor=Sensor(sequence.sensor())).start(Scene())
    list(run.track(sequence))
    middle_m = run.state.views[3].centroid_m

    def wrong(edge: Edge) -> Edge:
        if (edge.source < 3) == (edge.target < 3):
            return edge
        pose = edge.posterior.pose
        turn = se3.exp(np.array([0.0, turn_rad, 0.0, 0.0, 0.0, 0.0]))
        turn[:3, 3] = middle_m - turn[:3, :3] @ middle_m
        posterior = replace(edge.posterior, pose=replace(pose, mean=pose.mean @ turn))
        return replace(edge, posterior=posterior, accepted=edge.kind == "odometry")

    lost = replace(edge(9, 2), accepted=False)
    graph = replace(run.state.graph, edges=(*map(wrong, run.state.graph.edges), lost))
    run.state = replace(run.state, graph=graph, smoother=Smoother().to(graph))
    truth = sequence.truth()
    off_deg = rotation_error_deg(run.state.solution.trajectory[3], true_motion(truth, 0, 3))
    assert off_deg > 0.7 * np.degrees(turn_rad)
    return run, truth


def test_registrations_that_agree_on_another_pose_than_a_wrong_pair_correct_it() -> None:
    """A small error contradicts no free space, but the further pairs of the refinement."""
    run, truth = misplaced(12.0, 0.12)
    list(run.refine())
    refused = contradicting(run.state)
    assert len(refused) >= 2
    assert most_crossed(run.state, refused) == (2, 3)
    assert [event for event in run.correct() if isinstance(event, Searching)] == [Searching(3)]
    for frame, pose in run.state.solution.trajectory.items():
        assert rotation_error_deg(pose, true_motion(truth, 0, frame)) < 1.5, frame
    assert not contradicting(run.state)
    assert {edge for edge in run.state.graph.accepted if edge.kind == "span" and edge.target < 3 <= edge.source}


def test_a_pair_that_matches_by_chance_does_not_misplace_all_frames_after_it() -> None:
    run, truth = misplaced(30.0, 1.0)
    hurried: list[Event] = []
    with Interrupt() as interrupt:
        for event in _events(copy(run), (), interrupt, live=False):
            hurried.append(event)
            if event == Searching(3):
                signal.raise_signal(signal.SIGINT)
    assert hurried.count(Searching(3)) == 1
    assert isinstance(last := hurried[-1], Step)
    assert not last.verdict.trustworthy
    assert all(one.kind != "join" for one in last.edges_so_far)
    assert [event for event in run.correct() if isinstance(event, Searching)] == [Searching(3)]
    for frame, pose in run.state.solution.trajectory.items():
        assert rotation_error_deg(pose, true_motion(truth, 0, frame)) < 3.0, frame
    assert 9 in {one.source for one in run.state.graph.edges}  # of a frame that was lost
    across = [one for one in run.state.graph.edges if one.source != 9 and (one.source < 3) != (one.target < 3)]
    assert {one.kind for one in across if run.state.solution.takes_part(one)} == {"join"}
    (reason,) = [one.reason for one in across if one.kind == "odometry"]
    assert isinstance(reason, ElsewhereThanSegments)
    assert abs(reason.angle_deg - np.degrees(1.0)) < 3.0
    assert not any(isinstance(event, Searching) for event in run.correct())  # nothing is contradicted any more
