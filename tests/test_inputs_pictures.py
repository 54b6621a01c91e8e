"""Which pictures belong together, in which order, and what is made of those that do not fit."""

import json
import os
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from modeler.sequences import open_sequence, survey, write_bop
from modeler.sequences.image_files import read_depth
from modeler.types import Frame, InputError
from studies.formats.clouds import WRITERS as CLOUDS
from studies.formats.image_folders import raw_depth, save, write_bundlesdf, write_open3d, write_tum
from studies.formats.ros_bags import Recorder


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3", "", ".pcd", ".ply"])
@pytest.mark.parametrize("name", ["Gefäß 三", "100% sure", "a#b?c=d&e", "%41[0]*"])
def test_files_of_any_name_are_read(tmp_path: Path, frames: list[Frame], suffix: str, name: str) -> None:
    folder = tmp_path / name
    folder.mkdir()
    if suffix in (".pcd", ".ply"):
        kind = {".pcd": "pcd binary", ".ply": "ply binary"}[suffix]
        CLOUDS[kind][1](folder / f"{name}{suffix}", frames[0])
        path = folder
    else:
        plain = Recorder().write(tmp_path / f"s{suffix or '.db3'}", frames[:1])
        path = folder / f"{name}{suffix}"
        if suffix:
            plain.rename(path)
        else:  # a folder of ROS 2 with a database of a strange name
            shutil.copytree(tmp_path / "s", path)
            plain.rename(path / f"{name}.db3")
            meta = (path / "metadata.yaml").read_text()
            (path / "metadata.yaml").write_text(meta.replace("s.db3", json.dumps(f"{name}.db3")))
    (read,) = open_sequence(path)
    np.testing.assert_allclose(read.depth_m, frames[0].depth_m, rtol=0, atol=1e-5)


def test_colour_too_far_in_time_is_no_partner(tmp_path: Path, frames: list[Frame]) -> None:
    write_tum(tmp_path / "s", frames)
    listed = (tmp_path / "s" / "rgb.txt").read_text().splitlines()
    listed[3] = listed[3].replace("1305031102.505000 ", "1305031102.530000 ")
    (tmp_path / "s" / "rgb.txt").write_text("\n".join(listed))
    sequence = open_sequence(tmp_path / "s")
    assert [frame.colour is None for frame in sequence] == [False, True, False, False]
    (note,) = sequence.notes
    assert note.startswith("1 depth images")
    assert "20 ms" in note
    (tmp_path / "s" / "rgb.txt").unlink()
    assert all(frame.colour is None for frame in open_sequence(tmp_path / "s"))


def test_pictures_of_two_clocks_pair_by_number_or_order(tmp_path: Path, frames: list[Frame]) -> None:
    folder = tmp_path / "redwood"
    write_open3d(folder, frames)
    for index in range(4):
        (folder / "depth" / f"{index:06d}.png").rename(folder / "depth" / f"{index + 1:05d}-{33369 * index:012d}.png")
        (folder / "color" / f"{index:06d}.jpg").rename(folder / "color" / f"{index + 1:05d}-{33368 * index:012d}.jpg")
    sequence = open_sequence(folder)
    assert sequence.indices == (1, 2, 3, 4)
    assert all(frame.colour is not None for frame in sequence)
    (folder / "color" / "00002-000000033368.jpg").unlink()
    assert [frame.colour is None for frame in open_sequence(folder)] == [False, True, False, False]
    for index in range(4):
        path = next((folder / "depth").glob(f"{index + 1:05d}-*"))
        path.rename(path.with_name(f"{1000.1 + index:.3f}.png"))
    with pytest.raises(InputError, match="3 images cannot be matched"):
        open_sequence(folder)
    save(folder / "color" / "00002.jpg", raw_depth(frames[0], 1.0).astype(np.uint8))
    assert all(frame.colour is not None for frame in open_sequence(folder))


def test_a_mask_of_the_first_frame_alone_is_taken(tmp_path: Path, frames: list[Frame]) -> None:
    write_bundlesdf(tmp_path / "s", frames)
    for path in sorted((tmp_path / "s" / "masks").iterdir())[1:]:
        path.unlink()
    sequence = open_sequence(tmp_path / "s")
    assert [frame.mask is None for frame in sequence] == [False, True, True, True]
    (note,) = sequence.notes
    assert note.startswith("3 of 4 ")


@pytest.mark.parametrize("write", [write_open3d, write_tum])
def test_masks_of_no_frame_are_reported(
    tmp_path: Path, frames: list[Frame], write: Callable[[Path, list[Frame]], None]
) -> None:
    write(tmp_path / "s", frames)
    stem = sorted((tmp_path / "s" / "depth").iterdir())[0].stem
    for name in (stem, "999999"):
        save(tmp_path / "s" / "mask" / f"{name}.png", np.full((120, 160), 255, np.uint8))
    sequence = open_sequence(tmp_path / "s")
    assert any("999999.png" in note for note in sequence.notes)


def test_numbers_within_names_tell_the_order(tmp_path: Path, frames: list[Frame]) -> None:
    write_open3d(tmp_path / "s", frames)
    for folder, prefix in (("depth", "depth_"), ("color", "colour-")):
        for place, path in enumerate(sorted((tmp_path / "s" / folder).iterdir())):
            path.rename(path.with_name(f"{prefix}{7 + 3 * place}_1{path.suffix}"))  # 7, 10, 13, 16
    sequence = open_sequence(tmp_path / "s")
    assert sequence.indices == (7, 10, 13, 16)
    for read, wrote in zip(sequence, frames, strict=True):
        np.testing.assert_allclose(read.depth_m, wrote.depth_m, rtol=0, atol=1e-6)
        assert np.abs(read.colour.astype(float) - wrote.colour).mean() < 3.0


def test_aligned_colour_that_is_finer_than_depth_is_shrunk(tmp_path: Path, frames: list[Frame]) -> None:
    write_open3d(tmp_path / "s", frames)
    before = [frame.colour for frame in open_sequence(tmp_path / "s")]
    for path in (tmp_path / "s" / "color").iterdir():
        with Image.open(path) as picture:
            picture.resize((480, 360), Image.Resampling.NEAREST).save(path, quality=95)
    sequence = open_sequence(tmp_path / "s")
    (note,) = sequence.notes
    assert "480 x 360" in note
    assert "160 x 120" in note
    for frame, colour in zip(sequence, before, strict=True):
        assert np.abs(frame.colour.astype(float) - colour).mean() < 3.0


@pytest.mark.parametrize(("every", "sparse"), [((1, 1), False), ((4, 1), True), ((4, 2), True)])
def test_depth_of_lines_or_single_points_is_asked_about(
    tmp_path: Path, frames: list[Frame], every: tuple[int, int], *, sparse: bool
) -> None:
    def thinned(frame: Frame) -> Frame:
        depth_m = np.full_like(frame.depth_m, np.nan)
        depth_m[:: every[0], :: every[1]] = frame.depth_m[:: every[0], :: every[1]]
        return replace(frame, depth_m=depth_m)

    write_open3d(tmp_path / "s", list(map(thinned, frames)))
    doubts = survey(open_sequence(tmp_path / "s")).doubts
    assert [doubt[:5] for doubt in doubts] == ["100% "] * sparse


def test_onboarding_scenes_are_read(tmp_path: Path, frames: list[Frame], truth: dict[int, np.ndarray]) -> None:
    """onboarding_static/obj_000001_up: grey JPEG, sparse numbers, masks of some frames, poses in the camera entries."""
    scene = tmp_path / "onboarding_static" / "obj_000001_up"
    some = [Frame(10 * f.index + 3, f.index, f.depth_m, f.camera, f.mask if f.index < 2 else None) for f in frames]
    write_bop(scene, some, {10 * index + 3: pose for index, pose in truth.items()}, depth_scale_mm=1.0)
    (scene / "sequence.json").unlink()
    for frame in frames:
        save_grey(scene / "gray" / f"{10 * frame.index + 3:06d}.jpg", frame)
    save_grey(scene / "gray" / "000099.jpg", frames[0])  # colour images outnumber depth images
    cameras = json.loads((scene / "scene_camera.json").read_text())
    for entry in cameras.values():
        entry.update(cam_R_w2c=np.eye(3).ravel().tolist(), cam_t_w2c=[0, 0, 0])
    (scene / "scene_camera.json").write_text(json.dumps(cameras))
    sequence = open_sequence(scene)
    assert sequence.indices == (3, 13, 23, 33)
    assert sequence.name == "obj_000001_up"
    assert [frame.mask is None for frame in sequence] == [False, False, True, True]
    for frame in sequence:
        assert frame.colour.shape == (120, 160, 3)
    found = survey(sequence)
    assert (found.masks, found.colours, found.truths) == (2, 4, 4)
    assert any(what.startswith("no mask in 2 frames") for what in found.missing)
    (note,) = sequence.notes
    assert note == "1 colour image has no depth image, left out"
    with pytest.raises(InputError, match="obj_000001_up"):
        open_sequence(tmp_path / "onboarding_static")


def test_onboarding_video_has_truth_for_its_first_frame_only(
    tmp_path: Path, frames: list[Frame], truth: dict[int, np.ndarray]
) -> None:
    scene = tmp_path / "onboarding_dynamic" / "obj_000001"
    write_bop(scene, frames, {0: truth[0]}, depth_scale_mm=1.0)
    poses = open_sequence(scene).truth()
    assert poses is not None
    assert tuple(poses) == (0,)


def test_colour_without_depth_is_refused(tmp_path: Path, frames: list[Frame]) -> None:
    save_grey(tmp_path / "hot3d" / "gray" / "000000.jpg", frames[0])
    (tmp_path / "hot3d" / "scene_camera.json").write_text('{"0": {"cam_K": [1, 0, 0, 0, 1, 0, 0, 0, 1]}}')
    with pytest.raises(InputError, match="holds no depth image"):
        open_sequence(tmp_path / "hot3d")
    (tmp_path / "hot3d" / "scene_camera.json").unlink()
    (tmp_path / "hot3d" / "gray").rename(tmp_path / "hot3d" / "rgb")
    with pytest.raises(InputError, match="colour but no depth"):
        open_sequence(tmp_path / "hot3d")


def test_the_folder_of_the_images_alone_is_distinguished_from_its_sequence(tmp_path: Path, frames: list[Frame]) -> None:
    write_bop(tmp_path / "scene", frames[:1], depth_scale_mm=1.0)
    with pytest.raises(InputError, match=rf"give the one it lies in, {tmp_path / 'scene'}"):
        open_sequence(tmp_path / "scene" / "depth")
    with pytest.raises(InputError, match=r"000000\.png"):
        open_sequence(tmp_path / "scene" / "depth" / "000000.png")


def test_pictures_read_by_two_threads_leave_stderr_as_it_was(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "a.tiff"
    Image.fromarray(np.arange(90_000, dtype=np.uint16).reshape(300, 300)).save(picture, compression="tiff_lzw")
    with ThreadPoolExecutor(4) as threads:
        list(threads.map(read_depth, [picture] * 200))
    os.write(2, b"here")
    assert capfd.readouterr().err == "here"


def test_tiff_pictures_are_read(tmp_path: Path, frames: list[Frame]) -> None:
    write_bop(tmp_path / "itodd", frames, depth_scale_mm=1.0)
    for frame in frames:
        (tmp_path / "itodd" / "depth" / f"{frame.index:06d}.png").unlink()
        save(tmp_path / "itodd" / "depth" / f"{frame.index:06d}.tif", raw_depth(frame, 1.0))
    for read, wrote in zip(open_sequence(tmp_path / "itodd"), frames, strict=True):
        np.testing.assert_allclose(read.depth_m, wrote.depth_m, atol=1e-6)


def save_grey(path: Path, frame: Frame) -> None:
    save(path, frame.colour.mean(axis=2).astype(np.uint8))
