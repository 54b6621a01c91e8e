"""Nonvisual information about how the object moves."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from modeler.types.densities import AbstractPoseDensity
from modeler.types.solution import Edge, Solution
from modeler.types.views import RayImage


@dataclass(frozen=True)
class SharedAxis:
    """One axis that all steps turn about: what they have in common beyond what the edge of each holds."""

    sigma_tilt_rad: float
    """How far the object tilts against the axis in a step; infinite where edges hold its direction already."""
    sigma_shift_m: float
    """How far the object slips across the axis in a step."""


class AbstractPrior(ABC):
    """A nonvisual-information model: parameters with units that say what motions are possible between two views."""

    @abstractmethod
    def between(self, source: RayImage, target: RayImage) -> AbstractPoseDensity:
        """Return the density of target_from_source.

        Raises:
            InputError: where the views lack what the prior needs (a table, say).
        """

    def relaxed(self, steps: float) -> AbstractPrior:
        """Return the prior with limits that hold for a motion of several steps; itself by default.

        A frame is registered with it where frames before it were lost, or where the motion seems to lie beyond.

        Args:
            steps: at least 1, how many steps the motion may be made of.
        """
        return self

    def learned(self, solution: Solution, edges: Sequence[Edge]) -> AbstractPrior:
        """Return the prior with what the sequence taught it so far (a common axis, a pace); itself by default.

        What is learnt from images only proposes: they count in their own edges.

        Args:
            solution: the poses so far.
            edges: every edge judged so far, in order.
        """
        return self

    def shared_axis(self, views: Collection[RayImage]) -> SharedAxis | None:
        """Return the axis that all steps between consecutive views share; None, the default, where there is none.

        Only what no edge holds is told, so that all edges and the axis together count everything once.
        """
        return None
