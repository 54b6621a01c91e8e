"""Reads a recording in a separate process."""

from __future__ import annotations

import subprocess
import sys
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from modeler.system.pictures import encoded
from modeler.system.processes import environment
from modeler.viz import entities

FRAME_PATHS: Final = (
    entities.COLOUR,
    entities.DEPTH,
    entities.MASK,
    entities.PAIR_TARGET,
    entities.PAIR_BEFORE,
    entities.PAIR_AFTER,
)
"""Entities that are shown."""
READ: Final = (*FRAME_PATHS, entities.PAIR_CAPTION)
_COMPONENTS: Final = ("blob", "buffer", "format", "positions", "colors", "labels")
_READER: Final = ("-m", "modeler.viz.reader")


@dataclass
class LoggedStep:
    """Data logged together."""

    frame: int
    """On the timeline."""
    rows: dict[str, dict[str, Any]] = field(default_factory=dict)
    """By entity."""


def steps_of(recording: Path) -> dict[int, LoggedStep]:
    """Return the steps of a run by the time, in ns since its start, at which they were drawn; none of a damaged one.

    Another process reads them, because Rerun 0.41 aborts the one in which it reads some damaged recordings.
    """
    read = subprocess.run(
        [sys.executable, *_READER, str(recording)],
        env=environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        check=False,
    )
    steps: dict[int, LoggedStep] = {}
    source = pa.BufferReader(read.stdout if read.returncode == 0 else b"")
    while source.tell() < source.size():
        with pa.ipc.open_stream(source) as stream:
            row, said = stream.read_all(), stream.schema.metadata
        step = steps.setdefault(int(said[b"elapsed"]), LoggedStep(int(said[b"frame"])))
        step.rows.setdefault(said[b"path"].decode(), {})[said[b"component"].decode()] = row["value"].combine_chunks()
    return steps


def write_steps(recording: Path, out: BinaryIO) -> None:
    """Write the steps of a run, each value as an Arrow stream of one row."""
    for elapsed, step in read_steps(recording).items():
        for path, values in step.rows.items():
            for component, value in values.items():
                key = {"elapsed": str(elapsed), "frame": str(step.frame), "path": path, "component": component}
                row = pa.record_batch([value], schema=pa.schema([pa.field("value", value.type)], metadata=key))
                with pa.ipc.new_stream(out, row.schema) as stream:
                    stream.write_batch(row)


def read_steps(recording: Path) -> dict[int, LoggedStep]:
    """Return the steps of a run as `steps_of` does, each value an array of one, for scalars are sent slowly."""
    import rerun.chunk

    steps: dict[int, LoggedStep] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a run that was killed leaves a recording without its last page
        for chunk in rerun.chunk.RrdReader(recording).stream():
            path = str(chunk.entity_path).removeprefix("/")
            if path not in READ or chunk.is_static:
                continue
            batch = chunk.to_record_batch()
            for name in batch.schema.names:
                component = name.partition(":")[2]
                if component not in _COMPONENTS:
                    continue
                times = zip(batch[entities.ELAPSED], batch[entities.FRAME].to_pylist(), strict=True)
                for place, (elapsed, frame) in enumerate(times):
                    if batch[name][place].is_valid:
                        step = steps.setdefault(elapsed.value, LoggedStep(frame))
                        step.rows.setdefault(path, {})[component] = batch[name].take([place])
    for step in steps.values():
        if {"buffer", "format"} <= step.rows.get(entities.MASK, {}).keys():
            step.rows[entities.MASK] = {"blob": pa.array([[_packed(step.rows[entities.MASK])]], _BLOB)}
    return steps


_BLOB: Final = pa.list_(pa.list_(pa.uint8()))


def _packed(row: Mapping[str, Any]) -> npt.NDArray[np.uint8]:
    """Return a mask as the bytes (n,) of a PNG, a hundredth of its size, as colour and depth are recorded."""
    shape = row["format"][0].as_py()[0]
    pixels = row["buffer"][0].values[0].values.to_numpy().reshape(shape["height"], shape["width"])
    return np.frombuffer(encoded(pixels > 0, "PNG"), np.uint8)


if __name__ == "__main__":
    write_steps(Path(sys.argv[1]), sys.stdout.buffer)
