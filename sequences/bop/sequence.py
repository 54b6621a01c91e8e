"""Sequences in the layout of the BOP benchmark (its `bop_datasets_format.md`): one scene folder, one object."""

import json
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import final

import numpy as np
import numpy.typing as npt

from modeler.types import Array, BoolArray, Camera, Frame, InputError
from sequences.bop.entries import camera_from_model, depth_scale_mm, intrinsics
from sequences.files.folders import entries, frame_number, inside
from sequences.files.images import check_alike, check_size, metres, read_colour, read_depth, read_mask
from sequences.files.json_input import read_tree
from sequences.given import Given
from sequences.recording import AbstractRecording


@final
@dataclass(frozen=True)
class BopSequence(AbstractRecording):
    """A BOP scene folder, the onboarding layouts among them.

    Of several objects the first (`mask_visib/*_000000.png`, first ground truth) counts.
    Opening checks the layout, the intrinsics and `sequence.json`; pictures and ground truth are read when asked for.
    """

    given: Given = field(default_factory=Given)
    """What counts more than the folder."""

    def __post_init__(self) -> None:
        """Check everything that can be checked without decoding a picture.

        Raises:
            InputError: where the folder is no readable scene.
        """
        _ = self._depth_paths, self._intrinsics, self._times_s, self.name, self.sensor(), self.motion

    @property
    def indices(self) -> tuple[int, ...]:
        """Frame numbers, ascending: the frames that have a depth image."""
        return tuple(self._depth_paths)

    def frame(self, index: int) -> Frame:
        """Return the frame with number `index`, depth in m and NaN where nothing was measured."""
        if index not in self._depth_paths:
            raise self.absent(index)
        path = self._depth_paths[index]
        raw = read_depth(path)
        matrix, scale_mm = self._intrinsics[index]
        alike = self._depth_paths[self._first_with[matrix]]
        if alike != path:
            check_alike(path, raw.shape, alike, "with the same cam_K; give each size its own in scene_camera.json")
        camera = Camera(raw.shape[1], raw.shape[0], *matrix)
        mask, colour = self._mask(index, raw.shape), self._colour(index, raw.shape)
        return Frame(index, self._times_s[index], metres(raw, scale_mm), camera, mask, colour)

    def truth(self) -> dict[int, Array] | None:
        """Return the true camera_from_model (4, 4), in m, by frame number; None without `scene_gt.json`."""
        path = self.path / "scene_gt.json"
        if not path.is_file():
            return None
        objects = {index: node.elements() for index, node in read_tree(inside(path, self.path)).frames().items()}
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
        """What the sequence is stored as."""
        return "BOP scene folder"

    @property
    def depth_unit(self) -> str:
        """What one unit of stored depth is."""
        scales = sorted({scale for _, scale in self._intrinsics.values()})
        source = "scene_camera.json" if self.given.depth_scale_mm is None else "--depth-scale-mm"
        return f"{' or '.join(f'{scale:g}' for scale in scales[:3])} mm ({source})"

    @property
    def notes(self) -> tuple[str, ...]:
        """What the reader left out."""
        left = [index for index in self._colour_paths if index not in self._depth_paths]
        return (f"{len(left)} colour images have no depth image and are left out",) if left else ()

    @cached_property
    def _depth_paths(self) -> dict[int, Path]:
        if not self.path.is_dir():
            raise InputError(f"{self.path}: no such folder; give a BOP scene folder with depth/ and scene_camera.json.")
        paths = _numbered(self.path, "depth", (".png", ".tif", ".tiff"))
        if not paths:
            raise InputError(f"{self.path / 'depth'}: holds no depth image; put 000000.png, 000001.png, ... there.")
        return dict(sorted(paths.items()))

    @cached_property
    def _colour_paths(self) -> dict[int, Path]:
        kinds = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
        return _numbered(self.path, "rgb", kinds) or _numbered(self.path, "gray", kinds)

    @cached_property
    def _intrinsics(self) -> dict[int, tuple[tuple[float, float, float, float], float]]:
        path = self.path / "scene_camera.json"
        nodes = read_tree(inside(path, self.path)).frames()
        missing = [index for index in self.indices if index not in nodes]
        if missing:
            raise InputError(f"{path}: says nothing of frame {missing[0]}; add its cam_K and depth_scale.")
        given_k, given_mm = self.given.intrinsics, self.given.depth_scale_mm
        return {
            index: (
                intrinsics(nodes[index]) if given_k is None else given_k,
                depth_scale_mm(nodes[index]) if given_mm is None else given_mm,
            )
            for index in self.indices
        }

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
    def _first_with(self) -> dict[tuple[float, float, float, float], int]:
        """The first frame with each intrinsics: all of them must have its size."""
        return {self._intrinsics[index][0]: index for index in reversed(self.indices)}

    def _mask(self, index: int, size: tuple[int, ...]) -> BoolArray | None:
        path = self.path / "mask_visib" / f"{self._depth_paths[index].stem}_000000.png"
        if not path.is_file():
            return None
        mask = read_mask(inside(path, self.path))
        check_size(path, mask.shape, size)
        return mask

    def _colour(self, index: int, size: tuple[int, ...]) -> npt.NDArray[np.uint8] | None:
        path = self._colour_paths.get(index)
        if path is None:
            return None
        colour = read_colour(path)
        check_size(path, colour.shape[:2], size)
        return colour


def _numbered(root: Path, name: str, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """Return the pictures of a folder of a sequence by the number that is their name."""
    found: dict[int, Path] = {}
    for path in entries(inside(root / name, root)):
        number = frame_number(path.stem)
        if path.suffix.lower() not in suffixes or number is None:
            continue
        if number in found:
            raise InputError(f"{path}: is frame {number}, and so is {found[number].name}; remove one of them.")
        found[number] = inside(path, root) if path.is_symlink() else path
    return found
