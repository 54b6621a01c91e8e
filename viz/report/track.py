"""The page about an object that was tracked: what was found in each frame, how surely, and where."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from modeler import se3
from modeler.types import Array
from modeler.viz.report import key_figures, save_page
from modeler.viz.report.cards import outlined_card, outlined_cards, size_px, with_outline
from modeler.viz.report.run_data import recorded


def write_track_page(folder: Path, out: Path, centre_m: Array) -> None:
    """Write a self-contained page about a track.

    Args:
        folder: of the track, with `poses.json` and, for pictures, `recording.rrd`.
        out: file to write.
        centre_m: (3,) the object's centre in the model's frame, at which the uncertainty of its place is stated.
    """
    track = json.loads((folder / "poses.json").read_text())
    poses, rows = track["poses"], recorded(folder / "recording.rrd")
    cards = []
    for pose in poses:
        picture = with_outline(rows, pose["id"], size_px(len(poses), doubtful=not pose["usable"]))
        if picture is not None:
            cards.append(outlined_card(pose["id"], picture, _doubts(pose)))
    note = (
        "Each frame with the outline of the model in its pose, which should follow the object; a click enlarges it. "
        "Where the object is not there, the outline is that of what was compared with the model."
    )
    name = escape(f"{Path(track['model']).name} in {Path(track['sequence']).name}")
    parts = [f"<h1>{name}</h1>", _verdict(poses), _figures(poses), *outlined_cards("Frames", note, cards)]
    parts.append(_table(poses, centre_m))
    save_page(out, f"{name}: tracking report", parts)


def _doubts(pose: Mapping[str, Any]) -> list[str]:
    """Return why a frame has no pose of use; nothing if it has one."""
    return [] if pose["usable"] else [pose["outcome"], pose["reason"]]


def _verdict(poses: Sequence[Mapping[str, Any]]) -> str:
    """Return whether each frame has a pose of use, or is known not to show the object."""
    doubtful = [pose for pose in poses if not pose["usable"] and pose["outcome"] != "not there"]
    if poses and not doubtful:
        words = "In every frame the object was placed, or found not to be there."
        return f'<p class="verdict">{words}</p>'
    reasons = "".join(f"<li>frame {pose['id']}: {escape(', '.join(_doubts(pose)))}</li>" for pose in doubtful)
    words = f"Poses of {len(doubtful)} of {len(poses)} frames are in doubt:" if poses else "There are no frames."
    return f'<div class="verdict no">{words}<ul>{reasons}</ul></div>'


def _figures(poses: Sequence[Mapping[str, Any]]) -> str:
    usable = sum(pose["usable"] for pose in poses)
    absent = sum(pose["outcome"] == "not there" for pose in poses)
    figures = (
        (f"{usable} of {len(poses)}", "frames placed", "with one pose, but for symmetries, and a small uncertainty"),
        (str(absent), "frames without the object", "no pose of the model explains them"),
        (f"{median([pose['seconds'] for pose in poses] or [0.0]):.2f} s", "a frame", "median, finding and following"),
    )
    return key_figures(figures)


def _table(poses: Sequence[Mapping[str, Any]], centre_m: Array) -> str:
    heads = ("frame", "outcome", "rotation sd", "place sd", "modes", "overlap", "time")
    lines = []
    for pose in poses:
        shares = ", ".join(f"{100.0 * mode['weight']:.0f} %" for mode in pose["modes"]) or "one"
        cells = [str(pose["id"]), pose["outcome"], "", "", "", f"{pose['overlap']:.2f}", f"{pose['seconds']:.2f} s"]
        if pose["camera_from_model"] is not None:
            covariance = se3.covariance_about(np.reshape((pose["modes"] or [pose])[0]["covariance"], (6, 6)), centre_m)
            turn, place = (np.sqrt(np.linalg.eigvalsh(block)[-1]) for block in (covariance[:3, :3], covariance[3:, 3:]))
            cells[2:5] = [f"{np.degrees(turn):.2f}°", f"{1000.0 * place:.2f} mm", shares]
        lines.append("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>")
    note = (
        "Standard deviations (sd) are those of the heaviest mode along the least certain axis; that of the place is at "
        "the object's centre."
    )
    head = "".join(f"<th>{word}</th>" for word in heads)
    return f"<h2>Poses</h2><p class='quiet'>{note}</p><table><tr>{head}</tr>{''.join(lines)}</table>"
