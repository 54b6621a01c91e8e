"""A structured-light depth camera and its errors, effect by effect, and a colour camera under lamps.

The defaults of the depth camera are those of the first Kinect (Khoshelham & Oude Elberink 2012; Nguyen, Izadi & Lovell
2012): about 1.2 mm of noise along the ray at 0.8 m, growing with the square of the range. Lamps stay with the camera
while the object turns under them, and the colour camera drifts.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter, gaussian_filter1d, maximum_filter, minimum_filter
from scipy.sparse import coo_array
from scipy.special import ndtr

from modeler import se3
from modeler.sequences.meshes import Hits, IntArray, Mesh
from modeler.sequences.rendering.labels import LabelledMesh, Surfels, gamma_coded
from modeler.system.pictures import linear_light
from modeler.types import Array, BoolArray


@dataclass(frozen=True)
class LateralJitter:
    """Correlated lateral jitter of the pixels' rays."""

    sigma_px: float = 0.4
    """Standard deviation along rows and columns."""
    correlation_px: float = 1.5
    """Width of the smoothing that neighbours share."""

    def __post_init__(self) -> None:
        _not_negative(sigma_px=self.sigma_px, correlation_px=self.correlation_px)

    def offsets_px(self, shape: tuple[int, int], rng: np.random.Generator) -> tuple[Array, Array]:
        """Draw the lateral offsets of the pixels in px, along columns and rows, each (h, w)."""
        along_w, along_h = (self.sigma_px * gaussian_field(shape, self.correlation_px, rng) for _ in range(2))
        return along_w, along_h


@dataclass(frozen=True)
class DisparityNoise:
    """Noise and quantisation of the disparity."""

    sigma_px: float = 0.07
    """Standard deviation of the disparity of a surface that faces the camera."""
    quantum_px: float = 0.125
    """Step of the disparity; 0 for none."""
    correlation_px: float = 1.0
    """Width of the smoothing that neighbours share; 0 for independent pixels."""
    slope_gain: float = 0.075
    """How fast noise grows on slopes: times 1 + gain·θ²/(π/2 - θ)² at incidence θ."""

    def __post_init__(self) -> None:
        _not_negative(sigma_px=self.sigma_px, quantum_px=self.quantum_px, correlation_px=self.correlation_px)
        _not_negative(slope_gain=self.slope_gain)

    def apply(self, depth_m: Array, incidence_rad: Array, *, focal_baseline: float, rng: np.random.Generator) -> Array:
        """Return noisy depth (h, w); `focal_baseline` is disparity in px times depth in m."""
        slope = np.minimum(incidence_rad, np.radians(85.0))
        gain = 1.0 + self.slope_gain * (slope / (np.pi / 2.0 - slope)) ** 2
        noise_px = self.sigma_px * gain * gaussian_field((depth_m.shape[0], depth_m.shape[1]), self.correlation_px, rng)
        disparity_px = focal_baseline / depth_m + noise_px
        if self.quantum_px > 0.0:
            disparity_px = self.quantum_px * np.rint(disparity_px / self.quantum_px)
        return focal_baseline / np.where(disparity_px > 0.0, disparity_px, np.nan)

    def sigma_m(self, depth_m: float, focal_baseline: float) -> float:
        """Return the standard deviation of depth in m on a surface that faces the camera."""
        return float(depth_m**2 / focal_baseline * np.hypot(self.sigma_px, self.quantum_px / np.sqrt(12.0)))


@dataclass(frozen=True)
class GrazingLoss:
    """Drop-out at grazing incidence, in patches."""

    start_deg: float = 70.0
    """Incidence from which on pixels are lost."""
    end_deg: float = 88.0
    """Incidence at which all are lost."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.start_deg < self.end_deg:
            raise ValueError("start_deg must be at least 0 and less than end_deg")

    def lost(self, incidence_rad: Array, rng: np.random.Generator) -> BoolArray:
        """Draw which pixels (h, w) are lost."""
        share = (np.degrees(incidence_rad) - self.start_deg) / (self.end_deg - self.start_deg)
        return _uniform((share.shape[0], share.shape[1]), 1.0, rng) < share


@dataclass(frozen=True)
class MixedPixels:
    """Mixed pixels: at depth discontinuities a pixel may measure a depth between the two surfaces."""

    probability: float = 0.05
    """Share of border pixels that do."""
    min_jump_m: float = 0.02
    """Least difference of depth that makes a border."""

    def __post_init__(self) -> None:
        _share(probability=self.probability)
        _not_negative(min_jump_m=self.min_jump_m)

    def apply(self, depth_m: Array, rng: np.random.Generator) -> Array:
        """Return depth (h, w) with borders mixed."""
        near = minimum_filter(np.where(np.isnan(depth_m), np.inf, depth_m), size=3)
        far = maximum_filter(np.where(np.isnan(depth_m), -np.inf, depth_m), size=3)
        chosen, blend = rng.random(depth_m.shape) < self.probability, rng.random(depth_m.shape)
        mixed = chosen & np.isfinite(depth_m) & (far - near > self.min_jump_m)
        return np.where(mixed, near + blend * np.where(mixed, far - near, 0.0), depth_m)


@dataclass(frozen=True)
class RandomLoss:
    """Drop-out of small patches anywhere."""

    probability: float = 0.002
    """Share of pixels that are lost."""
    correlation_px: float = 1.0
    """Width of the patches."""

    def __post_init__(self) -> None:
        _share(probability=self.probability)
        _not_negative(correlation_px=self.correlation_px)

    def lost(self, shape: tuple[int, int], rng: np.random.Generator) -> BoolArray:
        """Draw which pixels (h, w) are lost."""
        return _uniform(shape, self.correlation_px, rng) < self.probability


def gaussian_field(shape: tuple[int, int], correlation_px: float, rng: np.random.Generator) -> Array:
    """Draw a Gaussian field (h, w) of mean 0 and variance 1 that is smooth over `correlation_px`."""
    white = rng.normal(size=shape)
    if correlation_px == 0.0:
        return white
    impulse = np.zeros(2 * int(4.0 * correlation_px + 1.0) + 1)
    impulse[len(impulse) // 2] = 1.0
    kernel = gaussian_filter1d(impulse, correlation_px, mode="constant")
    return gaussian_filter(white, correlation_px, mode="wrap") / np.sum(kernel**2)


def _uniform(shape: tuple[int, int], correlation_px: float, rng: np.random.Generator) -> Array:
    """Draw a field (h, w) uniform on 0..1 that is smooth over `correlation_px`."""
    return ndtr(gaussian_field(shape, correlation_px, rng))


def _not_negative(**values: float) -> None:
    for name, value in values.items():
        if value < 0.0:
            raise ValueError(f"{name} must not be negative")


def _share(**values: float) -> None:
    for name, value in values.items():
        if not 0.0 <= value <= 1.0:
            raise ValueError(f"{name} must be from 0 to 1")


@dataclass(frozen=True, eq=False)
class Exposure:
    """Ray hits of one image."""

    depth_m: Array
    """(h, w) distance along the optical axis; NaN where they met nothing."""
    incidence_rad: Array
    """(h, w) angle between the ray and the normal of the hit surface."""
    shadowed: BoolArray
    """(h, w) True where the projector's light does not reach."""


@dataclass(frozen=True)
class DepthSensor:
    """A camera and a projector side by side. An effect that is null is left out."""

    baseline_m: float = 0.075
    """Distance of the projector from the camera along x, in m; positive to the right."""
    min_range_m: float = 0.4
    """Nearer surfaces are not measured."""
    max_range_m: float = 3.5
    """Farther surfaces are not measured."""
    shadow: bool = True
    """Whether surface not lit by the projector is lost."""
    jitter: LateralJitter | None = field(default_factory=LateralJitter)
    mixed: MixedPixels | None = field(default_factory=MixedPixels)
    disparity: DisparityNoise | None = field(default_factory=DisparityNoise)
    grazing: GrazingLoss | None = field(default_factory=GrazingLoss)
    loss: RandomLoss | None = field(default_factory=RandomLoss)

    def __post_init__(self) -> None:
        if self.baseline_m == 0.0:
            raise ValueError("baseline_m must not be 0")
        if not 0.0 <= self.min_range_m < self.max_range_m:
            raise ValueError("min_range_m must be at least 0 and less than max_range_m")

    def measure(self, exposure: Exposure, focal_px: float, rng: np.random.Generator) -> npt.NDArray[np.float32]:
        """Draw the measured depth (h, w) in m; NaN = no measurement.

        Every effect has its own random generator, so that leaving one out does not change the others.
        """
        mixed_rng, disparity_rng, grazing_rng, loss_rng = rng.spawn(4)
        depth_m, incidence_rad = exposure.depth_m, exposure.incidence_rad
        shape = (depth_m.shape[0], depth_m.shape[1])
        lost = np.isnan(depth_m)
        if self.shadow:
            lost = lost | exposure.shadowed
        if self.mixed is not None:
            depth_m = self.mixed.apply(depth_m, mixed_rng)
        if self.disparity is not None:
            focal_baseline = focal_px * abs(self.baseline_m)
            depth_m = self.disparity.apply(depth_m, incidence_rad, focal_baseline=focal_baseline, rng=disparity_rng)
        if self.grazing is not None:
            lost = lost | self.grazing.lost(incidence_rad, grazing_rng)
        if self.loss is not None:
            lost = lost | self.loss.lost(shape, loss_rng)
        kept = ~lost & (depth_m >= self.min_range_m) & (depth_m <= self.max_range_m)
        return np.where(kept, depth_m, np.nan).astype(np.float32)

    def sigmas(self, depth_m: float, focal_px: float, depth_unit_m: float) -> tuple[float, float]:
        """Return `(sigma_wh, sigma_r_m)` at a depth; a pixel's own width and the file's unit count as noise too."""
        jitter_px = 0.0 if self.jitter is None else self.jitter.sigma_px
        noise_m = 0.0 if self.disparity is None else self.disparity.sigma_m(depth_m, focal_px * abs(self.baseline_m))
        rounding = 1.0 / np.sqrt(12.0)
        return float(np.hypot(jitter_px, rounding) / focal_px), float(np.hypot(noise_m, depth_unit_m * rounding))


EXACT = DepthSensor(1.0, 0.0, 1e6, False, jitter=None, mixed=None, disparity=None, grazing=None, loss=None)
"""A camera without any of the effects."""


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
