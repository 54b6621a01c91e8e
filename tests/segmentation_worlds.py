"""Scenes of boxes on tables for tests of segmentation, and how well masks fit."""

import numpy as np
from scipy.spatial.transform import Rotation
from tabletop import Box

from modeler.segmentation import Segmenter
from modeler.types import Camera, Frame

CAMERA = Camera(width=240, height=180, fx=220.0, fy=220.0, cx=119.5, cy=89.5)
OBJECT = 1


class World:
    """Boxes in a frame whose z axis points up from the table, before a camera that looks down at its origin."""

    def __init__(self, tilt_deg=35.0, distance_m=0.8, turn_deg=0.0):
        tilt = np.radians(tilt_deg)
        down = np.array([[1.0, 0.0, 0.0], [0.0, -np.sin(tilt), -np.cos(tilt)], [0.0, np.cos(tilt), -np.sin(tilt)]])
        turn = Rotation.from_rotvec([0.0, 0.0, np.radians(turn_deg)]).as_matrix()
        self.camera_from_table = down @ turn
        self.origin_m = np.array([0.0, 0.0, distance_m])
        self.boxes = []

    def box(self, centre_m, half_m, *, turn_deg=0.0, label=0):
        """Return the world with a box more."""
        turn = Rotation.from_rotvec([0.0, 0.0, np.radians(turn_deg)]).as_matrix()
        self.boxes.append((np.array(centre_m), tuple(half_m), turn, label))
        return self

    def table(self):
        """Return the world with a table whose top is z = 0."""
        return self.box((0.0, 0.0, -0.01), (0.6, 0.45, 0.01))

    def frame(self, index, rng, sigma_m=0.001):
        """Return a frame without a mask, and the object's true pixels."""
        w, h = CAMERA.rays()
        rays = np.stack([w, h, np.ones_like(w)], axis=-1).reshape(-1, 3)
        depth, labels = np.full(len(rays), np.inf), np.zeros(len(rays), dtype=int)
        for centre, half_m, turn, label in self.boxes:
            box_from_camera = turn.T @ self.camera_from_table.T
            eye = box_from_camera @ -self.origin_m - turn.T @ centre
            found, _ = Box(half_m).cast(eye, rays @ box_from_camera.T)
            nearer = found < depth
            depth[nearer], labels[nearer] = found[nearer], label
        depth[np.isinf(depth)] = np.nan
        image = (depth + rng.normal(0.0, sigma_m, len(depth))).reshape(w.shape).astype(np.float32)
        return Frame(index, float(index), image, CAMERA), (labels == OBJECT).reshape(w.shape)


def filmed(count, rng, world_of, **noise):
    """Return frames of the worlds of their numbers, and the object's true pixels (h, w) in each."""
    views = [world_of(k).frame(k, rng, **noise) for k in range(count)]
    return [frame for frame, _ in views], [mask for _, mask in views]


def segmented(frames, scene=None, **fields):
    """Return what is found in frames, whose scene is learned from all of them where none is given."""
    segmenter = Segmenter(**fields)
    scene = segmenter.scene(frames) if scene is None else scene
    return [segmenter.segment(frame, scene) for frame in frames]


def least_iou(found, masks):
    return min(iou(one.mask, mask) for one, mask in zip(found, masks, strict=True))


def iou(found, true):
    return np.count_nonzero(found & true) / np.count_nonzero(found | true)
