"""Bodies with solid textures on a table, drawn by Open3D's ray casting: another renderer than the package's own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO
from typing import Final, Literal, final

import numpy as np
import numpy.typing as npt
import open3d as o3d
from PIL import Image
from scipy import ndimage

from modeler import se3
from modeler.types import Array, Camera, Frame
from studies.whole.capture import printed

STEP_DEG: Final = 24.0
_SIZE_M: Final = 0.075  # of apples and balls
_SAMPLES: Final = 2  # rays of colour per pixel along each side
_BASELINE_PX_M: Final = 575.0 * 0.075  # focal length times baseline of the first Kinect
_FACETS: Final = 120  # of half a turn: facets would look like print
_WAVES: Final = 16  # of each typical length of a texture
_PICTURE_M: Final = 0.08  # side of a photograph on a body
_QUALITY: Final = 30  # of JPEG: of a video call; cameras' own is 75 or more
_READOUT: Final = (0.0, 0.0, 0.035, 0.005, 0.005, 0.0)  # sd of ξ while rows are read: 60° a second for 33 ms, a hand's

Picture = npt.NDArray[np.uint8]
Effect = Literal["none", "highlights", "coloured lamps", "drift", "clipped", "JPEG", "rolling shutter"]
EFFECTS: Final[tuple[Effect, ...]] = (
    "none",
    "highlights",
    "coloured lamps",
    "drift",
    "clipped",
    "JPEG",
    "rolling shutter",
)
"""What is wrong with light or camera: lacquer; a warm and a cold lamp; exposure and white balance of each frame;
saturated and black pixels; blocks of compressed images; and rows that are read one after the other."""


@final
@dataclass(frozen=True)
class Scene:
    """One body with one texture, as a camera sees it."""

    body: str
    """`ball`, `apple`, `tin`, `mug`, `box`, `bottle` or `figure`."""
    texture: str
    """`printed`, `faint`, `freckled`, `grained`, `plain` or `photograph`."""
    seed: int
    """Of texture, start, steps and noise."""
    size_px: float = 90.0
    """Height of the body in the image."""
    size: tuple[int, int] = (320, 240)
    """Width and height of the image."""
    frames: int = 15
    """Steps of `STEP_DEG` on average."""
    effect: Effect = "none"
    """What is wrong with light or camera."""
    picture: Picture | None = None
    """(h, w, 3) of a body that has a photograph."""

    @property
    def camera(self) -> Camera:
        """The camera."""
        width, height = self.size
        return Camera(width, height, 287.5, 287.5, 0.5 * (width - 1), 0.5 * (height - 1))

    def rendered(self) -> tuple[list[Frame], dict[int, Array]]:
        """Return frames with masks, and camera_from_object (4, 4) by frame number."""
        rng = np.random.default_rng(self.seed)
        mesh, height_m = _body(self.body)
        camera, elevation = self.camera, np.radians(rng.uniform(25.0, 40.0))
        distance_m = camera.fy * height_m / self.size_px
        sin, cos = np.sin(elevation), np.cos(elevation)
        camera_from_table = np.eye(4)
        camera_from_table[:3, :3] = [[1.0, 0.0, 0.0], [0.0, -sin, -cos], [0.0, cos, -sin]]
        camera_from_table[:3, 3] = [0.0, 0.5 * height_m * cos, distance_m + 0.5 * height_m * sin]
        lamps = rng.normal(size=(2, 3)) * (1.0, 0.6, 0.3) - (0.0, 0.4, 1.0)
        if self.effect == "highlights":
            lamps[:, 1] += 1.2  # low windows, which upright surface mirrors
        texture: _Print = _Photograph(self.picture) if self.picture is not None else _Texture.drawn(self.texture, rng)
        table = _Texture.drawn("grained", rng)
        frames, truth = [], {}
        angles_deg = rng.uniform(0.0, 360.0) + np.cumsum(STEP_DEG + rng.normal(size=self.frames))
        for index, angle_deg in enumerate(angles_deg):
            turn = se3.exp(np.array([0.0, 0.0, np.radians(angle_deg), *(0.002 * rng.normal(size=2)), 0.0]))
            truth[index] = camera_from_table @ turn
            poses, textures = (truth[index], camera_from_table), (texture, table)
            frames.append(_frame(self.effect, index, camera, mesh, poses, textures, lamps, rng))
        return frames, truth


def _body(name: str) -> tuple[o3d.t.geometry.TriangleMesh, float]:
    """Return a mesh that stands on z = 0, and its height in m."""
    shapes = o3d.geometry.TriangleMesh
    if name == "ball":
        mesh, height_m = shapes.create_sphere(0.5 * _SIZE_M, _FACETS), _SIZE_M
    elif name == "apple":
        mesh, height_m = shapes.create_sphere(0.5 * _SIZE_M, _FACETS), 0.9 * _SIZE_M
        points = np.asarray(mesh.vertices) / (0.5 * _SIZE_M)
        round_, polar = np.arctan2(points[:, 1], points[:, 0]), points[:, 2]
        radius = 1.0 - 0.25 * np.exp(-((1.0 - polar) / 0.1)) - 0.12 * np.exp(-((1.0 + polar) / 0.05))
        radius *= 1.0 + 0.015 * np.cos(5.0 * round_) * (polar < 0.0) + 0.02 * np.cos(round_)
        mesh.vertices = o3d.utility.Vector3dVector(0.5 * _SIZE_M * points * radius[:, None] * (1.0, 1.0, 0.92))
    elif name == "tin":
        mesh, height_m = shapes.create_cylinder(0.037, 0.11, 2 * _FACETS, 20), 0.11
    elif name == "mug":
        mesh, height_m = shapes.create_cylinder(0.04, 0.095, 2 * _FACETS, 20), 0.095
        handle = shapes.create_torus(0.026, 0.006, 40, 16)
        handle.rotate(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])).translate((0.045, 0.0, 0.0))
        mesh = mesh + handle
        mesh.translate((-0.016, 0.0, 0.0))
    elif name == "box":
        mesh, height_m = shapes.create_box(0.08, 0.055, 0.13), 0.13
    elif name == "bottle":
        mesh, height_m = shapes.create_cylinder(1.0, 0.2, 2 * _FACETS, 100), 0.2
        points = np.asarray(mesh.vertices).copy()
        radius_m = 0.012 + 0.02 / (1.0 + np.exp((points[:, 2] - 0.045) / 0.008))
        mesh.vertices = o3d.utility.Vector3dVector(
            points * np.column_stack([radius_m, radius_m, np.ones_like(radius_m)])
        )
    else:
        mesh, height_m = shapes.create_sphere(0.05, _FACETS), 0.13
        points = np.asarray(mesh.vertices) / 0.05
        bumps = 1.0 + 0.3 * np.sin(4.0 * points[:, 0] + 1.0) * np.cos(3.0 * points[:, 1] + 2.0 * points[:, 2])
        mesh.vertices = o3d.utility.Vector3dVector(0.05 * points * bumps[:, None] * (1.0, 0.8, 1.4))
    low = np.asarray(mesh.vertices).min(axis=0)
    middle = mesh.get_axis_aligned_bounding_box().get_center()
    mesh.translate((-middle[0], -middle[1], -low[2]))
    return o3d.t.geometry.TriangleMesh.from_legacy(mesh), height_m


@final
@dataclass(frozen=True, eq=False)
class _Texture:
    """Albedo as a function of the place in the body: waves, and dots where their sums are high."""

    rgb: Array
    """(2, 3) of the ground, and of what is drawn on it."""
    scales_m: tuple[float, ...]
    """Typical lengths of what is drawn."""
    contrast: float
    """Share of the second colour where it is drawn."""
    dots: bool
    """Whether the finest scale is of dots, on a ground that changes slowly."""
    directions: Array
    """(s, n, 3) of waves, per typical length."""
    phases: Array
    """(s, n)."""

    @staticmethod
    def drawn(name: str, rng: np.random.Generator) -> _Texture:
        """Return a texture of some kind."""
        scales_m = {"freckled": (0.033, 0.0033), "grained": (0.03, 0.012, 0.005), "plain": (0.03,)}
        lengths = scales_m.get(name, (0.03, 0.01, 0.004))
        contrast = {"printed": 1.0, "faint": 0.1, "freckled": 0.35, "grained": 0.3, "plain": 0.0}[name]
        ground = rng.uniform(0.3, 0.8, 3)
        rgb = np.array([ground, np.clip(ground * rng.choice([0.3, 2.0]), 0.05, 0.95)])
        size = (len(lengths), _WAVES)
        return _Texture(
            rgb, lengths, contrast, name == "freckled", rng.normal(size=(*size, 3)), rng.uniform(0.0, 2.0 * np.pi, size)
        )

    def at(self, points_m: Array, normals: Array) -> Array:
        """Return the albedo (n, 3) at points (n, 3) of the body's frame with normals (n, 3)."""
        del normals
        values, places = [], points_m.astype(np.float32)  # several times as fast
        for scale_m, directions, phases in zip(self.scales_m, self.directions, self.phases, strict=True):
            waves = np.sin(places @ (np.pi / scale_m * directions.T).astype(np.float32) + phases.astype(np.float32))
            values.append(waves.sum(axis=1) * np.sqrt(2.0 / _WAVES))
        if self.dots:
            share = 0.5 + 0.35 * np.tanh(values[0]) + 0.5 * (values[1] > 1.3)
        elif self.contrast >= 1.0 or self.contrast == 0.1:
            share = np.mean([np.tanh(4.0 * value) > 0.0 for value in values], axis=0)  # edges, as print has
        else:
            share = 0.5 + 0.3 * np.tanh(np.sum(values, axis=0))
        return self.rgb[0] + self.contrast * share[:, None] * (self.rgb[1] - self.rgb[0])


@final
@dataclass(frozen=True, eq=False)
class _Photograph:
    """A photograph that lies on a body from six sides."""

    picture: Picture

    def at(self, points_m: Array, normals: Array) -> Array:
        """Return the albedo (n, 3) at points (n, 3) of the body's frame with normals (n, 3)."""
        return 0.05 + 0.85 * (printed(self.picture, points_m / _PICTURE_M, normals) / 255.0) ** 2.2


_Print = _Texture | _Photograph


def _frame(
    effect: Effect,
    index: int,
    camera: Camera,
    mesh: o3d.t.geometry.TriangleMesh,
    poses: tuple[Array, Array],
    textures: tuple[_Print, _Print],
    lamps: Array,
    rng: np.random.Generator,
) -> Frame:
    """Return one image of the body on its table; the camera of depth and colour is one."""
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(mesh.clone().transform(o3d.core.Tensor.from_numpy(poses[0])))
    board = o3d.geometry.TriangleMesh.create_box(0.7, 0.7, 0.01)
    board.translate((-0.35, -0.35, -0.01))
    scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(board).transform(o3d.core.Tensor.from_numpy(poses[1])))
    offsets = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
    row, column = np.indices((camera.height, camera.width), dtype=np.float64)
    shine, exponent = (1.0, 30.0) if effect == "highlights" else (0.15, 40.0)
    warm_and_cold = [[1.3, 0.9, 0.5], [0.4, 0.7, 1.2]] if effect == "coloured lamps" else np.ones((2, 3))
    toward = lamps / np.linalg.norm(lamps, axis=1, keepdims=True)
    turn = _READOUT * rng.normal(size=6) if effect == "rolling shutter" else np.zeros(6)
    shares = (np.arange(camera.height) + 0.5) / camera.height - 0.5
    moved = poses[1] @ se3.inverse(se3.exp(shares[:, None] * turn)) @ se3.inverse(poses[1])  # camera at each row

    def cast_rays(across: float, down: float, moved: Array) -> tuple[np.ndarray, dict[str, o3d.core.Tensor]]:
        x, y = (column + across - camera.cx) / camera.fx, (row + down - camera.cy) / camera.fy
        directions = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.swapaxes(moved[:, :3, :3], 1, 2)
        origins = np.broadcast_to(moved[:, None, :3, 3], directions.shape)
        rays = np.concatenate([origins, directions], axis=-1).astype(np.float32)
        return rays, scene.cast_rays(o3d.core.Tensor.from_numpy(rays))

    middle, colours = cast_rays(0.0, 0.0, np.broadcast_to(np.eye(4), moved.shape))[1], []
    depth_m, mask = middle["t_hit"].numpy().astype(np.float64), middle["geometry_ids"].numpy() == 0
    for down in offsets:
        for across in offsets:
            rays, cast = cast_rays(across, down, moved)
            distances, part = cast["t_hit"].numpy().astype(np.float64), cast["geometry_ids"].numpy()
            normals = cast["primitive_normals"].numpy().astype(np.float64)
            light = np.full((*row.shape, 3), 0.12)
            for number, (pose, texture) in enumerate(zip(poses, textures, strict=True)):
                hit = (part == number) & np.isfinite(distances)
                points_m = rays[hit][:, :3] + rays[hit][:, 3:] * distances[hit, None]
                facing = normals[hit] * np.sign(-np.sum(normals[hit] * rays[hit][:, 3:], axis=1))[:, None]
                shade = 0.35 + 0.4 * np.maximum(facing @ toward.T, 0.0) @ warm_and_cold
                half = toward - points_m[:, None] / np.linalg.norm(points_m, axis=1)[:, None, None]
                half /= np.linalg.norm(half, axis=2, keepdims=True)
                gloss = shine * np.maximum(np.einsum("ni,nki->nk", facing, half), 0.0) ** exponent @ warm_and_cold
                part_from_camera = se3.inverse(pose)
                places_m = se3.transform(part_from_camera, points_m)
                light[hit] = texture.at(places_m, facing @ part_from_camera[:3, :3].T) * shade + gloss
            colours.append(light)
    return Frame(
        index, float(index), _noisy(depth_m, rng), camera, mask, _exposed(np.mean(colours, axis=0), effect, rng)
    )


def _exposed(light: Array, effect: Effect, rng: np.random.Generator) -> Picture:
    """Return the image (h, w, 3) of light from 0 to 1."""
    exposure, balance = (0.4, 0.15) if effect == "drift" else (0.05, 0.02)
    gain = np.exp(exposure * rng.normal() + balance * rng.normal(size=3))
    if effect == "clipped":
        light = 0.5 + 2.5 * (light - np.median(light))  # much is black or white, of some bodies all
    image = 255.0 * np.clip(light * gain, 0.0, 1.0) ** (1.0 / 2.2) + 1.5 * rng.normal(size=light.shape)
    found = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    if effect != "JPEG":
        return found
    stream = BytesIO()
    Image.fromarray(found).save(stream, "JPEG", quality=_QUALITY)
    return np.array(Image.open(stream))


def _noisy(depth_m: Array, rng: np.random.Generator) -> np.ndarray:
    """Return depth with errors of disparity, alike in neighbours, and in steps, as at twice the distance."""
    noise_px = ndimage.gaussian_filter(rng.normal(size=depth_m.shape), 1.0) / 0.28
    disparity_px = _BASELINE_PX_M / np.where(np.isfinite(depth_m), depth_m, np.nan) + 0.3 * noise_px
    return (_BASELINE_PX_M / (np.rint(3.0 * disparity_px) / 3.0)).astype(np.float32)


SIZES_PX: Final[Mapping[str, float]] = {"apple": 45.0, "ball": 60.0}
"""Heights in the image of bodies that are seen small."""
