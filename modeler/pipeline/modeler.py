"""The pipeline: frames in, events out. Visualisation only consumes events."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from modeler.closure import Closer
from modeler.fusion import Fuser
from modeler.pipeline.joining import Joiner
from modeler.pipeline.pairs import Prepared, Registrations, prepare, without_limits
from modeler.pipeline.run import Run
from modeler.pipeline.state import State
from modeler.pipeline.tracking import Tracker
from modeler.priors import GeneralPrior
from modeler.registration import VisibilityRegistrar
from modeler.segmentation import Scene, Segmenter
from modeler.suggestion import Belief, Candidate, Goal, Suggestions, suggest
from modeler.types import (
    AbstractPairCache,
    AbstractPrior,
    AbstractRegistrar,
    Edge,
    Event,
    Frame,
    InputError,
    Posterior,
    RayImage,
    Solution,
    Step,
    checked,
)
from modeler.views import Sensor


@checked
@dataclass(frozen=True)
class Modeler:
    """Builds the model of an object while it turns in front of the camera.

    Each frame is registered against the previous accepted view, and against earlier views to which the object seems to
    have returned (paper, section VI-D). The posteriors become edges of a pose graph, with whose optimised poses the
    views are fused.
    """

    segmenter: Segmenter = field(default_factory=Segmenter)
    """Finds the object."""
    sensor: Sensor = field(default_factory=Sensor)
    """Noise model of the camera."""
    prior: AbstractPrior = field(default_factory=GeneralPrior)
    """Prior on the motion between two frames."""
    registrar: AbstractRegistrar = field(default_factory=VisibilityRegistrar)
    """Registers two views."""
    closer: Closer = field(default_factory=Closer)
    """Selects pairs to register and accepts or rejects the results."""
    fuser: Fuser = field(default_factory=Fuser)
    """Fuses views into a mesh."""
    common_noise: float = 0.1
    """Covariance of the error common to all views of a run, as a fraction of an edge's. Loops do not observe it; with
    this value, covariances of poses are calibrated over many rendered runs, whose ground truth is known."""
    common_distance: float = 0.001
    """Standard deviation of a bias of all distances, as a share of them, unless the focal length is exact. Loops do not
    observe it, and a larger value does not improve the calibration for cameras other than the renderer's."""
    tolerance_m: float | None = None
    """Error of the surface above which a model is called wrong; None: a share of the object's size, at least what the
    camera's noise allows."""
    colour: bool = True
    """Whether colour is to fit depth for a model to be trusted."""
    seed: int = 0
    """Each pair has its own random generator, seeded with this and the two frame numbers."""
    cache: AbstractPairCache | None = None
    """Registrations of an interrupted run, if any."""

    def __post_init__(self) -> None:
        """Reject a seed that random generators do not take."""
        if self.seed < 0:
            raise InputError(f"the seed {self.seed} is negative; give a whole number from 0")

    @checked
    def run(
        self,
        frames: Iterable[Frame],
        scene: Scene,
        *,
        closure_expected: bool = False,
        depth_scale_sigma: float = 0.0,
        live: bool = False,
    ) -> Iterator[Event]:
        """Build a model and yield events: for each frame a `Step`, the last of which has the final model and verdict.

        To skip or shorten the refinement, iterate over the phases of `start(scene)` instead.

        Args:
            frames: in order of time; unless `live`, read one ahead: the last frame is always compared with the first.
            scene: as the segmenter estimated it from the sequence.
            closure_expected: whether the object is known to come back to its start.
            depth_scale_sigma: standard deviation of the depth scale's logarithm; 0 = exact.
            live: process each frame before the next one is read, which may only come later.

        Raises:
            InputError: if two frames have the same number.
        """
        run = self.start(scene, closure_expected=closure_expected, depth_scale_sigma=depth_scale_sigma)
        yield from run.track(frames, live=live)
        yield from run.revisit()
        yield from run.rejoin()
        yield from run.refine()
        yield from run.correct()
        yield from run.finish()

    @checked
    def start(self, scene: Scene, *, closure_expected: bool = False, depth_scale_sigma: float = 0.0) -> Run:
        """Return a run before its first frame; for the arguments see `run`."""
        measured = replace(self, sensor=self.sensor.measured(scene.range_noise))
        return Run(measured, scene, closure_expected=closure_expected, depth_scale_sigma=depth_scale_sigma)

    @checked
    def prepare(self, frame: Frame, scene: Scene) -> Prepared:
        """Segment a frame and prepare it for registration."""
        return prepare(frame, scene, self.segmenter, self.sensor.measured(scene.range_noise))

    @checked
    def register(self, source: RayImage, target: RayImage, prior: AbstractPrior | None = None) -> Posterior:
        """Return the posterior of target_from_source. The result depends on views, prior and seed alone.

        Args:
            source: one view.
            target: another.
            prior: of the motion. None: the modeler's own; if its limits are defaults, then any motion if nothing within
                them matches, or the images contradict the match.

        Raises:
            InputError: if the views lack what the prior needs.
        """

        def attempt(prior: AbstractPrior) -> Posterior:
            return self.registrations.register(source, target, prior.between(source, target))

        return attempt(prior) if prior is not None else without_limits(attempt(self.prior), self.prior, attempt)

    @checked
    def suggest(
        self, known: Step, candidates: Sequence[Candidate] | None = None, goal: Goal | None = None
    ) -> Suggestions:
        """Return the next actions (view, turn or poke), ranked by information gain on poses and surface.

        Args:
            known: the newest step of a run.
            candidates: possible actions; None: turns either way, pokes, laying the object on its side.
            goal: when to stop; None: every pose known to 1°, 95 % of the visible surface seen.

        Raises:
            InputError: if no view has a pose yet.
        """
        return suggest(self.belief(known.views, known.solution, known.edges_so_far), candidates, goal)

    def belief(self, views: Mapping[int, RayImage], solution: Solution, edges: Sequence[Edge]) -> Belief:
        """Return the belief about poses and surface after some views, with these components.

        Raises:
            InputError: if no view has a pose.
        """

        def ready(view: RayImage) -> RayImage:
            return view if view.layers else self.sensor.ray_image(view.frame, view.plane)

        likelihood = self.registrar.likelihood if isinstance(self.registrar, VisibilityRegistrar) else None
        prior = self.prior.learned(solution, edges)
        return Belief.of(views, solution, edges, prior, closer=self.closer, likelihood=likelihood, ready=ready)

    @property
    def registrations(self) -> Registrations:
        """Registers pairs of views."""
        return Registrations(self.registrar, self.seed, self.cache)

    def tracker(self, state: State) -> Tracker:
        """Return the tracker of a run in some state, with these components."""
        return Tracker(state, self.prior, self.closer, self.sensor, self.registrations)

    def joiner(self, tracker: Tracker) -> Joiner:
        """Return the joiner of segments of a run, with these components."""
        return Joiner(self.registrations, tracker.ready)
