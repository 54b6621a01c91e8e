"""Differences along a ridge: those of both halves of the points are evidence, those of one are chance."""

from dataclasses import replace
from typing import Final

import numpy as np
import pytest

from modeler import se3
from modeler.evaluation import nees, true_motion
from modeler.priors import GeneralPrior
from modeler.registration import VisibilityLikelihood, VisibilityRegistrar
from modeler.registration.visibility import ridge
from modeler.registration.visibility.likelihood import PairLikelihood
from modeler.registration.visibility.ridge import reliability, without_chance
from modeler.segmentation import Segmenter
from modeler.sequences import bundled, open_sequence
from modeler.sequences.rendering import RenderedSequence
from modeler.sequences.rendering.recipe import Place, Places, load_recipe
from modeler.types import Array, RayImage
from modeler.views import Sensor

BASIN: Final = np.repeat([0.2, 0.01], 3)


@pytest.fixture(scope="module")
def tube() -> PairLikelihood:
    """Two views of the bundled tube."""
    sequence = open_sequence(bundled("tube"))
    frames = [sequence.frame(index) for index in (0, 1)]
    target, source = (Sensor().ray_image(frame, None) for frame in frames)
    return VisibilityLikelihood().between(source, target, np.random.default_rng(0))


def spins(count: int, apart_rad: float = 1.0) -> Array:
    """Return poses on a ridge, far enough apart for each to have a difference of its own."""
    xi = np.zeros((count, 6))
    xi[:, 1] = apart_rad * (np.arange(count) - count // 2)
    return se3.exp(xi)


def of(pair: PairLikelihood, poses: Array) -> tuple[Array, Array]:
    """Return the log-likelihoods of poses, and those without chance."""

    def plain(some: Array, _: Array) -> Array:
        return pair.tempered(some, 0.002)

    without = without_chance(pair, poses, plain, blur_m=0.002, typical_misfit=0.5, basin=BASIN)
    return plain(poses, np.zeros(len(poses))), without(poses, np.zeros(len(poses)))


def test_halves_are_parts_of_the_likelihood(tube: PairLikelihood) -> None:
    poses = spins(7, 0.05)
    found = ridge.by_halves(tube, poses, 0.002, typical_misfit=0.5)
    assert found.shape == (2, 2, 7)
    assert found.sum(axis=(0, 1)) == pytest.approx(tube.scores(poses, 0.002, stride=1).surface, abs=0.1)
    assert np.all(np.ptp(found, axis=2) > 0.0)


def test_what_both_halves_show_is_reliable(rng: np.random.Generator) -> None:
    shown = rng.normal(size=(2, 1, 30))
    assert reliability(np.repeat(shown, 2, axis=1)) == pytest.approx(1.0)
    assert reliability(np.repeat(shown, 2, axis=1) * 3.0 + 5.0) == pytest.approx(1.0)
    assert reliability(np.concatenate([shown, -shown], axis=1)) == 0.0
    assert reliability(np.zeros((2, 2, 30))) == 0.0


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_the_reliability_is_the_share_of_the_variance_of_sums(share: float, rng: np.random.Generator) -> None:
    """With variance `share` in what the halves have in common: of their sum, 4 s / (4 s + 2 (1 - s))."""
    common, own = rng.normal(size=(2, 1, 20000)), rng.normal(size=(2, 2, 20000))
    halves = np.sqrt(share) * common + np.sqrt(1.0 - share) * own
    assert reliability(halves) == pytest.approx(2.0 * share / (1.0 + share), abs=0.02)


def test_few_poses_are_no_ridge(tube: PairLikelihood) -> None:
    plain, without = of(tube, spins(4))
    assert np.array_equal(plain, without)


def test_chance_goes_and_evidence_stays(tube: PairLikelihood, monkeypatch: pytest.MonkeyPatch) -> None:
    """If the halves do not agree, poses of the ridge are equally likely, their mean likelihood as before."""
    poses, half = spins(6), np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
    monkeypatch.setattr(ridge, "by_halves", lambda *_, **__: np.stack([[half, -half]] * 2))
    plain, without = of(tube, poses)
    assert np.ptp(plain) > 1.0
    assert without == pytest.approx(np.full(6, without[0]), abs=1e-3)
    assert np.logaddexp.reduce(without) == pytest.approx(np.logaddexp.reduce(plain), abs=1e-3)
    monkeypatch.setattr(ridge, "by_halves", lambda *_, **__: np.stack([[half, half]] * 2))
    plain, without = of(tube, poses)
    assert without == pytest.approx(plain)


@pytest.mark.parametrize("seed", range(4))
def test_the_spin_of_a_bowl_is_open(seed: int) -> None:
    """A plain bowl turned by 40°: noise must not pretend to tell by how much."""
    source, target, truth = bowls(seed)
    density = GeneralPrior().between(source, target)
    posterior = VisibilityRegistrar().register(source, target, density, rng=np.random.default_rng(seed))
    assert posterior.usable
    assert nees(posterior.pose, truth) < 22.5  # χ²₆ at 0.999


def bowls(seed: int) -> tuple[RayImage, RayImage, Array]:
    """Return two views of a bowl, the second turned, and the true motion from the second to the first."""
    turns = Places((Place(), Place(rotation_deg=(0.0, 0.0, 40.0))))
    sequence = RenderedSequence(replace(load_recipe("bowl"), seed=seed, trajectory=turns))
    noise, truth, segmenter = sequence.sensor(), sequence.truth(), Segmenter()
    frames = [sequence.frame(index) for index in (0, 1)]
    scene = segmenter.scene(frames)
    sensor = Sensor(noise).measured(scene.range_noise)
    target, source = (sensor.ray_image(frame, segmenter.segment(frame, scene).plane) for frame in frames)
    return source, target, true_motion(truth, target=0, source=1)
