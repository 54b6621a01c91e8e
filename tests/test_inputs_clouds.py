"""Organised clouds: the depth image and the camera come back from the points."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from modeler.cli import main
from modeler.sequences import Overrides, open_sequence
from modeler.types import Frame, InputError
from studies.formats.clouds import WRITERS, write_pcd, write_ply
from studies.formats.image_folders import small_frames


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return small_frames(3)


@pytest.mark.parametrize("kind", WRITERS)
def test_depth_and_camera_come_back(tmp_path: Path, frames: list[Frame], kind: str) -> None:
    suffix, write = WRITERS[kind]
    folder = tmp_path / "eine Tasse"
    folder.mkdir()
    for frame in frames:
        write(folder / f"cloud_{frame.index}{suffix}", frame)
    sequence = open_sequence(folder)
    assert sequence.layout == f"organised clouds ({suffix[1:].upper()})"
    assert sequence.indices == (0, 1, 2)
    for read, wrote in zip(sequence, frames, strict=True):
        ours, theirs = read.camera, wrote.camera
        assert (ours.width, ours.height) == (theirs.width, theirs.height)
        expected = (theirs.fx, theirs.fy, theirs.cx, theirs.cy)
        assert (ours.fx, ours.fy, ours.cx, ours.cy) == pytest.approx(expected, abs=1e-2)
        np.testing.assert_allclose(read.depth_m, wrote.depth_m, rtol=1e-5)
        seen = np.isfinite(wrote.depth_m)
        assert read.colour is not None
        assert wrote.colour is not None
        np.testing.assert_array_equal(read.colour[seen], wrote.colour[seen])


def test_one_file_is_a_sequence_of_one_frame(tmp_path: Path, frames: list[Frame]) -> None:
    write_ply(tmp_path / "one.ply", frames[0])
    assert open_sequence(tmp_path / "one.ply").indices == (0,)
    assert main(["convert", str(tmp_path / "one.ply"), "--out", str(tmp_path / "bop")]) == 0
    np.testing.assert_allclose(open_sequence(tmp_path / "bop").frame(0).depth_m, frames[0].depth_m, atol=3e-5)


def test_millimetres_are_told(tmp_path: Path, frames: list[Frame], capsys: pytest.CaptureFixture[str]) -> None:
    far = Frame(0, 0.0, frames[0].depth_m * np.float32(1000.0), frames[0].camera, None, frames[0].colour)
    write_pcd(tmp_path / "s.pcd", far, "binary")
    assert main(["info", str(tmp_path / "s.pcd")]) == 2
    assert "looks like millimetres" in capsys.readouterr().err
    read = open_sequence(tmp_path / "s.pcd", Overrides(depth_scale_mm=1.0)).frame(0)
    np.testing.assert_allclose(read.depth_m, frames[0].depth_m, rtol=1e-5)


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda data: data[:-5000], "is cut off"),
        (lambda data: data[:120], "no header"),
        (lambda data: b"", "no header"),
        (lambda data: data.replace(b"WIDTH 160", b"WIDTH 19200").replace(b"HEIGHT 120", b"HEIGHT 1"), "not organised"),
        (lambda data: data.replace(b"WIDTH 160", b"WIDTH 161"), "not organised"),
        (lambda data: data.replace(b"WIDTH 160", b"WIDTH -16"), "not organised"),
        (
            lambda data: (
                data.replace(b"WIDTH 160", b"WIDTH 100000")
                .replace(b"HEIGHT 120", b"HEIGHT 100000")
                .replace(b"POINTS 19200", b"POINTS 10000000000")
            ),
            "million points",
        ),
        (lambda data: data.replace(b"FIELDS x y z", b"FIELDS z y x"), "rays of a pinhole camera"),
        (lambda data: data.replace(b"FIELDS x y z", b"FIELDS a b c"), "could be read"),
        (lambda data: data[: data.index(b"binary\n") + 7] + bytes(16 * 19200), "0 points before the camera"),
    ],
)
def test_broken_clouds_are_one_line(
    tmp_path: Path,
    frames: list[Frame],
    capfd: pytest.CaptureFixture[str],
    damage: Callable[[bytes], bytes],
    says: str,
) -> None:
    path = tmp_path / "s.pcd"
    write_pcd(path, frames[0], "binary")
    path.write_bytes(damage(path.read_bytes()))
    assert main(["info", str(path)]) == 2
    said = capfd.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert str(path) in said.err
    assert says in said.err


def test_a_mesh_is_no_sequence(tmp_path: Path) -> None:
    (tmp_path / "m.ply").write_text("ply\nformat ascii 1.0\nelement vertex 0\nelement face 0\nend_header\n")
    with pytest.raises(InputError, match="not organised"):
        open_sequence(tmp_path / "m.ply")
