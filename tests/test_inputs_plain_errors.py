"""Inputs that are plainly not what they seem are refused in one line, and used on request."""

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from modeler.cli import main
from modeler.cli.convert import of_the_scene
from modeler.sequences import Overrides, Survey, bundled, open_sequence, survey, write_bop
from modeler.sequences.calibrated import AxialSequence, stretch
from modeler.sequences.ros.messages import from_rvl
from modeler.types import Camera, Frame, InputError
from modeler.views.rays import part_of
from studies.formats.image_folders import raw_depth, save

CAMERA = Camera(320, 240, 280.0, 280.0, 159.5, 119.5)


def colour_as(colour: np.ndarray, *, mirrored: bool, scale: float, shift_px: tuple[float, float]) -> np.ndarray:
    """Return colour as another camera, or another program, shows it."""
    image = Image.fromarray(colour[:, ::-1] if mirrored else colour)
    (width, height), (x, y) = image.size, shift_px
    across, down = width / 2 * (1 - 1 / scale) - x / scale, height / 2 * (1 - 1 / scale) - y / scale
    return np.asarray(image.transform(image.size, Image.Transform.AFFINE, (1 / scale, 0, across, 0, 1 / scale, down)))


def cards(
    folder: Path,
    *,
    mirrored: bool = False,
    upside_down: bool = False,
    scale: float = 1.0,
    shift_px: tuple[float, float] = (0.0, 0.0),
) -> Survey:
    """Return the survey of cards of one colour each before a wall, other ones in every frame."""
    rng, frames = np.random.default_rng(3), []
    for index in range(6):
        depth_m = np.full((240, 320), 1.5, np.float32)
        colour = np.full((240, 320, 3), 90, np.uint8)
        for _ in range(5):
            row, column, height, width = rng.integers((20, 20, 20, 20), (180, 250, 60, 70))
            depth_m[row : row + height, column : column + width] = rng.uniform(0.7, 1.2)
            colour[row : row + height, column : column + width] = rng.integers(0, 256, 3)
        colour = colour[::-1, ::-1] if upside_down else colour
        seen = colour_as(colour, mirrored=mirrored, scale=scale, shift_px=shift_px)
        frames.append(Frame(index, float(index), depth_m, CAMERA, None, seen))
    write_bop(folder, frames)
    return survey(open_sequence(folder))


def test_aligned_colour_is_accepted(tmp_path: Path) -> None:
    assert cards(tmp_path / "s").misaligned is None


def test_shifted_colour_is_reported_by_how_much(tmp_path: Path) -> None:
    found = cards(tmp_path / "s", shift_px=(20.0, -12.0))
    assert not found.misaligned.flip
    assert found.misaligned.scale == (1.0, 1.0)
    assert found.misaligned.shift_px == pytest.approx((20.0, -12.0), abs=2.0)
    with pytest.raises(InputError, match="colour is shifted by about"):
        found.check("cards")
    found.check("cards", despite_doubts=True)


def test_colour_of_another_lens_is_reported(tmp_path: Path) -> None:
    found = cards(tmp_path / "s", scale=1.25, shift_px=(-12.0, 0.0))
    assert found.misaligned.scale == pytest.approx((1.25, 1.25), abs=0.05)
    assert found.misaligned.shift_px == pytest.approx((-12.0, 0.0), abs=4.0)


def test_distance_along_the_ray_is_reported_and_mended(tmp_path: Path, refusal: Callable[..., str]) -> None:
    whole = open_sequence(bundled("box"))
    camera = whole.frame(0).camera
    for index in whole.indices[:3]:
        frame = whole.frame(index)
        bent = replace(frame, depth_m=(frame.depth_m * stretch(camera)).astype(np.float32))
        save(tmp_path / "s" / "depth" / f"{index}.png", raw_depth(bent, 0.1))
    facts = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy, "depth_scale": 0.1}
    (tmp_path / "s" / "camera.json").write_text(json.dumps(facts))
    said = refusal("convert", tmp_path / "s", "--out", tmp_path / "bop")
    assert "distance along the ray" in said
    assert "--along-ray" in said
    assert main(["convert", str(tmp_path / "s"), "--out", str(tmp_path / "bop"), "--along-ray"]) == 0
    for read, wrote in zip(open_sequence(tmp_path / "bop"), whole, strict=False):
        np.testing.assert_allclose(read.depth_m, wrote.depth_m, atol=2e-4)
    mended = open_sequence(tmp_path / "s", Overrides(along_ray=True))
    assert isinstance(mended, AxialSequence)
    assert not survey(mended).doubts
    assert not survey(whole.select(frames=slice(0, 3))).plain_errors


def doubts_of(folder: Path, *, noise: float = 0.0, from_column: int = 0) -> list[str]:
    """Return the doubts of `info` about the bundled box, with more noise, or seen from some column of the images on."""
    rng, frames = np.random.default_rng(0), []
    for frame in open_sequence(bundled("box")):
        half = part_of(replace(frame, mask=None, colour=None), slice(None, None, 2), slice(from_column, None, 2))
        scatter = 1.0 + noise * rng.standard_normal(half.depth_m.shape).astype(np.float32)
        frames.append(replace(half, depth_m=(half.depth_m * scatter).astype(np.float32)))
    write_bop(folder, frames)
    sequence = open_sequence(folder)
    return [*survey(sequence).doubts, *of_the_scene(sequence)]


def test_doubts_are_what_is_wrong_with_a_capture(tmp_path: Path) -> None:
    assert doubts_of(tmp_path / "right") == []
    assert doubts_of(tmp_path / "noisy", noise=0.02)[0].startswith("depth scatters by 2.0% of the distance")
    whole = open_sequence(bundled("box")).frame(0)
    assert whole.mask is not None
    middle = int(np.median(np.nonzero(whole.mask)[1]))
    assert "the image cuts off the object" in doubts_of(tmp_path / "cut", from_column=middle)[-1]


def test_the_gravest_doubt_comes_first(tmp_path: Path) -> None:
    found = replace(cards(tmp_path / "s", mirrored=True), range_m=(0.01, 0.02, 0.03), repeated=(1,), noise=0.1)
    words = ("is the unit right?", "colour is mirrored", "depth scatters", "have the depth of the frame before")
    assert len(found.doubts) == len(words)
    for doubt, some in zip(found.doubts, words, strict=True):
        assert some in doubt


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda facts: facts | {"depth_scale": 0.1 * facts["depth_scale"]}, "is the unit right?"),
        (lambda facts: facts | {"depth_scale": 10.0 * facts["depth_scale"]}, "is the unit right?"),
        (lambda facts: facts | {"cx": facts["cy"], "cy": facts["cx"]}, "are cx and cy exchanged?"),
        (lambda facts: {name: 2.0 * value for name, value in facts.items()} | {"depth_scale": 1.0}, "of another size?"),
    ],
)
def test_units_and_principal_points_that_are_plainly_wrong_are_refused(
    tmp_path: Path, frames: list[Frame], refusal: Callable[..., str], change: Callable[[dict], dict], says: str
) -> None:
    folder, camera = tmp_path / "s", frames[0].camera
    facts = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy, "depth_scale": 1.0}
    for frame in frames:
        save(folder / "depth" / f"{frame.index}.png", raw_depth(frame, 1.0))
    (folder / "camera.json").write_text(json.dumps(facts))
    assert not survey(open_sequence(folder)).plain_errors
    (folder / "camera.json").write_text(json.dumps(change(facts)))
    (error,) = survey(open_sequence(folder)).plain_errors
    assert says in error
    for command in (["build"], ["track", bundled("box") / "model.ply"]):
        said = refusal(*command, folder, "--out", tmp_path / "run")
        assert said.endswith("(or --despite-doubts)\n")
        assert says in said
    given = Overrides((camera.fx, camera.fy, camera.cx, camera.cy), change(facts)["depth_scale"])
    assert not survey(open_sequence(folder, given)).plain_errors


def test_images_cut_out_anywhere_are_doubted_at_most(tmp_path: Path, frames: list[Frame]) -> None:
    camera = frames[0].camera
    for frame in frames:
        save(tmp_path / "depth" / f"{frame.index}.png", raw_depth(frame, 1.0))
    for cx, cy in ((-0.2, 0.7), (1.4, 0.5), (0.5, -0.3), (1.2, 1.0)):
        facts = {"fx": camera.fx, "fy": camera.fy, "cx": cx * camera.width, "cy": cy * camera.height}
        (tmp_path / "camera.json").write_text(json.dumps({**facts, "depth_scale": 1.0}))
        found = survey(open_sequence(tmp_path))
        assert "principal point" in " ".join(found.doubts)
        assert not found.plain_errors


def packed(image: np.ndarray) -> bytes:
    """Pack depth by RVL, number by number, as Wilson's program does."""
    values, groups, at, before = image.ravel().astype(int).tolist(), [], 0, 0

    def put(number: int) -> None:
        while True:
            more = number >> 3
            groups.append((number & 7) | (8 if more else 0))
            if not more:
                return
            number = more

    while at < len(values):
        empty = at
        while at < len(values) and values[at] == 0:
            at += 1
        filled = at
        while at < len(values) and values[at] != 0:
            at += 1
        put(filled - empty)
        put(at - filled)
        for value in values[filled:at]:
            step, before = value - before, value
            put((step << 1) ^ (step >> 31))
    groups += [0] * (-len(groups) % 8)
    words = [
        sum(group << (28 - 4 * place) for place, group in enumerate(groups[start : start + 8]))
        for start in range(0, len(groups), 8)
    ]
    return struct.pack(f"<II{len(words)}I", image.shape[1], image.shape[0], *words)


def test_images_packed_by_rvl_are_read(frames: list[Frame], rng: np.random.Generator) -> None:
    for image in (
        raw_depth(frames[0], 1.0),
        rng.integers(0, 65536, (7, 5)).astype(np.uint16),
        np.zeros((3, 4), np.uint16),
        (rng.random((40, 50)) < 0.5).astype(np.uint16) * 900,
    ):
        data = packed(image)
        np.testing.assert_array_equal(from_rvl(data, "bag"), image)
        if image.any():
            with pytest.raises(InputError, match="cut off"):
                from_rvl(data[: 8 + (len(data) - 8) // 8 * 4], "bag")
    with pytest.raises(InputError, match="has 0 x 0 pixels"):
        from_rvl(b"", "bag")


@pytest.mark.parametrize(
    ("mirrored", "upside_down", "flip"),
    [(True, False, "mirrored"), (False, True, "upside down"), (True, True, "flipped top to bottom")],
)
def test_flipped_colour_is_reported(tmp_path: Path, *, mirrored: bool, upside_down: bool, flip: str) -> None:
    found = cards(tmp_path / "s", mirrored=mirrored, upside_down=upside_down)
    assert (found.misaligned.flip, found.misaligned.is_sure) == (flip, True)
    assert found.doubts[0].startswith(f"colour is {flip}")


def test_colour_without_anything_to_see_is_no_error(tmp_path: Path, rng: np.random.Generator) -> None:
    """Noise has edges everywhere, and one colour has none."""
    for name, noise in (("plain", 0.0), ("noisy", 20.0)):
        frames = []
        for index in range(6):
            depth_m = np.full((240, 320), 1.5, np.float32)
            depth_m[60 + index : 160, 100 : 200 - 3 * index] = 1.0
            colour = np.clip(90.0 + noise * rng.normal(size=(240, 320, 3)), 0, 255).astype(np.uint8)
            frames.append(Frame(index, float(index), depth_m, CAMERA, None, colour))
        write_bop(tmp_path / name, frames)
        assert not survey(open_sequence(tmp_path / name)).plain_errors
