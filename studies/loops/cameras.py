"""Whole runs of cameras other than the renderer's: `python -m studies loops.cameras`.

A hand pushes each shape about a table for a full turn. Depth cameras of several kinds (`calibration.depth_cameras`)
observe it; the given focal length has an error of 2 % standard deviation, and neither masks nor a noise model are
given. A model is built with default settings. The table has, for each run, the exit status, whether the model is wrong
(as in `make trust`), the largest errors of poses, NEES and coverage of poses to the first frame, and the focal length,
given and estimated, relative to the true one.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Final, final

import numpy as np
from scipy import stats

from modeler.composition.options import PriorOptions
from modeler.export import write_atomically
from modeler.sequences import AbstractSequence
from modeler.sequences.meshes import Mesh
from modeler.sequences.rendering import RenderedSequence
from modeler.types import Array, Frame, SensorNoise
from studies.calibration.by_camera import NOMINAL, chosen, refocused, shown, world_of
from studies.calibration.depth_cameras import CAMERAS, DepthCamera
from studies.loops.covariances import judged, pushed
from studies.trust.study import MAX_DEG, MAX_M, MIN_F, built, f_score, pose_errors

_RADIUS: Final = float(stats.chi2(6).ppf(0.95))
_ENDS: Final = ((False, 0), (False, 3), (True, 0), (True, 3))


@final
@dataclass(frozen=True, eq=False)
class Filmed(AbstractSequence):
    """A rendered sequence as a depth camera observes it."""

    rendered: RenderedSequence
    """The object and its poses."""
    camera: DepthCamera
    focal_factor: float
    """Given over true focal length."""
    seed: int
    """Of the camera's noise."""
    exact: bool = False
    """Whether depth has no errors."""

    @property
    def name(self) -> str:
        """Name of the object's recipe."""
        return self.rendered.name

    @property
    def indices(self) -> tuple[int, ...]:
        """Frame numbers."""
        return self.rendered.indices

    def frame(self, index: int) -> Frame:
        """Return a frame as the user has it."""
        return self._given[index]

    def true_frame(self, index: int) -> Frame:
        """Return a frame without errors of depth and focal length, with the object's mask."""
        seen = self.camera.look(world_of(self.rendered, index))
        depth_m = np.where(np.isfinite(seen.depth_m), seen.depth_m, np.nan).astype(np.float32)
        return Frame(index, float(index), depth_m, self.camera.camera, seen.on_object)

    def sensor(self) -> SensorNoise:
        """Return what is known of the errors of the camera from its kind."""
        return self.camera.stated._replace(sigma_focal=NOMINAL)

    def truth(self) -> dict[int, Array]:
        """Return the true camera_from_model (4, 4) by frame number."""
        return self.rendered.truth()

    def model(self) -> Mesh:
        """Return the true surface of the object."""
        return self.rendered.model()

    @cached_property
    def _given(self) -> dict[int, Frame]:
        if self.exact:
            frames = [self.true_frame(index) for index in self.indices]
        else:
            frames = shown(self.rendered, self.camera, np.random.default_rng([self.seed, 2]), self.seed)
        camera = refocused(self.camera.camera, self.focal_factor)
        return {
            frame.index: replace(
                frame, depth_m=np.where(frame.depth_m > 0.0, frame.depth_m, np.nan), camera=camera, mask=None
            )
            for frame in frames
        }


@final
@dataclass(frozen=True)
class Run:
    """What a run came to."""

    camera: str
    shape: str
    status: int
    """0 or 3."""
    wrong: bool
    """Whether the model is, as in `make trust`, but to its tolerance."""
    placed: int
    """Number of frames in the model."""
    error_deg: float
    """Largest rotation error of a pose to the first."""
    error_mm: float
    """Largest error of the object's place."""
    f_score: float
    """Of the mesh, at the model's tolerance, or at 5 mm if it is less."""
    nees: float
    """Of poses to the first, an average a degree of freedom."""
    covered: float
    """Share of poses in their 95 % regions."""
    given: float
    """Given over true focal length."""
    found: float
    """Estimated over true focal length."""
    sigma: float
    """Standard deviation of the logarithm of the estimate."""
    loop: float
    """Closure error in standard deviations before optimisation; NaN without a loop."""
    codes: tuple[str, ...]
    """Reasons of status 3."""


def filmed_by(name: str, shape: str, seed: int, frames: int, step_deg: float) -> Filmed:
    """Return a shape that is pushed about a table, as a camera observes it."""
    camera = CAMERAS[name]
    number = int(np.random.SeedSequence([seed, list(CAMERAS).index(name), *shape.encode()]).generate_state(1)[0])
    rng = np.random.default_rng(number)
    sequence = pushed(shape, seed, frames, step_deg)
    view = replace(sequence.recipe.view, distance_m=float(rng.choice(camera.distances_m)))
    rendered = RenderedSequence(replace(sequence.recipe, view=view))
    return Filmed(rendered, camera, float(np.exp(rng.normal(0.0, NOMINAL))), number)


def run(name: str, shape: str, seed: int, frames: int, step_deg: float) -> Run:
    """Build a sequence and evaluate the model."""
    filmed = filmed_by(name, shape, seed, frames, step_deg)
    step, report = built(filmed, PriorOptions(), seed)
    solution = step.solution
    errors = pose_errors(replace(filmed, exact=True), step)
    limit_m = max(MAX_M, float(report["tolerance_m"]))  # a model is trusted to its tolerance
    score = None if step.model is None else f_score(filmed, step.model, solution.trajectory, limit_m)
    error_deg, error_m, score = (np.inf if errors[0] is None else errors[0], np.inf if errors[1] is None else errors[1],
                                 score or 0.0)  # fmt: skip
    squares = judged(solution, filmed.truth())["pose"] if len(solution.trajectory) > 1 else []
    focal = solution.focal
    loop = report.get("loop")
    return Run(
        name,
        shape,
        0 if report["trustworthy"] else 3,
        error_deg > MAX_DEG or error_m > limit_m or score < MIN_F,
        len(solution.trajectory),
        error_deg,
        1000.0 * error_m,
        score,
        float(np.mean(squares)) / 6.0 if squares else np.nan,
        float(np.mean(np.array(squares) <= _RADIUS)) if squares else np.nan,
        filmed.focal_factor,
        filmed.focal_factor * (1.0 if focal is None else focal.factor),
        np.nan if focal is None else focal.sigma,
        loop["sigmas"] if loop else np.nan,
        tuple(report["reason_codes"]),
    )


def line(found: Run) -> str:
    """Return a run as a line of the table."""
    model = "wrong" if found.wrong else "right"
    given, estimated = 100.0 * (found.given - 1.0), 100.0 * (found.found - 1.0)
    return (
        f"{found.camera:20}{found.shape:22}{found.status:>3}{model:>7}{found.placed:>4}"
        f"{found.error_deg:>7.1f}{found.error_mm:>6.1f}{found.f_score:>6.2f}{found.nees:>7.2f}"
        f"{100.0 * found.covered:>5.0f}{given:>7.1f}{estimated:>7.1f}{100.0 * found.sigma:>6.1f}{found.loop:>6.1f}  "
        + ", ".join(found.codes)
    )


def summary(runs: Sequence[Run]) -> str:
    """Return, for each camera, counts of runs, and the calibration of poses in them: median of NEES/6, mean coverage.

    The last column is the root mean square error of the focal length in its standard deviations, where loops close.
    """
    lines = [
        f"{'':20}{'runs':>6}{'placed':>9}{'right, 0':>10}{'right, 3':>10}{'wrong, 0':>10}{'wrong, 3':>10}"
        f"{'NEES/6':>8}{'95 %':>6}{'closed':>8}{'focal':>7}"
    ]
    for name in dict.fromkeys(one.camera for one in runs):
        some = [one for one in runs if one.camera == name]
        ends = [sum((one.wrong, one.status) == end for one in some) for end in _ENDS]
        squares, covered = np.median([one.nees for one in some]), np.mean([one.covered for one in some])
        closed = [one for one in some if np.isfinite(one.loop)]
        off = np.sqrt(np.mean([(np.log(one.found) / one.sigma) ** 2 for one in closed] or [np.nan]))
        lines.append(
            f"{name:20}{len(some):>6}{sum(one.placed for one in some):>9}{''.join(f'{end:>10}' for end in ends)}"
            f"{squares:>8.2f}{100.0 * covered:>6.0f}{len(closed):>8}{off:>7.1f}"
        )
    return "\n".join(lines)


def asked(
    study: str,
    description: str | None,
    arguments: Sequence[str] | None,
    *,
    per_class: int,
    out: Path,
    recorded: bool = False,
) -> argparse.Namespace:
    """Return the options of a study of turned shapes before cameras; without `--shapes`, those of its half.

    Args:
        study: as `python -m studies` takes it.
        description: for the help.
        arguments: of the command line; None: those of the process.
        per_class: shapes of each class of symmetry, unless the user says how many.
        out: file of the results likewise.
        recorded: whether the results have a table of it, which `--record` makes.
    """
    parser = argparse.ArgumentParser(prog=f"python -m studies {study}", description=description)
    parser.add_argument("--half", choices=("tuning", "held-out"), default="tuning", help="which shapes")
    parser.add_argument(
        "--per-class", type=int, default=per_class, metavar="N", help="shapes of each class of symmetry"
    )
    parser.add_argument("--cameras", nargs="+", choices=CAMERAS, default=list(CAMERAS))
    parser.add_argument("--shapes", nargs="+", metavar="NAME", help="only these")
    parser.add_argument("--seed", type=int, default=0, help="of poses, noise and registration")
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--step-deg", type=float, default=24.0, help="mean turn from frame to frame")
    parser.add_argument("--out", type=Path, default=out, help="file of the results")
    if recorded:
        parser.add_argument("--record", action="store_true", help="put the means into the results")
    options = parser.parse_args(arguments)
    options.shapes = options.shapes or [one.recipe for one in chosen(options.half, options.per_class)]
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    options = asked("loops.cameras", __doc__, arguments, per_class=2, out=Path("runs/cameras.json"))
    runs = []
    print(
        f"{'camera':20}{'shape':22}{'ends':>3}{'model':>6}{'in':>4}{'deg':>7}{'mm':>6}{'F':>6}{'NEES':>7}{'95 %':>5}"
        f"{'given %':>7}{'found':>7}{'± %':>6}{'loop':>6}",
        flush=True,
    )
    for name in options.cameras:
        for shape in options.shapes:
            runs.append(run(name, shape, options.seed, options.frames, options.step_deg))
            print(line(runs[-1]), flush=True)
    print(f"\n{summary(runs)}")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(options.out, json.dumps([asdict(one) for one in runs]) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
