"""The verdict on a model: every check speaks against wrong models, and not against right ones."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from run_builders import ball
from scipy.special import ndtr

from modeler import se3
from modeler.fusion import SymmetryFinder
from modeler.graph import PoseGraph, solve
from modeler.priors import AutoPrior, GeneralPrior, HeldPrior, ProductPrior, TablePrior, TurntablePrior
from modeler.priors.mixtures import Gaussian
from modeler.types import (
    AbstractPoseDensity,
    AbstractPrior,
    Array,
    Camera,
    Check,
    Consistency,
    Edge,
    Failed,
    FocalLength,
    Frame,
    FrameRecord,
    HandPoses,
    LowCorrelation,
    LowLikelihood,
    LowOverlap,
    Mode,
    OpenRotation,
    Outcome,
    Plane,
    PoseGaussian,
    Posterior,
    RayImage,
    Reason,
    Segmentation,
    Solution,
    Stated,
    Step,
    loop_closure_errors,
)
from modeler.verdict import judged
from modeler.verdict.evidence import (
    contradiction,
    displacement,
    free_space,
    graph_check,
    loop_check,
    other_modes,
    prior_check,
    prior_distances,
)
from modeler.verdict.spreads import AboutMean, misfit, one_axis_sd, spread_of_positions, spread_of_rotations

CAMERA = Camera(160, 120, 200.0, 200.0, 79.5, 59.5)
AXES_M = np.array([0.09, 0.05, 0.03])
MIDDLE = se3.translation(np.array([0.0, 0.0, 0.6]))
UP = (0.0, -1.0, 0.0)
ABOUT_OBJECT = np.diag(np.repeat([np.radians(0.3), 0.0005], 3) ** 2)
COVARIANCE = se3.adjoint(MIDDLE) @ ABOUT_OBJECT @ se3.adjoint(MIDDLE).T
SPIN = np.array([0.0, 1.0, 0.0, -0.6, 0.0, 0.0])  # ξ of a turn about the vertical through the object, by 1 rad


def turned(angle_deg: float) -> Array:
    """camera_from_object (4, 4) of an object in front of the camera, turned about the camera's vertical."""
    return MIDDLE @ se3.exp(np.array([0.0, np.radians(angle_deg), 0.0, 0.0, 0.0, 0.0]))


def seen(
    index: int, camera_from_object: Array, wall_m: float = 1.0, plane: Plane | None = None, axes_m: Array = AXES_M
) -> RayImage:
    """An ellipsoid before a wall, each pixel a ray that meets it or does not."""
    w, h = CAMERA.rays()
    rays = np.stack([w, h, np.ones_like(w)], axis=-1).reshape(-1, 3)
    turn, middle_m = camera_from_object[:3, :3], camera_from_object[:3, 3]
    ahead, start = (rays @ turn) / axes_m, (-middle_m @ turn) / axes_m  # in units of the axes it is a unit sphere
    square, cross, rest = np.sum(ahead**2, axis=1), ahead @ start, start @ start - 1.0
    root = cross**2 - square * rest
    depth_m = np.where(root > 0.0, (-cross - np.sqrt(np.maximum(root, 0.0))) / square, wall_m)
    mask = root > 0.0
    points_m = rays[mask] * depth_m[mask, None]
    outwards = ((points_m - middle_m) @ turn) / axes_m**2 @ turn.T
    normals = outwards / np.linalg.norm(outwards, axis=1, keepdims=True)
    shape = (CAMERA.height, CAMERA.width)
    frame = Frame(index, float(index), depth_m.reshape(shape).astype(np.float32), CAMERA, mask.reshape(shape))
    return RayImage(frame, plane, 0.001, 0.001, points_m, normals, np.argwhere(mask.reshape(shape)))


def views_of(angles_deg: list[float], **changes: Any) -> dict[int, RayImage]:
    return {index: seen(index, turned(angle_deg), **changes) for index, angle_deg in enumerate(angles_deg)}


def poses_of(angles_deg: list[float]) -> dict[int, Array]:
    """object_from_camera (4, 4) by frame, the first frame's camera being the object's frame."""
    return {index: turned(angles_deg[0]) @ se3.inverse(turned(angle_deg)) for index, angle_deg in enumerate(angles_deg)}


def joined(source: int, target: int, poses: Mapping[int, Array], *, kind: Any = "odometry", **changes: Any) -> Edge:
    motion = se3.inverse(poses[target]) @ poses[source]
    posterior = Posterior(source, target, PoseGaussian(motion, COVARIANCE), Outcome.CONVERGED, overlap=0.8)
    return Edge(replace(posterior, **changes), kind, True, Stated("made up"))


def last_step(views: dict[int, RayImage], edges: tuple[Edge, ...], records: list[FrameRecord], **changes: Any) -> Step:
    """The last step of a run."""
    newest = views[max(views)]
    step = Step(
        frame=newest.frame,
        segmentation=Segmentation(newest.frame.mask, None, Outcome.CONVERGED),  # pyright: ignore[reportArgumentType]
        view=newest,
        posteriors=(),
        edges=(),
        left_out=None,
        solution=solve(PoseGraph(edges=edges, first=0), {}),
        edges_so_far=edges,
        views=views,
        frames_so_far=tuple(records),
        last=True,
    )
    return replace(step, **changes)


STEPS_DEG = [0.0, 25.0, 50.0, 75.0]
LONGER_DEG = [1.01 * angle_deg for angle_deg in STEPS_DEG]


def test_other_frames_see_through_what_is_in_the_wrong_place() -> None:
    angles_deg = [25.0 * k for k in range(6)]
    views = views_of(angles_deg)
    found = free_space(views, poses_of(angles_deg), 0.005)
    assert found.violations.holds
    assert found.violations.value < 0.01
    assert found.false_surface.holds
    assert found.false_surface.value == 0.0
    wrong = free_space(views, poses_of([*angles_deg[:5], 125.0 - 60.0]), 0.005)
    assert wrong.frame == 5
    assert not wrong.violations.holds
    assert 5 in wrong.contradictions
    found = wrong.contradictions[5]
    mask = views[5].frame.mask
    assert mask[tuple(found.surface[:, :2].T.astype(int))].all()
    assert (found.surface[:, 2] >= 1).all()
    assert len(found.free) == len(np.unique(found.free, axis=0)) > 0
    assert free_space({0: views[0]}, poses_of([0.0]), 0.005) is None  # nobody else looks
    after = free_space(views, poses_of([*angles_deg[:3], *(angle_deg - 60.0 for angle_deg in angles_deg[3:])]), 0.005)
    assert after.excess > 1.0 > wrong.excess / after.excess
    assert after.most_contradicted({frame: frame for frame in views}) == (2, 3)
    assert after.most_contradicted({frame: -frame for frame in views}) == (3, 2)


def test_a_part_that_one_frame_alone_shows_is_not_there() -> None:
    """A frame that shows more than the others: a wider object, as of a part that is elsewhere in truth."""
    angles_deg = [5.0 * k for k in range(6)]
    views, poses = views_of(angles_deg), poses_of(angles_deg)
    longer = seen(2, turned(angles_deg[2]), axes_m=AXES_M * np.array([1.0, 1.3, 1.0]))
    found = free_space(views | {2: longer}, poses, 0.005)
    assert found.contradicted_frame == 2
    assert not found.false_surface.holds
    assert set(found.contradictions) == {2}
    false = found.contradictions[2].surface[found.contradictions[2].surface[:, 2] >= 2]
    columns = np.flatnonzero(views[2].frame.mask.any(axis=0))  # pyright: ignore[reportOptionalMemberAccess]
    rows = np.flatnonzero(views[2].frame.mask.any(axis=1))  # pyright: ignore[reportOptionalMemberAccess]
    outside = ~np.isin(false[:, 0], rows) | ~np.isin(false[:, 1], columns)
    assert outside.mean() > 0.5  # beyond the outline that the object has in truth
    assert free_space(views, poses, 0.005).false_surface.holds  # pyright: ignore[reportOptionalMemberAccess]


@pytest.mark.parametrize(("sigma", "codes"), [(0.0, []), (0.04, []), (0.12, ["unsure_size"])])
def test_a_size_that_is_open_by_more_than_5_mm_is_not_to_be_trusted(sigma: float, codes: list[str]) -> None:
    """The ellipsoid's surface lies within 80 mm of its centre."""
    found, holds = whole_run(STEPS_DEG, prior=TurntablePrior(-25.0), depth_scale_sigma=sigma)
    assert found == codes
    assert holds.get("size_m", True) == (not codes)
    assert ("size_m" in holds) == (sigma > 0.0)


def test_surface_that_never_moved_more_than_noise_shows_no_motion() -> None:
    views = views_of(STEPS_DEG)
    moved, stayed = (displacement(views, Solution(poses_of(angles))) for angles in (STEPS_DEG, [0.0, 0.3, 0.1, 0.4]))
    assert (moved.holds, stayed.holds) == (True, False)
    assert displacement(views, Solution({0: np.eye(4)})) is None


class Conveyor(AbstractPrior):
    """A prior of a user's own, which expects a turn of 25° ± 2° about the camera's vertical."""

    def between(self, source: RayImage, target: RayImage) -> AbstractPoseDensity:
        motion = turned(0.0) @ se3.inverse(turned(-25.0 * (source.index - target.index)))
        return Gaussian(motion, np.diag(np.repeat([np.radians(2.0), 0.01], 3) ** 2), source.centroid_m)


TABLE = Plane(np.array([0.0, -1.0, 0.0]), 0.1, np.radians(0.3), 0.001)


def strongest(distances: Sequence[tuple[Edge, float]]) -> tuple[Edge, Check]:
    """The contradiction of edges of which some can be compared with their prior."""
    found = contradiction(distances)
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("prior", "found_deg", "contradicted"),
    [
        (TurntablePrior(25.0), 25.0, False),
        (TurntablePrior(25.0), 28.0, False),
        (TurntablePrior(25.0), 0.0, True),
        (TurntablePrior(25.0, step_sign="unknown"), -25.0, False),
        (TurntablePrior(25.0, axis_direction=UP), -25.0, True),
        (TurntablePrior(20.0, 5.0), -70.0, True),
        (ProductPrior(TurntablePrior(25.0), GeneralPrior()), 0.0, True),
        (Conveyor(), 25.0, False),
        (Conveyor(), -25.0, True),
        (GeneralPrior(), 25.0, False),
        (GeneralPrior(), 60.0, False),  # beyond the limits of one step, which are none of knowledge
        (TablePrior(), 25.0, False),
    ],
)
def test_pairs_are_compared_with_their_prior(prior: AbstractPrior, found_deg: float, contradicted: bool) -> None:
    views = views_of([0.0, -found_deg], plane=TABLE if isinstance(prior, TablePrior) else None)
    poses = poses_of([0.0, -found_deg])  # turned left-handed about y, which points down: right-handed about up
    edge, check = strongest(prior_distances([joined(1, 0, poses)], views, prior))
    assert check.holds is not contradicted
    assert (edge.source, edge.target) == (1, 0)


@pytest.mark.parametrize(("changes", "together"), [(0, True), (1, True), (12, False)])
def test_one_new_grasp_contradicts_no_hand_and_one_at_every_step_does(changes: int, together: bool) -> None:
    angles_deg = [18.0 * k for k in range(13)]
    views, poses = views_of(angles_deg), poses_of(angles_deg)
    anew = se3.exp(np.array([np.pi, 0.0, 0.0, 0.0, 0.0, 0.1]))
    grasp, hands = np.eye(4), []
    for index, angle_deg in enumerate(angles_deg):
        grasp = grasp @ anew if 0 < index <= changes else grasp
        hands.append(turned(angle_deg) @ grasp)
    distances = prior_distances(
        [joined(k, k - 1, poses) for k in range(1, 13)], views, HeldPrior(HandPoses(np.arange(13.0), np.stack(hands)))
    )
    (_, against), check = strongest(distances), prior_check(distances)
    assert against.holds
    assert check.holds is together


def test_a_tilted_object_contradicts_its_table() -> None:
    """A step that leaves the table's plane by 5°, where 0.2° is usual."""
    views = views_of([0.0, 25.0], plane=TABLE)
    tilt = MIDDLE @ se3.exp(np.array([np.radians(5.0), 0.0, 0.0, 0.0, 0.0, 0.0])) @ se3.inverse(MIDDLE)
    right = se3.inverse(poses_of([0.0, 25.0])[1])
    for motion, holds in ((right, True), (tilt @ right, False)):
        poses = {0: np.eye(4), 1: se3.inverse(motion)}
        _, against = strongest(prior_distances([joined(1, 0, poses)], views, TablePrior()))
        assert against.holds is holds


def test_limits_that_nobody_stated_contradict_nothing() -> None:
    """A step of 80° off the table, the limits for several steps being 75°."""
    for assumed in (True, False):
        prior = AutoPrior(GeneralPrior(limits_assumed=assumed), TablePrior(limits_assumed=assumed))
        views = views_of([0.0, 80.0], plane=TABLE)
        tilt = MIDDLE @ se3.exp(np.array([np.radians(5.0), 0.0, 0.0, 0.0, 0.0, 0.0])) @ se3.inverse(MIDDLE)
        poses = {0: np.eye(4), 1: poses_of([0.0, 80.0])[1] @ tilt}
        against = contradiction(prior_distances([joined(1, 0, poses)], views, prior))
        assert assumed is (against is not None and against[1].holds)


def test_a_rotation_that_a_pair_leaves_open_contradicts_no_steps_that_the_graph_agrees_with() -> None:
    views, poses = views_of([0.0, -25.0, -50.0]), poses_of([0.0, -25.0, -50.0])
    anywhere = joined(2, 0, poses_of([0.0, 0.0, -20.0]), kind="span")
    for solution, holds in ((None, False), (Solution(poses), True), (Solution(poses_of([0.0, 0.0, -20.0])), False)):
        _, against = strongest(prior_distances([anywhere], views, TurntablePrior(25.0), solution=solution))
        assert against.holds is holds


@pytest.mark.parametrize(("step_deg", "alone", "together"), [(25.3, True, True), (28.5, True, False)])
def test_a_step_given_wrongly_shows_in_all_pairs_together(step_deg: float, alone: bool, together: bool) -> None:
    angles_deg = [-step_deg * k for k in range(13)]
    views, poses = views_of(angles_deg), poses_of(angles_deg)
    edges = [joined(k, k - 1, poses) for k in range(1, 13)]
    distances = prior_distances(edges, views, TurntablePrior(25.0))
    (_, against), check = strongest(distances), prior_check(distances)
    assert against.holds is alone
    assert check.holds is together
    assert prior_check(prior_distances([joined(5, 1, poses, kind="closure")], views, TurntablePrior(25.0))) is None


def ring(off_deg: float, *, count: int = 15) -> tuple[list[Edge], Solution]:
    """A chain of steps of 360° / 14 and a closure, which the chain misses by `off_deg`."""
    step_deg = (360.0 + off_deg) / (count - 1)
    chain = poses_of([step_deg * k for k in range(count)])
    edges = [joined(k, k - 1, chain) for k in range(1, count)]
    edges.append(joined(count - 1, 0, poses_of([0.0] * count), kind="closure"))
    return edges, solve(PoseGraph(edges=tuple(edges), first=0), {})


def test_loops_open_by_more_than_their_edges_state_speak_against_a_model() -> None:
    """Fifteen edges of 0.3° each: a loop is uncertain by 1.2°."""
    for off_deg, holds in ((0.0, True), (2.0, True), (8.0, False)):
        edges, solution = ring(off_deg)
        worst = loop_check(loop_closure_errors(edges, solution, {}))
        assert worst is not None
        error, check = worst
        assert check.holds is holds
        assert np.degrees(error.rotation_rad) == pytest.approx(off_deg, abs=1e-6)
    assert loop_check(loop_closure_errors(edges[:-1], solution, {})) is None


def test_a_loop_open_by_less_than_makes_a_pose_wrong_is_closed_however_precise_its_edges() -> None:
    for off_deg, tolerance_m, holds in ((8.0, 1.0, False), (2.5, 1.0, True), (2.5, 1e-3, False)):
        edges, solution = ring(off_deg)
        sure = [replace(error, sigmas=10.0) for error in loop_closure_errors(edges, solution, {})]
        far = [replace(error, translation_m=0.005) for error in sure]
        worst = loop_check(far, tolerance_m)
        assert worst[1].holds is holds


def test_each_of_many_loops_may_be_open_a_little_farther() -> None:
    edges, solution = ring(2.0)
    errors = loop_closure_errors(edges, solution, {})
    one, many = loop_check(errors), loop_check(errors * 50)
    assert one[1].limit == pytest.approx(np.sqrt(22.458 / 6.0), rel=1e-3)  # χ² of 6 degrees of freedom, 0.001
    assert many[1].limit > one[1].limit


def test_edges_that_contradict_each_other_speak_against_a_model() -> None:
    edges, solution = ring(0.0)
    check = graph_check(edges, solution)
    assert check.holds
    wrong = poses_of([0.0, 20.0])[1]
    spoilt = replace(edges[3].posterior, pose=replace(edges[3].posterior.pose, mean=wrong))
    spoilt_edges = [*edges[:3], replace(edges[3], posterior=spoilt), *edges[4:]]
    check = graph_check(spoilt_edges, solution)
    assert not check.holds
    assert misfit(spoilt_edges, solution) == pytest.approx(np.sqrt(check.value))
    views = views_of([360.0 * k / 14.0 for k in range(15)])
    check = graph_check(spoilt_edges, solution, views, tolerance_m=1.0)
    assert not check.holds  # 6° off
    nearly = replace(edges[3].posterior, pose=replace(edges[3].posterior.pose, mean=poses_of([0.0, 24.0])[1]))
    nearly_edges = [*edges[:3], replace(edges[3], posterior=nearly), *edges[4:]]
    for seen_in, tolerance_m, holds in ((None, 0.0, False), (views, 0.001, False), (views, 0.005, True)):
        check = graph_check(nearly_edges, solution, seen_in, tolerance_m)
        assert check.holds is holds  # 1.7° off, within what is called right
    assert misfit(edges, solution) >= 1.0
    assert graph_check(edges[:-1], solution) is None  # a tree contradicts nothing
    assert misfit(edges[:-1], solution) == 1.0


def test_modes_that_the_graph_leaves_open_speak_against_a_model() -> None:
    angles = [0.0, 25.0]
    poses, views = poses_of(angles), views_of(angles)
    motions = [se3.inverse(poses_of([0.0, angle])[1]) for angle in (25.0, 26.0, 115.0)]
    modes = tuple(Mode(1.0 / 3.0, PoseGaussian(motion, COVARIANCE)) for motion in motions)
    edge = joined(1, 0, poses, modes=modes)
    for weights, holds in (((0.5, 0.49, 0.01), True), ((0.5, 0.3, 0.2), False)):
        solution = Solution(poses, mode_weights={(1, 0): np.array(weights)})
        check = other_modes([edge], solution, views, 0.005)
        assert check.holds is holds
        assert check.value == pytest.approx(weights[2])
    assert other_modes([edge], Solution(poses), views, 0.005).value == 0.0


def test_a_pose_that_is_wrong_with_more_than_five_percent_speaks_against_a_model() -> None:
    """At the limit 95 % of poses are right; the place is that of the object, not that of the camera."""
    views, poses = views_of(STEPS_DEG), poses_of(STEPS_DEG)
    rng = np.random.default_rng(0)
    for sigma_deg, sigma_m, turn_holds, place_holds in ((1.4, 0.002, True, True), (1.6, 0.003, False, False)):
        spread = ABOUT_OBJECT + np.diag([0.0, np.radians(sigma_deg) ** 2, 0.0, 0.0, 0.0, sigma_m**2])
        away = {frame: se3.adjoint(se3.translation(view.centroid_m)) for frame, view in views.items()}
        about = {frame: spread if frame == 2 else ABOUT_OBJECT for frame in poses}
        solution = Solution(poses, {frame: away[frame] @ about[frame] @ away[frame].T for frame in poses})
        spread_from_first = AboutMean.of(solution)  # no joint covariance is known
        turn = spread_of_rotations(spread_from_first)
        place = spread_of_positions(views, solution, spread_from_first, 0.005)
        assert (turn.frame, turn.check.holds) == (2, turn_holds)
        assert (place.frame, place.check.holds) == (2, place_holds)
        assert place.check.value == pytest.approx(np.hypot(sigma_m, 0.0005), rel=0.02)
        drawn_deg = np.abs(turn.check.value * rng.normal(size=20_000))
        assert bool(np.mean(drawn_deg > 3.0) < 0.05) is turn_holds
    wider = spread_of_rotations(spread_from_first, 2.0)
    assert 1.9 < wider.check.value / turn.check.value < 2.2
    assert spread_of_rotations(AboutMean.of(Solution())) is None
    assert spread_of_positions(views, Solution(), AboutMean(), 0.005) is None


@pytest.mark.parametrize("sigmas_deg", [(1.5, 0.0, 0.0), (1.5, 0.6, 0.5), (1.3, 1.3, 0.1), (1.0, 1.0, 1.0)])
def test_a_limit_holds_for_all_axes_of_a_rotation_together(
    sigmas_deg: tuple[float, ...], rng: np.random.Generator
) -> None:
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    found = one_axis_sd(axes @ np.diag(np.square(sigmas_deg)) @ axes.T, 3.0)
    drawn_deg = np.linalg.norm(rng.normal(size=(200_000, 3)) * sigmas_deg, axis=1)
    assert 2.0 * ndtr(-3.0 / found) == pytest.approx(np.mean(drawn_deg > 3.0), abs=0.003)
    assert found > 0.999 * max(sigmas_deg)


def test_where_nearly_every_pose_is_wrong_the_root_mean_square_counts() -> None:
    assert one_axis_sd(np.diag(np.square([60.0, 50.0, 40.0])), 3.0) == pytest.approx(np.sqrt(7700.0))
    assert one_axis_sd(np.diag(np.square([1e6, 1e6, 1e6])), 3.0) == pytest.approx(np.sqrt(3e12))


def whole_run(
    angles_deg: list[float],
    *,
    unsure: int = 0,
    prior: AbstractPrior | None = None,
    last: bool = True,
    refused: Reason | None = None,
    expected: bool = False,
    depth_scale_sigma: float = 0.0,
    focal: FocalLength | None = None,
    spin_rad: float = 0.0,
) -> tuple[list[str], dict[str, bool]]:
    """Codes of what is wrong with a run whose poses are true, and which figures hold."""
    views, poses = views_of(angles_deg), poses_of(angles_deg)
    spun = COVARIANCE + spin_rad**2 * np.outer(SPIN, SPIN)
    edges = tuple(
        joined(k, k - 1, poses, pose=PoseGaussian(se3.inverse(poses[k - 1]) @ poses[k], spun))
        for k in range(1, len(views))
    )
    if refused is not None:
        edges = (*edges, replace(joined(len(views) - 1, 0, poses, kind="closure"), accepted=False, reason=refused))
    masks = [Outcome.UNSURE_MASK if index < unsure else Outcome.CONVERGED for index in views]
    frames = [FrameRecord(k, float(k), 100, "accepted", mask=mask.label) for k, mask in enumerate(masks)]
    solution = solve(PoseGraph(edges=edges, first=0), {}, focal=focal)
    step = last_step(views, edges, frames, solution=solution, last=last, make_model=ball)
    given = {"prior": prior, "closure_expected": expected, "depth_scale_sigma": depth_scale_sigma}
    verdict = judged(step, **given, tolerance_m=0.005)
    assert verdict.trustworthy == (not verdict.reasons)
    return list(verdict.codes), {name: check.holds for name, check in verdict.checks.items()}


@pytest.mark.parametrize(("sigma", "codes"), [(0.0, []), (0.03, []), (0.1, ["unsure_focal", "unsure_size"])])
def test_poses_that_hang_on_the_focal_length_are_not_to_be_trusted(sigma: float, codes: list[str]) -> None:
    """Rotations that are larger by as much as the focal length, over three steps of 25°, bend the model."""
    longer = {frame: pose @ se3.inverse(poses_of(STEPS_DEG)[frame]) for frame, pose in poses_of(LONGER_DEG).items()}
    by_focal = {frame: se3.log(moved) / 0.01 for frame, moved in longer.items()}
    focal = FocalLength(0.0, sigma, sigma, 0, 0.0, 0.0, by_focal)
    found, _ = whole_run(STEPS_DEG, prior=TurntablePrior(-25.0), focal=focal)
    assert found == codes


@pytest.mark.parametrize(
    ("turns", "codes"),
    [
        (np.array([SPIN]), []),
        (np.zeros((0, 6)), ["closures_refused", "unsure_rotation", "unsure_place"]),
        (np.array([[1.0, 0.0, 0.0, 0.0, 0.6, 0.0]]), ["unsure_rotation", "unsure_place"]),  # about another axis
    ],
)
def test_how_far_a_body_of_revolution_turned_is_no_matter_of_its_model(
    turns: Array, codes: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SymmetryFinder, "free_turns", lambda finder, model: turns)
    found, _ = whole_run(STEPS_DEG, spin_rad=0.1, refused=OpenRotation(9.0), expected=True)
    assert found == codes
    elsewhere, _ = whole_run(STEPS_DEG, spin_rad=0.1, refused=LowOverlap(0.3, 0.4), expected=True)
    assert elsewhere == ["closures_refused", "unsure_rotation", "unsure_place"]


def test_a_sound_run_is_trusted_and_shows_its_evidence() -> None:
    codes, holds = whole_run(STEPS_DEG, prior=TurntablePrior(-25.0))
    assert codes == []
    evidence = "unsure_masks motion_m prior_sds prior_chi2 free_space_violations false_surface other_modes flat_frames"
    assert holds == dict.fromkeys([*evidence.split(), "pose_sd_deg", "pose_sd_m"], True)


TURN_DEG = [30.0 * k for k in range(13)]
CONTRADICTS = Consistency(7.1, 4.7, 25.1, 0.018, 1.0, 0.05)


FAR_APART = LowOverlap(0.2, 0.4)


@pytest.mark.parametrize(
    ("angles_deg", "how", "codes"),
    [
        (STEPS_DEG, {"unsure": 2}, []),
        (STEPS_DEG, {"unsure": 3}, ["unsure_masks"]),
        ([0.0, 0.1, 0.0, 0.1], {}, ["no_motion"]),
        (STEPS_DEG, {"prior": TurntablePrior(25.0, axis_direction=UP)}, ["prior_contradicted"]),
        ([0.0] * 4, {"prior": TurntablePrior(25.0)}, ["no_motion", "prior_contradicted"]),
        # Where a turn may be complete, a loop must have been tried.
        (TURN_DEG[:9], {}, []),
        (TURN_DEG[:9], {"expected": True}, ["never_came_back"]),
        (TURN_DEG[:12], {}, ["not_tried"]),  # 30° from the first view
        (TURN_DEG, {"refused": CONTRADICTS}, ["closures_refused"]),
        (TURN_DEG, {"refused": FAR_APART}, ["closures_refused"]),
        (TURN_DEG[:11], {"refused": FAR_APART}, []),  # 60° apart: surface in common is not to be expected
        (TURN_DEG[:11], {"refused": Failed(Outcome.NO_OVERLAP)}, []),
        (TURN_DEG[:11], {"refused": Failed(Outcome.NO_OVERLAP), "expected": True}, ["closures_refused"]),
        (TURN_DEG[:11], {"refused": CONTRADICTS}, ["closures_refused"]),
        (TURN_DEG[:11], {"refused": LowLikelihood(-90.0, -20.0)}, []),
        (TURN_DEG[:11], {"refused": LowCorrelation(0.0, 0.8)}, []),
        (TURN_DEG, {"refused": LowCorrelation(0.0, 0.8)}, ["closures_refused"]),
    ],
)
def test_each_fault_of_a_run_has_its_code(angles_deg: list[float], how: dict[str, Any], codes: list[str]) -> None:
    assert whole_run(angles_deg, **how)[0] == codes


def test_evidence_is_gathered_once_all_edges_are_in() -> None:
    assert whole_run(STEPS_DEG, unsure=4, last=False) == (["unfinished"], {})


def test_two_segments_need_two_pairs_that_join_them_and_what_is_between_them_counts_not() -> None:
    angles_deg = [0.0, 25.0, 50.0, 30.0, 55.0, 80.0]  # of frames 0 to 2, and 4 to 6, after the object was put down anew
    numbers = [0, 1, 2, 4, 5, 6]
    views = {k: seen(k, turned(angle_deg)) for k, angle_deg in zip(numbers, angles_deg, strict=True)}
    poses = dict(zip(numbers, poses_of(angles_deg).values(), strict=True))
    chain = [joined(k, k - 1, poses) for k in (1, 2, 5, 6)]
    joins = [joined(4, 1, poses, kind="join"), joined(5, 2, poses, kind="join")]
    for count, lost, expected in ((2, 3, set()), (1, 3, {"unconfirmed"}), (2, 7, {"left_out"})):
        edges = (*chain, *joins[:count])
        records = [FrameRecord(k, float(k), 100, "accepted") for k in numbers]
        records.append(FrameRecord(lost, float(lost), 0, "a hand", cause="no overlap"))
        step = last_step(views, edges, records)
        # Steps of 25° where the motion was known, and none of the joins is one.
        verdict = judged(step, prior=TurntablePrior(-25.0, axis_direction=UP), tolerance_m=0.005)
        assert {*verdict.codes} == expected
