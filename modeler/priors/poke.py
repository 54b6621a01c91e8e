"""The poke prior: a push along the table predicts the object's turn and shift."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from modeler import se3
from modeler.priors.table import WOBBLE_DEG, WOBBLE_M, OnPlane, TablePrior, on_plane
from modeler.types import AbstractPoseDensity, AbstractPrior, Array, InputError, RayImage, checked
from modeler.types.base import check_parameters

STEPS = 20  # integration steps of a push; with 10 or 40, log densities at the truth change by 0.5 nats at most
_PUSHES = 512
"""Samples of a push, for the spread of six components; with 1,024 the log density at the truth changes by 1 nat."""
_MIN_IN_PLANE = 0.1  # component of a direction in the plane: within six degrees of the normal it is an error


@dataclass(frozen=True)
class Poke:
    """A straight push with a finger that does not slip on the object."""

    point_m: tuple[float, float, float]
    """Initial contact point of the finger on the object, in camera coordinates."""
    direction: tuple[float, float, float]
    """Direction of its motion in camera coordinates, of any length, projected onto the plane."""
    length_m: float
    """Length of its motion."""

    def __post_init__(self) -> None:
        """Check the parameters."""
        check_parameters(self)


@checked
@dataclass(frozen=True)
class PokePrior(AbstractPrior):
    """Quasi-static pushing on a plane with friction.

    The motion follows from the position of the contact relative to the centre of friction, and from c, the ratio of the
    friction's greatest moment to its greatest force (Lynch, Maekawa and Tanie 1992), integrated over the push. The
    uncertain quantities (centre, c, contact, direction, length) are sampled.
    """

    poke: Poke | None = None
    """The push between any two frames."""
    pokes: Mapping[int, Poke] = field(default_factory=dict)
    """Pushes of a sequence, by the number of the first frame after each; they take precedence over `poke`."""
    poke_sigma_m: float = 0.005  # by hand: as well as a finger meets a mark
    """Standard deviation of the contact and of the push's length."""
    poke_sigma_deg: float = 5.0  # by hand
    """Standard deviation of the push's direction."""
    centre_sigma_m: float = 0.015  # by hand: half or twice as much changes log densities by 4.5 nats at most
    """Standard deviation of the centre of friction about the centroid of the visible surface, in each direction."""
    friction_sigma: float = 0.25  # by hand: from pressure at the rim to even pressure
    """Standard deviation of the log of c about the surface's root mean square distance from its centroid."""
    sigma_tilt_deg: float = WOBBLE_DEG
    """Standard deviation of the rotation out of the plane, on top of the plane's own uncertainty."""
    sigma_height_m: float = WOBBLE_M
    """Standard deviation of the motion along the normal, on top of the plane's own uncertainty."""

    def __post_init__(self) -> None:
        """Check the parameters."""
        check_parameters(self)

    def between(self, source: RayImage, target: RayImage) -> AbstractPoseDensity:
        """Return the density of target_from_source; after several pushes that of the table prior.

        Raises:
            InputError: if neither view shows a plane, no push is given, or it is directed into the plane.
        """
        earlier, later = sorted((source, target), key=lambda view: view.index)
        pokes = self._between(earlier.index, later.index)
        if len(pokes) > 1:
            return TablePrior(sigma_tilt_deg=self.sigma_tilt_deg, sigma_height_m=self.sigma_height_m).between(
                source, target
            )
        plane = on_plane(
            earlier,
            later,
            turn_rad=np.pi / 4.0,
            shift_m=0.05,
            sigma_tilt_rad=np.radians(self.sigma_tilt_deg),
            sigma_lift_m=self.sigma_height_m,
        )
        if np.linalg.norm(plane.axes[:2] @ pokes[0].direction) <= _MIN_IN_PLANE * np.linalg.norm(pokes[0].direction):
            raise InputError(
                f"the poke between frames {earlier.index} and {later.index} presses on the table, not along it; "
                "give its direction in camera coordinates"
            )
        outcomes = self._outcomes(pokes[0], earlier, plane)
        mean = outcomes.mean(axis=0)
        covariance = np.cov(outcomes.T) + np.diag([1e-4, 1e-5, 1e-5]) ** 2
        return PokeDensity(plane, mean, covariance, backwards=source is later)

    def _between(self, earlier: int, later: int) -> list[Poke]:
        """Return the pushes between two frames."""
        if not self.pokes and self.poke is not None:
            return [self.poke]
        found = [poke for frame, poke in self.pokes.items() if earlier < frame <= later]
        if not found:
            raise InputError(
                f"no poke is given between frames {earlier} and {later}; give each poke with the first frame after it, "
                "or use `prior` table"
            )
        return found

    def _outcomes(self, poke: Poke, before: RayImage, plane: OnPlane) -> Array:
        """Draw outcomes (n, 3) of a push: turn in rad, and the centroid's position relative to the later one's in m."""
        rng = np.random.default_rng(0)  # equal pushes give equal outcomes
        noise = rng.normal(size=(_PUSHES, 7))
        in_plane = plane.axes[:2]
        push = in_plane @ np.array(poke.direction)
        push = push / np.linalg.norm(push)
        along_push = np.array([push, [-push[1], push[0]]])  # coordinates along the push and orthogonal to it
        seen = before.points_m @ in_plane.T @ along_push.T
        centre = seen.mean(axis=0) + self.centre_sigma_m * noise[:, :2]
        radius_m = np.sqrt(np.sum(np.var(seen, axis=0))) * np.exp(self.friction_sigma * noise[:, 2])
        contact = along_push @ in_plane @ np.array(poke.point_m) + self.poke_sigma_m * noise[:, 3:5]
        bearing = np.radians(self.poke_sigma_deg) * noise[:, 5]
        length_m = np.maximum(poke.length_m + self.poke_sigma_m * noise[:, 6], 0.0)
        step = (length_m / STEPS)[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
        turn, shift = pushed(contact - centre, step, radius_m)
        # The centre of friction moves by `shift`; the centroid also turns about it.
        lever = seen.mean(axis=0) - centre
        cos, sin = np.cos(turn), np.sin(turn)
        rotated = np.stack([cos * lever[:, 0] - sin * lever[:, 1], sin * lever[:, 0] + cos * lever[:, 1]], axis=1)
        there = (centre + shift + rotated) @ along_push
        return np.column_stack([turn, there - in_plane @ plane.target_centroid_m])


@dataclass(frozen=True, eq=False)
class PokeDensity(AbstractPoseDensity):
    """A Gaussian of turn and shift in the plane, with a Gaussian tilt and lift out of it."""

    plane: OnPlane
    """From the earlier view to the later."""
    mean: Array
    """(3,) turn in rad, then shift in m, of the motion forward in time."""
    covariance: Array
    """(3, 3)."""
    backwards: bool
    """Whether the source is the later view."""

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        drawn = self.mean + rng.normal(size=(count, 3)) @ np.linalg.cholesky(self.covariance).T
        later_from_earlier = self.plane.motions(drawn[:, 0], drawn[:, 1:], rng)
        return se3.inverse(later_from_earlier) if self.backwards else later_from_earlier

    def log_density(self, target_from_source: Array) -> Array:
        # The uniform measure is the same forward and backward.
        later_from_earlier = se3.inverse(target_from_source) if self.backwards else target_from_source
        turn_rad, shift_m, out_of_plane = self.plane.coordinates(later_from_earlier)
        root = np.linalg.cholesky(self.covariance)
        deviation = np.column_stack([turn_rad, shift_m]) - self.mean
        whitened = np.linalg.solve(root, deviation.T)
        planar = -0.5 * np.sum(whitened**2, axis=0) - np.log((2.0 * np.pi) ** 1.5 * np.prod(np.diag(root)))
        return planar + out_of_plane


def pushed(contact_m: Array, step_m: Array, radius_m: Array) -> tuple[Array, Array]:
    """Return turns (n,) in rad and shifts (n, 2) in m of objects on a plane, pushed by a finger that does not slip.

    A limit ellipsoid relates force f and moment m at the centre of friction to the twist: v ∝ f, ω ∝ m / c², m = x × f,
    such that the contact's velocity v + ω ẑ × x is the finger's (Lynch, Maekawa and Tanie 1992).

    Args:
        contact_m: (n, 2) contact relative to the centre of friction.
        step_m: (n, 2) the finger's motion in each of the steps.
        radius_m: (n,) c, the ratio of the friction's greatest moment to its greatest force.
    """
    turn, shift, contact_m = np.zeros(len(contact_m)), np.zeros_like(contact_m), contact_m.copy()
    squares = radius_m**2
    for _ in range(STEPS):
        x, y = contact_m.T
        u, w = step_m.T
        total = squares + x**2 + y**2
        along = np.stack([(squares + x**2) * u + x * y * w, x * y * u + (squares + y**2) * w], axis=1) / total[:, None]
        turned = (x * along[:, 1] - y * along[:, 0]) / squares
        shift, turn = shift + along, turn + turned
        contact_m = contact_m + step_m - along  # the finger does not slip on the object
    return turn, shift
