"""Folders as other programs write them: what was written is what is read, and what `info` and `convert` make of it."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from bop_scenes import CAMERA, INDICES
from hypothesis import given
from hypothesis import strategies as st

from modeler.cli import main
from modeler.export import RunFolder
from modeler.sequences import AbstractSequence, KeptSequence, frame_range, open_sequence
from modeler.types import Frame, InputError
from studies.formats.image_folders import write_tum
from studies.formats.ros_bags import Recorder


def assert_same(sequence: AbstractSequence, frames: list[Frame], *, colour_off: float = 0.0) -> None:
    assert len(sequence) == len(frames)
    for read, wrote in zip(sequence, frames, strict=True):
        np.testing.assert_allclose(read.depth_m, wrote.depth_m, rtol=0, atol=1e-6)
        camera, ours = read.camera, wrote.camera
        assert (camera.width, camera.height) == (ours.width, ours.height)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((ours.fx, ours.fy, ours.cx, ours.cy))
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
    assert len([what for what in said["missing"] if "mask" in what]) == (0 if masked else 1)
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


def test_poses_are_not_interpolated_over_gaps(
    tmp_path: Path, frames: list[Frame], truth: dict[int, np.ndarray]
) -> None:
    write_tum(tmp_path / "s", frames, truth)
    path = tmp_path / "s" / "groundtruth.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:3] + lines[4:]))  # without the pose after the first frame
    poses = open_sequence(tmp_path / "s").truth()
    assert poses is not None
    assert tuple(poses) == (1, 2, 3)


def test_poses_of_a_run_go_to_bop(built: Path, tmp_path: Path, refusal: Callable[..., str]) -> None:
    poses = {str(pose["id"]): pose["object_from_camera"] for pose in RunFolder(built).report()["poses"]}
    assert main(["convert", str(built), "--out", str(tmp_path / "scene_gt.json")]) == 0
    written = json.loads((tmp_path / "scene_gt.json").read_text())
    assert written.keys() == poses.keys()
    for index, numbers in poses.items():
        pose, (entry,) = np.reshape(numbers, (4, 4)), written[index]
        np.testing.assert_allclose(np.reshape(entry["cam_R_m2c"], (3, 3)), pose[:3, :3].T, atol=1e-12)
        np.testing.assert_allclose(entry["cam_t_m2c"], -1000.0 * pose[:3, :3].T @ pose[:3, 3], atol=1e-9)
    for option in ("--every 2", "--frames 2:", "--sensor x.json", "--depth-scale-mm 1"):
        refusal("convert", built, "--out", tmp_path / "part.txt", *option.split())
    refusal("convert", built, "--out", tmp_path / "poses.csv")
    assert [path.name for path in tmp_path.iterdir()] == ["scene_gt.json"]


def test_a_model_is_built_from_any_of_them(tmp_path: Path, frames: list[Frame]) -> None:
    path = Recorder("32FC1").write(tmp_path / "turned by hand.mcap", frames)
    run = tmp_path / "run"
    status = main(["build", str(path), "--out", str(run), "--method", "icp", "--prior", "table"])
    report = json.loads((run / "report.json").read_text())
    assert status == (3 if report["reasons"] else 0)
    # ICP states too little on images so small.
    assert set(report["reason_codes"]) <= {"prior_contradicted", "edges_disagree"}
    assert [frame["outcome"] for frame in report["frames"]] == ["accepted"] * 4
    assert main(["convert", str(run), "--out", str(tmp_path / "scene_gt.json")]) == 0
    assert set(json.loads((tmp_path / "scene_gt.json").read_text())) == {"0", "1", "2", "3"}


# Frames are selected by number, as slices are.


@given(every=st.integers(1, 4), start=st.none() | st.integers(0, 14), stop=st.none() | st.integers(0, 14))
def test_selection_is_a_slice_of_frame_numbers(every: int, start: int | None, stop: int | None) -> None:
    whole = Numbers(INDICES)
    wanted = [i for i in INDICES if i in range(0 if start is None else start, 99 if stop is None else stop)][::every]
    if not wanted:
        with pytest.raises(InputError, match=r"3 to 12"):
            whole.select(every, slice(start, stop))
        return
    part = whole.select(every, slice(start, stop))
    assert list(part.indices) == wanted == [f.index for f in part]
    assert part.name == whole.name
    part_truth = part.truth()
    assert part_truth is not None
    assert list(part_truth) == wanted
    for index in set(INDICES) - set(wanted):
        with pytest.raises(InputError, match="not among the selected"):
            part.frame(index)


def test_frames_that_were_read_stay_as_far_as_memory_allows() -> None:
    size = Numbers(INDICES).frame(INDICES[0]).depth_m.nbytes
    kept = KeptSequence(Numbers(INDICES), memory_bytes=2 * size + 1)
    first, second = list(kept), list(kept)
    assert [frame.index for frame in second] == list(INDICES)
    assert [one is other for one, other in zip(first, second, strict=True)] == [k < 2 for k in range(len(INDICES))]


class Numbers(AbstractSequence):
    """Empty frames of given numbers."""

    def __init__(self, numbers: tuple[int, ...]) -> None:
        self.numbers = numbers

    @property
    def name(self) -> str:
        return "numbers"

    @property
    def indices(self) -> tuple[int, ...]:
        return self.numbers

    def frame(self, index: int) -> Frame:
        return Frame(index, float(index), np.zeros((30, 40), np.float32), CAMERA)

    def truth(self) -> dict[int, np.ndarray] | None:
        return {index: np.eye(4) for index in self.numbers}

    @property
    def model_path(self) -> None:
        return None


@pytest.mark.parametrize(
    ("text", "expected"),
    [("3:9", slice(3, 9)), (":4", slice(None, 4)), ("2:", slice(2, None)), (":", slice(None, None))],
)
def test_ranges_of_frames_are_read(text: str, expected: slice) -> None:
    assert frame_range(text) == expected


@pytest.mark.parametrize("text", ["", "3", "a:b", "1:2:3", "-1:3", "1.5:2", "\u0661:\u0662"])
def test_other_ranges_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="A:B"):
        frame_range(text)
