"""Recipes of synthetic sequences: object, view, motion and camera, read from JSON or TOML."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from modeler import se3
from modeler.sequences.input_files import build, read_tree
from modeler.sequences.rendering.cameras import DepthSensor, Photography
from modeler.sequences.rendering.labels import Label
from modeler.sequences.rendering.shapes import AnyShape, placement
from modeler.types import Array, Camera, InputError


@dataclass(frozen=True)
class Tabletop:
    """The object is pushed over the table by hand: each step turns it by about `step_deg` and shifts it a little."""

    frames: int = 14
    step_deg: float = 25.0
    """Mean turn about the vertical from frame to frame."""
    step_sigma_deg: float = 3.0
    """Standard deviation of the turn."""
    shift_m: float = 0.03
    """Mean shift from frame to frame in m; single shifts are half to one and a half of it."""
    reach_m: float = 0.05
    """The object stays within this distance of the middle of the table."""
    start_deg: float = 0.0
    """Turn of the first frame."""
    wobble_deg: float = 0.0
    """Standard deviation of the tilt about each horizontal direction in one motion from frame to frame."""
    wobble_m: float = 0.0
    """Standard deviation of the lift in one motion from frame to frame in m."""

    def __post_init__(self) -> None:
        _checked(self.frames, self.step_sigma_deg, self.shift_m, self.wobble_deg, self.wobble_m)
        if self.shift_m > self.reach_m:
            raise ValueError("reach_m must be at least shift_m")

    def table_from_object(self, centre_m: Array, rng: np.random.Generator) -> Array:
        """Draw the poses (frames, 4, 4)."""
        turn_deg, place_m = self.start_deg, np.zeros(2)
        poses = [placement((0.0, 0.0, 0.0), (0.0, 0.0, turn_deg))]
        while len(poses) < self.frames:
            turn_deg += rng.normal(self.step_deg, self.step_sigma_deg)
            place_m = self._next_place(place_m, rng)
            poses.append(placement((place_m[0], place_m[1], 0.0), (0.0, 0.0, turn_deg)))
        return _wobbling(np.array(poses), self.wobble_deg, self.wobble_m, rng)

    def _next_place(self, place_m: Array, rng: np.random.Generator) -> Array:
        while True:  # from within reach at least a third of the directions stay within reach, so this soon ends
            angle, length_m = rng.uniform(0.0, 2.0 * np.pi), self.shift_m * rng.uniform(0.5, 1.5)
            there_m = place_m + length_m * np.array([np.cos(angle), np.sin(angle)])
            if np.hypot(*there_m) <= self.reach_m:
                return there_m

    def motion(self) -> Mapping[str, Any]:
        """Return its entry in `sequence.json`."""
        return {"kind": "table", "step_deg": self.step_deg, "sigma_deg": self.step_sigma_deg, "shift_m": self.shift_m}


@dataclass(frozen=True)
class Turntable:
    """The object turns about a fixed vertical axis."""

    frames: int = 15
    step_deg: float = 24.0
    """Nominal turn from frame to frame."""
    step_sigma_deg: float = 0.5
    """Standard deviation of the turn."""
    offset_m: tuple[float, float] = (0.02, 0.01)
    """Where the object stands on the disc at the start, from its axis, in m."""
    wobble_deg: float = 0.0
    """Standard deviation of the tilt about each horizontal direction in one motion from frame to frame."""
    wobble_m: float = 0.0
    """Standard deviation of the lift in one motion from frame to frame in m."""

    def __post_init__(self) -> None:
        _checked(self.frames, self.step_sigma_deg, self.wobble_deg, self.wobble_m)

    def table_from_object(self, centre_m: Array, rng: np.random.Generator) -> Array:
        """Draw the poses (frames, 4, 4)."""
        steps_deg = rng.normal(self.step_deg, self.step_sigma_deg, self.frames - 1)
        on_disc = se3.translation(np.array([*self.offset_m, 0.0]))
        turns_deg = np.concatenate([[0.0], np.cumsum(steps_deg)])
        poses = np.array([placement((0.0, 0.0, 0.0), (0.0, 0.0, turn_deg)) @ on_disc for turn_deg in turns_deg])
        return _wobbling(poses, self.wobble_deg, self.wobble_m, rng)

    def motion(self) -> Mapping[str, Any]:
        """Return its entry in `sequence.json`."""
        return {"kind": "turntable", "step_deg": self.step_deg, "sigma_deg": self.step_sigma_deg}


@dataclass(frozen=True)
class RobotReadings:
    """Errors of a robot's readings of where the hand is that holds the object."""

    sigma_deg: float = 1.0
    """Standard deviation of a pose's rotation about each axis."""
    sigma_m: float = 0.003
    """Standard deviation of a pose's translation along each axis in m."""

    def __post_init__(self) -> None:
        _checked(1, self.sigma_deg, self.sigma_m)

    def camera_from_hand(self, camera_from_model: Array, rng: np.random.Generator) -> Array:
        """Draw poses (n, 4, 4) of a hand that holds the object still at its model frame."""
        sigma = np.repeat([np.radians(self.sigma_deg), self.sigma_m], 3)
        return camera_from_model @ se3.exp(rng.normal(size=(len(camera_from_model), 6)) * sigma)


@dataclass(frozen=True)
class Hand:
    """The object is turned freely in the air, about an axis that wanders."""

    frames: int = 20
    step_deg: float = 18.0
    """Mean turn from frame to frame."""
    step_sigma_deg: float = 3.0
    """Standard deviation of the turn."""
    shift_m: float = 0.015
    """Standard deviation of the shift along each axis, about the middle, in m."""
    wander: float = 0.4
    """How much the axis turns from step to step: 0 keeps it, 1 and more forget it quickly."""
    height_m: float = 0.1
    """Height of the object's centre above the table's plane in m."""
    robot: RobotReadings | None = None
    """The robot that holds the object and writes `robot.txt`; null for a person."""

    def __post_init__(self) -> None:
        _checked(self.frames, self.step_sigma_deg, self.shift_m, self.wander)

    def table_from_object(self, centre_m: Array, rng: np.random.Generator) -> Array:
        """Draw the poses (frames, 4, 4)."""
        middle = se3.translation(np.array([0.0, 0.0, self.height_m]))
        about_centre = se3.translation(-centre_m)
        axis, turn = rng.normal(size=3), np.eye(4)
        poses = [middle @ about_centre]
        while len(poses) < self.frames:
            axis = axis / np.linalg.norm(axis) + self.wander * rng.normal(size=3)
            angle_rad = np.radians(rng.normal(self.step_deg, self.step_sigma_deg))
            turn = se3.exp(np.concatenate([angle_rad * axis / np.linalg.norm(axis), np.zeros(3)])) @ turn
            poses.append(middle @ se3.translation(rng.normal(0.0, self.shift_m, 3)) @ turn @ about_centre)
        return np.array(poses)

    def motion(self) -> Mapping[str, Any]:
        """Return its entry in `sequence.json`."""
        kind = "general" if self.robot is None else "held"
        return {"kind": kind, "step_deg": self.step_deg, "sigma_deg": self.step_sigma_deg, "shift_m": self.shift_m}


@dataclass(frozen=True)
class Place:
    """One pose of the resting object on, or above, the table."""

    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Shift in m."""
    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Turns about the fixed x, y and z axes, in this order."""


@dataclass(frozen=True)
class Places:
    """Poses that are given one by one."""

    poses: tuple[Place, ...]
    """The pose of every frame."""

    def __post_init__(self) -> None:
        _checked(len(self.poses))

    def table_from_object(self, centre_m: Array, rng: np.random.Generator) -> Array:
        """Return the poses (frames, 4, 4)."""
        return np.array([placement(pose.offset_m, pose.rotation_deg) for pose in self.poses])

    def motion(self) -> Mapping[str, Any] | None:
        """Return its entry in `sequence.json`: none."""
        return None


AnyTrajectory = Tabletop | Turntable | Hand | Places


def _wobbling(table_from_object: Array, wobble_deg: float, wobble_m: float, rng: np.random.Generator) -> Array:
    """Return upright poses (n, 4, 4), each tilted about where the object stands and lifted at random.

    A motion takes the wobble of two frames, hence the root of two. It has its own random streams: turns and
    shifts are those on an exact table, and a sequence begins like a shorter one.
    """
    count = len(table_from_object)
    tilt_rng, lift_rng = rng.spawn(2)
    if wobble_deg > 0.0:
        tilt = np.zeros((count, 6))
        tilt[:, :2] = tilt_rng.normal(0.0, np.radians(wobble_deg) / np.sqrt(2.0), (count, 2))
        table_from_object = table_from_object @ se3.exp(tilt)
    if wobble_m > 0.0:
        lift = np.tile(np.eye(4), (count, 1, 1))
        lift[:, 2, 3] = lift_rng.normal(0.0, wobble_m / np.sqrt(2.0), count)
        table_from_object = lift @ table_from_object
    return table_from_object


def _checked(frames: int, *spreads: float) -> None:
    if not 1 <= frames <= 10_000:
        raise ValueError("the number of frames must be from 1 to 10000")
    if min(spreads, default=0.0) < 0.0:
        raise ValueError("standard deviations and shifts must not be negative")


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
        rotation = np.array([[1.0, 0.0, 0.0], [0.0, -sin, -cos], [0.0, cos, -sin]])
        return se3.rigid(rotation, np.array([0.0, 0.0, self.distance_m]) - rotation @ [0.0, 0.0, self.look_height_m])


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
    """Return a recipe from a JSON or TOML file, or a built-in one by its name.

    Raises:
        InputError: if there is no such recipe or it is not understood.
    """
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
