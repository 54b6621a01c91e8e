"""Which topics of a bag hold depth, the camera that took it, and colour that is aligned to it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from modeler.types import Camera, InputError
from sequences.alignment import Alignment
from sequences.given import Given
from sequences.lens import Lens
from sequences.ros import frames, images, realsense
from sequences.ros.bag import Bag


def first_images(bag: Bag) -> dict[str, Any]:
    """Return the first message of each topic of images."""
    kinds = (images.IMAGE, images.PACKED)
    found = {}
    for topic in sorted(topic for topic, kind in bag.types.items() if kind in kinds):
        for _, message in bag.messages(topic, most=1):
            found[topic] = message
    return found


def depth_topic(bag: Bag, first: Mapping[str, Any], given: Given) -> str:
    """Return the topic of depth images.

    Raises:
        InputError: where there is none or nothing tells which.
    """
    found = [topic for topic, message in first.items() if images.is_depth(message)]
    if given.depth_topic is not None:
        if given.depth_topic not in found:
            raise InputError(f"{bag.path}: {given.depth_topic} holds no depth images; {_listed(found)}.")
        return given.depth_topic
    for better in (
        [topic for topic in found if "depth" in topic.lower()],
        [topic for topic in found if not topic.endswith("compressedDepth")],
        [topic for topic in found if "aligned" in topic or "registered" in topic],  # colour comes with it
    ):
        found = better or found
    if not found:
        raise InputError(f"{bag.path}: holds no depth images (16UC1 or 32FC1); its image topics are: {_names(first)}.")
    if len(found) > 1:
        raise InputError(f"{bag.path}: {_listed(found)}; convert with --depth-topic.")
    return found[0]


def depth_lens(bag: Bag, topic: str, image: Any, given: Given) -> Lens:
    """Return the camera of a topic.

    Raises:
        InputError: where nothing tells it.
    """
    if given.intrinsics is not None:
        if image.__msgtype__ == images.IMAGE:
            return Lens(Camera(int(image.width), int(image.height), *given.intrinsics), ())
        height, width = images.depth_m(image, 1.0, f"{bag.path}: {topic}").shape
        return Lens(Camera(width, height, *given.intrinsics), ())
    known = _camera(bag, topic)
    if known is None:
        raise InputError(
            f"{bag.path}: no camera_info belongs to {topic}; record it too, or convert with --intrinsics FX FY CX CY."
        )
    return known


def _camera(bag: Bag, topic: str) -> Lens | None:
    """Return what the first camera_info message beside a topic of images says; None where there is none."""
    infos = [other for other, kind in bag.types.items() if kind == images.CAMERA]
    bare = re.sub(r"/(compressedDepth|compressed|theora)$", "", topic)
    parent = bare.rsplit("/", 1)[0]
    wanted = (f"{parent}/camera_info", f"{parent.rsplit('/', 1)[0]}/info/camera_info", f"{bare}/camera_info")
    for info in (name for name in wanted if name in infos):
        for _, message in bag.messages(info, most=1):
            known = images.lens(message, f"{bag.path}: {info}", ros1=bag.is_ros1)
            return Lens(known.camera, ()) if "rect" in bare.rsplit("/", 1)[1] else known
    return realsense.lens(bag, topic)


@final
@dataclass(frozen=True, eq=False)
class Colour:
    """Where colour comes from."""

    topic: str
    """Topic of the images."""
    alignment: Alignment | None
    """Where their camera is; None where they have the depth camera's pixels."""


def colour_source(
    bag: Bag, first: Mapping[str, Any], depth: tuple[str, Lens], given: Given
) -> tuple[Colour | None, list[str]]:
    """Return where colour comes from that is or can be aligned to depth, and what is said of other colour.

    Args:
        bag: the bag.
        first: the first image of each topic.
        depth: topic and camera of the depth images.
        given: what a person says.

    Raises:
        InputError: where the topic asked for holds none.
    """
    found = [topic for topic, message in first.items() if images.is_colour(message)]
    if given.colour_topic is not None:
        if given.colour_topic not in found:
            raise InputError(f"{bag.path}: {given.colour_topic} holds no colour images; there are {_names(found)}.")
        return Colour(given.colour_topic, _beside(bag, first, given.colour_topic, depth)), []
    cameras, left = {}, []
    for topic in found:
        try:
            cameras[topic] = _camera(bag, topic)
        except InputError as error:  # depth is enough
            left.append(f"colour of {topic} is left out: {str(error).removeprefix(f'{bag.path}: ')}")
    aligned = [topic for topic, camera in cameras.items() if _same(camera, depth[1])]
    for better in (
        [topic for topic in aligned if "color" in topic or "rgb" in topic or "colour" in topic],
        [topic for topic in aligned if first[topic].__msgtype__ == images.IMAGE],
    ):
        aligned = better or aligned
    if aligned:
        return Colour(aligned[0], None), []
    for topic in (name for name in cameras if "color" in name.lower() or "rgb" in name):
        alignment = _beside(bag, first, topic, depth)
        if alignment is not None:
            return Colour(topic, alignment), []
    return None, (left + [f"colour of {topic} is not aligned to depth and is left out" for topic in cameras])[:3]


def _beside(bag: Bag, first: Mapping[str, Any], topic: str, depth: tuple[str, Lens]) -> Alignment | None:
    """Return where the camera of a colour topic is; None where nothing tells it."""
    camera, motion = _camera(bag, topic), realsense.colour_from_depth(bag, topic, depth[0])
    if motion is None:
        motion = frames.fixed(bag, first[topic].header.frame_id, first[depth[0]].header.frame_id)
    return None if camera is None or motion is None else Alignment(depth[1].camera, camera, motion)


def _same(one: Lens | None, other: Lens) -> bool:
    """Return whether two cameras see the same thing at every pixel."""
    if one is None:
        return False
    ours, theirs = one.camera, other.camera
    alike = np.allclose([ours.fx, ours.fy, ours.cx, ours.cy], [theirs.fx, theirs.fy, theirs.cx, theirs.cy], atol=0.5)
    return (ours.width, ours.height) == (theirs.width, theirs.height) and bool(alike)


def unit(bag: Bag, topic: str, image: Any, given: Given) -> tuple[float, str]:
    """Return the millimetres in one unit of 16-bit depth, and the unit in words."""
    if given.depth_scale_mm is not None:
        return given.depth_scale_mm, f"{given.depth_scale_mm:g} mm (--depth-scale-mm)"
    if image.__msgtype__ == images.IMAGE and image.encoding in images.METRES:
        return 1000.0, "m (32FC1)"
    found = realsense.unit_mm(bag, topic)
    if found is not None:
        return found[0], f"{found[0]:g} mm ({found[1]})"
    return 1.0, "1 mm (16UC1)"


def _listed(topics: list[str]) -> str:
    return f"depth images are in {_names(topics)}" if topics else "there are none"


def _names(topics: Iterable[str]) -> str:
    return ", ".join(topics) or "none"
