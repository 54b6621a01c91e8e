"""Arrays and views in a temporary file, mapped into memory: the system reads what is used, and drops it again."""

from __future__ import annotations

import mmap
import sys
import tempfile
import weakref
from dataclasses import replace
from typing import IO, TypeVar

import numpy as np
import numpy.typing as npt

from modeler.types import Frame, RayImage

_Number = TypeVar("_Number", bound=np.generic)


class DiskArrays:
    """Arrays in files of `TMPDIR`, which have no names, and end with the last of their arrays, or with the process."""

    def __init__(self, chunk_bytes: int = 128 * 2**20) -> None:
        """Open nothing yet.

        Args:
            chunk_bytes: of a file, if no array is larger.
        """
        self._chunk_bytes = chunk_bytes
        self._file: IO[bytes] | None = None
        self._chunk: mmap.mmap | None = None
        self._chunks: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()
        self._filled = 0

    def written(self, array: npt.NDArray[_Number]) -> npt.NDArray[_Number]:
        """Return an array that is on disk; OSError if it cannot be written."""
        if not array.size:
            return array
        if self._chunk is None or self._filled + array.nbytes > len(self._chunk):
            self._chunk = self._mapped(max(self._chunk_bytes, array.nbytes))
        assert self._file is not None
        offset, self._filled = self._filled, -(-(self._filled + array.nbytes) // 64) * 64
        self._file.seek(offset)
        self._file.write(np.ascontiguousarray(array).data.cast("B"))
        self._file.flush()
        return np.ndarray(array.shape, array.dtype, self._chunk, offset)  # one object, not four

    def release(self) -> None:
        """Drop from memory what was read of the arrays; where it is used again, it is read again."""
        if sys.platform == "linux":
            for chunk in self._chunks:
                chunk.madvise(mmap.MADV_DONTNEED)

    def _mapped(self, size: int) -> mmap.mmap:
        """Return another file as memory; what was read of those before need not stay there."""
        self.release()
        file = tempfile.TemporaryFile(prefix="modeler-")
        weakref.finalize(self, file.close)
        file.truncate(size)
        # Writable, because compiled functions tell such arrays from others; nothing is written through it.
        chunk = mmap.mmap(file.fileno(), size, access=mmap.ACCESS_WRITE)
        if self._file is not None:
            self._file.close()
        self._chunks.add(chunk)
        self._file, self._filled = file, 0
        return chunk


def release(array: npt.NDArray[np.generic]) -> None:
    """Drop from memory what was read of the part of a file in which an array lies; nothing for an array in memory."""
    owner: object = array
    while isinstance(owner, np.ndarray):
        owner = owner.base
    if isinstance(owner, mmap.mmap) and sys.platform == "linux":
        owner.madvise(mmap.MADV_DONTNEED)


class ViewStore:
    """Keeps frames, and views without the images that a likelihood looks up, ten times as large as the frame.

    The first stay in memory. Once they fill `memory_bytes`, the arrays of further ones go to disk. Where they
    cannot be written, they stay in memory too.
    """

    def __init__(self, memory_bytes: int = 64 * 2**20, chunk_bytes: int = 64 * 2**20) -> None:
        """Open a store.

        Args:
            memory_bytes: of views that stay in memory.
            chunk_bytes: see `DiskArrays`.
        """
        self._left_bytes, self._disk = memory_bytes, DiskArrays(chunk_bytes)

    def keep(self, view: RayImage) -> RayImage:
        """Return a view without layers, its arrays in memory or on disk."""
        light = replace(view, layers={})
        if self._fits(_images(view.frame), view.points_m, view.normals, view.pixels):
            return light
        try:
            return replace(
                light,
                frame=self._written(view.frame),
                points_m=self._disk.written(view.points_m),
                normals=self._disk.written(view.normals),
                pixels=self._disk.written(view.pixels),
            )
        except OSError:
            return light

    def keep_frame(self, frame: Frame) -> Frame:
        """Return a frame, its images in memory or on disk."""
        if self._fits(_images(frame)):
            return frame
        try:
            return self._written(frame)
        except OSError:
            return frame

    def _fits(self, images: list[npt.NDArray[np.generic]], *arrays: npt.NDArray[np.generic]) -> bool:
        """Return whether arrays may stay in memory, and count them if so."""
        size = sum(array.nbytes for array in (*images, *arrays))
        fits = size <= self._left_bytes
        self._left_bytes -= size if fits else 0
        return fits

    def _written(self, frame: Frame) -> Frame:
        """Return a frame whose images are on disk."""
        return replace(
            frame,
            mask=None if frame.mask is None else self._disk.written(frame.mask),
            colour=None if frame.colour is None else self._disk.written(frame.colour),
            occluder=None if frame.occluder is None else self._disk.written(frame.occluder),
            depth_m=self._disk.written(frame.depth_m),
        )


def _images(frame: Frame) -> list[npt.NDArray[np.generic]]:
    return [image for image in (frame.depth_m, frame.mask, frame.colour, frame.occluder) if image is not None]
