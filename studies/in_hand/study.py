"""Objects in a hand: a robot's, with a regrasp on the way, or a person's, at the frame rate of a camera."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal, final

import numpy as np

from modeler import se3
from modeler.composition import compose
from modeler.composition.options import MethodOptions, ObjectOptions, PriorOptions
from modeler.evaluation import rotation_error_deg, true_motion
from modeler.priors import HeldPrior
from modeler.sequences import AbstractSequence
from modeler.sequences.hand_shapes import HandMarkedSequence, HandShape
from modeler.sequences.rendering import RenderedSequence
from modeler.sequences.rendering.recipe import Hand, Place, Places
from modeler.sequences.rendering.shapes import Box, Compound, placement
from modeler.types import Array, HandPoses, Step
from studies.calibration.specimens import load_specimen
from studies.scenes.occluded import gripper
from studies.scenes.plan import reach_m
from studies.table_stage import matrix_of, place_of
from studies.trust.plan import viewed
from studies.trust.stage import Recorded, Stage, posed
from studies.trust.study import f_score

Holder = Literal["robot", "steady", "person"]
"""A robot that regrasps the object halfway, one that does not, or a person."""
HOLDERS: Final[tuple[Holder, ...]] = ("robot", "steady", "person")
Given = Literal["masks", "nothing", "shape"]
"""What is handed over of the images: masks of object and hand, nothing, or the shape of the robot's hand."""
GIVEN: Final[tuple[Given, ...]] = ("masks", "nothing", "shape")
SHAPES: Final = ("drill", "teapot", "figurine", "l_bracket", "rubber_duck", "toy_car", "stapler", "telephone")
ROBOT_FRAMES, REGRASPED, ROBOT_STEP_DEG = 24, 12, 18.0
"""Of the robot: number of frames, first frame of the second grasp, and the turn from frame to frame."""
PERSON_FRAMES, PERSON_STEP_DEG = 96, 4.0
"""Of the person: a full turn and a little more at 60° a second, 15 frames a second."""
SIGMA_DEG, SIGMA_M = 2.0, 0.005
"""Errors of the robot's hand poses."""
MARGIN_M: Final = 0.012
"""Of the hand's shape: two standard deviations of where the errors put it, 6 cm from the hand's frame."""
_F_M: Final = 0.003
_HEIGHT_M: Final = 0.15
_FINGER_M: Final = 0.08  # wide, to hide a good part of the object


@final
@dataclass(frozen=True)
class Outcome:
    """What one run came to."""

    holder: Holder
    shape: str
    """Name of the object's recipe."""
    hidden: float
    """Median share of the object's pixels that the hand hides."""
    placed: int
    frames: int
    """Number of frames in the model, and of all."""
    median_deg: float
    worst_deg: float
    """Rotation errors of poses against the first."""
    nees: float
    """Mean squared normalised error of poses against the first, a degree of freedom."""
    f_score: float
    """At 3 mm, of the mesh against what the frames saw."""
    status: int
    """0 or 3."""
    reasons: tuple[str, ...]
    seconds: float
    """Wall time of the run without rendering."""
    given: Given = "masks"


def stage(shape: str, holder: Holder, given: Given = "masks", *, motion: Hand | None = None) -> Stage:
    """Return what is recorded and handed over of the images; a motion replaces the holder's own."""
    seed = SHAPES.index(shape)
    rng = np.random.default_rng([seed, 9])
    recipe = viewed(load_specimen(shape), rng, seed)
    view = replace(recipe.view, look_height_m=_HEIGHT_M, elevation_deg=20.0)
    recipe = replace(recipe, table=None, view=view)
    if motion is None:
        motion = (
            Hand(PERSON_FRAMES, PERSON_STEP_DEG, 0.5, 0.002, wander=0.05, height_m=0.0)
            if holder == "person"
            else Hand(ROBOT_FRAMES, ROBOT_STEP_DEG, 3.0, 0.01, height_m=0.0)
        )
    height_m = reach_m(recipe)[2]
    raised = se3.translation(np.array([0.0, 0.0, _HEIGHT_M - 0.5 * height_m]))
    about = se3.translation(np.array([0.0, 0.0, 0.5 * height_m]))
    moves = [matrix_of(place) for place in posed(motion, seed)]
    places = [place_of(raised @ about @ move @ se3.inverse(about)) for move in moves]
    recipe = replace(recipe, trajectory=Places(tuple(places)))
    below = about @ placement((0.0, 0.0, 0.0), (180.0, 0.0, 90.0)) @ se3.inverse(about)
    away = Place((3.0, 0.0, 0.0))
    since = REGRASPED if holder == "robot" else len(places)
    first = [place if k < since else away for k, place in enumerate(places)]
    second = [place_of(matrix_of(place) @ below) if k >= since else away for k, place in enumerate(places)]
    hands = (gripper(recipe, first, _FINGER_M), gripper(recipe, second, _FINGER_M))
    return Stage(
        recipe,
        PriorOptions(prior="velocity" if holder == "person" else "general"),
        masks=given == "masks",
        others=hands,
        occluder_of=lambda _, others: others[0] | others[1] if given == "masks" else None,
    )


def hand_poses(recorded: Recorded, regrasped: int) -> Array:
    """Return camera_from_hand (n, 4, 4) as measured by a robot that regrasps the object at a frame."""
    rng = np.random.default_rng([recorded.stage.recipe.seed, 24])
    sigma = np.repeat([np.radians(SIGMA_DEG), SIGMA_M], 3)
    regrasp = se3.exp(np.array([np.pi, 0.0, 0.0, 0.0, 0.0, 0.1]))
    poses = []
    for frame, pose in recorded.truth().items():
        held = pose if frame < regrasped else pose @ regrasp
        poses.append(held @ se3.exp(rng.normal(size=6) * sigma))
    return np.stack(poses)


def hand_shape(recorded: Recorded) -> HandShape:
    """Return the robot's gripper of the first grasp as capsules in the frame of its poses."""
    recipe = recorded.stage.others[0]
    hand_from_gripper = se3.inverse(recorded.truth()[0]) @ RenderedSequence(recipe).truth()[0]
    assert isinstance(recipe.object, Compound)
    ends_m, radii_m = [], []
    for part in recipe.object.parts:
        assert isinstance(part.shape, Box)
        size_m = np.array(part.shape.size_m)
        thin, wide, long = np.argsort(size_m)
        radius_m, rows = 0.5 * size_m[thin], int(np.ceil(size_m[wide] / size_m[thin]))
        for across_m in (np.arange(rows) + 0.5) * size_m[wide] / rows - 0.5 * size_m[wide]:
            ends = np.tile(part.offset_m, (2, 1))
            ends[:, wide] += across_m
            ends[:, long] += np.array([-1.0, 1.0]) * (0.5 * size_m[long] - radius_m)
            ends_m.append(se3.transform(hand_from_gripper, ends))
            radii_m.append(radius_m)
    return HandShape(np.array(ends_m), np.array(radii_m), MARGIN_M)


def outcome(shape: str, holder: Holder, given: Given = "masks") -> Outcome:
    """Build the model of one run and compare it with the truth."""
    recorded = Recorded(stage(shape, holder, given))
    modeler = compose.modeler(recorded, recorded.stage.options, MethodOptions(seed=0), ObjectOptions())
    sequence: AbstractSequence = recorded
    if holder != "person":
        times_s = np.array([recorded.frame(index).time_s for index in recorded.indices])
        regrasped = REGRASPED if holder == "robot" else ROBOT_FRAMES
        poses = HandPoses(times_s, hand_poses(recorded, regrasped))
        modeler = replace(modeler, prior=HeldPrior(poses))
        if given == "shape":
            sequence = HandMarkedSequence(recorded, hand_shape(recorded), poses)
    hidden = _hidden(recorded)
    began = time.perf_counter()
    *_, last = modeler.run(sequence, compose.scene(modeler, sequence))
    assert isinstance(last, Step)
    assert last.verdict is not None
    seconds = time.perf_counter() - began
    trajectory, truth = last.solution.trajectory, recorded.truth()
    first, *others = sorted(trajectory)
    relative = {frame: se3.inverse(trajectory[first]) @ trajectory[frame] for frame in others}
    errors_deg = [rotation_error_deg(pose, true_motion(truth, first, frame)) for frame, pose in relative.items()]
    normalised = []
    for frame, pose in relative.items():
        xi = se3.log(se3.inverse(pose) @ true_motion(truth, first, frame))
        normalised.append(xi @ np.linalg.solve(last.solution.covariances[frame], xi) / 6.0)
    score = None if last.model is None else f_score(recorded, last.model, trajectory, _F_M)
    return Outcome(
        holder,
        shape,
        hidden,
        len(trajectory),
        len(recorded.indices),
        float(np.median(errors_deg)) if errors_deg else np.inf,
        float(np.max(errors_deg, initial=0.0)),
        float(np.mean(normalised)) if normalised else np.nan,
        score or 0.0,
        0 if last.verdict.trustworthy else 3,
        last.verdict.reasons,
        seconds,
        given,
    )


def _hidden(recorded: Recorded) -> float:
    """Return the median share of the object's pixels that the hand hides."""
    alone = Recorded(replace(recorded.stage, others=(), occluder_of=lambda index, others: None))
    shares = []
    for index in recorded.indices:
        own, seen = alone.true_frame(index).mask, recorded.true_frame(index).mask
        assert own is not None
        assert seen is not None
        shares.append(1.0 - np.count_nonzero(own & seen) / max(np.count_nonzero(own), 1))
    return float(np.median(shares))


def table(outcomes: Sequence[Outcome]) -> str:
    """Return a line a run."""
    heads = ("hidden", "frames", "median", "worst", "NEES/6", "F 3 mm", "status", "s")
    lines = [" " * 32 + "".join(f"{head:>9}" for head in heads)]
    for one in outcomes:
        cells = f"{one.hidden:.0%}", f"{one.placed}/{one.frames}", f"{one.median_deg:.2f}°", f"{one.worst_deg:.2f}°"
        cells += f"{one.nees:.2f}", f"{one.f_score:.3f}", f"{one.status}", f"{one.seconds:.0f}"
        lines.append(f"{', '.join((one.holder, one.shape, one.given)):32}" + "".join(f"{cell:>9}" for cell in cells))
    return "\n".join(lines)
