"""Recipes of synthetic sequences: object, view, motion and camera, read from JSON or TOML."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, final

import numpy as np

from modeler.sequences.input_files import build, read_tree
from modeler.sequences.rendering.depth_sensor import DepthSensor
from modeler.sequences.rendering.labels import Label
from modeler.sequences.rendering.photography import Photography
from modeler.sequences.rendering.shapes import AnyShape
from modeler.sequences.rendering.trajectory import AnyTrajectory, Tabletop
from modeler.types import Array, Camera, InputError


@final
@dataclass(frozen=True)
class Viewpoint:
    """The camera, and its position relative to the middle of the table."""

    width: int = 640
    height: int = 480
    focal_px: float = 575.0
    """Focal length in px; the principal point is the middle of the image."""
    distance_m: float = 0.8
    """Distance from the point looked at."""
    elevation_deg: float = 35.0
    """Angle of the line of sight with the table."""
    look_height_m: float = 0.03
    """Height above the table of the point looked at."""

    def __post_init__(self) -> None:
        if not (2 <= self.width <= 8192 and 2 <= self.height <= 8192):
            raise ValueError("width and height must be from 2 to 8192 px")
        if self.focal_px < 1.0 or self.distance_m <= 0.0 or not -90.0 <= self.elevation_deg <= 90.0:
            raise ValueError("focal_px must be at least 1, distance_m positive, elevation_deg from -90 to 90")

    def camera(self) -> Camera:
        """Return the intrinsics."""
        focal_px = self.focal_px
        return Camera(self.width, self.height, focal_px, focal_px, (self.width - 1) / 2.0, (self.height - 1) / 2.0)

    def camera_from_table(self) -> Array:
        """Return the pose (4, 4) of the table in camera coordinates."""
        sin, cos = np.sin(np.radians(self.elevation_deg)), np.cos(np.radians(self.elevation_deg))
        pose = np.eye(4)
        pose[:3, :3] = [[1.0, 0.0, 0.0], [0.0, -sin, -cos], [0.0, cos, -sin]]
        pose[:3, 3] = np.array([0.0, 0.0, self.distance_m]) - pose[:3, :3] @ [0.0, 0.0, self.look_height_m]
        return pose


@final
@dataclass(frozen=True)
class Table:
    """A slab whose surface is the plane z = 0."""

    size_m: tuple[float, float] = (0.5, 0.4)
    """Width and depth in m."""
    thickness_m: float = 0.02
    rgb: tuple[int, int, int] = (150, 140, 125)

    def __post_init__(self) -> None:
        if min(*self.size_m, self.thickness_m) <= 0.0:
            raise ValueError("size_m and thickness_m must be positive")


@final
@dataclass(frozen=True)
class Wall:
    """An upright wall behind the table."""

    distance_m: float = 0.6
    """Distance from the middle of the table in m."""
    size_m: tuple[float, float] = (4.0, 3.0)
    """Width and height in m, centred at the height of the table."""
    rgb: tuple[int, int, int] = (205, 205, 200)

    def __post_init__(self) -> None:
        if min(self.size_m) <= 0.0:
            raise ValueError("size_m must be positive")


@final
@dataclass(frozen=True)
class Mosaic:
    """The object's colour varies from cell to cell of a grid in space."""

    cell_m: float = 0.02
    """Edge length of a cell in m."""
    contrast: float = 0.6
    """How much darker the darkest cells are, 0 to 1."""

    def __post_init__(self) -> None:
        if self.cell_m <= 0.0 or not 0.0 <= self.contrast <= 1.0:
            raise ValueError("cell_m must be positive and contrast from 0 to 1")


@final
@dataclass(frozen=True)
class TurnedOver:
    """The object is laid down differently within the sequence."""

    at: int
    """Number of the first frame in that pose."""
    rest_rotation_deg: tuple[float, float, float]
    """Its resting pose from then on: turns about the fixed x, y and z axes, before it is set on the table."""

    def __post_init__(self) -> None:
        if self.at < 1:
            raise ValueError("at must be at least 1, for frame 0 shows the object as rest_rotation_deg says")


@final
@dataclass(frozen=True)
class Recipe:
    """Everything a synthetic sequence depends on."""

    object: AnyShape
    """Shape of the object in its model frame, z up."""
    name: str = "rendered"
    seed: int = 0
    """Seed of motion and noise."""
    rest_rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Resting pose of the object: turns about the fixed x, y and z axes, before it is set on the table."""
    turned_over: TurnedOver | None = None
    """Whether it is laid down differently on the way; the trajectory continues unchanged."""
    view: Viewpoint = Viewpoint()
    """The camera and its place."""
    table: Table | None = Table()
    """Support of the object; null for none."""
    wall: Wall | None = None
    """Background; null for none."""
    trajectory: AnyTrajectory = field(default_factory=Tabletop)
    """How the object moves."""
    sensor: DepthSensor | None = field(default_factory=DepthSensor)
    """Errors of the depth camera; null for exact depth."""
    colour: Literal["none", "png", "jpg"] = "none"
    """Whether and how colour images are written."""
    pattern: Mosaic | None = None
    """Pattern on the object."""
    label: Label | None = None
    """Label around the object; needs photography."""
    photography: Photography | None = None
    """Lamps and the colour camera; null for light from the camera itself, without noise."""
    masks: bool = True
    """Whether the object's masks are written."""
    period_s: float = 0.5
    """Time from frame to frame."""
    depth_unit_mm: float = 0.1
    """Unit of the depth images."""

    def __post_init__(self) -> None:
        if self.seed < 0 or self.period_s <= 0.0 or not 1e-3 <= self.depth_unit_mm <= 10.0:
            raise ValueError("seed must not be negative, period_s positive, depth_unit_mm from 0.001 to 10")
        if self.label is not None and self.photography is None:
            raise ValueError('label needs photography; write "photography": {} for its defaults')


def load_recipe(recipe: str | Path) -> Recipe:
    """Return a recipe from a JSON or TOML file, or a built-in one by its name."""
    path = Path(recipe)
    if not path.is_file() and path.name == str(recipe) and not path.suffix:
        if path.name not in builtin_recipes():
            raise InputError(
                f"{recipe}: no such file and no built-in recipe; those are {', '.join(builtin_recipes())}."
            )
        path = _FOLDER / f"{path.name}.json"
    try:
        return build(Recipe, read_tree(path))
    except RecursionError:
        raise InputError(f"{path}: is nested too deeply; describe the shape with fewer compounds.") from None


def builtin_recipes() -> tuple[str, ...]:
    """Return the names of the built-in recipes."""
    return tuple(sorted(path.stem for path in _FOLDER.glob("*.json")))


_FOLDER = Path(__file__).parents[1] / "recipes"
