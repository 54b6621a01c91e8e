"""Sequences that are short, long, or show something else than one object: a result with its reasons, or one line."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_runner import QUICK

from modeler import se3
from modeler.cli import main
from modeler.sequences import bundled, open_sequence, write_bop
from modeler.types import Frame, Outcome
from modeler.views.rays import part_of
from studies.formats.image_folders import small_frames, small_truth
from studies.fuzz.targets import tiny


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return small_frames(6)


def built(frames: list[Frame], folder: Path, *options: str) -> tuple[int, dict]:
    """Return the status and the report of a build."""
    write_bop(folder / "in", frames, depth_scale_mm=1.0)
    status = main(["build", str(folder / "in"), "--out", str(folder / "run"), *QUICK, *options])
    return status, json.loads((folder / "run" / "report.json").read_text())


def bare(frame: Frame) -> Frame:
    """Return a frame without its object: what the table would measure there."""
    assert frame.mask is not None
    rows, columns = np.nonzero(np.isfinite(frame.depth_m) & ~frame.mask & (np.indices(frame.mask.shape)[0] > 60))
    design = np.stack([rows, columns, np.ones(rows.size)], axis=1)
    plane, *_ = np.linalg.lstsq(design, 1.0 / frame.depth_m[rows, columns].astype(float), rcond=None)
    inside = np.argwhere(frame.mask)
    depth_m = frame.depth_m.copy()
    depth_m[frame.mask] = 1.0 / (np.column_stack([inside, np.ones(len(inside))]) @ plane)
    return replace(frame, depth_m=depth_m, mask=None)


def unmasked(frame: Frame) -> Frame:
    return replace(frame, mask=None)


def filled(frame: Frame) -> Frame:
    """Return the part of a frame in which there is nothing but the object."""
    assert frame.mask is not None
    rows, columns = np.nonzero(frame.mask)
    top, left = int(np.percentile(rows, 30)), int(np.percentile(columns, 30))
    return part_of(replace(frame, mask=None), slice(top, top + 24), slice(left, left + 24))


def doubled(frame: Frame) -> Frame:
    """Return a frame with the object a second time, farther to the left."""
    assert frame.mask is not None
    depth_m = frame.depth_m.copy()
    other = np.roll(frame.mask, -45, axis=1)
    depth_m[other] = np.roll(frame.depth_m, -45, axis=1)[other]
    return replace(frame, depth_m=depth_m, mask=None)


def test_one_frame_is_a_view_and_two_are_a_model(frames: list[Frame], tmp_path: Path) -> None:
    status, report = built(frames[:1], tmp_path / "one")
    assert (status, report["complete"]) == (3, True)
    assert any("fewer than two frames" in reason for reason in report["reasons"])
    assert len((tmp_path / "one" / "run" / "trajectory.txt").read_text().splitlines()) == 1
    assert (tmp_path / "one" / "run" / "model.ply").exists()
    status, report = built(frames[:2], tmp_path / "two")
    assert (status, len(report["poses"]), len(report["edges"])) == (0, 2, 1)


def test_an_object_that_leaves_is_reported_frame_by_frame(
    frames: list[Frame], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    left = [*map(unmasked, frames[:3]), bare(frames[3]), bare(frames[4])]
    status, report = built(left, tmp_path)
    assert status == 3
    assert [frame["outcome"] == "accepted" for frame in report["frames"]] == [True, True, True, False, False]
    said = capsys.readouterr().err
    assert [f"frame {index} is left out: " in said for index in range(5)] == [False, False, False, True, True]


def test_an_object_that_comes_back_is_found_again(frames: list[Frame], tmp_path: Path) -> None:
    shown = [frames[0], frames[1], replace(frames[1], mask=np.zeros_like(frames[1].mask)), frames[2], frames[3]]
    _, report = built([replace(frame, index=k, time_s=0.1 * k) for k, frame in enumerate(shown)], tmp_path)
    assert [frame["outcome"] == "accepted" for frame in report["frames"]] == [True, True, False, True, True]


@pytest.mark.parametrize("change", [filled, doubled, bare])
def test_what_is_no_single_object_ends_with_a_reason_or_a_model(
    frames: list[Frame], tmp_path: Path, change: Callable[[Frame], Frame], capsys: pytest.CaptureFixture[str]
) -> None:
    status, report = built([change(frame) for frame in frames[:3]], tmp_path)
    lost = [frame for frame in report["frames"] if frame["outcome"] != "accepted"]
    assert status == (3 if report["reasons"] else 0)
    assert bool(report["reasons"]) == (not report["trustworthy"])
    said = capsys.readouterr().err
    assert said.count("is left out") == len(lost)
    if change is bare:
        assert len(lost) == 3
        assert "not to be trusted" in said
    if change is doubled:
        assert f"3 of 3 frames: {Outcome.UNSURE_MASK.label}" in said
        assert "--roi" in said


def test_an_object_that_fills_the_image_is_modelled_where_masks_say_so(frames: list[Frame], tmp_path: Path) -> None:
    close = [replace(filled(frame), mask=np.ones((24, 24), dtype=bool)) for frame in frames[:2]]
    status, report = built(close, tmp_path, "--prior", "general")
    assert status in (0, 3)
    assert report["frames"][0]["outcome"] == "accepted"


def thinned(frame: Frame, step: int) -> Frame:
    """Return every so many-th pixel of a frame."""
    return part_of(frame, slice(None, None, step), slice(None, None, step))


@pytest.fixture(scope="module")
def mixed() -> list[Frame]:
    whole = open_sequence(bundled("box"))
    return [thinned(whole.frame(index), 4 if index % 2 else 2) for index in whole.indices[:4]]


@pytest.mark.parametrize("masked", [pytest.param(True, marks=pytest.mark.slow), False])
def test_frames_of_different_size_are_one_model(
    mixed: list[Frame], tmp_path: Path, capsys: pytest.CaptureFixture[str], masked: bool
) -> None:
    """Some cameras send a part of the sensor, or merge pixels, on their own: each frame has its intrinsics."""
    status, report = built(mixed if masked else [*map(unmasked, mixed)], tmp_path)
    assert status == (3 if report["reasons"] else 0)
    assert set(report["reason_codes"]) <= {"edges_disagree"}  # ICP states too little on images so small
    assert [frame["outcome"] for frame in report["frames"]] == ["accepted"] * 4
    truth = small_truth(4)
    for pose in report["poses"]:
        first_from_this = truth[0] @ se3.inverse(truth[pose["id"]])
        off = se3.inverse(first_from_this) @ np.reshape(pose["object_from_camera"], (4, 4))
        assert np.degrees(se3.rotation_angle(off)) < 2.0
    capsys.readouterr()
    assert main(["info", str(tmp_path / "in")]) == 0
    assert "resolution    320 x 240, 160 x 120\n" in capsys.readouterr().out
    if masked:  # what is made of a run does not know where its masks come from
        assert main(["report", str(tmp_path / "run")]) == 0
        textured = ["--out", str(tmp_path / "m.obj"), "--texture", "--triangles", "500"]
        assert main(["export", str(tmp_path / "run"), *textured]) == 0


def test_frames_of_different_size_need_different_intrinsics(
    mixed: list[Frame], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_bop(tmp_path / "in", mixed, depth_scale_mm=1.0)
    assert main(["calibrate-sensor", str(tmp_path / "in"), "--out", str(tmp_path / "noise.json")]) == 2
    assert "frame 1 has other intrinsics" in capsys.readouterr().err
    path = tmp_path / "in" / "scene_camera.json"
    cameras = json.loads(path.read_text())
    cameras["3"]["cam_K"] = cameras["2"]["cam_K"]
    path.write_text(json.dumps(cameras))
    assert main(["info", str(tmp_path / "in")]) == 2
    said = capsys.readouterr().err
    assert [words for words in ("000003.png", "160 x 120", "000000.png", "320 x 240") if words not in said] == []


@pytest.mark.slow
def test_hundreds_of_frames_are_read_and_converted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pattern = tiny(4)
    numbers = range(900, 1200)  # of three digits and of four, which as words come in another order
    write_bop(tmp_path / "in", (replace(pattern[k % 4], index=k, time_s=0.1 * k) for k in numbers))
    assert main(["info", str(tmp_path / "in"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["frames"] == list(numbers)
    assert main(["convert", str(tmp_path / "in"), "--out", str(tmp_path / "out"), "--every", "2"]) == 0
    assert open_sequence(tmp_path / "out").indices == tuple(numbers[::2])


def test_frames_far_apart_in_number_stay_so(frames: list[Frame], tmp_path: Path) -> None:
    numbered = [replace(frame, index=number) for frame, number in zip(frames[:2], (7, 999_999_999), strict=True)]
    status, report = built(numbered, tmp_path)
    assert (status, [frame["id"] for frame in report["frames"]]) == (0, [7, 999_999_999])


def test_every_frame_alike_is_no_motion(frames: list[Frame], tmp_path: Path) -> None:
    status, report = built([replace(frames[0], index=k, time_s=float(k)) for k in range(3)], tmp_path)
    assert (status, report["reason_codes"]) == (3, ["no_motion"])
    for pose in report["poses"]:
        np.testing.assert_allclose(np.reshape(pose["object_from_camera"], (4, 4)), np.eye(4), atol=1e-3)
