"""One run of a changed capture, from its name to what the disk keeps."""

from __future__ import annotations

import time
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, final

import numpy as np

from modeler.composition.options import PriorOptions
from modeler.sequences import open_sequence
from modeler.types import InputError, Step
from studies.multiplied.ways import WAYS, Changed
from studies.trust.study import built

DATA: Final = Path(__file__).resolve().parents[3] / "shared" / "data"
AS_IT_IS: Final = "as it is"
_POINTS: Final = 300
"""Of a view that are kept: errors of the surface are then known to a few per cent."""


@final
@dataclass(frozen=True)
class Run:
    """What a run came to."""

    capture: str
    way: str
    seed: int
    frames: int
    """Number of frames shown."""
    status: int
    """With which `modeler build` ends: 0, 2 or 3."""
    codes: tuple[str, ...]
    """Of what speaks against the model."""
    words: tuple[str, ...]
    """The same for people."""
    evidence: Mapping[str, tuple[float | None, float | None]]
    """Value and limit by name."""
    tolerance_m: float
    """Of the verdict."""
    poses: Mapping[str, list[float]]
    """object_from_camera of the changed camera, row by row, by frame number of the capture."""
    points_m: Mapping[str, list[list[float]]]
    """Points (n, 3) of the object in the changed camera's frame, by frame number of the capture."""
    outcomes: Mapping[str, str]
    """Of frames that were left out, by frame number of the capture."""
    seconds: float
    """Wall time, reading included."""

    def values(self) -> dict[str, Any]:
        """Return the run as JSON holds it."""
        return asdict(self)

    @staticmethod
    def of(values: Mapping[str, Any]) -> Run:
        """Return what JSON held."""
        return Run(**values)


def captures(data: Path) -> tuple[str, ...]:
    """Return the names of the captures of a folder."""
    return tuple(sorted(path.name for path in data.iterdir() if path.is_dir()))


def half_of(capture: str, way: str) -> str:
    """Return the half to which a pair of capture and way belongs."""
    return ("tuning", "held-out")[zlib.crc32(f"{capture}, {way}".encode()) % 2]


def finished(data: Path, capture: str, way: str, seed: int) -> Run:
    """Build the model of a changed capture with the default options."""
    began = time.perf_counter()
    step, report, frames, numbers = None, {}, 0, ()
    try:
        changed = Changed(open_sequence(data / capture), way)
        numbers, frames = changed.shown, len(changed.shown)
        if frames < WAYS[way].least_frames:
            raise InputError("too few frames")
        step, report = built(changed, PriorOptions(), seed)
    except InputError as error:
        report = {"trustworthy": False, "reason_codes": [f"refused: {error}"], "reasons": [str(error)], "evidence": {}}
    seconds = time.perf_counter() - began
    rng = np.random.default_rng(0)
    return Run(
        capture=capture,
        way=way,
        seed=seed,
        frames=frames,
        status=2 if step is None else 0 if report["trustworthy"] else 3,
        codes=tuple(report["reason_codes"]),
        words=tuple(report["reasons"]),
        evidence={name: (figure["value"], figure["limit"]) for name, figure in report["evidence"].items()},
        tolerance_m=0.0 if step is None or step.verdict is None else step.verdict.tolerance_m,
        poses={} if step is None else _poses(step, numbers),
        points_m={} if step is None else _points_m(step, numbers, rng),
        outcomes={}
        if step is None
        else {str(numbers[one.id]): one.outcome for one in step.frames_so_far if not one.accepted},
        seconds=seconds,
    )


def _poses(step: Step, numbers: tuple[int, ...]) -> dict[str, list[float]]:
    return {str(numbers[index]): pose.ravel().tolist() for index, pose in step.solution.trajectory.items()}


def _points_m(step: Step, numbers: tuple[int, ...], rng: np.random.Generator) -> dict[str, list[list[float]]]:
    found = {}
    for index in step.solution.trajectory:
        points_m = step.views[index].points_m
        chosen = rng.choice(len(points_m), min(_POINTS, len(points_m)), replace=False)
        found[str(numbers[index])] = points_m[chosen].round(5).tolist()
    return found
