"""Views on disk, so that the memory of a run does not grow with the number of its frames."""

from __future__ import annotations

import mmap
import sys
import tempfile
import weakref
from dataclasses import replace
from typing import IO, TypeVar, final

import numpy as np
import numpy.typing as npt

from modeler.types import RayImage

_Number = TypeVar("_Number", bound=np.generic)
_ALIGNMENT = 64  # bytes, for every type of number


@final
class ViewStore:
    """Keeps views without the images that a likelihood looks up, which are ten times as large as the frame.

    The first views stay in memory. Once they fill `memory_bytes`, the arrays of further ones are written to a temporary
    file (in `TMPDIR`), which has no name and ends with the process, and are mapped from there: the operating system
    reads what is used, and drops it again. Where the file cannot be written, they stay in memory too.
    """

    def __init__(self, memory_bytes: int = 256 * 2**20, chunk_bytes: int = 128 * 2**20) -> None:
        """Open a store.

        Args:
            memory_bytes: of views that stay in memory.
            chunk_bytes: of the file that are mapped together, a multiple of 64 kB.
        """
        self._left_bytes, self._chunk_bytes = memory_bytes, chunk_bytes
        self._file: IO[bytes] | None = None
        self._chunk: mmap.mmap | None = None
        self._start, self._filled = -chunk_bytes, chunk_bytes

    def keep(self, view: RayImage) -> RayImage:
        """Return a view without layers, its arrays in memory or on disk."""
        light, frame = replace(view, layers={}), view.frame
        arrays = (frame.depth_m, frame.mask, frame.colour, view.points_m, view.normals, view.pixels)
        size = sum(array.nbytes + _ALIGNMENT for array in arrays if array is not None)
        if size <= self._left_bytes or size > self._chunk_bytes:
            self._left_bytes -= size
            return light
        try:
            mask = None if frame.mask is None else self._written(frame.mask)
            colour = None if frame.colour is None else self._written(frame.colour)
            return replace(
                light,
                frame=replace(frame, depth_m=self._written(frame.depth_m), mask=mask, colour=colour),
                points_m=self._written(view.points_m),
                normals=self._written(view.normals),
                pixels=self._written(view.pixels),
            )
        except OSError:
            return light

    def _written(self, array: npt.NDArray[_Number]) -> npt.NDArray[_Number]:
        """Return an array that is on disk.

        Raises:
            OSError: where it cannot be written.
        """
        if not array.size:
            return array
        if self._filled + array.nbytes > self._chunk_bytes:
            self._open_chunk()
        assert self._file is not None
        assert self._chunk is not None
        offset, self._filled = self._filled, -(-(self._filled + array.nbytes) // _ALIGNMENT) * _ALIGNMENT
        self._file.seek(self._start + offset)
        self._file.write(array.tobytes())
        self._file.flush()
        return np.frombuffer(self._chunk, array.dtype, array.size, offset).reshape(array.shape)

    def _open_chunk(self) -> None:
        """Map another part of the file; what was read of the one before need not stay in memory."""
        if self._file is None:
            self._file = tempfile.TemporaryFile(prefix="modeler-")
            weakref.finalize(self, self._file.close)
        if self._chunk is not None and sys.platform == "linux":
            self._chunk.madvise(mmap.MADV_DONTNEED)
        start = self._start + self._chunk_bytes
        self._file.truncate(start + self._chunk_bytes)
        # Writable, because compiled functions tell such arrays from others; nothing is written through it.
        self._chunk = mmap.mmap(self._file.fileno(), self._chunk_bytes, access=mmap.ACCESS_WRITE, offset=start)
        self._start, self._filled = start, 0
