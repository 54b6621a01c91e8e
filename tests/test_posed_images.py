"""Data sets for radiance fields and splats: the object at rest, cameras around it, as other programs read them."""

import importlib.util
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from command_runner import Run
from PIL import Image
from scipy.ndimage import binary_dilation

from modeler.cli import main
from modeler.export.datasets import PosedImages, with_unmeasured, write_nerfstudio
from modeler.sequences import open_sequence
from modeler.types import Camera, Frame

# pycolmap brings libraries that disturb others in its process.
COLMAP = """
import json, sys, pycolmap
found = pycolmap.Reconstruction(sys.argv[1])
json.dump({
    "error": found.compute_mean_reprojection_error(),
    "cameras": {k: [c.model.name, c.width, c.height, *c.params] for k, c in found.cameras.items()},
    "images": {i.name: [i.camera_id, i.cam_from_world().matrix().tolist()] for i in found.images.values()},
    "seen": {i.name: [[*map(float, p.xy), p.point3D_id] for p in i.points2D] for i in found.images.values()},
    "points": {k: [*map(float, p.xyz), *map(int, p.color)] for k, p in found.points3D.items()},
}, sys.stdout)
"""


@pytest.fixture(scope="module")
def exported(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `nerfstudio` and `colmap` of a run."""
    folder = tmp_path_factory.mktemp("posed")
    for purpose in ("nerfstudio", "colmap"):
        assert main(["export", str(built), "--for", purpose, "--out", str(folder / purpose)]) == 0
    return folder


def points_of(path: Path) -> tuple[np.ndarray, np.ndarray]:
    cloud: Any = trimesh.load(path)
    return np.asarray(cloud.vertices), np.asarray(cloud.colors)[:, :3]


def test_initial_points_of_nerfstudio_lie_where_its_images_show_them(exported: Path) -> None:
    folder = exported / "nerfstudio"
    content = json.loads((folder / "transforms.json").read_text())
    points, colours = points_of(folder / content["ply_file_path"])
    assert -1e-3 < points[:, 2].min() < 5e-3  # it stands on z = 0, centred
    np.testing.assert_allclose(points[:, :2].max(axis=0) + points[:, :2].min(axis=0), 0.0, atol=2e-3)
    centres = []
    for entry in content["frames"]:
        rgba, mask, depth_mm = (
            np.asarray(Image.open(folder / entry[name])).astype(np.float64)
            for name in ("file_path", "mask_path", "depth_file_path")
        )
        assert rgba.shape == (content["h"], content["w"], 4)
        np.testing.assert_array_equal(rgba[..., 3], mask)
        assert not rgba[mask == 0].any()
        assert not depth_mm[mask == 0].any()
        world_from_camera = np.array(entry["transform_matrix"])
        centres.append(world_from_camera[:3, 3])
        x, y, z = ((points - centres[-1]) @ world_from_camera[:3, :3]).T  # OpenGL: it looks along -z, y is up
        assert (z < 0.0).all()
        column = np.floor(content["cx"] + content["fl_x"] * x / -z).astype(int)
        row = np.floor(content["cy"] - content["fl_y"] * y / -z).astype(int)
        assert binary_dilation(mask > 0)[row, column].mean() > 0.99  # the rim falls to either side
        seen = np.abs(depth_mm[row, column] / 1000.0 + z) < 3e-3
        assert seen.mean() > 0.2
        assert np.median(np.abs(rgba[row, column, :3] - colours)[seen]) < 12.0
    assert all(centre[2] > 0.05 for centre in centres)  # the cameras look down at it
    assert centres[0][1] < -0.2  # the first one from -y
    assert np.ptp(centres, axis=0).max() > 0.05  # they stand around it


def test_nerfstudio_folders_are_sequences_again(exported: Path, built: Path, scene: Path) -> None:
    again, before = open_sequence(exported / "nerfstudio"), open_sequence(scene)
    for index in again.indices:
        new, old = again.frame(index), before.frame(index)
        assert new.camera == old.camera  # pixel centres lie at halves there, at whole numbers here
        np.testing.assert_allclose(new.depth_m[new.mask], old.depth_m[new.mask], atol=6e-4)


@pytest.mark.parametrize("form", ["bin", "txt"])
def test_pycolmap_reads_the_cameras_of_nerfstudio(exported: Path, tmp_path: Path, form: str) -> None:
    if importlib.util.find_spec("pycolmap") is None:
        pytest.skip("pycolmap is not installed")
    for path in (exported / "colmap" / "sparse" / "0").glob(f"*.{form}"):
        shutil.copy(path, tmp_path)
    command = [sys.executable, "-c", COLMAP, str(tmp_path)]
    found = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    content = json.loads((exported / "nerfstudio" / "transforms.json").read_text())
    names = ("w", "h", "fl_x", "fl_y", "cx", "cy")
    assert found["cameras"] == {"1": ["PINHOLE", *(content[name] for name in names)]}
    assert found["error"] < 1e-6  # px
    assert len(found["images"]) == len(content["frames"])
    points, colours = points_of(exported / "nerfstudio" / content["ply_file_path"])
    for number, (x, y, z, *rgb) in found["points"].items():
        np.testing.assert_allclose((x, y, z), points[int(number) - 1], atol=1e-6)
        np.testing.assert_array_equal(rgb, colours[int(number) - 1])
    for entry in content["frames"]:
        name = Path(entry["file_path"]).name
        _, camera_from_world = found["images"][name]
        world_from_opencv = np.array(entry["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
        np.testing.assert_allclose(
            [*camera_from_world, [0.0, 0.0, 0.0, 1.0]], np.linalg.inv(world_from_opencv), atol=1e-9
        )
        mask = np.asarray(Image.open(exported / "colmap" / "masks" / f"{name}.png"))
        image = np.asarray(Image.open(exported / "colmap" / "images" / name))
        np.testing.assert_array_equal(image[..., 3], mask)
        assert len(found["seen"][name]) > 0.2 * len(points)
        assert all(mask[int(y), int(x)] for x, y, _ in found["seen"][name])


def test_where_no_depth_was_measured_the_model_says_what_the_object_is() -> None:
    depth_m = np.ones((3, 4), np.float32)
    depth_m[0, 1:] = np.nan
    mask, hand, silhouette = (np.zeros((3, 4), bool) for _ in range(3))
    mask[1], hand[0, 3], silhouette[:, 1:] = True, True, True
    frame = Frame(0, 0.0, depth_m, Camera(4, 3, 9.0, 9.0, 1.5, 1.0), mask, None, hand)
    expected = mask.copy()
    expected[0, 1:3] = True  # where depth is, the mask decides; at the hand, nothing is the object
    filled = with_unmeasured(frame, silhouette).mask
    np.testing.assert_array_equal(filled, expected)


def test_frames_of_two_cameras_have_their_own(tmp_path: Path) -> None:
    def frame(index: int, fx: float) -> Frame:
        camera = Camera(4, 3, fx, fx, 1.5, 1.0)
        return Frame(index, 0.0, np.ones((3, 4), np.float32), camera, None, np.zeros((3, 4, 3), np.uint8))

    frames = {0: frame(0, 10.0), 1: frame(1, 12.0)}
    one = np.zeros((1, 3))
    data = PosedImages(frames, {k: np.eye(4) for k in frames}, one, one, one.astype(np.uint8))
    write_nerfstudio(data, tmp_path)
    content = json.loads((tmp_path / "transforms.json").read_text())
    assert [entry["fl_x"] for entry in content["frames"]] == [10.0, 12.0]
    assert "fl_x" not in content


def test_without_colour_there_is_nothing_to_learn_from(cli: Run, scene: Path, built: Path, tmp_path: Path) -> None:
    grey = tmp_path / "grey"
    shutil.copytree(scene, grey)
    shutil.rmtree(grey / "rgb")
    ended = cli("export", built, "--for", "nerfstudio", "--out", tmp_path / "out", "--sequence", grey)
    assert ended.status == 2
    assert "no colour" in ended.err.splitlines()[-1]
