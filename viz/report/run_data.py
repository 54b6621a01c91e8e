"""What is read of a run: its report in the nouns of the package, and the clouds and images of its recording."""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from PIL import Image

from modeler import se3
from modeler.export import RunFolder, edges_of, poses_of
from modeler.graph import PoseGraph, dead_reckoning
from modeler.regular_files import check_regular
from modeler.types import Array, Edge, InputError, PoseGaussian
from viz import entities


@dataclass(frozen=True, eq=False)
class Result:
    """A finished or interrupted run, with the true motion where it is known."""

    path: Path
    """The run folder."""
    report: Mapping[str, Any]
    """`report.json`."""
    truth: Mapping[int, Array]
    """camera_from_model (4, 4) by frame number; empty where it is not known."""

    @classmethod
    def read(cls, path: Path, truth: Mapping[int, Array] | None = None) -> Result:
        """Read a run folder.

        Raises:
            InputError: where there is no run, or no frame of it was accepted.
        """
        report = RunFolder(path).report()
        if not report["poses"]:
            raise InputError(f"{path}: no frame of this run was accepted; report.json says why")
        return cls(path, report, truth or {})

    @cached_property
    def edges(self) -> list[Edge]:
        """Every edge, in order."""
        return list(edges_of(self.report))

    @cached_property
    def poses(self) -> dict[int, PoseGaussian]:
        """object_from_camera after optimisation, by frame number."""
        return poses_of(self.report)

    @cached_property
    def chain(self) -> dict[int, PoseGaussian]:
        """object_from_camera of the pairwise chain alone, by frame number: `odometry.txt` with covariances."""
        reached = dead_reckoning(PoseGraph(tuple(self.edges), self.first))
        return {frame: reached[frame] for frame in self.poses if frame in reached}

    @property
    def first(self) -> int:
        """Number of the first accepted frame, in whose camera frame the object is."""
        return next(iter(self.poses))

    def true_pose(self, frame: int) -> Array | None:
        """Return the true object_from_camera (4, 4) of a frame; None where it is not known."""
        if frame not in self.truth or self.first not in self.truth:
            return None
        return self.truth[self.first] @ se3.inverse(self.truth[frame])

    def true_motion(self, edge: Edge) -> Array | None:
        """Return the true target_from_source (4, 4) of an edge; None where it is not known."""
        if edge.source not in self.truth or edge.target not in self.truth:
            return None
        return self.truth[edge.target] @ se3.inverse(self.truth[edge.source])


FRAME_PATHS: Final = (
    entities.COLOUR,
    entities.DEPTH,
    entities.MASK,
    entities.PAIR_TARGET,
    entities.PAIR_BEFORE,
    entities.PAIR_AFTER,
)
"""Entities that are shown."""
_COMPONENTS: Final = ("blob", "buffer", "format", "positions", "colors", "labels")
_READ: Final = (*FRAME_PATHS, entities.PAIR_CAPTION)

Row = Mapping[str, Any]
"""Values of an entity by component."""


_MAX_BYTES = 4 << 30  # Rerun reads the whole file into memory; 5,000 frames of 640×480 are as many


def recorded(recording: Path) -> dict[str, dict[int, dict[str, Any]]]:
    """Return the rows of `FRAME_PATHS` and of the pairs' captions by frame; no frames where nothing can be read.

    A frame is what a pair's caption calls the newer view, else what the timeline says: a frame that was tried again
    later stands there beside the latest. Of a frame that was tried more than once the last attempt counts.
    """
    rows: dict[str, dict[int, dict[str, Any]]] = {path: {} for path in _READ}
    if not os.path.lexists(recording):
        return rows
    check_regular(recording)
    if recording.stat().st_size > _MAX_BYTES:
        return rows
    steps = _steps(recording)
    for _, step in sorted(steps.items()):
        found = {path: {name: value[0] for name, value in row.items()} for path, row in step.rows.items()}
        pair = registered(found.get(entities.PAIR_CAPTION, {}))
        for path, row in found.items():
            rows[path][step.frame if pair is None else pair[0]] = row
    return rows


def registered(caption: Row) -> tuple[int, int] | None:
    """Return the numbers of a pair's frames, the newer first, as its caption names them; None where there is none."""
    words = " ".join(map(str, caption["labels"].as_py())) if "labels" in caption else ""
    numbers = re.findall(r"frame (\d+)", words)
    return (int(numbers[0]), int(numbers[1])) if len(numbers) == 2 else None


def cloud(row: Row) -> tuple[Array, npt.NDArray[np.uint8]] | None:
    """Return points (n, 3) in m and colours (n, 3) of a row; None where it has none."""
    if "positions" not in row or "colors" not in row:
        return None
    points = np.array(row["positions"].as_py(), dtype=np.float64).reshape(-1, 3)
    packed = np.array(row["colors"].as_py(), dtype=np.uint32)
    colours = np.stack([packed >> 24, packed >> 16, packed >> 8], axis=1).astype(np.uint8)
    return points, np.broadcast_to(colours, points.shape)


def surfaces(rows: Mapping[str, Mapping[int, Row]]) -> dict[int, Array]:
    """Return the surface points (n, 3) of each frame that was registered, or registered to, in its own camera's frame.

    Args:
        rows: as `recorded` returns them.
    """
    found = {frame: cloud(row) for frame, row in rows[entities.PAIR_BEFORE].items()}
    for frame, caption in rows[entities.PAIR_CAPTION].items():
        pair, target = registered(caption), rows[entities.PAIR_TARGET].get(frame)
        if pair is not None and target is not None and found.get(pair[1]) is None:
            found[pair[1]] = cloud(target)
    return {frame: points_colours[0] for frame, points_colours in found.items() if points_colours is not None}


@dataclass
class _Step:
    """What was logged at once."""

    frame: int
    """On the timeline."""
    rows: dict[str, dict[str, Any]] = field(default_factory=dict)
    """By entity."""


def _steps(recording: Path) -> dict[int, _Step]:
    """Return the steps of a run by the time, in ns since its start, at which they were drawn; none of a damaged one.

    Another process reads them, because Rerun 0.41 aborts the one in which it reads some damaged recordings.
    """
    read = subprocess.run(
        [sys.executable, "-c", _READER, str(recording)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        check=False,
    )
    steps: dict[int, _Step] = {}
    source = pa.BufferReader(read.stdout if read.returncode == 0 else b"")
    while source.tell() < source.size():
        with pa.ipc.open_stream(source) as stream:
            row, said = stream.read_all(), stream.schema.metadata
        step = steps.setdefault(int(said[b"elapsed"]), _Step(int(said[b"frame"])))
        step.rows.setdefault(said[b"path"].decode(), {})[said[b"component"].decode()] = row["value"].combine_chunks()
    return steps


_READER: Final = """
import sys
from pathlib import Path
from viz.report.run_data import write_steps
write_steps(Path(sys.argv[1]), sys.stdout.buffer)
"""


def write_steps(recording: Path, out: BinaryIO) -> None:
    """Write the steps of a run, each value as an Arrow stream of one row."""
    for elapsed, step in read_steps(recording).items():
        for path, values in step.rows.items():
            for component, value in values.items():
                key = {"elapsed": str(elapsed), "frame": str(step.frame), "path": path, "component": component}
                row = pa.record_batch([value], schema=pa.schema([pa.field("value", value.type)], metadata=key))
                with pa.ipc.new_stream(out, row.schema) as stream:
                    stream.write_batch(row)


def read_steps(recording: Path) -> dict[int, _Step]:
    """Return the steps of a run as `_steps` does, each value an array of one, for scalars are sent slowly."""
    import rerun.chunk

    steps: dict[int, _Step] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a run that was killed leaves a recording without its last page
        for chunk in rerun.chunk.RrdReader(recording).stream():
            path = str(chunk.entity_path).removeprefix("/")
            if path not in _READ or chunk.is_static:
                continue
            batch = chunk.to_record_batch()
            for name in batch.schema.names:
                component = name.partition(":")[2]
                if component not in _COMPONENTS:
                    continue
                times = zip(batch[entities.ELAPSED], batch[entities.FRAME].to_pylist(), strict=True)
                for place, (elapsed, frame) in enumerate(times):
                    if batch[name][place].is_valid:
                        step = steps.setdefault(elapsed.value, _Step(frame))
                        step.rows.setdefault(path, {})[component] = batch[name].take([place])
    for step in steps.values():
        if {"buffer", "format"} <= step.rows.get(entities.MASK, {}).keys():
            step.rows[entities.MASK] = {"blob": pa.array([[_packed(step.rows[entities.MASK])]], _BLOB)}
    return steps


_BLOB: Final = pa.list_(pa.list_(pa.uint8()))


def _packed(row: Row) -> npt.NDArray[np.uint8]:
    """Return a mask as the bytes (n,) of a PNG, a hundredth of its size, as colour and depth are recorded."""
    shape = row["format"][0].as_py()[0]
    pixels = row["buffer"][0].values[0].values.to_numpy().reshape(shape["height"], shape["width"])
    content = io.BytesIO()
    Image.fromarray(pixels > 0).save(content, "PNG")
    return np.frombuffer(content.getvalue(), np.uint8)
