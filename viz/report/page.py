"""The page about a run."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from PIL import Image

from modeler import evaluation, se3
from modeler.export import write_atomically
from modeler.export.mesh import MOST_SIGMA_M
from modeler.export.standing import model_upright
from modeler.types import ACCEPTED, Array, Edge, Outcome, explain, loops_closed
from viz import entities
from viz.blueprint import FROM_THE_SIDE
from viz.readings import certainty_words
from viz.report import plots
from viz.report.mesh import Mesh, look_at, read_mesh, scene, shade
from viz.report.run_data import FRAME_PATHS, Result, Row, cloud, recorded, surfaces

_SHAPE_POINTS: Final = 6_000
_CAMERA_SHARE: Final = 0.12  # length of a drawn camera, as a share of its distance
_ABOVE_LEFT: Final = np.array([-0.5, -0.5, -0.75])


def write_page(run: Path, out: Path, truth: Mapping[int, Array] | None = None) -> None:
    """Write a self-contained page about a run.

    Args:
        run: the run folder.
        out: file to write.
        truth: camera_from_model (4, 4) by frame number, where it is known.

    Raises:
        InputError: where the folder holds no run, no frame was accepted, or the file cannot be written.
    """
    result = Result.read(run, truth)
    mesh = read_mesh(run / "model.ply")
    centre_m = se3.transform(result.poses[result.first].mean, np.zeros((1, 3)))[0] if mesh is None else mesh.centre_m
    rows = recorded(run / "recording.rrd")
    parts = [_head(result, mesh), *_model(result, mesh), *_trajectory(result, mesh, centre_m)]
    parts += [*_closure(result, rows), *_accuracy(result, centre_m), *pair_cards(result, thumbnails(rows), centre_m)]
    parts.append(_settings(result))
    page = Template(_asset("page.html")).substitute(
        title=escape(f"{_name(result)}: model report"), body="\n".join(parts)
    )
    write_atomically(out, page)


def _opening(loop: Mapping[str, float] | None) -> list[tuple[str, str]]:
    """Return by how much the loop was open, as a key figure; nothing where no loop was closed."""
    if loop is None:
        return []
    return [(f"{loop['opening_deg']:.1f}°, {loop['sigmas']:.1f} sd", "open loop, before optimisation")]


def _head(result: Result, mesh: Mesh | None) -> str:
    """Return name, verdict and key figures."""
    report = result.report
    reasons = "".join(f"<li>{escape(reason)}</li>" for reason in report["reasons"])
    verdict = (
        '<p class="verdict">All frames were placed and all checks passed.</p>'
        if report["trustworthy"]
        else f'<div class="verdict no">Do not trust this model:<ul>{reasons}</ul></div>'
    )
    closed = loops_closed([edge for edge in result.edges if edge.accepted])
    total_s = report["seconds"].get("total")
    figures = [
        (f"{len(result.poses)} of {len(report['frames'])}", "frames placed"),
        (str(closed), "loop closed" if closed == 1 else "loops closed"),
        *_opening(report.get("loop")),
        ("none" if mesh is None else f"{mesh.total:,}", "triangles"),
        ("unknown" if total_s is None else f"{total_s:.0f} s", "build time"),
    ]
    if result.true_pose(result.first) is not None:
        poses = {k: pose.mean for k, pose in result.poses.items() if result.true_pose(k) is not None}
        off = evaluation.trajectory_errors(poses, result.truth, np.zeros(3))
        figures.append((f"{off.max_rotation_deg:.2f}°", "largest rotation error"))
    cells = "".join(f"<div><b>{value}</b>{words}</div>" for value, words in figures)
    where = escape(str(report["sequence"]))
    return (
        f"<h1>{escape(_name(result))}</h1><p class='quiet'>{where}, prior {escape(report['prior'])}, seed "
        f"{report['seed']}</p>{verdict}<div class='figures'>{cells}</div>{_evidence(report.get('evidence') or {})}"
    )


_CHECKS: Final = {
    "unsure_masks": ("frames with an unsure mask", 100.0, " %"),
    "motion_m": ("largest motion of the surface", 1000.0, " mm"),
    "prior_sds": ("farthest pair from what the prior expects", 1.0, " sd"),
    "loop_sigmas": ("widest open loop, before optimisation", 1.0, " sd"),
    "graph_chi2": ("squared residuals of the edges over their covariances", 1.0, ""),
    "seen_through": ("surface of a frame that others see through", 100.0, " %"),
    "absent": ("surface of a frame that most others that look see through", 100.0, " %"),
    "other_modes": ("probability of another mode", 100.0, " %"),
}
"""Figures of the evidence in words, each with the factor to its unit."""


def _evidence(evidence: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the figures behind the verdict beside their limits; "" for runs of earlier versions."""
    rows = []
    for name, figure in evidence.items():
        words, factor, unit = _CHECKS.get(name, (name.replace("_", " "), 1.0, ""))
        value, limit = (
            "unknown" if number is None else f"{factor * number:.3g}{unit}"
            for number in (figure["value"], figure["limit"])
        )
        bound = "at least" if figure.get("at_least") else "at most"
        mark = "holds" if figure["holds"] else "<b class='no'>does not hold</b>"
        rows.append(
            f"<tr><th>{escape(words)}</th><td>{value}</td><td class='quiet'>{bound} {limit}</td><td>{mark}</td></tr>"
        )
    return f"<table class='evidence'>{''.join(rows)}</table>" if rows else ""


def _model(result: Result, mesh: Mesh | None) -> Sequence[str]:
    """Return the mesh in its viewer, over a picture of it for browsers that draw no surfaces."""
    if mesh is None:
        return ["<h2>Model</h2><p>This run has no mesh.</p>"]
    cameras = [_pyramid(pose.mean) for pose in result.poses.values()]
    object_from_upright = model_upright(result.report)
    data = json.dumps(scene(mesh, cameras, object_from_upright))
    paints = {"colours": "colour", "certainty": "standard deviation", "plain": "plain"}
    known = [name for name in paints if name == "plain" or getattr(mesh, name) is not None]
    options = "".join(f"<option value='{name}'>{paints[name]}</option>" for name in known)
    made_coarser = "" if len(mesh.triangles) == mesh.total else f", shown with {len(mesh.triangles):,}"
    return [
        "<h2>Model</h2><figure><div class='stage'>"
        f"<canvas id='mesh' style='background-image:url({_poster(mesh, object_from_upright)})'></canvas>"
        f"<div class='switches'><span id='scale' hidden>sd {_scale()} {1000.0 * MOST_SIGMA_M:g} mm, "
        f"<span class='pink'>pink: not seen</span></span><select id='paint'>{options}</select>"
        "<label><input type='checkbox' id='cameras'> cameras</label></div></div>"
        f"<figcaption id='mesh-note'>The fused mesh, {mesh.total:,} triangles{made_coarser}. Drag to rotate, scroll to "
        "zoom, Shift and drag to pan, double-click to reset. Back faces of open surfaces are reddish.</figcaption>"
        "</figure>",
        f"<script type='application/json' id='scene'>{data}</script>",
        f"<script>{_asset('mesh_viewer.js')}</script>",
    ]


def _trajectory(result: Result, mesh: Mesh | None, centre_m: Array) -> Sequence[str]:
    """Return the camera poses and their uncertainty."""
    shape_m = np.zeros((0, 3)) if mesh is None else mesh.vertices_m
    shape_m = shape_m[:: max(len(shape_m) // _SHAPE_POINTS, 1)]
    return [
        "<h2>Camera poses</h2>",
        figure(
            plots.trajectory(result, shape_m),
            "Camera positions in the object frame; the black dot is the first frame. Ellipses are 3 sd regions of the "
            "positions, to scale. Grey: the object.",
        ),
        "<h2>Uncertainty</h2>",
        figure(
            plots.uncertainty(result, centre_m),
            "Standard deviation (sd) along the least certain axis: of each edge, and of each pose relative to the "
            "first frame, before loop closure (chain of consecutive edges) and after optimisation. The gap between the "
            "two lines is the effect of loop closure.",
        ),
    ]


def _closure(result: Result, rows: Mapping[str, Mapping[int, Row]]) -> Sequence[str]:
    """Return the merged points before and after loop closure, if there was one and the recording has the points."""
    surfaces_m = surfaces(rows)
    seen = sum(frame in surfaces_m for frame in result.poses)  # of joined runs the recording has one pair alone
    if 2 * seen < len(result.poses) or not any(edge.kind == "closure" and edge.accepted for edge in result.edges):
        return []
    return [
        "<h2>Merged points</h2>",
        figure(
            plots.merged_clouds(result, surfaces_m),
            "Points of all frames, merged by the poses before loop closure (left) and after optimisation (right), "
            "coloured by frame from dark to bright. Where the loop was open before closure, bright points lie "
            "apart from dark ones.",
            kind="png",
        ),
    ]


def _accuracy(result: Result, centre_m: Array) -> Sequence[str]:
    """Return errors and coverage where the truth is known."""
    if result.true_pose(result.first) is None or not plots.edge_estimates(result):
        return [
            "<h2>Errors</h2><p>There is no ground truth (no scene_gt.json in the sequence, or the sequence has moved), "
            "so errors cannot be shown.</p>"
        ]
    nees = [evaluation.nees(pose, truth) for pose, truth in plots.edge_estimates(result)]
    inside = evaluation.coverage(nees)[0.95]
    return [
        "<h2>Errors against ground truth</h2>",
        figure(
            plots.errors(result, centre_m),
            "Lines: errors relative to the first frame. Bands: the estimated sd along the least certain axis. Errors "
            "far above their band mean that the covariances are too small, or that the ground truth is inaccurate.",
        ),
        "<h2>Calibration of the covariances</h2>",
        figure(
            plots.coverage(result),
            "Share of true poses inside the region of a given probability. On the diagonal: calibrated; below: "
            "overconfident; above: conservative; grey: expected scatter. The 95 % regions of "
            f"{100.0 * inside:.0f} % of the {len(nees)} edges contain the truth.",
            style="half",
            kind="png",
        ),
    ]


def _settings(result: Result) -> str:
    """Return the settings, versions and times of the run, and the frames left out."""
    report = result.report
    rows = {"sequence": report["sequence"], "seed": report["seed"], "prior": report["prior"], **report["settings"]}
    if rows.get("frames") == ":":
        rows["frames"] = "all"
    rows |= {f"seconds, {part}": f"{seconds:.1f}" for part, seconds in report["seconds"].items() if seconds is not None}
    rows |= {f"version of {name}": version for name, version in report["versions"].items()}
    lost = [frame for frame in report["frames"] if frame["outcome"] != ACCEPTED]
    rows |= {f"frame {frame['id']} left out": frame["outcome"] for frame in lost}
    unsure = [str(frame["id"]) for frame in report["frames"] if frame.get("mask") == Outcome.UNSURE_MASK.label]
    rows |= {"frames with an unsure mask": ", ".join(unsure)} if unsure else {}
    lines = "".join(
        f"<tr><th>{escape(str(key).replace('_', ' '))}</th><td>{escape(str(value))}</td></tr>"
        for key, value in rows.items()
    )
    return f"<h2>Settings</h2><table>{lines}</table>"


def _name(result: Result) -> str:
    """Return the name of the sequence, of joined runs the names of all."""
    where = str(result.report["sequence"])
    parts = where.split(" + ") if "joined" in result.report["settings"] else [where]
    return " + ".join(Path(part).name for part in parts) or "model"


def _pyramid(object_from_camera: Array) -> Array:
    """Return a camera (n, 3) as one line in the object frame."""
    size_m = _CAMERA_SHARE * max(float(np.linalg.norm(object_from_camera[:3, 3])), 0.3)
    corners = size_m * np.array([[-0.55, -0.4, 1.0], [0.55, -0.4, 1.0], [0.55, 0.4, 1.0], [-0.55, 0.4, 1.0]])
    tip = np.zeros(3)
    outline = [tip, *corners, corners[0], tip, corners[1], corners[2], tip, corners[3]]
    return se3.transform(object_from_camera, np.array(outline))


def _poster(mesh: Mesh, object_from_upright: Array) -> str:
    """Return a still picture of the mesh as a data address."""
    away = object_from_upright @ _ABOVE_LEFT
    camera = look_at(mesh.centre_m, away, 4.2 * mesh.radius_m, -object_from_upright[:, 1])
    picture = shade(mesh.vertices_m, mesh.triangles, mesh.colours, camera, (460, 1048))
    content = io.BytesIO()
    Image.fromarray(picture).save(content, "JPEG", quality=85)
    return data_address(content.getvalue(), "jpeg")


def _scale() -> str:
    """Return the colour scale of standard deviations."""
    from matplotlib import colormaps

    stops = ",".join(
        f"rgb({r:.0f},{g:.0f},{b:.0f})" for r, g, b, _ in 255.0 * colormaps["cividis"](np.linspace(0, 1, 9))
    )
    return f"0 <i style='background:linear-gradient(90deg,{stops})'></i>"


def _asset(name: str) -> str:
    return (resources.files("viz.report") / name).read_text(encoding="utf-8")


def pair_cards(result: Result, pictures: Mapping[int, Thumbnails], centre_m: Array) -> Sequence[str]:
    """Return every pair with its pictures, its outcome and why it was or was not joined, as HTML.

    Args:
        result: the run.
        pictures: by frame number.
        centre_m: (3,) the object's centre, in the object frame.
    """
    note = (
        "From left: the frame; its surface (<span class='orange'>orange</span>) and that of the view it is registered "
        "to (<span class='teal'>teal</span>) before and after alignment."
        if pictures
        else "There are no pictures because recording.rrd is missing."
    )
    cards = [
        _pair_card(result, edge, record, pictures.get(edge.source), centre_m)
        for edge, record in zip(result.edges, result.report["edges"], strict=True)
    ]
    return [f"<h2>Pairs</h2><p class='quiet'>{note}</p><div class='pairs'>{''.join(cards)}</div>"]


def _mode_words(modes: Sequence[Mapping[str, Any]]) -> str:
    """Return how the probability is shared among the modes of an edge, where there are several."""
    if len(modes) < 2:
        return ""
    shares = [f"{100.0 * mode['weight']:.0f} %" for mode in modes]
    left = [f"{100.0 * mode['weight_in_graph']:.0f} %" for mode in modes if mode.get("weight_in_graph") is not None]
    graph = f"; in the pose graph {', '.join(left)}" if left else ""
    return f"<p>{len(modes)} modes: {', '.join(shares)}{graph}.</p>"


def _pair_card(
    result: Result, edge: Edge, record: Mapping[str, Any], pictures: Thumbnails | None, centre_m: Array
) -> str:
    posterior = edge.posterior
    shown = ""
    if pictures is not None and edge.kind == "odometry":
        images = [image for image in (pictures.colour, pictures.before, pictures.after) if image is not None]
        shown = "".join(f"<img src='{data_address(image, 'jpeg')}' alt=''>" for image in images)
        shown = f"<div class='pictures'>{shown}</div>"
    seen_m = centre_m
    if edge.source in result.poses:
        seen_m = se3.transform(se3.inverse(result.poses[edge.source].mean), centre_m[None])[0]
    facts = [
        f"turned by {np.degrees(se3.rotation_angle(posterior.pose.mean)):.1f}°",
        *certainty_words(posterior, seen_m),
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


_SIZE: Final = (150, 200)  # height and width in px
_JPEG_QUALITY: Final = 82
_BACKGROUND: Final = 250
_DOT: Final = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])  # pixels of a point


@dataclass(frozen=True)
class Thumbnails:
    """Small pictures of a frame as JPEG; None where there is nothing to show."""

    colour: bytes | None
    """What the camera saw."""
    before: bytes | None
    """The frame's surface and that of the view it was registered to, both in their own camera's coordinates."""
    after: bytes | None
    """The same under the mean of the posterior."""


def thumbnails(rows: Mapping[str, Mapping[int, Row]]) -> dict[int, Thumbnails]:
    """Return the pictures by frame number.

    Args:
        rows: what the recording holds, as `recorded` returns it.
    """
    frames = sorted({frame for entity in rows.values() for frame in entity})
    return {frame: _of_frame({path: rows[path].get(frame, {}) for path in FRAME_PATHS}) for frame in frames}


def _of_frame(rows: Mapping[str, Row]) -> Thumbnails:
    blob = rows[entities.COLOUR].get("blob")
    colour = None if blob is None else _small(bytes(blob.values[0].values.to_numpy()))
    target, before, after = (cloud(rows[path]) for path in FRAME_PATHS[1:])
    if target is None or before is None or after is None:
        return Thumbnails(colour, None, None)
    return Thumbnails(colour, _pair_picture(target, before), _pair_picture(target, after))


def _pair_picture(*clouds: tuple[Array, npt.NDArray[np.uint8]]) -> bytes:
    """Return two clouds seen from the side, nearer points over farther ones; the first says where to look."""
    points = np.concatenate([cloud for cloud, _ in clouds])
    colours = np.concatenate([colour for _, colour in clouds])
    forward = -FROM_THE_SIDE / np.linalg.norm(FROM_THE_SIDE)
    right = np.cross(np.array([0.0, 1.0, 0.0]), forward)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward])
    centre = clouds[0][0].mean(axis=0)
    seen = (points - centre) @ axes.T
    reach_m = float(np.percentile(np.abs((clouds[0][0] - centre) @ axes.T), 99.5))
    height, width = _SIZE
    places = np.rint(seen[:, :2] * (0.40 * height / max(reach_m, 1e-9)) + 0.5 * np.array([width, height]))
    order = np.repeat(np.argsort(-seen[:, 2], kind="stable"), len(_DOT))
    picture = np.full((height, width, 3), _BACKGROUND, dtype=np.uint8)
    columns, rows = (places[order] + np.tile(_DOT, (len(points), 1))).astype(np.int64).T
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    picture[rows[inside], columns[inside]] = colours[order][inside]
    return _jpeg(Image.fromarray(picture))


def _small(jpeg: bytes) -> bytes:
    picture = Image.open(io.BytesIO(jpeg))
    height, width = _SIZE
    picture.thumbnail((width, height))
    return _jpeg(picture)


def _jpeg(picture: Image.Image) -> bytes:
    content = io.BytesIO()
    picture.save(content, "JPEG", quality=_JPEG_QUALITY)
    return content.getvalue()


def figure(picture: bytes, caption: str, *, style: str = "", kind: str = "svg+xml") -> str:
    """Return a picture with a caption.

    Args:
        picture: the file's bytes.
        caption: in HTML.
        style: the picture's class.
        kind: its media type, after `image/`.
    """
    image = f"<img class='{style}' src='{data_address(picture, kind)}' alt=''>"
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"


def data_address(content: bytes, kind: str) -> str:
    """Return an address that is the picture itself, whose media type is `image/` and `kind`."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
