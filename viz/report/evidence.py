"""The figures behind the verdict on a run, each explained and beside its limit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from typing import Any, Final


@dataclass(frozen=True)
class Check:
    """How a figure of the evidence is worded."""

    words: str
    """What it is."""
    why: str
    """What a large value, or else a small one, means."""
    factor: float = 1.0
    """To its unit."""
    unit: str = ""
    """As written behind the number."""


CHECKS: Final = {
    "unsure_masks": Check(
        "frames with an unsure mask",
        "The object could not be told from its surroundings. Where that is the rule, anything may be modelled.",
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
        "farthest pair from what the prior expects",
        "The prior is what was known of the motion. An estimate many standard deviations (sd) from it contradicts it.",
        1.0,
        " sd",
    ),
    "prior_chi2": Check(
        "mean squared distance of all pairs from the prior",
        "In units of the prior's variance. Many small deviations to one side show in the mean: a wrong step, say.",
    ),
    "loop_sigmas": Check(
        "widest open loop, before optimisation",
        "By how much the chain of consecutive pairs misses a view seen before, in sd that its covariances state; 1 is "
        "expected. More: a wrong pair, or errors that all pairs share, as a wrong focal length makes.",
        1.0,
        " sd",
    ),
    "graph_chi2": Check(
        "mean squared residual of the edges",
        "How far the registrations are from the poses that fit all of them best, in units of their variance; 1 is "
        "expected.",
    ),
    "seen_through": Check(
        "surface of a frame that others see through",
        "Another camera measured something behind it, where it should block the view: one of the two poses is wrong.",
        100.0,
        " %",
    ),
    "absent": Check(
        "surface of a frame that is not there",
        "Most other frames that look at it see through it: the pose of this frame is wrong, or its mask holds more "
        "than the object.",
        100.0,
        " %",
    ),
    "pose_sd_deg": Check(
        "largest sd of a pose's rotation", "At the limit, one pose in twenty is off by more than 3°.", 1.0, "°"
    ),
    "pose_sd_m": Check(
        "largest sd of a pose's place",
        "At the limit, one pose in twenty puts the surface more than 5 mm from where it belongs.",
        1000.0,
        " mm",
    ),
    "size_m": Check(
        "error of the surface that the camera's scale leaves open",
        "Loops cannot tell a wrong focal length from depth of too flat a relief, and sizes depend on which it is.",
        1000.0,
        " mm",
    ),
    "other_modes": Check(
        "probability of another mode",
        "Where several poses explain a pair of images, as for symmetric objects, each is a mode: the probability that "
        "some pair is at another one than the model assumes.",
        100.0,
        " %",
    ),
}


def evidence_table(evidence: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the figures beside their limits as HTML; "" for runs of earlier versions.

    Args:
        evidence: as `report.json` has it.
    """
    rows = [_row(CHECKS.get(name, Check(name.replace("_", " "), "")), figure) for name, figure in evidence.items()]
    if not rows:
        return ""
    return f"<h2>What was checked</h2><table class='evidence'>{''.join(rows)}</table>"


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
