"""The page about many models."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import Any, Final

from modeler.export import write_atomically
from modeler.viz.report import asset

_SHOWN: Final = {
    "name": ("name", 1.0, ""),
    "frames": ("frames", 1.0, ""),
    "accepted": ("frames placed", 1.0, ""),
    "opening_deg": ("loop closure error", 1.0, "°"),
    "opening_sigmas": ("loop closure error, in sd", 1.0, " sd"),
    "rotation_error_deg": ("largest rotation error", 1.0, "°"),
    "translation_error_m": ("largest translation error", 1000.0, " mm"),
    "width_m": ("width", 1000.0, " mm"),
    "height_m": ("height", 1000.0, " mm"),
    "depth_m": ("depth", 1000.0, " mm"),
    "volume_m3": ("volume", 1e6, " cm³"),
    "surface_sigma_m": ("sd of the surface", 1000.0, " mm"),
    "pose_sigma_deg": ("largest sd of a rotation", 1.0, "°"),
    "triangles": ("triangles", 1.0, ""),
    "seconds": ("build time", 1.0, " s"),
}
"""Columns of the list of models, each in words, with the factor to its unit."""


def write_gallery(
    out: Path,
    title: str,
    rows: Sequence[Mapping[str, Any]],
    pictures: Mapping[str, bytes],
    links: Mapping[str, str],
) -> None:
    """Write a self-contained page.

    Args:
        out: file to write.
        title: of the page.
        rows: one a sequence, as the list of models has them.
        pictures: JPEG by name, of those that have a model.
        links: addresses by name, relative to the page.
    """
    models = [
        {
            "status": row["status"],
            "why": row["failure"] or "; ".join(row["reasons"] or ()),
            "link": links.get(row["name"]),
            "values": [_rounded(row[column], factor) for column, (_, factor, _) in _SHOWN.items()],
        }
        for row in rows
    ]
    coded = [base64.b64encode(pictures.get(row["name"], b"")).decode() for row in rows]
    columns = [{"words": words, "unit": unit} for words, _, unit in _SHOWN.values()]
    page = Template(asset("gallery.html")).substitute(
        title=escape(title), columns=_script(columns), models=_script(models), pictures=_script(coded)
    )
    write_atomically(out, page)


def _rounded(value: Any, factor: float) -> Any:
    """Return a number in its unit, to four digits; other values unchanged."""
    return float(f"{factor * value:.4g}") if isinstance(value, float) else value


def _script(value: Any) -> str:
    """Return a value as a script has it: nothing in it ends the script."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
