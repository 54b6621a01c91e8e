"""The abstract interfaces: densities of poses, priors, and registration methods."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from modeler.types.base import Array
from modeler.types.posteriors import Posterior
from modeler.types.solution import Edge, Solution
from modeler.types.views import RayImage


class AbstractPoseDensity(ABC):
    """A density on SE(3) of target_from_source, the motion of the object between two views.

    Poses are (4, 4), in metres, between camera coordinates (see `se3`). Densities are per rad³ m³, with respect to the
    uniform measure: the Haar measure of rotations, scaled as dω at the identity, times that of translations.
    """

    evidence: bool = True
    """True: independent evidence, which becomes part of the edge. False: a proposal, which only guides the search."""

    @abstractmethod
    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw poses (count, 4, 4)."""

    @abstractmethod
    def log_density(self, target_from_source: Array) -> Array:
        """Return the normalised log density (n,) of poses (n, 4, 4); -inf outside the support."""

    def log_prior(self, target_from_source: Array) -> Array:
        """Return the log density (n,) of the independent evidence at poses (n, 4, 4), which enters the posterior.

        By default the whole density if it is evidence; if it is a proposal, 0 within its support and -inf outside.
        """
        log_density = self.log_density(target_from_source)
        return log_density if self.evidence else np.where(np.isfinite(log_density), 0.0, -np.inf)

    @property
    def alternatives(self) -> tuple[AbstractPoseDensity, ...]:
        """The densities of which one holds, each of which a search covers by itself; by default the density itself."""
        return (self,)


@dataclass(frozen=True)
class SharedAxis:
    """One axis common to all steps: information beyond that in each edge."""

    sigma_tilt_rad: float
    """Standard deviation of the tilt out of the axis in one step; infinite if edges already contain its direction."""
    sigma_shift_m: float
    """Standard deviation of the slip across the axis in one step."""


class AbstractPrior(ABC):
    """Nonvisual information: a frozen dataclass whose fields are its parameters, with a density for each pair.

    To write one, subclass and implement `between`; the other methods have defaults. Ten lines suffice, since densities
    may be composed of those in `modeler.priors`:

    >>> from dataclasses import dataclass
    >>> import numpy as np
    >>> import modeler
    >>> from modeler import se3
    >>> from modeler.priors import Gaussian
    >>> from modeler.types import AbstractPrior

    >>> @dataclass(frozen=True)
    ... class ConveyorPrior(AbstractPrior):
    ...     speed_m: float = 0.05  # from one frame number to the next, along the camera's x
    ...
    ...     def between(self, source, target):
    ...         shift_m = (target.index - source.index) * self.speed_m
    ...         sigmas = np.repeat([0.02, 0.003], 3)  # rad, m
    ...         return Gaussian(se3.translation(np.array([shift_m, 0.0, 0.0])), np.diag(sigmas**2), source.centroid_m)

    It is given to `modeler.build` and `modeler.register` as `prior=ConveyorPrior(speed_m=0.1)`, or on the command line
    as `--prior FILE:ConveyorPrior --prior-args speed_m=0.1`, where FILE.py is in the current folder. To try it on two
    views:

    >>> sequence = modeler.open_sequence(modeler.sequences.bundled("box"))
    >>> source, target = (modeler.Sensor().ray_image(sequence.frame(index)) for index in (0, 1))
    >>> poses = ConveyorPrior(speed_m=0.1).between(source, target).sample(2000, np.random.default_rng(0))
    >>> moved_m = [se3.transform(pose, source.centroid_m[None])[0] - source.centroid_m for pose in poses]
    >>> print(np.mean(moved_m, axis=0).round(3) + 0.0)
    [0.1 0.  0. ]

    Frames: target_from_source (4, 4) maps a point of the object from its camera coordinates in the source frame to
    those in the target frame; x right, y down, z forward. Units: metres and radians; fields carry units in their names
    (`_deg`, `_m`), because they become command-line options. Source and target are `RayImage`: `index` is the frame
    number, `frame.time_s` its time, `points_m` (n, 3) and `normals` the surface, `centroid_m` (3,) its mean, `plane`
    the support plane or None. The source may come before or after the target, and several frames from it.

    Evidence or proposal: a density from an independent instrument (a turntable, a robot, a table) has `evidence = True`
    and is multiplied into the edge. One derived from the images themselves must have `evidence = False`, or the images
    would be counted twice: `modeler.priors.defensive_mixture(known, [guess])` lets it guide the search only.
    Uncertainties should be honest: a pose outside the support is never found.

    Raise `InputError` in `__post_init__` for parameters out of range (`modeler.types.base`), and in `between` if
    the views lack what the prior needs: the pair is skipped, with the message as its reason.
    """

    @abstractmethod
    def between(self, source: RayImage, target: RayImage) -> AbstractPoseDensity:
        """Return the density of target_from_source, the same for the same views.

        Raises:
            InputError: if the views lack what the prior needs, such as a table.
        """

    def relaxed(self, steps: float) -> AbstractPrior:
        """Return the prior with limits for a motion of several steps, at least 1; by default the prior itself.

        Used after lost frames, and if the motion seems to exceed the limits.
        """
        return self

    def unlimited(self) -> AbstractPrior | None:
        """Return the prior without limits on the motion, if these are defaults; by default None: they are given.

        Used if nothing within the limits matches.
        """
        return None

    def learned(self, solution: Solution, edges: Sequence[Edge]) -> AbstractPrior:
        """Return the prior updated with the sequence so far (a common axis, a velocity); by default the prior itself.

        What is learned from images may only propose, since the images already count in their own edges.

        Args:
            solution: the poses so far.
            edges: every edge judged so far, in order.
        """
        return self

    def following(self, frame: int) -> AbstractPrior:
        """Return the prior for a frame that is placed relative to another; by default the prior itself.

        The motion from `frame` is evidence then, that from other frames is not: it is part of the edges in between.
        """
        return self

    def shared_axis(self, views: Collection[RayImage]) -> SharedAxis | None:
        """Return the axis that all steps between consecutive views share; by default None.

        It must only contain information that no edge contains, so that nothing is counted twice.
        """
        return None


FULL_EFFORT: Final = 1.0
"""Effort of a registration that may become an edge."""


@dataclass(frozen=True, eq=False)
class ViewPair:
    """Two views to register, and all else on which the result depends."""

    source: RayImage
    target: RayImage
    density: AbstractPoseDensity
    """Prior density of target_from_source."""
    rng: np.random.Generator
    """Source of all randomness."""
    effort: float = FULL_EFFORT
    """Share (0..1] of the usual effort, for pairs that may share no surface."""
    near: Array | None = None
    """(4, 4) target_from_source of the only mode that is asked for, if it is known roughly."""


class AbstractRegistrar(ABC):
    """A registration method: parameters as fields, one pure method. To write one, implement `posterior_of`."""

    @property
    def least_effort(self) -> float:
        """The least effort at which registering costs less than with more; by default 1: there is one way only."""
        return FULL_EFFORT

    @abstractmethod
    def posterior_of(self, pair: ViewPair) -> Posterior:
        """Return the posterior of target_from_source. Failure is the posterior's outcome, never an exception."""

    def register(
        self,
        source: RayImage,
        target: RayImage,
        density: AbstractPoseDensity,
        *,
        rng: np.random.Generator,
        effort: float = FULL_EFFORT,
    ) -> Posterior:
        """Return the posterior of target_from_source; for the arguments see `ViewPair`."""
        return self.posterior_of(ViewPair(source, target, density, rng, effort))


class AbstractPairCache(ABC):
    """Results of registrations that need not be repeated."""

    @abstractmethod
    def posterior_of(self, registrar: AbstractRegistrar, pair: ViewPair) -> Posterior:
        """Return the stored result of the same registration, or else register and store it."""
