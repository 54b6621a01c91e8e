"""Sequences in the layout of the BOP benchmark (its `bop_datasets_format.md`): one scene folder, one object."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.sequences.base import AbstractSequence
from modeler.sequences.image_files import (
    COLOUR_SUFFIXES,
    check_same_size,
    check_size,
    metres,
    no_depth,
    read_colour,
    read_depth,
    read_masks,
    write_image,
)
from modeler.sequences.input_files import Node, entries, first_folder, frame_number, is_there, read_tree
from modeler.sequences.intrinsics import RANGE, Intrinsics, Overrides, of_matrix
from modeler.sequences.meshes import Mesh, read_mesh
from modeler.sequences.recording import AbstractRecording
from modeler.system.regular_files import json_lines, left_behind
from modeler.types import Array, BoolArray, Camera, Frame, InputError


def intrinsics(node: Node) -> Intrinsics:
    """Return (fx, fy, cx, cy) in px of one entry of `scene_camera.json`."""
    entry = node.need("cam_K")
    found = of_matrix(entry.numbers(9).reshape(3, 3))
    if found is None:
        raise entry.fault(f"[fx, 0, cx, 0, fy, cy, 0, 0, 1] in px, {RANGE}")
    return found


def depth_scale_mm(node: Node) -> float:
    """Return the millimetres per unit of depth of one entry of `scene_camera.json`."""
    return node.need("depth_scale").number(1e-6, 100.0)


def camera_from_model(node: Node) -> Array:
    """Return the pose (4, 4), in m, of one object of `scene_gt.json`."""
    rotation = node.need("cam_R_m2c").rotation()
    return se3.rigid(rotation, node.need("cam_t_m2c").numbers(3) / 1000.0)


def _occluder_names(stem: str) -> tuple[str, str]:
    """Return the names that the mask of an occluder may have, given that of the depth image without its suffix."""
    return f"{stem}.png", f"{stem}_000000.png"


def pose_entry(pose: Array) -> dict[str, object]:
    """Return the entry of `scene_gt.json` for camera_from_model (4, 4) in m."""
    rotation, shift = pose[:3, :3].ravel(), pose[:3, 3] * 1000.0
    return {"cam_R_m2c": [float(v) for v in rotation], "cam_t_m2c": [float(v) for v in shift], "obj_id": 1}


MASKS = "mask_visib"  # folder of the masks
OCCLUDERS = "mask_hand"  # folder of the masks of occluders: a hand, a gripper


@dataclass(frozen=True)
class BopSequence(AbstractRecording):
    """A BOP scene folder, the onboarding layouts among them.

    Of several objects the first (`mask_visib/*_000000.png`, first ground truth) counts.
    Opening checks the layout, the intrinsics and `sequence.json`; images and ground truth are read on demand.
    """

    overrides: Overrides = field(default_factory=Overrides)
    """Values that take precedence over the files."""

    def __post_init__(self) -> None:
        """Check everything that can be checked without decoding an image."""
        _ = self._depth_paths, self._intrinsics, self._times_s, self.name, self.sensor(), self.motion

    @property
    def indices(self) -> tuple[int, ...]:
        return tuple(self._depth_paths)

    def frame(self, index: int) -> Frame:
        if index not in self._depth_paths:
            raise self.absent(index)
        path = self._depth_paths[index]
        raw = read_depth(path)
        matrix, scale_mm = self._intrinsics[index]
        alike = self._depth_paths[self._first_with[matrix]]
        if alike != path:
            check_same_size(path, raw.shape, alike, "with the same cam_K; give each size its own in scene_camera.json")
        camera = Camera(raw.shape[1], raw.shape[0], *matrix)
        mask, occluder = self._masks(index, raw.shape)
        colour = self._colour(index, raw.shape)
        return Frame(index, self._times_s[index], metres(raw, scale_mm), camera, mask, colour, occluder)

    def truth(self) -> dict[int, Array] | None:
        path = self.path / "scene_gt.json"
        if not is_there(path):
            return None
        objects = {index: node.elements() for index, node in read_tree(path).frames().items()}
        firsts = {index: objects[index][0] for index in self.indices if objects.get(index)}
        names = {
            index: json.dumps(node.items()["obj_id"].value) for index, node in firsts.items() if node.get("obj_id")
        }
        for index, name in names.items():
            at = next(iter(names))
            if name != names[at]:
                raise InputError(
                    f"{path}: the first object of frame {at} is {names[at]}, of frame {index} {name}; "
                    "list the same object first in every frame."
                )
        return {index: camera_from_model(node) for index, node in firsts.items()} or None

    @property
    def layout(self) -> str:
        return "BOP scene folder"

    @property
    def depth_unit(self) -> str:
        scales = sorted({scale for _, scale in self._intrinsics.values()})
        source = "scene_camera.json" if self.overrides.depth_scale_mm is None else "`depth_scale_mm`"
        return f"{' or '.join(f'{scale:g}' for scale in scales[:3])} mm ({source})"

    @property
    def notes(self) -> tuple[str, ...]:
        notes = []
        left = [index for index in self._colour_paths if index not in self._depth_paths]
        if left:
            some = "1 colour image has" if len(left) == 1 else f"{len(left)} colour images have"
            notes.append(f"{some} no depth image, left out")
        stems = {path.stem for path in self._depth_paths.values()}
        masks = [path for path in entries(self.path / MASKS) if path.suffix.lower() == ".png"]
        strange = [path.name for path in masks if re.sub(r"_\d+$", "", path.stem) not in stems]
        if strange:
            expected = f"{next(iter(self._depth_paths.values())).stem}_000000.png"
            notes.append(
                f"{len(strange)} of {len(masks)} masks belong to no depth image and are left out ({strange[0]}; a name "
                f"such as {expected} is expected)"
            )
        elif not masks and (other := first_folder(self.path, ("mask", "masks"))) is not None:
            notes.append(f"masks are read from {MASKS}/; those in {other.name}/ are left out")
        hands = [path.name for path in entries(self.path / OCCLUDERS)]
        readable = {name for stem in stems for name in _occluder_names(stem)}
        unread = [name for name in hands if name not in readable]
        if unread:
            notes.append(
                f"{len(unread)} of {len(hands)} files in {OCCLUDERS}/ belong to no depth image and are left out "
                f"({unread[0]}; a name such as {min(readable)} is expected)"
            )
        scales = {scale for _, scale in self._intrinsics.values()}
        if len(scales) > 1:
            notes.append(
                f"depth_scale differs from frame to frame, from {min(scales):g} to {max(scales):g} mm per unit: is "
                "every one right?"
            )
        return tuple(notes)

    @cached_property
    def _depth_paths(self) -> dict[int, Path]:
        if not self.path.is_dir():
            raise InputError(f"{self.path}: no such folder; give a BOP scene folder with depth/ and scene_camera.json.")
        paths = _numbered(self.path, "depth", (".png", ".tif", ".tiff"))
        if not paths:
            raise no_depth(self.path / "depth", "000000.png, 000001.png, ...", "16-bit PNG and TIFF")
        return dict(sorted(paths.items()))

    @cached_property
    def _colour_paths(self) -> dict[int, Path]:
        return _numbered(self.path, "rgb", COLOUR_SUFFIXES) or _numbered(self.path, "gray", COLOUR_SUFFIXES)

    @cached_property
    def _intrinsics(self) -> dict[int, tuple[tuple[float, float, float, float], float]]:
        path = self.path / "scene_camera.json"
        nodes = read_tree(path).frames()
        missing = [index for index in self.indices if index not in nodes]
        if missing:
            raise InputError(f"{path}: says nothing of frame {missing[0]}; add its cam_K and depth_scale.")
        given_k, given_mm = self.overrides.intrinsics, self.overrides.depth_scale_mm
        return {
            index: (
                intrinsics(nodes[index]) if given_k is None else given_k,
                depth_scale_mm(nodes[index]) if given_mm is None else given_mm,
            )
            for index in self.indices
        }

    @cached_property
    def _times_s(self) -> dict[int, float]:
        node = self.facts.get("timestamps_s")
        if node is None:
            return {index: float(index) for index in self.indices}
        given = node.frames()
        missing = [index for index in self.indices if index not in given]
        if missing:
            raise InputError(f"{node.path}: {node.where} lacks frame {missing[0]}; give every frame a time, or none.")
        times = {index: given[index].number() for index in self.indices}
        late = [i for i, j in zip(self.indices[1:], self.indices[:-1], strict=True) if times[i] <= times[j]]
        if late:
            raise InputError(f"{node.path}: {node.where} does not grow at frame {late[0]}; times must increase.")
        return times

    @cached_property
    def _first_with(self) -> dict[tuple[float, float, float, float], int]:
        """The first frame with each intrinsics: all of them must have its size."""
        return {self._intrinsics[index][0]: index for index in reversed(self.indices)}

    def _masks(self, index: int, size: tuple[int, ...]) -> tuple[BoolArray | None, BoolArray | None]:
        """Return the masks (h, w) of object and occluder; None if there is no file."""
        stem = self._depth_paths[index].stem
        path = self.path / MASKS / f"{stem}_000000.png"
        named = (self.path / OCCLUDERS / name for name in _occluder_names(stem))
        hand = next((one for one in named if is_there(one)), None)
        return read_masks(path if is_there(path) else None, hand, size)

    def _colour(self, index: int, size: tuple[int, ...]) -> npt.NDArray[np.uint8] | None:
        path = self._colour_paths.get(index)
        if path is None:
            return None
        colour = read_colour(path)
        check_size(path, colour.shape[:2], size)
        return colour


def _numbered(root: Path, name: str, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """Return the images of a folder by the frame number in their name."""
    found: dict[int, Path] = {}
    for path in entries(root / name):
        number = frame_number(path.stem)
        if path.suffix.lower() not in suffixes or number is None:
            continue
        if number in found:
            raise InputError(f"{path}: is frame {number}, and so is {found[number].name}; remove one of them.")
        found[number] = path
    return found


_UNITS_MM = (0.05, 0.1, 0.25, 0.5, 1.0, 2.0, 10.0)  # of stored depth


def finest_unit_mm(farthest_m: float) -> float:
    """Return the finest unit of depth, in mm, in which a depth fits into 16 bits."""
    return next((unit for unit in _UNITS_MM if farthest_m * 1000.0 < 65535.0 * unit), _UNITS_MM[-1])


def scene_meta(sequence: AbstractSequence) -> dict[str, object]:
    """Return the entries of `sequence.json` that a sequence has of itself."""
    meta: dict[str, object] = {"name": sequence.name}
    noise, motion = sequence.sensor(), sequence.motion
    if noise is not None:
        meta["sensor"] = {name: value for name, value in noise._asdict().items() if value is not None}
    if motion is not None:
        meta["motion"] = dict(motion)
    return meta


def write_bop(
    folder: Path,
    frames: Iterable[Frame],
    truth: Mapping[int, Array] | None = None,
    meta: Mapping[str, object] | None = None,
    *,
    depth_scale_mm: float = 0.1,
    colour_suffix: str = ".png",
    files: Mapping[str, bytes] | None = None,
) -> None:
    """Write frames as a BOP scene folder; it appears complete or not at all.

    Args:
        folder: where to write; it may exist if it is empty.
        frames: what to write, each taken once.
        truth: camera_from_model (4, 4), in m, by frame number.
        meta: entries of `sequence.json`; the frames' times are added.
        depth_scale_mm: millimetres per unit of depth; with 0.1 depth reaches to 6.55 m.
        colour_suffix: `.png`, or `.jpg` for small files.
        files: more files by name, such as `model.ply` and `robot.txt`.

    Raises:
        InputError: if the folder is not empty or cannot be written, or depth does not fit into 16 bits.
    """
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: exists already; remove it or give another `out`.")
    partial = folder.parent / f".{folder.name}.{os.getpid()}.partial"
    try:
        for left in left_behind(folder, ".partial"):
            shutil.rmtree(left, ignore_errors=True)
        partial.mkdir(parents=True)
        _fill(partial, frames, truth, meta or {}, depth_scale_mm=depth_scale_mm, colour_suffix=colour_suffix)
        for name, content in (files or {}).items():
            (partial / name).write_bytes(content)
        os.replace(partial, folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror}); check space and permissions.") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _fill(
    folder: Path,
    frames: Iterable[Frame],
    truth: Mapping[int, Array] | None,
    meta: Mapping[str, object],
    *,
    depth_scale_mm: float,
    colour_suffix: str,
) -> None:
    cameras: dict[str, object] = {}
    times_s: dict[str, float] = {}
    for frame in frames:
        camera, stem = frame.camera, f"{frame.index:06d}"
        matrix = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
        cameras[str(frame.index)] = {"cam_K": [*map(float, matrix)], "depth_scale": depth_scale_mm}
        times_s[str(frame.index)] = frame.time_s
        _image(folder / "depth" / f"{stem}.png", _raw_depth(frame, depth_scale_mm))
        if frame.mask is not None:
            _image(folder / "mask_visib" / f"{stem}_000000.png", frame.mask.astype(np.uint8) * np.uint8(255))
        if frame.occluder is not None:
            _image(folder / OCCLUDERS / f"{stem}.png", frame.occluder.astype(np.uint8) * np.uint8(255))
        if frame.colour is not None:
            _image(folder / "rgb" / f"{stem}{colour_suffix}", frame.colour)
    (folder / "scene_camera.json").write_text(json_lines(cameras))
    if truth is not None:
        poses = {str(index): [pose_entry(pose)] for index, pose in truth.items()}
        (folder / "scene_gt.json").write_text(json_lines(poses))
    (folder / "sequence.json").write_text(json.dumps({**meta, "timestamps_s": times_s}, indent=1) + "\n")


def _raw_depth(frame: Frame, depth_scale_mm: float) -> npt.NDArray[np.uint16]:
    """Return depth in units of the file; 0 if nothing was measured."""
    measured = np.isfinite(frame.depth_m)
    units = np.rint(np.where(measured, frame.depth_m, 0.0) * (1000.0 / depth_scale_mm))
    if units.max(initial=0.0) > np.iinfo(np.uint16).max or units.min(initial=0.0) < 0.0:
        raise InputError(
            f"frame {frame.index}: depth up to {units.max() * depth_scale_mm / 1000.0:.2f} m does not fit into 16 bits "
            f"of {depth_scale_mm:g} mm; use a coarser unit or a shorter range."
        )
    return np.where(measured, np.maximum(units, 1.0), 0.0).astype(np.uint16)


def _image(path: Path, pixels: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]) -> None:
    path.parent.mkdir(exist_ok=True)
    write_image(path, pixels)


def true_mesh(sequence: AbstractSequence) -> Mesh:
    """Return the true surface in m, in the model frame of `sequence.truth()`.

    That is `model.ply` of the sequence, in m, as the renderer writes it; else, of a BOP scene, the model of its object
    in the dataset's `models` folder, in mm.
    """
    if sequence.model_path is not None:
        return read_mesh(sequence.model_path, 1.0)
    if isinstance(sequence, BopSequence):
        found = _of_dataset(sequence.path)
        if found is not None:
            return read_mesh(found, 1e-3)
    raise InputError(
        f"{sequence.name}: has no true surface to compare with; put model.ply (m) next to its frames, or BOP's models "
        "folder (mm) next to its split"
    )


def _of_dataset(scene: Path) -> Path | None:
    """Return the model of a scene's first object, next to the scene or its split."""
    truth = scene / "scene_gt.json"
    if not is_there(truth):
        return None
    objects = [node.elements() for node in read_tree(truth).frames().values()]
    number = next((first[0].need("obj_id").value for first in objects if first), None)
    if not isinstance(number, int):
        return None
    name, place = f"obj_{number:06d}.ply", scene.resolve()
    candidates = [
        folder / models / name for folder in (place, *place.parents[:2]) for models in ("models", "models_eval")
    ]
    return next((path for path in candidates if is_there(path)), None)
