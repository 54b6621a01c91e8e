"""Poses at which a model may be in a frame, whatever its rotation, and their odds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.kernels import point_likelihood
from modeler.kernels.gauss_newton import Regulariser
from modeler.registration import VisibilityLikelihood, VisibilityRegistrar
from modeler.registration.visibility.directed import DirectedLikelihood, FixedPattern, points_of, spread_points
from modeler.registration.visibility.likelihood import DESCENT_STRIDE, PairLikelihood
from modeler.registration.visibility.search import Search
from modeler.tracking.rendering import COARSE_PX, MOST_PX, ModelRenderer
from modeler.types import Array, Camera, RayImage
from modeler.views import Sensor

_NEAR = 1.15  # ratio of distances from which the model looks about the same
RIVAL_NATS: Final = 12.0
"""Below the best pose, a pose of the search is negligible: twice the log of a negligible share."""


@dataclass(frozen=True, eq=False)
class Viewpoints:
    """A model seen from all around at one distance, at a coarse resolution."""

    camera_from_model: Array
    """(v, 4, 4)."""
    views: tuple[RayImage, ...]
    """The model there."""
    centroids_m: tuple[Array, ...]
    """(5, 3) of each view and of its halves."""
    distance_m: float
    """Of the model's centre."""

    @staticmethod
    def around(renderer: ModelRenderer, count: int, camera: Camera, sensor: Sensor, distance_m: float) -> Viewpoints:
        """Return viewpoints evenly spread over the sphere (a Fibonacci lattice), but for those that see no surface.

        Args:
            renderer: of the model.
            count: number of viewpoints.
            camera: intrinsics of the frames that they are compared with.
            sensor: of these frames.
            distance_m: of the model's centre.
        """
        height = 1.0 - (2.0 * np.arange(count) + 1.0) / count
        around = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(count)
        across = np.sqrt(1.0 - height**2)
        directions = np.stack([across * np.cos(around), across * np.sin(around), height], axis=1)
        poses = np.stack([_aligned(direction, np.array([0.0, 0.0, 1.0])) for direction in directions])
        poses[:, :3, 3] = np.array([0.0, 0.0, distance_m]) - poses[:, :3, :3] @ renderer.centre_m
        views = [renderer.view(pose, camera, sensor, most_px=COARSE_PX) for pose in poses]
        kept = [number for number, view in enumerate(views) if len(view.points_m) >= VisibilityRegistrar.min_points]
        views = [views[number] for number in kept]
        return Viewpoints(poses[kept], tuple(views), tuple(_centroids(seen) for seen in views), distance_m)

    def suits(self, distance_m: float) -> bool:
        """Return whether the model looks about the same at another distance."""
        return 1.0 / _NEAR < self.distance_m / distance_m < _NEAR


@dataclass(frozen=True)
class ViewpointSearch:
    """Searches all rotations: viewpoints all around the model, turned about the line of sight."""

    viewpoints: int = 48
    """Number of viewpoints, about 30° apart."""
    turns: int = 16
    """Rotations about the line of sight that are scored at each, 22° apart: one is within a basin of attraction of
    any."""
    descended: int = 3
    """Of these, the best descend. With a third of the descents, two of nine scenes with a half visible object are
    lost."""
    refined: int = 24
    """Best poses of all viewpoints that descend once more, in a view of the model where they ended: a cube has as many
    turns."""
    rivals: int = 12
    """Of these, most that descend a last time, in views as fine as the frame."""
    coarse: VisibilityLikelihood = field(default_factory=lambda: VisibilityLikelihood(points=240, colour=False))
    """Compares the frame with viewpoints."""
    fine: VisibilityLikelihood = field(default_factory=lambda: VisibilityLikelihood(points=300))
    """Compares it with the view of the model where they ended."""
    search: Search = field(default_factory=Search)
    """Stages and steps of a descent."""

    def roughly(self, viewpoints: Viewpoints, view: RayImage, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return camera_from_model (k, 4, 4), the likeliest first, and their log-likelihoods (k,) in nats.

        They are those of few points at a coarse resolution, without colours. No two are within a basin of attraction.

        Args:
            viewpoints: around the model, at about its distance.
            view: the frame, segmented.
            rng: source of all randomness.
        """
        source = points_of(view, spread_points(view, self.coarse.points, rng))
        return _ranked(
            [self._from_viewpoint(viewpoints, number, view, source, rng) for number in range(len(viewpoints.views))]
        )

    def again(
        self,
        renderer: ModelRenderer,
        rough: tuple[Array, Array],
        view: RayImage,
        sensor: Sensor,
        rng: np.random.Generator,
    ) -> tuple[Array, Array]:
        """Return the best of rough poses after descent in views of the model where they ended, as `roughly` does.

        Those that are left as rivals, before or after it, descend once more in views as fine as the frame, with
        colours, whose bands are then alike: coarse surface alone may lead a flat object astray along its open shift.

        Args:
            renderer: of the model.
            rough: camera_from_model (n, 4, 4) and their log-likelihoods, the likeliest first.
            view: the frame, segmented.
            sensor: of the frame.
            rng: source of all randomness.
        """

        def descended(poses: Array, model: VisibilityLikelihood, most_px: float) -> list[tuple[Array, Array]]:
            views = [renderer.view(pose, view.frame.camera, sensor, most_px=most_px) for pose in poses]
            return [
                self._descended(model.between(view, seen, rng), _here_and_centred(view, seen), pose)
                for pose, seen in zip(poses, views, strict=True)
                if len(seen.points_m) >= VisibilityRegistrar.min_points
            ]

        near, scores = _ranked([rough, *descended(rough[0][: self.refined], self.coarse, COARSE_PX)])
        rivals = near[scores > scores[:1] - RIVAL_NATS][: self.rivals]
        return _ranked(descended(rivals, self.fine, MOST_PX))

    def _from_viewpoint(
        self, viewpoints: Viewpoints, number: int, view: RayImage, source: Array, rng: np.random.Generator
    ) -> tuple[Array, Array]:
        """Return camera_from_model (k, 4, 4) after descent from the best turns at one, and log-likelihoods (k,).

        Args:
            viewpoints: around the model.
            number: of the viewpoint.
            view: the frame.
            source: (n, 10) points of the frame, see `points_of`.
            rng: source of all randomness.
        """
        seen, centroids_m = viewpoints.views[number], viewpoints.centroids_m[number]
        size_m, pattern = 0.5 * (view.size_m + seen.size_m), FixedPattern.between(view, seen)
        target = points_of(seen, spread_points(seen, self.coarse.points, rng))
        pair = PairLikelihood(
            DirectedLikelihood(self.coarse, source, seen, size_m, pattern),
            DirectedLikelihood(self.coarse, target, view, size_m, pattern),
            size_m,
        )
        axis = seen.centroid_m / np.linalg.norm(seen.centroid_m)
        angles = np.arange(self.turns) * 2.0 * np.pi / self.turns
        starts = np.broadcast_to(np.eye(4), (len(centroids_m), self.turns, 4, 4)).copy()
        facing = _aligned(view.centroid_m / np.linalg.norm(view.centroid_m), axis)[:3, :3]
        starts[..., :3, :3] = Rotation.from_rotvec(angles[:, None] * axis).as_matrix() @ facing
        starts[..., :3, 3] = centroids_m[:, None] - starts[..., :3, :3] @ view.centroid_m
        starts = starts.reshape(-1, 4, 4)
        scores = pair.tempered(starts, 2.0 * self.search.blurs_m(pair)[0], stride=DESCENT_STRIDE)
        best = starts[np.argsort(-scores, kind="stable")[: self.descended]]
        return self._descended(pair, best, viewpoints.camera_from_model[number])

    def _descended(self, pair: PairLikelihood, poses: Array, camera_from_model: Array) -> tuple[Array, Array]:
        """Return camera_from_model (k, 4, 4) after descent from poses of the pair, and log-likelihoods (k,)."""
        damping = 0.0025 * pair.points / self.search.extent(pair) ** 2
        regulariser = Regulariser(se3.rows(np.eye(4)), np.zeros((6, 6)), damping, self.search.basin)
        for blur_m in self.search.blurs_m(pair):
            poses = pair.descend(poses, blur_m, regulariser, steps=self.search.steps)
        return se3.inverse(poses) @ camera_from_model, pair.tempered(poses, self.search.fine_m(pair))


def _centroids(seen: RayImage) -> Array:
    """Return the centroids (5, 3) of a view of a model, and of its halves along the axes of its image.

    Of an object that is partly hidden, one of these is about where the centroid of the rest is.
    """
    halves = [seen.centroid_m]
    for axis in np.linalg.svd(seen.points_m - seen.centroid_m, full_matrices=False)[2][:2]:
        side = (seen.points_m - seen.centroid_m) @ axis > 0.0
        halves += [seen.points_m[side].mean(axis=0), seen.points_m[~side].mean(axis=0)]
    return np.array(halves)


def _here_and_centred(view: RayImage, seen: RayImage) -> Array:
    """Return motions (2, 4, 4) from a view to that of a model: none, and the shift of one centroid to the other.

    Surface that is nearly a plane does not tell how far it is along itself, so that descent may end beside it.
    """
    return np.stack([np.eye(4), se3.translation(seen.centroid_m - view.centroid_m)])


def _ranked(found: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Return poses (k, 4, 4) and scores (k,), best first, without those within a basin of a better one."""
    if not found:
        return np.zeros((0, 4, 4)), np.zeros(0)
    poses, scores = (np.concatenate(some) for some in zip(*found, strict=True))
    kept: list[int] = []
    for number in np.argsort(-scores, kind="stable"):
        apart = se3.rotation_angle(se3.inverse(poses[kept]) @ poses[number]) if kept else np.zeros(0)
        if np.all(apart > Search.basin):
            kept.append(int(number))
    return poses[kept], scores[kept]


def _aligned(one: Array, other: Array) -> Array:
    """Return the rotation (4, 4) of least angle that takes one unit vector (3,) to another."""
    turn, axis, cosine = np.eye(4), np.cross(one, other), float(one @ other)
    if cosine < -1.0 + 1e-9:  # half a turn about any axis across
        axis = np.linalg.svd(one[None])[2][1]
        turn[:3, :3] = 2.0 * np.outer(axis, axis) - np.eye(3)
    else:
        cross = se3.hat(axis)
        turn[:3, :3] += cross + cross @ cross / (1.0 + cosine)
    return turn


# Wrong poses that the search reaches, and share of a frame's patches that match in one: measured on absent objects,
# 100 in the mean, and 0.36 of 3 to 10 patches (0.2 of more).
_POSES, _CHANCE = 100.0, 0.36


def log_odds(pair: PairLikelihood, fine_m: float) -> float:
    """Return the log (nats) of the odds that a frame shows the model in the pose in which it is rendered.

    The likelihood counts 0 where surface matches as well as in a true pose, and here where nothing was measured, as in
    the shadows of what hides the object. Of other surface, each patch matches by chance alone, in one of the poses of
    the search (method, eq. 15.1). The noise of matching surface is at least `fine_m`.
    """
    pose, here = np.eye(4), se3.rows(np.eye(4))
    noise_m = max(pair.noises_m(pose, fine_m)[0], fine_m)
    matched = float(np.mean(pair.forward.classify(here) == point_likelihood.MATCHED))
    surface = pair.temper * float(pair.without_holes().scores(pose[None], noise_m, stride=1).surface[0])
    return surface - pair.backward.image.patches * matched * np.log(_CHANCE) - np.log(_POSES)


def relative_weights(pairs: Sequence[PairLikelihood], view: RayImage, fine_m: float) -> Array:
    """Return relative weights (k,) of poses: those of Gaussians about the means, under the noise of the best match.

    Each pair is of the view and the model, rendered in one of the poses; the noise is at least `fine_m`.
    """
    here = np.eye(4)
    blur_m = max(min(pair.noises_m(here, fine_m)[0] for pair in pairs), fine_m)
    widest = np.diag(1.0 / np.repeat([1.0, view.size_m], 3) ** 2)
    logs = [
        pair.without_holes().tempered(here[None], blur_m)[0]
        - 0.5 * np.linalg.slogdet(pair.curvatures(here[None], blur_m, stride=1)[0] + widest)[1]
        for pair in pairs
    ]
    return np.exp(np.array(logs) - max(logs))
