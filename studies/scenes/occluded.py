"""Objects behind a hand or a gripper: accuracy of poses and models by the given masks."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal, final

import numpy as np

from modeler.composition import compose
from modeler.composition.options import MethodOptions, ObjectOptions, PriorOptions
from modeler.sequences.rendering import RenderedSequence
from modeler.sequences.rendering.recipe import Place, Places, Recipe, Tabletop
from modeler.sequences.rendering.shapes import Box, Compound, Part, placement
from modeler.types import BoolArray, Step
from studies.calibration.specimens import load_specimen
from studies.scenes.plan import arm, reach_m, thing
from studies.table_stage import matrix_of, place_of
from studies.trust.plan import SHIFT_M, viewed
from studies.trust.stage import Recorded, Stage, posed
from studies.trust.study import f_score, pose_errors

Holder = Literal["arm", "gripper"]
HOLDERS: Final[tuple[Holder, ...]] = ("arm", "gripper")
"""An arm in front of the object, at a different place in every frame; a gripper that holds it and turns with it."""
SHAPES: Final = ("drill", "teapot", "figurine", "l_bracket", "box")
Given = Literal["no hand", "masks with hand", "masks", "masks and hand", "nothing", "hand"]
GIVEN: Final[tuple[Given, ...]] = ("no hand", "masks with hand", "masks", "masks and hand", "nothing", "hand")
"""Given masks: no occlusion; joint masks of object and hand; masks of the object; separate masks of object and hand; no
masks; masks of the hand alone."""
FRAMES, STEP_DEG = 12, 30.0


@final
@dataclass(frozen=True)
class Outcome:
    """Result of one run."""

    shape: str
    """Name of the object's recipe."""
    holder: Holder
    """What hides it."""
    given: Given
    """The given masks."""
    hidden: float
    """Median share of the object's pixels that are hidden."""
    placed: int
    """Number of the frames that are in the model."""
    error_deg: float | None
    """Largest rotation error of a pose against the first."""
    f_score: float | None
    """Of the mesh against what the frames saw."""
    seconds: float
    """Wall time of the run without rendering."""


def stage(shape: str, holder: Holder, given: Given) -> Stage:
    """Return what is recorded and handed over: 12 frames, 30° apart on a table."""
    seed = SHAPES.index(shape)
    rng = np.random.default_rng(seed)
    recipe = viewed(load_specimen(shape), rng, seed)
    places = tuple(posed(Tabletop(FRAMES, STEP_DEG, shift_m=SHIFT_M), seed))
    recipe = replace(recipe, trajectory=Places(places))
    object_alone = Stage(recipe, PriorOptions(prior="table"), masks=given.startswith("masks") or given == "no hand")
    if given == "no hand":
        return object_alone
    if holder == "arm":
        hidden = arm(object_alone, rng, shown=range(FRAMES))
    else:
        hidden = replace(object_alone, others=(gripper(recipe, places),))
    with_hand = given == "masks with hand"
    shown = given in {"masks and hand", "hand"}
    return replace(
        hidden,
        mask_of=lambda _, own, others: own | others[0] if with_hand else own,
        occluder_of=lambda _, others: others[0] if shown else None,
    )


def outcome(shape: str, holder: Holder, given: Given) -> Outcome:
    """Build the model of one run and compare it with the truth."""
    recorded = Recorded(stage(shape, holder, given))
    modeler = compose.modeler(recorded, recorded.stage.options, MethodOptions(seed=0), ObjectOptions())
    hidden = _hidden(recorded)
    began = time.perf_counter()
    last = None
    for event in modeler.run(recorded, compose.scene(modeler, recorded)):
        last = event if isinstance(event, Step) else last
    assert last is not None
    seconds = time.perf_counter() - began
    error_deg, _ = pose_errors(recorded, last)
    trajectory = last.solution.trajectory
    score = None if last.model is None else f_score(recorded, last.model, trajectory)
    return Outcome(shape, holder, given, hidden, len(trajectory), error_deg, score, seconds)


def _hidden(recorded: Recorded) -> float:
    whole = RenderedSequence(recorded.stage.recipe)
    shares = []
    for index in recorded.indices:
        own, seen = whole.frame(index).mask, recorded.true_frame(index).mask
        assert own is not None
        assert seen is not None
        shares.append(1.0 - _count(own & seen) / max(_count(own), 1))
    return float(np.median(shares))


def _count(mask: BoolArray) -> int:
    return int(np.count_nonzero(mask))


def gripper(recipe: Recipe, places: Sequence[Place], width_m: float = 0.03) -> Recipe:
    """Return two fingers so wide and a palm that hold the object from above by its narrow sides, and turn with it."""
    x_m, y_m, height_m = reach_m(recipe)
    narrow_m, thick_m = min(x_m, y_m), 0.012
    lowest_m = 0.35 * height_m
    finger = Box((width_m, thick_m, 1.2 * height_m - lowest_m))
    palm = Box((0.05, 2.0 * (narrow_m + thick_m), 0.03))
    up_m = 0.5 * (1.2 * height_m - lowest_m)
    parts = tuple(Part(finger, (0.0, side * (narrow_m + 0.5 * thick_m), up_m)) for side in (-1.0, 1.0))
    parts += (Part(palm, (0.0, 0.0, 2.0 * up_m + 0.015)),)
    grasp = placement((0.0, 0.0, lowest_m), (0.0, 0.0, 0.0 if y_m <= x_m else 90.0))
    held = [place_of(matrix_of(place) @ grasp) for place in places]
    return thing(recipe, Compound(parts), held)


def table(outcomes: Sequence[Outcome]) -> str:
    """Return a line for each holder and given masks: medians over the shapes, and the worst."""
    lines = [f"{'':26}{'hidden':>8}{'placed':>10}{'rotation, median':>18}{'worst':>8}{'F, median':>11}{'worst':>8}"]
    for holder in HOLDERS:
        for given in GIVEN:
            some = [one for one in outcomes if one.given == given and one.holder == holder]
            if not some:
                continue
            degrees = [180.0 if one.error_deg is None else one.error_deg for one in some]
            scores = [0.0 if one.f_score is None else one.f_score for one in some]
            placed, frames = sum(one.placed for one in some), FRAMES * len(some)
            lines.append(
                f"{holder + ', ' + given:26}{np.median([one.hidden for one in some]):8.0%}{f'{placed} / {frames}':>10}"
                f"{np.median(degrees):17.2f}°{max(degrees):7.1f}°{np.median(scores):11.3f}{min(scores):8.3f}"
            )
    return "\n".join(lines)
