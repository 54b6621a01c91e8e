"""Shared fixtures."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from recordings import small_frames, small_truth

from sequences import bundled, write_bop


@pytest.fixture
def rng():
    """Return a generator with a fixed seed."""
    return np.random.default_rng(0)


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of three small frames of the bundled box, their true poses and the true mesh: to be read only."""
    folder = tmp_path_factory.mktemp("scene") / "box"
    write_bop(folder, small_frames(3), small_truth(3), depth_scale_mm=1.0)
    shutil.copy(bundled("box") / "model.ply", folder)
    return folder
