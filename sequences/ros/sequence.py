"""Depth images in bags of ROS 1 and ROS 2 and in MCAP files, RealSense's recordings among them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np
import numpy.typing as npt

from modeler.types import InputError
from sequences.given import Given
from sequences.lens import Lens
from sequences.ros import images, topics
from sequences.ros.bag import Bag, Stamp
from sequences.streams import AbstractStreams, paired


@final
@dataclass(frozen=True)
class RosSequence(AbstractStreams[Stamp]):
    """The depth images of one topic, and the colour images that are aligned to them."""

    bag: Bag
    """The open bag."""
    depth_topic: str
    """Topic of the depth images."""
    colour: topics.Colour | None
    """Where colour comes from."""
    unit_mm: float
    """Millimetres per unit of 16-bit depth."""
    unit: str
    """The unit in words."""

    def seen_m(self, index: int, stamp: Stamp) -> npt.NDArray[np.float32]:
        """Return the depth (h, w) in m as the lens shows it, NaN where nothing was measured."""
        where = f"{self.path}: {self.depth_topic}, image {index}"
        depth_m = images.depth_m(self.bag.message(self.depth_topic, stamp), self.unit_mm, where)
        self._check_size(where, depth_m.shape, self.lens)
        return depth_m

    def aligned(self, index: int, stamp: Stamp, depth_m: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8] | None:
        """Return colour (h, w, 3) as RGB at the pixels of depth; None without a topic of colour."""
        if self.colour is None:
            return None
        where = f"{self.path}: {self.colour.topic}, for image {index}"
        picture = images.colour(self.bag.message(self.colour.topic, stamp), where)
        alignment = self.colour.alignment
        self._check_size(where, picture.shape[:2], self.lens if alignment is None else alignment.colour)
        return self.lens.straight(picture) if alignment is None else alignment.aligned(depth_m, picture)

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
    pairs, alone = paired(times, [] if colour is None else _times(bag, colour.topic))
    return RosSequence(path, lens, pairs, (*left, *alone), bag, depth_topic, colour, unit_mm, unit)


def _times(bag: Bag, topic: str) -> list[tuple[float, Stamp]]:
    """Return the times in s of the images of a topic, in order, each once: of capture, else of receipt."""
    found: dict[int, Stamp] = {}
    for stamp, message in bag.messages(topic):
        time = message.header.stamp
        found.setdefault(int(time.sec) * 10**9 + int(time.nanosec) or stamp.received_ns, stamp)
    return [(time_ns * 1e-9, found[time_ns]) for time_ns in sorted(found)]
