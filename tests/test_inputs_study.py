"""The study of inputs writes what it says: what is right is read whole."""

from pathlib import Path

import numpy as np
import pytest

from modeler.sequences import open_sequence, survey
from studies.formats.image_folders import small_frames
from studies.inputs.ways import WAYS, put


@pytest.mark.parametrize("way", WAYS)
def test_what_is_right_is_read_whole(tmp_path: Path, rng: np.random.Generator, way: str) -> None:
    frames = small_frames(4)
    given = put(way, tmp_path / "in", frames, rng)
    command = given.commands[0] if given.commands else given.last
    sequence = open_sequence(command[1].replace("{in}", str(tmp_path / "in"))) if "byte" not in given.said else None
    if given.cause or sequence is None:
        return
    found = survey(sequence)
    assert len(found.indices) == len(given.shown or frames) // len(given.commands or (1,))
    assert found.range_m[1] == pytest.approx(float(np.nanmedian(frames[0].depth_m)), rel=0.5)
