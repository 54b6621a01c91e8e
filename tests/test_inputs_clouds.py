"""Organised clouds: the depth image and the camera come back from the points."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from modeler.cli import main
from modeler.sequences import Overrides, open_sequence
from modeler.types import Frame, InputError
from studies.formats.clouds import WRITERS, write_pcd, write_ply
from studies.formats.image_folders import raw_depth, save


@pytest.mark.parametrize("kind", WRITERS)
def test_depth_and_camera_come_back(tmp_path: Path, frames: list[Frame], kind: str) -> None:
    suffix, write = WRITERS[kind]
    folder = tmp_path / "eine Tasse"
    folder.mkdir()
    for frame in frames:
        write(folder / f"cloud_{frame.index}{suffix}", frame)
    sequence = open_sequence(folder)
    assert sequence.layout == f"organised clouds ({suffix[1:].upper()})"
    assert sequence.indices == (0, 1, 2, 3)
    for read, wrote in zip(sequence, frames, strict=True):
        ours, theirs = read.camera, wrote.camera
        assert (ours.width, ours.height) == (theirs.width, theirs.height)
        expected = (theirs.fx, theirs.fy, theirs.cx, theirs.cy)
        assert (ours.fx, ours.fy, ours.cx, ours.cy) == pytest.approx(expected, abs=1e-2)
        np.testing.assert_allclose(read.depth_m, wrote.depth_m, rtol=1e-5)
        seen = np.isfinite(wrote.depth_m)
        np.testing.assert_array_equal(read.colour[seen], wrote.colour[seen])


def test_one_file_is_a_sequence_of_one_frame(tmp_path: Path, frames: list[Frame]) -> None:
    write_ply(tmp_path / "one.ply", frames[0])
    assert open_sequence(tmp_path / "one.ply").indices == (0,)
    assert main(["convert", str(tmp_path / "one.ply"), "--out", str(tmp_path / "bop")]) == 0
    np.testing.assert_allclose(open_sequence(tmp_path / "bop").frame(0).depth_m, frames[0].depth_m, atol=3e-5)


def test_millimetres_are_recognised(tmp_path: Path, frames: list[Frame]) -> None:
    far = Frame(0, 0.0, frames[0].depth_m * np.float32(1000.0), frames[0].camera, None, frames[0].colour)
    write_pcd(tmp_path / "s.pcd", far, "binary")
    sequence = open_sequence(tmp_path / "s.pcd")
    assert sequence.depth_unit == "1 mm (by the size of the coordinates)"
    np.testing.assert_allclose(sequence.frame(0).depth_m, frames[0].depth_m, rtol=1e-5)
    given = open_sequence(tmp_path / "s.pcd", Overrides(depth_scale_mm=2.0)).frame(0)
    np.testing.assert_allclose(given.depth_m, 2.0 * frames[0].depth_m, rtol=1e-5)


def write_points(path: Path, points: np.ndarray, decimals: int = 6) -> None:
    head = "ply\nformat ascii 1.0\ncomment VCGLIB generated\n" + f"element vertex {len(points)}\n"
    head += "property float x\nproperty float y\nproperty float z\nend_header\n"
    path.write_text(head + "".join(" ".join(f"{value:.{decimals}f}" for value in point) + "\n" for point in points))


OFF_CENTRE = (143.75, 151.5, 66.25, 71.125)


def seen_points(frame: Frame, rng: np.random.Generator) -> np.ndarray:
    """Return the points of a frame's object, in no order, by a camera with its principal point off the middle."""
    fx, fy, cx, cy = OFF_CENTRE
    rows, columns = np.nonzero(frame.mask & (frame.depth_m > 0.0))
    z = frame.depth_m[rows, columns].astype(np.float64)
    return rng.permutation(np.stack([(columns - cx) / fx * z, (rows - cy) / fy * z, z], axis=1))


AXES: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "camera": ("", lambda points: points),
    "viewer": ("y points up and z backward", lambda points: points * (1.0, -1.0, -1.0)),
    "body": ("x points forward and z up", lambda points: points[..., [2, 0, 1]] * (1.0, -1.0, -1.0)),
}


@pytest.mark.parametrize("axes", AXES)
@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_the_camera_of_points_on_its_pixels_is_recovered(
    tmp_path: Path, frames: list[Frame], rng: np.random.Generator, *, axes: str, unit: float
) -> None:
    said, turned = AXES[axes]
    clouds = [seen_points(frame, rng) for frame in frames]
    for index, points in enumerate(clouds):
        write_points(tmp_path / f"view-{index + 1}.ply", turned(points) * unit, 6 if unit == 1.0 else 4)
    sequence = open_sequence(tmp_path)
    assert sequence.indices == (1, 2, 3, 4)
    assert sequence.layout == "clouds (PLY)"
    notes = " ".join(sequence.notes)
    assert [each for each, _ in AXES.values() if each and each in notes] == [said] * bool(said)
    for read, points in zip(sequence, clouds, strict=True):
        camera = read.camera
        assert (camera.fx, camera.fy) == pytest.approx(OFF_CENTRE[:2], abs=0.01)
        assert camera.cx % 1.0 == pytest.approx(0.25, abs=0.02)
        assert camera.cy % 1.0 == pytest.approx(0.125, abs=0.02)
        rows, columns = np.nonzero(np.isfinite(read.depth_m))
        z = read.depth_m[rows, columns].astype(np.float64)
        back = np.stack([(columns - camera.cx) / camera.fx * z, (rows - camera.cy) / camera.fy * z, z], axis=1)
        order, expected = np.lexsort(np.round(back, 4).T), np.lexsort(np.round(points, 4).T)
        assert len(back) == len(points)
        np.testing.assert_allclose(back[order], points[expected], atol=2e-4)


def test_points_off_a_grid_need_intrinsics(tmp_path: Path, frames: list[Frame], rng: np.random.Generator) -> None:
    points = seen_points(frames[0], rng)
    points[:, :2] += rng.uniform(-3e-3, 3e-3, (len(points), 2))
    write_points(tmp_path / "0.ply", points)
    with pytest.raises(InputError, match=r"nor do its points lie on the rays of a grid.*`intrinsics`"):
        open_sequence(tmp_path)
    given = Overrides(intrinsics=OFF_CENTRE)
    read = open_sequence(tmp_path, given).frame(0)
    assert (read.camera.cx, read.camera.cy) == OFF_CENTRE[2:]
    assert np.nanmedian(read.depth_m) == pytest.approx(np.median(points[:, 2]), abs=2e-3)
    (tmp_path / "camera.json").write_text('{"fx": 143.75, "fy": 151.5, "cx": 66.25, "cy": 71.125}')
    assert open_sequence(tmp_path).frame(0).camera.fx == 143.75


def test_points_beside_the_camera_are_passed_over(
    tmp_path: Path, frames: list[Frame], rng: np.random.Generator
) -> None:
    points = seen_points(frames[0], rng)
    write_points(tmp_path / "0.ply", np.concatenate([points, [[1e8, 1e8, 1e-5]]]))
    assert np.count_nonzero(np.isfinite(open_sequence(tmp_path).frame(0).depth_m)) == len(points)


def test_images_beside_clouds_are_used(tmp_path: Path, frames: list[Frame], rng: np.random.Generator) -> None:
    write_points(tmp_path / "0.ply", seen_points(frames[0], rng))
    save(tmp_path / "0_depth.png", raw_depth(frames[0], 1.0))
    (tmp_path / "camera.json").write_text('{"fx": 143.75, "fy": 143.75, "cx": 79.875, "cy": 59.875}')
    np.testing.assert_allclose(open_sequence(tmp_path).frame(0).depth_m, frames[0].depth_m, atol=1e-6)


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda data: data[:-5000], "is cut off"),
        (lambda data: data[:120], "no header"),
        (lambda data: b"", "no header"),
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
    tmp_path: Path, frames: list[Frame], refusal: Callable[..., str], damage: Callable[[bytes], bytes], says: str
) -> None:
    path = tmp_path / "s.pcd"
    write_pcd(path, frames[0], "binary")
    path.write_bytes(damage(path.read_bytes()))
    said = refusal("info", path)
    assert str(path) in said
    assert says in said


def test_a_mesh_is_no_sequence(tmp_path: Path) -> None:
    (tmp_path / "m.ply").write_text("ply\nformat ascii 1.0\nelement vertex 0\nelement face 0\nend_header\n")
    with pytest.raises(InputError, match="not organised"):
        open_sequence(tmp_path / "m.ply")


def test_image_coordinates_of_points_tell_the_camera(
    tmp_path: Path, frames: list[Frame], rng: np.random.Generator
) -> None:
    """As PCDs of Washington's data set have them; points are rounded, which lie on no grid then."""
    for frame in frames:
        rows, columns = np.nonzero(np.isfinite(frame.depth_m))
        w, h = (each[rows, columns] for each in frame.camera.rays())
        z = frame.depth_m[rows, columns].astype(float)
        lines = [
            f"{a + e:.3f} {b + f:.3f} {c:.3f} 0 {u} {v}"
            for a, b, c, e, f, u, v in zip(
                w * z, h * z, z, *rng.normal(0.0, 1e-3, (2, len(z))), columns, rows, strict=True
            )
        ]
        header = (
            f"VERSION .7\nFIELDS x y z rgb imX imY\nSIZE 4 4 4 4 4 4\nTYPE F F F F F F\nCOUNT 1 1 1 1 1 1\n"
            f"WIDTH {len(z)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(z)}\nDATA ascii\n"
        )
        (tmp_path / f"cup_1_1_{frame.index}.pcd").write_text(header + "\n".join(lines) + "\n")
    sequence = open_sequence(tmp_path)
    assert any("imX, imY" in note for note in sequence.notes)
    read, wrote = sequence.frame(0), frames[0]
    ours, theirs = read.camera, wrote.camera
    expected = (theirs.fx, theirs.fy, theirs.cx, theirs.cy)
    assert (ours.fx, ours.fy, ours.cx, ours.cy) == pytest.approx(expected, abs=1.0)
