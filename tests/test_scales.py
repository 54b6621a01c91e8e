"""The same images of a world of another scale: the same answers, with all lengths in proportion."""

from dataclasses import replace

import numpy as np
import pytest
from segmentation_worlds import World

from modeler import se3
from modeler.pipeline import Modeler
from modeler.priors import GeneralPrior
from modeler.segmentation import DepthNoise, Scene, Segmenter
from modeler.sequences import bundled, open_sequence
from modeler.types import Step
from modeler.views import Sensor

SCALES = [0.125, 8.0]  # powers of two, so that nothing is rounded otherwise


def scaled_noise(scale: float) -> DepthNoise:
    noise = DepthNoise()
    return DepthNoise(scale * noise.floor_m, noise.quadratic_per_m / scale)


@pytest.fixture(scope="module")
def built() -> dict[float, list[Step]]:
    sequence = open_sequence(bundled("box"))
    noise = sequence.sensor()
    frames = [sequence.frame(index) for index in sequence.indices[:3]]
    runs = {}
    for scale in (1.0, *SCALES):
        modeler = Modeler(sensor=Sensor(noise._replace(sigma_r_m=None)), prior=GeneralPrior(limits_assumed=True))
        images = [replace(frame, depth_m=np.float32(scale) * frame.depth_m) for frame in frames]
        runs[scale] = [step for step in modeler.run(images, Scene()) if isinstance(step, Step)]
    return runs


@pytest.mark.parametrize("scale", SCALES)
def test_a_model_is_built_alike_at_every_scale(built: dict[float, list[Step]], scale: float) -> None:
    one, other = built[1.0][-1], built[scale][-1]
    assert [(edge.source, edge.target, edge.kind, edge.accepted) for edge in one.edges_so_far] == [
        (edge.source, edge.target, edge.kind, edge.accepted) for edge in other.edges_so_far
    ]
    assert one.verdict.codes == other.verdict.codes
    assert other.verdict.tolerance_m == pytest.approx(scale * one.verdict.tolerance_m, rel=1e-6)
    units = np.array([1.0, 1.0, 1.0, scale, scale, scale])
    first, *others = one.solution.trajectory
    np.testing.assert_array_equal(other.solution.trajectory[first], one.solution.trajectory[first])
    for frame in others:
        pose = one.solution.trajectory[frame]
        resized = other.solution.trajectory[frame].copy()
        resized[:3, 3] /= scale
        sigmas = np.sqrt(np.diagonal(one.solution.covariances[frame]))
        other_sigmas = np.sqrt(np.diagonal(other.solution.covariances[frame])) / units
        np.testing.assert_allclose(other_sigmas, sigmas, rtol=0.25)
        assert np.all(np.abs(se3.log(se3.inverse(pose) @ resized)) <= 0.5 * sigmas)
    assert one.model is not None
    assert other.model is not None
    extents_m = [np.ptp(step.model.vertices_m, axis=0) for step in (one, other)]  # pyright: ignore[reportOptionalMemberAccess]
    np.testing.assert_allclose(extents_m[1], scale * extents_m[0], rtol=0.02)


@pytest.mark.parametrize("scale", SCALES)
def test_an_object_is_found_alike_at_every_scale(rng: np.random.Generator, scale: float) -> None:
    frames = [
        World().table().box((0.01 * k, 0.0, 0.07), (0.06, 0.035, 0.07), turn_deg=25.0 * k).frame(k, rng)[0]
        for k in range(4)
    ]
    masks = []
    for factor in (1.0, scale):
        images = [replace(frame, depth_m=np.float32(factor) * frame.depth_m) for frame in frames]
        segmenter = Segmenter(noise=scaled_noise(factor))
        scene = segmenter.scene(images)
        masks.append([segmenter.segment(image, scene).mask for image in images])
    for mask, resized in zip(*masks, strict=True):
        assert mask.any()
        assert np.count_nonzero(mask ^ resized) <= 0.01 * np.count_nonzero(mask)
