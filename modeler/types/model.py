"""The model, the progress of a run, the results of its frames, and whether the model can be trusted."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from sys import intern

import numpy as np
import numpy.typing as npt

from modeler.types.base import Array, Outcome
from modeler.types.posteriors import Posterior
from modeler.types.reasons import ACCEPTED, Reason, code, explain
from modeler.types.solution import Edge, Solution
from modeler.types.views import Flip, Frame, RayImage, Segmentation


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


@dataclass(frozen=True, eq=False)
class ColourAlignment:
    """Where colour is against depth, as far as print that several views see determines it: a Gaussian."""

    mean: Array
    """(3,) shift right and down in px, and logarithm of the scale about the middle of the image."""
    covariance: Array
    """(3, 3); what print does not tell has the prior's."""
    flip: Flip = ""
    """How colour is turned over."""
    frames: int = 0
    """Number of frames by which the time of colour is after that of depth."""

    def __str__(self) -> str:
        (x, y, scale), (x_sd, y_sd, scale_sd) = self.mean, np.sqrt(np.diag(self.covariance))
        return (
            f"shift ({x:.1f} ± {x_sd:.1f}, {y:.1f} ± {y_sd:.1f}) px, scale {np.exp(scale):.3f} ± "
            f"{np.exp(scale) * scale_sd:.3f}"
        )


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
    colour: ColourAlignment | None = None
    """Where colour is against depth; None where no views with colour share surface, or colour was not used."""

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


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """The fused object, in the object frame (camera frame of the first accepted frame)."""

    points_m: Array
    """(n, 3) merged cloud."""
    normals: Array
    """(n, 3) unit normals of the cloud."""
    colours: npt.NDArray[np.uint8] | None
    """(n, 3) RGB of the cloud, if the input has colour."""
    vertices_m: Array
    """(v, 3) mesh vertices."""
    triangles: npt.NDArray[np.int64]
    """(t, 3) vertex numbers, counter-clockwise from outside."""
    vertex_normals: Array
    """(v, 3) unit normals of the vertices."""
    vertex_colours: npt.NDArray[np.uint8] | None
    """(v, 3) RGB of the vertices."""
    vertex_views: npt.NDArray[np.int64] | None = None
    """(v,) number of views that saw each vertex; 0 = unobserved, interpolated to close a gap. None: unknown."""
    vertex_sigmas_m: Array | None = None
    """(v,) standard deviation of each vertex along its normal, from noise and poses; inf =
    interpolated. None: unknown."""


@dataclass(frozen=True, eq=False)
class Step:
    """The result of one frame, and the state of the run after it.

    The final step of a run repeats the last frame with the pairs of the refinement and the final model.
    """

    frame: Frame
    segmentation: Segmentation
    view: RayImage | None
    """The frame prepared for registration; None if the object was not found."""
    posteriors: tuple[Posterior, ...]
    """Registrations since the step before: with this frame as source, in the final step those of the refinement."""
    edges: tuple[Edge, ...]
    """Their edges, accepted or not."""
    left_out: Reason | None
    """Why the frame is not part of the model; None: it is."""
    solution: Solution
    """All poses so far."""
    make_model: Callable[[], ObjectModel | None] = lambda: None
    edges_so_far: tuple[Edge, ...] = ()
    """Every edge so far, accepted or not, in order."""
    views: Mapping[int, RayImage] = field(default_factory=dict)
    """Every accepted view by frame number; those of the posteriors with the images that a likelihood looks up, if these
    are in memory."""
    frames_so_far: tuple[FrameRecord, ...] = ()
    """Results of every frame so far, in order of their numbers."""
    last: bool = False
    """True for the final step."""
    verdict: Verdict | None = None
    """Whether the model can be trusted; only the final step has one."""
    remasked: Collection[int] = ()
    """Numbers of the views whose masks are not those found in their frames alone; in the final step."""

    @cached_property
    def model(self) -> ObjectModel | None:
        """The model so far, made on first request: a preview except in the final step; None until the first view."""
        return self.make_model()

    @property
    def accepted(self) -> bool:
        """Whether the frame is part of the model."""
        return self.left_out is None

    @property
    def record(self) -> FrameRecord:
        """The result of the frame."""
        points = 0 if self.view is None else len(self.view.points_m)
        reason, mask = self.left_out, self.segmentation.outcome.label
        # The same words for thousands of frames in which nothing is.
        outcome, cause = (ACCEPTED, "") if reason is None else (intern(explain(reason)), intern(code(reason)))
        return FrameRecord(self.frame.index, float(self.frame.time_s), points, outcome, cause, mask)


@dataclass(frozen=True)
class Searching:
    """The previous view does not place a frame: others are tried."""

    frame: int


@dataclass(frozen=True)
class Refining:
    """After the last frame, further pairs of views are registered to improve the poses."""

    done: int
    """Pairs registered so far."""
    total: int | None
    """Pairs to register; None while they are being chosen."""


@dataclass(frozen=True)
class Fusing:
    """The final model is being made."""


Event = Step | Searching | Refining | Fusing  # an event of a run


def area_vectors_m2(vertices_m: Array, triangles: npt.NDArray[np.int64]) -> Array:
    """Return the normals (t, 3) of triangles (t, 3) of vertices (v, 3), each as long as the area."""
    one, two, three = np.moveaxis(vertices_m[triangles], 1, 0)
    return 0.5 * np.cross(two - one, three - one)


def areas_m2(vertices_m: Array, triangles: npt.NDArray[np.int64]) -> Array:
    """Return the areas (t,) of triangles (t, 3) of vertices (v, 3)."""
    return np.linalg.norm(area_vectors_m2(vertices_m, triangles), axis=1)
