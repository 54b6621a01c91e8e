"""Whether a model can be trusted, and the results of frames on which that depends."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from modeler.types.base import Array, Outcome
from modeler.types.reasons import ACCEPTED


@dataclass(frozen=True, slots=True)
class FrameRecord:
    """The result of one frame."""

    id: int
    timestamp: float
    """Time of capture in s."""
    points: int
    """Number of surface points on the object."""
    outcome: str
    """`ACCEPTED`, or the reason in words why the frame was left out."""
    cause: str = ""
    """The machine-readable reason, from `types.code`; "" for accepted frames."""
    mask: str = Outcome.CONVERGED.label
    """Label of the segmentation's outcome."""

    @property
    def accepted(self) -> bool:
        """Whether the frame is part of the model."""
        return self.outcome == ACCEPTED


@dataclass(frozen=True)
class Check:
    """A measured value, compared with its limit."""

    value: float
    limit: float
    """Beyond it, the model is not trusted."""
    at_least: bool = False
    """Whether the limit is a lower one."""

    @property
    def holds(self) -> bool:
        """Whether the value is within its limit."""
        return self.value >= self.limit if self.at_least else self.value <= self.limit


@dataclass(frozen=True)
class Shortcoming:
    """A reason not to trust a model."""

    code: str
    """For programs: `interrupted`, `unfinished`, `left_out`, `too_few_frames`, `unsure_masks`, `no_motion`,
    `prior_contradicted`, `colour_misaligned`, `print_contradicts`, `flat_match`, `loop_open`, `edges_disagree`,
    `closures_refused`, `unconfirmed`, `never_came_back`, `not_tried`, `free_space_violations`, `false_surface`,
    `other_modes`, `unsure_rotation`, `unsure_place`, `unsure_focal` or `unsure_size`."""
    words: str
    """For people."""


@dataclass(frozen=True, eq=False)
class Contradictions:
    """Where a frame and others contradict each other under the poses found, in pixels of the frame."""

    surface: Array
    """(n, 4) row and column of its surface in the free space of others, number of frames in whose free space it is, and
    of frames that see it."""
    free: Array
    """(m, 2) row and column where it measured free space, and others surface."""


@dataclass(frozen=True)
class Verdict:
    """Whether a model can be trusted."""

    shortcomings: tuple[Shortcoming, ...] = ()
    """Reasons not to trust it; empty if it can be trusted."""
    checks: Mapping[str, Check] = field(default_factory=dict)
    """By name, after the last step: `unsure_masks`, `motion_m`, `prior_sds`, `prior_chi2`, `loop_sigmas`,
    `graph_chi2`, `free_space_violations`, `false_surface`, `other_modes`, `colour_fit`, `print_fit`, `flat_frames`,
    `pose_sd_deg`, `pose_sd_m` and `size_m`, as available."""
    tolerance_m: float = 0.0
    """Error of the surface above which a model is called wrong."""
    contradicted: Mapping[int, Contradictions] = field(default_factory=dict)
    """By number of a frame that contradicts others beyond a limit."""

    @property
    def trustworthy(self) -> bool:
        """Whether the model can be trusted."""
        return not self.shortcomings

    @property
    def trusted_to_m(self) -> float | None:
        """Error of the surface due to poses that no frame exceeds with 95 % probability; None if it is not trusted."""
        check = self.checks.get("pose_sd_m")
        return self.tolerance_m * check.value / check.limit if check is not None and self.trustworthy else None

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why it is not trusted, in words."""
        return tuple(shortcoming.words for shortcoming in self.shortcomings)

    @property
    def codes(self) -> tuple[str, ...]:
        """The same for programs."""
        return tuple(shortcoming.code for shortcoming in self.shortcomings)
