"""Depth cameras of several kinds, modelled on their measurement principle, independent of the renderer.

Each camera intersects triangles with its own rays and measures them by its principle: window matching with a fixed
pattern (Kinect 1, D415, D435), independent pixels, phases with multipath (time of flight), a stripe that falls off
edges (laser). Numbers have their source next to them; "assumed" marks those without.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final, final

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter, median_filter, uniform_filter

from modeler import se3
from modeler.types import MULTIPATH, Array, BoolArray, Camera, SensorNoise

if TYPE_CHECKING:
    import open3d as o3d

Triangles = tuple[Array, np.ndarray]
"""Vertices (n, 3) in m and triangles (m, 3)."""


@dataclass(frozen=True, eq=False)
class Look:
    """What rays (..., 3) from the camera's centre meet first."""

    depth_m: Array
    """(...) along the optical axis; infinite where they meet nothing."""
    normals: Array
    """(..., 3) unit normals towards the camera."""
    on_object: BoolArray
    """(...) whether that is the object."""


@dataclass(frozen=True, eq=False)
class World:
    """An object and what surrounds it, in camera coordinates."""

    thing: Triangles
    around: Triangles

    @cached_property
    def _scene(self) -> tuple[o3d.t.geometry.RaycastingScene, int]:
        import open3d as o3d

        scene = o3d.t.geometry.RaycastingScene()
        numbers = [
            scene.add_triangles(_tensor(vertices), o3d.core.Tensor.from_numpy(faces.astype(np.uint32)))
            for vertices, faces in (self.thing, self.around)
            if len(faces)
        ]
        return scene, numbers[0]

    def cast(self, origins: Array, rays: Array) -> Look:
        """Follow rays (..., 3) from origins of that shape; depth is in multiples of a ray's length."""
        scene, thing = self._scene
        both = np.concatenate([np.broadcast_to(origins, rays.shape), rays], axis=-1)
        found = scene.cast_rays(_tensor(both))
        normals = found["primitive_normals"].numpy().astype(np.float64)
        away = np.sum(normals * rays, axis=-1, keepdims=True) > 0.0
        return Look(
            found["t_hit"].numpy().astype(np.float64),
            np.where(away, -normals, normals),
            found["geometry_ids"].numpy() == thing,
        )

    def hidden(self, lamp_m: Array, points_m: Array) -> BoolArray:
        """Return which points (..., 3) a lamp (3,) does not reach."""
        scene, _ = self._scene
        away = np.nan_to_num(points_m, posinf=0.0) - lamp_m
        both = np.concatenate([np.broadcast_to(lamp_m, away.shape), away], axis=-1)
        return np.asarray(scene.test_occlusions(_tensor(both), tnear=0.0, tfar=0.995).numpy(), dtype=np.bool_)


@dataclass(frozen=True)
class DepthCamera(ABC):
    """A kind of depth camera."""

    width: int = 416
    height: int = 320
    """The middle of the image: all that objects and their surroundings need."""
    focal_px: float = 575.0
    distances_m: tuple[float, ...] = (0.6, 0.8, 1.1)
    """At which objects are shown to it."""

    @property
    def camera(self) -> Camera:
        """The true intrinsics."""
        middle = (self.width - 1) / 2.0, (self.height - 1) / 2.0
        return Camera(self.width, self.height, self.focal_px, self.focal_px, *middle)

    @property
    def stated(self) -> SensorNoise:
        """What is known of its errors from its kind alone."""
        return SensorNoise(sigma_r_m=None)

    def rays(self, offset_px: tuple[float, float] = (0.0, 0.0)) -> Array:
        """Return rays (h, w, 3) of unit depth, away from the middle of the pixels by an offset."""
        w, h = self.camera.rays()
        return np.stack([w + offset_px[0] / self.focal_px, h + offset_px[1] / self.focal_px, np.ones_like(w)], axis=-1)

    def look(self, world: World, offset_px: tuple[float, float] = (0.0, 0.0)) -> Look:
        """Return what the rays of the pixels meet."""
        return world.cast(np.zeros(3), self.rays(offset_px))

    @abstractmethod
    def measure(self, world: World, rng: np.random.Generator, seed: int) -> Array:
        """Return measured depth (h, w) in m, 0 where there is none.

        Args:
            world: the scene.
            rng: of noise that changes from frame to frame.
            seed: of what does not.
        """


@final
@dataclass(frozen=True)
class IndependentPixels(DepthCamera):
    """A triangulating camera each of whose pixels errs on its own."""

    baseline_m: float = 0.075
    noise_px: float = 0.12
    """Standard deviation of the disparity (assumed; 1.8 mm at 0.8 m)."""
    step_px: float = 0.1

    def measure(self, world: World, rng: np.random.Generator, seed: int) -> Array:
        """Return measured depth."""
        seen = self.look(world)
        fb = self.focal_px * self.baseline_m
        disparity = fb / seen.depth_m + rng.normal(0.0, self.noise_px, seen.depth_m.shape)
        return _depth(self.step_px * np.rint(disparity / self.step_px), fb, np.isfinite(seen.depth_m))


@final
@dataclass(frozen=True)
class WindowMatching(DepthCamera):
    """A projected pattern found again by windows: each disparity is an average over the surface in its window.

    The pattern stands still, so that a share of the error is the same whenever the same speckles fall on a pixel: what
    does not move errs alike in all frames. Where two surfaces share a window, that of its larger part wins (fattening).
    """

    baseline_m: float = 0.075
    noise_px: float = 0.0625
    """Standard deviation of the disparity of a surface that faces the camera."""
    step_px: float = 0.125
    window_px: int = 9
    blob_px: float = 0.0
    """Width (sd) over which errors are smoothed beyond the window."""
    fixed_share: float = 0.5
    """Share of the variance that a still scene repeats (assumed)."""
    grazing_deg: float = 75.0
    """Steeper surface is not found again (assumed; windows hold too many disparities)."""
    fill: bool = False
    """Whether holes take the depth of the farthest pixel around them."""

    def measure(self, world: World, rng: np.random.Generator, seed: int) -> Array:
        """Return measured depth."""
        seen, rays = self.look(world), self.rays()
        fb = self.focal_px * self.baseline_m
        there = np.isfinite(seen.depth_m)
        points = rays * np.where(there, seen.depth_m, 1.0)[..., None]
        cosine = -np.sum(seen.normals * rays, axis=-1) / np.linalg.norm(rays, axis=-1)
        lost = ~there | (cosine < np.cos(np.radians(self.grazing_deg)))
        lost |= world.hidden(np.array([self.baseline_m, 0.0, 0.0]), points)
        exact = np.where(there, fb / np.where(there, seen.depth_m, 1.0), 0.0)
        disparity = _of_window(exact, self.window_px)
        noise = self._pattern(exact, seed) * np.sqrt(self.fixed_share)
        noise += self._smooth(rng.normal(size=exact.shape)) * np.sqrt(1.0 - self.fixed_share)
        # A slope shears the window: fewer of its speckles agree.
        disparity = disparity + self.noise_px * noise / np.sqrt(np.maximum(cosine, 0.2))
        if self.step_px > 0.0:
            disparity = self.step_px * np.rint(disparity / self.step_px)
        depth = _depth(disparity, fb, ~lost)
        return _filled(depth) if self.fill else depth

    def _pattern(self, disparity: Array, seed: int) -> Array:
        """Return the errors that belong to the speckles: those of the projector's column that a pixel sees."""
        height, width = disparity.shape
        field = self._smooth(np.random.default_rng(seed).normal(size=(height, 2 * width)))
        rows, columns = np.indices(disparity.shape)
        return field[rows, np.clip(np.rint(columns + disparity).astype(np.int64), 0, 2 * width - 1)]

    def _smooth(self, white: Array) -> Array:
        """Return noise of unit variance that is an average over windows and blobs."""
        smooth = uniform_filter(white, self.window_px, mode="wrap")
        if self.blob_px > 0.0:
            smooth = gaussian_filter(smooth, self.blob_px, mode="wrap")
        return np.asarray(smooth / smooth.std())


@final
@dataclass(frozen=True)
class TimeOfFlight(DepthCamera):
    """Phases of modulated light: with light that came by way of other surfaces, and mixed at edges."""

    focal_px: float = 504.0
    """Of Azure Kinect's narrow, unbinned mode."""
    modulation_hz: float = 200e6
    """The finest of Azure Kinect's (Bamji et al. 2018: 200 MHz); unwrapping by the others is taken to be right."""
    noise_m: float = 0.001
    """Standard deviation of a white surface that faces the camera at 1 m (Tölgyessy et al. 2021: about 1 mm)."""
    albedo: float = 0.6
    """Of all surfaces in the infrared (assumed)."""
    samples: int = 3
    """Of a pixel's area, along each side."""
    bounces: int = 8
    """Directions in which each pixel's surface looks for other light."""
    min_amplitude: float = 0.1
    """Of a white surface that faces the camera at 1 m: less is not measured (assumed)."""

    @property
    def stated(self) -> SensorNoise:
        """What is known of its errors from its kind alone."""
        return SensorNoise(sigma_r_m=None, sigma_multipath=MULTIPATH["tof"])

    def measure(self, world: World, rng: np.random.Generator, seed: int) -> Array:
        """Return measured depth."""
        wave = 4.0 * np.pi * self.modulation_hz / 299792458.0  # rad per m of range
        steps = (np.arange(self.samples) + 0.5) / self.samples - 0.5
        rays = self.rays()
        length = np.linalg.norm(rays, axis=-1)
        phasor = np.zeros(length.shape, dtype=np.complex128)
        for across in steps:
            for down in steps:
                seen = self.look(world, (float(across), float(down)))
                phasor += self._direct(seen, self.rays((float(across), float(down))), wave) / self.samples**2
        phasor += self._indirect(world, self.look(world), rays, wave, rng)
        sigma = self.noise_m * wave  # of the phase at amplitude 1
        phasor += sigma * (rng.normal(size=length.shape) + 1j * rng.normal(size=length.shape))
        middle = self.look(world).depth_m
        # Unwrapped next to the nearest surface in the pixel's neighbourhood, or to any between: mod the wavelength.
        period = 2.0 * np.pi / wave
        range_m = np.angle(phasor) / wave
        near = np.where(np.isfinite(middle), middle, 0.0) * length
        range_m += period * np.rint((near - range_m) / period)
        return np.where((np.abs(phasor) > self.min_amplitude) & (near > 0.0), range_m / length, 0.0)

    def _direct(self, seen: Look, rays: Array, wave: float) -> Array:
        there = np.isfinite(seen.depth_m)
        range_m = np.where(there, seen.depth_m, 1.0) * np.linalg.norm(rays, axis=-1)
        cosine = -np.sum(seen.normals * rays, axis=-1) / np.linalg.norm(rays, axis=-1)
        amplitude = np.where(there, self.albedo * np.maximum(cosine, 0.0) / range_m**2, 0.0)
        return amplitude * np.exp(1j * wave * range_m)

    def _indirect(self, world: World, seen: Look, rays: Array, wave: float, rng: np.random.Generator) -> Array:
        """Return the light that came to each pixel's surface from others: one bounce, Lambertian, by Monte Carlo.

        What the surface sees in directions drawn by their cosine is lit from the camera; a pixel sees the mean of it.
        Looked at near the object only; the mean over 5 px takes the draw's own noise out.
        """
        there = np.isfinite(seen.depth_m)
        near = there & (uniform_filter(seen.on_object.astype(np.float64), 41) > 0.0)
        found = np.zeros(there.shape, dtype=np.complex128)
        points, normals = (rays * np.where(there, seen.depth_m, 1.0)[..., None])[near], seen.normals[near]
        total = np.zeros(len(points), dtype=np.complex128)
        for _ in range(self.bounces):
            direction = normals + _unit(rng.normal(size=points.shape))  # by the cosine
            direction = _unit(direction)
            hit = world.cast(points + 1e-4 * normals, direction)
            met = np.isfinite(hit.depth_m)
            way = np.where(met, hit.depth_m, 1.0)
            there_m = points + way[:, None] * direction
            back = np.linalg.norm(there_m, axis=1)
            cosine = np.maximum(-np.sum(hit.normals * there_m, axis=1) / back, 0.0)
            light = np.where(met, self.albedo**2 * cosine / back**2, 0.0)
            total += light * np.exp(0.5j * wave * (back + way + np.linalg.norm(points, axis=1))) / self.bounces
        found[near] = total
        weight = uniform_filter(near.astype(np.float64), 5)
        smooth = uniform_filter(found.real, 5) + 1j * uniform_filter(found.imag, 5)
        return np.where(near, smooth / np.maximum(weight, 1e-9), 0.0)


@final
@dataclass(frozen=True)
class LaserStripe(DepthCamera):
    """A laser's stripe seen at an angle. Where only a part of its width falls on a surface, its middle is misplaced."""

    noise_m: float = 0.0001
    """Of a range (scanners for objects state 0.05 to 0.3 mm)."""
    stripe_m: float = 0.001
    """Width of the stripe between 1/e² (Curless and Levoy 1995: 1 mm)."""
    triangulation_deg: float = 30.0
    """Between laser and camera (Curless and Levoy 1995)."""
    samples: int = 7

    def measure(self, world: World, rng: np.random.Generator, seed: int) -> Array:
        """Return measured depth."""
        middle = self.look(world)
        there = np.isfinite(middle.depth_m)
        depth = np.where(there, middle.depth_m, 1.0)
        weight, shift, mean = (np.zeros(depth.shape) for _ in range(3))
        for part in np.linspace(-1.0, 1.0, self.samples):  # across the stripe, out to 1/e²
            offset_m = part * 0.5 * self.stripe_m
            seen = self.look(world, (offset_m * self.focal_px / float(np.median(depth[there])), 0.0))
            same = there & (np.abs(seen.depth_m - depth) < 5.0 * self.stripe_m)
            light = np.exp(-2.0 * part**2) * same
            weight += light
            shift += light * offset_m
            mean += light * np.where(same, seen.depth_m, 0.0)
        measured = (mean + shift / np.tan(np.radians(self.triangulation_deg))) / np.maximum(weight, 1e-9)
        laser_m = np.array([float(np.median(depth[there])) * np.tan(np.radians(self.triangulation_deg)), 0.0, 0.0])
        hidden = world.hidden(laser_m, self.rays() * depth[..., None])
        return np.where(there & ~hidden, measured + rng.normal(0.0, self.noise_m, depth.shape), 0.0)


CAMERAS: Final[Mapping[str, DepthCamera]] = {
    "independent pixels": IndependentPixels(),
    # Khoshelham and Oude Elberink 2012: half a step of 1/8 px; 9 x 9 px windows (Konolige and Mihelich 2010).
    "Kinect 1": WindowMatching(focal_px=580.0),
    # Field of view 65° x 40° cut to 4:3, baseline 55 mm, 0.08 px (Intel: RMS below 0.1 px on texture), steps of
    # 1/32 px; width of the bumps assumed; holes are filled from the farthest pixel around (librealsense's default).
    "D415, holes filled": WindowMatching(
        focal_px=605.0, baseline_m=0.055, noise_px=0.08, step_px=1 / 32, window_px=7, blob_px=3.0, fixed_share=0.75,
        fill=True,
    ),
    # Field of view 87° x 58°, baseline 50 mm.
    "D435": WindowMatching(
        focal_px=385.0, baseline_m=0.05, noise_px=0.08, step_px=1 / 32, window_px=7, blob_px=1.5, fixed_share=0.75,
        distances_m=(0.4, 0.5, 0.7),
    ),
    "time of flight": TimeOfFlight(),
    "laser stripe": LaserStripe(),
}  # fmt: skip
"""By name."""


def _tensor(values: Array) -> o3d.core.Tensor:
    import open3d as o3d

    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(values, dtype=np.float32))


def _depth(disparity: Array, fb: float, kept: BoolArray) -> Array:
    good = kept & (disparity > 0.0)
    return np.where(good, fb / np.where(good, disparity, 1.0), 0.0)


def _unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _of_window(disparity: Array, window_px: int) -> Array:
    """Return the mean (h, w) over the surface that has the larger part of each window."""
    wins = median_filter(disparity, window_px)
    total, count = np.zeros_like(disparity), np.zeros_like(disparity)
    half = window_px // 2
    for down in range(-half, half + 1):
        for across in range(-half, half + 1):
            other = np.roll(disparity, (down, across), axis=(0, 1))
            same = np.abs(other - wins) < 1.0  # px: more is another surface
            total += np.where(same, other, 0.0)
            count += same
    return total / np.maximum(count, 1.0)


def _filled(depth_m: Array) -> Array:
    """Return depth with holes filled from the farthest of the eight pixels around, until there are none."""
    for _ in range(max(depth_m.shape)):
        if depth_m.all():
            break
        depth_m = np.where(depth_m == 0.0, maximum_filter(depth_m, 3), depth_m)
    return depth_m


def placed(vertices_m: Array, triangles: np.ndarray, camera_from_mesh: Array) -> Triangles:
    """Return triangles in camera coordinates."""
    return se3.transform(camera_from_mesh, vertices_m), triangles
