"""Depth images in bags of ROS 1 and ROS 2 and in MCAP files, RealSense's recordings among them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np
import numpy.typing as npt

from modeler.types import Array, Frame, InputError
from sequences.given import Given
from sequences.lens import Lens
from sequences.pictures.tum import MAX_APART_S, nearest
from sequences.recording import AbstractRecording
from sequences.ros import images, topics
from sequences.ros.bag import Bag, Stamp


@final
@dataclass(frozen=True)
class RosSequence(AbstractRecording):
    """The depth images of one topic, and the colour images that are aligned to them."""

    bag: Bag
    """The open bag."""
    depth_topic: str
    """Topic of the depth images."""
    colour: topics.Colour | None
    """Where colour comes from."""
    lens: Lens
    """The depth camera."""
    unit_mm: float
    """Millimetres per unit of 16-bit depth."""
    unit: str
    """The unit in words."""
    shots: Mapping[int, tuple[float, Stamp, Stamp | None]]
    """By frame number: time in s, the depth message and the colour message."""
    remarks: tuple[str, ...]
    """What was assumed or left out."""

    @property
    def indices(self) -> tuple[int, ...]:
        """Frame numbers, ascending: places in order of time."""
        return tuple(self.shots)

    def frame(self, index: int) -> Frame:
        """Return the frame with number `index`, without the lens's distortion."""
        if index not in self.shots:
            raise self.absent(index)
        time_s, depth_stamp, colour_stamp = self.shots[index]
        where = f"{self.path}: {self.depth_topic}, image {index}"
        depth_m = images.depth_m(self.bag.message(self.depth_topic, depth_stamp), self.unit_mm, where)
        self._check_size(where, depth_m.shape, self.lens)
        camera = self.lens.camera
        depth_m = self.lens.straight(depth_m, float("nan"))
        return Frame(index, time_s, depth_m, camera, None, self._colour(index, depth_m, colour_stamp))

    def truth(self) -> dict[int, Array] | None:
        """Return None: bags do not tell the object's pose."""
        return None

    @property
    def layout(self) -> str:
        """What the sequence is stored as."""
        kinds = {".bag": "ROS 1 bag", ".mcap": "MCAP file", ".db3": "ROS 2 bag"}
        realsense = ", by RealSense" if self.depth_topic.startswith("/device_") else ""
        return f"{kinds.get(self.path.suffix.lower(), 'ROS 2 bag')}{realsense}, topic {self.depth_topic}"

    @property
    def depth_unit(self) -> str:
        """What one unit of stored depth is."""
        return self.unit

    @property
    def notes(self) -> tuple[str, ...]:
        """What was assumed or left out."""
        return self.remarks

    def _colour(
        self, index: int, depth_m: npt.NDArray[np.float32], stamp: Stamp | None
    ) -> npt.NDArray[np.uint8] | None:
        if stamp is None or self.colour is None:
            return None
        where = f"{self.path}: {self.colour.topic}, for image {index}"
        picture = images.colour(self.bag.message(self.colour.topic, stamp), where)
        alignment = self.colour.alignment
        self._check_size(where, picture.shape[:2], self.lens if alignment is None else alignment.colour)
        return self.lens.straight(picture) if alignment is None else alignment.aligned(depth_m, picture)

    def _check_size(self, where: str, found: tuple[int, ...], lens: Lens) -> None:
        camera = lens.camera
        if found != (camera.height, camera.width):
            raise InputError(
                f"{where}: is {found[1]} x {found[0]} pixels where camera_info says {camera.width} x {camera.height}; "
                "record the topic to which camera_info belongs."
            )


def open_ros(path: Path, given: Given) -> RosSequence:
    """Open a bag. Which topics hold depth and aligned colour is told from their messages.

    Raises:
        InputError: where it is no bag, or lacks depth images or their camera.
    """
    bag = Bag(path)
    first = topics.first_images(bag)
    depth_topic = topics.depth_topic(bag, first, given)
    lens = topics.depth_lens(bag, depth_topic, first[depth_topic], given)
    colour, left = topics.colour_source(bag, first, (depth_topic, lens), given)
    unit_mm, unit = topics.unit(bag, depth_topic, first[depth_topic], given)
    times = _times(bag, depth_topic)
    if not times:
        raise InputError(f"{path}: holds no message of {depth_topic}; record it anew.")
    colours = [] if colour is None else _times(bag, colour.topic)
    partners = nearest([time_s for time_s, _ in times], [time_s for time_s, _ in colours], MAX_APART_S)
    shots = {
        index: (time_s, stamp, None if partner is None else colours[partner][1])
        for index, ((time_s, stamp), partner) in enumerate(zip(times, partners, strict=True))
    }
    alone = sum(partner is None for partner in partners)
    if colours and alone:
        left.append(f"{alone} depth images have no colour image within {MAX_APART_S * 1000:g} ms")
    return RosSequence(path, bag, depth_topic, colour, lens, unit_mm, unit, shots, tuple(left))


def _times(bag: Bag, topic: str) -> list[tuple[float, Stamp]]:
    """Return the times in s of the images of a topic, in order, each once: of capture, else of receipt."""
    found: dict[int, Stamp] = {}
    for stamp, message in bag.messages(topic):
        time = message.header.stamp
        found.setdefault(int(time.sec) * 10**9 + int(time.nanosec) or stamp.received_ns, stamp)
    return [(time_ns * 1e-9, found[time_ns]) for time_ns in sorted(found)]
