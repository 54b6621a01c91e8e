"""Whether runs are right, by the truth of their capture or by the whole capture's run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeVar, final

import numpy as np
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.sequences import open_sequence
from modeler.types import Array
from studies.multiplied.study import AS_IT_IS, Run
from studies.multiplied.ways import WAYS
from studies.results.tables import markdown

Key = TypeVar("Key")

_ALIGNMENTS: Final = 20
"""Of surfaces in turn by a similarity and by a shift: the shift has then settled to a hundredth."""
MAX_DEG: Final = 3.0
"""Rotation error of a pose from which on a model is called wrong, as in the study of trust."""


@final
@dataclass(frozen=True)
class Judged:
    """A run beside what it should be."""

    run: Run
    error_deg: float | None
    """Largest rotation error of a pose after alignment of all rotations; None without reference or poses."""
    error_m: float | None
    """Largest error of a view's surface (rms) after alignment by a similarity; None likewise."""

    @property
    def right(self) -> bool | None:
        """Whether the model is right to its tolerance; None if nothing tells."""
        if len(self.run.poses) < 2:
            return False
        if self.error_deg is None or self.error_m is None:
            return None
        return self.error_deg <= MAX_DEG and self.error_m <= self.run.tolerance_m


def judged(run: Run, whole: Run, data: Path) -> Judged:
    """Compare a run with the truth where it is known, else with the run of the capture as it is."""
    reference = _truth(run.capture, data) or ({} if run is whole else _poses(whole, WAYS[AS_IT_IS].new_from_old))
    found = _poses(run, WAYS[run.way].new_from_old)
    common = sorted(set(reference) & set(found), key=int)
    if len(common) < 2:
        return Judged(run, None, None)
    return Judged(run, *apart(found, reference, {key: _points_m(run, key) for key in common}))


def apart(
    found: Mapping[Key, Array], reference: Mapping[Key, Array], points_m: Mapping[Key, Array]
) -> tuple[float, float]:
    """Return the largest rotation error of a pose in degrees, and of a view's surface (rms) in m.

    Rotations are aligned by their mean; surfaces by a similarity, so that an error of scale alone is none, and by a
    shift that all views share in their cameras: distances that are biased alike change the size of a model as well, and
    a reference made of images has its own.

    Args:
        found: object_from_camera (4, 4).
        reference: the same as it should be, in any frame of the object.
        points_m: (n, 3) of the object in the camera frame, of the views to compare: two or more.
    """
    shift_m, errors_m = np.zeros(3), {}
    true_m = np.concatenate([se3.transform(reference[key], points_m[key]) for key in points_m])
    for _ in range(_ALIGNMENTS):
        said_m = {key: se3.transform(found[key], points_m[key] - shift_m) for key in points_m}
        rotation, scale, offset_m = _similarity(np.concatenate([*said_m.values()]), true_m)
        errors_m = {
            key: scale * said @ rotation.T + offset_m - se3.transform(reference[key], points_m[key])
            for key, said in said_m.items()
        }
        in_camera_m = [error_m @ reference[key][:3, :3] for key, error_m in errors_m.items()]
        shift_m = shift_m + np.concatenate(in_camera_m).mean(axis=0)
    apart_m = [float(np.sqrt(np.square(error_m).sum(axis=1).mean())) for error_m in errors_m.values()]
    rotations = Rotation.from_matrix([reference[key][:3, :3] @ found[key][:3, :3].T for key in points_m])
    turned_deg = np.degrees((rotations.mean().inv() * rotations).magnitude())
    return float(turned_deg.max()), max(apart_m)


def text(all_judged: Sequence[Judged]) -> str:
    """Return tables by way and by capture, and the runs that ended otherwise than they should."""
    parts = [
        table(all_judged, "way", [one.run.way for one in all_judged]),
        table(all_judged, "capture", [one.run.capture for one in all_judged]),
    ]
    for one in all_judged:
        run = one.run
        if (run.status == 0) is not one.right:
            errors = "" if one.error_deg is None else f", {one.error_deg:.1f}°, {1e3 * (one.error_m or 0.0):.1f} mm"
            parts.append(
                f"{run.capture}, {run.way}: {len(run.poses)} of {run.frames}, right: {one.right}{errors} of "
                f"{1e3 * run.tolerance_m:.1f}; status {run.status}: {'; '.join(run.words)}"
            )
    return "\n\n".join(parts)


def table(all_judged: Sequence[Judged], title: str, keys: Sequence[str]) -> str:
    """Return a table of `counts`, a row a key."""
    columns = [f"{right}, {status}" for right in ("right", "wrong", "no reference") for status in ("0", "3")]
    return markdown((title, "runs", "placed", *columns), counts(all_judged, keys))


def counts(all_judged: Sequence[Judged], keys: Sequence[str]) -> list[tuple[str | int, ...]]:
    """Return the number of runs, the share of frames placed, and runs by rightness and status: a row a key, and all."""
    rows = []
    for key in [*dict.fromkeys(keys), None]:
        part = [one for one, own in zip(all_judged, keys, strict=True) if key in (None, own)]
        placed = sum(len(one.run.poses) for one in part) / max(1, sum(one.run.frames for one in part))
        kinds = [
            sum(one.right is right and (one.run.status == 0) is trusted for one in part)
            for right in (True, False, None)
            for trusted in (True, False)
        ]
        rows.append((key or "all", len(part), f"{100.0 * placed:.0f} %", *kinds))
    return rows


def _truth(capture: str, data: Path) -> dict[str, Array]:
    truth = open_sequence(data / capture).truth() or {}
    return {str(index): se3.inverse(pose) for index, pose in truth.items()}


def _poses(run: Run, new_from_old: tuple[tuple[float, ...], ...] | None) -> dict[str, Array]:
    """Return object_from_camera (4, 4) of the capture's camera."""
    turned = np.eye(4) if new_from_old is None else np.array(new_from_old)
    return {key: np.array(pose).reshape(4, 4) @ turned for key, pose in run.poses.items()}


def _points_m(run: Run, key: str) -> Array:
    """Return points (n, 3) of a view in the capture's camera frame."""
    rows = WAYS[run.way].new_from_old
    points_m = np.array(run.points_m[key])
    return points_m if rows is None else points_m @ np.array(rows)[:3, :3]


def _similarity(from_m: Array, to_m: Array) -> tuple[Array, float, Array]:
    """Return rotation (3, 3), scale and offset (3,) that take points (n, 3) nearest to others (Umeyama 1991)."""
    centre_from, centre_to = from_m.mean(axis=0), to_m.mean(axis=0)
    a, b = from_m - centre_from, to_m - centre_to
    u, d, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * signs) @ vt
    scale = float((d * signs).sum() / np.square(a).sum())
    return rotation, scale, centre_to - scale * rotation @ centre_from
