"""Views on disk, so that the memory of a run does not grow with the number of its frames."""

from __future__ import annotations

from dataclasses import replace
from typing import final

from modeler.disk_arrays import DiskArrays
from modeler.types import RayImage


@final
class ViewStore:
    """Keeps views without the images that a likelihood looks up, which are ten times as large as the frame.

    The first views stay in memory. Once they fill `memory_bytes`, the arrays of further ones go to disk. Where they
    cannot be written, they stay in memory too.
    """

    def __init__(self, memory_bytes: int = 256 * 2**20, chunk_bytes: int = 128 * 2**20) -> None:
        """Open a store.

        Args:
            memory_bytes: of views that stay in memory.
            chunk_bytes: see `DiskArrays`.
        """
        self._left_bytes, self._disk = memory_bytes, DiskArrays(chunk_bytes)

    def keep(self, view: RayImage) -> RayImage:
        """Return a view without layers, its arrays in memory or on disk."""
        light, frame = replace(view, layers={}), view.frame
        arrays = (frame.depth_m, frame.mask, frame.colour, view.points_m, view.normals, view.pixels)
        size = sum(array.nbytes for array in arrays if array is not None)
        if size <= self._left_bytes:
            self._left_bytes -= size
            return light
        try:
            mask = None if frame.mask is None else self._disk.written(frame.mask)
            colour = None if frame.colour is None else self._disk.written(frame.colour)
            return replace(
                light,
                frame=replace(frame, depth_m=self._disk.written(frame.depth_m), mask=mask, colour=colour),
                points_m=self._disk.written(view.points_m),
                normals=self._disk.written(view.normals),
                pixels=self._disk.written(view.pixels),
            )
        except OSError:
            return light

    def release(self) -> None:
        """Drop from memory what was read of the views on disk; where it is used again, it is read again."""
        self._disk.release()
