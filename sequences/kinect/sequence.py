"""Recordings of the Azure Kinect and of cameras that write its format (.mkv), by the PyAV library."""

from __future__ import annotations

import importlib
import json
import weakref
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, final

import numpy as np
import numpy.typing as npt

from modeler.types import InputError
from sequences.alignment import Alignment
from sequences.files.broken import told
from sequences.files.images import MAX_PIXELS, Packed, metres, read_colour
from sequences.files.json_input import Node
from sequences.given import Given
from sequences.kinect.calibration import colour_from_depth, colour_lens, depth_lens
from sequences.streams import AbstractStreams, paired

ADVICE = "pip install 'modeler[kinect]'"
_AGAIN = "record or copy it anew"


@final
@dataclass(frozen=True)
class KinectSequence(AbstractStreams[int]):
    """The depth track of a recording, and colour brought to its pixels. Images are found by their time stamps."""

    file: Matroska
    """The open file."""
    alignment: Alignment | None
    """Where the colour camera is; None without colour."""
    unit_mm: float
    """Millimetres per unit of depth."""

    def seen_m(self, index: int, stamp: int) -> npt.NDArray[np.float32]:
        """Return the depth (h, w) in m as the lens shows it, NaN where nothing was measured."""
        camera, data = self.lens.camera, self.file.packet("DEPTH", stamp)
        if len(data) != 2 * camera.width * camera.height:
            raise InputError(f"{self.path}: depth image {index} is cut off; record it anew.")
        return metres(np.frombuffer(data, ">u2").reshape(camera.height, camera.width).astype(np.uint16), self.unit_mm)

    def aligned(self, index: int, stamp: int, depth_m: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8] | None:
        """Return colour (h, w, 3) as RGB at the pixels of depth; None without a colour camera."""
        if self.alignment is None:
            return None
        picture = self.file.picture("COLOR", stamp, f"{self.path}: colour image {index}")
        camera = self.alignment.colour.camera
        if picture.shape[:2] != (camera.height, camera.width):
            raise InputError(
                f"{self.path}: colour image {index} is {picture.shape[1]} x {picture.shape[0]} pixels where the track "
                f"says {camera.width} x {camera.height}; record it anew."
            )
        return self.alignment.aligned(depth_m, picture)

    @property
    def layout(self) -> str:
        """What the sequence is stored as."""
        return "Azure Kinect recording (MKV)"

    @property
    def depth_unit(self) -> str:
        """What one unit of stored depth is."""
        return f"{self.unit_mm:g} mm ({'of the format' if self.unit_mm == 1.0 else '--depth-scale-mm'})"


def open_kinect(path: Path, given: Given) -> KinectSequence:
    """Open a recording.

    Raises:
        InputError: where PyAV is not installed, or the file is no such recording.
    """
    file = Matroska(path)
    calibration = Node(file.calibration(), path)
    size = file.size("DEPTH")
    if size is None:
        raise InputError(f"{path}: has no DEPTH track; record with depth (k4arecorder --depth-mode NFOV_UNBINNED).")
    lens = depth_lens(calibration, size, given.intrinsics)
    stamps, colours, colour_size = file.stamps("DEPTH"), [], file.size("COLOR")
    if not stamps:
        raise InputError(f"{path}: its DEPTH track holds no image; record it anew.")
    alignment = None
    if colour_size is not None:
        colours = file.stamps("COLOR")
        alignment = Alignment(lens.camera, colour_lens(calibration, colour_size), colour_from_depth(calibration))
    unit_mm = 1.0 if given.depth_scale_mm is None else given.depth_scale_mm
    pairs, left = paired(stamps, colours)
    return KinectSequence(path, lens, pairs, tuple(left), file, alignment, unit_mm)


@final
@dataclass(frozen=True)
class Matroska:
    """A recording that is open while it is used."""

    path: Path
    """The file."""

    def calibration(self) -> Any:
        """Return what `calibration.json`, which is attached to the recording, says.

        Raises:
            InputError: where nothing of the kind is attached.
        """
        with told(self.path, "recording", _AGAIN):
            for attached in self._container.streams.attachments:
                if attached.name == "calibration.json":
                    return json.loads(bytes(attached.data).rstrip(b"\0").decode("utf-8-sig"))
        raise InputError(f"{self.path}: carries no calibration.json; it is not a recording of an Azure Kinect.")

    def size(self, title: str) -> tuple[int, int] | None:
        """Return the (width, height) of a track; None where there is none."""
        with told(self.path, "recording", _AGAIN):
            track = self._track(title)
            return None if track is None else (int(track.width), int(track.height))

    def stamps(self, title: str) -> list[tuple[float, int]]:
        """Return the times in s and time stamps of a track's images, in order, each once."""
        with told(self.path, "recording", _AGAIN):
            track = self._track(title)
            if track is None or track.time_base is None:
                return []
            self._container.seek(0)
            found = {int(packet.pts) for packet in self._container.demux(track) if packet.pts is not None}
            return [(float(stamp * track.time_base), stamp) for stamp in sorted(found)]

    def packet(self, title: str, stamp: int) -> bytes:
        """Return the bytes of one image."""
        with told(self.path, "recording", _AGAIN):
            return bytes(self._find(title, stamp))

    def picture(self, title: str, stamp: int, where: str) -> npt.NDArray[np.uint8]:
        """Return one image as RGB (h, w, 3); `where` names it for messages.

        Raises:
            InputError: where it cannot be decoded.
        """
        with told(self.path, "recording", _AGAIN):
            packet = self._find(title, stamp)
            content = bytes(packet)
            if content[:2] == b"\xff\xd8":
                return read_colour(Packed(content, where))
            for image in packet.decode():
                return np.asarray(image.to_ndarray(format="rgb24"), dtype=np.uint8)
        raise InputError(f"{where}: cannot be decoded; record it anew.")

    def _find(self, title: str, stamp: int) -> Any:
        track = self._track(title)
        for start in (stamp, 0):  # recordings that were cut off have no index: then from the beginning
            self._container.seek(start, stream=track)
            for packet in self._container.demux(track):
                if packet.pts == stamp:
                    return packet
        raise InputError(f"{self.path}: lacks an image of {title} that it had; record it anew.")

    def _track(self, title: str) -> Any:
        named = (track for track in self._container.streams.video if track.metadata.get("title") == title)
        track = next(named, None)
        if track is not None and not 0 < track.width * track.height <= MAX_PIXELS:
            raise InputError(f"{self.path}: {title} has {track.width} x {track.height} pixels; record it anew.")
        if track is not None and not track.codec_context.is_open:  # the images may claim more than their track
            track.codec_context.options = {"max_pixels": str(MAX_PIXELS)}
        return track

    @cached_property
    def _container(self) -> Any:
        """Return the open file; it is closed when this recording is forgotten."""
        try:
            av = importlib.import_module("av")
        except ImportError:
            raise InputError(f"{self.path}: recordings of the Azure Kinect are read by PyAV; {ADVICE}") from None
        container = av.open(str(self.path), mode="r")
        weakref.finalize(self, container.close)
        return container
