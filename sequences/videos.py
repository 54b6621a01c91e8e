"""Videos of depth and colour: what PyAV reads, recordings of the Azure Kinect (.mkv) among it, and Record3D's .r3d."""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import threading
import weakref
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from modeler import se3
from modeler.sequences.image_files import MAX_PIXELS, EmbeddedImage, metres, read_colour, resize_to_depth
from modeler.sequences.input_files import MAX_TEXT_BYTES, Node, input_errors
from modeler.sequences.intrinsics import Intrinsics, Overrides, camera_of, sane
from modeler.sequences.lens import Alignment, Lens, coefficients
from modeler.sequences.recording import AbstractRecording, AbstractStreams, paired
from modeler.system.processes import install_command
from modeler.system.regular_files import MAX_BYTES, check_regular, open_regular, parse_json
from modeler.types import Array, Camera, Frame, InputError


def can_decode() -> bool:
    """Return whether the library that decodes videos is installed."""
    return importlib.util.find_spec("av") is not None


def _opened(path: Path, owner: object) -> Any:
    """Return an open file, which is closed when its owner is forgotten."""
    av = importlib.import_module("av")
    check_regular(path)
    container = av.open(str(path), mode="r")
    weakref.finalize(owner, container.close)
    return container


def _limit(track: Any, where: str) -> None:
    """Refuse a track whose images are too large; those that claim more than it says are not decoded."""
    if not 0 < track.width * track.height <= MAX_PIXELS:
        raise InputError(f"{where} has {track.width} x {track.height} pixels; record it again.")
    if not track.codec_context.is_open:
        track.codec_context.options = {"max_pixels": str(MAX_PIXELS)}


class Video:
    """A video whose images are read one after the other: to go back is to begin again."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock, self._next = threading.Lock(), 0
        self._images: Iterator[Any] = iter(())

    def image(self, number: int) -> npt.NDArray[np.uint8] | None:
        """Return an image, counted from 0, as RGB (h, w, 3); None if the video ends before it."""
        with self._lock, input_errors(self.path, "video", "record it again"):
            if number < self._next or self._next == 0:
                self._container.seek(0)
                self._next, self._images = 0, self._container.decode(video=0)
            for image in self._images:
                self._next += 1
                if self._next > number:
                    return np.asarray(image.to_ndarray(format="rgb24"), dtype=np.uint8)
        return None

    @cached_property
    def _container(self) -> Any:
        container = _opened(self.path, self)
        _limit(container.streams.video[0], f"{self.path}:")
        return container


DEPTH, COLOUR = "CALIBRATION_CameraPurposeDepth", "CALIBRATION_CameraPurposePhotoVideo"
Size = tuple[int, int]
_MODELS = tuple(f"CALIBRATION_LensDistortionModel{name}" for name in ("BrownConrady", "Rational6KT"))
"""Those that the maker's library takes; they differ by less than a tenth of a pixel, in a tangential term."""
_DEPTH_MODES: dict[Size, tuple[Size, Size]] = {  # image: (binned sensor, corner of the image in it)
    (320, 288): ((512, 512), (96, 90)),
    (640, 576): ((1024, 1024), (192, 180)),
    (512, 512): ((512, 512), (0, 0)),
    (1024, 1024): ((1024, 1024), (0, 0)),
}


def depth_lens(calibration: Node, size: Size, intrinsics: Intrinsics | None) -> Lens:
    """Return the depth camera for images of (width, height)."""
    if intrinsics is not None:
        return Lens(Camera(*size, *intrinsics), ())
    if size not in _DEPTH_MODES:
        raise InputError(
            f"{calibration.path}: depth of {size[0]} x {size[1]} pixels is of no mode of the Azure Kinect; "
            "convert with `intrinsics` FX FY CX CY."
        )
    return _lens(calibration, DEPTH, size, *_DEPTH_MODES[size])


def colour_lens(calibration: Node, size: Size) -> Lens:
    """Return the colour camera for images of (width, height): of the sensor of 4 : 3, cropped for 16 : 9."""
    whole = size[0], size[0] * 3 // 4
    return _lens(calibration, COLOUR, size, whole, (0, (whole[1] - size[1]) // 2))


def colour_from_depth(calibration: Node) -> Array:
    """Return the motion (4, 4), in m, that takes points of the depth camera to the colour camera."""
    return _camera_from_device(calibration, COLOUR) @ se3.inverse(_camera_from_device(calibration, DEPTH))


def _lens(calibration: Node, purpose: str, size: Size, sensor: Size, corner: Size) -> Lens:
    intrinsics = _camera(calibration, purpose).need("Intrinsics")
    model = intrinsics.get("ModelType")
    if model is not None and model.value not in _MODELS:
        raise model.fault(f"one of {', '.join(_MODELS)}")
    entry = intrinsics.need("ModelParameters")
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = (float(value) for value in entry.numbers(14))
    pixels = (
        fx * sensor[0],
        fy * sensor[1],
        cx * sensor[0] - corner[0] - 0.5,  # from the corner of the first pixel to its centre
        cy * sensor[1] - corner[1] - 0.5,
    )
    if not sane(pixels):
        raise entry.fault("the 14 parameters of a lens")
    return Lens(Camera(*size, *pixels), coefficients([k1, k2, p1, p2, k3, k4, k5, k6]))


def _camera_from_device(calibration: Node, purpose: str) -> Array:
    entry = _camera(calibration, purpose).need("Rt")
    rotation = entry.need("Rotation").rotation()
    return se3.rigid(rotation, entry.need("Translation").numbers(3))


def _camera(calibration: Node, purpose: str) -> Node:
    for entry in calibration.need("CalibrationInformation").need("Cameras").elements():
        if entry.need("Purpose").value == purpose:
            return entry
    raise InputError(f"{calibration.path}: its calibration has no {purpose}; record it again.")


_AGAIN = "record or copy it again"


@dataclass(frozen=True)
class KinectSequence(AbstractStreams[int]):
    """The depth track of a recording, and colour brought to its pixels. Images are found by their time stamps."""

    file: Matroska
    alignment: Alignment | None
    """Where the colour camera is; None without colour."""
    unit_mm: float
    """Millimetres per unit of depth."""

    def seen_m(self, index: int, stamp: int) -> npt.NDArray[np.float32]:
        camera, data = self.lens.camera, self.file.packet("DEPTH", stamp)
        if len(data) != 2 * camera.width * camera.height:
            raise InputError(f"{self.path}: depth image {index} is cut off; record it again.")
        return metres(np.frombuffer(data, ">u2").reshape(camera.height, camera.width).astype(np.uint16), self.unit_mm)

    def colour_at(self, index: int, stamp: int, depth_m: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8] | None:
        if self.alignment is None:
            return None
        image = self.file.image("COLOR", stamp, f"{self.path}: colour image {index}")
        camera = self.alignment.colour.camera
        if image.shape[:2] != (camera.height, camera.width):
            raise InputError(
                f"{self.path}: colour image {index} is {image.shape[1]} x {image.shape[0]} pixels where the track "
                f"says {camera.width} x {camera.height}; record it again."
            )
        return self.alignment.align(depth_m, image)

    @property
    def layout(self) -> str:
        return "Azure Kinect recording (MKV)"

    @property
    def depth_unit(self) -> str:
        return f"{self.unit_mm:g} mm ({'of the format' if self.unit_mm == 1.0 else '`depth_scale_mm`'})"


def open_kinect(path: Path, overrides: Overrides) -> KinectSequence:
    """Open a recording."""
    file = Matroska(path)
    calibration = Node(file.calibration(), path)
    size = file.size("DEPTH")
    if size is None:
        raise InputError(f"{path}: has no DEPTH track; record with depth (k4arecorder --depth-mode NFOV_UNBINNED).")
    lens = depth_lens(calibration, size, overrides.intrinsics)
    stamps, colours, colour_size = file.stamps("DEPTH"), [], file.size("COLOR")
    if not stamps:
        raise InputError(f"{path}: its DEPTH track holds no image; record it again.")
    alignment = None
    if colour_size is not None:
        colours = file.stamps("COLOR")
        alignment = Alignment(lens.camera, colour_lens(calibration, colour_size), colour_from_depth(calibration))
    unit_mm = 1.0 if overrides.depth_scale_mm is None else overrides.depth_scale_mm
    pairs, left = paired(stamps, colours)
    about = {"remarks": tuple(left), "calibrated": overrides.intrinsics is None, "kind": "tof"}
    return KinectSequence(path, lens, pairs, file, alignment, unit_mm, **about)


def _check_whole(path: Path) -> None:
    """Reject a file whose end was never written, as after a disk was full: the library would look for images in it."""
    with open_regular(path) as file:
        size = file.seek(0, os.SEEK_END)
        hole_bytes = size - os.lseek(file.fileno(), 0, getattr(os, "SEEK_HOLE", os.SEEK_END)) if size else 0
    if hole_bytes > MAX_BYTES:  # so many zeros the library reads in a second
        raise InputError(f"{path}: ends in {hole_bytes / 1e9:.0f} GB that were never written; record or copy it again.")


@dataclass(frozen=True)
class Matroska:
    """A recording that is open while it is used."""

    path: Path

    def calibration(self) -> Any:
        """Return the contents of `calibration.json`, attached to the recording."""
        with input_errors(self.path, "recording", _AGAIN):
            for attached in self._container.streams.attachments:
                if attached.name == "calibration.json":
                    return json.loads(bytes(attached.data).rstrip(b"\0").decode("utf-8-sig"))
        raise InputError(f"{self.path}: carries no calibration.json; it is not a recording of an Azure Kinect.")

    def size(self, title: str) -> tuple[int, int] | None:
        """Return the (width, height) of a track; None if there is none."""
        with input_errors(self.path, "recording", _AGAIN):
            track = self._track(title)
            return None if track is None else (int(track.width), int(track.height))

    def stamps(self, title: str) -> list[tuple[float, int]]:
        """Return the times in s and time stamps of a track's images, in order, each once."""
        with input_errors(self.path, "recording", _AGAIN):
            track = self._track(title)
            if track is None or track.time_base is None:
                return []
            self._container.seek(0)
            found = {int(packet.pts) for packet in self._container.demux(track) if packet.pts is not None}
            return [(float(stamp * track.time_base), stamp) for stamp in sorted(found)]

    def packet(self, title: str, stamp: int) -> bytes:
        """Return the bytes of one image."""
        with input_errors(self.path, "recording", _AGAIN):
            return bytes(self._find(title, stamp))

    def image(self, title: str, stamp: int, where: str) -> npt.NDArray[np.uint8]:
        """Return one image as RGB (h, w, 3); `where` is for error messages."""
        with input_errors(self.path, "recording", _AGAIN):
            packet = self._find(title, stamp)
            content = bytes(packet)
            if content[:2] == b"\xff\xd8":
                return read_colour(EmbeddedImage(content, where))
            for image in packet.decode():
                return np.asarray(image.to_ndarray(format="rgb24"), dtype=np.uint8)
        raise InputError(f"{where}: cannot be decoded; record it again.")

    def _find(self, title: str, stamp: int) -> Any:
        track = self._track(title)
        for start in (stamp, 0):  # recordings that were cut off have no index: then from the beginning
            self._container.seek(start, stream=track)
            for packet in self._container.demux(track):
                if packet.pts == stamp:
                    return packet
        raise InputError(f"{self.path}: lacks an image of {title} that it had; record it again.")

    def _track(self, title: str) -> Any:
        named = (track for track in self._container.streams.video if track.metadata.get("title") == title)
        track = next(named, None)
        if track is not None:
            _limit(track, f"{self.path}: {title}")
        return track

    @cached_property
    def _container(self) -> Any:
        if not can_decode():
            how = install_command("kinect")
            raise InputError(f"{self.path}: recordings of the Azure Kinect are read by PyAV; {how}")
        _check_whole(self.path)
        return _opened(self.path, self)


_EXPORT_AGAIN = "export it again"


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
        with input_errors(self.path, "recording", _EXPORT_AGAIN):
            return np.frombuffer(lzfse.decompress(self._content(name)), kind).reshape(size).copy()

    def _content(self, name: str) -> bytes:
        with input_errors(self.path, "recording", _EXPORT_AGAIN):
            if self._archive.getinfo(name).file_size > MAX_TEXT_BYTES:
                raise ValueError(f"{name} is larger than images are")
            return self._archive.read(name)

    @cached_property
    def _names(self) -> frozenset[str]:
        return frozenset(self._archive.namelist())

    @cached_property
    def _archive(self) -> zipfile.ZipFile:
        """Return the open archive; it is closed when this recording is forgotten."""
        with input_errors(self.path, "recording", _EXPORT_AGAIN):
            file = open_regular(self.path)
            weakref.finalize(self, file.close)
            return zipfile.ZipFile(file)


def open_record3d(path: Path, overrides: Overrides) -> Record3DSequence:
    """Open an archive of Record3D."""
    with input_errors(path, "recording", _EXPORT_AGAIN), open_regular(path) as file, zipfile.ZipFile(file) as archive:
        if archive.getinfo("metadata").file_size > MAX_TEXT_BYTES:
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
        raise InputError(f"{path}: holds no image rgbd/0.depth; {_EXPORT_AGAIN}.")
    stamps, rate = meta.get("frameTimestamps"), meta.get("fps")
    times_s = [float(index) / (30.0 if rate is None else rate.number(1e-3, 1e4)) for index in range(count)]
    if stamps is not None and len(stamps.elements()) == count:
        times_s = [stamp.number() for stamp in stamps.elements()]
    camera, said = Camera(width, height, *intrinsics), ("depth of confidence 0 is left out",)
    calibrated = overrides.intrinsics is None
    return Record3DSequence(path, camera, tuple(times_s), remarks=said, calibrated=calibrated, kind="tof")
