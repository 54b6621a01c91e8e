"""The loop, with a registrar that knows the truth: what joins, what is left out, and what a step says about it."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import final

import numpy as np
import pytest
import tabletop

from modeler import se3
from modeler.closure import Closer, Thresholds
from modeler.fusion import Fuser
from modeler.graph import CommonAxis, PoseGraph, shared_noise, solve
from modeler.pipeline import Modeler, Prepared
from modeler.pipeline.joining import Alignment, Joiner, Segment
from modeler.pipeline.state import State
from modeler.priors.mixtures import DefensiveMixture, KernelMixture
from modeler.segmentation import Scene, Segmenter, scene_frames
from modeler.types import (
    AbstractPoseDensity,
    AbstractPrior,
    AbstractRegistrar,
    Array,
    Edge,
    Failed,
    Frame,
    Fusing,
    InputError,
    Outcome,
    PoseGaussian,
    Posterior,
    PriorRefused,
    RayImage,
    Refining,
    Segmentation,
    SensorNoise,
    SharedAxis,
    Solution,
    Step,
    ViewPair,
    explain,
)
from modeler.views import Sensor

BOX = tabletop.Box((0.06, 0.045, 0.08))
POSES = tabletop.turntable(9)
COLOURED = [view.frame for view in tabletop.views(BOX, POSES, np.random.default_rng(0)).values()]
FRAMES = [replace(frame, colour=None) for frame in COLOURED]
"""Without colours, of which the oracle makes nothing: they take half of the time of a run, to be fused and judged."""
SIGMAS = np.repeat([0.002, 0.0005], 3)
CLOSER = Closer(max_span_deg=85.0, min_span_gain_nats=0.0, thresholds=Thresholds(min_overlap=0.2))
"""It closes over two steps of the turntable too."""


@final
@dataclass(frozen=True)
class AnyDensity(AbstractPoseDensity):
    steps: float = 1.0
    possible: bool = True
    evidence = True

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        return np.broadcast_to(np.eye(4), (count, 4, 4))

    def log_density(self, target_from_source: Array) -> Array:
        return np.full(len(target_from_source), 0.0 if self.possible else -np.inf)


@final
@dataclass(frozen=True)
class AnyPrior(AbstractPrior):
    refused: frozenset[tuple[int, int]] = frozenset()
    beyond: frozenset[tuple[int, int]] = frozenset()
    steps: float = 1.0
    axis: SharedAxis | None = None
    lessons: list[tuple[list[int], int]] = field(default_factory=list)

    def between(self, source: RayImage, target: RayImage) -> AbstractPoseDensity:
        if (source.index, target.index) in self.refused:
            raise InputError(f"frames {source.index} and {target.index}: no plane")
        return AnyDensity(self.steps, (source.index, target.index) not in self.beyond)

    def relaxed(self, steps: float) -> AbstractPrior:
        return replace(self, steps=steps)

    def unlimited(self) -> AbstractPrior | None:
        return replace(self, beyond=frozenset(), steps=np.inf) if self.beyond else None

    def learned(self, solution: Solution, edges: Sequence[Edge]) -> AbstractPrior:
        self.lessons.append((list(solution.trajectory), len(edges)))
        return self

    def shared_axis(self, views: Collection[RayImage]) -> SharedAxis | None:
        return self.axis


@final
@dataclass(frozen=True)
class Oracle(AbstractRegistrar):
    noise: float = 0.0
    blind: frozenset[int] = frozenset()
    apart: frozenset[tuple[int, int]] = frozenset()
    reach: float = 1.0
    asked: list[tuple[int, int]] = field(default_factory=list)
    priors: list[tuple[int, int, float]] = field(default_factory=list)
    quick: Oracle | None = None
    """Asked for little effort."""

    @property
    def least_effort(self) -> float:
        return 1.0 if self.quick is None else 0.25

    def posterior_of(self, pair: ViewPair) -> Posterior:
        if pair.effort < 1.0:
            return self.quick.posterior_of(replace(pair, effort=1.0))
        density = pair.density
        if isinstance(density, DefensiveMixture):  # the graph foretells it
            (guess,) = density.proposals
            assert isinstance(guess, KernelMixture)
            np.testing.assert_allclose(guess.means[0, :3, :3], self._truth(pair.source, pair.target)[:3, :3], atol=0.1)
            density = density.known
        steps = density.steps if isinstance(density, AnyDensity) else np.inf  # between segments there is no prior
        self.asked.append((pair.source.index, pair.target.index))
        self.priors.append((pair.source.index, pair.target.index, steps))
        target_from_source = self._truth(pair.source, pair.target)
        error = se3.exp(self.noise * SIGMAS * pair.rng.standard_normal(6))
        lost = pair.source.index in self.blind or (
            (pair.source.index, pair.target.index) in self.apart and steps <= self.reach
        )
        pose = PoseGaussian(target_from_source @ error, np.diag(SIGMAS**2))
        outcome = Outcome.NO_OVERLAP if lost else Outcome.CONVERGED
        samples = np.broadcast_to(pose.mean, (50, 4, 4))
        overlap = 0.0 if lost else 0.8
        return Posterior(pair.source.index, pair.target.index, pose, outcome, overlap, samples, np.full(50, 0.02))

    def _truth(self, source: RayImage, target: RayImage) -> Array:
        return POSES[target.index] @ se3.inverse(POSES[source.index])


def modeler(**changes: object) -> Modeler:
    parts: dict[str, object] = {"prior": AnyPrior(), "registrar": Oracle(), "closer": Closer(), "sensor": Sensor()}
    return Modeler(segmenter=Segmenter(), fuser=Fuser(voxel_m=0.01), **(parts | changes))  # pyright: ignore[reportArgumentType]


def run(frames: list[Frame] = FRAMES, **changes: object) -> list[Step]:
    return [event for event in modeler(**changes).run(frames, Scene()) if isinstance(event, Step)]


def blank(index: int) -> Frame:
    return replace(FRAMES[index], mask=np.zeros_like(FRAMES[index].mask))


def trajectory_error(step: Step) -> float:
    first = min(step.solution.trajectory)
    wanted = {k: POSES[first] @ se3.inverse(POSES[k]) for k in step.solution.trajectory}
    return max(float(np.abs(step.solution.trajectory[k] - pose).max()) for k, pose in wanted.items())


def test_each_frame_gives_one_step_with_a_preview_and_the_end_one_more_with_the_model() -> None:
    steps = run()
    assert [step.frame.index for step in steps] == [*range(9), 8]
    assert [step.last for step in steps] == [False] * 9 + [True]
    models = [step.model for step in steps if step.model is not None]
    assert [len(model.triangles) > 0 for model in models] == [False] * 9 + [True]
    assert [model.vertex_views is not None for model in models] == [False] * 9 + [True]  # made with care
    assert all(len(model.points_m) > 0 for model in models)


@pytest.mark.parametrize(("live", "ahead"), [(False, 1), (True, 0)])
def test_frames_are_read_one_ahead_and_of_a_live_camera_none(live: bool, ahead: int) -> None:
    read: list[int] = []

    def camera() -> Iterator[Frame]:
        for frame in FRAMES:
            read.append(frame.index)
            yield frame

    for event in modeler().start(Scene()).track(camera(), live=live):
        assert isinstance(event, Step)
        assert len(read) == min(event.frame.index + 1 + ahead, len(FRAMES))
    assert len(read) == len(FRAMES)


def test_a_full_turn_is_closed_on_the_first_view_in_whose_camera_frame_the_trajectory_is() -> None:
    *_, closing, last = run()
    assert [(edge.target, edge.kind, edge.accepted) for edge in closing.edges] == [
        (7, "odometry", True),
        (0, "closure", True),
    ]
    assert closing.edges_so_far[-2:] == closing.edges
    assert last.edges_so_far == (*closing.edges_so_far, *last.edges)
    assert list(last.solution.trajectory) == list(range(9))
    assert trajectory_error(last) < 1e-6


def test_a_frame_without_object_is_left_out_and_the_next_joins_the_view_before() -> None:
    registrar = Oracle()
    steps = run([FRAMES[0], FRAMES[1], blank(2), FRAMES[3]], registrar=registrar)
    assert [step.accepted for step in steps] == [True, True, False, True, True]
    assert steps[2].left_out == Failed(Outcome.TOO_FEW_POINTS)
    assert steps[2].view is None
    assert registrar.asked == [(1, 0), (3, 1)]
    assert trajectory_error(steps[-1]) < 1e-6


def test_a_frame_that_cannot_be_registered_is_left_out_with_advice() -> None:
    registrar = Oracle(blind=frozenset({2}))
    steps = run(FRAMES[:4], registrar=registrar)
    assert steps[2].left_out == Failed(Outcome.NO_OVERLAP)
    assert steps[2].view is not None
    assert list(steps[-1].views) == list(steps[-1].solution.trajectory) == [0, 1, 3]
    assert (3, 1) in registrar.asked


def test_a_frame_to_which_the_prior_does_not_apply_is_left_out() -> None:
    steps = run(FRAMES[:4], prior=AnyPrior(refused=frozenset({(2, 0), (2, 1), (2, 3)})))
    assert [step.left_out for step in steps] == [None, None, PriorRefused("frames 2 and 1: no plane"), None, None]
    assert [explain(edge.reason) for edge in steps[2].edges] == ["frames 2 and 1: no plane", "frames 2 and 0: no plane"]
    assert {edge.posterior.outcome for edge in steps[2].edges} == {Outcome.NOT_APPLICABLE}


def test_a_closure_to_which_the_prior_does_not_apply_leaves_its_frame_in() -> None:
    last = run(prior=AnyPrior(refused=frozenset({(8, 0)})))[-1]
    assert last.accepted
    refused = next(edge for edge in last.edges_so_far if (edge.source, edge.target) == (8, 0))
    assert not refused.accepted
    assert explain(refused.reason) == "frames 8 and 0: no plane"
    assert 8 in last.solution.trajectory
    assert trajectory_error(last) < 1e-6


def test_a_previous_view_to_which_the_prior_does_not_apply_gives_way_to_others() -> None:
    steps = run(FRAMES[:5], prior=AnyPrior(refused=frozenset({(4, 3)})))
    assert all(step.accepted for step in steps)
    assert trajectory_error(steps[-1]) < 1e-6


def test_limits_that_are_defaults_do_not_exclude_what_the_graph_predicts() -> None:
    registrar = Oracle()
    last = run(registrar=registrar, closer=CLOSER, prior=AnyPrior(beyond=frozenset({(8, 0), (5, 3)})))[-1]
    assert {(8, 0), (5, 3)} <= {(edge.source, edge.target) for edge in last.edges_so_far}
    assert {(s, t) for s, t, steps in registrar.priors if steps == np.inf} == {(8, 0), (5, 3)}


def test_at_the_end_views_two_steps_apart_are_registered_too_and_judged() -> None:
    registrar = Oracle(noise=1.0)
    *steps, last = run(registrar=registrar, closer=CLOSER)
    assert all(edge.source - edge.target in (1, 8) for step in steps for edge in step.edges)
    spans = [edge for edge in last.edges if (edge.source - edge.target) % 9 in (2, 7)]
    assert list(last.edges) == spans
    assert sorted(edge.source for edge in spans) == list(range(2, 9))
    assert all(
        edge.accepted and edge.kind == ("span" if edge.source - edge.target == 2 else "closure") for edge in spans
    )
    assert len(registrar.asked) == len(set(registrar.asked)) == len(last.edges_so_far)
    none = run(registrar=Oracle(noise=1.0), closer=replace(CLOSER, max_spans=0))[-1]
    assert len(none.edges_so_far) == len(last.edges_so_far) - len(spans)
    assert np.mean(_rotation_errors(last.solution)) < np.mean(_rotation_errors(none.solution))
    shared = run(registrar=Oracle(noise=1.0), closer=CLOSER, prior=AnyPrior(axis=SharedAxis(1e-4, 1e-5)))[-1]
    assert len(shared.edges_so_far) == len(none.edges_so_far)  # their noise is not distinguished from slip


def test_the_end_tells_how_far_it_is_and_can_be_cut_short() -> None:
    building = modeler(registrar=Oracle(noise=1.0), closer=CLOSER)
    events = list(building.run(FRAMES, Scene()))
    given = [event for event in events if not isinstance(event, Step)]
    total = len(given) - 3
    assert given == [Refining(0, None), *(Refining(done, total) for done in range(total + 1)), Fusing()]
    last = events[-1]
    assert isinstance(last, Step)
    none = run(registrar=Oracle(noise=1.0), closer=replace(CLOSER, max_spans=0))[-1]
    assert total == len(last.edges) == len(last.edges_so_far) - len(none.edges_so_far)
    for stop, edges in ((Refining(1, total), 1), (Refining(0, None), 0)):
        cut = building.start(Scene())
        list(cut.track(FRAMES))
        next(event for event in cut.refine() if event == stop)
        *_, hurried = cut.finish()
        assert isinstance(hurried, Step)
        assert len(hurried.edges) == edges
        assert len(hurried.edges_so_far) == len(none.edges_so_far) + edges
        assert hurried.model is not None


def test_covariances_account_for_the_noise_of_a_frame_in_all_its_edges() -> None:
    """The Oracle's edges err less around loops than they say, as if their images' noise cancelled there.

    What all images err by alike comes on top.
    """
    last = run(registrar=Oracle(noise=0.3))[-1]
    graph = PoseGraph(last.edges_so_far, first=0)
    single = solve(graph, {})
    for frame, pose in single.trajectory.items():
        np.testing.assert_allclose(last.solution.trajectory[frame], pose, atol=1e-6)
    shared = solve(graph, {}, shared=shared_noise(graph, single), common=Modeler.common_noise)
    for frame in range(1, 9):
        found, wanted = (solution.covariances[frame] for solution in (last.solution, shared))
        np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-10)
        assert not np.allclose(found, single.covariances[frame], rtol=1e-2)


def test_covariances_include_a_bias_of_all_distances_unless_the_focal_length_is_exact() -> None:
    noisy = {"registrar": Oracle(noise=0.3), "sensor": Sensor(SensorNoise(sigma_focal=0.02))}
    last, without = (run(**noisy, common_distance=sigma)[-1] for sigma in (0.01, 0.0))
    shift_m = 0.01 * np.mean([view.centroid_m for view in last.views.values()], axis=0)
    for frame in range(1, 9):
        left = np.eye(6) - se3.adjoint(last.solution.relative(frame, 0))
        wider = last.solution.relative_covariance(0, frame) - without.solution.relative_covariance(0, frame)
        moved = left @ np.append(np.zeros(3), shift_m)
        np.testing.assert_allclose(wider, np.outer(moved, moved), atol=1e-10)
    exact = [run(registrar=Oracle(noise=0.3), common_distance=sigma)[-1].solution for sigma in (0.01, 0.0)]
    np.testing.assert_array_equal(exact[0].covariances[4], exact[1].covariances[4])


def test_the_first_good_view_makes_the_object_frame() -> None:
    steps = run([blank(0), FRAMES[1], FRAMES[2]])
    assert np.array_equal(steps[-1].solution.trajectory[1], np.eye(4))
    assert trajectory_error(steps[-1]) < 1e-6


@pytest.mark.parametrize("lost", [(3,), (2, 3)])
def test_the_mesh_is_made_though_the_last_frames_are_lost(lost: tuple[int, ...]) -> None:
    last = run([blank(k) if k in lost else FRAMES[k] for k in range(4)])[-1]
    assert last.last
    assert not last.accepted
    assert len(last.model.triangles) > 0


def test_an_axis_that_all_steps_share_sharpens_the_first_pairs_too() -> None:
    """Only the last solution knows of it: that of all edges and the axis together, in which each counts once."""
    prior, axis = AnyPrior(axis=SharedAxis(1e-4, 1e-5)), CommonAxis(1e-4, 1e-5, np.inf)
    plain, shared = [], []
    for seed in range(3):
        *_, before, last = run(registrar=Oracle(noise=1.0), prior=prior, seed=seed)
        assert before.solution.camera_from_axis is None
        graph = PoseGraph(last.edges_so_far, first=0)
        whole = solve(graph, last.solution.trajectory, axis=axis)
        for frame, pose in last.solution.trajectory.items():
            np.testing.assert_allclose(pose, whole.trajectory[frame], atol=1e-6)
        plain.append(_rotation_errors(solve(graph, {})))
        shared.append(_rotation_errors(last.solution))
    assert np.mean(shared) < 0.8 * np.mean(plain)
    assert np.mean(shared, axis=0)[0] < np.mean(plain, axis=0)[0]


def _rotation_errors(solution: Solution) -> list[float]:
    truth = {k: POSES[0] @ se3.inverse(POSES[k]) for k in solution.trajectory}
    return [float(se3.rotation_angle(se3.inverse(truth[k]) @ pose)) for k, pose in solution.trajectory.items() if k]


def test_without_any_object_there_is_no_model() -> None:
    steps = run([blank(0), blank(1)])
    assert [step.model for step in steps] == [None, None, None]
    assert steps[-1].last
    assert run([]) == []


def test_a_pair_depends_on_the_seed_and_its_views_alone() -> None:
    whole = run(registrar=Oracle(noise=1.0), seed=7)[4].posteriors[0]
    maker = modeler(registrar=Oracle(noise=1.0), seed=7)
    source, target = (maker.prepare(FRAMES[k], Scene()).view for k in (4, 3))
    assert source is not None
    assert target is not None
    assert np.array_equal(maker.register(source, target).pose.mean, whole.pose.mean)
    other = modeler(registrar=Oracle(noise=1.0), seed=8).register(source, target)
    assert not np.array_equal(other.pose.mean, whole.pose.mean)


def test_same_seed_same_bits_side_by_side_or_one_after_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_NUM_THREADS", "1")
    one = run(COLOURED, registrar=Oracle(noise=1.0))[-1]
    monkeypatch.setenv("NUMBA_NUM_THREADS", "2")
    other = run(COLOURED, registrar=Oracle(noise=1.0))[-1]
    assert len(one.edges_so_far) > 8
    for k, pose in one.solution.trajectory.items():
        assert np.array_equal(pose, other.solution.trajectory[k])
    assert np.array_equal(one.model.vertices_m, other.model.vertices_m)


def test_the_prior_learns_from_all_that_came_before_a_frame() -> None:
    prior = AnyPrior()
    steps = run(FRAMES[:4], prior=prior)
    assert prior.lessons == [([0], 0), ([0, 1], 1), ([0, 1, 2], 2), ([0, 1, 2, 3], 3)]  # the last before further pairs
    assert len(steps[-1].edges_so_far) == 3


@pytest.mark.parametrize(
    ("frames", "apart", "priors"),
    [
        ([FRAMES[0], FRAMES[1], blank(2), blank(3), FRAMES[4], FRAMES[5]], (), [(1, 0, 1.0), (4, 1, 3.0), (5, 4, 1.0)]),
        (FRAMES[:5:2], (), [(2, 0, 1.0), (4, 2, 1.0)]),
        (FRAMES[:4], ((2, 1),), [(1, 0, 1.0), (2, 1, 1.0), (2, 1, 2.0), (3, 2, 1.0)]),  # once more for a motion beyond
    ],
)
def test_the_prior_grows_with_the_number_of_lost_frames_not_with_that_of_a_frame(
    frames: list[Frame], apart: tuple[tuple[int, int], ...], priors: list[tuple[int, int, float]]
) -> None:
    registrar = Oracle(apart=frozenset(apart), reach=1.5)
    last = run(frames, registrar=registrar)[-1]
    assert registrar.priors == priors
    assert trajectory_error(last) < 1e-6


def test_a_frame_that_the_previous_view_does_not_place_is_found_from_another() -> None:
    registrar = Oracle(apart=frozenset({(3, 2)}), reach=9.0)
    steps = run(FRAMES[:5], registrar=registrar)
    assert all(step.accepted for step in steps)
    assert steps[3].posteriors[0].target == 2
    refused, *placing = [edge.accepted for edge in steps[3].edges]
    assert not refused
    assert placing == [True, True]  # from far round, one view alone is not taken at its word
    assert trajectory_error(steps[-1]) < 1e-6


def test_lost_frames_join_after_all_where_later_views_place_them() -> None:
    early = frozenset((source, target) for source in (3, 4, 5, 6) for target in range(source) if target < 3)
    registrar = Oracle(apart=early, reach=9.0)
    steps = run(FRAMES, registrar=registrar)
    outcomes = [(step.frame.index, step.accepted) for step in steps]
    lost = [frame for frame, joined in outcomes if not joined]
    assert lost == [3, 4, 5, 6]
    assert outcomes[:8] == [(k, k not in lost) for k in range(8)]
    assert outcomes[8:] == [(8, True), (6, True), (5, True), (4, True), (3, True), (8, True)]
    assert [step.last for step in steps] == [False] * 13 + [True]
    assert set(steps[-1].views) == set(steps[-1].solution.trajectory) == set(range(9))
    assert steps[-1].model is not None
    assert len({(e.source, e.target) for e in steps[-1].edges_so_far}) == len(steps[-1].edges_so_far)
    assert trajectory_error(steps[-1]) < 1e-6


def test_a_lost_frame_far_back_joins_across_another_that_is_lost_for_good() -> None:
    """Where it should be follows from the views around it, not from the last ones, by now far round."""
    registrar = Oracle(apart=frozenset({(2, 1), (2, 0)}), reach=9.0)
    *_, last = run([*FRAMES[:3], blank(3), *FRAMES[4:]], registrar=registrar)
    assert sorted(last.solution.trajectory) == [0, 1, 2, 4, 5, 6, 7, 8]
    assert trajectory_error(last) < 1e-6


def test_frames_held_in_the_air_do_not_keep_those_after_them_from_being_a_segment(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    groups = {frame: group for group, frames in enumerate(((0, 1, 2), (3, 4), (5, 6, 7, 8))) for frame in frames}
    apart = frozenset(pair for pair in product(groups, groups) if groups[pair[0]] != groups[pair[1]])
    joined: list[list[int]] = []

    def join(self: Joiner, target: Segment, source: Segment) -> list[Alignment]:
        joined.append(source.frames)
        return []

    monkeypatch.setattr(Joiner, "join", join)
    steps = run(FRAMES, registrar=Oracle(apart=apart, reach=9.0))
    assert joined == [[5, 6, 7, 8]]
    assert sorted(steps[-1].solution.trajectory) == [0, 1, 2]


def test_frames_tried_once_more_in_vain_are_reported_too() -> None:
    hopeless = frozenset((source, target) for source in (2, 3, 5) for target in range(9))
    steps = run(FRAMES, registrar=Oracle(apart=hopeless, reach=9.0))
    assert [step.frame.index for step in steps] == [*range(9), 8]
    given = {(edge.source, edge.target): edge.accepted for edge in steps[-1].edges_so_far}
    assert [given[pair] for pair in ((2, 4), (3, 4), (5, 6))] == [False] * 3
    assert len(given) == len(steps[-1].edges_so_far)
    assert sorted(steps[-1].solution.trajectory) == [0, 1, 4, 6, 7, 8]


def test_two_frames_of_one_number_are_refused() -> None:
    with pytest.raises(InputError, match="frame 1 comes twice; give each"):
        run([*FRAMES[:2], FRAMES[1]])


def test_what_is_kept_of_a_frame_is_light_and_makes_the_same_view_again() -> None:
    steps = run(COLOURED)
    assert all(not view.layers for view in steps[-1].views.values())
    assert all(not len(edge.posterior.samples) for edge in steps[-1].edges_so_far)
    assert all(len(posterior.samples) for step in steps for posterior in step.posteriors)
    whole = steps[3].view
    again = Sensor().ray_image(steps[-1].views[3].frame, steps[-1].views[3].plane)
    assert set(again.layers) == set(whole.layers)
    assert np.array_equal(again.points_m, whole.points_m)
    for name, layer in whole.layers.items():
        np.testing.assert_array_equal(again.layers[name], layer)


@pytest.mark.parametrize("kind", ["nothing measured", "all object", "one pixel", "zero depth", "far apart", "no mask"])
def test_an_odd_frame_never_stops_the_run(kind: str) -> None:
    frame = FRAMES[2]
    depth_m, mask = frame.depth_m.copy(), np.ones_like(frame.depth_m, dtype=bool)
    match kind:
        case "nothing measured":
            depth_m[:] = np.nan
        case "one pixel":
            mask[:] = False
            mask[10, 10] = True
        case "zero depth":
            depth_m[:] = 0.0
        case "far apart":
            depth_m[:] = np.nan
            depth_m[::7, ::7] = 0.8
            mask = np.isfinite(depth_m)
    odd = replace(frame, depth_m=depth_m, mask=None if kind == "no mask" else mask)
    steps = run([FRAMES[0], FRAMES[1], odd, FRAMES[3], FRAMES[4]])
    last = steps[-1]
    assert last.last
    assert {0, 1, 3, 4} <= set(last.solution.trajectory)
    assert last.model is not None
    assert trajectory_error(last) < 1e-6


@pytest.mark.parametrize(("frames", "given"), [(1, 1), (3, 3), (15, 15), (16, 15), (1000, 15)])
def test_a_scene_is_learned_from_few_frames_spread_over_the_sequence(frames: int, given: int) -> None:
    indices = range(7, 7 + 2 * frames, 2)
    chosen = scene_frames(indices)
    assert len(chosen) == len(set(chosen)) == given
    assert set(chosen) <= set(indices)
    assert chosen[0] == indices[0]
    assert chosen[-1] == indices[-1] or frames == 1
    gaps = np.diff(chosen)
    assert np.ptp(gaps) <= 2 if len(gaps) else given == 1


def test_only_frames_that_a_view_followed_soon_are_tried_again_newest_first() -> None:
    all_object = Segmentation(np.ones((2, 2), dtype=bool), None, Outcome.CONVERGED)
    lost = {k: Prepared(FRAMES[k], all_object, None) for k in (1, 4, 5)}
    views = {k: tabletop.view(BOX, POSES[k], k) for k in (0, 7)}
    state = State(views=views, lost=lost, places={k: k for k in range(9)})
    assert list(state.retries()) == [(5, 7), (4, 7)]
