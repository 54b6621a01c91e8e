"""Colour images of a video, of which each has a depth image of its own beside it, as Stray Scanner writes them."""

from __future__ import annotations

import importlib
import importlib.util
import threading
import weakref
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any, final

import numpy as np
import numpy.typing as npt

from modeler.sequences.image_files import MAX_PIXELS
from modeler.sequences.input_files import input_errors
from modeler.system.regular_files import check_regular
from modeler.types import InputError


def can_decode() -> bool:
    """Return whether the library that decodes videos is installed."""
    return importlib.util.find_spec("av") is not None


@final
class Video:
    """A video whose images are read one after the other: to go back is to begin again."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock, self._next = threading.Lock(), 0
        self._images: Iterator[Any] = iter(())

    def image(self, number: int) -> npt.NDArray[np.uint8] | None:
        """Return an image, counted from 0, as RGB (h, w, 3); None if the video ends before it.

        Raises:
            InputError: if it cannot be decoded.
        """
        with self._lock, input_errors(self.path, "video", "record it again"):
            if number < self._next or self._next == 0:
                self._container.seek(0)
                self._next, self._images = 0, self._container.decode(video=0)
            for image in self._images:
                self._next += 1
                if self._next > number:
                    return np.asarray(image.to_ndarray(format="rgb24"), dtype=np.uint8)
        return None

    @cached_property
    def _container(self) -> Any:
        """Return the open file; it is closed when this video is forgotten."""
        av = importlib.import_module("av")
        check_regular(self.path)
        container = av.open(str(self.path), mode="r")
        weakref.finalize(self, container.close)
        (track, *_) = container.streams.video
        if not 0 < track.width * track.height <= MAX_PIXELS:
            raise InputError(f"{self.path}: has {track.width} x {track.height} pixels; record it again.")
        track.codec_context.options = {"max_pixels": str(MAX_PIXELS)}
        return container
