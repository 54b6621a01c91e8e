"""Whether colour shows what depth shows: edges of depth are looked for in colour, mirrored, scaled and shifted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from modeler.types import FLIPS, Array, Flip, Frame

_WIDTH: Final = 160  # px to which images are shrunk
_REACH: Final = 0.2  # of the width: largest shift
_SCALES: Final = np.exp(0.05 * np.arange(-7, 8))
_ASPECTS: Final = (1.0, 0.75, 0.866, 1.155, 1.333)  # of 4 : 3, 3 : 2 and 16 : 9 in each other
_EDGE: Final = 0.03  # relative second difference of inverse depth, which is linear over planes
_LEAST_EDGES: Final = 12.0  # px at that size, mean over the frames


@dataclass(frozen=True)
class Misalignment:
    """Where edges of depth are found in colour, if not where they are."""

    flip: Flip
    """Whether colour is mirrored left to right, turned by 180°, or mirrored as OpenGL stores images."""
    scale: tuple[float, float]
    """Size of things in colour relative to depth, across and down."""
    shift_px: tuple[float, float]
    """Shift of colour against depth at the middle of the image, right and down, in px of the images."""
    support: float
    """Largest correlation of edges anywhere, in standard deviations over all shifts."""
    support_aligned: float
    """Correlation of edges if colour is aligned, in standard deviations over all shifts."""

    @property
    def is_sure(self) -> bool:
        """Whether alignment is out of the question: as good as anywhere, where it is plain elsewhere."""
        return self.support > _PLAIN and self.support_aligned < _NO_BETTER

    def __str__(self) -> str:
        across, down = self.scale
        parts = [f"is {self.flip}"] if self.flip else []
        if max(abs(np.log(self.scale))) > 0.02:
            size = f"{across:.2f}" if across == down else f"{across:.2f} across and {down:.2f} down"
            parts.append(f"shows things {size} times as large")
        if max(map(abs, self.shift_px)) >= 1.0:
            parts.append(f"is shifted by about ({self.shift_px[0]:.0f}, {self.shift_px[1]:.0f}) px")
        return " and ".join(parts)


_PLAIN, _NO_BETTER = 4.5, 4.0  # standard deviations; aligned captures of cameras have 5 to 15
_STRONG, _CLEAR = 1.0, 7.0  # least correlation, or standard deviations: noise has edges everywhere
_BETTER: Final = 1.5  # ratio of correlations from which another place than alignment is believed
_SHIFTED: Final = 1.3  # the same where alignment is not plainly wrong
_SIMPLER: Final = 0.8  # share of the best correlation with which a simpler explanation does
_LEAST_SHIFT: Final = 2  # px at that size


def misalignment(frames: Sequence[Frame]) -> Misalignment | None:
    """Return where colour of one camera is instead of where depth is; None if aligned, or edges do not tell."""
    pairs = [_edges(frame, frame.colour) for frame in frames if frame.colour is not None]
    if not pairs or np.mean([depth.sum() for depth, _ in pairs]) < _LEAST_EDGES:
        return None
    search = _Search(pairs)
    still = search.correlations((1.0, 1.0))[""]
    deviation, centre = float(still.std()), still.shape[0] // 2
    if deviation == 0.0:
        return None
    aligned = float(still[centre - 1 : centre + 2, centre - 1 : centre + 2].max())
    shifted = _best(still, "", (1.0, 1.0))
    if aligned > _PLAIN * deviation:
        plain = shifted.height > _SHIFTED * aligned and max(map(abs, shifted.shift)) > _LEAST_SHIFT
        return _result(frames[0], shifted, shifted, aligned / deviation) if plain else None
    tried = [_best(found, flip, scale) for scale in _scales() for flip, found in search.correlations(scale).items()]
    best = max(tried, key=lambda each: each.height)
    plain = best.height > _BETTER * aligned and best.height > _PLAIN * best.deviation
    if not plain or (best.height < _STRONG and best.height < _CLEAR * best.deviation):
        return None
    simple = sorted((each for each in tried if each.height >= _SIMPLER * best.height), key=lambda each: each.steps)
    chosen = max((each for each in simple if each.steps == simple[0].steps), key=lambda each: each.height)
    return _result(frames[0], chosen, best, aligned / deviation)


@dataclass(frozen=True)
class _Peak:
    """The best shift of one flip and scale."""

    height: float
    deviation: float
    shift: tuple[int, int]
    flip: Flip
    scale: tuple[float, float]

    @property
    def steps(self) -> int:
        """How complicated an explanation it is."""
        across, down = self.scale
        return (self.flip != "") + (self.scale != (1.0, 1.0)) + (across != down)


def _best(correlation: Array, flip: Flip, scale: tuple[float, float]) -> _Peak:
    reach = correlation.shape[0] // 2
    row, column = np.unravel_index(int(correlation.argmax()), correlation.shape)
    shift = int(column) - reach, int(row) - reach
    return _Peak(float(correlation.max()), float(correlation.std()), shift, flip, scale)


def _result(frame: Frame, peak: _Peak, best: _Peak, aligned: float) -> Misalignment:
    step = _step(frame.depth_m.shape[1])
    shift_px = float(step * peak.shift[0]), float(step * peak.shift[1])
    return Misalignment(peak.flip, peak.scale, shift_px, best.height / best.deviation, aligned)


def _scales() -> Iterator[tuple[float, float]]:
    for aspect in _ASPECTS:
        for scale in _SCALES:
            yield round(float(scale * np.sqrt(aspect)), 3), round(float(scale / np.sqrt(aspect)), 3)


def _step(width: int) -> int:
    return max(1, width // _WIDTH)


def _edges(frame: Frame, colour: npt.NDArray[np.uint8]) -> tuple[Array, Array]:
    """Return the edges of depth and of colour, shrunk; those of colour less their surroundings' mean."""
    bends = depth_edges(frame.depth_m)
    square = np.zeros(colour.shape[:2], dtype=np.float32)
    for channel in range(3):
        smooth = ndimage.gaussian_filter(colour[..., channel].astype(np.float32), 1.0)
        square = np.maximum(square, ndimage.sobel(smooth, 0) ** 2 + ndimage.sobel(smooth, 1) ** 2)
    slope = np.sqrt(square)
    steep = slope / (slope + np.percentile(slope, 80.0) + 1e-9)
    step = _step(frame.depth_m.shape[1])
    seen = _shrunk(steep, step)
    return np.minimum(_shrunk(bends.astype(np.float64), step), 0.5), seen - np.asarray(ndimage.gaussian_filter(seen, 8))


def depth_edges(depth_m: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
    """Return the pixels (h, w) at which measured depth bends or jumps."""
    inverse = 1.0 / np.where(depth_m > 0.0, depth_m, np.nan).astype(np.float64)
    bends = np.zeros(inverse.shape, dtype=np.bool_)
    for axis in (0, 1):
        bent = np.abs(np.roll(inverse, 1, axis) + np.roll(inverse, -1, axis) - 2.0 * inverse)
        with np.errstate(invalid="ignore"):
            bends |= bent > _EDGE * inverse
    bends[[0, -1]] = bends[:, [0, -1]] = False  # rolled around
    return bends


def _shrunk(image: Array, step: int) -> Array:
    height, width = (size // step for size in image.shape)
    return image[: height * step, : width * step].reshape(height, step, width, step).mean(axis=(1, 3))


class _Search:
    """Correlation of edges of depth and colour over shifts, summed over frames."""

    def __init__(self, pairs: Sequence[tuple[Array, Array]]) -> None:
        from scipy.fft import next_fast_len  # many import this module who align no colour

        height, width = pairs[0][0].shape
        self._reach = round(_REACH * width)
        self._size = tuple(next_fast_len(size + self._reach, real=True) for size in (height, width))
        self._depth = [depth for depth, _ in pairs]
        self._colour = [np.fft.rfft2(colour, self._size) for _, colour in pairs]
        self._norm = float(np.sqrt(np.mean([np.mean(colour**2) for _, colour in pairs]))) + 1e-12
        down, across = (
            np.exp(2j * np.pi * frequencies(padded) * (size - 1))
            for size, padded, frequencies in zip(
                (height, width), self._size, (np.fft.fftfreq, np.fft.rfftfreq), strict=True
            )
        )
        rows = down[:, None]
        self._phases = {"": 1.0, "mirrored": across, "upside down": rows * across, "flipped top to bottom": rows}

    def correlations(self, scale: tuple[float, float]) -> dict[Flip, Array]:
        """Return the correlation by shift, down and right, from minus to plus the reach, for each way to flip.

        An image turned by 180 degrees has the conjugate spectrum, but for a phase; a mirrored one that of the opposite
        frequency across, or down.
        """
        sums: dict[Flip, npt.NDArray[np.complex128]] = {flip: np.zeros_like(self._colour[0]) for flip in FLIPS}
        count = 1.0
        for depth, colour in zip(self._depth, self._colour, strict=True):
            moved = depth if scale == (1.0, 1.0) else _resized(depth, scale)
            spectrum = np.fft.rfft2(moved, self._size)
            sums[""] += np.conj(spectrum) * colour
            opposite = np.roll(spectrum[::-1], 1, axis=0)
            sums["mirrored"] += opposite * colour
            sums["upside down"] += spectrum * colour
            sums["flipped top to bottom"] += np.conj(opposite) * colour
            count += float(moved.sum())
        near = np.arange(-self._reach, self._reach + 1)
        found: dict[Flip, Array] = {}
        for flip, total in sums.items():
            rows = np.fft.ifft(self._phases[flip] * total, axis=0)[near]
            found[flip] = np.fft.irfft(rows, self._size[1], axis=1)[:, near] / (count * self._norm)
        return found


def _resized(image: Array, scale: tuple[float, float]) -> Array:
    """Return an image (h, w) with things of another size, across and down, by interpolation, about its middle."""
    factors = 1.0 / np.array(scale[::-1])
    middle = (np.array(image.shape) - 1) / 2
    offset = middle - factors * middle
    moved = ndimage.affine_transform(image, factors, offset, order=1)  # pyright: ignore[reportArgumentType]
    return np.asarray(moved)
