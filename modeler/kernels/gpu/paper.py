"""The likelihood, draws and free-space test of `modeler.kernels.paper` by Warp, also in double precision.

A draw is a pure function of its number, and samples are kept in the order of their numbers: results do not depend on
the scheduling of threads.
"""
# pyright: reportInvalidTypeForm=false

import weakref
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from modeler.kernels import paper as twin

if TYPE_CHECKING:
    wp = cast("Any", None)  # type checkers do not understand Warp kernels
else:
    import warp as wp

wp.set_module_options({"enable_backward": False})

Pose = wp.types.vector(length=12, dtype=wp.float64)
Check = wp.types.vector(length=5, dtype=wp.float64)
Image = wp.types.vector(length=7, dtype=wp.float64)

STRIDE, GOLDEN = wp.constant(wp.uint64(int(twin.STRIDE))), wp.constant(wp.uint64(int(twin.GOLDEN)))
FIRST, SECOND = wp.constant(wp.uint64(int(twin.FIRST_FACTOR))), wp.constant(wp.uint64(int(twin.SECOND_FACTOR)))
LOW_21 = wp.constant(wp.uint64(int(twin.LOW_21)))
HALF, ONE, TWO = wp.constant(wp.float64(0.5)), wp.constant(wp.float64(1.0)), wp.constant(wp.float64(2.0))
ZERO, NEVER = wp.constant(wp.float64(0.0)), wp.constant(wp.float64(-np.inf))
TO_GRID, TO_UNIT = wp.constant(wp.float64(2.0**-20)), wp.constant(wp.float64(2.0**-53))
HIDDEN, FREE = wp.constant(wp.float64(6.0)), wp.constant(wp.float64(-27.3))
NO_REACH, ROUNDED_DOWN = wp.constant(wp.float64(1e6)), wp.constant(wp.float64(1.0 - 1e-6))

AT_ONCE = 1 << 24
"""Number of draws of one launch, which take 192 MB of device memory."""

_sent: dict[tuple[object, ...], wp.array] = {}


def sent(array: np.ndarray, device: str, dtype: Any = None) -> wp.array:
    """Return the copy of a host array on a device, cached while the host array exists; it must not be modified.

    Args:
        array: of the host.
        device: name of the Warp device.
        dtype: Warp type of an element, such as a vector; None = a number.
    """
    owner = array
    while isinstance(owner.base, np.ndarray):
        owner = owner.base
    key = (array.__array_interface__["data"][0], array.shape, array.strides, array.dtype.str, device, dtype)
    if key not in _sent:
        _sent[key] = wp.array(array, dtype=Any if dtype is None else dtype, device=device, copy=True)
        weakref.finalize(owner, _sent.pop, key, None)
    return _sent[key]


@wp.struct
class View:
    """`Measured` of one view."""

    points_m: wp.array[wp.vec3d]
    ranges_m: wp.array2d[wp.float64]
    intrinsics: wp.vec4d
    noise: wp.mat33d


@wp.struct
class Tests:
    """`FreeSpace`."""

    checks: wp.array[Check]
    near_target_m: wp.array2d[wp.float32]
    near_source_m: wp.array2d[wp.float32]
    of_target: Image
    of_source: Image


@wp.func
def rotation_of(pose: Pose) -> wp.mat33d:
    """Return a pose's rotation."""
    return wp.mat33d(pose[0], pose[1], pose[2], pose[4], pose[5], pose[6], pose[8], pose[9], pose[10])


@wp.func
def translation_of(pose: Pose) -> wp.vec3d:
    """Return a pose's translation."""
    return wp.vec3d(pose[3], pose[7], pose[11])


@wp.func
def ray_jacobian(point: wp.vec3d) -> wp.mat33d:
    """Return Q = ∂(w, h, r)/∂(x, y, z) at a point."""
    x, y, z = point[0], point[1], point[2]
    r = wp.length(point)
    return wp.mat33d(ONE / z, ZERO, -x / (z * z), ZERO, ONE / z, -y / (z * z), x / r, y / r, z / r)


@wp.func
def summed_covariance(jacobian: wp.mat33d, noise: wp.mat33d) -> wp.mat33d:
    """Return J L Jᵀ + L."""
    return jacobian * noise * wp.transpose(jacobian) + noise


@wp.func
def point_density(
    point_b: wp.vec3d,
    rotation: wp.mat33d,
    shift_m: wp.vec3d,
    ranges_m: wp.array2d[wp.float64],
    camera: wp.vec4d,
    noise: wp.mat33d,
    reach_sigmas: wp.float64,
) -> wp.float64:
    """Return p(b_j | M_A, T) of one point, up to a constant (paper, eq. pbd)."""
    in_a = rotation * point_b + shift_m
    if in_a[2] <= ZERO:
        return ZERO
    q_a, q_b = ray_jacobian(in_a), ray_jacobian(point_b)
    precision = wp.inverse(summed_covariance(q_a * rotation * wp.inverse(q_b), noise))
    in_b = summed_covariance(q_b * wp.transpose(rotation) * wp.inverse(q_a), noise)
    k2 = ONE / wp.sqrt(wp.determinant(in_b))
    last = precision[2, 2]
    d_ww = precision[0, 0] - precision[2, 0] * precision[2, 0] / last
    d_wh = precision[1, 0] - precision[2, 0] * precision[2, 1] / last
    d_hh = precision[1, 1] - precision[2, 1] * precision[2, 1] / last
    v = wp.vec3d(precision[2, 0], precision[2, 1], precision[2, 2]) / wp.sqrt(TWO * last)
    w, h, r = in_a[0] / in_a[2], in_a[1] / in_a[2], wp.length(in_a)
    first_row, last_row = wp.int32(0), ranges_m.shape[0] - 1
    first_column, last_column = wp.int32(0), ranges_m.shape[1] - 1
    if reach_sigmas < NO_REACH:
        determinant = d_ww * d_hh - d_wh * d_wh
        reach_w = reach_sigmas * wp.sqrt(d_hh / determinant)
        reach_h = reach_sigmas * wp.sqrt(d_ww / determinant)
        # Clamped before conversion to integers: for points almost in the camera's plane they may be huge.
        columns, rows = wp.float64(ranges_m.shape[1]), wp.float64(ranges_m.shape[0])
        first_column = wp.int32(wp.clamp(wp.ceil(camera[0] * (w - reach_w) + camera[2]), ZERO, columns))
        last_column = wp.int32(wp.clamp(wp.floor(camera[0] * (w + reach_w) + camera[2]), -ONE, columns - ONE))
        first_row = wp.int32(wp.clamp(wp.ceil(camera[1] * (h - reach_h) + camera[3]), ZERO, rows))
        last_row = wp.int32(wp.clamp(wp.floor(camera[1] * (h + reach_h) + camera[3]), -ONE, rows - ONE))
    limit = HALF * reach_sigmas * reach_sigmas
    total = wp.float64(0.0)
    for row in range(first_row, last_row + 1):
        dh = h - (wp.float64(row) - camera[3]) / camera[1]
        for column in range(first_column, last_column + 1):
            dw = w - (wp.float64(column) - camera[2]) / camera[0]
            exponent = HALF * (d_ww * dw * dw + TWO * d_wh * dw * dh + d_hh * dh * dh)
            if exponent <= limit:
                behind = v[0] * dw + v[1] * dh + v[2] * (r - ranges_m[row, column])
                if behind > HIDDEN:
                    total += TWO * wp.exp(-exponent)
                elif behind > FREE:
                    total += wp.exp(-exponent) * wp.erfc(-behind)
    return k2 * total


@wp.func
def log_likelihood(
    own: View, other: View, rotation: wp.mat33d, shift_m: wp.vec3d, reach_sigmas: wp.float64, least: wp.float64
) -> wp.float64:
    """Return log p(points | other view, pose), -inf if a point rejects the pose."""
    threshold = least / wp.sqrt(wp.determinant(TWO * other.noise))
    total = wp.float64(0.0)
    for j in range(own.points_m.shape[0]):
        density = point_density(
            own.points_m[j], rotation, shift_m, other.ranges_m, other.intrinsics, other.noise, reach_sigmas
        )
        if density <= threshold:
            return NEVER
        total += wp.log(density)
    return total


@wp.kernel
def weigh(
    poses: wp.array[Pose],
    source: View,
    target: View,
    reach_sigmas: wp.float64,
    least: wp.float64,
    found: wp.array[wp.float64],
):
    """Write log p(P_B | M_A, T) + log p(P_A | M_B, T) of each pose."""
    i = wp.tid()
    rotation, shift_m = rotation_of(poses[i]), translation_of(poses[i])
    total = log_likelihood(source, target, rotation, shift_m, reach_sigmas, least)
    if total > NEVER:
        back = wp.transpose(rotation)
        total += log_likelihood(target, source, back, -(back * shift_m), reach_sigmas, least)
    found[i] = total


@wp.func
def mixed(counter: wp.uint64) -> wp.uint64:
    """Return 64 random bits of a counter (Steele, Lea and Flood 2014, SplitMix64)."""
    bits = (counter ^ (counter >> wp.uint64(30))) * FIRST
    bits = (bits ^ (bits >> wp.uint64(27))) * SECOND
    return bits ^ (bits >> wp.uint64(31))


@wp.func
def on_grid(bits: wp.uint64) -> wp.float64:
    """Return the centre of one of 2²¹ equal parts of [-1, 1]."""
    return (wp.float64(bits) + HALF) * TO_GRID - ONE


@wp.func
def in_ball(counter: wp.uint64):
    """Return the advanced counter and a point uniform in the unit ball, on a grid of 10⁻⁶."""
    point = wp.vec3d(TWO, TWO, TWO)
    while wp.dot(point, point) > ONE:
        counter = counter + GOLDEN
        bits = mixed(counter)
        point = wp.vec3d(
            on_grid(bits >> wp.uint64(43)),
            on_grid((bits >> wp.uint64(22)) & LOW_21),
            on_grid((bits >> wp.uint64(1)) & LOW_21),
        )
    return counter, point


@wp.func
def draw(number: wp.uint64, seed: wp.uint64, limits: wp.array[wp.float64]) -> Pose:
    """Return the pose of a number, see `twin.draw`."""
    counter = seed + GOLDEN * STRIDE * number
    least = ONE - limits[0] * limits[0]
    vector = wp.vec3d()
    square = wp.float64(0.0)
    chance = wp.float64(0.0)
    while chance * chance * square >= least or square == ZERO:
        counter, point = in_ball(counter)
        vector = limits[0] * point
        square = ONE - wp.dot(vector, vector)
        counter = counter + GOLDEN
        chance = wp.float64(mixed(counter) >> wp.uint64(11)) * TO_UNIT
    x, y, z, w = vector[0], vector[1], vector[2], wp.sqrt(square)
    turn = wp.mat33d(
        ONE - TWO * (y * y + z * z),
        TWO * (x * y - w * z),
        TWO * (x * z + w * y),
        TWO * (x * y + w * z),
        ONE - TWO * (x * x + z * z),
        TWO * (y * z - w * x),
        TWO * (x * z - w * y),
        TWO * (y * z + w * x),
        ONE - TWO * (x * x + y * y),
    )
    counter, offset = in_ball(counter)
    middle = wp.mat33d(
        limits[8], limits[9], limits[10], limits[11], limits[12], limits[13], limits[14], limits[15], limits[16]
    )
    r = turn * middle
    t = wp.vec3d(limits[5], limits[6], limits[7]) + limits[1] * offset - r * wp.vec3d(limits[2], limits[3], limits[4])
    return Pose(
        r[0, 0], r[0, 1], r[0, 2], t[0], r[1, 0], r[1, 1], r[1, 2], t[1], r[2, 0], r[2, 1], r[2, 2], t[2]
    )  # fmt: skip


@wp.func
def forbidden(at: wp.vec3d, margin_m: wp.float64, near_m: wp.array2d[wp.float32], image: Image) -> wp.bool:
    """Return whether a point lies in front of every measured pixel within its reach, see `twin.forbidden`."""
    if at[2] <= ZERO:
        return True
    inverse = ONE / at[2]
    square = wp.dot(at, at)
    if square * inverse * inverse * inverse * inverse > image[6]:
        return False
    column = image[0] * at[0] * inverse + image[2] + HALF
    row = image[1] * at[1] * inverse + image[3] + HALF
    if column < ZERO or column >= image[4] or row < ZERO or row >= image[5]:
        return True
    free_m = wp.float64(near_m[wp.int32(row), wp.int32(column)]) - margin_m
    return free_m > ZERO and square < free_m * free_m


@wp.func
def passes(pose: Pose, tests: Tests) -> wp.int32:
    """Return 1 if no check forbids a pose, else 0."""
    rotation, shift_m = rotation_of(pose), translation_of(pose)
    for j in range(tests.checks.shape[0]):
        check = tests.checks[j]
        point = wp.vec3d(check[0], check[1], check[2])
        wrong = wp.bool(False)
        if check[4] > ZERO:
            at = wp.transpose(rotation) * (point - shift_m)
            wrong = forbidden(at, check[3], tests.near_source_m, tests.of_source)
        else:
            wrong = forbidden(rotation * point + shift_m, check[3], tests.near_target_m, tests.of_target)
        if wrong:
            return 0
    return 1


@wp.kernel
def sift_draws(
    first: wp.uint64, seed: wp.uint64, limits: wp.array[wp.float64], tests: Tests, passing: wp.array[wp.int32]
):
    """Write whether each of the draws numbered from `first` passes."""
    i = wp.tid()
    passing[i] = passes(draw(first + wp.uint64(i), seed, limits), tests)


@wp.kernel
def keep_draws(
    first: wp.uint64,
    seed: wp.uint64,
    limits: wp.array[wp.float64],
    places: wp.array[wp.int32],
    kept: wp.array[Pose],
):
    """Write the draws that pass to their places: the running count of those that pass, from 1."""
    i = wp.tid()
    before = wp.int32(0)
    if i > 0:
        before = places[i - 1]
    if places[i] > before:
        kept[before] = draw(first + wp.uint64(i), seed, limits)


@wp.kernel
def sift(poses: wp.array[Pose], tests: Tests, passing: wp.array[wp.int32]):
    """Write whether each pose passes."""
    i = wp.tid()
    passing[i] = passes(poses[i], tests)


@wp.kernel
def find_nearest(
    ranges_m: wp.array2d[wp.float64],
    reach_px: wp.vec2d,
    across: wp.int32,
    down: wp.int32,
    near_m: wp.array2d[wp.float32],
):
    """Write the least range within reach of any point that rounds to a pixel, see `twin.nearest_ranges`."""
    row, column = wp.tid()
    least = wp.float32(wp.inf)
    for dy in range(-down, down + 1):
        other = row - down + dy
        rest = wp.max(wp.float64(wp.abs(dy)) - HALF, ZERO) / reach_px[1]
        rest = ONE - rest * rest
        if other >= 0 and other < ranges_m.shape[0] and rest >= ZERO:
            half = wp.int32(wp.floor(reach_px[0] * wp.sqrt(rest) + HALF))
            for there in range(
                wp.max(column - across - half, 0), wp.min(column - across + half + 1, ranges_m.shape[1])
            ):
                least = wp.min(least, wp.float32(ranges_m[other, there] * ROUNDED_DOWN))
    near_m[row, column] = least


def nearest_ranges(
    ranges_m: npt.NDArray[np.float64], reach_px: npt.NDArray[np.float64], device: str
) -> npt.NDArray[np.float32]:
    """Return the result of `paper.nearest_ranges`."""
    across, down = (int(np.ceil(reach + 0.5)) for reach in reach_px)
    shape = ranges_m.shape[0] + 2 * down, ranges_m.shape[1] + 2 * across
    near_m = wp.empty(shape, dtype=wp.float32, device=device)
    inputs = [sent(ranges_m, device), wp.vec2d(*reach_px), across, down]
    wp.launch(find_nearest, dim=shape, inputs=inputs, outputs=[near_m], device=device)
    return near_m.numpy()


@dataclass(frozen=True, eq=False)
class OnDevice:
    """The paper's likelihood and test of free space for two views, on a device."""

    device: str
    """Name of the Warp device."""
    source: Any
    """`View`s; their points and ranges are copied once."""
    target: Any
    tests: Any
    options: tuple[float, float]
    """As for `paper.log_likelihoods`."""

    @staticmethod
    def of(
        device: str,
        views: Sequence[tuple[np.ndarray, ...]],
        tests: tuple[np.ndarray, tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]],
        options: tuple[float, float],
    ) -> "OnDevice":
        """Return source and target, each points (n, 3), ranges, intrinsics and noise, and a test, on a device.

        Args:
            device: name of the Warp device.
            views: source and target.
            tests: checks, nearest ranges and images, as for `paper.passing`.
            options: as for `paper.log_likelihoods`.
        """
        checks, near_m, images = tests
        sifter = Tests()
        sifter.checks = sent(np.ascontiguousarray(checks), device, Check)
        sifter.near_target_m, sifter.near_source_m = (sent(near, device) for near in near_m)
        sifter.of_target, sifter.of_source = (Image(*image) for image in images)
        source, target = (_view(view, device) for view in views)
        return OnDevice(device, source, target, sifter, options)

    def weighted_draws(
        self, count: int, seed: np.uint64, limits: npt.NDArray[np.float64]
    ) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """Yield the number of draws, and the poses (k, 12) and log-likelihoods (k,) of those not rejected."""
        on_device = wp.array(limits, dtype=wp.float64, device=self.device)
        passing = wp.empty(min(count, AT_ONCE), dtype=wp.int32, device=self.device)
        for first in range(0, count, AT_ONCE):
            tried = min(AT_ONCE, count - first)
            numbers = [wp.uint64(first), wp.uint64(int(seed)), on_device]
            wp.launch(sift_draws, dim=tried, inputs=[*numbers, self.tests], outputs=[passing], device=self.device)
            wp.utils.array_scan(passing[:tried], passing[:tried], inclusive=True)
            kept = wp.empty(int(passing[tried - 1 : tried].numpy()[0]), dtype=Pose, device=self.device)
            wp.launch(keep_draws, dim=tried, inputs=[*numbers, passing], outputs=[kept], device=self.device)
            yield tried, *self._weighted(kept)

    def weighted(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the poses (k, 12) of (m, 12) that are not rejected, and their log-likelihoods (k,)."""
        passing = wp.empty(len(poses), dtype=wp.int32, device=self.device)
        on_device = wp.array(np.ascontiguousarray(poses), dtype=Pose, device=self.device)
        wp.launch(sift, dim=len(poses), inputs=[on_device, self.tests], outputs=[passing], device=self.device)
        kept = poses[passing.numpy() > 0]
        return self._weighted(wp.array(np.ascontiguousarray(kept), dtype=Pose, device=self.device))

    def log_likelihoods(self, poses: np.ndarray) -> np.ndarray:
        """Return log p(P_B | M_A, T) + log p(P_A | M_B, T) (m,) of poses (m, 12); -inf if rejected."""
        return self._log_likelihoods(wp.array(np.ascontiguousarray(poses), dtype=Pose, device=self.device))

    def _log_likelihoods(self, poses: wp.array) -> np.ndarray:
        found = wp.empty(len(poses), dtype=wp.float64, device=self.device)
        inputs = [poses, self.source, self.target, *self.options]
        wp.launch(weigh, dim=len(poses), inputs=inputs, outputs=[found], device=self.device)
        return found.numpy()

    def _weighted(self, poses: wp.array) -> tuple[np.ndarray, np.ndarray]:
        found = self._log_likelihoods(poses)
        possible = np.isfinite(found)
        return poses.numpy().reshape(-1, 12)[possible], found[possible]


def _view(view: tuple[np.ndarray, ...], device: str) -> Any:
    """Return points, ranges, intrinsics and noise of a view on a device."""
    points_m, ranges_m, intrinsics, noise = view
    result = View()
    result.points_m, result.ranges_m = sent(np.ascontiguousarray(points_m), device, wp.vec3d), sent(ranges_m, device)
    result.intrinsics, result.noise = wp.vec4d(*intrinsics), wp.mat33d(*noise.ravel())
    return result
