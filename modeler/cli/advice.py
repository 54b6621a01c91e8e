"""What the outcome of a run suggests to do otherwise, in terms of options."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from modeler import se3
from modeler.priors import TurntablePrior
from modeler.types import AbstractPrior, Failed, Outcome, Reason, advice
from sequences import AbstractSequence

_SURE_STEPS: Final = 3  # pairs that tell a step
_FAR_SDS: Final = 3.0  # of the told step, from which on another one is meant
_BY_OPTIONS: Final = {
    Outcome.AT_LIMIT: (
        "The motion may be larger than the prior allows; raise --max-rotation-deg (general, table), --max-offset-m "
        "(general) or --max-shift-m (table, turntable)."
    ),
    Outcome.TOO_FEW_POINTS: "The object covers too few pixels; check the mask, --roi and --max-depth-m.",
    Outcome.UNSURE_MASK: (
        "The object is hard to tell from its surroundings; give --roi, --max-depth-m, or masks that hold nothing else."
    ),
}


def outcome_advice(outcome: Outcome) -> str:
    """Return what to do about an outcome, in terms of options."""
    return _BY_OPTIONS.get(outcome, outcome.advice)


def reason_advice(reason: Reason) -> str:
    """Return what to do about a frame that was left out, in terms of options; "" where there is nothing to do."""
    return outcome_advice(reason.outcome) if isinstance(reason, Failed) else advice(reason)


def comes_back(frames: AbstractSequence, given_deg: float | None, reach_deg: float) -> bool:
    """Return whether the object is said to turn as far as its first view, or nearly.

    Args:
        frames: the sequence, which may tell the turn from frame to frame.
        given_deg: that turn where a person tells it, who counts more.
        reach_deg: how near to a view another must look for them to be registered.
    """
    step_deg = (frames.motion or {}).get("step_deg") if given_deg is None else given_deg
    if not isinstance(step_deg, int | float):
        return False
    return abs(step_deg) * (frames.indices[-1] - frames.indices[0]) >= 360.0 - reach_deg


def sense_in_doubt(report: Mapping[str, Any], prior: AbstractPrior) -> bool:
    """Return whether views overlap so little that a table may turn the other way round than its prior takes for known.

    Args:
        report: of the run.
        prior: of the run.
    """
    little = "little_overlap" in (report.get("reason_codes") or ())
    little = little or any(frame.get("cause") == Outcome.NO_OVERLAP.label for frame in report["frames"])
    return little and isinstance(prior, TurntablePrior) and prior.step_sign == "known"


def other_step(edges: Sequence[Mapping[str, Any]], prior: AbstractPrior) -> str:
    """Return in words by what step the views turned where that is not the one that the prior was told, else "".

    Args:
        edges: of the report.
        prior: of the run.
    """
    odometry = [edge for edge in edges if edge["accepted"] and edge["kind"] == "odometry"]
    gaps = [abs(edge["source"] - edge["target"]) for edge in odometry]  # frames tried again lie before their targets
    gap = min(gaps, default=1)
    turns = [
        np.degrees(se3.rotation_angle(np.reshape(edge["target_from_source"], (4, 4)))) / gap
        for edge, apart in zip(odometry, gaps, strict=True)
        if apart == gap
    ]
    if not isinstance(prior, TurntablePrior) or len(turns) < _SURE_STEPS:
        return ""
    found_deg, told_deg = float(np.median(turns)), abs(prior.step_deg)
    if abs(found_deg - told_deg) <= _FAR_SDS * prior.step_sigma_deg:
        return ""
    return (
        f"the views turned by {found_deg:.1f}° from one frame number to the next, not by the {told_deg:g}° ± "
        f"{prior.step_sigma_deg:g}° that was told; is --step-deg {np.copysign(found_deg, prior.step_deg):.1f} meant?"
    )


def ends_without(frames: Sequence[Mapping[str, Any]]) -> str:
    """Return in words which frames show the object, where the first or the last ones do not, else "".

    Args:
        frames: of the report.
    """
    ids = sorted(frame["id"] for frame in frames)
    seen = sorted(frame["id"] for frame in frames if frame.get("cause") != Outcome.TOO_FEW_POINTS.label)
    if len(seen) < 2 or (seen[0], seen[-1]) == (ids[0], ids[-1]):
        return ""
    late, early = seen[0] > ids[0], seen[-1] < ids[-1]
    when = [f"from frame {seen[0]} on"] * late + [f"up to frame {seen[-1]}"] * early
    only = f"{seen[0] if late else ''}:{seen[-1] + 1 if early else ''}"
    return f"the object is seen {', '.join(when)}; --frames {only} takes those frames alone"
