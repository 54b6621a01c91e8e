"""How well the object is found without masks: intersection over union with the truth, frame by frame."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

import numpy as np

from modeler.segmentation import Segmenter, scene_frames
from modeler.types import BoolArray, Camera, Frame, Outcome, Segmentation
from studies.scenes.plan import FRAMES, KINDS, Plan
from studies.trust.stage import Recorded

LEAST: Final = 0.8
"""Intersection over union below which a mask is bad."""


@final
@dataclass(frozen=True, eq=False)
class Shots:
    """The frames of a scene, and the object's true pixels among the measured ones."""

    frames: tuple[Frame, ...]
    """Without masks."""
    masks: tuple[BoolArray, ...]
    """(h, w) of each."""


def shots(plan: Plan, folder: Path) -> Shots:
    """Return what a plan shows; it is rendered once, and then read from a folder."""
    path = folder / f"{plan.half}-{plan.number}.npz"
    camera: Camera
    if not path.exists():
        recorded = Recorded(plan.stage())
        frames = [recorded.frame(index) for index in recorded.indices]
        true = [recorded.true_frame(index).mask for index in recorded.indices]
        camera = frames[0].camera
        numbers = [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy]
        path.parent.mkdir(parents=True, exist_ok=True)
        depth_m, masks = np.stack([frame.depth_m for frame in frames]), np.stack([m for m in true if m is not None])
        np.savez_compressed(path, depth_m=depth_m, masks=masks, camera=numbers)
    with np.load(path) as stored:
        width, height, *others = stored["camera"].tolist()
        camera = Camera(int(width), int(height), *others)
        depths_m, masks = stored["depth_m"], stored["masks"]
    frames = tuple(Frame(index, float(index), depth_m, camera) for index, depth_m in enumerate(depths_m))
    return Shots(frames, tuple(mask & np.isfinite(depth_m) for mask, depth_m in zip(masks, depths_m, strict=True)))


@final
@dataclass(frozen=True)
class Found:
    """How well the object was found in a scene."""

    plan: Plan
    """Which scene."""
    ious: tuple[float, ...]
    """Of each frame."""
    unsure: tuple[bool, ...]
    """Whether the segmenter says so, or finds nothing."""
    seconds: float
    """Time per frame, learning the scene included."""


def find(plan: Plan, folder: Path) -> tuple[Found, Shots, list[Segmentation]]:
    """Segment the frames of a scene as a build does, and compare the masks with the truth."""
    shown, segmenter = shots(plan, folder), Segmenter()
    began = time.perf_counter()
    scene = segmenter.scene([shown.frames[index] for index in scene_frames(range(len(shown.frames)))])
    found = [segmenter.segment(frame, scene) for frame in shown.frames]
    seconds = (time.perf_counter() - began) / len(found)
    ious = tuple(iou(one.mask, mask) for one, mask in zip(found, shown.masks, strict=True))
    return Found(plan, ious, tuple(one.outcome is not Outcome.CONVERGED for one in found), seconds), shown, found


def iou(found: BoolArray, true: BoolArray) -> float:
    """Return intersection over union of two masks; 1 where both are empty."""
    union = np.count_nonzero(found | true)
    return np.count_nonzero(found & true) / union if union else 1.0


def picture(shown: Shots, found: Sequence[Segmentation]) -> np.ndarray:
    """Return the frames of a scene side by side (h, w, 3): red what was found rightly, blue wrongly, yellow missed."""
    tiles = []
    for frame, true, one in zip(shown.frames, shown.masks, found, strict=True):
        near_m, far_m = np.nanpercentile(frame.depth_m, [2, 95])
        grey = np.nan_to_num(220.0 - 180.0 * np.clip((frame.depth_m - near_m) / (far_m - near_m), 0.0, 1.0))
        tile = np.repeat(grey[..., None], 3, axis=2)
        right, wrong, missed = one.mask & true, one.mask & ~true, true & ~one.mask
        for where, rgb in ((right, (220, 60, 60)), (wrong, (60, 60, 255)), (missed, (240, 220, 0))):
            tile[where] = 0.3 * tile[where] + 0.7 * np.array(rgb)
        tiles.append(tile[::2, ::2].astype(np.uint8))
    return np.concatenate(tiles, axis=1)


def table(results: Sequence[Found]) -> str:
    """Return a line for each kind of scene and one for all."""
    lines = [f"{'':24}{'frames':>8}{'median':>8}{'below 0.8':>11}{'unsaid':>8}{'unsure though good':>20}{'ms':>6}"]
    for name in (*KINDS, "all"):
        some = [one for one in results if name in (one.plan.kind, "all")]
        if not some:
            continue
        ious = np.array([value for one in some for value in one.ious])
        unsure = np.array([value for one in some for value in one.unsure])
        bad = ious < LEAST
        lines.append(
            f"{name:24}{len(ious):8}{np.median(ious):8.3f}{bad.mean():11.1%}{(bad & ~unsure).mean():8.1%}"
            f"{(unsure & ~bad).mean():20.1%}{1000.0 * np.mean([one.seconds for one in some]):6.0f}"
        )
    return "\n".join(lines)


SCENES: Final = 3 * len(KINDS)
"""Of a half, of `FRAMES` each."""
assert FRAMES <= 15  # so that all are evaluated
