"""Organised clouds: the depth image and the camera come back from the points."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from recordings import small_frames

from modeler.cli import main
from modeler.sequences import Overrides, open_sequence
from modeler.types import Frame, InputError


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return small_frames(3)


def points_of(frame: Frame) -> np.ndarray:
    w, h = frame.camera.rays()
    return (np.stack([w, h, np.ones_like(w)], axis=2) * frame.depth_m[..., None]).astype("<f4")


def table(frame: Frame, names: str, kinds: list[str]) -> np.ndarray:
    points, colour = points_of(frame).reshape(-1, 3), frame.colour
    assert colour is not None
    rows = np.zeros(len(points), dtype=list(zip(names.split(), kinds, strict=True)))
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis]
    flat = colour.reshape(-1, 3).astype(np.uint32)
    if "rgb" in names.split():  # as the Point Cloud Library packs it
        rows["rgb"] = (flat[:, 0] << 16) | (flat[:, 1] << 8) | flat[:, 2]
    else:
        for axis, name in enumerate(("red", "green", "blue")):
            rows[name] = flat[:, axis]
    return rows


def write_pcd(path: Path, frame: Frame, data: str) -> None:
    rows = table(frame, "x y z rgb", ["<f4", "<f4", "<f4", "<u4"])
    height, width = frame.depth_m.shape
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\n"
        f"COUNT 1 1 1 1\nWIDTH {width}\nHEIGHT {height}\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {width * height}\nDATA {data}\n"
    )
    if data == "ascii":
        lines = (f"{r['x']!s} {r['y']!s} {r['z']!s} {np.uint32(r['rgb']).view(np.float32)!s}\n" for r in rows)
        body = "".join(lines).encode()
    elif data == "binary":
        body = rows.tobytes()
    else:  # the library's LZF, all of it literal
        columns = b"".join(rows[name].tobytes() for name in ("x", "y", "z", "rgb"))
        packed = b"".join(
            bytes([len(columns[at : at + 32]) - 1]) + columns[at : at + 32] for at in range(0, len(columns), 32)
        )
        body = np.array([len(packed), len(columns)], "<u4").tobytes() + packed
    path.write_bytes(header.encode() + body)


def write_ply(path: Path, frame: Frame, data: str = "binary_little_endian", size: str = "obj_info num_") -> None:
    rows = table(frame, "x y z red green blue", ["<f4"] * 3 + ["u1"] * 3)
    height, width = frame.depth_m.shape
    header = [
        "ply",
        f"format {data} 1.0",
        f"{size}cols {width}",
        f"{size}rows {height}",
        f"element vertex {width * height}",
        *(f"property float {name}" for name in "xyz"),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        "end_header\n",
    ]
    body = rows.tobytes() if data != "ascii" else "".join(" ".join(map(str, row)) + "\n" for row in rows).encode()
    path.write_bytes("\n".join(header).encode() + body)


WRITERS: dict[str, tuple[str, Callable[[Path, Frame], None]]] = {
    "pcd ascii": (".pcd", lambda path, frame: write_pcd(path, frame, "ascii")),
    "pcd binary": (".pcd", lambda path, frame: write_pcd(path, frame, "binary")),
    "pcd compressed": (".pcd", lambda path, frame: write_pcd(path, frame, "binary_compressed")),
    "ply binary": (".ply", write_ply),
    "ply ascii": (".ply", lambda path, frame: write_ply(path, frame, "ascii", "comment ")),
}


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
