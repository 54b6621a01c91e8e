"""The nouns of the package and its abstract interfaces, in the order data meets them. All are frozen values.

Lengths are metres and angles radians unless a name says otherwise; `se3` holds the conventions of poses and tangents.
"""

from __future__ import annotations

import enum
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from modeler import se3

Array = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]


class InputError(Exception):
    """Input that cannot be used: one line that names what, where and what to do. Commands end with status 2."""


class Outcome(enum.Enum):
    """How an attempt ended, each with a sentence of advice."""

    CONVERGED = "converged", "The posterior is one compact bump; nothing to do."
    AMBIGUOUS = "ambiguous", "Several poses explain the images; add a prior (table, turntable) or more views."
    DEGENERATE = "degenerate", "Too few distinct samples carry the weight; raise the number of samples."
    NO_OVERLAP = "no overlap", "The views share too little surface; use a smaller step between frames."
    AT_LIMIT = (
        "at the prior's limit",
        "The motion may be larger than the prior allows; raise --max-rotation-deg, --max-offset-m or --max-shift-m.",
    )
    TOO_FEW_POINTS = "too few points", "The object covers too few pixels; check the mask, --roi and --max-depth-m."
    UNSURE_MASK = "unsure mask", "The object is hard to tell from its surroundings; give --roi, --max-depth-m or masks."
    NO_PLANE = "no plane", "No support plane was found; use --prior general or show more of the table."

    label: str
    advice: str

    def __new__(cls, label: str, advice: str) -> Outcome:
        """Make a member whose value is its label."""
        member = object.__new__(cls)
        member._value_ = label
        member.label = label
        member.advice = advice
        return member


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion; x right, y down, z forward."""

    width: int
    """Image width in px."""
    height: int
    """Image height in px."""
    fx: float
    """Focal length along x in px."""
    fy: float
    """Focal length along y in px."""
    cx: float
    """Column of the principal point in px; pixel centres lie at whole numbers."""
    cy: float
    """Row of the principal point in px."""

    def rays(self) -> tuple[Array, Array]:
        """Return w = x/z and h = y/z of every pixel, each (h, w)."""
        w = (np.arange(self.width, dtype=np.float64) - self.cx) / self.fx
        h = (np.arange(self.height, dtype=np.float64) - self.cy) / self.fy
        return np.broadcast_to(w, (self.height, self.width)), np.broadcast_to(h[:, None], (self.height, self.width))


@dataclass(frozen=True, eq=False)
class Frame:
    """One image of the depth camera."""

    index: int
    """Number of the frame in its sequence."""
    time_s: float
    """Time of capture in s; the index where none is known."""
    depth_m: npt.NDArray[np.float32]
    """(h, w) distance along the optical axis; NaN = no measurement."""
    camera: Camera
    """Intrinsics of the depth image."""
    mask: BoolArray | None = None
    """(h, w) True = object; None = not segmented."""
    colour: npt.NDArray[np.uint8] | None = None
    """(h, w, 3) RGB aligned to depth."""


@dataclass(frozen=True, eq=False)
class Plane:
    """A support plane in camera coordinates: normal · p + offset_m = 0."""

    normal: Array
    """(3,) unit, pointing to the side on which the camera and the object are."""
    offset_m: float
    """Distance of the camera from the plane, positive."""
    sigma_tilt_rad: float
    """Standard deviation of the normal's direction, about either axis in the plane."""
    sigma_offset_m: float
    """Standard deviation of the plane's distance below the object."""

    def height_m(self, points: Array) -> Array:
        """Return the height (n,) of points (n, 3) above the plane."""
        return points @ self.normal + self.offset_m


@dataclass(frozen=True, eq=False)
class Segmentation:
    """What of a frame is the object, and what it stands on."""

    mask: BoolArray
    """(h, w) True = object."""
    plane: Plane | None
    """The support plane, where one is seen."""
    outcome: Outcome
    """CONVERGED, or UNSURE_MASK / TOO_FEW_POINTS where a person should look."""


@dataclass(frozen=True, eq=False)
class RayImage:
    """A segmented frame made ready for registration: what was seen, and where it was empty.

    Surface points are the object's pixels with a normal; they lie on the measured surface smoothed by local planes.
    """

    frame: Frame
    """The frame, with its mask."""
    plane: Plane | None
    """The support plane, where one is seen."""
    sigma_wh: float
    """Lateral noise of the sensor in ray coordinates (w, h)."""
    sigma_r_m: float
    """Noise of the sensor along the ray, for a surface that faces it."""
    points_m: Array
    """(n, 3) surface points in camera coordinates."""
    normals: Array
    """(n, 3) unit normals, towards the camera."""
    pixels: npt.NDArray[np.int64]
    """(n, 2) row and column of each point."""
    layers: Mapping[str, npt.NDArray[np.float64] | npt.NDArray[np.float32]] = field(default_factory=dict)
    """Images a likelihood looks up, made by `rays`."""

    @property
    def index(self) -> int:
        """Number of the frame in its sequence."""
        return self.frame.index

    @cached_property
    def centroid_m(self) -> Array:
        """Mean (3,) of the surface points; the origin where there are none."""
        return self.points_m.mean(axis=0) if len(self.points_m) else np.zeros(3)


@dataclass(frozen=True, eq=False)
class EvenSpread:
    """Motions spread evenly over rotations up to a limit and over a ball of centroid offsets."""

    source_centroid_m: Array
    """(3,)."""
    target_centroid_m: Array
    """(3,)."""
    middle: Array
    """(3, 3) rotation from which the limit counts."""
    max_rotation_rad: float
    """Largest angle of the rotation from the middle."""
    max_offset_m: float
    """Largest distance between the target's centroid and the source's, carried over."""


class AbstractMotion(ABC):
    """What is known of one motion `target_from_source` before the images are compared: a density on SE(3)."""

    evidence: bool
    """True: independent knowledge that belongs in the edge. False: only proposes where to look."""

    @abstractmethod
    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw motions (count, 4, 4)."""

    @abstractmethod
    def log_density(self, target_from_source: Array) -> Array:
        """Return the log density (n,) of motions (n, 4, 4) with respect to the uniform measure; -inf outside."""

    def even_spread(self) -> EvenSpread | None:
        """Return the limits within which motions are spread evenly, where that is all there is to them; else None."""
        return None

    def log_evidence(self, target_from_source: Array) -> Array:
        """Return the log density (n,) of what is independently known, the part of a motion that belongs in an edge.

        All of the density where it is evidence; where it only proposes, 0 within its support and -inf outside.
        """
        log_density = self.log_density(target_from_source)
        return log_density if self.evidence else np.where(np.isfinite(log_density), 0.0, -np.inf)


class AbstractPrior(ABC):
    """A nonvisual-information model: parameters with units that say what motions are possible between two views."""

    @abstractmethod
    def between(self, source: RayImage, target: RayImage) -> AbstractMotion:
        """Return the density of target_from_source.

        Raises:
            InputError: where the views lack what the prior needs (a table, say).
        """

    def grown(self, steps: float) -> AbstractPrior:
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


@dataclass(frozen=True, eq=False)
class PoseGaussian:
    """A Gaussian on SE(3): `mean @ exp(ξ)` with ξ ~ N(0, covariance)."""

    mean: Array
    """(4, 4)."""
    covariance: Array
    """(6, 6) of ξ: rotation in rad first, then translation in m."""

    def inverse(self) -> PoseGaussian:
        """Return the Gaussian of the inverse motion."""
        return PoseGaussian(se3.inverse(self.mean), se3.inverse_covariance(self.mean, self.covariance))


@dataclass(frozen=True, eq=False)
class Mode:
    """One of several separate places where a posterior has its mass."""

    weight: float
    """Share (0..1) of the mass."""
    pose: PoseGaussian
    """target_from_source: mean and covariance of this part alone."""


@dataclass(frozen=True, eq=False)
class Posterior:
    """What two views and a prior say about the motion between them."""

    source: int
    """Frame number of the source view."""
    target: int
    """Frame number of the target view."""
    pose: PoseGaussian
    """target_from_source: mean and covariance."""
    outcome: Outcome
    """How the attempt ended."""
    overlap: float
    """Share (0..1) of the surface that should be seen by both cameras at the mean and is."""
    samples: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))
    """(n, 4, 4) samples of target_from_source; empty where the method draws none."""
    weights: Array = field(default_factory=lambda: np.zeros(0))
    """(n,) weights of the samples, summing to 1."""
    modes: tuple[Mode, ...] = ()
    """The separate modes, heaviest first, whose weights sum to 1; empty where there is but one, or none are told."""
    information: Array | None = None
    """(6, 6) information about ξ from the images alone, without the prior; None where not known."""
    effective_samples: float = float("nan")
    """Effective sample size."""
    pareto_k: float = float("nan")
    """Tail index of the weights; above 0.7 their mean is not to be trusted."""
    log_evidence: float = float("nan")
    """Log of the mean likelihood under the prior, against nothing matching (nats)."""
    seconds: float = float("nan")
    """Wall time of the registration in s."""

    @property
    def usable(self) -> bool:
        """Whether the posterior may become an edge."""
        return self.outcome in (Outcome.CONVERGED, Outcome.AMBIGUOUS)


class AbstractRegistrar(ABC):
    """A registration method: parameters as fields, one pure method."""

    @abstractmethod
    def register(
        self, source: RayImage, target: RayImage, motion: AbstractMotion, *, rng: np.random.Generator
    ) -> Posterior:
        """Return the posterior of target_from_source. Failure is the posterior's outcome, never an exception."""


@dataclass(frozen=True, eq=False)
class Edge:
    """A posterior as the graph sees it: joined, or judged and left out."""

    posterior: Posterior
    """The registration behind the edge."""
    kind: str
    """"odometry" or "closure"."""
    accepted: bool
    """Whether the edge takes part in the optimisation."""
    reason: str
    """Why, in words."""

    @property
    def source(self) -> int:
        """Frame number of the source view."""
        return self.posterior.source

    @property
    def target(self) -> int:
        """Frame number of the target view."""
        return self.posterior.target


def _unsolved(target: int, source: int) -> Array:
    """Refuse: nothing was solved."""
    raise KeyError(f"no motion from frame {source} to frame {target} was solved")


@dataclass(frozen=True, eq=False)
class Solution:
    """The optimised poses."""

    trajectory: Mapping[int, Array] = field(default_factory=dict)
    """object_from_camera (4, 4) by frame number."""
    covariances: Mapping[int, Array] = field(default_factory=dict)
    """Marginal covariance (6, 6) by frame number; the first frame's is the gauge's."""
    odometry: Mapping[int, Array] = field(default_factory=dict)
    """object_from_camera (4, 4) of the pairwise chain alone, before closure."""
    outliers: tuple[Edge, ...] = ()
    """Accepted edges that the optimisation left out because all others contradict them."""
    relative_covariance: Callable[[int, int], Array] = _unsolved
    """Covariance (6, 6) of `relative(target, source)`, worked out when called."""
    edge_poses: Mapping[tuple[int, int], PoseGaussian] = field(default_factory=dict)
    """target_from_source by (source, target) of edges that took part otherwise than by the posterior's own pose."""
    mode_weights: Mapping[tuple[int, int], Array] = field(default_factory=dict)
    """Weights (m,) that all edges together leave to the modes of an edge with several, by (source, target)."""
    camera_from_axis: Array | None = None
    """(4, 4), the third direction that about which all steps turn; None where that was not asked, or does not fit."""

    def relative_gaussian(self, target: int, source: int) -> PoseGaussian:
        """Return target_from_source between two different solved frames, with its uncertainty."""
        return PoseGaussian(self.relative(target, source), self.relative_covariance(target, source))

    def relative(self, target: int, source: int) -> Array:
        """Return target_from_source (4, 4) between two solved frames."""
        return se3.inverse(self.trajectory[target]) @ self.trajectory[source]


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """The fused object, in the object frame (camera frame of the first accepted frame)."""

    points_m: Array
    """(n, 3) merged cloud."""
    normals: Array
    """(n, 3) unit normals of the cloud."""
    colours: npt.NDArray[np.uint8] | None
    """(n, 3) RGB of the cloud, where the input has colour."""
    vertices_m: Array
    """(v, 3) mesh vertices."""
    triangles: npt.NDArray[np.int64]
    """(t, 3) vertex numbers, counter-clockwise from outside."""
    vertex_normals: Array
    """(v, 3) unit normals of the vertices."""
    vertex_colours: npt.NDArray[np.uint8] | None
    """(v, 3) RGB of the vertices."""
    vertex_views: npt.NDArray[np.int64] | None = None
    """(v,) how many views saw each vertex; 0 = surface that nobody saw, made up to close a gap. None: not known."""
    vertex_sigmas_m: Array | None = None
    """(v,) standard deviation of each vertex along its normal, as far as noise and poses are known to err; inf = made
    up. None: not known."""


@dataclass(frozen=True, eq=False)
class Step:
    """What one frame brought: the only thing that leaves the loop."""

    frame: Frame
    """The frame as read."""
    segmentation: Segmentation
    """What of it is the object."""
    view: RayImage | None
    """The frame made ready; None where the object was not found."""
    posteriors: tuple[Posterior, ...]
    """Registrations tried with this frame as source."""
    edges: tuple[Edge, ...]
    """Their judgement."""
    outcome: str
    """"accepted", or why the frame was left out."""
    solution: Solution
    """All poses so far."""
    model: ObjectModel | None
    """The model so far; None until the first view."""
    edges_so_far: tuple[Edge, ...] = ()
    """Every edge judged so far, in order."""
    views: Mapping[int, RayImage] = field(default_factory=dict)
    """Every accepted view by frame number."""
    last: bool = False
    """True on the final step, whose model is made with care."""
