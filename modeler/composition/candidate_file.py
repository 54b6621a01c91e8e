"""Candidate actions from a file: turns, pokes and poses with their costs."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.priors import HeldPrior
from modeler.priors import Poke as Push
from modeler.sequences.input_files import Node, build, read_text, read_tree
from modeler.suggestion import Candidate
from modeler.types import Array, InputError

_COLUMNS = ("name", "cost", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
_MOST = 1000  # 25 s; a robot's list is shorter


@dataclass(frozen=True)
class Turn:
    """A turn about the table's normal."""

    turn_deg: float
    """Right-handed about up: counter-clockwise from above."""
    name: str = ""
    cost: float = Candidate.cost


@dataclass(frozen=True)
class Poke:
    """A push along the table, as `sequence.json` has them, in the coordinates of the last camera."""

    point_m: tuple[float, float, float]
    direction: tuple[float, float, float]
    length_m: float
    name: str = ""
    cost: float = Candidate.cost


@dataclass(frozen=True)
class Lay:
    """Laying the object on its side."""

    name: str = ""
    cost: float = Candidate.cost


@dataclass(frozen=True)
class Pose:
    """A pose that a robot can bring the object, or the camera, to."""

    new_from_last: tuple[float, ...]
    """(16,) row by row: from the object's camera coordinates in the last frame to those after the action, in m."""
    name: str = ""
    cost: float = Candidate.cost
    sigma_deg: float = HeldPrior.held_sigma_deg
    """Standard deviation of its rotation, that of a hand that holds the object (`held_sigma_deg`)."""
    sigma_m: float = HeldPrior.held_sigma_m
    """Standard deviation of its place."""

    def __post_init__(self) -> None:
        if len(self.new_from_last) != 16:
            raise ValueError("new_from_last must have 16 numbers")
        if not se3.is_rigid(np.reshape(self.new_from_last, (4, 4)), tolerance=1e-3, farthest_m=1e3):
            raise ValueError("new_from_last must be a rigid motion (4 x 4, row by row)")
        if not (0.0 < self.sigma_deg <= 180.0 and 0.0 < self.sigma_m <= 10.0):
            raise ValueError("sigma_deg must be above 0 and up to 180, sigma_m above 0 and up to 10")


def read_candidates(path: Path) -> list[Candidate]:
    """Return the actions in a file.

    Raises:
        InputError: if it cannot be read or holds none.
    """
    if path.suffix.lower() == ".csv":
        found = _poses(path)
    else:
        tree = read_tree(path)
        if isinstance(tree.value, dict):  # TOML has no list at its top
            tree = tree.need("candidates")
        nodes = tree.elements()
        found = [_priced(_candidate(build(Turn | Poke | Lay | Pose, node)), node) for node in nodes]
    if not found:
        raise InputError(f"{path}: holds no candidates; give at least one")
    if len(found) > _MOST:
        raise InputError(f"{path}: holds {len(found)} candidates; give at most {_MOST}")
    return found


def _candidate(asked: Turn | Poke | Lay | Pose) -> Candidate:
    match asked:
        case Turn(turn_deg, name, cost):
            return Candidate("turn", turn_deg=turn_deg, name=name, cost=cost)
        case Poke(point_m, direction, length_m, name, cost):
            return Candidate("poke", poke=Push(point_m, direction, length_m), name=name, cost=cost)
        case Lay(name, cost):
            return Candidate("lay", name=name, cost=cost)
        case Pose(motion, name, cost, sigma_deg, sigma_m):
            return _reached(np.reshape(motion, (4, 4)), name, cost, (sigma_deg, sigma_m))


def _priced(candidate: Candidate, node: Node) -> Candidate:
    if not (candidate.cost > 0.0 and math.isfinite(candidate.cost)):
        raise InputError(f"{node.path}: {node.where}: cost must be positive")
    return candidate


def _poses(path: Path) -> list[Candidate]:
    """Return the poses in a table: name, cost, and the motion as TUM files have poses."""
    rows = csv.DictReader(io.StringIO(read_text(path, "table")))
    missing = [name for name in _COLUMNS if name not in (rows.fieldnames or ())]
    if missing:
        raise InputError(f"{path}: has no column {missing[0]!r}; its first line must name {', '.join(_COLUMNS)}")
    found = []
    for number, row in enumerate(rows, 2):
        try:
            cost, *numbers = (float(row[name]) for name in _COLUMNS[1:])
        except (TypeError, ValueError):
            raise InputError(f"{path}: line {number}: cost and pose must be numbers") from None
        length = math.hypot(*numbers[3:])
        if not all(map(math.isfinite, (cost, *numbers))) or cost <= 0.0 or abs(length - 1.0) > 1e-2:
            raise InputError(f"{path}: line {number}: cost must be positive, and qx to qw a unit quaternion")
        motion = se3.rigid(Rotation.from_quat(numbers[3:]).as_matrix(), np.array(numbers[:3]))
        found.append(_reached(motion, row["name"] or f"line {number}", cost, (Pose.sigma_deg, Pose.sigma_m)))
    return found


def _reached(motion: Array, name: str, cost: float, sigmas: tuple[float, float]) -> Candidate:
    matrix = tuple(tuple(float(value) for value in row) for row in motion)
    exact = math.radians(sigmas[0]), sigmas[1]
    return Candidate("pose", new_from_last=matrix, name=name or "pose", cost=cost, sigmas=exact)
