"""Folders as other programs write them: what was written is what is read, and what `info` and `convert` make of it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bags import Recorder
from PIL import Image
from recordings import raw_depth, save, small_frames, small_truth, write_bundlesdf, write_open3d, write_tum
from test_inputs_clouds import WRITERS as CLOUDS

from modeler import se3
from modeler.cli import main
from modeler.types import Frame, InputError
from sequences import AbstractSequence, Given, bundled, open_sequence, survey, write_bop

Writer = Callable[[Path, list[Frame], dict[int, np.ndarray] | None], None]
WRITERS: dict[str, Writer] = {"TUM RGB-D": write_tum, "Open3D": write_open3d, "BundleSDF": write_bundlesdf}


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return small_frames()


@pytest.fixture(scope="module")
def truth() -> dict[int, np.ndarray]:
    return small_truth()


@pytest.fixture(params=WRITERS)
def folder(request: pytest.FixtureRequest, tmp_path: Path, frames: list[Frame], truth: dict[int, np.ndarray]) -> Path:
    path = tmp_path / request.param
    WRITERS[request.param](path, frames, truth)
    return path


def assert_same(sequence: AbstractSequence, frames: list[Frame], *, colour_off: float = 0.0) -> None:
    assert len(sequence) == len(frames)
    for read, wrote in zip(sequence, frames, strict=True):
        np.testing.assert_allclose(read.depth_m, wrote.depth_m, rtol=0, atol=1e-6)
        camera, ours = read.camera, wrote.camera
        assert (camera.width, camera.height) == (ours.width, ours.height)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((ours.fx, ours.fy, ours.cx, ours.cy))
        assert read.colour is not None
        assert wrote.colour is not None
        assert np.abs(read.colour.astype(float) - wrote.colour).mean() <= colour_off


def test_what_was_written_is_read(folder: Path, frames: list[Frame], truth: dict[int, np.ndarray]) -> None:
    sequence = open_sequence(folder)
    assert sequence.layout == f"{folder.name} folder"
    assert_same(sequence, frames, colour_off=3.0 if folder.name == "Open3D" else 0.0)
    times_s = np.array([frame.time_s for frame in sequence])
    wrote_s = np.array([frame.time_s for frame in frames])
    if folder.name != "Open3D":  # which has no times
        np.testing.assert_allclose(np.diff(times_s), np.diff(wrote_s), atol=1e-6)
    poses = sequence.truth()
    assert poses is not None
    assert tuple(poses) == sequence.indices
    for index, pose in poses.items():
        np.testing.assert_allclose(pose, truth[index], atol=1e-6)
    for read, wrote in zip(sequence, frames, strict=True):
        assert (read.mask is not None) == (folder.name == "BundleSDF")
        if read.mask is not None:
            np.testing.assert_array_equal(read.mask, wrote.mask)  # type: ignore[arg-type]


def test_converting_keeps_every_number(folder: Path, tmp_path: Path) -> None:
    assert main(["convert", str(folder), "--out", str(tmp_path / "bop")]) == 0
    before, after = open_sequence(folder), open_sequence(tmp_path / "bop")
    assert after.layout == "BOP scene folder"
    assert (after.indices, after.name) == (before.indices, before.name)
    for first, second in zip(before, after, strict=True):
        np.testing.assert_allclose(second.depth_m, first.depth_m, rtol=0, atol=1e-6)
        assert second.time_s == first.time_s
        assert second.camera == first.camera
        for one, other in ((first.colour, second.colour), (first.mask, second.mask)):
            assert (one is None) == (other is None)
            if one is not None and other is not None:
                np.testing.assert_array_equal(one, other)
    one, other = before.truth(), after.truth()
    assert one is not None
    assert other is not None
    for index in before.indices:
        np.testing.assert_allclose(one[index], other[index], atol=1e-9)


def test_info_tells_what_is_there_and_what_is_missing(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(folder), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["format"] == f"{folder.name} folder"
    assert said["frames"] == [0, 1, 2, 3]
    assert said["resolution"] == [160, 120]
    assert said["intrinsics"][0] == pytest.approx([143.75, 143.75, 79.875, 59.875])
    assert said["depth_unit"].startswith("0.2 mm" if folder.name == "TUM RGB-D" else "1 mm")
    assert 0.5 < said["depth_m"]["1%"] < said["depth_m"]["50%"] < said["depth_m"]["99%"] < 1.3
    masked = folder.name == "BundleSDF"
    assert (said["masks"], said["colour"], said["ground_truth"]) == (4 if masked else 0, 4, 4)
    assert [what for what in said["missing"] if "mask" in what] == (
        [] if masked else ["no masks: the object is segmented by the program"]
    )
    assert main(["info", str(folder)]) == 0
    lines = capsys.readouterr().out
    for what in ("format", "frames", "resolution", "intrinsics", "depth unit", "depth range", "masks", "ground truth"):
        assert f"\n{what} " in lines


def test_paths_with_spaces_and_other_letters_are_read(folder: Path, tmp_path: Path) -> None:
    strange = tmp_path / "Gefäß 三 mit Henkel" / "ein Ordner"
    shutil.copytree(folder, strange)
    assert len(list(open_sequence(strange))) == 4
    (tmp_path / "link").symlink_to(strange)
    assert len(list(open_sequence(tmp_path / "link"))) == 4


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


def test_what_a_person_says_counts_more(folder: Path) -> None:
    sequence = open_sequence(folder, Given(intrinsics=(100.0, 101.0, 80.0, 60.0), depth_scale_mm=0.4))
    plain = open_sequence(folder)
    unit = 0.2 if folder.name == "TUM RGB-D" else 1.0
    for first, second in zip(plain, sequence, strict=True):
        np.testing.assert_allclose(second.depth_m, first.depth_m * np.float32(0.4 / unit), rtol=1e-6)
        assert (second.camera.fx, second.camera.fy, second.camera.cx, second.camera.cy) == (100.0, 101.0, 80.0, 60.0)
    assert sequence.depth_unit == "0.4 mm (--depth-scale-mm)"


# TUM


def test_colour_too_far_in_time_is_no_partner(tmp_path: Path, frames: list[Frame]) -> None:
    write_tum(tmp_path / "s", frames)
    listed = (tmp_path / "s" / "rgb.txt").read_text().splitlines()
    listed[3] = listed[3].replace("1305031102.505000 ", "1305031102.530000 ")
    (tmp_path / "s" / "rgb.txt").write_text("\n".join(listed))
    sequence = open_sequence(tmp_path / "s")
    assert [frame.colour is None for frame in sequence] == [False, True, False, False]
    assert sequence.notes == ("1 depth images have no colour image within 20 ms",)
    (tmp_path / "s" / "rgb.txt").unlink()
    assert all(frame.colour is None for frame in open_sequence(tmp_path / "s"))


def test_poses_are_not_interpolated_over_gaps(
    tmp_path: Path, frames: list[Frame], truth: dict[int, np.ndarray]
) -> None:
    write_tum(tmp_path / "s", frames, truth)
    path = tmp_path / "s" / "groundtruth.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:3] + lines[4:]))  # without the pose after the first frame
    known = open_sequence(tmp_path / "s").truth()
    assert known is not None
    assert tuple(known) == (1, 2, 3)


def test_the_benchmarks_own_size_needs_no_intrinsics(tmp_path: Path, frames: list[Frame]) -> None:
    write_tum(tmp_path / "s", frames)
    (tmp_path / "s" / "calibration.txt").unlink()
    with pytest.raises(InputError, match=r"no intrinsics for images of 160 x 120"):
        open_sequence(tmp_path / "s")
    for path in (tmp_path / "s").glob("*/*.png"):
        with Image.open(path) as picture:
            large = np.asarray(picture).repeat(4, axis=0).repeat(4, axis=1)
        save(path, large)
    sequence = open_sequence(tmp_path / "s")
    assert sequence.frame(0).camera.fx == 525.0
    assert "assumed" in sequence.notes[0]


# Open3D, BundleSDF


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
    with pytest.raises(InputError, match="3 pictures cannot be told"):
        open_sequence(folder)
    save(folder / "color" / "00002.jpg", raw_depth(frames[0], 1.0).astype(np.uint8))
    assert all(frame.colour is not None for frame in open_sequence(folder))


def test_a_mask_of_the_first_frame_alone_is_taken(tmp_path: Path, frames: list[Frame]) -> None:
    write_bundlesdf(tmp_path / "s", frames)
    for path in sorted((tmp_path / "s" / "masks").iterdir())[1:]:
        path.unlink()
    sequence = open_sequence(tmp_path / "s")
    assert [frame.mask is None for frame in sequence] == [False, True, True, True]
    assert sequence.notes == ("3 of 4 depth images have no mask",)


@pytest.mark.parametrize(
    "content",
    [
        {"width": 160, "height": 120, "intrinsic_matrix": [143.75, 0, 0, 0, 143.75, 0, 79.875, 59.875, 1]},
        {"intrinsic_matrix": [143.75, 0, 79.875, 0, 143.75, 59.875, 0, 0, 1]},
        {"camera_matrix": [[143.75, 0, 79.875], [0, 143.75, 59.875], [0, 0, 1]]},
        {"fx": 143.75, "fy": 143.75, "ppx": 79.875, "ppy": 59.875},
        {"intrinsic": {"fx": 143.75, "fy": 143.75, "cx": 79.875, "cy": 59.875}},
    ],
)
def test_intrinsics_are_read_in_each_spelling(tmp_path: Path, frames: list[Frame], content: dict) -> None:
    write_open3d(tmp_path / "s", frames)
    (tmp_path / "s" / "camera_intrinsic.json").write_text(json.dumps(content))
    camera = open_sequence(tmp_path / "s").frame(0).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (143.75, 143.75, 79.875, 59.875)


@pytest.mark.parametrize(
    "content",
    [
        "143.75 143.75 79.875 59.875 0 0 0 0 0",
        "# fx, fy, cx, cy\n143.75, 143.75, 79.875, 59.875\n",
        "143.75 0 79.875\n0 143.75 59.875\n0 0 1\n",
        "[[143.75   0.     79.875]\n [  0.   143.75   59.875]\n [  0.     0.      1.   ]]\n",
    ],
)
def test_intrinsics_are_read_from_text_in_each_spelling(tmp_path: Path, frames: list[Frame], content: str) -> None:
    write_open3d(tmp_path / "s", frames)
    (tmp_path / "s" / "cam_K.txt").write_text(content)
    camera = open_sequence(tmp_path / "s").frame(0).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (143.75, 143.75, 79.875, 59.875)


@pytest.mark.parametrize(("scale", "unit"), [(0.1, "0.1 mm"), (0.0001, "0.1 mm"), (5000, "0.2 mm"), (1, "1 mm")])
def test_the_unit_of_depth_that_stands_beside_the_intrinsics_counts(
    tmp_path: Path, frames: list[Frame], scale: float, unit: str
) -> None:
    """BOP's mm a unit, RealSense's m a unit, Open3D's units a m."""
    write_open3d(tmp_path / "s", frames)
    (tmp_path / "s" / "camera_intrinsic.json").unlink()
    told = {"fx": 143.75, "fy": 143.75, "cx": 79.875, "cy": 59.875, "depth_scale": scale}
    (tmp_path / "s" / "camera.json").write_text(json.dumps(told))
    sequence = open_sequence(tmp_path / "s")
    assert sequence.layout == "folder of pictures"
    assert sequence.depth_unit == f"{unit} (camera.json)"
    given = open_sequence(tmp_path / "s", Given(depth_scale_mm=3.0))
    ratio = np.nanmedian(given.frame(0).depth_m / sequence.frame(0).depth_m)
    assert ratio == pytest.approx(3.0 / float(unit.split()[0]), rel=1e-5)
    (tmp_path / "s" / "camera.json").write_text(json.dumps({**told, "depth_scale": 30}))
    with pytest.raises(InputError, match=r"camera\.json: \"depth_scale\" is 30; it must be millimetres"):
        open_sequence(tmp_path / "s")


def test_numbers_within_names_tell_the_order(tmp_path: Path, frames: list[Frame]) -> None:
    write_open3d(tmp_path / "s", frames)
    for folder, prefix in (("depth", "depth_"), ("color", "colour-")):
        for place, path in enumerate(sorted((tmp_path / "s" / folder).iterdir())):
            path.rename(path.with_name(f"{prefix}{7 + 3 * place}_1{path.suffix}"))  # 7, 10, 13, 16
    sequence = open_sequence(tmp_path / "s")
    assert sequence.indices == (7, 10, 13, 16)
    for read, wrote in zip(sequence, frames, strict=True):
        np.testing.assert_allclose(read.depth_m, wrote.depth_m, rtol=0, atol=1e-6)
        assert read.colour is not None
        assert wrote.colour is not None
        assert np.abs(read.colour.astype(float) - wrote.colour).mean() < 3.0


def test_intrinsics_of_images_of_another_size_are_asked_about(tmp_path: Path, frames: list[Frame]) -> None:
    write_open3d(tmp_path / "s", frames)
    assert not open_sequence(tmp_path / "s").notes
    path = tmp_path / "s" / "camera_intrinsic.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "width": 640, "height": 480}))
    assert open_sequence(tmp_path / "s").notes == (
        "camera_intrinsic.json is of images of 640 x 480 where the depth images are 160 x 120: are its intrinsics "
        "theirs?",
    )


def test_aligned_colour_that_is_finer_than_depth_is_shrunk(tmp_path: Path, frames: list[Frame]) -> None:
    write_open3d(tmp_path / "s", frames)
    before = [frame.colour for frame in open_sequence(tmp_path / "s")]
    for path in (tmp_path / "s" / "color").iterdir():
        with Image.open(path) as picture:
            picture.resize((480, 360), Image.Resampling.NEAREST).save(path, quality=95)
    sequence = open_sequence(tmp_path / "s")
    assert sequence.notes == (
        "colour is 480 x 360 where depth is 160 x 120: it is shrunk, and taken for the depth camera's view",
    )
    for frame, colour in zip(sequence, before, strict=True):
        assert frame.colour is not None
        assert colour is not None
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
    assert [doubt.partition(":")[0] for doubt in doubts] == [
        "100% of the measured pixels have none beside them"
    ] * sparse


# BOP onboarding


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
        assert frame.colour is not None
        assert frame.colour.shape == (120, 160, 3)
    found = survey(sequence)
    assert (found.masks, found.colours, found.truths) == (2, 4, 4)
    assert "no mask in 2 frames: the object is segmented by the program" in found.missing
    assert sequence.notes == ("1 colour images have no depth image and are left out",)
    with pytest.raises(InputError, match="holds 1 sequences; give one of them: obj_000001_up"):
        open_sequence(tmp_path / "onboarding_static")


def test_what_may_be_meant_otherwise_is_asked(tmp_path: Path, frames: list[Frame]) -> None:
    write_bop(tmp_path / "right", frames, depth_scale_mm=1.0)
    assert survey(open_sequence(tmp_path / "right")).doubts == ()
    doubled = [frames[0], replace(frames[0], index=1), frames[2], replace(frames[2], index=3)]
    write_open3d(tmp_path / "twice", doubled)
    (doubt,) = survey(open_sequence(tmp_path / "twice")).doubts
    assert doubt == (
        "2 of 4 frames have the depth of the frame before, to the bit (1, 3): were they saved twice? If so, remove them"
    )
    write_bop(tmp_path / "unit", [replace(one, depth_m=10.0 * one.depth_m) for one in frames], depth_scale_mm=1.0)
    (doubt,) = survey(open_sequence(tmp_path / "unit")).doubts
    assert "very far for an object: is the unit right?" in doubt
    cameras = [replace(one.camera, cx=one.camera.cy, cy=one.camera.cx) for one in frames]
    swapped = [replace(one, camera=camera) for one, camera in zip(frames, cameras, strict=True)]
    write_bop(tmp_path / "swapped", swapped, depth_scale_mm=1.0)
    (doubt,) = survey(open_sequence(tmp_path / "swapped")).doubts
    assert doubt.endswith("are cx and cy exchanged?")
    larger = [replace(one.camera, cx=2.0 * one.camera.cx, cy=2.0 * one.camera.cy) for one in frames]
    doubled = [replace(one, camera=camera) for one, camera in zip(frames, larger, strict=True)]
    write_bop(tmp_path / "larger", doubled, depth_scale_mm=1.0)
    (doubt,) = survey(open_sequence(tmp_path / "larger")).doubts
    assert doubt.endswith("are the intrinsics those of images of another size?")


def test_onboarding_video_has_truth_for_its_first_frame_only(
    tmp_path: Path, frames: list[Frame], truth: dict[int, np.ndarray]
) -> None:
    scene = tmp_path / "onboarding_dynamic" / "obj_000001"
    write_bop(scene, frames, {0: truth[0]}, depth_scale_mm=1.0)
    known = open_sequence(scene).truth()
    assert known is not None
    assert tuple(known) == (0,)


def test_colour_without_depth_is_refused(tmp_path: Path, frames: list[Frame]) -> None:
    save_grey(tmp_path / "hot3d" / "gray" / "000000.jpg", frames[0])
    (tmp_path / "hot3d" / "scene_camera.json").write_text('{"0": {"cam_K": [1, 0, 0, 0, 1, 0, 0, 0, 1]}}')
    with pytest.raises(InputError, match="holds no depth image"):
        open_sequence(tmp_path / "hot3d")
    (tmp_path / "hot3d" / "scene_camera.json").unlink()
    (tmp_path / "hot3d" / "gray").rename(tmp_path / "hot3d" / "rgb")
    with pytest.raises(InputError, match="colour but no depth"):
        open_sequence(tmp_path / "hot3d")


def test_the_folder_of_the_images_alone_is_told_from_its_sequence(tmp_path: Path, frames: list[Frame]) -> None:
    write_bop(tmp_path / "scene", frames[:1], depth_scale_mm=1.0)
    with pytest.raises(InputError, match=rf"give the one it lies in, {tmp_path / 'scene'}"):
        open_sequence(tmp_path / "scene" / "depth")
    with pytest.raises(InputError, match="a file of this kind holds no sequence"):
        open_sequence(tmp_path / "scene" / "depth" / "000000.png")


def test_a_sequence_has_no_poses_to_convert(
    tmp_path: Path, frames: list[Frame], capfd: pytest.CaptureFixture[str]
) -> None:
    write_bop(tmp_path / "scene", frames[:1], depth_scale_mm=1.0)
    assert main(["convert", str(tmp_path / "scene"), "--out", str(tmp_path / "poses.txt")]) == 2
    assert "is no folder of a run" in capfd.readouterr().err
    assert not (tmp_path / "poses.txt").exists()


def test_tiff_pictures_are_read(tmp_path: Path, frames: list[Frame]) -> None:
    write_bop(tmp_path / "itodd", frames, depth_scale_mm=1.0)
    for frame in frames:
        (tmp_path / "itodd" / "depth" / f"{frame.index:06d}.png").unlink()
        save(tmp_path / "itodd" / "depth" / f"{frame.index:06d}.tif", raw_depth(frame, 1.0))
    for read, wrote in zip(open_sequence(tmp_path / "itodd"), frames, strict=True):
        np.testing.assert_allclose(read.depth_m, wrote.depth_m, atol=1e-6)


def save_grey(path: Path, frame: Frame) -> None:
    assert frame.colour is not None
    save(path, frame.colour.mean(axis=2).astype(np.uint8))


# Results to other programs


def test_poses_of_a_run_go_to_bop_and_tum(tmp_path: Path, rng: np.random.Generator) -> None:
    run = tmp_path / "run"
    run.mkdir()
    poses = {index: se3.exp(0.3 * rng.normal(size=6)) for index in (2, 5)}
    frame = {"points": 900, "outcome": "accepted"}
    covariance = {"covariance": np.eye(6).ravel().tolist()}
    report = {
        "schema": 1,
        "sequence": "cup",
        "settings": {},
        "seconds": {},
        "closed": False,
        "trustworthy": True,
        "reasons": [],
        "frames": [{"id": index, "timestamp": 0.5 * index} | frame for index in (2, 3, 5)],
        "edges": [],
        "poses": [
            {"id": index, "object_from_camera": pose.ravel().tolist()} | covariance for index, pose in poses.items()
        ],
    }
    (run / "report.json").write_text(json.dumps(report))
    assert main(["convert", str(run), "--out", str(tmp_path / "scene_gt.json")]) == 0
    written = json.loads((tmp_path / "scene_gt.json").read_text())
    assert set(written) == {"2", "5"}
    for index, pose in poses.items():
        entry = written[str(index)][0]
        np.testing.assert_allclose(np.reshape(entry["cam_R_m2c"], (3, 3)), pose[:3, :3].T, atol=1e-12)
        np.testing.assert_allclose(entry["cam_t_m2c"], -1000.0 * pose[:3, :3].T @ pose[:3, 3], atol=1e-9)
    assert main(["convert", str(run), "--out", str(tmp_path / "poses.txt")]) == 0
    rows = np.loadtxt(tmp_path / "poses.txt")
    np.testing.assert_allclose(rows[:, 0], [1.0, 2.5])
    np.testing.assert_allclose(rows[:, 1:4], [pose[:3, 3] for pose in poses.values()])
    assert main(["convert", str(run), "--out", str(tmp_path / "poses.csv")]) == 2
    for option in (["--every", "2"], ["--frames", "2:"], ["--sensor", "x.json"], ["--depth-scale-mm", "1"]):
        assert main(["convert", str(run), "--out", str(tmp_path / "part.txt"), *option]) == 2
    assert not (tmp_path / "part.txt").exists()
    stray = {"id": 7, "object_from_camera": np.eye(4).ravel().tolist()} | covariance
    for broken in (
        {"schema": 1, "poses": [{"id": "x"}]},
        report | {"poses": [stray]},
        report | {"poses": [stray | {"id": 2, "object_from_camera": [2.0] * 16}]},
        report | {"frames": [{"id": 2, "timestamp": 10**400} | frame], "poses": []},
        report | {"poses": [stray | {"id": 2, "object_from_camera": [10**400, *stray["object_from_camera"][1:]]}]},
    ):
        (run / "report.json").write_text(json.dumps(broken))
        assert main(["convert", str(run), "--out", str(tmp_path / "other.txt")]) == 2
        assert not (tmp_path / "other.txt").exists()


# Commands


def test_a_model_is_built_from_any_of_them(tmp_path: Path, frames: list[Frame]) -> None:
    path = Recorder("32FC1").write(tmp_path / "turned by hand.mcap", frames)
    run = tmp_path / "run"
    assert main(["build", str(path), "--out", str(run), "--method", "icp", "--prior", "table"]) == 0
    report = json.loads((run / "report.json").read_text())
    assert [frame["outcome"] for frame in report["frames"]] == ["accepted"] * 4
    assert main(["convert", str(run), "--out", str(tmp_path / "scene_gt.json")]) == 0
    assert set(json.loads((tmp_path / "scene_gt.json").read_text())) == {"0", "1", "2", "3"}


# Real captures


def test_real_sequences_survive_the_way_there_and_back(tmp_path: Path) -> None:
    data = Path(__file__).parents[2] / "shared" / "data"
    if not data.is_dir():
        pytest.skip("the real sequences are not here")
    for name in ("cap", "dragon"):
        whole = open_sequence(data / name)
        assert main(["convert", str(data / name), "--every", "12", "--out", str(tmp_path / name)]) == 0
        again = open_sequence(tmp_path / name)
        for frame in again:
            np.testing.assert_allclose(frame.depth_m, whole.frame(frame.index).depth_m, rtol=0, atol=1e-6)


def test_the_bundled_sequences_are_found_in_their_folder(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(bundled("box").parent)]) == 2
    assert "box, flashlight, tube" in capsys.readouterr().err
