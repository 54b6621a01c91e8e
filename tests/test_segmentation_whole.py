"""Objects are found in whole sequences, rendered and recorded, without their masks."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from worlds import World, iou

from modeler.segmentation import Scene, Segmenter
from modeler.types import Outcome
from sequences.bop import BopSequence

BUNDLED = Path(__file__).parents[1] / "sequences" / "bundled"
REAL = Path(__file__).parents[2] / "shared" / "data"


def bare(frames):
    return [replace(frame, mask=None) for frame in frames]


def test_what_rises_over_the_end_of_its_table_is_sure(rng):
    """A table before nothing, in a part of the image: what is taller than its far end is not cut off."""
    frames = [
        World()
        .box((0.0, 0.0, -0.01), (0.32, 0.2, 0.01))
        .box((0.0, 0.05, 0.12), (0.05, 0.04, 0.12), turn_deg=20.0 * k)
        .frame(k, rng)[0]
        for k in range(5)
    ]
    segmenter = Segmenter()
    scene = segmenter.scene(frames)
    assert {segmenter.segment(frame, scene).outcome for frame in frames} == {Outcome.CONVERGED}


@pytest.mark.parametrize("name", ["box", "flashlight", "tube"])
def test_rendered_sequences_without_their_masks(name):
    frames = list(BopSequence(BUNDLED / name))
    segmenter = Segmenter()
    scene = segmenter.scene(bare(frames)[:: max(1, len(frames) // 12)])
    for frame in frames:
        assert frame.mask is not None
        one = segmenter.segment(replace(frame, mask=None), scene)
        assert iou(one.mask, frame.mask & np.isfinite(frame.depth_m)) >= 0.97
        assert one.outcome is Outcome.CONVERGED


@pytest.mark.parametrize("name", ["box", "flashlight", "tube"])
def test_table_of_rendered_sequences(name):
    """The model turns about the table's normal, so that its axis is the same in every frame."""
    truth = json.loads((BUNDLED / name / "scene_gt.json").read_text())
    turns = np.array([np.reshape(truth[key][0]["cam_R_m2c"], (3, 3)) for key in sorted(truth, key=int)])
    steps = Rotation.from_matrix(turns[1:] @ turns[:-1].transpose(0, 2, 1)).as_rotvec()
    normal = steps.sum(axis=0) / np.linalg.norm(steps.sum(axis=0))
    for frame in list(BopSequence(BUNDLED / name))[::5]:
        plane = Segmenter().segment(frame, Scene()).plane
        assert plane is not None
        assert np.arccos(min(1.0, abs(plane.normal @ normal))) < 2.0 * plane.sigma_tilt_rad


@pytest.mark.skipif(not REAL.exists(), reason="the real sequences are not here")
@pytest.mark.parametrize(
    ("name", "pixels", "object_px"),
    [
        ("cap", (16000, 21000), (300, 230)),
        ("kleenex", (11000, 16500), (315, 260)),
        ("castard", (38000, 75000), (345, 250)),
        ("dog_upright", (19000, 27000), (350, 200)),
    ],
)
def test_real_sequences(name, pixels, object_px):
    """Sizes and places are those of masks that were looked at, frame by frame."""
    frames = [frame for frame in BopSequence(REAL / name)]
    segmenter = Segmenter()
    picks = np.unique(np.linspace(0, len(frames) - 1, 12).round().astype(int))
    scene = segmenter.scene([frames[k] for k in picks])
    assert scene.plane is not None
    for frame in frames:
        one = segmenter.segment(frame, scene)
        assert one.outcome is Outcome.CONVERGED
        assert pixels[0] < np.count_nonzero(one.mask) < pixels[1]
        assert np.abs(np.argwhere(one.mask).mean(axis=0)[::-1] - object_px).max() < 60.0
