"""A small BOP scene of random pictures."""

from pathlib import Path

import numpy as np

from modeler import se3
from modeler.sequences import write_bop
from modeler.types import Camera, Frame

CAMERA = Camera(40, 30, 57.5, 58.5, 19.25, 14.75)
INDICES = (3, 7, 12)


def frame(index: int, rng: np.random.Generator) -> Frame:
    """Return a frame of random depth, mask and colour."""
    depth_m = rng.uniform(0.4, 6.0, (30, 40)).astype(np.float32)
    depth_m[rng.random((30, 40)) < 0.2] = np.nan
    mask = rng.random((30, 40)) < 0.5
    colour = rng.integers(0, 256, (30, 40, 3), dtype=np.uint8)
    return Frame(index, 0.1 * index + 0.01, depth_m, CAMERA, mask, colour)


META = {"name": "thing", "sensor": {"sigma_wh": 1e-3, "sigma_r_m": 2e-3}, "motion": {"kind": "table", "step_deg": 25}}


def random_frames() -> list[Frame]:
    """Return the frames of the scene."""
    rng = np.random.default_rng(0)
    return [frame(index, rng) for index in INDICES]


def random_truth() -> dict[int, np.ndarray]:
    """Return camera_from_model (4, 4) by frame number."""
    rng = np.random.default_rng(1)
    return {index: se3.exp(rng.normal(size=6)) for index in INDICES}


def written(folder: Path) -> Path:
    """Return the folder with the scene in it."""
    write_bop(folder, random_frames(), random_truth(), META)
    return folder
