"""Prints on objects: synthetic prints and image files, and how images are laid on the body: flat charts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from modeler.sequences.image_files import read_colour
from modeler.sequences.meshes import IntArray, Mesh
from modeler.system.pictures import linear_light
from modeler.types import Array, BoolArray, Float32Array, InputError


@dataclass(frozen=True)
class Chart:
    """A flat image's size on the body: u runs to the right and v down, as seen from outside, each 0 to 1."""

    width_m: float
    """Length of the row that is the longest."""
    height_m: float
    """Length of a column."""
    closed: bool = False
    """Whether rows meet their own beginning."""
    polar: bool = False
    """Whether rows are circles of latitude, the first and the last of them points."""

    def row_lengths_m(self, v: Array) -> Array:
        """Return the lengths of rows at `v` (n,)."""
        return self.width_m * (np.sin(np.pi * v) if self.polar else np.ones_like(v))


@dataclass(frozen=True, eq=False)
class Surfels:
    """Points of a mesh's surface."""

    points_m: Array
    """(n, 3) in the frame of the mesh."""
    normals: Array
    """(n, 3) outward normals of the triangles."""
    triangle: IntArray
    """(n,) number of the triangle."""
    weights: Array
    """(n, 3) barycentric coordinates."""


@dataclass(frozen=True, eq=False)
class Places:
    """Where points lie in charts."""

    chart: IntArray
    """(n,) number of the chart; -1 for points that are in none."""
    u: Array
    """(n,)."""
    v: Array
    """(n,)."""


@dataclass(frozen=True)
class Cylindrical:
    """One image around the z axis, over side-facing surface."""

    bottom_m: float | None = None
    """Height in the model frame at which it begins in m; null for that of the lowest point."""
    top_m: float | None = None
    """Height at which it ends in m; null for that of the highest point."""

    def __post_init__(self) -> None:
        if self.bottom_m is not None and self.top_m is not None and self.bottom_m >= self.top_m:
            raise ValueError("top_m must be more than bottom_m")

    def _heights_m(self, mesh: Mesh) -> tuple[float, float]:
        low, high = mesh.vertices_m[:, 2].min(), mesh.vertices_m[:, 2].max()
        return float(low) if self.bottom_m is None else self.bottom_m, float(high) if self.top_m is None else self.top_m

    def charts(self, mesh: Mesh) -> tuple[Chart, ...]:
        """Return the charts of a mesh."""
        low_m, high_m = self._heights_m(mesh)
        radius_m = float(np.hypot(mesh.vertices_m[:, 0], mesh.vertices_m[:, 1]).max())
        return (Chart(2.0 * np.pi * radius_m, high_m - low_m, closed=True),)

    def places(self, mesh: Mesh, surfels: Surfels) -> Places:
        """Return where points of a mesh lie."""
        low_m, high_m = self._heights_m(mesh)
        x, y, z = surfels.points_m.T
        v = (high_m - z) / (high_m - low_m)
        # What is tilted from upright by more than 45° counts as facing up or down.
        covered = (v >= 0.0) & (v <= 1.0) & (np.abs(surfels.normals[:, 2]) <= np.sqrt(0.5))
        return Places(np.where(covered, 0, -1), _turn(x, y), v)


@dataclass(frozen=True)
class Spherical:
    """One image around the middle of the body: columns are meridians, rows circles of latitude."""

    def charts(self, mesh: Mesh) -> tuple[Chart, ...]:
        """Return the charts of a mesh."""
        radius_m = float(np.linalg.norm(mesh.vertices_m - _middle(mesh), axis=1).max())
        return (Chart(2.0 * np.pi * radius_m, np.pi * radius_m, closed=True, polar=True),)

    def places(self, mesh: Mesh, surfels: Surfels) -> Places:
        """Return where points of a mesh lie."""
        x, y, z = (surfels.points_m - _middle(mesh)).T
        return Places(np.zeros(len(x), np.int64), _turn(x, y), np.arctan2(np.hypot(x, y), z) / np.pi)


_RIGHT = np.array([[0, 1, 0], [1, 0, 0], [0, -1, 0], [-1, 0, 0], [1, 0, 0], [1, 0, 0]], np.float64)
_DOWN = np.array([[0, 0, -1]] * 4 + [[0, -1, 0], [0, 1, 0]], np.float64)
_OUT = np.cross(_DOWN, _RIGHT)


@dataclass(frozen=True)
class Faces:
    """An image on each face of the body's bounding box: facing +x, -y, -x, +y and, if wanted, up and down."""

    lids: bool = False
    """Whether surface facing up and down has images too."""

    @property
    def count(self) -> int:
        """Number of charts."""
        return 6 if self.lids else 4

    def charts(self, mesh: Mesh) -> tuple[Chart, ...]:
        """Return the charts of a mesh."""
        size_m = np.ptp(mesh.vertices_m, axis=0)
        sides = zip(np.abs(_RIGHT) @ size_m, np.abs(_DOWN) @ size_m, strict=True)
        return tuple(Chart(float(width_m), float(height_m)) for width_m, height_m in sides)[: self.count]

    def places(self, mesh: Mesh, surfels: Surfels) -> Places:
        """Return where points of a mesh lie."""
        face = np.argmax(surfels.normals @ _OUT.T, axis=1)
        from_middle = (surfels.points_m - _middle(mesh)) / np.ptp(mesh.vertices_m, axis=0)
        u, v = (0.5 + np.sum(from_middle * along[face], axis=1) for along in (_RIGHT, _DOWN))
        return Places(np.where(face < self.count, face, -1), u, v)


@dataclass(frozen=True)
class Unwrapped:
    """One image mapped by the texture coordinates of the mesh file."""

    def charts(self, mesh: Mesh) -> tuple[Chart, ...]:
        """Return the charts of a mesh."""
        if mesh.uv is None:
            raise InputError("the object has no texture coordinates; give a mesh file that has, or another wrap.")
        there = np.isfinite(mesh.uv).all(axis=(1, 2))
        in_image = _doubled_areas(np.pad(mesh.uv[there], ((0, 0), (0, 0), (0, 1)))).sum()
        on_body_m2 = _doubled_areas(mesh.corners()[there]).sum()
        side_m = float(np.sqrt(on_body_m2 / max(in_image, 1e-12)))
        return (Chart(side_m, side_m),)

    def places(self, mesh: Mesh, surfels: Surfels) -> Places:
        """Return where points of a mesh lie."""
        assert mesh.uv is not None
        u, up = np.einsum("nc,nck->kn", surfels.weights, mesh.uv[surfels.triangle])
        found = np.isfinite(u)
        inside = [np.where(found, value, 0.0) % 1.0 for value in (u, 1.0 - up)]
        return Places(np.where(found, 0, -1), *inside)


AnyWrap = Cylindrical | Spherical | Faces | Unwrapped


def _doubled_areas(corners: Array) -> Array:
    """Return twice the areas (t,) of triangles (t, 3, 3)."""
    return np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)


def _turn(x: Array, y: Array) -> Array:
    """Return azimuths as a share of a full turn, 0 to 1."""
    return np.arctan2(y, x) / (2.0 * np.pi) % 1.0


def _middle(mesh: Mesh) -> Array:
    """Return the middle (3,) of the bounding box."""
    return 0.5 * (mesh.vertices_m.min(axis=0) + mesh.vertices_m.max(axis=0))


Rgb = npt.NDArray[np.uint8]

_FINE = 2  # number of pixels per texel along each side when prints are drawn


def gamma_coded(light: Array) -> Array:
    """Return light, 0 to 1, as sRGB values."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0.0) ** (1.0 / 2.4) - 0.055)


@dataclass(frozen=True)
class Print:
    """A made-up label: patches, bands, bar codes and lines of letter-like blocks, from the large to the small."""

    seed: int = 0
    """Seed of the print; faces of one body differ."""
    contrast: float = 1.0
    """Contrast of colours to the paper: 1 strong, 0.1 faint, 0 plain."""
    rgb: tuple[int, int, int] = (206, 200, 186)
    """Colour of the paper."""
    items: int = 60
    """How many things are printed on a chart."""

    def __post_init__(self) -> None:
        if self.seed < 0 or not 0.0 <= self.contrast <= 1.0 or not 0 <= self.items <= 1000:
            raise ValueError("seed must not be negative, contrast from 0 to 1, items from 0 to 1000")
        if not all(0 <= value <= 255 for value in self.rgb):
            raise ValueError("rgb must hold numbers from 0 to 255")

    def image(self, mesh: Mesh, chart: Chart, number: int, texel_m: float) -> Float32Array:
        """Return the print of a chart (h, w, 3), in sRGB, 0 to 1."""
        rng = np.random.default_rng((self.seed, number))
        paper = np.array(self.rgb) / 255.0
        inks = rng.uniform(0.0, 1.0, (5, 3)) * np.linspace(0.15, 1.0, 5)[:, None]
        height, width = (_FINE * px for px in _size_px(chart, texel_m))
        canvas = _Canvas(chart, np.broadcast_to(paper, (height, width, 3)).astype(np.float32))
        smallest_m, largest_m = 0.002, 0.5 * min(chart.width_m, chart.height_m)
        sizes_m = np.sort(np.exp(rng.uniform(np.log(smallest_m), np.log(max(largest_m, smallest_m)), self.items)))
        for size_m in sizes_m[::-1]:
            canvas.draw(_ITEMS[rng.integers(len(_ITEMS))], size_m, inks[rng.integers(len(inks))], rng)
        inked = paper + self.contrast * (canvas.pixels - paper)
        return inked.reshape(height // _FINE, _FINE, width // _FINE, _FINE, 3).mean(axis=(1, 3)).astype(np.float32)


@dataclass(eq=False)
class _Canvas:
    """A chart that things are drawn on."""

    chart: Chart
    pixels: Float32Array
    """(h, w, 3)."""

    def draw(self, item: _Item, size_m: float, ink: Array, rng: np.random.Generator) -> None:
        """Draw an item of a size somewhere, upright or turned."""
        height, width = self.pixels.shape[:2]
        # On a sphere the sine spreads places evenly over the surface.
        v0 = np.arccos(rng.uniform(-1.0, 1.0)) / np.pi if self.chart.polar else rng.uniform(0.0, 1.0)
        u0, turn_rad = rng.uniform(0.0, 1.0), rng.choice([0.0, rng.uniform(-np.pi / 2.0, np.pi / 2.0)], p=[0.7, 0.3])
        v = (np.arange(height) + 0.5) / height
        rows = np.flatnonzero(np.abs(v - v0) * self.chart.height_m <= 2.2 * size_m)
        if len(rows) == 0:
            return
        u = (np.arange(width) + 0.5) / width - u0
        u = (u + 0.5) % 1.0 - 0.5 if self.chart.closed else u
        x_m = u * self.chart.row_lengths_m(v[rows])[:, None]
        y_m = np.broadcast_to(((v[rows] - v0) * self.chart.height_m)[:, None], x_m.shape)
        sin, cos = np.sin(turn_rad), np.cos(turn_rad)
        inked = item((cos * x_m + sin * y_m) / size_m, (cos * y_m - sin * x_m) / size_m, rng)
        self.pixels[rows[0] : rows[0] + len(rows)][inked] = ink


def _patch(x: Array, y: Array, rng: np.random.Generator) -> BoolArray:
    """An ellipse with a wavy border."""
    along, across, lobes = rng.uniform(0.4, 1.0), rng.uniform(0.3, 1.0), rng.integers(2, 7)
    border = 1.0 + 0.25 * np.sin(lobes * np.arctan2(y, x) + rng.uniform(0.0, 2.0 * np.pi))
    return (x / along) ** 2 + (y / across) ** 2 <= border**2


def _band(x: Array, y: Array, rng: np.random.Generator) -> BoolArray:
    """A bar of limited length."""
    return (np.abs(x) <= 1.4) & (np.abs(y) <= rng.uniform(0.08, 0.3))


def _bar_code(x: Array, y: Array, rng: np.random.Generator) -> BoolArray:
    """Parallel bars of different widths."""
    bars = rng.random(24) < 0.5
    inside = (np.abs(x) < 1.0) & (np.abs(y) < rng.uniform(0.3, 0.8))
    return inside & bars[np.clip(((x + 1.0) * 12.0).astype(np.int64), 0, 23)]


def _letters(x: Array, y: Array, rng: np.random.Generator) -> BoolArray:
    """Lines of letter-like blocks: cells of 4 by 6, with a free column and a free row."""
    lines, columns = rng.integers(1, 5), rng.integers(3, 9)
    cells = rng.random((lines, 7, columns, 5)) < 0.6
    cells[:, -1], cells[..., -1] = False, False
    cells = cells.reshape(7 * lines, 5 * columns)
    side = 2.0 / cells.shape[1]
    column = np.floor((x + 1.0) / side).astype(np.int64)
    row = np.floor(y / side + 0.5 * len(cells)).astype(np.int64)
    inside = (column >= 0) & (column < cells.shape[1]) & (row >= 0) & (row < len(cells))
    return inside & cells[np.where(inside, row, 0), np.where(inside, column, 0)]


_Item = Callable[[Array, Array, np.random.Generator], BoolArray]
_ITEMS: tuple[_Item, ...] = (_patch, _band, _bar_code, _letters, _letters)


@dataclass(frozen=True)
class Picture:
    """Image files."""

    paths: tuple[Path, ...]
    """PNG, JPEG or TIFF, relative to the recipe: one for every face, or one for all."""

    def image(self, mesh: Mesh, chart: Chart, number: int, texel_m: float) -> Float32Array:
        """Return the print of a chart (h, w, 3), in sRGB, 0 to 1."""
        return _fitted(read_colour(self.paths[number % len(self.paths)]), chart, texel_m)


@dataclass(frozen=True)
class Embedded:
    """The image in the object's own mesh file."""

    def image(self, mesh: Mesh, chart: Chart, number: int, texel_m: float) -> Float32Array:
        """Return the print of a chart (h, w, 3), in sRGB, 0 to 1."""
        if mesh.picture is None:
            raise InputError("the object's file holds no image; give a GLB file with one, or a picture.")
        return _fitted(mesh.picture, chart, texel_m)


@dataclass(frozen=True)
class Label:
    """An image, or one for every face, wrapped around the object; it replaces the shape's colour there."""

    image: Print | Picture | Embedded = Print()
    wrap: AnyWrap = field(default_factory=Cylindrical)
    """How it is laid around the object."""

    def __post_init__(self) -> None:
        charts = self.wrap.count if isinstance(self.wrap, Faces) else 1
        if isinstance(self.image, Picture) and len(self.image.paths) not in (1, charts):
            raise ValueError(f"paths must hold one image or {charts}")


@dataclass(frozen=True, eq=False)
class LabelledMesh:
    """A mesh and its label, made ready for looking colours up."""

    label: Label
    mesh: Mesh
    texel_m: float
    """Side of an image's pixel on the body: the footprint of a camera sample, to avoid aliasing."""

    @cached_property
    def _textures(self) -> tuple[Texture, ...]:
        charts = self.label.wrap.charts(self.mesh)
        return tuple(
            Texture(linear_light(self.label.image.image(self.mesh, chart, number, self.texel_m)), chart.closed)
            for number, chart in enumerate(charts)
        )

    def albedo(self, surfels: Surfels) -> Array:
        """Return the linear RGB (n, 3), 0 to 1, of points of the mesh; NaN where there is no label."""
        textures, places = self._textures, self.label.wrap.places(self.mesh, surfels)
        found = np.full((len(places.chart), 3), np.nan)
        for number, texture in enumerate(textures):
            here = places.chart == number
            found[here] = texture.at(places.u[here], places.v[here])
        return found


@dataclass(frozen=True, eq=False)
class Texture:
    """An image that is looked up between its pixels."""

    linear: Array
    """(h, w, 3) linear RGB, 0 to 1."""
    closed: bool
    """Whether rows meet their own beginning."""

    def at(self, u: Array, v: Array) -> Array:
        """Return colours (n, 3) at places, 0 to 1, bilinearly."""
        height, width = self.linear.shape[:2]
        column, row = u * width - 0.5, np.clip(v * height - 0.5, 0.0, height - 1.0)
        column = column if self.closed else np.clip(column, 0.0, width - 1.0)
        left, up = np.floor(column).astype(np.int64), np.floor(row).astype(np.int64)
        right, down = (
            (left + 1) % width if self.closed else np.minimum(left + 1, width - 1),
            np.minimum(up + 1, height - 1),
        )
        s, t = (column - left)[:, None], (row - up)[:, None]
        upper = (1.0 - s) * self.linear[up, left % width] + s * self.linear[up, right]
        lower = (1.0 - s) * self.linear[down, left % width] + s * self.linear[down, right]
        return (1.0 - t) * upper + t * lower


def _size_px(chart: Chart, texel_m: float) -> tuple[int, int]:
    """Return height and width of a chart's image."""
    height, width = (int(np.clip(np.ceil(m / texel_m), 1, 4096)) for m in (chart.height_m, chart.width_m))
    return height, width


def _fitted(pixels: Rgb, chart: Chart, texel_m: float) -> Float32Array:
    """Return an image (h, w, 3), 0 to 1, no finer than texels, which would alias."""
    height, width = (min(have, want) for have, want in zip(pixels.shape, _size_px(chart, texel_m), strict=False))
    shrunk = Image.fromarray(np.ascontiguousarray(pixels)).resize((width, height), Image.Resampling.BOX)
    return np.asarray(shrunk, np.float32) / np.float32(255.0)
