"""What runs were made of: their sequences, found again and told from others."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

from modeler.cli import compose
from modeler.cli.options import MethodOptions, ObjectOptions, PriorOptions
from modeler.export import RunFolder
from modeler.types import ACCEPTED, Array, InputError, RayImage
from sequences import AbstractSequence, SensedSequence, open_sequence, read_noise

_ALIKE = 0.02  # share by which the number of an object's points may change with the version of a library


@final
@dataclass(frozen=True, eq=False)
class Part:
    """A run as it was built, and the sequence that it was made from."""

    run: Path
    """Its folder, or that of the run which it is a part of."""
    report: Mapping[str, Any]
    """What it said of itself, under its own frame numbers."""
    sequence: AbstractSequence
    """The sequence."""
    offset: int = 0
    """What its frame numbers are counted on from in the joined run."""

    @property
    def accepted(self) -> tuple[int, ...]:
        """Numbers, its own, of the frames that became part of the model."""
        return tuple(record["id"] for record in self.report["frames"] if record["outcome"] == ACCEPTED)

    def truth(self) -> dict[int, Array] | None:
        """Return the true camera_from_model (4, 4) by frame number of the joined run; None where it is not known."""
        truth = self.sequence.truth()
        return None if truth is None else {frame + self.offset: pose for frame, pose in truth.items()}

    def views(self, frames: Sequence[int]) -> dict[int, RayImage]:
        """Return views, made again, by frame number of the joined run.

        Args:
            frames: numbers, its own, of accepted frames.

        Raises:
            InputError: where the sequence shows something else than when the run was made.
        """
        settings = self.report["settings"]
        roi = settings.get("roi")
        limits = ObjectOptions(roi=None if roi is None else tuple(roi), max_depth_m=settings.get("max_depth_m"))
        modeler = compose.modeler(self.sequence, PriorOptions(prior="general"), MethodOptions(), limits)
        scene, views = compose.scene(modeler, self.sequence), {}
        points = {record["id"]: record["points"] for record in self.report["frames"]}
        for frame in frames:
            _, view = modeler.view(self.sequence.frame(frame), scene)
            if view is None or abs(len(view.points_m) - points[frame]) > _ALIKE * points[frame]:
                raise InputError(
                    f"{self.sequence.name}: frame {frame} shows something else than the one that {self.run} was made "
                    "from, or another version finds the object otherwise there; say where that sequence is with "
                    "--sequence, or build the run again"
                )
            views[frame + self.offset] = renumbered(view, self.offset)
        return views

    def check(self) -> None:
        """Look at the first and the last frame.

        Raises:
            InputError: where the sequence shows something else than when the run was made.
        """
        self.views(sorted({*self.accepted[:1], *self.accepted[-1:]}))


def parts_of(run: Path, sequences: Sequence[Path] = ()) -> tuple[Part, ...]:
    """Return what a run was made of: itself, or the runs that it joins.

    Args:
        run: run folder.
        sequences: where the sequences are now, in order; none: where they were.

    Raises:
        InputError: where a folder holds no run, or a sequence is not to be found.
    """
    places = deque(sequences) if sequences else None
    found = _parts(run, places)
    if places:
        raise InputError(
            f"--sequence is given {len(sequences)} times where {run} was made from {len(found)}; give each once"
        )
    return found


def _parts(run: Path, places: deque[Path] | None) -> tuple[Part, ...]:
    report = RunFolder(run).result()
    settings = report["settings"]
    if "joined" in settings:
        first, second = (_parts(Path(part), places) for part in settings["joined"])
        moved = (replace(part, offset=part.offset + int(settings["offset"])) for part in second)
        return (*first, *moved)
    if places is not None and not places:
        raise InputError(f"--sequence is given too few times; say where the sequence of {run} is, too, in order")
    where = Path(report["sequence"]) if places is None else places.popleft()
    if not where.exists():
        raise InputError(f"{where}: the sequence of {run} is not there; say where it is with --sequence")
    whole = open_sequence(where)
    whole = SensedSequence(whole, read_noise(Path(settings["sensor"]))) if "sensor" in settings else whole
    return (Part(run, report, whole),)


def renumbered(view: RayImage, offset: int) -> RayImage:
    """Return a view with another frame number."""
    return replace(view, frame=replace(view.frame, index=view.frame.index + offset))
