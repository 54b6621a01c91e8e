"""The likelihood of `modeler.kernels.point_likelihood` by Warp, for poses of any number of pairs in one launch.

A thread processes one pose in one direction and sums over points in order: results on a device are reproducible to the
bit. Neighbouring threads read the same points.
"""
# pyright: reportInvalidTypeForm=false

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from modeler.kernels import planes
from modeler.kernels import point_likelihood as twin
from modeler.kernels.gpu.memory import sent
from modeler.kernels.point_likelihood import LikelihoodParameters, Projection

if TYPE_CHECKING:
    wp = cast("Any", None)  # type checkers do not understand Warp kernels
else:
    import warp as wp

wp.set_module_options({"enable_backward": False})

Pose = wp.types.vector(length=13, dtype=wp.float64)
Rows = wp.types.matrix(shape=(3, 4), dtype=wp.float32)
Camera = wp.types.vector(length=6, dtype=wp.float32)
Cell = wp.types.vector(length=planes.CELL_SIZE, dtype=wp.float32)
Support = wp.types.vector(length=5, dtype=wp.float32)

SURFACE, BACKGROUND, MISSING = wp.constant(planes.SURFACE), wp.constant(planes.BACKGROUND), wp.constant(planes.MISSING)
VARIANCE, KIND, DEPTH, SILHOUETTE, RIM = (
    wp.constant(field) for field in (planes.VARIANCE, planes.KIND, planes.DEPTH, planes.SILHOUETTE, planes.RIM)
)
DISTANCE, POINT_VARIANCE = wp.constant(planes.DISTANCE), wp.constant(twin.VARIANCE_M2)
COLUMN, ROW = wp.constant(twin.COLUMN), wp.constant(twin.ROW)
TABLE_LOW, TABLE_HIGH = wp.constant(float(twin.TABLE_LOW)), wp.constant(float(twin.TABLE_HIGH))
LAST, PER_STEP = wp.constant(twin.TABLE_STEPS - 1), wp.constant(float(twin._PER_STEP))
MIN_AGREEMENT = wp.constant(float(twin.MIN_AGREEMENT))
MATCH_LIMIT, HIDDEN_FROM = wp.constant(float(twin.MATCH_LIMIT)), wp.constant(float(twin.HIDDEN_FROM))

Pair = tuple[Projection, Projection, LikelihoodParameters, LikelihoodParameters]


@wp.struct
class Direction:
    """A `Projection` with its `LikelihoodParameters`."""

    first: wp.int32
    """Column of its first point in the points of all directions."""
    count: wp.int32
    image: wp.int32
    table: wp.int32
    camera: Camera
    cosines: wp.vec4
    pattern: wp.vec2
    rim_m2: wp.float32
    blur_m: wp.float32
    silhouette_px: wp.float32
    clearance_m: wp.float32
    max_point_cost: wp.float32
    normal_cost: wp.float32
    unmeasured_gain: wp.float32
    typical_misfit: wp.float32
    support: Support


@wp.struct
class Image:
    """The cells of a view."""

    cells: wp.array[Cell]


@wp.func
def of_surface(
    of: Direction,
    table: wp.array[wp.float32],
    cell: Cell,
    position: wp.vec3,
    normal: wp.vec3,
    variance: wp.float32,
    common: wp.float32,
    faces: wp.float32,
):
    """Return the log-likelihood of a point that falls on surface (eq. 5), and f if the surface explains it, else 0."""
    plane = wp.vec3(cell[0], cell[1], cell[2])
    in_front = cell[DISTANCE] + wp.dot(plane, position)
    agreement = wp.dot(plane, normal)
    other = cell[VARIANCE] + of.rim_m2 * cell[RIM] * cell[RIM]
    half_square = 0.5 * in_front * in_front / (variance + other + of.blur_m * of.blur_m)
    match = of.typical_misfit - half_square - 0.5 * common - of.normal_cost * (1.0 - agreement)
    step = (wp.clamp(match, TABLE_LOW, TABLE_HIGH) - TABLE_LOW) * PER_STEP
    node = wp.min(wp.int32(step), LAST)
    seen = table[node] + (step - wp.float32(node)) * (table[node + 1] - table[node])
    hidden = wp.float32(0.0)
    if in_front > 0.0:
        hidden = wp.min(half_square, of.max_point_cost)
        if match < table[0]:
            seen = wp.max(match, -of.max_point_cost)
    else:
        seen *= 1.0 - wp.clamp((half_square - MATCH_LIMIT) / (HIDDEN_FROM - MATCH_LIMIT), 0.0, 1.0)
    explained = wp.float32(0.0)
    if half_square < MATCH_LIMIT and agreement > MIN_AGREEMENT:
        explained = faces
    return faces * seen - (1.0 - faces) * hidden, explained


@wp.kernel
def sum_over_points(
    poses: wp.array[Pose],
    pair_of: wp.array[wp.int32],
    directions: wp.array[Direction],
    points: wp.array2d[wp.float32],
    images: wp.array[Image],
    tables: wp.array2d[wp.float32],
    found: wp.array2d[wp.vec2],
):
    """Write the log-likelihood of each pose's points in each direction, and the number explained, see the twin."""
    side, i = wp.tid()
    of = directions[2 * pair_of[i] + side]
    pose = poses[i]
    turn = wp.mat33d(pose[0], pose[1], pose[2], pose[4], pose[5], pose[6], pose[8], pose[9], pose[10])
    shift = wp.vec3d(pose[3], pose[7], pose[11])
    if side == 1:
        turn = wp.transpose(turn)
        shift = -(turn * shift)
    factor = pose[12]
    shortened = wp.vec3d(wp.float64(1.0) / factor, wp.float64(1.0) / factor, wp.float64(1.0))
    lengthened = wp.diag(wp.vec3d(factor, factor, wp.float64(1.0)))
    rotation, shift_m = wp.mat33(lengthened * turn * wp.diag(shortened)), wp.vec3(lengthened * shift)
    total, explained = wp.float32(0.0), wp.float32(0.0)
    cells, table = images[of.image].cells, tables[of.table]
    for j in range(of.first, of.first + of.count):
        position = rotation * wp.vec3(points[0, j], points[1, j], points[2, j]) + shift_m
        normal = rotation * wp.vec3(points[3, j], points[4, j], points[5, j])
        cosine = -wp.dot(normal, position) / wp.length(position)
        faces = wp.clamp((cosine - of.cosines[0]) / (of.cosines[1] - of.cosines[0]), 0.0, 1.0)
        column = of.camera[0] * position[0] / position[2] + of.camera[2] + 0.5
        row = of.camera[1] * position[1] / position[2] + of.camera[3] + 0.5
        cell = Cell()
        kind = MISSING
        if position[2] > 0.0 and column >= 0.0 and column < of.camera[4] and row >= 0.0 and row < of.camera[5]:
            cell = cells[wp.int32(row) * wp.int32(of.camera[4]) + wp.int32(column)]
            kind = cell[KIND]
        gain, by_surface = wp.float32(0.0), wp.float32(0.0)
        if kind == SURFACE:
            across, down = column - 0.5 - points[COLUMN, j], row - 0.5 - points[ROW, j]
            correlation = wp.max(1.0 - (across * across + down * down) * of.pattern[1], 0.0)
            common = of.pattern[0] * correlation * correlation
            variance = points[POINT_VARIANCE, j]
            gain, by_surface = of_surface(of, table, cell, position, normal, variance, common, faces)
        elif kind == BACKGROUND:
            if position[2] < cell[DEPTH] - of.clearance_m:
                beyond = cell[SILHOUETTE] / of.silhouette_px
                gain = -wp.min(0.5 * beyond * beyond, of.max_point_cost)
        elif kind == MISSING:
            covered = wp.clamp((cosine - of.cosines[2]) / (of.cosines[3] - of.cosines[2]), 0.0, 1.0)
            gain = of.unmeasured_gain * covered
        standing = wp.vec3(of.support[0], of.support[1], of.support[2])
        height_m = wp.dot(standing, position) + of.support[3] + of.clearance_m
        below = wp.max(-height_m * of.support[4], 0.0)
        total += wp.max(gain - 0.5 * below * below, -of.max_point_cost)
        explained += by_surface
    found[side, i] = wp.vec2(total, explained)


@wp.kernel
def add_directions(found: wp.array2d[wp.vec2], total: wp.array[wp.vec2]):
    """Write the sum over both directions."""
    i = wp.tid()
    total[i] = found[0, i] + found[1, i]


def log_likelihoods(
    poses: npt.NDArray[np.float64], pair_of: npt.NDArray[np.int32], pairs: Sequence[Pair], device: str
) -> npt.NDArray[np.float32]:
    """Return the first two columns of `scores.scores`, (m, 2), for poses of several pairs.

    The sums differ from the twin's only by rounding, unless a point falls within 1e-3 px of a pixel's border.

    Args:
        poses: (m, 12) rows of the 3×4 matrices of target_from_source; or (m, 13), see
            `point_likelihood.write_transform`.
        pair_of: (m,) index of each pose's pair.
        pairs: the arguments of the twin after the poses.
        device: name of the Warp device.
    """
    found = wp.empty((2, len(poses)), dtype=wp.vec2, device=device)
    total = wp.empty(len(poses), dtype=wp.vec2, device=device)
    if poses.shape[1] == 12:  # under the focal length of the views
        poses = np.column_stack([poses, np.ones(len(poses))])
    inputs = [
        wp.array(np.ascontiguousarray(poses), dtype=Pose, device=device),
        wp.array(pair_of, dtype=wp.int32, device=device),
        *_directions(pairs, device),
    ]
    wp.launch(sum_over_points, dim=found.shape, inputs=inputs, outputs=[found], device=device)
    wp.launch(add_directions, dim=len(total), inputs=[found], outputs=[total], device=device)
    return total.numpy()


def _directions(pairs: Sequence[Pair], device: str) -> list[wp.array]:
    """Return the directions of pairs, two a pair, and the points, images and tables to which they refer, on a device.

    Arrays of structs are slow to fill one by one (0.1 ms a direction), as are many small copies.
    """
    projections = [projection for pair in pairs for projection in pair[:2]]
    parameters = [one for pair in pairs for one in pair[2:]]
    counts = np.array([projection.points.shape[1] for projection in projections])
    cells, image_of = _distinct([projection.cells for projection in projections])
    tables, table_of = _distinct([one.table for one in parameters])
    columns = {
        "first": np.cumsum(counts) - counts,
        "count": counts,
        "image": image_of,
        "table": table_of,
        **{name: [getattr(projection, name) for projection in projections] for name in Projection._fields[2:]},
        **{name: [getattr(one, name) for one in parameters] for name in LikelihoodParameters._fields[:8]},
    }
    directions: Any = np.zeros(len(projections), dtype=Direction.numpy_dtype())
    for name, values in columns.items():
        directions[name] = values
    images = []
    for one in cells:
        image = Image()
        image.cells = sent(one, device, Cell)
        images.append(image)
    return [
        wp.array(directions, dtype=Direction, device=device),
        wp.array(np.concatenate([projection.points for projection in projections], axis=1), device=device),
        wp.array(images, dtype=Image, device=device),
        wp.array(np.stack(tables), device=device),
    ]


def _distinct(arrays: Sequence[np.ndarray]) -> tuple[list[np.ndarray], list[int]]:
    """Return arrays without those of the same memory, and the index of each among them."""
    keys = [array.ctypes.data for array in arrays]
    distinct = dict(zip(keys, arrays, strict=True))
    numbers = {key: number for number, key in enumerate(distinct)}
    return list(distinct.values()), [numbers[key] for key in keys]
