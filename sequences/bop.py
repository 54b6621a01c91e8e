"""Sequences in the layout of the BOP benchmark (its `bop_datasets_format.md`): one scene folder, one object."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import final

import numpy as np
import numpy.typing as npt

from modeler.types import Array, BoolArray, Camera, Frame, InputError
from sequences.base import AbstractSequence, span
from sequences.bop_entries import camera_from_model, depth_scale_mm, intrinsics
from sequences.images import read_colour, read_depth, read_mask
from sequences.json_input import Node, read_tree


@final
@dataclass(frozen=True)
class BopSequence(AbstractSequence):
    """A BOP scene folder. Of several objects the first (`mask_visib/*_000000.png`, first ground truth) counts.

    Opening checks the layout, the intrinsics and `sequence.json`; pictures and ground truth are read when asked for.
    """

    path: Path
    """The scene folder."""

    def __post_init__(self) -> None:
        """Check everything that can be checked without decoding a picture.

        Raises:
            InputError: where the folder is no readable scene.
        """
        _ = self._depth_paths, self._intrinsics, self._times_s, self.name, self.sensor(), self.motion

    @property
    def name(self) -> str:
        """What the sequence is called: as `sequence.json` says, else as the folder."""
        node = None if self._meta is None else self._meta.get("name")
        return self.path.resolve().name if node is None else node.text()

    @property
    def indices(self) -> tuple[int, ...]:
        """Frame numbers, ascending: the frames that have a depth image."""
        return tuple(self._depth_paths)

    def frame(self, index: int) -> Frame:
        """Return the frame with number `index`, depth in m and NaN where nothing was measured."""
        if index not in self._depth_paths:
            raise InputError(f"{self.path}: has no frame {index}; its frames are {span(self.indices)}.")
        path = self._depth_paths[index]
        raw = read_depth(path)
        _check_size(path, raw.shape, self._size)
        (fx, fy, cx, cy), scale_mm = self._intrinsics[index]
        depth_m = np.where(raw == 0, np.float32(np.nan), (raw * (scale_mm / 1000.0)).astype(np.float32))
        camera = Camera(raw.shape[1], raw.shape[0], fx, fy, cx, cy)
        return Frame(index, self._times_s[index], depth_m, camera, self._mask(index), self._colour(index))

    def truth(self) -> dict[int, Array] | None:
        """Return the true camera_from_model (4, 4), in m, by frame number; None without `scene_gt.json`."""
        path = self.path / "scene_gt.json"
        if not path.is_file():
            return None
        entries = {index: node.elements() for index, node in read_tree(path).frames().items()}
        firsts = {index: entries[index][0] for index in self.indices if entries.get(index)}
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

    def sensor(self) -> tuple[float, float] | None:
        """Return `(sigma_wh, sigma_r_m)` from `sequence.json`; None where it does not say."""
        node = None if self._meta is None else self._meta.get("sensor")
        if node is None:
            return None
        return node.need("sigma_wh").number(1e-9, 1.0), node.need("sigma_r_m").number(1e-9, 10.0)

    @property
    def motion(self) -> Mapping[str, object] | None:
        """What `sequence.json` says of the motion; None where it says nothing."""
        node = None if self._meta is None else self._meta.get("motion")
        return None if node is None else {key: entry.value for key, entry in node.items().items()}

    @property
    def robot_path(self) -> Path | None:
        """`robot.txt`, where there is one."""
        path = self.path / "robot.txt"
        return path if path.is_file() else None

    @property
    def model_path(self) -> Path | None:
        """`model.ply`, where there is one: the true surface in m."""
        path = self.path / "model.ply"
        return path if path.is_file() else None

    @cached_property
    def _depth_paths(self) -> dict[int, Path]:
        if not self.path.is_dir():
            raise InputError(f"{self.path}: no such folder; give a BOP scene folder with depth/ and scene_camera.json.")
        paths = _numbered(self.path / "depth", (".png",))
        if not paths:
            raise InputError(f"{self.path / 'depth'}: holds no depth image; put 000000.png, 000001.png, ... there.")
        return dict(sorted(paths.items()))

    @cached_property
    def _colour_paths(self) -> dict[int, Path]:
        return _numbered(self.path / "rgb", (".png", ".jpg", ".jpeg")) or _numbered(
            self.path / "gray", (".png", ".jpg")
        )

    @cached_property
    def _intrinsics(self) -> dict[int, tuple[tuple[float, float, float, float], float]]:
        path = self.path / "scene_camera.json"
        nodes = read_tree(path).frames()
        missing = [index for index in self.indices if index not in nodes]
        if missing:
            raise InputError(f"{path}: says nothing of frame {missing[0]}; add its cam_K and depth_scale.")
        return {index: (intrinsics(nodes[index]), depth_scale_mm(nodes[index])) for index in self.indices}

    @cached_property
    def _meta(self) -> Node | None:
        path = self.path / "sequence.json"
        return read_tree(path) if path.is_file() else None

    @cached_property
    def _times_s(self) -> dict[int, float]:
        node = None if self._meta is None else self._meta.get("timestamps_s")
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
    def _size(self) -> tuple[int, ...]:
        return read_depth(self._depth_paths[self.indices[0]]).shape

    def _mask(self, index: int) -> BoolArray | None:
        path = self.path / "mask_visib" / f"{self._depth_paths[index].stem}_000000.png"
        if not path.is_file():
            return None
        mask = read_mask(path)
        _check_size(path, mask.shape, self._size)
        return mask

    def _colour(self, index: int) -> npt.NDArray[np.uint8] | None:
        path = self._colour_paths.get(index)
        if path is None:
            return None
        colour = read_colour(path)
        _check_size(path, colour.shape[:2], self._size)
        return colour


def _check_size(path: Path, found: tuple[int, ...], expected: tuple[int, ...]) -> None:
    if found != expected:
        raise InputError(
            f"{path}: is {found[1]} x {found[0]} pixels where the first depth image is {expected[1]} x {expected[0]}; "
            "all pictures of a sequence must have one size."
        )


def _numbered(folder: Path, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """Return the pictures of a folder by the number that is their name."""
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if path.suffix.lower() not in suffixes or not (path.stem.isascii() and path.stem.isdigit()):
            continue
        number = int(path.stem)
        if number in found:
            raise InputError(f"{path}: is frame {number}, and so is {found[number].name}; remove one of them.")
        found[number] = path
    return found
