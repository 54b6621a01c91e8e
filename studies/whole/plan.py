"""What is drawn of a capture: every factor at random, from half and number alone."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal, final

import numpy as np
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.types import Array
from studies.whole.things import Thing

Half = Literal["tuning", "held-out"]
HALVES: Final[tuple[Half, ...]] = ("tuning", "held-out")
NEAREST_M: Final = 0.15
"""Distance within which no depth camera measures: nearer objects are seen with a longer lens."""
FARTHEST_M: Final = 4.0
"""Distance beyond which few do: farther objects are seen with a wider lens."""


@final
@dataclass(frozen=True)
class Factors:
    """A capture, but for the draws of its noise."""

    thing: str
    """Name of the mesh."""
    stretch: tuple[float, float, float]
    """Of the mesh along its axes, before it is scaled to its size."""
    size_m: float
    """Largest extent of the object."""
    distance_m: float
    """Of its middle from the camera."""
    focal_px: float
    """True focal length."""
    width_px: int
    """Of the images; three quarters of it are their height."""
    elevation_deg: float
    """From which the camera looks down."""
    roll_deg: float
    """Of the camera."""
    cut: float
    """Share of the object's size that is beyond an edge of the image; 0: all of it is inside."""
    cut_below: bool
    """Whether that edge is the lower one; else the left one."""
    camera: str
    """Kind."""
    noise: float
    """Standard deviation of depth on the object, facing the camera, as a share of the distance."""
    bias: float
    """Standard deviation of the smooth error of depth, in standard deviations of the noise."""
    unit_m: float
    """Of the stored depth."""
    support: str
    """What holds the object."""
    wall: float
    """Distance of a wall behind the object in sizes; 0: there is none."""
    steps: str
    """How steps follow each other."""
    step_deg: float
    """Mean turn from frame to frame."""
    frames: int
    """Number."""
    order: str
    """In which the frames are shown."""
    masks: str
    """How good they are, or that there are none."""
    colour: str
    """Of the object, or that there is none."""
    pictures: tuple[int, int, int]
    """Numbers of the photographs on the object, on what is below it and on what is behind it."""
    told: bool
    """Whether the motion is given."""
    intrinsics: str
    """Where they come from."""
    focal_error: float
    """Logarithm of the given focal length over the true one."""
    kind_told: bool
    """Whether the camera's kind is known, as formats of devices say it and folders may."""
    led_round: bool = False
    """Whether the camera is led round the object, which lies still among other things."""

    @property
    def share(self) -> float:
        """Return the object's size in the image as a share of the image's height."""
        return self.size_m * self.focal_px / (self.distance_m * 0.75 * self.width_px)


def led_round(factors: Factors) -> Factors:
    """Return the factors with a camera that somebody leads round the object on a table, and no masks."""
    return replace(
        factors,
        led_round=True,
        support="table",
        wall=0.0,
        cut=0.0,
        elevation_deg=max(factors.elevation_deg, 20.0),  # else things before it hide the object
        steps="even",
        step_deg=5.0 + 0.2 * factors.step_deg,
        frames=12,
        order="as turned",
        masks="none",
        told=False,
    )


@final
@dataclass(frozen=True)
class Plan:
    """One capture."""

    half: Half
    """Whether anything may be mended by it."""
    number: int
    """Within its half."""

    @property
    def seed(self) -> int:
        """Of noise and registration."""
        return int(np.random.SeedSequence([HALVES.index(self.half), self.number, 58]).generate_state(1)[0])

    def factors(self, things: Sequence[Thing], pictures: int) -> Factors:
        """Draw the capture.

        Args:
            things: all meshes by name; every other one belongs to this half.
            pictures: number of photographs; likewise.
        """
        rng = np.random.default_rng([HALVES.index(self.half), self.number])
        own = HALVES.index(self.half)
        thing = things[own :: len(HALVES)][int(rng.integers(len(things[own :: len(HALVES)])))]
        support = str(rng.choice(("table", "turntable", "hand", "nothing"), p=(0.35, 0.3, 0.15, 0.2)))
        size_m = _between(rng, *((0.05, 0.4) if support == "hand" else (0.02, 2.0)))
        width_px = int(rng.choice((160, 212, 320)))
        share, cut = rng.uniform(0.3, 0.85), 0.0
        if rng.random() < 0.15:
            cut = float(rng.uniform(0.08, 0.3))
        focal_px = 0.5 * width_px / np.tan(np.radians(rng.uniform(45.0, 75.0)) / 2.0)
        distance_m = size_m * focal_px / (share * 0.75 * width_px)
        near_m = float(np.clip(distance_m, NEAREST_M, FARTHEST_M))
        focal_px *= near_m / distance_m
        steps = str(rng.choice(("even", "uneven", "with stops", "back and forth"), p=(0.4, 0.3, 0.15, 0.15)))
        step_deg = _between(rng, 5.0, 45.0 if support == "hand" else 90.0)
        turn = int(np.ceil(360.0 / step_deg)) + 1
        frames = int(np.clip(turn if rng.random() < 0.6 else rng.integers(6, 15), 6, 14))
        intrinsics = str(rng.choice(("exact", "device", "nominal"), p=(0.3, 0.3, 0.4)))
        camera = str(rng.choice(("structured light", "stereo", "time of flight", "laser"), p=(0.3, 0.3, 0.3, 0.1)))
        noise = _between(rng, *((0.0002, 0.0006) if camera == "laser" else (0.0006, 0.004)))
        masks = str(rng.choice(("none", "exact", "thin", "loose"), p=(0.5, 0.3, 0.1, 0.1)))
        photographs = np.arange(own, pictures, len(HALVES))
        chosen = rng.choice(photographs, 3)
        return Factors(
            thing=thing.name,
            stretch=(float(rng.uniform(0.8, 1.25)), float(rng.uniform(0.8, 1.25)), float(rng.uniform(0.8, 1.25))),
            size_m=size_m,
            distance_m=near_m,
            focal_px=float(focal_px),
            width_px=width_px,
            elevation_deg=float(rng.uniform(12.0, 55.0)),
            roll_deg=float(rng.normal(0.0, 3.0)),
            cut=cut,
            cut_below=bool(rng.random() < 0.5),
            camera=camera,
            noise=noise,
            bias=float(rng.uniform(0.0, 1.5 if camera == "time of flight" else 0.6)),
            unit_m=0.0001 if near_m < 0.3 or rng.random() < 0.3 else 0.001,
            support=support,
            wall=float(rng.choice((0.0, rng.uniform(0.05, 0.3), rng.uniform(1.0, 3.0)), p=(0.4, 0.2, 0.4))),
            steps=steps,
            step_deg=step_deg,
            frames=frames,
            order=str(rng.choice(("as turned", "backwards", "halves swapped"), p=(0.6, 0.25, 0.15))),
            masks=masks,
            colour=str(rng.choice(("photograph", "plain", "none"), p=(0.5, 0.2, 0.3))),
            pictures=(int(chosen[0]), int(chosen[1]), int(chosen[2])),
            told=bool(rng.random() < 0.4),
            intrinsics=intrinsics,
            focal_error=float(rng.normal(0.0, {"exact": 0.0, "device": 0.003, "nominal": 0.02}[intrinsics])),
            kind_told=bool(rng.random() < 0.5) or intrinsics == "device",
        )


def motion(factors: Factors, rng: np.random.Generator) -> tuple[Array, Array]:
    """Draw the motion of the object over the support, which is z = 0, in the order in which it is shown.

    Returns:
        Poses support_from_object (frames, 4, 4), and the turns from frame to frame (frames - 1,) in degrees.
    """
    turns_deg = _turns_deg(factors, rng)
    sense = float(rng.choice((-1.0, 1.0)))
    poses = []
    turn, centre_m = Rotation.from_rotvec([0.0, 0.0, rng.uniform(0.0, 2.0 * np.pi)]), np.zeros(3)
    axis = np.array([0.0, 0.0, 1.0])
    off_m = rng.normal(0.0, 0.07 * factors.size_m, 2) if factors.support == "turntable" else np.zeros(2)
    if factors.support == "hand":
        axis = _unit(rng.normal((0.0, 0.0, 1.5), 1.0))
        turn = Rotation.random(rng=rng)
    for turn_deg in (0.0, *turns_deg):
        if turn_deg:
            turn = Rotation.from_rotvec(sense * np.radians(turn_deg) * axis) * turn
            if factors.support == "table":
                centre_m = np.array([*np.clip(centre_m[:2] + _shift_m(factors, rng)[:2], *_reach_m(factors)), 0.0])
            if factors.support == "hand":
                axis = _unit(axis + rng.normal(0.0, 0.25, 3))
                centre_m = np.clip(centre_m + _shift_m(factors, rng), *_reach_m(factors))
        # What stands or hangs is never quite upright: a table that is not plane, a string that swings.
        tilt_deg = rng.normal(0.0, 0.3 if factors.support in ("table", "turntable") else 1.0, 2)
        tilt = Rotation.from_rotvec(np.radians([*tilt_deg, 0.0])) if turn_deg else Rotation.identity()
        pose = np.eye(4)
        pose[:3, :3] = (tilt * turn).as_matrix()
        pose[:3, 3] = centre_m + (turn.apply([*off_m, 0.0]) if factors.support == "turntable" else 0.0)
        poses.append(pose)
    numbers = np.arange(factors.frames)
    order = {
        "as turned": numbers,
        "backwards": numbers[::-1],
        "halves swapped": np.roll(numbers, factors.frames // 2),
    }[factors.order]
    shown = np.array(poses)[order]
    between = [se3.rotation_angle(se3.inverse(a) @ b) for a, b in itertools.pairwise(shown)]
    return shown, np.degrees(between)


def signed_step_deg(factors: Factors, support_from_object: Array) -> float:
    """Return the turn of the first step about the vertical, right-handed."""
    first, second = support_from_object[:2, :3, :3]
    return float(np.degrees(Rotation.from_matrix(second @ first.T).as_rotvec()[2]))


def _turns_deg(factors: Factors, rng: np.random.Generator) -> Array:
    """Draw the turns (frames - 1,) as they were made."""
    count = factors.frames - 1
    turns_deg = np.full(count, factors.step_deg)
    match factors.steps:
        case "uneven":
            turns_deg *= rng.uniform(0.4, 1.6, count)
        case "with stops":
            turns_deg[rng.random(count) < 0.3] = 0.0
        case "back and forth":
            since, until = sorted(rng.choice(count + 1, 2, replace=False))
            turns_deg[since:until] *= -1.0
        case _:
            turns_deg += rng.normal(0.0, 0.3, count)
    return turns_deg


def _shift_m(factors: Factors, rng: np.random.Generator) -> Array:
    return rng.normal(0.0, 0.08 * factors.size_m, 3)


def _reach_m(factors: Factors) -> tuple[float, float]:
    return -0.12 * factors.size_m, 0.12 * factors.size_m


def _unit(vector: Array) -> Array:
    return vector / np.linalg.norm(vector)


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number whose logarithm is spread evenly."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
