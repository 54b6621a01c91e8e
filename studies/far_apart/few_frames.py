"""Build models from few frames far apart: six views 60° apart of a full turn, and four views 90° apart.

    python -m studies far_apart.few_frames                              # 16 shapes of the tuning half
    python -m studies far_apart.few_frames --half held-out              # a single evaluation, at the end
    python -m studies far_apart.few_frames --views 4

Shapes that look different from every side stand on a table, 0.6 m from a camera of 640 × 480 px; only masks
are given. A frame in the model is right if its rotation error is below 3° and the position error of its surface below
5 mm; a model is wrong if a frame in it is not right. The status is 1 if a wrong model ends with 0.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, final

import numpy as np

from modeler import se3
from modeler.composition import compose
from modeler.composition.compose import comes_back
from modeler.composition.options import MethodOptions, ObjectOptions, PriorOptions
from modeler.evaluation import rotation_error_deg, translation_error_m, true_motion
from modeler.sequences.rendering import RenderedSequence
from modeler.types import Step
from studies.calibration.specimens import SPECIMENS, Half, load_specimen
from studies.calibration.study import Condition, staged
from studies.results.tables import FOLDER, record
from studies.trust.study import MAX_DEG, MAX_M

SHAPES: Final = 16


@final
@dataclass(frozen=True)
class Built:
    """What a recording came to."""

    shape: str
    placed: int
    """Frames in the model."""
    frames: int
    error_deg: float
    """Largest rotation error of a pose against the first's."""
    error_m: float
    """Largest error of the place of the object's surface."""
    status: int
    """With which `modeler build` ends: 0 or 3."""
    reasons: tuple[str, ...]
    seconds: float
    """Of a processor."""

    @property
    def wrong(self) -> bool:
        """Whether a frame in the model is not right."""
        return self.error_deg > MAX_DEG or self.error_m > MAX_M


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(
        prog="python -m studies far_apart.few_frames",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--half", choices=("tuning", "held-out"), default="tuning", help="which shapes")
    parser.add_argument("--views", type=int, default=6, metavar="N", help="of a full turn")
    parser.add_argument("--shapes", type=int, default=SHAPES, metavar="N", help="how many")
    parser.add_argument("--only", nargs="+", metavar="SHAPE", help="these shapes")
    parser.add_argument("--prior", default="auto", help="auto, general, or table")
    parser.add_argument("--record", action="store_true", help="put the counts into the results")
    options = parser.parse_args(arguments)
    if options.record and (options.only or options.shapes != SHAPES or options.prior != "auto"):
        parser.error(
            "the results are of all shapes under the default prior: --record goes with --half and --views alone"
        )
    names = options.only or shapes(options.half, options.shapes)
    known = []
    for name in names:
        known.append(built(name, options.views, options.prior))
        print(line(known[-1]), flush=True)
    found = kinds(known)
    print("\n".join(f"{kind}: {count}, {trusted} of them with status 0" for kind, (count, trusted) in found.items()))
    if options.record:
        (whole, sure), (some, _), (wrong, lying) = found.values()
        row = (f"{options.views} views, {options.half} half", len(known), whole, sure, some, wrong, lying)
        record(FOLDER / "few_frames.json", [row])
    return int(any(one.wrong and one.status == 0 for one in known))


def shapes(half: Half, count: int) -> list[str]:
    """Return shapes of a half that look different from every side, chosen at random."""
    names = [one.recipe for one in SPECIMENS if one.half == half and one.symmetry == "asymmetric"]
    return [str(name) for name in np.random.default_rng(60).permutation(names)[:count]]


def built(name: str, views: int, prior: str) -> Built:
    """Build the model of a shape as `modeler build` does, without recording, and compare it with the truth."""
    recipe = load_specimen(name)
    seed = int(np.random.SeedSequence([60, recipe.seed, views]).generate_state(1)[0])
    condition = Condition(distance_m=0.6, step_deg=360.0 / views)
    sequence = RenderedSequence(staged(recipe, condition, frames=views, seed=seed))
    options = PriorOptions(prior=prior)  # pyright: ignore[reportArgumentType]
    began = time.process_time()
    modeler = compose.modeler(sequence, options, MethodOptions(seed=0), ObjectOptions())
    centres_m, last = {}, None
    closes = comes_back(sequence, modeler.prior, modeler.closer.max_angle_deg)
    for event in modeler.run(sequence, compose.scene(modeler, sequence), closure_expected=closes):
        if isinstance(event, Step):
            if event.view is not None:
                centres_m[event.frame.index] = event.view.centroid_m
            last = event
    seconds = time.process_time() - began
    assert last is not None
    assert last.verdict is not None
    trajectory, truth = last.solution.trajectory, sequence.truth()
    errors = [(0.0, 0.0)]
    first = min(trajectory, default=0)
    for frame, pose in trajectory.items():
        found, true = se3.inverse(trajectory[first]) @ pose, true_motion(truth, first, frame)
        errors.append((rotation_error_deg(found, true), translation_error_m(found, true, centres_m[frame])))
    return Built(
        shape=name,
        placed=len(trajectory),
        frames=views,
        error_deg=max(error for error, _ in errors),
        error_m=max(error for _, error in errors),
        status=0 if last.verdict.trustworthy else 3,
        reasons=last.verdict.reasons,
        seconds=seconds,
    )


def line(one: Built) -> str:
    """Return a line of what came of a recording."""
    error = f"{one.error_deg:.1f}° {1e3 * one.error_m:.1f} mm"
    return (
        f"{one.shape:20}{one.placed:3} of {one.frames}{error:>20}{'  wrong' if one.wrong else '':8}"
        f"{one.status:3}{one.seconds:7.1f} s   {'; '.join(one.reasons)[:120]}"
    )


def kinds(known: Sequence[Built]) -> dict[str, tuple[int, int]]:
    """Return how many models have all frames, some frames, or are wrong, and how many of each have status 0."""
    parts = {
        "all frames, right": [one for one in known if one.placed == one.frames and not one.wrong],
        "some frames, right": [one for one in known if one.placed < one.frames and not one.wrong],
        "wrong": [one for one in known if one.wrong],
    }
    return {kind: (len(ones), sum(one.status == 0 for one in ones)) for kind, ones in parts.items()}


if __name__ == "__main__":
    sys.exit(main())
