"""Colour images: lamps that stay with the camera while the object turns under them, and a camera that drifts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array

from modeler import se3
from modeler.sequences.meshes import IntArray, Mesh
from modeler.sequences.rendering.labels import LabelledMesh, Surfels, gamma_coded
from modeler.sequences.rendering.meshes import Hits
from modeler.system.pictures import linear_light
from modeler.types import Array, BoolArray

_CREASE = np.cos(np.radians(30.0))
"""Triangles that meet at more than 30 degrees meet at an edge; others are facets of a round surface."""


@dataclass(frozen=True)
class Lamp:
    """Parallel light, fixed to the camera."""

    direction: tuple[float, float, float]
    """Where it comes from, in the camera frame (x right, y down, z forward); of any length."""
    strength: float
    """Radiance of a white surface that faces it; 1 is the maximum of an image."""

    def __post_init__(self) -> None:
        if not np.linalg.norm(self.direction) > 0.0 or self.strength < 0.0:
            raise ValueError("direction must not be zero, strength not negative")


@dataclass(frozen=True)
class Photography:
    """How colour comes about: Lambert's law, Blinn's and Phong's highlights, exposure, noise and sRGB's gamma.

    Lamps cast no shadows.
    """

    ambient: float = 0.3
    """Ambient light: radiance of a white surface."""
    lamps: tuple[Lamp, ...] = (Lamp((-0.7, -0.8, -0.5), 0.45), Lamp((0.6, 0.5, -0.8), 0.3))
    """Lamps, fixed to the camera."""
    highlight: float = 0.2
    """Strength of a lamp's highlight, as a share of the lamp's; 0 for a matt surface."""
    highlight_exponent: float = 30.0
    """How narrow highlights are."""
    exposure_sigma: float = 0.05
    """Standard deviation of a frame's exposure, in natural logarithm."""
    white_balance_sigma: float = 0.02
    """Standard deviation of each colour's gain in a frame, in natural logarithm."""
    noise_levels: float = 1.5
    """Standard deviation of the noise of each colour of a pixel, in 8-bit levels."""
    shift_px: float = 0.0
    """Standard deviation of the shift of a frame's colours against its depth, along either axis, in px."""
    samples: int = 3
    """Rays per pixel along each side, which are averaged."""

    def __post_init__(self) -> None:
        sizes = (
            self.ambient,
            self.highlight,
            self.exposure_sigma,
            self.white_balance_sigma,
            self.noise_levels,
            self.shift_px,
        )
        if min(sizes) < 0.0 or self.highlight_exponent <= 0.0 or not 1 <= self.samples <= 16:
            raise ValueError(
                "ambient, highlight and standard deviations must not be negative, highlight_exponent positive, samples "
                "from 1 to 16"
            )

    def radiance(self, albedo: Array, normals: Array, points_m: Array) -> Array:
        """Return the light (n, 3) that surfaces send to the camera.

        Args:
            albedo: (n, 3) linear RGB, 0 to 1.
            normals: (n, 3) unit normals in the camera frame; surfaces are lit and seen from the side that faces it.
            points_m: (n, 3) where they are, in the camera frame.
        """
        back = -points_m / np.linalg.norm(points_m, axis=-1, keepdims=True)
        facing = np.where(np.sum(normals * back, axis=-1, keepdims=True) < 0.0, -normals, normals)
        diffuse, glare = np.full(len(albedo), self.ambient), np.zeros(len(albedo))
        for lamp in self.lamps:
            towards = np.array(lamp.direction) / np.linalg.norm(lamp.direction)
            between = towards + back
            between /= np.maximum(np.linalg.norm(between, axis=-1, keepdims=True), 1e-12)
            lit = facing @ towards
            diffuse += lamp.strength * np.maximum(lit, 0.0)
            shine = np.maximum(np.sum(facing * between, axis=-1), 0.0) ** self.highlight_exponent
            glare += np.where(lit > 0.0, self.highlight * lamp.strength * shine, 0.0)
        return albedo * diffuse[:, None] + glare[:, None]

    def image(self, light: Array, rng: np.random.Generator) -> npt.NDArray[np.uint8]:
        """Return the image (h, w, 3) of a frame from radiance (h, w, 3)."""
        exposure_rng, balance_rng, noise_rng = rng.spawn(3)
        balance = self.white_balance_sigma * balance_rng.normal(size=3)
        gain = np.exp(self.exposure_sigma * exposure_rng.normal() + balance - balance.mean())
        levels = 255.0 * gamma_coded(np.clip(gain * light, 0.0, 1.0))
        noisy = levels + self.noise_levels * noise_rng.normal(size=light.shape)
        return np.rint(np.clip(noisy, 0.0, 255.0)).astype(np.uint8)


_LINEAR = linear_light(np.arange(256) / 255.0)


@dataclass(frozen=True, eq=False)
class LitMesh:
    """A mesh under the lamps."""

    mesh: Mesh
    labelled: LabelledMesh | None = None
    """Its label; without one, triangles have their own colours."""

    @cached_property
    def _smooth(self) -> SmoothNormals:
        return SmoothNormals(self.mesh)

    def light(self, photography: Photography, hits: Hits, seen: BoolArray, camera_from_mesh: Array) -> Array:
        """Return the light (n, 3) that the mesh sends to the camera from the hits (h, w) that are seen."""
        if not seen.any():
            return np.zeros((0, 3))
        triangle, weights, points_m = hits.triangle[seen], hits.weights[seen], hits.points_m[seen]
        albedo = _LINEAR[hits.albedo[seen]]
        if self.labelled is not None:
            in_mesh_m = se3.transform(se3.inverse(camera_from_mesh), points_m)
            surfels = Surfels(in_mesh_m, self._smooth.flat[triangle], triangle, weights)
            printed = self.labelled.albedo(surfels)
            albedo = np.where(np.isnan(printed), albedo, printed)
        normals = self._smooth.at(triangle, weights) @ camera_from_mesh[:3, :3].T
        return photography.radiance(albedo, normals, points_m)


@dataclass(frozen=True, eq=False)
class SmoothNormals:
    """The normals of the round surfaces that a mesh's facets stand for.

    With those of the facets, shading would show facets, which turn with the body as a print does.
    """

    mesh: Mesh

    @cached_property
    def flat(self) -> Array:
        """(t, 3) unit normals of the triangles."""
        first, second = (self.mesh.corners()[:, k] - self.mesh.corners()[:, 0] for k in (1, 2))
        across = np.cross(first, second)
        return across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)

    @cached_property
    def corners(self) -> Array:
        """(t, 3, 3) unit normals at the triangles' corners: the mean around a vertex, up to edges."""
        corners = self.mesh.corners()
        count, flat = len(corners), self.flat
        _, vertex = np.unique(np.round(corners.reshape(-1, 3), 9), axis=0, return_inverse=True)
        arms = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
        first, second = (arm / np.maximum(np.linalg.norm(arm, axis=2, keepdims=True), 1e-300) for arm in arms)
        angle = np.arccos(np.clip(np.sum(first * second, axis=2), -1.0, 1.0)).reshape(-1)
        at = coo_array((np.ones(3 * count), (np.arange(3 * count), vertex.reshape(-1)))).tocsr()
        pairs = (at @ at.T).tocoo()
        mine, other = pairs.coords[0], pairs.coords[1]
        alike = np.sum(flat[mine // 3] * flat[other // 3], axis=1) > _CREASE
        mine, other = mine[alike], other[alike]
        weights = angle[other]
        total = np.stack(
            [np.bincount(mine, weights * flat[other // 3, axis], minlength=3 * count) for axis in range(3)], axis=1
        )
        lengths = np.linalg.norm(total, axis=1, keepdims=True)
        means = np.where(lengths > 0.0, total / np.maximum(lengths, 1e-300), np.repeat(flat, 3, axis=0))
        return means.reshape(count, 3, 3)

    def at(self, triangle: IntArray, weights: Array) -> Array:
        """Return unit normals (n, 3), in the frame of the mesh, at barycentric coordinates (n, 3) in triangles (n,)."""
        normals = np.einsum("nc,nck->nk", weights, self.corners[triangle])
        return normals / np.linalg.norm(normals, axis=1, keepdims=True)
