"""Inspection of all frames: contents, missing data, implausible values, and a picture of some."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from modeler.sequences.base import AbstractSequence, span
from modeler.sequences.calibrated import flat_shares
from modeler.sequences.colour_alignment import Misalignment, depth_edges, misalignment
from modeler.sequences.intrinsics import MAX_ASPECT
from modeler.types import Camera, Float32Array, Frame, InputError

POSSIBLE_M = (0.01, 100.0)  # range of the median depth; beyond, the unit is wrong
PLAUSIBLE_M = (0.1, 5.0)
"""Beyond these the median depth is refused, unless its unit is sure: cameras for close range measure from 0.07 m, and
objects farther than 5 m are not turned."""
SURE_UNITS = ("`depth_scale_mm`", "of the format", "(the camera)", "(/", "(16UC1)", "(32FC1)")
"""What the sources of units say that nobody mistypes: an option, a format, a camera, topics and encodings of bags."""
LIKELY_M = (0.25, 5.0)
"""Half of a camera's depth lies within these limits when it watches an object; elsewhere the unit may be wrong."""
OFF_MIDDLE = 0.1
"""Principal points lie within such a share of an image's longer side of its middle; farther off, cx and cy may be
exchanged."""
FAR_OFF_MIDDLE = 0.3  # beyond such a share no whole image has it, but cut-out ones and intrinsics of larger images do
IN_MIDDLE = 0.04
"""Within such a share calibrated cameras have it. Cut-out images may have it anywhere: only there, once exchanged or
scaled to the images, is an error plain."""
USUAL_FIELD_DEG = (1.0, 135.0)  # fields of view of depth cameras, crops included
BENT = 1.5
"""Ratio of the shares on a plane from which depth is the distance along the ray: 2 to 6 in scenes with a table."""
INSPECTED = 6  # number of frames, spread over the sequence, whose planes and edges are looked at
LEAST_JOINED = 0.3
"""Depth cameras measure whole areas; where fewer pixels have measured neighbours, it is lines or single points."""


@dataclass(frozen=True)
class Survey:
    """Contents of the frames of a sequence."""

    indices: tuple[int, ...]
    times_s: tuple[float, ...]
    """Times of capture in s."""
    cameras: tuple[Camera, ...]
    """The cameras, each once."""
    range_m: tuple[float, float, float]
    """Depth in m that 1 %, half, and 99 % of the measured pixels do not exceed: medians over the frames."""
    farthest_m: float
    """Greatest depth in m."""
    measured: float
    """Share (0..1) of the pixels with a measurement."""
    joined: float
    """Share (0..1) of the measured pixels with a measured neighbour to the right and below: those of surfaces."""
    noise: float
    """Scatter of depth from pixel to pixel, as a share of it: the median of the frames'."""
    empty: tuple[int, ...]
    """Numbers of the frames without any measurement."""
    repeated: tuple[int, ...]
    """Numbers of the frames whose depth is that of the frame before, to the bit."""
    masks: int
    """Number of frames with a mask."""
    empty_masks: tuple[int, ...]
    """Numbers of the frames whose mask holds no measured pixel."""
    colours: int
    """Number of frames with colour."""
    truths: int | None
    """Number of frames with a true pose; None if not checked."""
    digests: Mapping[int, str] = field(default_factory=dict)
    """Of the images and the camera of each frame, by its number."""
    flat: tuple[float, float] = (0.0, 0.0)
    """Shares (0..1) of the pixels on the largest plane if depth is along the optical axis, and if along the ray."""
    unit: str = ""
    """Unit of stored depth, and its source."""
    misaligned: Misalignment | None = None
    """Where colour is instead of where depth is; None if it is aligned, or edges do not tell."""

    @property
    def missing(self) -> tuple[str, ...]:
        """Missing data and the consequences, in words."""
        total, lacks = len(self.indices), []
        if self.masks < total:
            what = "no masks" if self.masks == 0 else f"no mask in {total - self.masks} frames"
            lacks.append(f"{what}: the object is segmented by the program")
        if self.colours < total:
            what = "no colour" if self.colours == 0 else f"no colour in {total - self.colours} frames"
            lacks.append(f"{what}: nor will the model have any{' there' if self.colours else ''}")
        if self.truths == 0:
            lacks.append("no ground truth: nothing to evaluate against")
        if self.empty:
            lacks.append(f"no measurement at all in frames {_some(self.empty)}: they will be left out")
        if self.empty_masks:
            lacks.append(f"nothing measured inside the mask in frames {_some(self.empty_masks)}: they will be left out")
        return tuple(lacks)

    @property
    def plain_errors(self) -> tuple[str, ...]:
        """What depth or colour plainly are not, in words."""
        axis, ray = self.flat
        found = [words for camera in self.cameras[:1] for words, sure in _on_principal_point(camera) if sure]
        unit_is_sure = self.unit == "m" or any(source in self.unit for source in SURE_UNITS)
        if not (unit_is_sure or PLAUSIBLE_M[0] <= self.range_m[1] <= PLAUSIBLE_M[1]):
            found.append(_on_unit(self.range_m[1]))
        if ray > max(0.15, BENT * axis):  # 15 % of the pixels at least
            found.append(
                f"depth is the distance along the ray, as renderers write it: so {ray:.0%} of it lie on one plane, "
                f"along the optical axis {axis:.0%}; give `along_ray`"
            )
        elif self.misaligned is not None and self.misaligned.is_sure:
            found.append(_on_colour(self.misaligned))
        return tuple(found)

    def check(self, name: str, *, despite_doubts: bool = False) -> None:
        """Refuse a sequence with a plain error, unless asked not to."""
        if self.plain_errors and not despite_doubts:
            raise InputError(f"{name}: {self.plain_errors[0]} (or `despite_doubts`)")

    @property
    def doubts(self) -> tuple[str, ...]:
        """Likely errors, in words, in order of importance."""
        middle_m, doubts = self.range_m[1], list[str]()
        if not LIKELY_M[0] <= middle_m <= LIKELY_M[1]:
            doubts.append(_on_unit(middle_m))
        if self.misaligned is not None:
            doubts.append(_on_colour(self.misaligned))
        for camera in self.cameras:
            fields_deg = (field_of_view_deg(camera.width, camera.fx), field_of_view_deg(camera.height, camera.fy))
            stretched = max(camera.fx, camera.fy) > MAX_ASPECT * min(camera.fx, camera.fy)
            if stretched or min(fields_deg) < USUAL_FIELD_DEG[0] or max(fields_deg) > USUAL_FIELD_DEG[1]:
                doubts.append(
                    f"fx {camera.fx:g} and fy {camera.fy:g} px mean a field of view of {fields_deg[0]:.1f}° by "
                    f"{fields_deg[1]:.1f}°: are the focal lengths right?"
                )
                break
        doubts += [words for camera in self.cameras[:1] for words, _ in _on_principal_point(camera)]
        doubts += [error for error in self.plain_errors if error not in doubts]
        if self.noise > 0.008:  # a Kinect 1 at 3 m, the noisiest camera measured, has 0.4 %
            doubts.append(
                f"depth scatters by {self.noise:.1%} of the distance from pixel to pixel, more than cameras do: was it "
                "compressed with loss, interpolated, or estimated from colour? Poses and model will be coarse"
            )
        if self.joined < LEAST_JOINED:
            doubts.append(
                f"{1.0 - self.joined:.0%} of the measured pixels have no measured neighbours: surface between them is "
                "interpolated, poses and model will be coarse; if the images were enlarged, scale them down again"
            )
        if self.repeated:
            doubts.append(
                f"{len(self.repeated)} of {len(self.indices)} frames have the depth of the frame before, to the bit "
                f"({_some(self.repeated)}): were they saved twice? If so, remove them"
            )
        return tuple(doubts)


def survey(sequence: AbstractSequence, *, truth: bool = True) -> Survey:
    """Read every frame once, and reject a sequence without usable data.

    Args:
        sequence: to inspect.
        truth: whether to read the ground truth too; estimation must not.

    Raises:
        InputError: if a frame or the ground truth cannot be read, none measures anything, all masks are empty, or
            the depth cannot be in its given unit.
    """
    cameras: dict[Camera, None] = {}
    times_s, ranges, shares, joined, noises, farthest_m = [], [], [], [], [], 0.0
    empty, empty_masks, repeated, masks, colours = [], [], [], 0, 0
    before_m, inspected, digests = None, [], {}
    every = max(1, (len(sequence) - 1) // (INSPECTED - 1))
    for place, frame in enumerate(sequence):
        if place % every == 0 and len(inspected) < INSPECTED:
            inspected.append(frame)
        if frame.camera not in cameras:
            cameras[_checked(sequence, frame.camera)] = None
        times_s.append(frame.time_s)
        digests[frame.index] = _digest(frame)
        pixels = measured_pixels(frame)
        measured = frame.depth_m[pixels]
        shares.append(measured.size / frame.depth_m.size)
        colours += frame.colour is not None
        masks += frame.mask is not None
        if not measured.size:
            empty.append(frame.index)
            continue
        if before_m is not None and np.array_equal(frame.depth_m, before_m, equal_nan=True):
            repeated.append(frame.index)
        before_m = frame.depth_m
        if frame.mask is not None and not (frame.mask & pixels).any():
            empty_masks.append(frame.index)
        joined.append(np.count_nonzero(pixels[:-1, :-1] & pixels[:-1, 1:] & pixels[1:, :-1]) / measured.size)
        noises.append(_scatter(frame.depth_m))
        ranges.append(np.percentile(measured, (1.0, 50.0, 99.0)))
        farthest_m = max(farthest_m, float(measured.max()))
    if not ranges:
        raise InputError(
            f"{sequence.name}: none of its {len(sequence)} frames holds any depth, all is 0 or NaN; record it again."
        )
    if len(empty_masks) == len(ranges):
        raise InputError(f"{sequence.name}: its masks mark nothing that was measured; correct or remove them.")
    low, middle, high = (float(value) for value in np.median(ranges, axis=0))
    _check_unit(sequence, middle)
    poses = sequence.truth() if truth else None
    return Survey(
        indices=sequence.indices,
        times_s=tuple(times_s),
        cameras=tuple(cameras),
        range_m=(low, middle, high),
        farthest_m=farthest_m,
        measured=float(np.mean(shares)),
        joined=float(np.median(joined)),
        noise=float(np.median(noises)),
        empty=tuple(empty),
        repeated=tuple(repeated),
        masks=masks,
        empty_masks=tuple(empty_masks),
        colours=colours,
        truths=(0 if poses is None else len(poses)) if truth else None,
        digests=digests,
        flat=flat_shares(inspected),
        unit=sequence.depth_unit,
        misaligned=misalignment([frame for frame in inspected if frame.camera == inspected[0].camera]),
    )


def field_of_view_deg(size_px: int, focal_px: float) -> float:
    """Return the angle that an image of some width, or height, spans."""
    return float(np.degrees(2.0 * np.arctan(0.5 * size_px / focal_px)))


def _checked(sequence: AbstractSequence, camera: Camera) -> Camera:
    """Return a camera that can be one."""
    for name, focal_px, size_px in (("fx", camera.fx, camera.width), ("fy", camera.fy, camera.height)):
        if field_of_view_deg(size_px, focal_px) > 170.0:  # no pinhole camera sees more
            raise InputError(
                f"{sequence.name}: {name} of {focal_px:g} px is no focal length for images of {camera.width} x "
                f"{camera.height}; correct the intrinsics, which are in px, or convert with `intrinsics` FX FY CX CY."
            )
    return camera


def measured_pixels(frame: Frame) -> np.ndarray:
    """Return which pixels (h, w) hold a measurement."""
    return np.isfinite(frame.depth_m) & (frame.depth_m > 0.0)


def _scatter(depth_m: Float32Array) -> float:
    """Return the standard deviation of depth (h, w) about planes through neighbours, as a share of it; 0 if unknown."""
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / np.where(depth_m > 0.0, depth_m, np.nan)  # linear over planes
    bent = inverse[:, 2:] + inverse[:, :-2] - 2.0 * inverse[:, 1:-1]
    share = np.abs(bent / inverse[:, 1:-1])
    share = share[np.isfinite(share)]
    # Differences of weights 1, -2 and 1 have √6 times the deviation of a pixel, and a median size of 0.6745 of that.
    return float(np.median(share)) * (1.0 / (0.6745 * 6.0**0.5)) if share.size else 0.0


def _check_unit(sequence: AbstractSequence, middle_m: float) -> None:
    """Reject depth that cannot be in its given unit."""
    nearest_m, farthest_m = POSSIBLE_M
    if nearest_m <= middle_m <= farthest_m:
        return
    in_metres = middle_m < nearest_m <= middle_m * 1000.0 <= farthest_m
    in_millimetres = middle_m > farthest_m >= middle_m / 1000.0 >= nearest_m
    guess = "metres" if in_metres else "millimetres" if in_millimetres else "another unit"
    factor = " (1000 times the present scale)" if in_metres else " (a thousandth of it)" if in_millimetres else ""
    raise InputError(
        f"{sequence.name}: half of the depth lies within {middle_m:.3g} m where one unit is {sequence.depth_unit}: "
        f"it looks like {guess}; correct the depth scale{factor}, or convert with `depth_scale_mm`."
    )


def _digest(frame: Frame) -> str:
    digest = hashlib.blake2b(repr(frame.camera).encode(), digest_size=8)
    for image in (frame.depth_m, frame.mask, frame.colour, frame.occluder):
        digest.update(b"none" if image is None else np.ascontiguousarray(image).tobytes())
    return digest.hexdigest()


def _on_principal_point(camera: Camera) -> list[tuple[str, bool]]:
    """Return what is odd about a principal point in words, and whether it is plainly wrong; nothing if nothing is."""
    off_px, swapped_px = (
        float(np.hypot(x - camera.width / 2, y - camera.height / 2))
        for x, y in ((camera.cx, camera.cy), (camera.cy, camera.cx))
    )
    longer_px = max(camera.width, camera.height)
    exchanged, far = swapped_px < off_px and off_px > OFF_MIDDLE * longer_px, off_px > FAR_OFF_MIDDLE * longer_px
    if not (exchanged or far):
        return []
    across, down = 2.0 * camera.cx / camera.width, 2.0 * camera.cy / camera.height
    scaled = across > 0.0 < down and max(across, down) < (1.0 + IN_MIDDLE) * min(across, down)
    question = "cx and cy exchanged" if exchanged else "the intrinsics those of images of another size"
    words = (
        f"the principal point ({camera.cx:.0f}, {camera.cy:.0f}) lies {off_px:.0f} px off the middle of the images: "
        f"are {question}? Correct them, or give `intrinsics`"
    )
    return [(words, swapped_px < IN_MIDDLE * longer_px if exchanged else scaled)]


def _on_unit(middle_m: float) -> str:
    return (
        f"half of the depth lies within {middle_m:.2f} m, very {'near' if middle_m < LIKELY_M[0] else 'far'} for an "
        "object: is the unit right? Give it as `depth_scale_mm`"
    )


def _on_colour(found: Misalignment) -> str:
    return (
        f"colour {found} against depth, by the edges in {INSPECTED} frames: is it of another camera, resized or "
        "mirrored? Give colour that is aligned to depth, or move it away to do without"
    )


def _some(numbers: tuple[int, ...]) -> str:
    return ", ".join(map(str, numbers)) if len(numbers) <= 5 else span(numbers)


def write_picture(path: Path, frames: Sequence[Frame]) -> None:
    """Write a PNG with a row a frame: depth from near (light) to far (dark), colour or depth with edges, the mask."""
    gap = (0, 4), (0, 4), (0, 0)
    rows = [np.concatenate([np.pad(image, gap) for image in _images(frame)], axis=1) for frame in frames]
    width = max(row.shape[1] for row in rows)
    whole = np.concatenate([np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows])
    try:
        Image.fromarray(whole).save(path, "PNG")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error}); choose another place") from None


def _images(frame: Frame) -> list[npt.NDArray[np.uint8]]:
    """Return the images (h, w, 3) of a row."""
    depth = shaded_depth(frame)
    over = (depth if frame.colour is None else frame.colour).copy()
    over[depth_edges(frame.depth_m)] = (255, 0, 0)
    if frame.mask is None:
        return [depth, over]
    return [depth, over, np.where(frame.mask[..., None], depth, depth // 4).astype(np.uint8)]


def shaded_depth(frame: Frame) -> npt.NDArray[np.uint8]:
    """Return depth as an image (h, w, 3), from near (light) to far (dark), black where nothing was measured."""
    measured = measured_pixels(frame)
    image = np.zeros((*frame.depth_m.shape, 3), np.uint8)
    if measured.any():
        near, far = np.percentile(frame.depth_m[measured], (1.0, 99.0))
        share = np.clip((frame.depth_m[measured] - near) / max(far - near, 1e-6), 0.0, 1.0)[:, None]
        light, dark = np.array([255.0, 220.0, 120.0]), np.array([30.0, 40.0, 110.0])
        image[measured] = (light + share * (dark - light)).astype(np.uint8)
    return image
