"""The values behind the verdict on a run, each with an explanation and its limit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from typing import Any, Final


@dataclass(frozen=True)
class Check:
    """Description of a value of the evidence."""

    words: str
    """Its name."""
    why: str
    """Meaning of a value beyond its limit."""
    factor: float = 1.0
    """To its unit."""
    unit: str = ""
    """As written behind the number."""


CHECKS: Final = {
    "unsure_masks": Check(
        "frames with an unsure mask",
        "The object could not be segmented reliably. If this is the rule, anything may have been modelled.",
        100.0,
        " %",
    ),
    "motion_m": Check(
        "largest motion of the surface",
        "From the first frame to any other. If it does not exceed the sensor's noise, the object did not turn.",
        1000.0,
        " mm",
    ),
    "prior_sds": Check(
        "largest distance of a pair from the prior",
        "The prior describes the motion before the images are compared. Many standard deviations (sd) from it are a "
        "contradiction.",
        1.0,
        " sd",
    ),
    "prior_chi2": Check(
        "mean squared distance of all pairs from the prior",
        "In units of the prior's variance. The mean reveals many small deviations to one side, such as from a wrong "
        "step.",
    ),
    "loop_sigmas": Check(
        "largest loop closure error, before optimisation",
        "By how much the chain of consecutive pairs misses an earlier view, in sd of its covariances; 1 is expected. "
        "More: a wrong pair, or errors common to all pairs, such as from a wrong focal length.",
        1.0,
        " sd",
    ),
    "graph_chi2": Check(
        "mean squared residual of the edges",
        "Distance of the registrations from the optimised poses, in units of their variance; 1 is expected.",
    ),
    "seen_through": Check(
        "free-space violations: surface of a frame in the free space of others",
        "Another frame measured something behind it, although it should occlude that: one of the two poses is wrong.",
        100.0,
        " %",
    ),
    "absent": Check(
        "false surface: surface of a frame contradicted by others",
        "It lies in the free space of most frames that observe it: the pose of this frame is wrong, or its mask "
        "includes more than the object.",
        100.0,
        " %",
    ),
    "pose_sd_deg": Check(
        "largest sd of a pose's rotation", "At the limit, one pose in twenty is off by more than 3°.", 1.0, "°"
    ),
    "pose_sd_m": Check(
        "largest sd of a pose's position",
        "At the limit, one pose in twenty displaces the surface by more than 5 mm.",
        1000.0,
        " mm",
    ),
    "size_m": Check(
        "surface error due to unknown scale",
        "Loops cannot distinguish a wrong focal length from too flat a depth relief, and sizes depend on which it is.",
        1000.0,
        " mm",
    ),
    "other_modes": Check(
        "probability of another mode",
        "If several poses explain a pair of images, as for symmetric objects, each is a mode. This is the probability "
        "that some pair is at another mode than the model assumes.",
        100.0,
        " %",
    ),
}


def evidence_table(evidence: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the values with their limits as HTML; "" for runs of earlier versions.

    Args:
        evidence: as in `report.json`.
    """
    rows = [_row(CHECKS.get(name, Check(name.replace("_", " "), "")), figure) for name, figure in evidence.items()]
    if not rows:
        return ""
    return f"<h2>Checks</h2><table class='evidence'>{''.join(rows)}</table>"


def _row(check: Check, figure: Mapping[str, Any]) -> str:
    """Return a figure as a row of a table."""
    value, limit = (
        "unknown" if number is None else f"{check.factor * number:.3g}{check.unit}"
        for number in (figure["value"], figure["limit"])
    )
    bound = "at least" if figure.get("at_least") else "at most"
    mark = "holds" if figure["holds"] else "<b class='no'>does not hold</b>"
    return (
        f"<tr><th>{escape(check.words)}<p class='quiet'>{escape(check.why)}</p></th><td>{value}</td>"
        f"<td class='quiet'>{bound} {limit}</td><td>{mark}</td></tr>"
    )
