"""A simulated robot in front of the renderer: executes suggested actions with errors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np

from modeler.priors import PokePrior
from modeler.sequences.rendering.recipe import Recipe
from modeler.suggestion import Belief, Candidate
from studies.table_stage import Stage

TURN_SIGMA_DEG: Final = 2.0
"""Standard deviation of its turns: about that of a person with a mark to turn by."""
SHIFT_SIGMA_M: Final = 0.004
"""Standard deviation of where it puts the object back, along each direction of the table."""


@final
@dataclass(frozen=True)
class SimulatedRobot:
    """State of the robot. Immutable: `after` returns the next one."""

    stage: Stage
    """The object before the camera."""

    @classmethod
    def before(cls, recipe: Recipe) -> SimulatedRobot:
        """Return the robot before its first action."""
        return cls(Stage(recipe))

    def after(self, candidate: Candidate, belief: Belief, rng: np.random.Generator) -> SimulatedRobot:
        """Return the robot after an action; the motion of a poke is drawn from its prior.

        Args:
            candidate: the action.
            belief: before the action.
            rng: source of the errors.
        """
        if candidate.poke is not None:
            later = replace(belief.last, frame=replace(belief.last.frame, index=belief.last.index + 1))
            density = PokePrior(candidate.poke).between(belief.last, later)
            return SimulatedRobot(self.stage.moved(density.sample(1, rng)[0]))
        if candidate.action != "turn":
            motion = candidate.motion(belief.last, belief.stand, belief.object_from_last)
            return SimulatedRobot(self.stage.moved(motion))
        x, y = self.stage.poses[-1].offset_m[:2]  # it puts it back half of the way to the middle of the table
        shift_x, shift_y = rng.normal(0.0, SHIFT_SIGMA_M, 2)
        turn_deg = candidate.turn_deg + rng.normal(0.0, TURN_SIGMA_DEG)
        return SimulatedRobot(self.stage.moved_on_table(turn_deg, (float(shift_x - 0.5 * x), float(shift_y - 0.5 * y))))
