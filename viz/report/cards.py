"""A card for each pair of views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from modeler import evaluation, se3
from modeler.types import Array, Edge, explain
from viz import certainty
from viz.report.elements import data_address
from viz.report.pairs import Thumbnails
from viz.report.result import Result


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
        else "There are no pictures, for recording.rrd is missing."
    )
    cards = [
        _pair(result, edge, record, pictures.get(edge.source), centre_m)
        for edge, record in zip(result.edges, result.report["edges"], strict=True)
    ]
    return [f"<h2>Pairs</h2><p class='quiet'>{note}</p><div class='pairs'>{''.join(cards)}</div>"]


def _mode_words(modes: Sequence[Mapping[str, Any]]) -> str:
    """Return how the probability is shared among the modes of an edge, where there are several."""
    if len(modes) < 2:
        return ""
    shares = [f"{100.0 * mode['weight']:.0f} %" for mode in modes]
    left = [f"{100.0 * mode['weight_in_graph']:.0f} %" for mode in modes if mode.get("weight_in_graph") is not None]
    graph = f"; all edges together leave {', '.join(left)}" if left else ""
    return f"<p>{len(modes)} modes: {', '.join(shares)}{graph}.</p>"


def _pair(result: Result, edge: Edge, record: Mapping[str, Any], pictures: Thumbnails | None, centre_m: Array) -> str:
    posterior = edge.posterior
    shown = ""
    if pictures is not None and edge.kind == "odometry":
        images = [image for image in (pictures.colour, pictures.before, pictures.after) if image is not None]
        shown = "".join(f"<img src='{data_address(image, 'jpeg')}' alt=''>" for image in images)
        shown = f"<div class='pictures'>{shown}</div>"
    seen_m = centre_m
    if edge.source in result.poses:
        seen_m = se3.transform(se3.inverse(result.poses[edge.source].mean), centre_m[None])[0]
    facts = certainty.words(posterior, seen_m)
    truth = result.true_motion(edge)
    if truth is not None:
        facts += [
            f"rotation off by {evaluation.rotation_error_deg(posterior.pose.mean, truth):.2f}°",
            f"translation by {1000.0 * evaluation.translation_error_m(posterior.pose.mean, truth, seen_m):.1f} mm",
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
