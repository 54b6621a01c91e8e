"""Folders as people have them: images named and stored in ways of other programs, with lenses and masks of theirs."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from modeler.cli import main
from modeler.segmentation import Segmenter
from modeler.sequences import Overrides, open_sequence, survey
from modeler.sequences.file_names import said_of_angles
from modeler.types import Frame, InputError
from studies.formats.image_folders import raw_depth, save
from studies.formats.other_programs import CAMERAS, DEPTHS, LENS, NAMES, distorted, exr, write_camera


@pytest.mark.parametrize("kind", DEPTHS)
def test_depth_is_read_in_each_format(tmp_path: Path, frames: list[Frame], kind: str) -> None:
    write, units = DEPTHS[kind]
    (tmp_path / "depth").mkdir()
    for frame in frames:
        stored = (np.nan_to_num(frame.depth_m) * np.float32(units)).astype(np.float32)
        write(tmp_path / "depth" / f"{frame.index}.{kind.split()[0]}", stored)
    write_camera(tmp_path, frames[0].camera)
    sequence = open_sequence(tmp_path)
    assert sequence.depth_unit.startswith("1000 mm (by its values)" if units == 1.0 else "1 mm")
    for read, wrote in zip(sequence, frames, strict=True):
        np.testing.assert_allclose(read.depth_m, wrote.depth_m, rtol=1e-6)


def test_damaged_pixels_of_exr_are_one_line(
    tmp_path: Path, frames: list[Frame], capfd: pytest.CaptureFixture[str]
) -> None:
    """The library reports them on stderr, and returns the others."""
    path = tmp_path / "depth" / "0.exr"
    exr(path, np.nan_to_num(frames[0].depth_m))
    write_camera(tmp_path, frames[0].camera)
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    for damaged in (content[:middle] + bytes(range(40)) + content[middle + 40 :], content[:middle]):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"0\.exr: is not a readable EXR file"):
            open_sequence(tmp_path)
        assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("nothing", [65504.0, 1e10, np.inf, -1.0])
def test_what_programs_write_for_nothing_is_no_depth(tmp_path: Path, frames: list[Frame], nothing: float) -> None:
    depth_m = np.where(np.isnan(frames[0].depth_m), np.float32(nothing), frames[0].depth_m)
    exr(tmp_path / "depth" / "0.exr", depth_m.astype(np.float32), "V")
    write_camera(tmp_path, frames[0].camera)
    np.testing.assert_array_equal(open_sequence(tmp_path).frame(0).depth_m, frames[0].depth_m)


def test_the_largest_whole_number_is_no_depth(tmp_path: Path, frames: list[Frame]) -> None:
    units = raw_depth(frames[0], 1.0)
    units[units == 0] = 65535
    save(tmp_path / "depth" / "0.png", units)
    write_camera(tmp_path, frames[0].camera)
    np.testing.assert_allclose(open_sequence(tmp_path).frame(0).depth_m, frames[0].depth_m, atol=1e-6)


@pytest.mark.parametrize(
    "content", [b"\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, 'shape': (99999, 99999), }"]
)
def test_arrays_that_claim_to_be_enormous_are_refused(tmp_path: Path, frames: list[Frame], content: bytes) -> None:
    (tmp_path / "depth").mkdir()
    (tmp_path / "depth" / "0.npy").write_bytes(content.ljust(128) + b"\n")
    write_camera(tmp_path, frames[0].camera)
    with pytest.raises(InputError, match=r"0\.npy: is not a readable NPY file"):
        open_sequence(tmp_path)


@pytest.mark.parametrize("kind", NAMES)
def test_names_state_what_images_are(tmp_path: Path, frames: list[Frame], kind: str) -> None:
    depth, colour, mask = NAMES[kind]
    numbers = [7, 8, 9, 10]
    for number, frame in zip(numbers, frames, strict=True):
        ticks = 636000000000000000 + 5000000 * number
        save(tmp_path / depth.format(number, ticks), raw_depth(frame, 1.0))
        if colour is not None and frame.colour is not None:
            save(tmp_path / colour.format(number), frame.colour)
        if mask is not None and frame.mask is not None:
            save(tmp_path / mask.format(number), frame.mask.astype(np.uint8) * 255)
    write_camera(tmp_path, frames[0].camera)
    sequence = open_sequence(tmp_path)
    assert sequence.indices == tuple(numbers)
    for read, wrote in zip(sequence, frames, strict=True):
        np.testing.assert_allclose(read.depth_m, wrote.depth_m, atol=1e-6)
        assert (read.colour is None, read.mask is None) == (colour is None, mask is None)
        if read.colour is not None and wrote.colour is not None:
            assert np.abs(read.colour.astype(float) - wrote.colour).mean() < 3.0
        if read.mask is not None and wrote.mask is not None:
            assert np.count_nonzero(read.mask ^ wrote.mask) <= 0.02 * np.count_nonzero(wrote.mask)
    if kind == "ticks":
        np.testing.assert_allclose(np.diff([frame.time_s for frame in sequence]), 0.5, atol=1e-4)


@pytest.mark.parametrize(
    ("numbers", "step"),
    [
        (range(0, 360, 24), 24),
        (range(0, 361, 30), 30),
        ([0, 45, 90, 180, 225, 270, 315], 45),  # one of them is missing
        (range(0, 360), None),
        (range(0, 150, 10), None),
        (range(0, 400, 8), None),
    ],
)
def test_names_that_look_like_angles_are_said_to(numbers: Sequence[int], step: int | None) -> None:
    said = said_of_angles(numbers)
    assert said == () if step is None else f"in steps of {step}°" in said[0]


def test_a_step_is_asked_for_with_what_the_names_imply(
    tmp_path: Path, frames: list[Frame], capsys: pytest.CaptureFixture[str]
) -> None:
    for angle in range(0, 360, 60):
        save(tmp_path / "depth" / f"{angle}.png", raw_depth(frames[0], 1.0))
    write_camera(tmp_path, frames[0].camera)
    looks = "frame numbers look like angles, in steps of 60°; if they are, give `prior` turntable and `step_deg` 1"
    assert looks in open_sequence(tmp_path).notes
    assert main(["register", str(tmp_path), "60", "0", "--prior", "turntable"]) == 2
    assert "in steps of 60°; if they are, give --prior turntable and --step-deg 1)" in capsys.readouterr().err


@pytest.mark.parametrize("kind", CAMERAS)
def test_lenses_beside_the_intrinsics_are_taken_out(tmp_path: Path, frames: list[Frame], kind: str) -> None:
    name, text = CAMERAS[kind]
    frame, camera = frames[0], replace(frames[0].camera, fx=90.0, fy=90.0)
    assert frame.mask is not None
    assert frame.colour is not None
    save(tmp_path / "depth" / "0.png", distorted(raw_depth(frame, 1.0), camera))
    save(tmp_path / "masks" / "0.png", distorted(frame.mask.astype(np.uint8) * 255, camera))
    colour = [distorted(frame.colour[..., channel], camera) for channel in range(3)]
    save(tmp_path / "rgb" / "0.png", np.stack(colour, axis=2))
    (tmp_path / name).write_text(text(camera, LENS))
    sequence = open_sequence(tmp_path)
    read = sequence.frame(0)
    assert any("-0.28 0.09" in note and "taken out" in note for note in sequence.notes)
    assert read.mask is not None
    assert read.colour is not None
    assert np.count_nonzero(read.mask ^ frame.mask) < 0.1 * np.count_nonzero(frame.mask)
    seen = ~np.isnan(read.depth_m + frame.depth_m + distorted(frame.depth_m, camera))
    for mended, bent, true in (
        (read.depth_m, distorted(frame.depth_m, camera), frame.depth_m),
        (read.colour[..., 0].astype(float), colour[0].astype(float), frame.colour[..., 0].astype(float)),
    ):
        assert np.abs(mended - true)[seen].mean() < 0.4 * np.abs(bent - true)[seen].mean()


def test_a_fisheye_is_taken_out(tmp_path: Path, frames: list[Frame]) -> None:
    camera = replace(frames[0].camera, fx=60.0, fy=60.0)
    w, h = camera.rays()
    angle = np.hypot(w, h)  # of the fisheye's pixels, without coefficients
    stretch = np.tan(angle) / np.maximum(angle, 1e-12)
    slanted = np.rint(1000.0 / (1.0 + 0.3 * w * stretch + 0.2 * h * stretch)).clip(1, 60000)  # of a plane
    save(tmp_path / "depth" / "0.png", slanted.astype(np.uint16))
    write_camera(tmp_path, camera, model="OPENCV_FISHEYE", coeffs=[0, 0, 0, 0])
    read = open_sequence(tmp_path).frame(0).depth_m
    expected = 1.0 / (1.0 + 0.3 * w + 0.2 * h)
    assert float(np.nanquantile(np.abs(read - expected)[30:90, 40:120], 0.99)) < 0.012  # the nearest pixel's


def test_unknown_lenses_are_refused(tmp_path: Path, frames: list[Frame]) -> None:
    save(tmp_path / "depth" / "0.png", raw_depth(frames[0], 1.0))
    write_camera(tmp_path, frames[0].camera, model="division", coeffs=[0.1, 0, 0, 0])
    with pytest.raises(InputError, match="distortion model 'division'"):
        open_sequence(tmp_path)


def test_images_are_paired_by_the_times_in_their_names(tmp_path: Path, frames: list[Frame]) -> None:
    """Colour lags by 11 ms, lacks one image, and has one halfway between two: as many as depth images."""
    for frame in frames:
        time_s = 1700000000.0 + 0.5 * frame.index
        save(tmp_path / "depth" / f"{time_s:.6f}.png", raw_depth(frame, 1.0))
        assert frame.colour is not None
        if frame.index != 1:
            save(tmp_path / "rgb" / f"{time_s + 0.011:.6f}.png", frame.colour)
    assert frames[2].colour is not None
    save(tmp_path / "rgb" / "1700000001.260000.png", frames[2].colour)
    write_camera(tmp_path, frames[0].camera)
    sequence = open_sequence(tmp_path)
    for read, wrote in zip(sequence, frames, strict=True):
        if wrote.index == 1:
            assert read.colour is None
        else:
            np.testing.assert_array_equal(read.colour, wrote.colour)
        assert read.time_s == pytest.approx(1700000000.0 + 0.5 * wrote.index)
    notes = " ".join(sequence.notes)
    assert "by the times in their names, up to 11 ms apart" in notes
    assert "1 of 4 depth images have no colour image" in notes
    assert "1700000001.260000.png" in notes
    (tmp_path / "rgb" / "1700000001.260000.png").unlink()  # then fewer than depth images
    assert [frame.colour is None for frame in open_sequence(tmp_path)] == [False, True, False, False]


MASKS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "soft": lambda mask: ndimage.gaussian_filter(mask * 255.0, 2.0),
    "veiled": lambda mask: np.where(mask, 255.0, 2.0),
    "half veiled": lambda mask: np.where(mask, 255.0, np.where(np.arange(160) < 80, 2.0, 0.0)),
    "labels": lambda mask: mask * 3.0,
    "two labels": lambda mask: mask * np.where(np.arange(160) < 80, 1.0, 2.0),
}


@pytest.mark.parametrize("kind", MASKS)
@pytest.mark.parametrize("channels", [1, 3])
def test_masks_count_from_the_middle_of_their_range(
    tmp_path: Path, frames: list[Frame], kind: str, channels: int
) -> None:
    mask = frames[0].mask
    assert mask is not None
    grey = MASKS[kind](mask).astype(np.uint8)
    save(tmp_path / "depth" / "0.png", raw_depth(frames[0], 1.0))
    save(tmp_path / "masks" / "0.png", grey if channels == 1 else np.repeat(grey[..., None], 3, axis=2))
    write_camera(tmp_path, frames[0].camera)
    sequence = open_sequence(tmp_path)
    read = sequence.frame(0).mask
    assert read is not None
    outer, inner = (grow(mask, iterations=2) for grow in (ndimage.binary_dilation, ndimage.binary_erosion))
    rim = np.not_equal(outer, inner)
    np.testing.assert_array_equal(read[~rim] if kind == "soft" else read, mask[~rim] if kind == "soft" else mask)
    assert any("brighter half" in note for note in sequence.notes) == ("labels" not in kind)


@pytest.mark.parametrize("kind", ["cut out", "palette"])
def test_cut_out_objects_and_labels_of_a_palette_are_masks(tmp_path: Path, frames: list[Frame], kind: str) -> None:
    mask, colour = frames[0].mask, frames[0].colour
    assert mask is not None
    assert colour is not None
    labels = Image.fromarray(mask.astype(np.uint8), mode="P")
    labels.putpalette([0, 0, 0, 128, 0, 0])
    picture = Image.fromarray(np.dstack([colour, mask.astype(np.uint8) * 255])) if kind == "cut out" else labels
    save(tmp_path / "depth" / "0.png", raw_depth(frames[0], 1.0))
    (tmp_path / "masks").mkdir()
    picture.save(tmp_path / "masks" / "0.png")
    write_camera(tmp_path, frames[0].camera)
    np.testing.assert_array_equal(open_sequence(tmp_path).frame(0).mask, mask)


def test_masks_of_measured_pixels_hold_what_lies_between(frames: list[Frame], rng: np.random.Generator) -> None:
    """Nine of ten measurements are missing, and the mask is made of those that are there."""
    frame = frames[0]
    assert frame.mask is not None
    kept = rng.random(frame.depth_m.shape) < 0.1
    sparse = replace(frame, depth_m=np.where(kept, frame.depth_m, np.float32(np.nan)))
    segmenter = Segmenter(min_points=20)

    def found(mask: np.ndarray) -> np.ndarray:
        masked = replace(sparse, mask=mask)
        return segmenter.segment(masked, segmenter.scene([masked])).mask

    points, whole = found(frame.mask & kept & (frame.depth_m > 0.0)), found(frame.mask)
    assert np.count_nonzero(points & whole) > 0.6 * np.count_nonzero(whole)  # to the outermost measurements
    assert np.count_nonzero(points & ~whole) < 0.1 * np.count_nonzero(whole)


def test_depth_that_its_camera_does_not_trust_is_left_out(tmp_path: Path, frames: list[Frame]) -> None:
    """Stray Scanner: intrinsics of colour of 1920 x 1440, whose view depth has in fewer pixels."""
    camera, confidence = frames[0].camera, np.full((120, 160), 2, np.uint8)
    confidence[:, :40] = 0
    save(tmp_path / "depth" / "000000.png", raw_depth(frames[0], 1.0))
    save(tmp_path / "confidence" / "000000.png", confidence)
    matrix = f"{12 * camera.fx}, 0.0, 960.0\n0.0, {12 * camera.fy}, 720.0\n0.0, 0.0, 1.0\n"
    (tmp_path / "camera_matrix.csv").write_text(matrix)
    read = open_sequence(tmp_path).frame(0)
    assert read.camera.fx == pytest.approx(camera.fx)
    assert read.camera.cx == pytest.approx(79.5, abs=0.1)
    assert np.isnan(read.depth_m[:, :40]).all()
    np.testing.assert_allclose(read.depth_m[:, 40:], frames[0].depth_m[:, 40:], atol=1e-6)


def test_files_of_yaml_without_a_camera_are_passed_over(tmp_path: Path, frames: list[Frame]) -> None:
    save(tmp_path / "depth" / "0.png", raw_depth(frames[0], 1.0))
    (tmp_path / "config.yaml").write_text("exposure: 3\n")
    with pytest.raises(InputError, match="no intrinsics"):
        open_sequence(tmp_path)
    (tmp_path / "broken.yaml").write_text("a: [1, 2")
    with pytest.raises(InputError, match=r"broken\.yaml: is not valid YAML"):
        open_sequence(tmp_path)
    read = open_sequence(tmp_path, Overrides(intrinsics=(100.0, 101.0, 80.0, 60.0)))
    assert survey(read).cameras[0].fy == 101.0
