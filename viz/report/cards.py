"""Masks and pairs of a run as parts of its page, with small pictures from its recording."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from PIL import Image
from scipy import ndimage
from scipy.spatial import KDTree

from modeler import evaluation, se3
from modeler.system.pictures import encoded
from modeler.types import ACCEPTED, SOME_POINTS, Array, Edge, Outcome, explain
from modeler.viz import entities
from modeler.viz.blueprint import FROM_THE_SIDE
from modeler.viz.reader import FRAME_PATHS
from modeler.viz.readings import certainty_words
from modeler.viz.report.mesh import look_at
from modeler.viz.report.run_data import Result, Row, cloud

_TERMS: Final = {
    "13 → 12": "frame 13 was registered to frame 12: the pose of the object in the one relative to the other",
    "odometry": "to the previous frame; this is how a frame gets its first pose",
    "span": "over several frames, to make their poses more precise",
    "closure": "to a view that the object had turned away from; it closes the loop",
    "join": "between two segments, such as views before and after the object was laid down differently",
    "converged": "one well-determined pose explains both images; other outcomes state the problem and the remedy",
    "rejected": "did not join the pose graph, for the reason given below it",
    "rotation sd, translation sd": "standard deviation along the least certain axis, at the object's centre",
    "overlap": "share of the commonly visible surface that both views observed; 50 % is sufficient",
    "effective samples": "number of equivalent independent samples; at least 100 are needed",
    "sd from the poses": "how far the pair is from the final poses, in its own sd; about 1 is expected",
    "modes": "alternative poses that also explain the images, each with its probability",
}


def pair_cards(result: Result, pictures: Mapping[int, Thumbnails], centre_m: Array) -> Sequence[str]:
    """Return every pair with its pictures, its outcome and why it was or was not joined, as HTML."""
    note = (
        "From left: the frame, its object outlined; its surface (<span class='orange'>orange</span>) and that of "
        "the view it is registered to (<span class='teal'>teal</span>) before and after alignment."
        if pictures
        else "There are no pictures because recording.rrd is missing."
    )
    note = (
        "The worst first: pairs of frames that were lost, then by distance from the poses in standard deviations (sd). "
        f"{note}"
    )
    pairs = zip(result.edges, result.report["edges"], strict=True)
    cards = [
        _pair_card(result, edge, record, pictures.get(edge.source), centre_m)
        for edge, record in sorted(pairs, key=lambda pair: _badness(result, pair[0]), reverse=True)
    ]
    terms = "".join(f"<div><dt>{term}:</dt> <dd>{words}</dd></div>" for term, words in _TERMS.items())
    return [
        f"<h2>Pairs</h2><p class='quiet'>{note}</p><dl class='terms'>{terms}</dl>"
        f"<div class='pairs' id='pairs'>{''.join(cards)}</div>"
    ]


def mask_cards(result: Result, pictures: Mapping[int, Thumbnails]) -> Sequence[str]:
    """Return every frame with its mask as HTML, nothing where there are no pictures."""
    parts, contradicted = [], result.report.get("contradicted") or {}
    for frame in result.report["frames"]:
        shown = pictures.get(frame["id"])
        if shown is not None and shown.masked is not None:
            unsure = frame.get("mask") == Outcome.UNSURE_MASK.label
            words = [str(frame["id"]), *(["unsure"] if unsure else [])]
            words += [] if frame["outcome"] == ACCEPTED else ["left out"]
            words += ["contradicted"] if str(frame["id"]) in contradicted else []
            parts.append(outlined_card(frame["id"], shown.masked, words[1:]))
    note = (
        "The segmented object in each frame; a click enlarges it. The outline should follow the object all around: "
        "anything else inside becomes part of the model, anything outside is missing. Unsure: the object could not be "
        "segmented reliably."
    )
    if contradicted:
        note += (
            " Contradicted, under the poses found: <b class='no'>red</b>, surface through which most frames see that "
            "observe it; <span class='orange'>orange</span>, through which some see; <span class='teal'>teal</span>, "
            "where this frame sees through the surface of others. At outlines, masks include more than the object; all "
            "over, a pose is wrong."
        )
    return outlined_cards("Masks", note, parts)


def outlined_card(frame: int, picture: bytes, doubts: Sequence[str]) -> str:
    """Return a frame with the object outlined, and what is doubtful about it."""
    return (
        f"<div class='mask{' no' if doubts else ''}'><button type='button'>"
        f"<img src='{data_address(picture, 'jpeg')}' alt='frame {frame}'></button>"
        f"<p>{escape(', '.join([str(frame), *doubts]))}</p></div>"
    )


def outlined_cards(title: str, note: str, cards: Sequence[str]) -> Sequence[str]:
    """Return frames, each from `outlined_card`, which a click enlarges; nothing without frames."""
    if not cards:
        return []
    return [
        f"<h2>{title}</h2><p class='quiet'>{note}</p><div class='masks' id='{title.lower()}'>{''.join(cards)}</div>"
        f"<dialog id='large'></dialog><script>{_ENLARGE}</script>"
    ]


def _apart_sds(result: Result, edge: Edge) -> float | None:
    """Return the distance of an edge from the poses, root mean square in its standard deviations; None if unknown."""
    pose = edge.posterior.pose
    if edge.source not in result.poses or edge.target not in result.poses or not np.isfinite(pose.covariance).all():
        return None
    relative = se3.inverse(result.poses[edge.target].mean) @ result.poses[edge.source].mean
    return math.sqrt(evaluation.nees(pose, relative) / 6.0)


def _badness(result: Result, edge: Edge) -> tuple[bool, float, float]:
    """Return the sort key of a pair: lost frames first, then distance from the poses, then little overlap."""
    apart_sds = _apart_sds(result, edge)
    distance = 0.0 if apart_sds is None or not math.isfinite(apart_sds) else round(apart_sds, 1)
    overlap = edge.posterior.overlap
    return apart_sds is None, distance, -overlap if math.isfinite(overlap) else 1.0


def _mode_words(modes: Sequence[Mapping[str, Any]]) -> str:
    """Return how the probability is shared among the modes of an edge, where there are several."""
    if len(modes) < 2:
        return ""
    shares = [f"{100.0 * mode['weight']:.0f} %" for mode in modes]
    left = [f"{100.0 * mode['weight_in_graph']:.0f} %" for mode in modes if mode.get("weight_in_graph") is not None]
    graph = f"; in the pose graph {', '.join(left)}" if left else ""
    return f"<p>{len(modes)} modes: {', '.join(shares)}{graph}.</p>"


def _pair_card(
    result: Result,
    edge: Edge,
    record: Mapping[str, Any],
    pictures: Thumbnails | None,
    centre_m: Array,
) -> str:
    posterior = edge.posterior
    shown = ""
    if pictures is not None and edge.kind == "odometry":
        images = [image for image in (pictures.outlined, pictures.before, pictures.after) if image is not None]
        shown = "".join(f"<img src='{data_address(image, 'jpeg')}' alt=''>" for image in images)
        shown = f"<div class='pictures'>{shown}</div>"
    seen_m = centre_m
    if edge.source in result.poses:
        seen_m = se3.transform(se3.inverse(result.poses[edge.source].mean), centre_m[None])[0]
    facts = [
        f"turned by {np.degrees(se3.rotation_angle(posterior.pose.mean)):.1f}°",
        *certainty_words(posterior, seen_m),
        *([] if (apart_sds := _apart_sds(result, edge)) is None else [f"{apart_sds:.1f} sd from the poses"]),
    ]
    truth = result.true_motion(edge)
    if truth is not None:
        facts += [
            f"rotation error {evaluation.rotation_error_deg(posterior.pose.mean, truth):.2f}°",
            f"translation error {1000.0 * evaluation.translation_error_m(posterior.pose.mean, truth, seen_m):.1f} mm",
        ]
    words = escape(", ".join(facts))
    open_words = _mode_words(record.get("modes", [])) + "".join(
        f"<p>{escape(words)}.</p>" for words in record.get("undetermined", [])
    )
    verdict = edge.kind if edge.accepted else f"{edge.kind}, rejected"
    return (
        f"<div class='pair{'' if edge.accepted else ' no'}'><h3>{edge.source} → {edge.target}: {verdict}, "
        f"{posterior.outcome.label}</h3>{shown}<p>{words}.</p>{open_words}"
        f"<p class='quiet'>{escape(explain(edge.reason))}</p></div>"
    )


_ENLARGE: Final = """
const large = document.getElementById('large');
for (const button of document.querySelectorAll('.mask button'))
  button.onclick = () => { large.replaceChildren(button.firstChild.cloneNode()); large.showModal(); };
large.onclick = () => large.close();
"""
_SIZE: Final = (150, 200)  # height and width in px
_MARKS_RGB: Final = ((31, 143, 155), (217, 115, 13), (200, 69, 63))
"""Of free space with surface of others, of surface in the free space of others, and of false surface."""


@dataclass(frozen=True)
class Thumbnails:
    """Small pictures of a frame as JPEG; None if there is nothing to show."""

    outlined: bytes | None
    """Image around the outlined object, in colour or else depth."""
    before: bytes | None
    """The frame's surface and that of the view it was registered to, both in their own camera's coordinates."""
    after: bytes | None
    """The same under the mean of the posterior."""
    masked: bytes | None
    """As `outlined`, larger, with the surface marked that other frames contradict."""


@dataclass(frozen=True, eq=False)
class Marks:
    """Where a frame and others contradict each other, as in report.json."""

    size: tuple[int, int]
    """Height and width of the frame in px."""
    places: tuple[Array, Array, Array]
    """(n, 2) row and column, by colour of `_MARKS_RGB`."""

    @classmethod
    def read(cls, found: Mapping[str, Any]) -> Marks:
        """Return the marks of a record of report.json."""
        surface, free = np.reshape(found["surface"], (-1, 4)), np.reshape(found["free"], (-1, 2))
        false = (surface[:, 2] >= 2) & (surface[:, 2] > surface[:, 3])
        return cls(tuple(found["size"]), (free, surface[~false, :2], surface[false, :2]))


def thumbnails(rows: Mapping[str, Mapping[int, Row]], report: Mapping[str, Any]) -> dict[int, Thumbnails]:
    """Return the pictures by frame number."""
    frames = sorted({frame for entity in rows.values() for frame in entity})
    marks = {int(frame): Marks.read(found) for frame, found in (report.get("contradicted") or {}).items()}
    doubtful = {record["id"] for record in report["frames"] if record.get("mask") == Outcome.UNSURE_MASK.label}
    doubtful |= {record["id"] for record in report["frames"] if record["outcome"] != ACCEPTED} | set(marks)
    return {
        frame: _of_frame(
            {path: rows[path].get(frame, {}) for path in FRAME_PATHS},
            size_px(len(frames), doubtful=frame in doubtful),
            marks.get(frame),
        )
        for frame in frames
    }


def size_px(frames: int, *, doubtful: bool) -> tuple[int, int]:
    """Return height and width of a frame's picture, of so many: of more than 100, only doubtful ones are large."""
    return (360, 480) if doubtful or frames <= 100 else _SIZE  # as large as it has room beside its words


def with_outline(rows: Mapping[str, Mapping[int, Row]], frame: int, size: tuple[int, int]) -> bytes | None:
    """Return the part of a recorded frame around the outlined object as JPEG; None without a picture.

    Args:
        rows: of the recording, as `recorded` returns them.
        frame: its number.
        size: height and width in px.
    """
    return _outlined(*_shown({path: rows[path].get(frame, {}) for path in FRAME_PATHS}), size)


def _of_frame(rows: Mapping[str, Row], mask_size: tuple[int, int], marks: Marks | None) -> Thumbnails:
    shown, mask = _shown(rows)
    outlined, masked = _outlined(shown, mask, _SIZE), _outlined(shown, mask, mask_size, marks)
    target, before, after = (cloud(rows[p]) for p in (entities.PAIR_TARGET, entities.PAIR_BEFORE, entities.PAIR_AFTER))
    if target is None or before is None or after is None:
        return Thumbnails(outlined, None, None, masked)
    return Thumbnails(outlined, _pair_picture(target, before), _pair_picture(target, after), masked)


def _shown(rows: Mapping[str, Row]) -> tuple[Image.Image | None, Image.Image | None]:
    """Return the picture of a frame, in colour or else depth, and the object's mask; None where there is none."""
    seen, depth, mask = (_picture(rows[path]) for path in (entities.COLOUR, entities.DEPTH, entities.MASK))
    return depth if seen is None else seen, mask


def _picture(row: Row) -> Image.Image | None:
    """Return the picture of a row; None if it has none."""
    blob = row.get("blob")
    return None if blob is None else Image.open(io.BytesIO(bytes(blob.values[0].values.to_numpy())))


def _outlined(
    picture: Image.Image | None, mask: Image.Image | None, size: tuple[int, int], marks: Marks | None = None
) -> bytes | None:
    """Return the part of a picture (colour or depth) around the object, outlined; None without a picture."""
    if picture is None:
        return None
    mask = Image.new("L", picture.size, 255) if mask is None else mask.convert("L").resize(picture.size)
    box = _around(np.asarray(mask) > 0)
    shape = (size[1], round(size[1] * (box[3] - box[1]) / (box[2] - box[0])))
    on = np.asarray(mask.crop(box).resize(shape, Image.Resampling.NEAREST)) > 0
    how = Image.Resampling.BICUBIC if picture.mode == "RGB" else Image.Resampling.NEAREST
    pixels = np.array(picture.crop(box).resize(shape, how), dtype=np.float64)
    if pixels.ndim == 2:
        pixels = _grey(pixels, on)
    if marks is not None:
        _mark(pixels, marks, np.array(box) / picture.width * marks.size[1], int(np.count_nonzero(on)))
    line = ndimage.binary_dilation(on) != ndimage.binary_erosion(on, border_value=1)
    pixels[line] = entities.OUTLINE_RGB
    return encoded(pixels.astype(np.uint8), "JPEG", subsampling=0)  # thin lines keep their colour


def _mark(pixels: Array, marks: Marks, box: Array, area: int) -> None:
    """Paint surface that other frames contradict into a picture.

    Args:
        pixels: (h, w, 3) of the picture, changed in place.
        marks: the surface.
        box: left, top, right and bottom of the picture, in px of the frame.
        area: of the object in the picture, in px.
    """
    height, width = pixels.shape[:2]
    scale = width / (box[2] - box[0])
    reach = max(1.0, 0.5 * np.sqrt(area / SOME_POINTS))  # so that neighbouring points touch
    rows, columns = np.mgrid[:height, :width]
    for rgb, places in zip(_MARKS_RGB, marks.places, strict=True):
        centres = (places[:, ::-1] - box[:2]) * scale
        if len(centres):
            near_px = KDTree(centres).query(np.column_stack([columns.ravel(), rows.ravel()]))[0]
            covered = near_px.reshape(height, width) <= reach
            pixels[covered] = 0.25 * pixels[covered] + 0.75 * np.array(rgb)


def _around(on: npt.NDArray[np.bool_]) -> tuple[int, int, int, int]:
    """Return the box (left, top, right, bottom) around the set pixels of a mask (h, w), with room of 0.3 its size."""
    height, width = on.shape
    if not on.any():
        return 0, 0, width, height
    rows, columns = np.flatnonzero(on.any(axis=1)), np.flatnonzero(on.any(axis=0))
    shape = np.array([width / height, 1.0])  # that of the whole picture, so that it has room for the box
    extent = np.array([np.ptp(columns) + 1, np.ptp(rows) + 1]) * 1.6
    size = np.minimum(float((extent / shape).max()) * shape, [width, height])
    middle = 0.5 * np.array([columns[0] + columns[-1] + 1, rows[0] + rows[-1] + 1])
    start = np.clip(middle - 0.5 * size, 0.0, np.array([width, height]) - size)
    left, top, right, bottom = np.rint([*start, *(start + size)]).astype(np.int64)
    return int(left), int(top), int(right), int(bottom)


def _grey(depth: Array, on: npt.NDArray[np.bool_]) -> Array:
    """Return depth (h, w) as a picture (h, w, 3), near bright, its shades spread over where `on` (h, w) holds."""
    measured = depth > 0.0
    chosen = depth[on & measured] if (on & measured).any() else depth[measured]
    near, far = np.percentile(chosen, (1, 99)) if chosen.size else (0.0, 1.0)
    share = np.clip((depth - near) / max(2.0 * (far - near), 1.0), 0.0, 1.0)
    return np.repeat(np.where(measured, 255.0 * (1.0 - share), 0.0)[..., None], 3, axis=2)


def _pair_picture(*clouds: tuple[Array, npt.NDArray[np.uint8]]) -> bytes:
    """Return two clouds seen from the side, nearer points over farther ones; the first says where to look."""
    points = np.concatenate([cloud for cloud, _ in clouds])
    colours = np.concatenate([colour for _, colour in clouds])
    eye = look_at(clouds[0][0].mean(axis=0), FROM_THE_SIDE, 0.0, np.array([0.0, -1.0, 0.0]))
    seen = se3.transform(se3.inverse(eye), points)
    reach_m = float(np.percentile(np.abs(seen[: len(clouds[0][0])]), 99.5))
    height, width = _SIZE
    places = np.rint(seen[:, :2] * (0.40 * height / max(reach_m, 1e-9)) + 0.5 * np.array([width, height]))
    dot = np.argwhere(np.ones((2, 2)))  # its pixels
    order = np.repeat(np.argsort(-seen[:, 2], kind="stable"), len(dot))
    picture = np.full((height, width, 3), 250, dtype=np.uint8)  # as the page has it
    dots = places[order] + np.tile(dot, (len(points), 1))
    inside = ((dots >= 0) & (dots < (width, height))).all(axis=1)
    columns, rows = dots[inside].astype(np.int64).T
    picture[rows, columns] = colours[order][inside]
    return encoded(picture, "JPEG", subsampling=0)


def data_address(content: bytes, kind: str) -> str:
    """Return an address that is the picture itself, whose media type is `image/` and `kind`."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
