"""The prior by which an object may stay on its table, and limits that hold only where they were not left already."""

from dataclasses import replace

import numpy as np
import pytest
import tabletop
from prior_cases import views

from modeler import se3
from modeler.closure import Closer
from modeler.graph import PoseGraph, Smoother
from modeler.pipeline.attempts import Search, predicted
from modeler.pipeline.state import State
from modeler.priors import AnyMotion, AutoPrior, GeneralPrior, TablePrior, TurntablePrior
from modeler.types import Array, Edge, JoinsPrevious, Outcome, PoseGaussian, Posterior, RayImage, Solution
from modeler.views import Sensor

BODY, POSES = tabletop.Box((0.06, 0.045, 0.08)), tabletop.turntable(15)


def seen(*frames: int, poses: list[Array] = POSES) -> dict[int, RayImage]:
    return {k: Sensor().ray_image(tabletop.view(BODY, poses[k], k).frame) for k in frames}


def odometry(source: int, motion: Array, covariance: Array | None = None) -> Edge:
    pose = PoseGaussian(motion, 1e-6 * np.eye(6) if covariance is None else covariance)
    posterior = Posterior(source, source - 1, pose, Outcome.CONVERGED, overlap=0.9)
    return Edge(posterior, "odometry", True, JoinsPrevious(Outcome.CONVERGED, 0.9))


def joined(edges: list[Edge], views: dict[int, RayImage]) -> State:
    graph = PoseGraph(tuple(edges))
    return State(graph=graph, smoother=Smoother().to(graph), views=views, places={k: k for k in views})


def test_it_is_an_even_mixture_of_free_motion_and_motion_on_the_table(rng: np.random.Generator) -> None:
    source, target = views(np.eye(4))
    prior = AutoPrior()
    free, table = prior.free.between(source, target), prior.table.between(source, target)
    motions = np.concatenate([free.sample(20, rng), table.sample(20, rng)])
    expected = np.logaddexp(free.log_density(motions), table.log_density(motions)) - np.log(2.0)
    found = prior.between(source, target).log_density(motions)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    # Motion on the table is far denser: a few nats of the images do not lift the object.
    assert np.median(found[20:]) - np.median(found[:20]) > 5.0


def test_without_a_table_motion_is_free() -> None:
    source, target = views(np.eye(4), table=False)
    prior = AutoPrior()
    motion = prior.free.between(source, target).sample(5, np.random.default_rng(0))
    found = prior.between(source, target).log_density(motion)
    np.testing.assert_array_equal(found, prior.free.between(source, target).log_density(motion))


def test_limits_are_left_only_where_both_were_assumed() -> None:
    unlimited = AutoPrior().unlimited()
    assert isinstance(unlimited.free, AnyMotion)
    assert AutoPrior(free=GeneralPrior()).unlimited() is None
    assert AutoPrior(table=TablePrior()).unlimited() is None
    assert AutoPrior().relaxed(2.0).free == AutoPrior().free.relaxed(2.0)


@pytest.mark.parametrize(
    ("turn_deg", "assumed", "kept"), [(60.0, True, True), (90.0, True, False), (90.0, False, True)]
)
def test_pairs_are_registered_within_limits_that_hold_their_predicted_motion(
    turn_deg: float, assumed: bool, kept: bool
) -> None:
    poses = tabletop.turntable(360)
    target, source = seen(0, int(turn_deg), poses=poses).values()
    prior = GeneralPrior(max_offset_m=0.2, limits_assumed=assumed)
    solution = Solution({target.index: np.eye(4), source.index: poses[0] @ se3.inverse(poses[int(turn_deg)])})
    state = State(smoother=Smoother(solution=solution), views={target.index: target, source.index: source})
    motion = PoseGaussian(solution.relative(target.index, source.index), np.eye(6))
    found = predicted(Search(state, prior, Closer(), source, target.index), target.index, prior, motion)
    assert isinstance(found.known, GeneralPrior if kept else AnyMotion)


def test_pairs_registered_anew_keep_the_steps_that_their_edges_hold() -> None:
    """Those with the previous view; further pairs hold none, as edges in between do."""
    views = seen(0, 1, 2)
    placed = {k: POSES[0] @ se3.inverse(POSES[k]) for k in range(3)}
    state = joined([odometry(k, se3.inverse(placed[k - 1]) @ placed[k]) for k in (1, 2)], views)
    prior = TurntablePrior(24.0, 1.0).learned(state.solution, state.graph.edges)
    for source, target, evidence in ((1, 0, True), (2, 1, True), (2, 0, False)):
        (attempt,) = Search(state, prior, Closer(), views[source], target).attempts("refine")
        density = attempt.prior.between(views[source], views[target])
        there = se3.inverse(placed[target]) @ placed[source]
        off = se3.moved(there[None], np.array([0.0, np.radians(9.0), 0.0, 0.0, 0.0, 0.0]), views[source].centroid_m)
        steps = density.log_prior(there[None]) - density.log_prior(off)
        assert (steps > 20.0).all() if evidence else (np.abs(steps) < 1e-6).all()


def test_pairs_that_turn_the_other_way_than_the_rest_are_in_doubt() -> None:
    step = POSES[0] @ se3.inverse(POSES[1])
    edges = [odometry(k, se3.inverse(step) if k == 1 else step) for k in range(1, 6)]
    state = joined(edges, seen(*range(6)))
    prior = TurntablePrior(24.0, 1.0, step_sign="unknown")
    doubtful = state.less_probable(prior, prior.learned(state.solution, state.graph.edges))
    assert doubtful == [edges[0]]
    again = replace(edges[0].posterior, pose=replace(edges[0].posterior.pose, mean=step))
    mended = state.reregistered(doubtful, [again])
    np.testing.assert_allclose(mended.solution.relative(0, 1), step, atol=1e-9)
    assert not mended.less_probable(prior, prior.learned(mended.solution, mended.graph.edges))


def test_steps_about_no_common_axis_are_solved_without_one() -> None:
    views = {k: replace(view, plane=None) for k, view in seen(*range(6)).items()}
    prior = TurntablePrior(24.0, 1.0)
    for wobble_deg, fits in ((0.0, True), (3.0, False)):
        rng, edges = np.random.default_rng(0), []
        for source in range(1, 6):
            tilt = np.append(np.radians(wobble_deg) * rng.normal(size=3), np.zeros(3))
            step = se3.moved((POSES[source - 1] @ se3.inverse(POSES[source]))[None], tilt, views[source].centroid_m)[0]
            edges.append(odometry(source, step, se3.covariance_about(1e-6 * np.eye(6), -views[source].centroid_m)))
        state = joined(edges, views)
        assert (state.about_axis(prior) is not None) is fits
        assert replace(state, spans=(edges[0],)).about_axis(prior) is None
        assert state.about_axis(GeneralPrior()) is None


def test_an_edge_to_another_view_that_contradicts_what_was_given_does_not_place_a_view() -> None:
    views = seen(*range(4))
    placed = {k: POSES[0] @ se3.inverse(POSES[k]) for k in range(3)}
    state = State(smoother=Smoother(solution=Solution(placed)), views=views, places={k: k for k in views})

    def found(prior: TurntablePrior | GeneralPrior, target: int, true: int) -> bool:
        """Return whether frame 3 may be placed by a match with a view that is the true one with another."""
        search = Search(state, prior, Closer(), views[3], 2)
        motion = PoseGaussian(POSES[0] @ se3.inverse(POSES[true]), 1e-6 * np.eye(6))
        search.found[target] = Posterior(3, target, motion, Outcome.CONVERGED, overlap=0.9)
        return bool(search.candidates)

    given = TurntablePrior(24.0, 1.0)
    assert found(given, 0, 3)
    assert not found(given, 0, 1)  # three steps were given, and one is found
    assert found(given, 2, 3)  # the previous view's registration holds what was given
    assert found(GeneralPrior(limits_assumed=True), 0, 1)
