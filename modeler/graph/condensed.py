"""A large graph condensed to a few of its frames, so that a further one takes as long as in a small graph.

Where an object turns for hours, new edges lead to the newest frames and to keyframes alone. What all factors together
say about these frames is a Gaussian, the others eliminated (Grisetti, Kümmerle and Ni, Robust optimization of factor
graphs by using condensed measurements, IROS 2012): exact at the poses at which the factors were linearised.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

from modeler.graph import lazy_gtsam as gtsam
from modeler.graph.pose_graph import Factor
from modeler.types import Array


class Conditional(NamedTuple):
    """A variable given those that are eliminated after it: R ξ + Σ S_j ξ_j ~ N(0, 1)."""

    root: Array
    """R (6, 6), upper triangular."""
    others: Array
    """(6, 6 k), the S_j side by side."""
    parents: Sequence[int]
    """The k others."""

    @classmethod
    def of(cls, found: gtsam.GaussianConditional) -> Conditional:
        """Return one of GTSAM's, of a single variable."""
        return cls(found.R(), found.S(), found.keys()[1:])


@dataclass(frozen=True, eq=False)
class Condensed:
    """What factors say about some frames, and about the others given these."""

    factors: frozenset[Factor]
    """The factors, and outliers among them, which say nothing."""
    frames: frozenset[int]
    """The frames that are left."""
    net: gtsam.GaussianBayesNet
    """Conditionals of the eliminated ones, in their order."""
    linear: Sequence[gtsam.GaussianFactor]
    """Factors of the errors of those left."""
    poses: gtsam.Values
    """Of those left, at which the factors were linearised."""
    _known: dict[int, Conditional] = field(default_factory=dict, init=False)

    @classmethod
    def of(
        cls, factors: Sequence[Factor], poses: Mapping[int, Array], frames: frozenset[int], outliers: Iterable[Factor]
    ) -> Condensed:
        """Return factors condensed to some frames.

        Args:
            factors: those that take part, without a prior of the root, which is to be one of `frames`.
            poses: object_from_camera (4, 4) by frame number: the optimum.
            frames: which are left.
            outliers: further factors, which say nothing.
        """
        graph, values, left = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.Values()
        for factor in factors:
            graph.push_back(factor.between)
        for frame, object_from_camera in poses.items():
            values.insert(frame, gtsam.Pose3(object_from_camera))
        for frame in sorted(frames):
            left.insert(frame, gtsam.Pose3(poses[frame]))
        others, linear = [frame for frame in poses if frame not in frames], graph.linearize(values)
        try:
            net, rest = linear.eliminatePartialSequential(others)
        except RuntimeError:  # GTSAM reports an indeterminate system
            net, rest = linear.eliminatePartialSequential(others, gtsam.EliminateQR)
        return cls(frozenset((*factors, *outliers)), frames, net, [rest.at(k) for k in range(rest.size())], left)

    @cached_property
    def order(self) -> Mapping[int, int]:
        """Number of each eliminated frame in the order of elimination."""
        return {self.net.at(k).firstFrontalKey(): k for k in range(self.net.size())}

    def conditional(self, frame: int) -> Conditional:
        """Return the conditional of an eliminated frame."""
        if frame not in self._known:
            self._known[frame] = Conditional.of(self.net.at(self.order[frame]))
        return self._known[frame]

    def covers(self, factors: Iterable[Factor]) -> bool:
        """Return whether factors are of frames that are left or new, none of an eliminated one."""
        return not any(factor.target in self.order or factor.source in self.order for factor in factors)

    def new(self, factors: Iterable[Factor]) -> list[Factor]:
        """Return those of some factors that it does not hold."""
        return [factor for factor in factors if factor not in self.factors]

    def between(self) -> list[gtsam.LinearContainerFactor]:
        """Return the factors between the frames left, for a nonlinear graph."""
        return [gtsam.LinearContainerFactor(factor, self.poses) for factor in self.linear]
