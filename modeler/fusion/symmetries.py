"""Rotations that map a model onto itself as far as it was seen: its shape, and its shape with its colours."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from modeler import se3
from modeler.fusion.alignment import Matcher, even_rotations
from modeler.fusion.paint import Paint, SurfacePoints, cielab
from modeler.significance import SIGMAS
from modeler.system.pictures import raycaster, tensor
from modeler.types import Array, BoolArray, ObjectModel, area_vectors_m2

if TYPE_CHECKING:
    import open3d as o3d

ORDERS = (2, 3, 4, 5, 6, 7, 8, 9, 10, 12, 16)
"""Orders n of rotations by 360°/n that are tried about the likely axes; about the others, 2 and 3."""
_MOST = 59  # rotations of a finite group, but for those about one axis (an icosahedron's): more belong to a ball
_LIKELY = 6  # axes of a kind: a cube has six twofold ones
_NEAR = (0.2, 0.3, 0.5, 0.6, 0.7)  # of the points, within three tolerances at each step of ICP: else it is given up
_SMALL_DEG = (5.0, 8.0, 12.0)  # turns that bring up little of what was not seen, and map no n-fold shape onto itself
_PAINTED = 40_000  # points whose colours are looked up: 0.7 % of the diameter apart on a cube, of 1 % that is tolerated
_GENERIC_DEG = 360.0 * (np.arange(1, 13) * 0.61803398875 % 1.0)  # no two of them, nor their differences, make an order


@dataclass(frozen=True, eq=False)
class Axis:
    """A line in the object frame."""

    direction: Array
    """(3,) unit."""
    point_m: Array
    """(3,) a point on it."""

    @property
    def turn(self) -> Array:
        """ξ (6,) of a turn about it by 1 rad, in the object frame."""
        return np.concatenate([self.direction, np.cross(self.point_m, self.direction)])


@dataclass(frozen=True, eq=False)
class Symmetries:
    """What was found."""

    tolerance_m: float
    """Distance within which surface counts as the same."""
    discrete: tuple[Array, ...] = ()
    """(4, 4) rotations of the object frame onto itself, without the identity; those about a continuous axis are left
    out, and of those that differ by a turn about it, one is named."""
    continuous: tuple[Axis, ...] = ()
    """Axes about which any rotation maps the model onto itself; of a ball three, through its centre."""
    seen_in_part: tuple[Axis, ...] = ()
    """Axes about which small turns map the surface onto itself, but larger ones bring up what was not seen: of a can
    that lies, say. No rotation about them is claimed."""
    compared: float = 1.0
    """Share of the seen surface that was compared, in the rotation for which it was least."""
    with_colour: Symmetries | None = None
    """Those under which colours stay as well; None if the model has no colour."""

    @property
    def words(self) -> str:
        """The same in a sentence."""
        part = "; it looks like a body of revolution, but was not seen all around" if self.seen_in_part else ""
        coloured = "" if self.with_colour is None else f"; with colour: {self.with_colour.count_words}"
        return (
            f"symmetries of the shape within {1000.0 * self.tolerance_m:.1f} mm, of the observed part: "
            f"{self.count_words}{part}{coloured}"
        )

    @property
    def count_words(self) -> str:
        """How many there are of each kind, in words."""
        found = ["1 axis of revolution"] if len(self.continuous) == 1 else []
        found += ["all rotations about a centre"] if len(self.continuous) > 1 else []
        found += [f"{len(self.discrete)} discrete rotation{'s' * (len(self.discrete) > 1)}"] if self.discrete else []
        return " and ".join(found) or "none"


@dataclass(frozen=True)
class SymmetryFinder:
    """Register a surface with itself from likely axes, and keep rotations under which next to nothing is elsewhere.

    Axes are the vertical, the principal axes of the surface, directions in which much of it faces and those between
    them, and directions spread evenly. Each is refined by point-to-plane ICP of the surface with itself. A rotation
    is a symmetry where fewer than `elsewhere` of the points end farther than the tolerance from the surface, and fewer
    than `unknown` end where no surface was seen; nothing is said of what was not compared. The tolerance is that of the
    distance between two places of the surface, each of which errs.

    Colour leaves a rotation where fewer than `repainted` of the points end farther than the tolerances of place and
    colour from all points of the surface: BOP counts symmetries that the texture does not resolve (Hodaň et al., BOP
    Challenge 2020), as far as an estimator sees them.
    """

    least_share: float = 0.01
    """Least tolerance, as a share of the diameter: smaller details do not help a pose estimator."""
    elsewhere: float = 0.006
    """Largest share of points farther than the tolerance from the surface, which allows for outliers: twice what 3 sd
    of noise leave."""
    unknown: float = 0.1
    """Largest share of points that end where nothing was seen."""
    repainted: float = 0.05
    """Largest share of points that find no place of like colour within the tolerance."""
    colour_tolerance: float = 10.0
    """Distance of like colours in CIELAB: some four just noticeable differences."""
    points: int = 4000
    """Points that are compared: the standard deviation of a share of 0.006 is then 0.0012."""
    icp_points: int = Matcher.points
    """Points used by ICP."""
    directions: int = 24
    """Directions spread evenly over half a sphere, about 30° apart."""

    def find(
        self,
        vertices_m: Array,
        triangles: npt.NDArray[np.int64],
        *,
        up: Array,
        sigma_m: float,
        colours: npt.NDArray[np.uint8] | None = None,
        closed: bool = False,
    ) -> Symmetries:
        """Return the symmetries of a surface.

        Args:
            vertices_m: (v, 3) of what was seen.
            triangles: (t, 3) vertex numbers, counter-clockwise from outside.
            up: (3,) unit, normal of the support, or whatever axis is likely.
            sigma_m: standard deviation of the surface along its normal.
            colours: (v, 3) sRGB, where they are known.
            closed: whether all of the surface was seen, so that nothing ends where it was not.
        """
        surface = _Surface.of(vertices_m, triangles, self.points, closed=closed)
        tolerance_m = max(SIGMAS * np.sqrt(2.0) * sigma_m, self.least_share * surface.diameter_m)
        search = _Search(self, surface, tolerance_m)
        of_shape = self._of_shape(search, up)
        if colours is None:
            return of_shape
        search.paint(vertices_m, triangles, cielab(colours.astype(np.float64)))
        return replace(of_shape, with_colour=self._left_by_colour(search, of_shape))

    def find_in(self, model: ObjectModel, up: Array) -> Symmetries:
        """Return the symmetries of a model, as far as its surface was seen.

        Args:
            model: with a mesh.
            up: (3,) unit, normal of the support, or whatever axis is likely.
        """
        sigmas_m = model.vertex_sigmas_m
        seen = np.ones(len(model.vertices_m), dtype=bool) if sigmas_m is None else np.isfinite(sigmas_m)
        return self.find(
            model.vertices_m,
            model.triangles[seen[model.triangles].all(axis=1)],
            up=up,
            sigma_m=0.0 if sigmas_m is None or not seen.any() else float(np.median(sigmas_m[seen])),
            colours=model.vertex_colours,
        )

    def free_turns(self, model: ObjectModel) -> Array:
        """Return ξ (k, 6) of turns by 1 rad under which shape and colours of a model stay, in the object frame.

        About the axis of a body of revolution, or about three axes through the centre of a ball.
        """
        found = self.find_in(model, np.array([0.0, -1.0, 0.0]))
        return np.array([axis.turn for axis in (found.with_colour or found).continuous]).reshape(-1, 6)

    def _of_shape(self, search: _Search, up: Array) -> Symmetries:
        """Return the symmetries of the shape."""
        likely = search.likely_axes(up)
        continuous: list[Axis] = []
        for direction in likely:
            axis = search.refined(direction, 100.0)
            if axis is None or any(_parallel(axis, other) for other in continuous):
                continue
            if all(search.maps(_rotation(axis, np.radians(angle))) for angle in _GENERIC_DEG):
                continuous.append(axis)
            if len(continuous) == 3:
                break
        if len(continuous) > 1:  # two make a ball
            centre = _meeting_point(continuous)
            axes = tuple(Axis(direction, centre) for direction in np.eye(3))
            if all(search.maps(_rotation(axis, np.radians(a))) for axis in axes for a in _GENERIC_DEG[:4]):
                return Symmetries(search.tolerance_m, (), axes, compared=search.compared)
            continuous = continuous[:1]
        in_part = search.seen_in_part(likely, continuous)
        sliding = [*continuous, *in_part]
        found: list[Array] = []
        if len(sliding) < 2:  # of a ball no rotation differs from the others
            others = search.other_axes(likely)
            for place, direction in enumerate((*likely, *others)):
                for order in ORDERS if place < len(likely) else ORDERS[:2]:
                    axis = search.refined(direction, 360.0 / order)
                    if axis is None or any(_parallel(axis, other) for other in sliding):
                        continue
                    search.add(found, sliding, *(_rotation(axis, 2.0 * np.pi * k / order) for k in range(1, order)))
            search.close(found, sliding)
        if len(found) > _MOST:
            found, in_part = [], [Axis(direction, search.surface.points_m.mean(axis=0)) for direction in np.eye(3)]
        return Symmetries(search.tolerance_m, tuple(found), tuple(continuous), tuple(in_part), search.compared)

    def _left_by_colour(self, search: _Search, of_shape: Symmetries) -> Symmetries:
        """Return the symmetries of the shape under which colours stay.

        Of an axis of revolution that colour breaks, the turns by 360°/n about it are tried.
        """
        axes = of_shape.continuous
        continuous = tuple(a for a in axes if all(search.stays(_rotation(a, np.radians(t))) for t in _GENERIC_DEG))
        if len(axes) > 1 and len(continuous) < len(axes):
            continuous = ()
        discrete = [pose for pose in of_shape.discrete if search.stays(pose)]
        if len(axes) == 1 and not continuous:
            for order in ORDERS:
                turns = [_rotation(axes[0], 2.0 * np.pi * k / order) for k in range(1, order)]
                if all(search.stays(turn) for turn in turns):
                    search.add(discrete, [], *turns)
        return Symmetries(search.tolerance_m, tuple(discrete), continuous, compared=search.compared)


@dataclass(frozen=True, eq=False)
class _Surface:
    """A surface to look up distances from, and points on it."""

    points_m: Array
    normals: Array
    drawn: SurfacePoints
    scene: o3d.t.geometry.RaycastingScene
    at_border: BoolArray
    """(t,) triangles next to unknown surface."""
    diameter_m: float

    @staticmethod
    def of(vertices_m: Array, triangles: npt.NDArray[np.int64], count: int, *, closed: bool) -> _Surface:
        drawn = SurfacePoints.draw(vertices_m, triangles, count, np.random.default_rng(0))
        points = drawn.of(vertices_m)
        normals, scene = area_vectors_m2(vertices_m, drawn.corners), raycaster(vertices_m, triangles)
        edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        distinct, counts = np.unique(edges, axis=0, return_counts=True)
        border: BoolArray = np.zeros(len(vertices_m), dtype=bool)
        border[distinct[counts == 1].ravel()] = not closed
        extent_m = float(np.linalg.norm(np.ptp(points, axis=0)))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return _Surface(points, normals, drawn, scene, np.any(border[triangles], axis=1), extent_m)

    def nearest(self, points_m: Array) -> tuple[Array, Array, npt.NDArray[np.int64]]:
        """Return the nearest points (n, 3) on the surface, their normals (n, 3) and triangles (n,)."""
        found = self.scene.compute_closest_points(tensor(points_m))
        at, normals, numbers = (found[name].numpy() for name in ("points", "primitive_normals", "primitive_ids"))
        normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        return at.astype(np.float64), normals.astype(np.float64), numbers.astype(np.int64)


@dataclass(eq=False)
class _Search:
    """Trials of rotations on one surface."""

    finder: SymmetryFinder
    surface: _Surface
    tolerance_m: float
    compared: float = Symmetries.compared
    _paint: Paint | None = None
    _colours: Array = field(default_factory=lambda: np.zeros((0, 3)))

    def likely_axes(self, up: Array) -> list[Array]:
        """Return the vertical, the principal axes and the directions in which most of the surface faces, distinct."""
        points_m, normals = self.surface.points_m, self.surface.normals
        principal = np.linalg.svd(points_m - points_m.mean(axis=0), full_matrices=False)[2]
        facing = np.linalg.eigh(normals.T @ normals)[1].T
        axes: list[Array] = []
        for direction in (up, *principal, *facing, *self._faces()):
            if len(axes) < 3 * _LIKELY and all(abs(direction @ other) < np.cos(np.radians(5.0)) for other in axes):
                axes.append(direction)
        return axes[: 2 * _LIKELY]

    def _faces(self) -> list[Array]:
        """Return directions in which flat parts of the surface face, the largest first."""
        normals, found = self.surface.normals[::4], []
        near = np.abs(normals @ normals.T) > np.cos(np.radians(6.0))
        remaining = np.ones(len(normals), dtype=bool)
        for _ in range(_LIKELY):
            counts = (near & remaining).sum(axis=1) * remaining
            best = int(counts.argmax())
            if counts[best] < 0.05 * len(normals):
                break
            members = near[best] & remaining
            mean = (normals[members] * np.sign(normals[members] @ normals[best])[:, None]).mean(axis=0)
            found.append(mean / np.linalg.norm(mean))
            remaining &= ~members
        return found

    def other_axes(self, likely: list[Array]) -> list[Array]:
        """Return directions between likely axes, as the diagonals of a cube, and directions spread evenly."""
        axes: list[Array] = []
        signs = [
            np.array(sign, float) for sign in ((1, 1, 0), (1, -1, 0), (1, 1, 1), (1, 1, -1), (1, -1, 1), (-1, 1, 1))
        ]
        first = likely[0]
        across = [axis for axis in likely[1:] if abs(axis @ first) < 0.1]
        for one in across[:2]:
            frame = np.stack([first, one, np.cross(first, one)])
            axes += [sign @ frame / np.linalg.norm(sign) for sign in signs]
            axes += [frame[2]]
        axes += list(even_rotations(self.finder.directions)[:, :, 2])
        return axes

    def refined(self, direction: Array, angle_deg: float) -> Axis | None:
        """Return the axis to which ICP of the surface with itself brings a rotation; None if it is no symmetry."""
        centre = self.surface.points_m.mean(axis=0)
        points_m = self.surface.points_m[: self.finder.icp_points] - centre
        normals = self.surface.normals[: self.finder.icp_points]
        angle = np.radians(angle_deg)
        axis = Axis(direction, np.zeros(3))
        # Damping: of the motions of an axis, those along it and about it change nothing.
        damping = 1e-3 * len(points_m) * np.diag([1e-2 * self.surface.diameter_m**2] * 3 + [1.0] * 3)
        for step, limit_m in enumerate(self.surface.diameter_m * np.geomspace(0.1, 0.02, 10)):
            pose = _rotation(axis, angle)
            turn = pose[:3, :3]
            moved = se3.transform(pose, points_m)
            at, facing, _ = self.surface.nearest(moved + centre)
            away = at - centre - moved
            off_m = np.linalg.norm(away, axis=1)
            kept = (off_m < limit_m) & (np.sum(facing * (normals @ turn.T), axis=1) > 0.5)
            near = np.mean(off_m < 3.0 * self.tolerance_m)
            if np.count_nonzero(kept) < 0.5 * len(points_m) or near < _NEAR[min(step, len(_NEAR) - 1)]:
                return None
            # The angle stays; the axis moves by Exp(ξ), the rotation S to Exp(ξ) S Exp(-ξ).
            n, back, p, q = facing[kept], facing[kept] @ turn, points_m[kept], moved[kept]
            rows = np.concatenate([np.cross(q, n) - np.cross(p, back), n - back], axis=1)
            xi = np.linalg.solve(rows.T @ rows + damping, rows.T @ np.sum(n * away[kept], axis=1))
            motion = se3.exp(xi)
            axis = Axis(motion[:3, :3] @ axis.direction, se3.transform(motion, axis.point_m[None])[0])
        axis = Axis(axis.direction / np.linalg.norm(axis.direction), axis.point_m + centre)
        return axis if self.maps(_rotation(axis, angle)) else None

    def maps(self, pose: Array) -> bool:
        """Return whether a motion maps the surface onto itself as far as it was seen."""
        for count in (self.finder.icp_points, self.finder.points):  # most are refused by the first few
            elsewhere, unknown = self._shares(pose, count)
            slack = 0.02 if count < self.finder.points else 0.0
            if elsewhere > self.finder.elsewhere + slack or unknown > self.finder.unknown + slack:
                return False
        self.compared = min(self.compared, 1.0 - unknown)
        return True

    def seen_in_part(self, likely: list[Array], continuous: list[Axis]) -> list[Axis]:
        """Return axes about which small turns map the surface onto itself, of which larger ones are not claimed."""
        found: list[Axis] = []
        for direction in likely:
            axis = self.refined(direction, _SMALL_DEG[-1])
            if axis is None or any(_parallel(axis, other) for other in (*continuous, *found)):
                continue
            if all(self.maps(_rotation(axis, np.radians(sign * a))) for a in _SMALL_DEG for sign in (-1.0, 1.0)):
                found.append(axis)
        return found

    def paint(self, vertices_m: Array, triangles: npt.NDArray[np.int64], colours: Array) -> None:
        """Let `stays` compare colours (v, 3) in CIELAB."""
        dense = SurfacePoints.draw(vertices_m, triangles, _PAINTED, np.random.default_rng(1))
        places_m, at_places = dense.of(vertices_m), dense.of(colours)
        self._paint = Paint.of(places_m, at_places, self.tolerance_m, self.finder.colour_tolerance)
        self._colours = self.surface.drawn.of(colours)

    def stays(self, pose: Array) -> bool:
        """Return whether a motion that maps the surface onto itself maps its colours too."""
        assert self._paint is not None
        elsewhere, unknown = self._ends(pose, self.finder.points)
        compared = ~elsewhere & ~unknown
        moved = se3.transform(pose, self.surface.points_m[compared])
        return bool(np.mean(self._paint.differs(moved, self._colours[compared])) <= self.finder.repainted)

    def _shares(self, pose: Array, count: int) -> tuple[float, float]:
        """Return the shares of points that end away from the surface, and where none was seen."""
        elsewhere, unknown = self._ends(pose, count)
        return float(np.mean(elsewhere)), float(np.mean(unknown))

    def _ends(self, pose: Array, count: int) -> tuple[BoolArray, BoolArray]:
        """Return which of the first points end away from the surface, and which where none was seen."""
        moved = se3.transform(pose, self.surface.points_m[:count])
        at, facing, numbers = self.surface.nearest(moved)
        far = np.linalg.norm(moved - at, axis=1) > self.tolerance_m
        # Beside or behind the border of what was seen there may be surface; in front of it there is none.
        ahead = np.sum(facing * (moved - at), axis=1) > self.tolerance_m
        unknown = far & self.surface.at_border[numbers] & ~ahead
        return far & ~unknown, unknown

    def add(self, found: list[Array], sliding: list[Axis], *poses: Array) -> None:
        """Add motions that map the surface onto itself and are not there yet."""
        for pose in poses:
            if self._is_new(pose, found, sliding) and self.maps(pose):
                found.append(pose)

    def _is_new(self, pose: Array, found: list[Array], sliding: list[Axis]) -> bool:
        if se3.rotation_angle(pose) < np.radians(5.0):
            return False
        if not sliding:
            return all(se3.rotation_angle(se3.inverse(pose) @ other) > np.radians(5.0) for other in found)
        # About an axis of revolution, what takes the axis to the same place is the same.
        direction = sliding[0].direction
        ends = [direction, *(other[:3, :3] @ direction for other in found)]
        return all(pose[:3, :3] @ direction @ end < np.cos(np.radians(5.0)) for end in ends)

    def close(self, found: list[Array], sliding: list[Axis]) -> None:
        """Add products until there are no new ones, for symmetries are a group."""
        tried = 0
        while tried < len(found) <= _MOST:
            one = found[tried]
            for other in list(found):
                product = _snapped(one @ other)
                if product is not None:
                    self.add(found, sliding, product)
            tried += 1


def _rotation(axis: Axis, angle_rad: float) -> Array:
    """Return the rotation (4, 4) about an axis."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec(angle_rad * axis.direction).as_matrix()
    return se3.translation(axis.point_m) @ turn @ se3.translation(-axis.point_m)


def _axis_of(pose: Array, angle_rad: float) -> Axis | None:
    """Return the axis of a motion that turns by about an angle; None if it turns by another."""
    vector = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
    angle = float(np.linalg.norm(vector))
    if abs(angle - min(angle_rad, 2.0 * np.pi - angle_rad)) > np.radians(6.0):
        return None
    direction = vector / angle
    across = pose[:3, 3] - direction * (direction @ pose[:3, 3])
    # Of all points on the axis the one nearest to the origin: (I - R) c = t, solved across the axis.
    return Axis(direction, np.linalg.lstsq(np.eye(3) - pose[:3, :3], across, rcond=1e-9)[0])


def _snapped(pose: Array) -> Array | None:
    """Return a rotation (4, 4) by the multiple of 360°/n nearest to that of a motion; None if there is none near."""
    angle = float(np.linalg.norm(Rotation.from_matrix(pose[:3, :3]).as_rotvec()))
    steps = [2.0 * np.pi * k / order for order in ORDERS for k in range(1, order // 2 + 1)]
    nearest = min(steps, key=lambda step: abs(step - angle))
    axis = _axis_of(pose, nearest)
    return None if axis is None or abs(nearest - angle) > np.radians(4.0) else _rotation(axis, nearest)


def _meeting_point(axes: list[Axis]) -> Array:
    """Return the point (3,) nearest to several axes that are not all parallel."""
    across = [np.eye(3) - np.outer(axis.direction, axis.direction) for axis in axes]
    return np.linalg.solve(
        np.sum(across, axis=0), np.sum([p @ a.point_m for p, a in zip(across, axes, strict=True)], axis=0)
    )


def _parallel(one: Axis, other: Axis) -> bool:
    return bool(abs(one.direction @ other.direction) > np.cos(np.radians(5.0)))
