"""Runs streamed to a recording, and the recording read back."""

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import rerun.chunk

from modeler.types import Array, Step
from modeler.viz import entities
from modeler.viz.stream import open_stream

Recording = dict[str, dict[int, dict[str, Any]]]
MERGED = (entities.MERGED_BEFORE, entities.MERGED_AFTER)


def read(path: Path) -> Recording:
    """Return the rows of a recording by entity and frame (-1: static), each by component; rows of a frame merge."""
    rows: Recording = defaultdict(lambda: defaultdict(dict))
    for chunk in rerun.chunk.RrdReader(path).stream():
        batch = chunk.to_record_batch()
        columns = {name: batch[name].to_pylist() for name in batch.schema.names if name == "frame" or ":" in name}
        frames = columns.pop("frame", [-1] * chunk.num_rows)
        for row, frame in enumerate(frames):
            values = {name: column[row] for name, column in columns.items()}
            entity = rows[chunk.entity_path.removeprefix("/")][frame]
            entity |= {name.partition(":")[2]: value for name, value in values.items() if value is not None}
    return {entity: dict(frames) for entity, frames in rows.items()}


def record(path: Path, run: list[Step]) -> Recording:
    """Stream a run to a file and read it back."""
    stream = open_stream("box", save=path)
    for step in run:
        stream(step)
    stream.close()
    return read(path)


def drawn(recording: Recording, entity: str, component: str) -> dict[int, Array]:
    """Return a component by frame, without the frames that cleared it."""
    return {
        frame: np.array(row[component], dtype=np.float64)
        for frame, row in recording[entity].items()
        if component in row
    }
