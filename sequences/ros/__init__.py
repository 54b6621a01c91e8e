"""Depth images in bags of ROS 1 and ROS 2 and in MCAP files, RealSense recordings among them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from modeler.sequences.intrinsics import Overrides
from modeler.sequences.lens import Alignment, Lens
from modeler.sequences.recording import AbstractStreams, paired
from modeler.sequences.ros import messages
from modeler.sequences.ros.bag import Bag, Stamp
from modeler.sequences.ros.messages import (
    realsense_colour_from_depth,
    realsense_lens,
    realsense_unit_mm,
    static_transform,
)
from modeler.types import Camera, InputError


def first_images(bag: Bag) -> dict[str, Any]:
    """Return the first message of each topic of images."""
    topics = sorted(topic for topic, kind in bag.types.items() if kind in (messages.IMAGE, messages.PACKED))
    found = {topic: bag.first(topic) for topic in topics}
    return {topic: message for topic, message in found.items() if message is not None}


def choose_depth_topic(bag: Bag, first: Mapping[str, Any], overrides: Overrides) -> str:
    """Return the topic of depth images."""
    found = [topic for topic, message in first.items() if messages.is_depth(message)]
    if overrides.depth_topic is not None:
        if overrides.depth_topic not in found:
            raise InputError(f"{bag.path}: {overrides.depth_topic} holds no depth images; {_listed(found)}.")
        return overrides.depth_topic
    for better in (
        [topic for topic in found if "depth" in topic.lower()],
        [topic for topic in found if not topic.endswith("compressedDepth")],
        [topic for topic in found if "aligned" in topic or "registered" in topic],  # colour comes with it
    ):
        found = better or found
    if not found:
        raise InputError(f"{bag.path}: holds no depth images (16UC1 or 32FC1); its image topics are: {_names(first)}.")
    if len(found) > 1:
        raise InputError(f"{bag.path}: {_listed(found)}; convert with `depth_topic`.")
    return found[0]


def depth_lens(bag: Bag, topic: str, image: Any, overrides: Overrides) -> Lens:
    """Return the camera of a topic."""
    if overrides.intrinsics is not None:
        if image.__msgtype__ == messages.IMAGE:
            return Lens(Camera(int(image.width), int(image.height), *overrides.intrinsics), ())
        height, width = messages.depth_m(image, 1.0, f"{bag.path}: {topic}").shape
        return Lens(Camera(width, height, *overrides.intrinsics), ())
    known = _camera(bag, topic)
    if known is None:
        raise InputError(
            f"{bag.path}: no camera_info belongs to {topic}; record it too, or convert with `intrinsics` FX FY CX CY."
        )
    return known


def _camera(bag: Bag, topic: str) -> Lens | None:
    """Return the camera of the first camera_info message that belongs to a topic; None without."""
    infos = [other for other, kind in bag.types.items() if kind == messages.CAMERA]
    bare = re.sub(r"/(compressedDepth|compressed|theora)$", "", topic)
    parent = bare.rsplit("/", 1)[0]
    wanted = (f"{parent}/camera_info", f"{parent.rsplit('/', 1)[0]}/info/camera_info", f"{bare}/camera_info")
    for info in (name for name in wanted if name in infos):
        if (message := bag.first(info)) is not None:
            known = messages.lens(message, f"{bag.path}: {info}", ros1=bag.is_ros1)
            return Lens(known.camera, ()) if "rect" in bare.rsplit("/", 1)[1] else known
    return realsense_lens(bag, topic)


@dataclass(frozen=True, eq=False)
class ColourSource:
    """Where colour comes from."""

    topic: str
    alignment: Alignment | None
    """Where their camera is; None if they have the depth camera's pixels."""


def colour_source(
    bag: Bag, first: Mapping[str, Any], depth: tuple[str, Lens], overrides: Overrides
) -> tuple[ColourSource | None, list[str]]:
    """Return the source of colour that is or can be aligned to depth, and a note on other colour."""
    found = [topic for topic, message in first.items() if messages.is_colour(message)]
    if overrides.colour_topic is not None:
        if overrides.colour_topic not in found:
            raise InputError(f"{bag.path}: {overrides.colour_topic} holds no colour images; there are {_names(found)}.")
        return ColourSource(overrides.colour_topic, _beside(bag, first, overrides.colour_topic, depth)), []
    cameras, left = {}, []
    for topic in found:
        try:
            cameras[topic] = _camera(bag, topic)
        except InputError as error:  # depth is enough
            left.append(f"colour of {topic} is left out: {str(error).removeprefix(f'{bag.path}: ')}")
    aligned = [topic for topic, camera in cameras.items() if _same(camera, depth[1])]
    for better in (
        [topic for topic in aligned if "color" in topic or "rgb" in topic or "colour" in topic],
        [topic for topic in aligned if first[topic].__msgtype__ == messages.IMAGE],
    ):
        aligned = better or aligned
    if aligned:
        return ColourSource(aligned[0], None), []
    for topic in (name for name in cameras if "color" in name.lower() or "rgb" in name):
        alignment = _beside(bag, first, topic, depth)
        if alignment is not None:
            return ColourSource(topic, alignment), []
    return None, (left + [f"colour of {topic} is not aligned to depth and is left out" for topic in cameras])[:3]


def _beside(bag: Bag, first: Mapping[str, Any], topic: str, depth: tuple[str, Lens]) -> Alignment | None:
    """Return the alignment of a colour topic with depth; None if unknown."""
    camera, motion = _camera(bag, topic), realsense_colour_from_depth(bag, topic, depth[0])
    if motion is None:
        motion = static_transform(bag, first[topic].header.frame_id, first[depth[0]].header.frame_id)
    return None if camera is None or motion is None else Alignment(depth[1].camera, camera, motion)


def _same(one: Lens | None, other: Lens) -> bool:
    """Return whether two cameras see the same thing at every pixel."""
    if one is None:
        return False
    ours, theirs = one.camera, other.camera
    alike = np.allclose([ours.fx, ours.fy, ours.cx, ours.cy], [theirs.fx, theirs.fy, theirs.cx, theirs.cy], atol=0.5)
    return (ours.width, ours.height) == (theirs.width, theirs.height) and bool(alike)


def choose_unit(bag: Bag, topic: str, image: Any, overrides: Overrides) -> tuple[float, str]:
    """Return the millimetres per unit of 16-bit depth, and the unit for people."""
    if overrides.depth_scale_mm is not None:
        return overrides.depth_scale_mm, f"{overrides.depth_scale_mm:g} mm (`depth_scale_mm`)"
    if image.__msgtype__ == messages.IMAGE and image.encoding in messages.METRES:
        return 1000.0, "m (32FC1)"
    found = realsense_unit_mm(bag, topic)
    if found is not None:
        return found[0], f"{found[0]:g} mm ({found[1]})"
    return 1.0, "1 mm (16UC1)"


def _listed(topics: list[str]) -> str:
    return f"depth images are in {_names(topics)}" if topics else "there are none"


def _names(topics: Iterable[str]) -> str:
    return ", ".join(topics) or "none"


@dataclass(frozen=True)
class RosSequence(AbstractStreams[Stamp]):
    """The depth images of one topic, and the colour images that are aligned to them."""

    bag: Bag
    depth_topic: str
    colour: ColourSource | None
    unit_mm: float
    """Millimetres per unit of 16-bit depth."""
    unit: str
    """The unit, for people."""

    def seen_m(self, index: int, stamp: Stamp) -> npt.NDArray[np.float32]:
        where = f"{self.path}: {self.depth_topic}, image {index}"
        depth_m = messages.depth_m(self.bag.message(self.depth_topic, stamp), self.unit_mm, where)
        self._check_size(where, depth_m.shape, self.lens)
        return depth_m

    def colour_at(self, index: int, stamp: Stamp, depth_m: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8] | None:
        if self.colour is None:
            return None
        where = f"{self.path}: {self.colour.topic}, for image {index}"
        image = messages.colour(self.bag.message(self.colour.topic, stamp), where)
        alignment = self.colour.alignment
        self._check_size(where, image.shape[:2], self.lens if alignment is None else alignment.colour)
        return self.lens.undistort(image) if alignment is None else alignment.align(depth_m, image)

    @property
    def layout(self) -> str:
        kinds = {".bag": "ROS 1 bag", ".mcap": "MCAP file", ".db3": "ROS 2 bag"}
        realsense = ", by RealSense" if self.depth_topic.startswith("/device_") else ""
        return f"{kinds.get(self.path.suffix.lower(), 'ROS 2 bag')}{realsense}, topic {self.depth_topic}"

    @property
    def depth_unit(self) -> str:
        return self.unit

    def _check_size(self, where: str, found: tuple[int, ...], lens: Lens) -> None:
        camera = lens.camera
        if found != (camera.height, camera.width):
            raise InputError(
                f"{where}: is {found[1]} x {found[0]} pixels where camera_info says {camera.width} x {camera.height}; "
                "record the topic to which camera_info belongs."
            )


def open_ros(path: Path, overrides: Overrides) -> RosSequence:
    """Open a bag; topics of depth and colour are recognised from their messages."""
    bag = Bag(path)
    first = first_images(bag)
    depth_topic = choose_depth_topic(bag, first, overrides)
    lens = depth_lens(bag, depth_topic, first[depth_topic], overrides)
    colour, left = colour_source(bag, first, (depth_topic, lens), overrides)
    unit_mm, unit = choose_unit(bag, depth_topic, first[depth_topic], overrides)
    times = _times(bag, depth_topic)
    if not times:
        raise InputError(f"{path}: holds no message of {depth_topic}; record it again.")
    pairs, unpaired = paired(times, [] if colour is None else _times(bag, colour.topic))
    about = {"remarks": (*left, *unpaired), "calibrated": overrides.intrinsics is None}
    return RosSequence(path, lens, pairs, bag, depth_topic, colour, unit_mm, unit, **about)


def _times(bag: Bag, topic: str) -> list[tuple[float, Stamp]]:
    """Return the times in s of the images of a topic, in order, each once: of capture, else of receipt."""
    found: dict[int, Stamp] = {}
    for stamp, message in bag.messages(topic):
        time = message.header.stamp
        found.setdefault(int(time.sec) * 10**9 + int(time.nanosec) or stamp.received_ns, stamp)
    return [(time_ns * 1e-9, found[time_ns]) for time_ns in sorted(found)]
