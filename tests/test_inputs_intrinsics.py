"""Intrinsics and the unit of depth are read in each spelling, and asked about where they may be meant otherwise."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from modeler.sequences import Overrides, open_sequence, survey, write_bop
from modeler.types import Frame, InputError
from studies.formats.image_folders import save, write_open3d, write_tum


def test_what_a_person_says_counts_more(folder: Path) -> None:
    sequence = open_sequence(folder, Overrides(intrinsics=(100.0, 101.0, 80.0, 60.0), depth_scale_mm=0.4))
    plain = open_sequence(folder)
    unit = 0.2 if folder.name == "TUM RGB-D" else 1.0
    for first, second in zip(plain, sequence, strict=True):
        np.testing.assert_allclose(second.depth_m, first.depth_m * np.float32(0.4 / unit), rtol=1e-6)
        assert (second.camera.fx, second.camera.fy, second.camera.cx, second.camera.cy) == (100.0, 101.0, 80.0, 60.0)
    assert sequence.depth_unit == "0.4 mm (`depth_scale_mm`)"


def test_the_benchmarks_own_size_needs_no_intrinsics(tmp_path: Path, frames: list[Frame]) -> None:
    write_tum(tmp_path / "s", frames)
    (tmp_path / "s" / "calibration.txt").unlink()
    with pytest.raises(InputError, match=r"intrinsics .*160 x 120"):
        open_sequence(tmp_path / "s")
    for path in (tmp_path / "s").glob("*/*.png"):
        with Image.open(path) as picture:
            large = np.asarray(picture).repeat(4, axis=0).repeat(4, axis=1)
        save(path, large)
    sequence = open_sequence(tmp_path / "s")
    assert sequence.frame(0).camera.fx == 525.0
    assert "assumed" in sequence.notes[0]


PINHOLE = {"fx": 143.75, "fy": 143.75, "ppx": 79.875, "ppy": 59.875}
SPELLINGS = [
    ("json", {"width": 160, "height": 120, "intrinsic_matrix": [143.75, 0, 0, 0, 143.75, 0, 79.875, 59.875, 1]}),
    ("json", {"intrinsic_matrix": [143.75, 0, 79.875, 0, 143.75, 59.875, 0, 0, 1]}),
    ("json", {"camera_matrix": [[143.75, 0, 79.875], [0, 143.75, 59.875], [0, 0, 1]]}),
    ("json", PINHOLE),
    ("json", {"intrinsic": {"fx": 143.75, "fy": 143.75, "cx": 79.875, "cy": 59.875}}),
    ("json", {"intrinsics": PINHOLE | {"model": "none"}}),
    ("txt", "143.75 143.75 79.875 59.875 0 0 0 0 0"),
    ("txt", "# fx, fy, cx, cy\n143.75, 143.75, 79.875, 59.875\n"),
    ("txt", "143.75 0 79.875\n0 143.75 59.875\n0 0 1\n"),
    ("txt", "[[143.75   0.     79.875]\n [  0.   143.75   59.875]\n [  0.     0.      1.   ]]\n"),
]


@pytest.mark.parametrize(("kind", "content"), SPELLINGS)
def test_intrinsics_are_read_in_each_spelling(
    tmp_path: Path, frames: list[Frame], kind: str, content: dict | str
) -> None:
    write_open3d(tmp_path / "s", frames)
    (tmp_path / "s" / "camera_intrinsic.json").unlink()
    name = {"json": "camera_intrinsic.json", "txt": "cam_K.txt"}[kind]
    (tmp_path / "s" / name).write_text(content if isinstance(content, str) else json.dumps(content))
    camera = open_sequence(tmp_path / "s").frame(0).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (143.75, 143.75, 79.875, 59.875)


@pytest.mark.parametrize(("scale", "unit"), [(0.1, "0.1 mm"), (0.0001, "0.1 mm"), (5000, "0.2 mm"), (1, "1 mm")])
def test_the_unit_of_depth_that_stands_beside_the_intrinsics_counts(
    tmp_path: Path, frames: list[Frame], scale: float, unit: str
) -> None:
    """BOP's mm a unit, RealSense's m a unit, Open3D's units a m."""
    write_open3d(tmp_path / "s", frames)
    (tmp_path / "s" / "camera_intrinsic.json").unlink()
    stated = {"fx": 143.75, "fy": 143.75, "cx": 79.875, "cy": 59.875, "depth_scale": scale}
    (tmp_path / "s" / "camera.json").write_text(json.dumps(stated))
    sequence = open_sequence(tmp_path / "s")
    assert sequence.layout == "folder of pictures"
    assert sequence.depth_unit == f"{unit} (camera.json)"
    given = open_sequence(tmp_path / "s", Overrides(depth_scale_mm=3.0))
    ratio = np.nanmedian(given.frame(0).depth_m / sequence.frame(0).depth_m)
    assert ratio == pytest.approx(3.0 / float(unit.split()[0]), rel=1e-5)
    (tmp_path / "s" / "camera.json").write_text(json.dumps({**stated, "depth_scale": 30}))
    with pytest.raises(InputError, match=r"camera\.json: .*depth_scale.* 30\b"):
        open_sequence(tmp_path / "s")


def test_intrinsics_of_images_of_another_size_are_asked_about(tmp_path: Path, frames: list[Frame]) -> None:
    write_open3d(tmp_path / "s", frames)
    assert not open_sequence(tmp_path / "s").notes
    path = tmp_path / "s" / "camera_intrinsic.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "width": 640, "height": 480}))
    (note,) = open_sequence(tmp_path / "s").notes
    assert [words for words in ("camera_intrinsic.json", "640 x 480", "160 x 120") if words not in note] == []


def test_what_may_be_meant_otherwise_is_asked(tmp_path: Path, frames: list[Frame]) -> None:
    write_bop(tmp_path / "right", frames, depth_scale_mm=1.0)
    assert survey(open_sequence(tmp_path / "right")).doubts == ()
    doubled = [frames[0], replace(frames[0], index=1), frames[2], replace(frames[2], index=3)]
    write_open3d(tmp_path / "twice", doubled)
    (doubt,) = survey(open_sequence(tmp_path / "twice")).doubts
    assert doubt.startswith("2 of 4 frames")
    assert "(1, 3)" in doubt
    write_bop(tmp_path / "unit", [replace(one, depth_m=10.0 * one.depth_m) for one in frames], depth_scale_mm=1.0)
    (doubt,) = survey(open_sequence(tmp_path / "unit")).doubts
    assert "unit" in doubt
    cameras = [replace(one.camera, cx=one.camera.cy, cy=one.camera.cx) for one in frames]
    swapped = [replace(one, camera=camera) for one, camera in zip(frames, cameras, strict=True)]
    write_bop(tmp_path / "swapped", swapped, depth_scale_mm=1.0)
    (doubt,) = survey(open_sequence(tmp_path / "swapped")).doubts
    assert "are cx and cy exchanged?" in doubt
