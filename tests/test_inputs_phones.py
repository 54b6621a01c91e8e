"""Recordings of phones, and what `modeler info` and `modeler build` say of inputs as people have them."""

import io
import json
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_runner import Run
from PIL import Image

from modeler.composition import compose
from modeler.composition.options import PriorOptions
from modeler.export import RunFolder, RunMeta
from modeler.sequences import Overrides, open_sequence, survey
from modeler.types import Camera, Frame, InputError
from studies.formats.image_folders import raw_depth, save
from studies.formats.other_programs import write_camera


def enlarged(camera: Camera, factor: float) -> dict[str, float]:
    """Return the intrinsics of images of the same view with more pixels."""
    return {
        "fx": camera.fx * factor,
        "fy": camera.fy * factor,
        "cx": (camera.cx + 0.5) * factor - 0.5,
        "cy": (camera.cy + 0.5) * factor - 0.5,
    }


def check(path: Path, frames: list[Frame], *, coloured: bool = True) -> None:
    """Compare what is read, where confidence is not 0, with what was written."""
    sequence = open_sequence(path)
    assert len(sequence) == len(frames)
    for read, wrote in zip(sequence, frames, strict=True):
        ours, theirs = read.camera, wrote.camera
        assert (ours.fx, ours.fy, ours.cx, ours.cy) == pytest.approx((theirs.fx, theirs.fy, theirs.cx, theirs.cy))
        assert np.isnan(read.depth_m[:10]).all()
        np.testing.assert_allclose(read.depth_m[10:], wrote.depth_m[10:], atol=1e-6)
        assert (read.colour is not None) == coloured
        if read.colour is not None and wrote.colour is not None:
            assert np.abs(read.colour.astype(float) - wrote.colour).mean() < 4.0


def confidence() -> np.ndarray:
    trusted = np.full((120, 160), 2, np.uint8)
    trusted[:10] = 0
    return trusted


def larger(colour: np.ndarray | None, factor: int) -> np.ndarray:
    return colour.repeat(factor, axis=0).repeat(factor, axis=1)


def test_recordings_of_record3d_are_read(tmp_path: Path, frames: list[Frame]) -> None:
    lzfse = pytest.importorskip("lzfse")
    pixels = enlarged(frames[0].camera, 6.0)
    matrix = [pixels["fx"], 0, 0, 0, pixels["fy"], 0, pixels["cx"], pixels["cy"], 1]  # by columns
    stamps = [7.0 + 0.5 * frame.index for frame in frames]
    meta = {"K": matrix, "w": 960, "h": 720, "dw": 160, "dh": 120, "fps": 60, "frameTimestamps": stamps}
    with zipfile.ZipFile(tmp_path / "s.r3d", "w") as archive:
        archive.writestr("metadata", json.dumps(meta))
        for frame in frames:
            archive.writestr(f"rgbd/{frame.index}.depth", lzfse.compress(frame.depth_m.astype("<f4").tobytes()))
            archive.writestr(f"rgbd/{frame.index}.conf", lzfse.compress(confidence().tobytes()))
            packed = io.BytesIO()
            Image.fromarray(larger(frame.colour, 6)).save(packed, "JPEG", quality=95)
            archive.writestr(f"rgbd/{frame.index}.jpg", packed.getvalue())
    check(tmp_path / "s.r3d", frames)
    assert [frame.time_s for frame in open_sequence(tmp_path / "s.r3d")] == stamps
    with zipfile.ZipFile(tmp_path / "broken.r3d", "w") as archive:
        archive.writestr("metadata", json.dumps(meta))
        archive.writestr("rgbd/0.depth", b"bvx2 and nothing else")
    with pytest.raises(InputError, match=r"broken\.r3d: is not a readable recording"):
        survey(open_sequence(tmp_path / "broken.r3d"))


def test_folders_of_polycam_are_read(tmp_path: Path, frames: list[Frame]) -> None:
    """Each frame has a camera of its own, since the phone focuses."""
    focused = [
        replace(frame, camera=replace(frame.camera, fx=frame.camera.fx + frame.index, fy=frame.camera.fy))
        for frame in frames
    ]
    for frame in focused:
        stem, root = f"{41000000 + 500000 * frame.index}", tmp_path / "keyframes"
        save(root / "depth" / f"{stem}.png", raw_depth(frame, 1.0))
        save(root / "confidence" / f"{stem}.png", confidence() * 100)
        save(root / "images" / f"{stem}.jpg", larger(frame.colour, 4))
        (root / "cameras").mkdir(exist_ok=True)
        facts = enlarged(frame.camera, 4.0) | {"width": 640, "height": 480, "t_00": 1.0}
        (root / "cameras" / f"{stem}.json").write_text(json.dumps(facts))
    check(tmp_path, focused)


def test_lists_of_nerfstudio_are_read(tmp_path: Path, frames: list[Frame]) -> None:
    listed = []
    for frame in frames:
        depth, image = f"depths/d{frame.index}.png", f"pictures/p{frame.index}.png"
        trusted = replace(frame, depth_m=np.where(confidence() > 0, frame.depth_m, np.float32(np.nan)))
        save(tmp_path / depth, raw_depth(trusted, 1.0))
        save(tmp_path / image, larger(frame.colour, 3))
        listed.append({"file_path": image, "depth_file_path": depth, "transform_matrix": np.eye(4).tolist()})
    pixels = enlarged(frames[0].camera, 3.0)
    facts = {"fl_x": pixels["fx"], "fl_y": pixels["fy"], "w": 480, "h": 360}
    facts |= {"cx": pixels["cx"] + 0.5, "cy": pixels["cy"] + 0.5}  # from the corner of the first pixel
    (tmp_path / "transforms.json").write_text(json.dumps(facts | {"frames": listed}))
    check(tmp_path, frames)
    (tmp_path / "pictures" / "p1.png").unlink()
    with pytest.raises(InputError, match=r"names pictures/p1\.png, which is not there"):
        open_sequence(tmp_path)


def test_exchanged_bytes_are_reported(tmp_path: Path, frames: list[Frame]) -> None:
    save(tmp_path / "depth" / "0.png", raw_depth(frames[0], 1.0).byteswap())
    write_camera(tmp_path, frames[0].camera)
    with pytest.raises(InputError, match="two bytes of its values exchanged"):
        open_sequence(tmp_path)
    save(tmp_path / "depth" / "0.png", raw_depth(frames[0], 1.0))
    open_sequence(tmp_path)


def test_info_draws_what_it_read(tmp_path: Path, frames: list[Frame], cli: Run) -> None:
    for frame in frames:
        save(tmp_path / "s" / "depth" / f"{frame.index}.png", raw_depth(frame, 1.0))
        save(tmp_path / "s" / "rgb" / f"{frame.index}.png", larger(frame.colour, 1))
    write_camera(tmp_path / "s", frames[0].camera)
    assert cli("info", tmp_path / "s", "--picture", tmp_path / "look.png")[0] == 0
    with Image.open(tmp_path / "look.png") as drawn:
        pixels = np.asarray(drawn)
    assert pixels.shape == (2 * 124, 2 * 164, 3)
    first, second = frames[0].colour, frames[2].colour
    for row, colour in ((0, first), (124, second)):
        same = (pixels[row : row + 120, 164:324] == colour).all(axis=2)
        red = (pixels[row : row + 120, 164:324] == (255, 0, 0)).all(axis=2)
        assert (same | red).all()
        assert 0 < np.count_nonzero(red) < 0.1 * red.size
    assert (pixels[:120, :160][np.isnan(frames[0].depth_m)] == 0).all()


@pytest.mark.parametrize(("step_deg", "refused"), [(24.0, True), (1.0, False)])
def test_names_that_are_angles_are_reported(
    tmp_path: Path, frames: list[Frame], *, step_deg: float, refused: bool
) -> None:
    for frame in frames:
        save(tmp_path / "depth" / f"{24 * frame.index}.png", raw_depth(frame, 1.0))
    write_camera(tmp_path, frames[0].camera)
    options = PriorOptions(prior="turntable", step_deg=step_deg)
    if refused:
        with pytest.raises(InputError, match=r"576° apart; if the names are angles, give `step_deg` 1"):
            compose.resolved_prior(options, open_sequence(tmp_path))
    else:
        assert compose.resolved_prior(options, open_sequence(tmp_path))[0] == "turntable"


def test_frames_that_are_new_changed_or_gone_are_named(tmp_path: Path) -> None:
    """A run remembers the content of its frames, not their dates."""
    (tmp_path / "report.json").write_text(json.dumps({"schema": 1, "digests": {"0": "a", "1": "b", "2": "c"}}))
    run = RunFolder(tmp_path)

    def changes(digests: dict[int, str]) -> tuple[str, ...]:
        return run.changed_frames(RunMeta("s", 0, "auto", digests=digests))

    assert changes({0: "a", 1: "b", 2: "c"}) == ()
    assert changes({}) == ()  # of a sequence that is still being recorded
    assert changes({0: "a", 1: "x", 3: "d", 4: "e"}) == ("frames 3, 4 are new", "frame 1 is changed", "frame 2 is gone")
    assert changes({index: "abc"[index] if index < 3 else "n" for index in range(20)}) == (
        "frames 3 to 19 (17) are new",
    )


def test_digests_are_of_content(frames: list[Frame], tmp_path: Path) -> None:
    def digests(folder: Path, shift: int) -> dict[int, str]:
        for frame in frames:
            units = raw_depth(frame, 1.0)
            units[60, 80] += shift if frame.index == 2 else 0
            save(folder / "depth" / f"{frame.index}.png", units)
        write_camera(folder, frames[0].camera)
        return dict(survey(open_sequence(folder)).digests)

    first, again, other = digests(tmp_path / "a", 0), digests(tmp_path / "b", 0), digests(tmp_path / "c", 1)
    assert first == again
    assert [index for index in first if first[index] != other[index]] == [2]


def test_frames_of_nerfstudio_have_cameras_of_their_own(tmp_path: Path, frames: list[Frame]) -> None:
    shots = []
    for frame in frames:
        name, camera = f"frame_{frame.index:05d}.png", frame.camera
        save(tmp_path / "depth" / name, raw_depth(frame, 1.0))
        facts = {"fl_x": camera.fx + frame.index, "fl_y": camera.fy, "cx": camera.cx + 0.5, "cy": camera.cy + 0.5}
        shots.append(facts | {"depth_file_path": f"depth/{name}", "transform_matrix": np.eye(4).tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"w": 160, "h": 120, "frames": shots}))
    for read, wrote in zip(open_sequence(tmp_path), frames, strict=True):
        assert read.camera == replace(wrote.camera, fx=wrote.camera.fx + wrote.index)


def test_colour_of_a_video_belongs_to_depth_by_number(tmp_path: Path, frames: list[Frame]) -> None:
    """As Stray Scanner writes it: images of the same view, larger; one may be missing at the end."""
    av = pytest.importorskip("av")
    with av.open(str(tmp_path / "rgb.mp4"), "w") as container:
        track = container.add_stream("mpeg4", rate=30)
        track.width, track.height, track.pix_fmt, track.bit_rate = 320, 240, "yuv420p", 8_000_000
        for frame in frames[:-1]:
            picture = av.VideoFrame.from_ndarray(larger(frame.colour, 2), format="rgb24")
            container.mux(track.encode(picture))
        container.mux(track.encode())
    for frame in frames:
        save(tmp_path / "depth" / f"{frame.index:06d}.png", raw_depth(frame, 1.0))
    camera = enlarged(frames[0].camera, 1.0)
    (tmp_path / "camera_matrix.csv").write_text(
        f"{camera['fx']}, 0, {camera['cx']}\n0, {camera['fy']}, {camera['cy']}\n0, 0, 1\n"
    )
    sequence = open_sequence(tmp_path, Overrides(intrinsics=(camera["fx"], camera["fy"], camera["cx"], camera["cy"])))
    assert "colour is that of rgb.mp4, its images counted as depth images are" in sequence.notes
    for index in (*sequence.indices, 1, 0):  # also back
        colour, wrote = sequence.frame(index).colour, frames[index].colour
        assert (colour is None) == (index == frames[-1].index)
        if colour is not None and wrote is not None:
            assert np.abs(colour.astype(float) - wrote).mean() < 8.0
    (tmp_path / "rgb.mp4").write_bytes((tmp_path / "rgb.mp4").read_bytes()[:500])
    with pytest.raises(InputError, match=r"rgb\.mp4: is not a readable video"):
        open_sequence(tmp_path).frame(0)
