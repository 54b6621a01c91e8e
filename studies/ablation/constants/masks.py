"""The stage of segmentation: masks of the same frames."""

from __future__ import annotations

import numpy as np

from modeler.segmentation import Segmenter
from modeler.types import BoolArray
from studies.ablation.constants.inputs import Figures, Footage, digest


def masks(footage: Footage) -> Figures:
    """Segment frames as a build does: intersection over union with the default's masks, and with the truth."""
    segmenter = Segmenter()
    scene = segmenter.scene(footage.frames)
    found = [segmenter.segment(frame, scene) for frame in footage.frames]
    planes = [None if one.plane is None else (one.plane.normal, one.plane.offset_m) for one in found]
    default = footage.found or found
    figures: Figures = {
        "digest": digest([(np.packbits(one.mask), one.outcome.name) for one in found] + planes).hex()[:12],
        "iou": float(np.mean([iou(one.mask, old.mask) for one, old in zip(found, default, strict=True)])),
        "outcomes": float(sum(one.outcome is not old.outcome for one, old in zip(found, default, strict=True))),
        "planes": float(sum(plane is not None for plane in planes)),
    }
    if footage.true_masks is not None:
        figures["true_iou"] = float(
            np.mean([iou(one.mask, mask) for one, mask in zip(found, footage.true_masks, strict=True)])
        )
    if not footage.found:
        footage.found.extend(found)
    return figures


def planes(footage: Footage) -> Figures:
    """Fit the support planes of frames, with their uncertainty."""
    segmenter = Segmenter()
    scene = segmenter.scene(footage.frames)
    found = [plane for frame in footage.frames if (plane := segmenter.segment(frame, scene).plane) is not None]
    parts = [(plane.normal, plane.offset_m, plane.sigma_tilt_rad, plane.sigma_offset_m) for plane in found]
    return {
        "digest": digest(parts).hex()[:12],
        "tilt_deg": float(np.degrees(np.mean([plane.sigma_tilt_rad for plane in found]))),
        "offset_mm": 1e3 * float(np.mean([plane.sigma_offset_m for plane in found])),
    }


def iou(found: BoolArray, true: BoolArray) -> float:
    """Return intersection over union of two masks; 1 where both are empty."""
    union = np.count_nonzero(found | true)
    return np.count_nonzero(found & true) / union if union else 1.0
