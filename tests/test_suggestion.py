"""What to do next: laws of the predictions, and what they say of objects whose answer is known."""

from dataclasses import replace

import numpy as np
import pytest

from modeler import se3
from modeler.graph import PoseGraph, solve
from modeler.pipeline import Modeler
from modeler.priors import PokePrior, TablePrior
from modeler.sequences.rendering import RenderedSequence
from modeler.sequences.rendering.recipe import Place, Places, Recipe
from modeler.suggestion import Belief, Candidate, Goal, Prediction, suggest
from modeler.suggestion.candidates import poked, pokes
from modeler.suggestion.edge_prediction import TURNS_RAD, basins
from modeler.suggestion.pose_gain import PoseGraphBelief, edge_information
from modeler.suggestion.surface_cells import enclosing_circle
from modeler.types import Array, Edge, Outcome, PoseGaussian, Posterior, Stated
from modeler.views import Sensor
from studies.calibration.specimens import load_specimen


def edge(source: int, target: int, mean: Array, sigma_rad: float, rng: np.random.Generator) -> Edge:
    root = np.diag(np.repeat([sigma_rad, 0.03 * sigma_rad], 3)) @ (np.eye(6) + 0.2 * rng.normal(size=(6, 6)))
    posterior = Posterior(source, target, PoseGaussian(mean, root @ root.T), Outcome.CONVERGED, 0.9)
    return Edge(posterior, "odometry" if source - target == 1 else "closure", True, Stated("made up"))


def ring(count: int, rng: np.random.Generator) -> tuple[list[Edge], dict[int, Array]]:
    """Return a chain of edges with one loop, and the poses that they lead to."""
    poses = {k: se3.exp(np.array([0.0, 0.3 * k, 0.0, 0.2 * k, 0.0, 0.1])) for k in range(count)}
    first = se3.inverse(poses[0])
    poses = {k: first @ pose for k, pose in poses.items()}
    pairs = [(k + 1, k) for k in range(count - 1)] + [(count - 2, 0)]
    return [edge(s, t, se3.inverse(poses[t]) @ poses[s], 0.02, rng) for s, t in pairs], poses


def test_the_gain_of_edges_is_what_the_graph_with_them_comes_to(rng: np.random.Generator) -> None:
    edges, poses = ring(5, rng)
    new = poses[4] @ se3.exp(np.array([0.0, 0.3, 0.0, 0.2, 0.0, 0.0]))
    added = [edge(5, target, se3.inverse(poses[target]) @ new, 0.01, rng) for target in (4, 1)]
    before, after = (
        PoseGraphBelief.of(some, solve(PoseGraph(tuple(some), first=0), poses)) for some in (edges, [*edges, *added])
    )
    found = before.gain([(e.target, edge_information(new, e.posterior.pose.covariance)) for e in added], 5)
    frames = [1, 2, 3, 4]

    def joint(belief: PoseGraphBelief) -> Array:
        return np.block([[belief.covariance(one, other) for other in frames] for one in frames])

    half_log_det = [0.5 * np.linalg.slogdet(joint(belief))[1] for belief in (before, after)]
    np.testing.assert_allclose(found.nats, half_log_det[0] - half_log_det[1], rtol=1e-6)
    for frame in (*frames, 5):
        np.testing.assert_allclose(found.covariances[frame], after.covariance(frame, frame), rtol=1e-5, atol=1e-10)
        np.testing.assert_allclose(after.marginals[frame], after.covariance(frame, frame), rtol=1e-5, atol=1e-10)


def test_one_edge_alone_tells_nothing_of_the_poses_before(rng: np.random.Generator) -> None:
    edges, poses = ring(4, rng)
    belief = PoseGraphBelief.of(edges, solve(PoseGraph(tuple(edges), first=0), poses))
    assert belief.gain([(3, 1e4 * np.eye(6))], 9).nats == pytest.approx(0.0, abs=1e-8)


def test_modes_are_peaks_with_a_valley_between_them() -> None:
    places = np.linspace(-3.0, 3.0, 121)
    near, far = (np.logaddexp(-0.5 * (places / 0.3) ** 2, -0.5 * ((places - off) / 0.3) ** 2) for off in (0.4, 1.8))
    assert len(basins(places, near)[0]) == 1
    peaks, masses = basins(places, far)
    np.testing.assert_allclose(peaks, [0.0, 1.8], atol=0.06)
    np.testing.assert_allclose(masses, [0.5, 0.5], atol=0.01)


def test_the_circle_holds_all_points_and_is_hardly_larger_than_needed(rng: np.random.Generator) -> None:
    angle = rng.uniform(0.0, np.pi, 500)  # the front of a can shows how thick it is
    centre, radius = enclosing_circle(np.column_stack([np.cos(angle), np.sin(angle)]))
    assert np.hypot(np.cos(angle) - centre[0], np.sin(angle) - centre[1]).max() <= radius + 1e-12
    assert radius == pytest.approx(1.0, abs=0.02)


def shown(
    name: str, turns_deg: list[float], *, spin_sd_deg: float = 0.3, reach_deg: float = 100.0, colour: bool = False
) -> Belief:
    """Return what is known of a shape after true turns, whose edges state a spin uncertain by so much."""
    recipe = load_specimen(name)
    places = tuple(Place(rotation_deg=(0.0, 0.0, turn)) for turn in turns_deg)
    view = recipe.view
    small = Recipe(
        recipe.object,
        name,
        rest_rotation_deg=recipe.rest_rotation_deg,
        view=type(view)(200, 150, 180.0, 0.5, view.elevation_deg, view.look_height_m),
        trajectory=Places(places),
    )
    if colour:
        small = replace(small, colour=recipe.colour, photography=recipe.photography, label=recipe.label)
    sequence = RenderedSequence(small)
    modeler = Modeler(sensor=Sensor(sequence.sensor()), prior=TablePrior(max_rotation_deg=reach_deg, max_shift_m=0.05))
    frames = [sequence.frame(k) for k in sequence.indices]
    scene, truth = modeler.segmenter.scene(frames), sequence.truth()
    views = {frame.index: modeler.prepare(frame, scene).view for frame in frames}
    posed = {k: view for k, view in views.items() if view is not None}
    up = posed[0].plane.normal if posed[0].plane is not None else np.array([0.0, -1.0, 0.0])
    about = np.diag(np.repeat([np.radians(0.3), 0.0005], 3) ** 2)
    about[:3, :3] += np.radians(spin_sd_deg) ** 2 * np.outer(up, up)
    edges = []
    for k in sequence.indices[1:]:
        covariance = se3.covariance_about(about, -posed[k].centroid_m)
        posterior = Posterior(
            k, k - 1, PoseGaussian(truth[k - 1] @ se3.inverse(truth[k]), covariance), Outcome.CONVERGED, 0.8
        )
        edges.append(Edge(posterior, "odometry", True, Stated("true")))
    poses = {k: truth[0] @ se3.inverse(pose) for k, pose in truth.items()}
    graph = PoseGraph(tuple(edges), first=0)
    solution = solve(graph, poses)
    if not edges:
        solution = type(solution)(poses, {0: 1e-18 * np.eye(6)})
    return modeler.belief(posed, solution, edges)


@pytest.fixture(scope="module")
def box() -> Belief:
    """Return a box after two views, 30° apart."""
    return shown("l_bracket", [0.0, 30.0])


def test_more_views_show_more_and_a_whole_turn_shows_what_can_be_seen(box: Belief) -> None:
    once, round_ = shown("l_bracket", [0.0]), shown("l_bracket", [60.0 * k for k in range(6)])
    assert once.seen < box.seen < round_.seen
    assert once.seen < 0.7
    assert round_.seen > 0.9


def test_new_surface_grows_with_the_turn_and_the_pose_gets_less_certain(box: Belief) -> None:
    found = [box.predict(Candidate("turn", turn_deg=turn)) for turn in (10.0, 40.0, 90.0)]
    shares = [each.new_surface for each in found if each is not None]
    assert shares == sorted(shares)
    assert shares[2] > shares[0] + 0.2
    assert found[0].pose_deg < found[2].pose_deg
    assert found[2].right <= found[0].right


def test_no_action_takes_knowledge_away_and_odds_fall_with_the_turn(box: Belief) -> None:
    found = [box.predict(Candidate("turn", turn_deg=turn)) for turn in (5.0, 20.0, 45.0, 70.0, 95.0)]
    given = [each for each in found if each is not None]
    assert len(given) == len(found)
    assert all(min(each.pose_nats, each.surface_nats, each.gain_nats, each.mode_nats) >= 0.0 for each in given)
    assert all(0.0 <= each.right <= each.usable <= 1.0 for each in given)
    odds = [each.usable for each in given]
    assert odds == sorted(odds, reverse=True)
    assert odds[0] > 0.98
    for each in given:
        assert all(edge.masses.sum() == pytest.approx(1.0) for edge in each.edges)


@pytest.fixture(scope="module")
def can() -> Belief:
    """Return a can, whose spin nothing tells, after two views."""
    return shown("can", [0.0, 25.0], spin_sd_deg=25.0)


def mass_within(found: Prediction | None, turn_deg: float) -> float:
    """Return the probability that a view is placed within so much of where it belongs."""
    edge = found.edges[0]
    return float(edge.masses[np.abs(TURNS_RAD) <= np.radians(turn_deg)].sum())


def test_a_view_of_a_body_of_revolution_may_be_placed_at_many_turns(box: Belief, can: Belief) -> None:
    turn = Candidate("turn", turn_deg=45.0)
    assert mass_within(box.predict(turn), 10.0) > 0.95
    assert mass_within(can.predict(turn), 20.0) < 0.6


def test_colours_that_determined_the_spin_are_expected_to_do_so_again() -> None:
    turn = Candidate("turn", turn_deg=25.0)
    plain, printed = shown("can+plain", [0.0, 25.0], colour=True), shown("can+labelled", [0.0, 25.0], colour=True)
    assert shown("can+labelled", [0.0]).predictor.colour is None
    assert (printed.predictor.colour.losses <= 0.0).all()
    assert spin_deg(printed.predict(turn)) < 0.5 * spin_deg(plain.predict(turn))
    assert mass_within(printed.predict(turn), 10.0) > mass_within(plain.predict(turn), 10.0)


def test_a_view_that_may_be_placed_anywhere_is_expected_to_show_less_new_surface(can: Belief) -> None:
    found = can.predict(Candidate("turn", turn_deg=60.0))
    object_from_new = can.object_from_last @ se3.inverse(
        found.candidate.motion(can.last, can.stand, can.object_from_last)
    )
    cells, surface = can.cells.looked_at(se3.inverse(object_from_new))
    there = ~can.cells.under[cells]
    new = surface[there & ~can.cells.seen[cells]].sum() / surface[there].sum()
    assert found.new_surface < 0.9 * new


def test_surface_seen_counts_once_and_hidden_space_less_the_farther_out_it_is(box: Belief) -> None:
    pose = se3.inverse(box.stand.turned(np.radians(-60.0)) @ box.object_from_last)
    cells, surface = box.cells.looked_at(pose)
    np.testing.assert_array_equal(cells, box.cells.visible(pose))
    seen = box.cells.seen[cells]
    hidden = ~seen & ~box.cells.under[cells]
    np.testing.assert_array_equal(surface[seen], 1.0)
    assert hidden.any()
    assert (surface[hidden] > 0.0).all()
    far = hidden & box.cells.beyond[cells]
    assert surface[far].mean() < surface[hidden & ~far].mean()
    assert not box.cells.beyond[box.cells.seen].any()


def test_laying_it_down_shows_what_it_stood_on_with_the_odds_of_joining(box: Belief) -> None:
    found = box.predict(Candidate("lay"))
    assert found.new_surface > 0.0
    assert found.pose_nats == 0.0
    assert 0.5 < found.right < 1.0
    assert "placed correctly with probability" in suggest(box, [Candidate("lay")]).ranked[0].words


def test_a_turn_beyond_the_prior_is_no_candidate(box: Belief) -> None:
    assert box.predict(Candidate("turn", turn_deg=120.0)) is None


def test_back_at_a_view_whose_spin_was_lost_a_turn_tells_of_the_poses() -> None:
    belief = shown("l_bracket", [0.0, 40.0, 80.0, 120.0], spin_sd_deg=6.0)
    back = belief.predict(Candidate("turn", turn_deg=-100.0))
    on = belief.predict(Candidate("turn", turn_deg=40.0))
    assert back.pose_nats > on.pose_nats + 1.0
    assert {found.target for found in back.edges} & {0, 1}


def spin_deg(found: Prediction | None) -> float:
    """Return the standard deviation of the rotation between the new view and the last, which spin dominates."""
    return float(np.degrees(np.sqrt(found.edges[0].covariance[:3, :3].trace())))


def test_hardly_anything_tells_the_spin_of_a_can_but_a_poke_tells_more_than_a_turn(box: Belief, can: Belief) -> None:
    belief = can
    turn = Candidate("turn", turn_deg=25.0)
    assert spin_deg(belief.predict(turn)) > 5.0 * spin_deg(box.predict(turn))
    found = pokes(belief.last, belief.stand, belief.object_from_last)
    assert len(found) == 4
    assert all(spin_deg(belief.predict(each)) < 0.7 * spin_deg(belief.predict(turn)) for each in found)


def test_a_poke_is_expected_to_go_as_its_prior_says(box: Belief) -> None:
    push = pokes(box.last, box.stand, box.object_from_last)[0].poke
    assert push is not None
    assert box.last.plane is not None
    expected = poked(push, box.last, box.last.plane)
    later = replace(box.last, frame=replace(box.last.frame, index=2))
    density = PokePrior(poke=push).between(box.last, later)
    assert np.isfinite(density.log_density(se3.inverse(expected)[None])).all()


def test_actions_are_ranked_by_their_worth_for_their_cost(box: Belief) -> None:
    turns = [Candidate("turn", turn_deg=angle, cost=cost) for angle, cost in ((30.0, 1.0), (-40.0, 100.0), (20.0, 1.0))]
    found = suggest(box, turns)
    per_cost = [each.prediction.worth_nats / each.prediction.candidate.cost for each in found.ranked]
    assert per_cost == sorted(per_cost, reverse=True)
    assert found.ranked[-1].prediction.candidate.turn_deg == -40.0


def test_the_goal_is_what_the_user_says(box: Belief) -> None:
    assert Goal(pose_deg=90.0, seen=0.0).reached(box)
    assert not Goal(pose_deg=90.0, seen=1.0).reached(box)
    assert not Goal(pose_deg=90.0, seen=0.0, sigma_m=1e-6).reached(box)
    said = suggest(box, [Candidate("lay")], Goal(pose_deg=90.0, seen=0.0)).summary
    assert said.startswith("nothing more to gain: every pose within ")
    assert said.endswith("lay it on its side for the rest")
