"""One capture from its plan to figures: what was placed, whether it is right, and what the run says of itself."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.evaluation import TrueSurface
from modeler.types import AbstractRegistrar, Array, InputError, Step
from studies.multiplied.judged import MAX_DEG, apart
from studies.results_file import earlier_results
from studies.trust.study import built
from studies.whole.capture import Capture
from studies.whole.plan import Factors, Half, Plan
from studies.whole.things import Thing, read

_ALIKE: Final = 0.002
"""Mean distance, as a share of the size, within which a turned mesh is the same: a fifth of what the finest captures
resolve."""
_LEAST: Final = 0.5
"""Share of masks that is the object, and of the object in masks: with less, another thing is modelled, or a part."""
_POINTS: Final = 300
"""Of a view that are compared: errors of the surface are then known to a few per cent."""


@final
@dataclass(frozen=True)
class Outcome:
    """What a run came to."""

    half: Half
    """Of the study."""
    number: int
    """Within the half."""
    factors: Factors
    """What was drawn."""
    placed: int
    """Number of frames in the model."""
    status: int
    """With which `modeler build` ends: 0, 2 or 3."""
    codes: tuple[str, ...]
    """Of what speaks against the model."""
    words: tuple[str, ...]
    """The same for people."""
    evidence: Mapping[str, tuple[float | None, float | None]]
    """Value and limit by name."""
    outcomes: Mapping[str, str]
    """Of frames that were left out, by frame number."""
    tolerance_m: float
    """Of the verdict; 0 without one."""
    error_deg: float | None
    """Largest rotation error of a pose after alignment of all rotations; None with fewer than two poses."""
    error_m: float | None
    """Largest error of a view's surface (rms) after alignment by a similarity; None likewise."""
    seconds: float
    """Wall time of the run without rendering."""
    of_object: float | None = None
    """Share of the measured pixels of masks that show the object, median over views; None unless the camera moves."""
    complete: float | None = None
    """Share of the object's measured pixels that are in the masks, likewise."""

    @property
    def right(self) -> bool:
        """Whether the model is right to its tolerance, and of the object."""
        if self.error_deg is None or self.error_m is None:
            return False
        if self.of_object is not None and self.complete is not None and min(self.of_object, self.complete) < _LEAST:
            return False
        return self.error_deg <= MAX_DEG and self.error_m <= self.tolerance_m

    def values(self) -> dict[str, Any]:
        """Return the figures as JSON holds them."""
        return {**asdict(self), "right": self.right}

    @staticmethod
    def of(values: Mapping[str, Any]) -> Outcome:
        """Return what JSON held."""
        fields = {name: value for name, value in values.items() if name != "right"}
        return Outcome(**{**fields, "factors": Factors(**values["factors"])})


def earlier(path: Path) -> dict[int, Outcome]:
    """Return the outcomes that a file holds, by number; none if there is no file."""
    return {one.number: one for one in map(Outcome.of, map(json.loads, earlier_results(path)))}


Look = Callable[[Capture, Step | None], None]


def outcome(
    path: Path,
    plan: Plan,
    look: Look = lambda capture, step: None,
    *,
    drawn: Callable[[Factors], Factors] = lambda factors: factors,
    registrar: Callable[[Capture, AbstractRegistrar], AbstractRegistrar] = lambda capture, method: method,
) -> Outcome:
    """Build the model of a capture as `modeler build` does, without recording, and compare it with the truth.

    Args:
        path: of the meshes and photographs.
        plan: of the capture.
        look: receives the capture and the last step; None if the input was refused.
        drawn: returns the factors in place of those of the plan.
        registrar: returns what registers pairs of the capture in place of the method.
    """
    things, pictures = _read(path)
    capture = Capture(drawn(plan.factors(things, len(pictures))), plan.seed, things, pictures)
    capture.frame(0)  # renders all, so that the time is the run's
    began = time.perf_counter()
    step, report = None, {}
    try:
        step, report = built(capture, capture.options(), plan.seed, partial(registrar, capture))
    except InputError as error:
        report = {"trustworthy": False, "reason_codes": [f"refused: {error}"], "reasons": [str(error)], "evidence": {}}
    seconds = time.perf_counter() - began
    look(capture, step)
    error_deg, error_m = (None, None) if step is None else _errors(capture, step)
    return Outcome(
        half=plan.half,
        number=plan.number,
        factors=capture.factors,
        placed=0 if step is None else len(step.solution.trajectory),
        status=2 if step is None else 0 if report["trustworthy"] else 3,
        codes=tuple(report["reason_codes"]),
        words=tuple(report["reasons"]),
        evidence={name: (figure["value"], figure["limit"]) for name, figure in report["evidence"].items()},
        outcomes={} if step is None else {str(one.id): one.outcome for one in step.frames_so_far if not one.accepted},
        tolerance_m=0.0 if step is None or step.verdict is None else step.verdict.tolerance_m,
        error_deg=error_deg,
        error_m=error_m,
        seconds=seconds,
        **_shares(capture, step),
    )


def _shares(capture: Capture, step: Step | None) -> dict[str, float]:
    """Return how much of masks is the object, and how much of the object is in masks, if the camera is led round."""
    if step is None or not capture.factors.led_round or not step.views:
        return {}
    exact, found = replace(capture, factors=replace(capture.factors, masks="exact")), []
    for index, view in step.views.items():
        measured = np.nan_to_num(view.frame.depth_m) > 0.0
        own, true = (np.asarray(mask) & measured for mask in (view.frame.mask, exact.frame(index).mask))
        both = np.count_nonzero(own & true)
        found.append((both / max(np.count_nonzero(own), 1), both / max(np.count_nonzero(true), 1)))
    of_object, complete = np.median(found, axis=0).tolist()
    return {"of_object": of_object, "complete": complete}


@cache
def _read(path: Path) -> tuple[list[Thing], list[npt.NDArray[np.uint8]]]:
    return read(path)


def _errors(capture: Capture, step: Step) -> tuple[float | None, float | None]:
    """Return the largest errors of a run's poses, in degrees and m; None with fewer than two.

    Of the true poses that show the same surface, as those of a plain box turned by half a turn do, that nearest to the
    one found counts.
    """
    found = step.solution.trajectory
    if len(found) < 2:
        return None, None
    rng = np.random.default_rng(0)
    points_m = {
        index: rng.choice(step.views[index].points_m, min(_POINTS, len(step.views[index].points_m)), replace=False)
        for index in found
    }
    truth = {index: se3.inverse(capture.truth()[index]) for index in found}
    printed = capture.factors.colour == "photograph"
    alike = [np.eye(4)] if printed else symmetries(capture.mesh.vertices, capture.mesh.triangles)
    first = min(found)
    object_from_model = found[first] @ se3.inverse(truth[first])
    reference = {
        index: min(
            (turned @ truth[index] for turned in alike),
            key=lambda pose, index=index: se3.rotation_angle(se3.inverse(object_from_model @ pose) @ found[index]),
        )
        for index in found
    }
    return apart(found, reference, points_m)


def symmetries(vertices_m: Array, triangles: npt.NDArray[np.int64]) -> list[Array]:
    """Return the rotations (4, 4) by quarter and half turns about the middle that map a mesh onto itself.

    Args:
        vertices_m: (v, 3), upright.
        triangles: (t, 3) vertex numbers.
    """
    import open3d as o3d

    surface = TrueSurface.of(vertices_m, triangles, np.random.default_rng(0), 2000)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor.from_numpy(vertices_m.astype(np.float32)),
        o3d.core.Tensor.from_numpy(np.ascontiguousarray(triangles, dtype=np.uint32)),
    )
    middle_m = 0.5 * (vertices_m.min(axis=0) + vertices_m.max(axis=0))
    size_m = float(np.ptp(vertices_m, axis=0).max())
    found = []
    for rotation in Rotation.create_group("O").as_matrix():
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, middle_m - rotation @ middle_m
        places_m = se3.transform(pose, surface.points_m).astype(np.float32)
        off_m = scene.compute_distance(o3d.core.Tensor.from_numpy(places_m)).numpy()
        if float(np.mean(off_m)) <= _ALIKE * size_m:
            found.append(pose)
    return found
