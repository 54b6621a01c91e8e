"""Recordings of phones with a depth camera: Record3D's `.r3d`, and folders of Polycam and nerfstudio."""

from __future__ import annotations

import importlib
import weakref
import zipfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from modeler.sequences.image_files import MAX_PIXELS, EmbeddedImage, metres, read_colour, resize_to_depth
from modeler.sequences.image_folders import FoundImages
from modeler.sequences.input_files import MAX_BYTES, Node, input_errors, is_there, listed, read_tree
from modeler.sequences.intrinsics import Overrides, camera_of
from modeler.sequences.recording import AbstractRecording
from modeler.system.processes import install_command
from modeler.system.regular_files import open_regular, parse_json
from modeler.types import Camera, Frame, InputError

_AGAIN = "export it again"


@dataclass(frozen=True)
class Record3DSequence(AbstractRecording):
    """An archive `.r3d`: depth in m, packed by LZFSE, with its confidence, and JPEG colour of the same view."""

    camera: Camera
    """Of the depth images."""
    times_s: tuple[float, ...]
    """By frame number, from 0."""

    @property
    def indices(self) -> tuple[int, ...]:
        return tuple(range(len(self.times_s)))

    def frame(self, index: int) -> Frame:
        """Return the frame with number `index`, without depth of confidence 0."""
        if index not in self.indices:
            raise self.absent(index)
        size = self.camera.height, self.camera.width
        depth = self._unpacked(f"rgbd/{index}.depth", size, "<f4")
        depth_m = metres(depth.astype(np.float32), 1000.0)
        if f"rgbd/{index}.conf" in self._names:
            depth_m[self._unpacked(f"rgbd/{index}.conf", size, "u1") == 0] = np.nan
        colour = None
        if f"rgbd/{index}.jpg" in self._names:
            where = f"{self.path}: rgbd/{index}.jpg"
            seen = read_colour(EmbeddedImage(self._content(f"rgbd/{index}.jpg"), where))
            colour = resize_to_depth(Path(where), seen, size)
        return Frame(index, self.times_s[index], depth_m, self.camera, None, colour)

    @property
    def layout(self) -> str:
        return "Record3D recording (R3D)"

    @property
    def depth_unit(self) -> str:
        return "1000 mm (of the format)"

    def _unpacked(self, name: str, size: tuple[int, int], kind: str) -> np.ndarray[Any, Any]:
        try:
            lzfse = importlib.import_module("lzfse")
        except ImportError:
            how = install_command("phones")
            raise InputError(f"{self.path}: recordings of Record3D are unpacked by lzfse; {how}") from None
        with input_errors(self.path, "recording", _AGAIN):
            return np.frombuffer(lzfse.decompress(self._content(name)), kind).reshape(size).copy()

    def _content(self, name: str) -> bytes:
        with input_errors(self.path, "recording", _AGAIN):
            if self._archive.getinfo(name).file_size > MAX_BYTES:
                raise ValueError(f"{name} is larger than images are")
            return self._archive.read(name)

    @cached_property
    def _names(self) -> frozenset[str]:
        return frozenset(self._archive.namelist())

    @cached_property
    def _archive(self) -> zipfile.ZipFile:
        """Return the open archive; it is closed when this recording is forgotten."""
        with input_errors(self.path, "recording", _AGAIN):
            file = open_regular(self.path)
            weakref.finalize(self, file.close)
            return zipfile.ZipFile(file)


def open_record3d(path: Path, overrides: Overrides) -> Record3DSequence:
    """Open an archive of Record3D."""
    with input_errors(path, "recording", _AGAIN), open_regular(path) as file, zipfile.ZipFile(file) as archive:
        if archive.getinfo("metadata").file_size > MAX_BYTES:
            raise ValueError("metadata is larger than it can be")
        names, text = set(archive.namelist()), archive.read("metadata")
    meta = Node(parse_json(text, path), path)
    width, height = (int(meta.need(key).number(1.0, 1e5)) for key in ("dw", "dh"))
    if width * height > MAX_PIXELS:
        raise InputError(f"{path}: claims depth images of {width} x {height} pixels; export it again.")
    facts = camera_of(meta, "metadata").scaled((width, height))
    intrinsics = facts.intrinsics if overrides.intrinsics is None else overrides.intrinsics
    count = next(index for index in range(len(names) + 1) if f"rgbd/{index}.depth" not in names)
    if not count:
        raise InputError(f"{path}: holds no image rgbd/0.depth; {_AGAIN}.")
    stamps, rate = meta.get("frameTimestamps"), meta.get("fps")
    times_s = [float(index) / (30.0 if rate is None else rate.number(1e-3, 1e4)) for index in range(count)]
    if stamps is not None and len(stamps.elements()) == count:
        times_s = [stamp.number() for stamp in stamps.elements()]
    camera, said = Camera(width, height, *intrinsics), ("depth of confidence 0 is left out",)
    calibrated = overrides.intrinsics is None
    return Record3DSequence(path, camera, tuple(times_s), remarks=said, calibrated=calibrated, kind="tof")


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
