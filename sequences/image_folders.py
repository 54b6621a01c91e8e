"""Folders of depth and colour images, or with a video of colour: Open3D, BundleSDF, Stray Scanner and others."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np

from modeler import se3
from modeler.sequences.file_names import frame_numbers, partners, role_of, said_of_angles, stamps_s
from modeler.sequences.image_files import (
    COLOUR_SUFFIXES,
    DEPTH_SUFFIXES,
    MASK_SUFFIXES,
    check_same_size,
    check_size,
    depth_size,
    float_unit_mm,
    graded,
    image_size,
    is_finer,
    is_swapped,
    metres,
    no_depth,
    read_colour,
    read_depth,
    read_mask,
    read_masks,
    resize_to_depth,
)
from modeler.sequences.input_files import (
    entries,
    first_folder,
    frame_number,
    is_there,
    list_images,
    listed,
    read_text,
    read_tree,
)
from modeler.sequences.intrinsics import CameraFacts, Intrinsics, Overrides, cameras_of_frames, find_intrinsics
from modeler.sequences.lens import Lens
from modeler.sequences.recording import AbstractRecording
from modeler.sequences.videos import Video, can_decode
from modeler.system.processes import install_command
from modeler.types import Array, Camera, Frame, InputError


@dataclass(frozen=True, slots=True)
class FrameFiles:
    """Files of one frame."""

    time_s: float
    """Time of capture in s."""
    depth: Path
    colour: Path | None = None
    """Colour aligned to depth, in its size or finer."""
    mask: Path | None = None
    """Non-zero = object, `OCCLUDED` = something before it."""
    occluder: Path | None = None
    """Non-zero = something before the object."""
    confidence: Path | None = None
    """0 = depth that its camera does not trust, and that is left out."""
    intrinsics: Intrinsics | None = None
    """fx, fy, cx, cy in px of this frame; None: those of the sequence."""


@dataclass(frozen=True)
class ImageFolderSequence(AbstractRecording):
    """Image files of one camera."""

    files: Mapping[int, FrameFiles]
    """By frame number, ascending."""
    camera: CameraFacts
    depth_scale_mm: float
    """Millimetres per unit of depth."""
    what: str
    """Storage format, for people."""
    unit_source: str
    read_truth: Callable[[], dict[int, Array] | None] = lambda: None
    """Reads the true camera_from_model (4, 4) in m by frame number, when it is asked for."""
    video: Video | None = None
    """Colour by frame number, where it is no files."""

    @property
    def indices(self) -> tuple[int, ...]:
        return tuple(self.files)

    def frame(self, index: int) -> Frame:
        files = self.files.get(index)
        if files is None:
            raise self.absent(index)
        raw = read_depth(files.depth)
        check_same_size(
            files.depth, raw.shape, self._first, "and one camera took them all; convert each size by itself"
        )
        mask, occluder = read_masks(files.mask, files.occluder, raw.shape)
        colour = None if files.colour is None else read_colour(files.colour)
        if self.video is not None:
            colour = self.video.image(index)
        if colour is not None:
            colour = resize_to_depth(files.colour or self.path / VIDEO, colour, raw.shape)
        depth_m = metres(raw, self.depth_scale_mm)
        if files.confidence is not None:
            trusted = read_mask(files.confidence)
            check_size(files.confidence, trusted.shape, raw.shape)
            depth_m[~trusted] = np.nan
        lens, camera = self._lens, self._lens.camera
        if files.intrinsics is not None:
            camera = Camera(camera.width, camera.height, *files.intrinsics)
            lens = replace(lens, camera=camera)
        if lens.is_distorted:
            depth_m = lens.undistort(depth_m, float("nan"))
            mask, occluder = (None if image is None else lens.undistort(image) for image in (mask, occluder))
            colour = None if colour is None else lens.undistort(colour)
        return Frame(index, files.time_s, depth_m, camera, mask, colour, occluder)

    @property
    def _first(self) -> Path:
        return self.files[self.indices[0]].depth

    @cached_property
    def _lens(self) -> Lens:
        return self.camera.lens(depth_size(self._first))

    def truth(self) -> dict[int, Array] | None:
        return self.read_truth()

    @property
    def layout(self) -> str:
        return self.what

    @property
    def depth_unit(self) -> str:
        return f"{self.depth_scale_mm:g} mm ({self.unit_source})"

    @property
    def notes(self) -> tuple[str, ...]:
        said = list(self.remarks)
        coloured = next((files for files in self.files.values() if files.colour is not None), None)
        if coloured is not None and coloured.colour is not None:
            colour, depth = image_size(coloured.colour), depth_size(coloured.depth)
            if is_finer(colour, depth):
                sizes = f"{colour[0]} x {colour[1]} where depth is {depth[0]} x {depth[1]}"
                said.append(f"colour is {sizes}: it is shrunk, and taken for the depth camera's view")
        masked = next((files.mask for files in self.files.values() if files.mask is not None), None)
        if masked is not None and graded(masked):
            said.append("masks are graded from black to white: the brighter half of the range counts as object")
        return tuple(said)


DEPTH_FOLDERS = ("depth", "aligned_depth_to_color", "aligned_depth", "depth_images")
COLOUR_FOLDERS = ("color", "rgb", "colour", "image", "images")
MASK_FOLDERS = ("masks", "mask")
OCCLUDER_FOLDERS = ("mask_hand", "masks_hand")
CONFIDENCE_FOLDERS = ("confidence",)
POSES = "annotated_poses"


@dataclass(frozen=True)
class FoundImages:
    """Images of a folder by role and name, in order of their names."""

    depth: Mapping[str, Path]
    """At least one."""
    colour: Mapping[str, Path] = field(default_factory=dict)
    masks: Mapping[str, Path] = field(default_factory=dict)
    occluders: Mapping[str, Path] = field(default_factory=dict)
    """Masks of hands."""
    confidence: Mapping[str, Path] = field(default_factory=dict)


def images_within(path: Path, names: tuple[str, ...], suffixes: tuple[str, ...]) -> dict[str, Path]:
    """Return the images, by stem, in the first of some folders that is there."""
    folder = first_folder(path, names)
    return {} if folder is None else list_images(folder, suffixes)


def images_in_folders(path: Path) -> FoundImages:
    """Return the images in the folders `depth`, `rgb`, `masks` and others of such names."""
    folder = first_folder(path, DEPTH_FOLDERS) or path / DEPTH_FOLDERS[0]
    depth = list_images(folder, DEPTH_SUFFIXES)
    if not depth:
        raise no_depth(folder, "16-bit PNG or TIFF images")
    return FoundImages(
        depth,
        images_within(path, COLOUR_FOLDERS, COLOUR_SUFFIXES),
        images_within(path, MASK_FOLDERS, MASK_SUFFIXES),
        images_within(path, OCCLUDER_FOLDERS, MASK_SUFFIXES),
        images_within(path, CONFIDENCE_FOLDERS, MASK_SUFFIXES),
    )


def images_in_one_folder(path: Path) -> FoundImages | None:
    """Return the images of a folder in which names state what they are, as in `7_depth.png`; None without depth."""
    by_role: dict[str, dict[str, Path]] = {}
    for image in entries(path):
        suffix = image.suffix.lower()
        if image.name.startswith(".") or suffix not in (*DEPTH_SUFFIXES, *COLOUR_SUFFIXES):
            continue
        role, name = role_of(image.stem)
        role = role or "colour"
        if suffix in (DEPTH_SUFFIXES if role == "depth" else COLOUR_SUFFIXES):
            named = by_role.setdefault(role, {})
            if name in named:
                raise InputError(f"{image}: there is {named[name].name} too; remove one of them.")
            named[name] = image
    if "depth" not in by_role:
        return None
    return FoundImages(
        by_role["depth"], by_role.get("colour", {}), by_role.get("mask", {}), {}, by_role.get("confidence", {})
    )


def images_of_transforms(path: Path) -> FoundImages | None:
    """Return the images that nerfstudio's `transforms.json` lists; None if it lists no depth."""
    if not is_there(path / "transforms.json"):
        return None
    frames = read_tree(path / "transforms.json").get("frames")
    shown = [] if frames is None else [frame for frame in frames.elements() if frame.get("depth_file_path")]
    if not shown:
        return None

    def named(key: str) -> dict[str, Path]:
        return {
            Path(frame.need("depth_file_path").text()).stem: listed(path / "transforms.json", entry.text())
            for frame in shown
            if (entry := frame.get(key)) is not None
        }

    return FoundImages(named("depth_file_path"), named("file_path"), named("mask_path"))


SEVEN_SCENES = (585.0, 585.0, 320.0, 240.0)
"""Intrinsics that the authors of 7-Scenes recommend for its depth images of 640 x 480."""


def open_colour_depth(path: Path, found: FoundImages, overrides: Overrides) -> ImageFolderSequence:
    """Open a folder with depth images and intrinsics, and where they are there, colour, masks and masks of hands.

    Depth of whole numbers is in mm unless the file of intrinsics or the user gives another unit.
    """
    depth, first = found.depth, next(iter(found.depth.values()))
    size = depth_size(first)
    facts = find_intrinsics(path, overrides)
    each = cameras_of_frames(path, depth, size) if facts is None else {}
    facts = next(iter(each.values()), facts)
    if facts is None and _is_seven_scenes(first) and size == (640, 480):
        facts = CameraFacts(SEVEN_SCENES, "7-Scenes")
    if facts is None:
        raise InputError(
            f"{path}: no intrinsics; add camera.json with fx, fy, cx and cy in px, cam_K.txt (three rows of K), "
            "camera_intrinsic.json (Open3D's) or scene_camera.json (BOP's), or convert with `intrinsics` FX FY CX CY."
        )
    facts = facts.scaled(size)
    numbers = frame_numbers(list(depth)) or {stem: place for place, stem in enumerate(depth)}
    times_s = stamps_s(list(depth)) or {}
    remarks = [*facts.remarks(size), *said_of_angles(numbers.values())]
    roles = {
        "colour images": found.colour,
        "masks": found.masks,
        "masks of hands": found.occluders,
        "confidence images": found.confidence,
    }
    belonging: dict[str, dict[str, Path]] = {}
    for what, images in roles.items():
        belonging[what], left, said = partners(images, depth, what)
        lacking = sum(stem not in belonging[what] for stem in depth)
        remarks += said
        if belonging[what] and lacking and what != "masks of hands":  # not every frame has a hand
            remarks.append(f"{lacking} of {len(depth)} depth images have no {what.removesuffix('s')}")
        if left:
            remarks.append(f"{len(left)} {what} belong to no depth image and are left out ({left[0].name})")
    colour, masks, occluders, confidence = belonging.values()
    if confidence:
        remarks.append("depth of confidence 0 is left out")
    files = {
        numbers[stem]: FrameFiles(
            times_s.get(stem, float(numbers[stem])),
            image,
            colour.get(stem),
            masks.get(stem),
            occluders.get(stem),
            confidence.get(stem),
            each[stem].intrinsics if each else None,
        )
        for stem, image in depth.items()
    }
    video = None
    if not found.colour and is_there(path / VIDEO) and can_decode():
        video = Video(path / VIDEO)
        remarks.append(f"colour is that of {VIDEO}, its images counted as depth images are")
    elif not found.colour and is_there(path / VIDEO):
        remarks.append(f"colour of {VIDEO} is not read: {install_command('phones')}")
    unit_mm, who = facts.unit(overrides, (1.0, "the default"))
    raw = read_depth(first)
    if is_swapped(raw):
        raise InputError(
            f"{first}: has the two bytes of its values exchanged: neighbouring pixels differ less once they are "
            "swapped back; save depth again, in the byte order that the format demands."
        )
    if raw.dtype == np.uint16 and (nothing := float(np.mean(raw == np.iinfo(np.uint16).max))) > 0.0:
        remarks.append(f"65535, {nothing:.1%} of the first depth image, stands for no measurement")
    if overrides.depth_scale_mm is None and (float_mm := float_unit_mm(raw)) is not None:
        unit_mm, who = float_mm, "by its values"
    return ImageFolderSequence(
        path,
        files=dict(sorted(files.items())),
        camera=facts,
        depth_scale_mm=unit_mm,
        what=_layout(path, first),
        unit_source=who,
        read_truth=lambda: _posed_truth(path, numbers),
        remarks=tuple(remarks),
        calibrated=facts.calibrated,
        kind="tof" if facts.of_phone else None,
        video=video,
    )


VIDEO: Final = "rgb.mp4"  # Stray Scanner's, of the same view as depth


def _is_seven_scenes(depth: Path) -> bool:
    return depth.name.endswith(".depth.png") and is_there(depth.with_name(depth.name.replace(".depth.", ".pose.", 1)))


def _layout(path: Path, depth: Path) -> str:
    """Return the name of a folder's layout, of which one depth image is given."""
    if (path / "cam_K.txt").exists() and first_folder(path, (*MASK_FOLDERS, POSES)) is not None:
        return "BundleSDF folder"
    if (path / "camera_intrinsic.json").exists():
        return "Open3D folder"
    return "folder of pictures" if depth.parent != path else "folder of pictures named by what they show"


def _posed_truth(root: Path, numbers: Mapping[str, int]) -> dict[int, Array] | None:
    """Return camera_from_model by frame number from BundleSDF's or Open3D's pose files; None without."""
    posed = {path.stem: path for path in entries(root / POSES) if path.suffix == ".txt"}
    if posed:
        found = {number: _pose(posed[stem]) for stem, number in numbers.items() if stem in posed}
        return dict(sorted(found.items())) or None
    log = next((path for path in (root / "trajectory.log", root / "scene" / "trajectory.log") if is_there(path)), None)
    if log is None:
        return None
    rows = [line.split() for line in read_text(log).splitlines() if line.strip()]
    heads, places = rows[::5], sorted(numbers.values())
    if len(rows) % 5 or not all(len(head) == 3 and frame_number(head[0]) is not None for head in heads):
        raise InputError(f"{log}: is no trajectory; each pose is a line 'i i n' and four rows of its matrix.")
    poses: dict[int, Array] = {}
    for place, head in enumerate(heads):
        if int(head[0]) < len(places):
            poses[places[int(head[0])]] = se3.inverse(_rigid(rows[5 * place + 1 : 5 * place + 5], log))
    return dict(sorted(poses.items())) or None


def _pose(path: Path) -> Array:
    return _rigid([line.split() for line in read_text(path).splitlines() if line.strip()], path)


def _rigid(rows: list[list[str]], path: Path) -> Array:
    """Return the rigid motion (4, 4) that four rows of text are."""
    try:
        matrix = np.array(rows, dtype=np.float64)
    except ValueError:
        matrix = np.zeros(0)
    if matrix.shape == (4, 4) and se3.is_rigid(matrix, tolerance=1e-2):
        return matrix
    raise InputError(f"{path}: is no rigid motion; write four rows of four numbers, the last 0 0 0 1.")
