"""A run as one page that opens anywhere, and the values behind its verdict, each with an explanation and its limit."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from modeler import evaluation, se3
from modeler.export import read_model, write_atomically
from modeler.export.mesh import MOST_SIGMA_M
from modeler.export.placing import model_up, model_upright
from modeler.fusion import Symmetries, SymmetryFinder
from modeler.types import ACCEPTED, Array, InputError, Outcome, loops_closed
from modeler.verdict.advice import contradicted_focal_length
from modeler.viz.drawings import VIEW_POINTS, pyramid
from modeler.viz.report import plots
from modeler.viz.report.cards import data_address, mask_cards, pair_cards, thumbnails
from modeler.viz.report.mesh import Mesh, portrait, read_mesh, scene
from modeler.viz.report.run_data import Result, Row, recorded, surfaces

_SYMMETRIES: Final = (
    "Rotations that map the model onto itself: in any two of these poses it looks the same, so that a pose estimator "
    "cannot tell one from the other. Unobserved surface is not compared."
)

_VERTICAL: Final = "the vertical"


def write_page(run: Path, out: Path, truth: Mapping[int, Array] | None = None) -> None:
    """Write a self-contained page about a run.

    Args:
        run: the run folder.
        out: file to write.
        truth: camera_from_model (4, 4) by frame number, where it is known.

    Raises:
        InputError: if the folder holds no run, no frame was accepted, or the file cannot be written.
    """
    result = Result.read(run, truth)
    mesh = read_mesh(run / "model.ply")
    centre_m = se3.transform(result.poses[result.first].mean, np.zeros((1, 3)))[0] if mesh is None else mesh.centre_m
    rows = recorded(run / "recording.rrd")
    parts = [_head(result, mesh), *_model(result, mesh), evidence_table(result.report.get("evidence") or {})]
    parts += [*symmetry_section(run / "model.ply", result.report), *_trajectory(result, mesh, centre_m)]
    pictures = thumbnails(rows, result.report)
    parts += [*_closure(result, rows), *_accuracy(result, centre_m), *mask_cards(result, pictures)]
    parts += pair_cards(result, pictures, centre_m)
    parts.append(_settings(result))
    save_page(out, escape(f"{_name(result)}: model report"), parts)


def save_page(out: Path, title: str, parts: Sequence[str]) -> None:
    """Write a page of a title and parts in HTML."""
    write_atomically(out, Template(asset("page.html")).substitute(title=title, body="\n".join(parts)))


def _loop_closure_error(loop: Mapping[str, float] | None) -> list[tuple[str, str, str]]:
    """Return the loop closure error as a key value; nothing without a closed loop."""
    if loop is None:
        return []
    value = f"{loop['opening_deg']:.1f}°, {loop['sigmas']:.1f} sd"
    why = "by how much the chain of pairs misses its start; 1 sd (standard deviation) is expected"
    return [(value, "loop closure error, before optimisation", why)]


def _focal_length(camera: Mapping[str, Any] | None) -> list[tuple[str, str, str]]:
    """Return the estimate of the focal length as a key value; nothing if it is exact."""
    if camera is None or not (fx_px := camera.get("fx_px")):
        return []
    value = f"{fx_px:.1f} ± {fx_px * camera['focal_factor_sigma']:.1f} px"
    if not camera["loops"]:
        return [
            (value, "focal length", "as given: not observable without a loop; its uncertainty is part of the poses'")
        ]
    why = (
        f"{fx_px / camera['factor_in_run']:.1f} px was given; loop closure error {camera['sigmas_after']:.1f} sd with "
        f"this one, {camera['sigmas_before']:.1f} sd as given; poses and surface are those under this one"
    )
    why = "; ".join(filter(None, (why, contradicted_focal_length(camera))))
    return [(value, "focal length, estimated from loops", why)]


def _colour(colour: Mapping[str, Any] | None) -> list[tuple[str, str, str]]:
    """Return where colour is against depth as key values; nothing where it is not known."""
    if colour is None:
        return []
    across, down = (f"{px:.1f} ± {sd:.1f}" for px, sd in zip(colour["shift_px"], colour["shift_sigma_px"], strict=True))
    how = [f"colour is {colour['flip']}"] if colour["flip"] else []
    how += [f"colour is of the frame {'after' if colour['frames'] > 0 else 'before'}"] if colour["frames"] else []
    why = "by print that several frames show; right and down, and a shift along the axis of all turns is not observable"
    scale = f"{100.0 * (colour['scale'] - 1.0):.1f} ± {100.0 * colour['scale_sigma']:.1f} %"
    return [
        (f"{across}, {down} px", "shift of colour against depth", "; ".join([*how, why])),
        (scale, "by how much colour shows things larger than depth", "about the middle of the image"),
    ]


def _head(result: Result, mesh: Mesh | None) -> str:
    """Return name, verdict and key figures."""
    report = result.report
    reasons = "".join(f"<li>{escape(reason)}</li>" for reason in report["reasons"])
    remedies = "".join(f"<p>What to do: {escape(words)}</p>" for words in report.get("remedies", ()))
    verdict = (
        '<p class="verdict">All frames were placed and all checks passed.</p>'
        if report["trustworthy"]
        else f'<div class="verdict no">Do not trust this model:<ul>{reasons}</ul>{remedies}</div>'
    )
    closed = loops_closed([edge for edge in result.edges if edge.accepted])
    total_s = report["seconds"].get("total")
    figures = [
        (f"{len(result.poses)} of {len(report['frames'])}", "frames placed", "registered well enough to have a pose"),
        (
            str(closed),
            "loop closed" if closed == 1 else "loops closed",
            "a view was registered to one that the object had turned away from",
        ),
        *_loop_closure_error(report.get("loop")),
        *_focal_length(report.get("camera")),
        *_colour(report.get("colour")),
        ("none" if mesh is None else f"{mesh.total:,}", "triangles", "of the fused mesh"),
        ("unknown" if total_s is None else f"{total_s:.0f} s", "build time", "reading and writing included"),
    ]
    if result.true_pose(result.first) is not None:
        poses = {k: pose.mean for k, pose in result.poses.items() if result.true_pose(k) is not None}
        off = evaluation.trajectory_errors(poses, result.truth, np.zeros(3))
        aligned = evaluation.align_to_model(poses, result.truth)
        least_deg = max(
            evaluation.rotation_error_deg(aligned @ pose, se3.inverse(result.truth[k])) for k, pose in poses.items()
        )
        why = (
            f"of a pose relative to the first, whose own error is in all others; {least_deg:.2f}° if all are aligned "
            "to the truth together, as by <code>modeler evaluate</code>"
        )
        figures.append((f"{off.max_rotation_deg:.2f}°", "largest rotation error", why))
    where = escape(str(report["sequence"]))
    return (
        f"<h1>{escape(_name(result))}</h1><p class='quiet'>{where}, prior {escape(report['prior'])}, seed "
        f"{report['seed']}</p>{verdict}{key_figures(figures)}"
    )


def key_figures(figures: Iterable[tuple[str, str, str]]) -> str:
    """Return values in HTML, each with its name and what it means."""
    cells = "".join(f"<div><b>{value}</b>{words}<p class='quiet'>{why}</p></div>" for value, words, why in figures)
    return f"<div class='figures'>{cells}</div>"


def _model(result: Result, mesh: Mesh | None) -> Sequence[str]:
    """Return the mesh in its viewer, over a picture of it for browsers that draw no surfaces."""
    if mesh is None:
        return ["<h2>Model</h2><p>This run has no mesh.</p>"]
    cameras = [_pyramid(pose.mean) for pose in result.poses.values()]
    object_from_upright = model_upright(result.report)
    data = json.dumps(scene(mesh, cameras, object_from_upright))
    poster = data_address(portrait(mesh, object_from_upright, (460, 1048)), "jpeg")
    paints = {"colours": "colour", "certainty": "standard deviation", "plain": "plain"}
    known = [name for name in paints if name == "plain" or getattr(mesh, name) is not None]
    options = "".join(f"<option value='{name}'>{paints[name]}</option>" for name in known)
    made_coarser = "" if len(mesh.triangles) == mesh.total else f", shown with {len(mesh.triangles):,}"
    return [
        "<h2>Model</h2><figure><div class='stage'>"
        f"<canvas id='mesh' style='background-image:url({poster})'></canvas>"
        f"<div class='switches'><span id='scale' hidden>sd {_scale()} {1000.0 * MOST_SIGMA_M:g} mm, "
        f"<span class='pink'>pink: not seen</span></span><select id='paint'>{options}</select>"
        "<label><input type='checkbox' id='cameras'> cameras</label></div></div>"
        f"<figcaption id='mesh-note'>The fused mesh, {mesh.total:,} triangles{made_coarser}. Drag to rotate, scroll to "
        "zoom, Shift and drag to pan, double-click to reset. Back faces of open surfaces are reddish.</figcaption>"
        "</figure>",
        f"<script type='application/json' id='scene'>{data}</script>",
        f"<script>{asset('mesh_viewer.js')}</script>",
    ]


def _trajectory(result: Result, mesh: Mesh | None, centre_m: Array) -> Sequence[str]:
    """Return the camera poses and their uncertainty."""
    shape_m = np.zeros((0, 3)) if mesh is None else mesh.vertices_m
    shape_m = shape_m[:: max(len(shape_m) // VIEW_POINTS, 1)]
    return [
        "<h2>Camera poses</h2>",
        figure(
            plots.trajectory(result, shape_m),
            "Camera positions in the object frame, as if the object stood still; the black dot is the first frame. "
            "Ellipses hold the position within 3 standard deviations (sd), that is with 99 %, and are drawn to scale. "
            "Grey: the object.",
        ),
        "<h2>Uncertainty</h2>",
        figure(
            plots.uncertainty(result, centre_m),
            "Standard deviation (sd) along the least certain axis: of each edge (the relative pose of two frames by "
            "registration), and of each pose relative to the first frame, before loop closure (edges of "
            "consecutive frames, one after another, so that their errors add up) and after the pose graph of all edges "
            f"was optimised. {_effect(result, centre_m)}",
        ),
    ]


def _effect(result: Result, centre_m: Array) -> str:
    """Return in words what loop closure did to the uncertainty of the poses."""
    both = (result.chain, result.poses)
    before, after = (np.array([astuple(sd) for sd in plots.sds(poses, centre_m)]).max(axis=0) for poses in both)
    if (after <= before).all():
        return "The gap between the two lines is the effect of loop closure."
    return (
        "Poses may be less certain after optimisation than before: then the loops showed that errors are larger than "
        "the edges state, or that all edges share some, such as that of the focal length."
    )


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
            "Lines: errors relative to the first frame. Bands: 95 % of the errors are inside if the covariances are "
            "right. The error of the first frame is in all of them, so that many may leave the band together. Errors "
            "far above it mean that the covariances are too small, or that the ground truth is inaccurate.",
        ),
        "<h2>Calibration of the covariances</h2>",
        figure(
            plots.coverage(result),
            "A covariance defines regions that contain the true pose with a given probability; the curves are the "
            "shares of true poses inside. On the diagonal: calibrated; below: "
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
    parts = where.split(" + ") if {"joined", "continues"} & result.report["settings"].keys() else [where]
    return " + ".join(Path(part).name for part in parts) or "model"


def _pyramid(object_from_camera: Array) -> Array:
    """Return a camera (n, 3) as one line in the object frame, as long as 12 % of its distance."""
    size_m = 0.12 * max(float(np.linalg.norm(object_from_camera[:3, 3])), 0.3)
    corners = size_m * np.array([[-0.55, -0.4, 1.0], [0.55, -0.4, 1.0], [0.55, 0.4, 1.0], [-0.55, 0.4, 1.0]])
    return se3.transform(object_from_camera, pyramid(corners))


def _scale() -> str:
    """Return the colour scale of standard deviations."""
    from matplotlib import colormaps

    stops = ",".join(
        f"rgb({r:.0f},{g:.0f},{b:.0f})" for r, g, b, _ in 255.0 * colormaps["cividis"](np.linspace(0, 1, 9))
    )
    return f"0 <i style='background:linear-gradient(90deg,{stops})'></i>"


def asset(name: str) -> str:
    """Return the text of a file that pages are made of."""
    return (resources.files("modeler.viz.report") / name).read_text(encoding="utf-8")


def figure(picture: bytes, caption: str, *, style: str = "", kind: str = "svg+xml") -> str:
    """Return a picture, of media type `image/` and `kind`, with a caption in HTML."""
    image = f"<img class='{style}' src='{data_address(picture, kind)}' alt=''>"
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"


def symmetry_section(path: Path, report: Mapping[str, Any]) -> Sequence[str]:
    """Return the symmetries of the mesh in a file as HTML; nothing where it has none that can be drawn."""
    try:
        model = read_model(path)
    except InputError:
        return []
    up = model_up(report)[0]
    found = SymmetryFinder().find_in(model, up)
    rows = [(f"of the shape, within {1000.0 * found.tolerance_m:.1f} mm", rotation_words(found, up))]
    if found.seen_in_part:
        rows.append(("seen in part", "it looks like a body of revolution, but was not seen all around"))
    if found.with_colour is not None:
        rows.append(("of shape and colour", rotation_words(found.with_colour, up)))
    cells = "".join(f"<tr><th>{words}</th><td>{value}</td></tr>" for words, value in rows)
    return [f"<h2>Symmetries</h2><p class='quiet'>{_SYMMETRIES}</p><table>{cells}</table>"]


def rotation_words(found: Symmetries, up: Array) -> str:
    """Return the rotations in words, those about one axis together; `up` (3,) is the vertical."""
    if len(found.continuous) > 1:
        return "every rotation about its centre"
    said = [f"any angle about {_axis_words(axis.direction, up)}" for axis in found.continuous]
    by_axis: dict[str, list[float]] = {}
    for pose in found.discrete:
        vector = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
        angle_deg, words = float(np.degrees(np.linalg.norm(vector))), _axis_words(vector, up)
        downwards = words == _VERTICAL and vector @ up < 0.0
        by_axis.setdefault(words, []).append(360.0 - angle_deg if downwards else angle_deg)
    for words, angles_deg in by_axis.items():
        angles = sorted({round(angle) for angle in angles_deg})
        said.append(f"{', '.join(f'{angle}°' for angle in angles)} about {words}")
    return "; ".join(said) or "none"


def _axis_words(direction: Array, up: Array) -> str:
    """Return which way an axis (3,) of any length runs."""
    tilt_deg = float(np.degrees(np.arccos(min(1.0, abs(float(direction @ up)) / np.linalg.norm(direction)))))
    if tilt_deg < 5.0:
        return _VERTICAL
    return "level axes" if tilt_deg > 85.0 else f"axes {tilt_deg:.0f}° off the vertical"


CHECKS: Final = {  # name of a value, meaning of one beyond its limit, unit as written behind the number
    "unsure_masks": (
        "frames with an unsure mask",
        "The object could not be segmented reliably. If this is the rule, anything may have been modelled.",
        " %",
    ),
    "motion_m": (
        "largest motion of the surface",
        "From the first frame to any other. If it does not exceed the sensor's noise, the object did not turn.",
        " mm",
    ),
    "prior_sds": (
        "largest distance of a pair from the prior",
        "The prior describes the motion before the images are compared. Many standard deviations (sd) from it are a "
        "contradiction.",
        " sd",
    ),
    "prior_chi2": (
        "mean squared distance of all pairs from the prior",
        "In units of the prior's variance. The mean reveals many small deviations to one side, such as from a wrong "
        "step.",
        "",
    ),
    "loop_sigmas": (
        "largest loop closure error, before optimisation",
        "By how much the chain of consecutive pairs misses an earlier view, in sd of its covariances; 1 is expected. "
        "More: a wrong pair, or errors common to all pairs, such as from a wrong focal length.",
        " sd",
    ),
    "graph_chi2": (
        "mean squared residual of the edges",
        "Distance of the registrations from the optimised poses, in units of their variance; 1 is expected.",
        "",
    ),
    "free_space_violations": (
        "free-space violations: surface of a frame in the free space of others",
        "Another frame measured something behind it, although it should occlude that: one of the two poses is wrong.",
        " %",
    ),
    "false_surface": (
        "false surface: surface of a frame contradicted by others",
        "It lies in the free space of most frames that observe it: the pose of this frame is wrong, or its mask "
        "includes more than the object.",
        " %",
    ),
    "colour_fit": (
        "agreement of colours on surface that two frames see",
        "Correlation of the print, as a share of the best one with colour shifted, scaled, mirrored or of another "
        "frame. Less: colour is not aligned to depth.",
        " %",
    ),
    "print_fit": (
        "agreement of print between frames that match",
        "Least correlation of two frames that no chain of agreeing ones joins, as a share of that of others. Less: "
        "they show different sides.",
        " %",
    ),
    "flat_frames": (
        "frames that match the others by one flat face",
        "Another side of a box matches as well, and neither print nor the given motion excludes it.",
        "",
    ),
    "pose_sd_deg": ("largest sd of a pose's rotation", "At the limit, one pose in twenty is off by more than 3°.", "°"),
    "pose_sd_m": (
        "largest sd of a pose's position",
        "At the limit, one pose in twenty displaces the surface by more than the tolerance.",
        " mm",
    ),
    "size_m": (
        "surface error due to unknown scale",
        "Loops cannot distinguish a wrong focal length from too flat a depth relief, and sizes depend on which it is.",
        " mm",
    ),
    "other_modes": (
        "probability of another mode",
        "If several poses explain a pair of images, as for symmetric objects, each is a mode. This is the probability "
        "that some pair is at another mode than the model assumes.",
        " %",
    ),
}


def evidence_table(evidence: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the values with their limits as HTML; "" for runs of earlier versions."""
    rows = [_row(CHECKS.get(name, (name.replace("_", " "), "", "")), figure) for name, figure in evidence.items()]
    if not rows:
        return ""
    return f"<h2>Checks</h2><table class='evidence'>{''.join(rows)}</table>"


def _row(check: tuple[str, str, str], figure: Mapping[str, Any]) -> str:
    """Return a figure as a row of a table."""
    words, why, unit = check
    factor = {" %": 100.0, " mm": 1000.0}.get(unit, 1.0)
    value, limit = (
        "unknown" if number is None else f"{factor * number:.3g}{unit}" for number in (figure["value"], figure["limit"])
    )
    bound = "at least" if figure.get("at_least") else "at most"
    mark = "holds" if figure["holds"] else "<b class='no'>does not hold</b>"
    return (
        f"<tr><th>{escape(words)}<p class='quiet'>{escape(why)}</p></th><td>{value}</td>"
        f"<td class='quiet'>{bound} {limit}</td><td>{mark}</td></tr>"
    )
