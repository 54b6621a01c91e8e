"""The rules by which a model is trusted: each from evidence, with its threshold and where that comes from."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from modeler.types import (
    ACCEPTED,
    Edge,
    OptimisationOutlier,
    Solution,
    Step,
    explain,
    joined_without,
    loops_closed,
)

_LITTLE_OVERLAP: Final = 0.5  # views farther apart are registered wrongly now and then, and surely so
_UNSURE_DEG: Final = 5.0  # standard deviation of a frame's turn beyond which the model shows a surface several times


@dataclass(frozen=True)
class FrameRecord:
    """What became of one frame."""

    id: int
    """Frame number."""
    timestamp: float
    """Time of capture in s."""
    points: int
    """Number of surface points on the object."""
    outcome: str
    """`ACCEPTED`, or in words why the frame was left out."""
    cause: str = ""
    """The same for programs, as `types.code` has it; "" for frames that were accepted."""

    @property
    def accepted(self) -> bool:
        """Whether the frame is part of the model."""
        return self.outcome == ACCEPTED


@dataclass(frozen=True)
class Shortcoming:
    """Why a model is not to be trusted."""

    code: str
    """For programs: `doubt`, `interrupted`, `unfinished`, `left_out`, `too_few_frames`, `closures_refused`,
    `unconfirmed`, `never_came_back`, `little_overlap` or `unsure_rotation`."""
    words: str
    """For people."""


@dataclass(frozen=True)
class Verdict:
    """Whether a model can be trusted."""

    shortcomings: tuple[Shortcoming, ...] = ()
    """Why not; empty where it can be."""

    @property
    def trustworthy(self) -> bool:
        """Whether the model can be trusted."""
        return not self.shortcomings


def judged(
    step: Step,
    frames: Sequence[FrameRecord],
    *,
    doubts: Sequence[str] = (),
    interrupted: bool = False,
    closure_expected: bool = False,
) -> Verdict:
    """Judge the model of a run.

    Args:
        step: the latest.
        frames: what became of every frame so far.
        doubts: further reasons in words not to trust it.
        interrupted: whether the user ended the run before its last frame.
        closure_expected: whether the object is known to come back to its start.
    """
    reasons = [Shortcoming("doubt", words) for words in doubts]
    if interrupted:
        reasons.append(Shortcoming("interrupted", f"the run was interrupted after frame {step.frame.index}"))
    elif not step.last:
        reasons.append(Shortcoming("unfinished", "the run has not finished"))
    reasons += [Shortcoming("left_out", words) for words in _left_out(frames)]
    if sum(frame.accepted for frame in frames) < 2:
        words = "fewer than two frames were accepted: there is nothing to align"
        reasons.append(Shortcoming("too_few_frames", words))
    edges = [edge for edge in step.edges_so_far if step.solution.takes_part(edge)]
    reasons += _open_loop(step, edges, closure_expected=closure_expected)
    reasons += _little_overlap(edges)
    reasons += _unsure(step.solution)
    return Verdict(tuple(reasons))


def _left_out(frames: Sequence[FrameRecord]) -> list[str]:
    """Return in words which frames were left out and why, those that follow each other for one reason together."""
    words = []
    for outcome, together in itertools.groupby(sorted(frames, key=lambda frame: frame.id), key=lambda f: f.outcome):
        ids = [frame.id for frame in together]
        if outcome != ACCEPTED:
            which = f"frame {ids[0]} was" if len(ids) == 1 else f"frames {ids[0]} to {ids[-1]} were"
            words.append(f"{which} left out: {outcome}")
    return words


def _open_loop(step: Step, edges: Sequence[Edge], *, closure_expected: bool) -> list[Shortcoming]:
    """Return why no loop was closed where there should be one.

    Args:
        step: the latest.
        edges: those that take part.
        closure_expected: whether the object is known to come back to its start.
    """
    if loops_closed(edges):
        return []
    closures = [edge for edge in step.edges_so_far if edge.kind == "closure"]
    refused = [edge for edge in closures if edge not in edges]
    if refused:
        last = refused[-1]
        why = explain(OptimisationOutlier() if last in step.solution.outliers else last.reason)
        pair = f"frame {last.source} on frame {last.target}"
        words = f"none of {len(closures)} closures closed a loop; the last refused, {pair}: {why}"
        return [Shortcoming("closures_refused", words)]
    if closures:
        words = "what joins the first frames to the last is confirmed by nothing: no loop was closed"
        return [Shortcoming("unconfirmed", words)]
    if closure_expected:
        words = "the object never came back to an earlier view, so that no loop was closed"
        return [Shortcoming("never_came_back", words)]
    return []


def _little_overlap(edges: Sequence[Edge]) -> list[Shortcoming]:
    """Return which views share little surface, and are joined by nothing else."""
    return [
        Shortcoming(
            "little_overlap",
            f"frames {edge.source} and {edge.target} share little surface (overlap {edge.posterior.overlap:.2f}), and "
            "no other edge confirms how they were joined",
        )
        for edge in edges
        if edge.posterior.overlap < _LITTLE_OVERLAP and not joined_without(edge, edges)
    ]


def _unsure(solution: Solution) -> list[Shortcoming]:
    """Return which frames nobody knows how to turn: where the graph is not sure of it, nor is the model."""
    sigmas_deg = {
        frame: float(np.degrees(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])))
        for frame, covariance in solution.covariances.items()
    }
    worst = max(sigmas_deg, key=lambda frame: sigmas_deg[frame], default=None)
    if worst is None or sigmas_deg[worst] <= _UNSURE_DEG:
        return []
    count = sum(sigma_deg > _UNSURE_DEG for sigma_deg in sigmas_deg.values())
    others = f", {count - 1} more by over {_UNSURE_DEG:.0f}°" if count > 1 else ""
    words = f"frame {worst} may be turned by {sigmas_deg[worst]:.0f}° (one standard deviation){others}"
    return [Shortcoming("unsure_rotation", words)]
