"""Damaged inputs of every format: read, or refused in one line. `python -m studies fuzz` tries many more."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from modeler.sequences import open_sequence, read_noise, survey, write_bop
from modeler.types import InputError
from studies.fuzz.mutate import mutated, with_sums
from studies.fuzz.targets import TARGETS, fresh, tiny, truth

INPUTS = 20

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=10) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)
KEYS = st.sampled_from(["0", "1", "cam_K", "depth_scale", "cam_R_m2c", "sensor", "timestamps_s", "name", "noise"])
ENTRIES = st.dictionaries(KEYS, JSON | st.dictionaries(KEYS, JSON, max_size=3), max_size=4)


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow) if target.share <= 0.1 else name for name, target in TARGETS.items()],
)
def test_damage_is_reported_in_one_line_or_does_not_matter(tmp_path: Path, name: str) -> None:
    target, rng = TARGETS[name], np.random.default_rng([7, *name.encode()])
    path, files = fresh(target, tmp_path / "in")
    intact = {file: file.read_bytes() for file in files}
    target.read(path)
    stated: list[str] = []
    count = max(2, round(INPUTS * min(1.0, target.share)))
    for _ in range(count):
        file = files[int(rng.integers(len(files)))]
        file.write_bytes(mutated(intact[file], list(intact.values()), rng))
        try:
            target.read(path)
        except InputError as error:
            stated.append(str(error))
        file.write_bytes(intact[file])
    assert stated or count < INPUTS // 2
    assert "\n" not in "".join(stated)
    target.read(path)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("json") / "s"
    write_bop(folder, tiny(), truth())
    return folder


@given(which=st.sampled_from(["scene_camera.json", "scene_gt.json", "sequence.json"]), tree=ENTRIES | JSON)
@settings(max_examples=30)
def test_any_json_is_read_or_refused(scene: Path, which: str, tree: object) -> None:
    path = scene / which
    intact, stated = path.read_bytes(), ""
    try:
        path.write_text(json.dumps(tree))
        survey(open_sequence(scene))
    except InputError as error:
        stated = str(error)
    finally:
        path.write_bytes(intact)
    assert "\n" not in stated


@given(tree=ENTRIES | JSON)
@settings(max_examples=50)
def test_any_noise_file_is_read_or_refused(tmp_path_factory: pytest.TempPathFactory, tree: object) -> None:
    path = tmp_path_factory.getbasetemp() / "noise.json"
    path.write_text(json.dumps(tree))
    with pytest.raises(InputError):  # nothing but the right numbers in the right places is a model
        read_noise(path)


def test_sums_are_put_right(tmp_path: Path) -> None:
    _, files = fresh(TARGETS["png"], tmp_path / "in")
    content = files[0].read_bytes()
    assert with_sums(content) == content
    broken = bytearray(content)
    broken[29] ^= 0xFF  # within the sum of the header
    assert with_sums(bytes(broken)) == content
