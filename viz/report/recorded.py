"""What a run's recording holds of its frames."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from modeler.types import Array
from viz import entities

FRAME_PATHS: Final = (entities.COLOUR, entities.PAIR_TARGET, entities.PAIR_BEFORE, entities.PAIR_AFTER)
"""Entities that are read."""

Row = Mapping[str, Any]
"""Values of an entity by component."""


def recorded(recording: Path) -> dict[str, dict[int, dict[str, Any]]]:
    """Return the rows of the entities of `FRAME_PATHS` by frame; no frames where the recording cannot be read."""
    try:
        return _read(recording)
    except (OSError, ValueError, RuntimeError):
        return {path: {} for path in FRAME_PATHS}


def cloud(row: Row) -> tuple[Array, npt.NDArray[np.uint8]] | None:
    """Return points (n, 3) in m and colours (n, 3) of a row; None where it has none."""
    if "positions" not in row or "colors" not in row:
        return None
    points = np.array(row["positions"].as_py(), dtype=np.float64).reshape(-1, 3)
    packed = np.array(row["colors"].as_py(), dtype=np.uint32)
    colours = np.stack([packed >> 24, packed >> 16, packed >> 8], axis=1).astype(np.uint8)
    return points, np.broadcast_to(colours, points.shape)


def surfaces(rows: Mapping[str, Mapping[int, Row]], first: int) -> dict[int, Array]:
    """Return the surface points (n, 3) of each frame that was registered, and of the first, in its own camera's frame.

    Args:
        rows: as `recorded` returns them.
        first: number of the first accepted frame, which was registered to none.
    """
    found = {frame: cloud(row) for frame, row in rows[entities.PAIR_BEFORE].items()}
    targets = rows[entities.PAIR_TARGET]
    if targets:
        found[first] = cloud(targets[min(targets)])
    return {frame: points_colours[0] for frame, points_colours in found.items() if points_colours is not None}


def _read(recording: Path) -> dict[str, dict[int, dict[str, Any]]]:
    import rerun.chunk

    rows: dict[str, dict[int, dict[str, Any]]] = {path: {} for path in FRAME_PATHS}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a run that was killed leaves a recording without its last page
        for chunk in rerun.chunk.RrdReader(recording).stream():
            entity = rows.get(str(chunk.entity_path).removeprefix("/"))
            if entity is None or chunk.is_static:
                continue
            batch = chunk.to_record_batch()
            for name in batch.schema.names:
                component = name.partition(":")[2]
                if component in ("blob", "positions", "colors"):
                    for frame, value in zip(batch[entities.FRAME].to_pylist(), batch[name], strict=True):
                        if value.is_valid:
                            entity.setdefault(frame, {})[component] = value
    return rows
