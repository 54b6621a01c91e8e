"""Thumbnails of the pairs of a run, from its recording."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from PIL import Image

from modeler.types import Array
from viz import entities
from viz.blueprint import FROM_THE_SIDE
from viz.report.recorded import FRAME_PATHS, Row, cloud

_SIZE: Final = (150, 200)  # height and width in px
_JPEG_QUALITY: Final = 82
_BACKGROUND: Final = 250
_DOT: Final = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])  # pixels of a point


@dataclass(frozen=True)
class Thumbnails:
    """Small pictures of a frame as JPEG; None where there is nothing to show."""

    colour: bytes | None
    """What the camera saw."""
    before: bytes | None
    """The frame's surface and that of the view it was registered to, both in their own camera's coordinates."""
    after: bytes | None
    """The same under the mean of the posterior."""


def thumbnails(rows: Mapping[str, Mapping[int, Row]]) -> dict[int, Thumbnails]:
    """Return the pictures by frame number.

    Args:
        rows: what the recording holds, as `recorded` returns it.
    """
    frames = sorted({frame for entity in rows.values() for frame in entity})
    return {frame: _of_frame({path: rows[path].get(frame, {}) for path in FRAME_PATHS}) for frame in frames}


def _of_frame(rows: Mapping[str, Row]) -> Thumbnails:
    blob = rows[entities.COLOUR].get("blob")
    colour = None if blob is None else _small(bytes(blob.values[0].values.to_numpy()))
    target, before, after = (cloud(rows[path]) for path in FRAME_PATHS[1:])
    if target is None or before is None or after is None:
        return Thumbnails(colour, None, None)
    return Thumbnails(colour, _pair(target, before), _pair(target, after))


def _pair(*clouds: tuple[Array, npt.NDArray[np.uint8]]) -> bytes:
    """Return two clouds seen from the side, nearer points over farther ones; the first says where to look."""
    points = np.concatenate([cloud for cloud, _ in clouds])
    colours = np.concatenate([colour for _, colour in clouds])
    forward = -FROM_THE_SIDE / np.linalg.norm(FROM_THE_SIDE)
    right = np.cross(np.array([0.0, 1.0, 0.0]), forward)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward])
    centre = clouds[0][0].mean(axis=0)
    seen = (points - centre) @ axes.T
    reach_m = float(np.percentile(np.abs((clouds[0][0] - centre) @ axes.T), 99.5))
    height, width = _SIZE
    places = np.rint(seen[:, :2] * (0.40 * height / max(reach_m, 1e-9)) + 0.5 * np.array([width, height]))
    order = np.repeat(np.argsort(-seen[:, 2], kind="stable"), len(_DOT))
    picture = np.full((height, width, 3), _BACKGROUND, dtype=np.uint8)
    columns, rows = (places[order] + np.tile(_DOT, (len(points), 1))).astype(np.int64).T
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    picture[rows[inside], columns[inside]] = colours[order][inside]
    return _jpeg(Image.fromarray(picture))


def _small(jpeg: bytes) -> bytes:
    picture = Image.open(io.BytesIO(jpeg))
    height, width = _SIZE
    picture.thumbnail((width, height))
    return _jpeg(picture)


def _jpeg(picture: Image.Image) -> bytes:
    content = io.BytesIO()
    picture.save(content, "JPEG", quality=_JPEG_QUALITY)
    return content.getvalue()
