"""Recordings of the Azure Kinect and of cameras that write its format (.mkv), by the PyAV library."""

from __future__ import annotations

import importlib
import json
import weakref
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, final

import numpy as np
import numpy.typing as npt

from modeler.types import Array, Frame, InputError
from sequences.alignment import Alignment
from sequences.files.broken import told
from sequences.files.images import MAX_PIXELS, Packed, metres, read_colour
from sequences.files.json_input import Node
from sequences.given import Given
from sequences.kinect.calibration import colour_from_depth, colour_lens, depth_lens
from sequences.lens import Lens
from sequences.pictures.tum import MAX_APART_S, nearest
from sequences.recording import AbstractRecording

ADVICE = "pip install 'modeler[kinect]'"
_AGAIN = "record or copy it anew"


@final
@dataclass(frozen=True)
class KinectSequence(AbstractRecording):
    """The depth track of a recording, and colour brought to its pixels."""

    file: Matroska
    """The open file."""
    shots: Mapping[int, tuple[int, int | None]]
    """By frame number: time stamps of the depth and of the colour packet."""
    lens: Lens
    """The depth camera."""
    alignment: Alignment | None
    """Where the colour camera is; None without colour."""
    unit_mm: float
    """Millimetres per unit of depth."""

    @property
    def indices(self) -> tuple[int, ...]:
        """Frame numbers, ascending: places in the track."""
        return tuple(self.shots)

    def frame(self, index: int) -> Frame:
        """Return the frame with number `index`, without the lens's distortion."""
        if index not in self.shots:
            raise self.absent(index)
        stamp, partner = self.shots[index]
        camera = self.lens.camera
        data, time_s = self.file.packet("DEPTH", stamp)
        if len(data) != 2 * camera.width * camera.height:
            raise InputError(f"{self.path}: depth image {index} is cut off; record it anew.")
        raw = np.frombuffer(data, ">u2").reshape(camera.height, camera.width).astype(np.uint16)
        depth_m = self.lens.straight(metres(raw, self.unit_mm), float("nan"))
        colour = None
        if partner is not None and self.alignment is not None:
            colour = self.alignment.aligned(depth_m, self._picture(index, partner))
        return Frame(index, time_s, depth_m, camera, None, colour)

    def truth(self) -> dict[int, Array] | None:
        """Return None: recordings do not tell the object's pose."""
        return None

    @property
    def layout(self) -> str:
        """What the sequence is stored as."""
        return "Azure Kinect recording (MKV)"

    @property
    def depth_unit(self) -> str:
        """What one unit of stored depth is."""
        return f"{self.unit_mm:g} mm ({'of the format' if self.unit_mm == 1.0 else '--depth-scale-mm'})"

    def _picture(self, index: int, stamp: int) -> npt.NDArray[np.uint8]:
        assert self.alignment is not None
        picture = self.file.picture("COLOR", stamp, f"{self.path}: colour image {index}")
        camera = self.alignment.colour.camera
        if picture.shape[:2] != (camera.height, camera.width):
            raise InputError(
                f"{self.path}: colour image {index} is {picture.shape[1]} x {picture.shape[0]} pixels where the track "
                f"says {camera.width} x {camera.height}; record it anew."
            )
        return picture


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
    partners = nearest([time_s for time_s, _ in stamps], [time_s for time_s, _ in colours], MAX_APART_S)
    shots = {
        index: (stamp, None if partner is None else colours[partner][1])
        for index, ((_, stamp), partner) in enumerate(zip(stamps, partners, strict=True))
    }
    unit_mm = 1.0 if given.depth_scale_mm is None else given.depth_scale_mm
    return KinectSequence(path, file, shots, lens, alignment, unit_mm)


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

    def packet(self, title: str, stamp: int) -> tuple[bytes, float]:
        """Return the bytes of one image and its time in s."""
        with told(self.path, "recording", _AGAIN):
            packet = self._find(title, stamp)
            return bytes(packet), float(stamp * (packet.time_base or 0))

    def picture(self, title: str, stamp: int, where: str) -> npt.NDArray[np.uint8]:
        """Return one image as RGB (h, w, 3)."""
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
