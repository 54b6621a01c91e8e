"""What is done to a capture: every way is one thing that people do, or that happens to them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final, final

import numpy as np

from modeler.sequences.base import AbstractDerived
from modeler.types import Array, Frame

Chosen = Callable[[tuple[int, ...]], tuple[int, ...]]
"""Returns the frame numbers of the capture in the order in which they are shown."""
Change = Callable[[Frame, np.random.Generator], Frame]
"""Returns a frame changed."""
QUARTER_TURN: Final = ((0.0, -1.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
"""Rows of turned_from_camera (4, 4) of an image rotated clockwise by 90°."""


@final
@dataclass(frozen=True)
class Way:
    """One way to change a capture."""

    chosen: Chosen = lambda indices: indices
    change: Change = lambda frame, rng: frame
    new_from_old: tuple[tuple[float, ...], ...] | None = None
    """Camera frame of the changed images from that of the capture, as rows of a (4, 4) matrix; None: the same."""
    least_frames: int = 4
    """Fewer frames than this make no object: the capture is not changed so."""


def _every(stride: int) -> Chosen:
    return lambda indices: indices[::stride]


def _halved(frame: Frame, rng: np.random.Generator) -> Frame:
    """Return the frame with half the resolution: every second pixel, as a camera's decimation filter gives."""
    camera = frame.camera
    height, width = camera.height // 2, camera.width // 2
    small = replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx / 2.0,
        fy=camera.fy / 2.0,
        cx=camera.cx / 2.0,
        cy=camera.cy / 2.0,
    )
    return _images(frame, small, lambda image: np.ascontiguousarray(image[: 2 * height : 2, : 2 * width : 2]))


def _cropped(frame: Frame, rng: np.random.Generator) -> Frame:
    """Return the middle of the image: an eighth is cut off each side."""
    camera = frame.camera
    top, left = camera.height // 8, camera.width // 8
    height, width = camera.height - 2 * top, camera.width - 2 * left
    small = replace(camera, width=width, height=height, cx=camera.cx - left, cy=camera.cy - top)
    return _images(frame, small, lambda image: np.ascontiguousarray(image[top : top + height, left : left + width]))


def _turned(frame: Frame, rng: np.random.Generator) -> Frame:
    """Return the image rotated clockwise by 90°, as of a camera on its side."""
    camera = frame.camera
    turned = replace(
        camera,
        width=camera.height,
        height=camera.width,
        fx=camera.fy,
        fy=camera.fx,
        cx=camera.height - 1.0 - camera.cy,
        cy=camera.cx,
    )
    return _images(frame, turned, lambda image: np.ascontiguousarray(np.rot90(image, -1)))


def _noisy(frame: Frame, rng: np.random.Generator) -> Frame:
    """Return depth with noise of 2 mm at 1 m, growing with its square as stereo's does."""
    noise_m = 0.002 * frame.depth_m**2 * rng.standard_normal(frame.depth_m.shape)
    return replace(frame, depth_m=(frame.depth_m + noise_m).astype(np.float32))


def _holed(frame: Frame, rng: np.random.Generator) -> Frame:
    """Return depth with holes: discs of 2 % of the image's width, over a tenth of the image together."""
    depth_m = frame.depth_m.copy()
    height, width = depth_m.shape
    radius = 0.02 * width
    rows, columns = np.mgrid[:height, :width]
    for _ in range(round(0.1 * height * width / (np.pi * radius**2))):
        row, column = rng.uniform(0.0, height), rng.uniform(0.0, width)
        depth_m[(rows - row) ** 2 + (columns - column) ** 2 < radius**2] = np.nan
    return replace(frame, depth_m=depth_m)


def _zoomed(factor: float) -> Change:
    def change(frame: Frame, rng: np.random.Generator) -> Frame:
        camera = frame.camera
        return replace(frame, camera=replace(camera, fx=factor * camera.fx, fy=factor * camera.fy))

    return change


def _images(frame: Frame, camera: object, changed: Callable[[Array], Array]) -> Frame:
    """Return a frame with a camera and all images changed alike."""
    names = ("depth_m", "mask", "colour", "occluder")
    images = {name: changed(image) for name in names if (image := getattr(frame, name)) is not None}
    return replace(frame, camera=camera, **images)


WAYS: Final[Mapping[str, Way]] = MappingProxyType(
    {
        "as it is": Way(),
        "every second frame": Way(_every(2)),
        "every third frame": Way(_every(3)),
        "first half": Way(lambda indices: indices[: (len(indices) + 1) // 2]),
        "started elsewhere": Way(lambda indices: indices[len(indices) // 3 :] + indices[: len(indices) // 3]),
        "backwards": Way(lambda indices: indices[::-1]),
        "half the resolution": Way(change=_halved),
        "cropped": Way(change=_cropped),
        "rotated by 90°": Way(change=_turned, new_from_old=QUARTER_TURN),
        "more noise": Way(change=_noisy),
        "holes": Way(change=_holed),
        "no colour": Way(change=lambda frame, rng: replace(frame, colour=None)),
        "focal length 3 % long": Way(change=_zoomed(1.03)),
        "focal length 3 % short": Way(change=_zoomed(0.97)),
    }
)
"""By name."""


@final
@dataclass(frozen=True)
class Changed(AbstractDerived):
    """A capture, changed in one way. Frames are numbered anew in the order in which they are shown."""

    way: str
    """Of `WAYS`."""

    @property
    def shown(self) -> tuple[int, ...]:
        """Frame numbers of the capture, in the order in which they are shown."""
        return WAYS[self.way].chosen(self.whole.indices)

    @property
    def indices(self) -> tuple[int, ...]:
        """Frame numbers from 0."""
        return tuple(range(len(self.shown)))

    def frame(self, index: int) -> Frame:
        """Return a frame, changed."""
        number = self.shown[index]
        frame = WAYS[self.way].change(self.whole.frame(number), np.random.default_rng([number, len(self.way)]))
        return replace(frame, index=index, time_s=float(index))

    def truth(self) -> None:
        """Return None: the whole capture is the reference."""
