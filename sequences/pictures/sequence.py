"""Sequences of depth pictures in a folder, whatever tells which pictures belong together."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import final

from modeler.types import Array, Camera, Frame
from sequences.files.images import (
    check_alike,
    check_size,
    finer,
    fitted,
    metres,
    picture_size,
    read_colour,
    read_depth,
    read_mask,
)
from sequences.given import Intrinsics
from sequences.recording import AbstractRecording


@final
@dataclass(frozen=True)
class Shot:
    """The pictures of one frame."""

    time_s: float
    """Time of capture in s."""
    depth: Path
    """16-bit picture."""
    colour: Path | None = None
    """Colour aligned to depth, in its size or finer."""
    mask: Path | None = None
    """Not black = object."""


@final
@dataclass(frozen=True)
class PictureSequence(AbstractRecording):
    """Pictures in folders with one camera for all of them."""

    shots: Mapping[int, Shot]
    """By frame number, ascending."""
    intrinsics: Intrinsics
    """fx, fy, cx, cy in px."""
    depth_scale_mm: float
    """Millimetres per unit of depth."""
    what: str
    """The layout in words."""
    unit_source: str
    """Who says what the unit is."""
    read_truth: Callable[[], dict[int, Array] | None] = lambda: None
    """Reads the true camera_from_model (4, 4) in m by frame number, when it is asked for."""
    remarks: tuple[str, ...] = ()
    """What the reader assumed or left out."""

    def __post_init__(self) -> None:
        """Check `sequence.json`.

        Raises:
            InputError: where it cannot be used.
        """
        _ = self.name, self.sensor(), self.motion

    @property
    def indices(self) -> tuple[int, ...]:
        """Frame numbers, ascending."""
        return tuple(self.shots)

    def frame(self, index: int) -> Frame:
        """Return the frame with number `index`, depth in m and NaN where nothing was measured."""
        shot = self.shots.get(index)
        if shot is None:
            raise self.absent(index)
        raw = read_depth(shot.depth)
        first = self.shots[self.indices[0]].depth
        check_alike(shot.depth, raw.shape, first, "and one camera took them all; convert each size by itself")
        mask = None if shot.mask is None else read_mask(shot.mask)
        colour = None if shot.colour is None else read_colour(shot.colour)
        if shot.mask is not None and mask is not None:
            check_size(shot.mask, mask.shape, raw.shape)
        if shot.colour is not None and colour is not None:
            colour = fitted(shot.colour, colour, raw.shape)
        camera = Camera(raw.shape[1], raw.shape[0], *self.intrinsics)
        return Frame(index, shot.time_s, metres(raw, self.depth_scale_mm), camera, mask, colour)

    def truth(self) -> dict[int, Array] | None:
        """Return the true camera_from_model (4, 4), in m, by frame number; None where it is not known."""
        return self.read_truth()

    @property
    def layout(self) -> str:
        """What the sequence is stored as."""
        return self.what

    @property
    def depth_unit(self) -> str:
        """What one unit of stored depth is."""
        return f"{self.depth_scale_mm:g} mm ({self.unit_source})"

    @property
    def notes(self) -> tuple[str, ...]:
        """What the reader assumed, or left out."""
        coloured = next((shot for shot in self.shots.values() if shot.colour is not None), None)
        if coloured is None or coloured.colour is None:
            return self.remarks
        colour, depth = picture_size(coloured.colour), picture_size(coloured.depth)
        if not finer(colour, depth):
            return self.remarks
        sizes = f"{colour[0]} x {colour[1]} where depth is {depth[0]} x {depth[1]}"
        return (*self.remarks, f"colour is {sizes}: it is shrunk, and taken for the depth camera's view")
