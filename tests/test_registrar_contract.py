"""What every registration method must keep, whatever it computes."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
import tabletop

from modeler import baselines, registration, se3
from modeler.priors import GeneralPrior, PredictedProposal
from modeler.types import (
    AbstractPoseDensity,
    AbstractRegistrar,
    Array,
    Frame,
    Outcome,
    PoseGaussian,
    Posterior,
    RayImage,
    SensorNoise,
    ViewPair,
)
from modeler.views import Sensor

MAX_OFFSET_M = 0.02
PRIOR = GeneralPrior(max_rotation_deg=25.0, max_offset_m=MAX_OFFSET_M)
BODY = tabletop.Box((0.05, 0.08, 0.035))
POSES = tabletop.turntable(24)[2:4]

CLOUD_METHODS: list[AbstractRegistrar] = [
    baselines.IcpRegistrar(),
    baselines.GicpRegistrar(),
    baselines.FpfhRegistrar(),
    baselines.FpfhIcpRegistrar(),
    baselines.ColouredIcpRegistrar(),
]
IMAGE_METHODS: list[AbstractRegistrar] = [
    registration.VisibilityRegistrar(),
    baselines.PaperRegistrar(samples=150_000, points=25),
]
METHODS = CLOUD_METHODS + IMAGE_METHODS

TOLERANCE = 2.5, 0.004  # degrees, m
# Features without refinement, on a body that has three edges and no other feature; the nearest of few samples.
COARSE_TOLERANCE = 8.0, 0.012
COARSE = baselines.FpfhRegistrar, baselines.PaperRegistrar

FOUND = Outcome.CONVERGED, Outcome.AMBIGUOUS, Outcome.DEGENERATE

every_method = pytest.mark.parametrize("method", METHODS, ids=lambda m: type(m).__name__)
every_cloud_method = pytest.mark.parametrize("method", CLOUD_METHODS, ids=lambda m: type(m).__name__)


@dataclass(frozen=True)
class Carried(AbstractPoseDensity):
    """Another density between views that were each moved: target_new_from_target · T · source_from_source_new."""

    density: AbstractPoseDensity
    before: Array
    after: Array
    evidence: bool = True

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        return self.after @ self.density.sample(count, rng) @ self.before

    def log_density(self, target_from_source: Array) -> Array:
        return self.density.log_density(se3.inverse(self.after) @ target_from_source @ se3.inverse(self.before))


@cache
def view(index: int) -> RayImage:
    """Return frame `index` of a box that turns by 15° a frame and shows three faces, with depth noise."""
    frame = tabletop.view(BODY, POSES[index], index, rng=np.random.default_rng(index), table=False).frame
    return Sensor(SensorNoise(0.002, 0.001)).ray_image(frame)


def empty(index: int) -> RayImage:
    seen = view(index).frame
    nothing = Frame(index, seen.time_s, np.full_like(seen.depth_m, np.nan), seen.camera, np.zeros_like(seen.mask))
    return Sensor().ray_image(nothing)


def moved(seen: RayImage, pose: Array) -> RayImage:
    return replace(seen, points_m=se3.transform(pose, seen.points_m), normals=seen.normals @ pose[:3, :3].T)


@cache
def registered(method: AbstractRegistrar, source: int, target: int) -> Posterior:
    a, b = view(source), view(target)
    return method.register(a, b, PRIOR.between(a, b), rng=np.random.default_rng(5))


def assert_close(method: AbstractRegistrar, found: Array, expected: Array) -> None:
    """Check two motions of view 0 against each other, at its centroid."""
    centre = view(0).centroid_m[None]
    shift = se3.transform(found, centre) - se3.transform(expected, centre)
    degrees, metres = COARSE_TOLERANCE if isinstance(method, COARSE) else TOLERANCE
    assert np.degrees(se3.rotation_angle(se3.inverse(found) @ expected)) < degrees
    assert np.linalg.norm(shift) < metres


@every_method
def test_finds_the_motion_of_an_easy_pair(method: AbstractRegistrar) -> None:
    found = registered(method, 0, 1)
    assert found.outcome in FOUND
    assert (found.source, found.target) == (0, 1)
    assert_close(method, found.pose.mean, POSES[1] @ se3.inverse(POSES[0]))


@every_method
def test_does_not_move_identical_views(method: AbstractRegistrar) -> None:
    found = registered(method, 0, 0)
    assert found.outcome in FOUND
    assert_close(method, found.pose.mean, np.eye(4))


@every_method
def test_swapping_the_views_inverts_the_motion(method: AbstractRegistrar) -> None:
    assert_close(method, se3.inverse(registered(method, 1, 0).pose.mean), registered(method, 0, 1).pose.mean)


def test_a_known_mode_that_the_prior_excludes_is_at_its_limit() -> None:
    source, target = view(0), view(1)
    away = se3.moved(POSES[1] @ se3.inverse(POSES[0]), np.array([0.0, 0.0, 2.0, 0.0, 0.0, 0.0]), source.centroid_m)
    pair = ViewPair(source, target, PRIOR.between(source, target), np.random.default_rng(5), near=away)
    assert registration.VisibilityRegistrar().posterior_of(pair).outcome is Outcome.AT_LIMIT


@pytest.mark.parametrize(
    "method",
    [registration.VisibilityRegistrar(), baselines.PaperRegistrar(samples=50_000, points=4)],
    ids=lambda m: type(m).__name__,
)
def test_a_guess_tells_where_to_look_and_is_no_evidence(method: AbstractRegistrar) -> None:
    """Guesses on either side of the truth, surer than four points are, do not pull the answer to themselves."""
    source, target = view(0), view(1)
    truth = POSES[1] @ se3.inverse(POSES[0])
    axis = se3.log(truth)[:3] / np.linalg.norm(se3.log(truth)[:3])
    about = se3.adjoint(se3.translation(source.centroid_m))
    spread = about @ np.diag(np.repeat([np.radians(1.0), 0.002], 3) ** 2) @ about.T
    turned_deg = []
    for off_deg in (-6.0, 6.0):
        xi = np.concatenate([np.radians(off_deg) * axis, np.zeros(3)])
        guess = PredictedProposal(PRIOR, PoseGaussian(se3.moved(truth, xi, source.centroid_m), spread))
        found = method.register(source, target, guess.between(source, target), rng=np.random.default_rng(5))
        turned_deg.append(np.degrees(se3.difference(truth, found.pose.mean, source.centroid_m)[:3] @ axis))
    assert abs(turned_deg[1] - turned_deg[0]) < 1.5  # of the 12 between the guesses


@every_method
def test_failure_hands_on_what_was_known(method: AbstractRegistrar) -> None:
    nothing, seen = empty(0), view(1)
    found = method.register(nothing, seen, PRIOR.between(nothing, seen), rng=np.random.default_rng(5))
    assert not found.usable
    assert found.seconds >= 0.0
    sigma_m = np.sqrt(np.diag(found.pose.covariance)[3:])
    assert np.all((sigma_m > 0.1 * MAX_OFFSET_M) & (sigma_m < 100.0 * MAX_OFFSET_M))
    assert np.linalg.eigvalsh(found.pose.covariance)[0] > 0.0


@every_cloud_method
def test_moving_the_views_moves_the_answer(method: AbstractRegistrar) -> None:
    source, target = view(0), view(1)
    source_new_from_source = se3.exp(np.array([0.3, -0.2, 0.5, 0.1, 0.2, -0.05]))
    target_new_from_target = se3.exp(np.array([-0.4, 0.1, 0.2, -0.2, 0.1, 0.1]))
    density = Carried(PRIOR.between(source, target), se3.inverse(source_new_from_source), target_new_from_target)
    found = method.register(
        moved(source, source_new_from_source),
        moved(target, target_new_from_target),
        density,
        rng=np.random.default_rng(5),
    )
    back = se3.inverse(target_new_from_target) @ found.pose.mean @ source_new_from_source
    assert_close(method, back, registered(method, 0, 1).pose.mean)


@every_method
def test_states_a_proper_gaussian(method: AbstractRegistrar) -> None:
    found = registered(method, 0, 1)
    covariance = found.pose.covariance
    np.testing.assert_array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance)[0] > 0.0
    np.testing.assert_allclose(se3.inverse(found.pose.mean) @ found.pose.mean, np.eye(4), atol=1e-9)
    assert 0.0 <= found.overlap <= 1.0
    assert found.matches
    assert found.seconds > 0.0


@every_method
@pytest.mark.parametrize("missing", ["source", "target", "both"])
def test_says_so_where_there_is_nothing_to_register(method: AbstractRegistrar, missing: str) -> None:
    density = PRIOR.between(view(0), view(1))
    source = view(0) if missing == "target" else empty(0)
    target = view(1) if missing == "source" else empty(1)
    found = method.register(source, target, density, rng=np.random.default_rng(5))
    assert found.outcome in (Outcome.TOO_FEW_POINTS, Outcome.NO_OVERLAP)
    assert found.overlap == 0.0
    assert not found.matches
    assert np.all(np.isfinite(found.pose.mean))
    assert np.linalg.eigvalsh(found.pose.covariance)[0] > 0.0


@every_method
def test_gives_the_same_answer_for_the_same_seed(method: AbstractRegistrar) -> None:
    source, target = view(0), view(1)
    again = method.register(source, target, PRIOR.between(source, target), rng=np.random.default_rng(5))
    first = registered(method, 0, 1)
    assert again.pose.mean.tobytes() == first.pose.mean.tobytes()
    assert again.pose.covariance.tobytes() == first.pose.covariance.tobytes()
    assert again.overlap == first.overlap


@pytest.mark.parametrize("method", [METHODS[0], METHODS[1], *IMAGE_METHODS], ids=lambda m: type(m).__name__)
def test_finds_no_overlap_between_views_that_the_prior_keeps_apart(method: AbstractRegistrar) -> None:
    source, target = view(0), view(1)
    apart = se3.translation(np.array([0.6, 0.0, 0.0]))
    density = Carried(PRIOR.between(source, target), np.eye(4), apart)
    found = method.register(source, target, density, rng=np.random.default_rng(5))
    assert not found.usable
