"""The rules by which a model is trusted, each with its evidence, threshold and origin."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from modeler import se3
from modeler.fusion import SymmetryFinder
from modeler.types import (
    ACCEPTED,
    AWAY_DEG,
    NEAR_DEG,
    AbstractPrior,
    Check,
    ColourAlignment,
    Edge,
    Failed,
    FocalLength,
    FrameRecord,
    LowCorrelation,
    LowLikelihood,
    LowOverlap,
    OpenRotation,
    OptimisationOutlier,
    Outcome,
    Shortcoming,
    Solution,
    Step,
    Verdict,
    explain,
    joined_without,
    loop_closure_errors,
    loops_closed,
    segments,
)
from modeler.verdict.colour_alignment import colour_alignment
from modeler.verdict.colour_fit import Comparison
from modeler.verdict.evidence import (
    MAX_UNSURE,
    FreeSpace,
    contradiction,
    default_tolerance_m,
    displacement,
    free_space,
    graph_check,
    loop_check,
    other_modes,
    prior_check,
    prior_distances,
)
from modeler.verdict.likeness import flat_check, likenesses, print_check
from modeler.verdict.spreads import (
    AboutMean,
    misfit,
    size_check,
    spread_of_positions,
    spread_of_rotations,
    total_depth_scale_sigma,
)

_NO_SURFACE: Final = "poses are wrong, masks include more than the object, or it changed its shape"


def judged(
    step: Step,
    *,
    interrupted: bool = False,
    closure_expected: bool = False,
    prior: AbstractPrior | None = None,
    depth_scale_sigma: float = 0.0,
    tolerance_m: float | None = None,
    colour: bool = True,
) -> Verdict:
    """Judge the model of a run. Evidence is gathered after the last step, when all edges are in.

    Args:
        step: the latest.
        interrupted: whether the user ended the run before its last frame.
        closure_expected: whether the object is known to come back to its start.
        prior: of the motions; None: not known here.
        depth_scale_sigma: standard deviation of the depth scale's logarithm, as the camera was given; 0 = exact.
        tolerance_m: error of the surface above which a model is wrong; None: `default_tolerance_m`.
        colour: whether colour is to fit depth.
    """
    reasons, frames = [], step.frames_so_far
    if tolerance_m is None:
        tolerance_m = default_tolerance_m([*step.views.values()], step.solution.variance_factor)
    if interrupted:
        reasons.append(Shortcoming("interrupted", f"the run was interrupted after frame {step.frame.index}"))
    elif not step.last:
        reasons.append(Shortcoming("unfinished", "the run has not finished"))
    if sum(frame.accepted for frame in frames) < 2:
        words = "fewer than two frames were accepted: there is nothing to align"
        reasons.append(Shortcoming("too_few_frames", words))
    edges = [edge for edge in step.edges_so_far if step.solution.takes_part(edge)]
    reasons += [Shortcoming("left_out", words) for words in _left_out(frames, segments(edges))]
    free = free_space(step.views, step.solution.trajectory, tolerance_m) if step.last else None
    found = _found(step, frames, edges, prior, tolerance_m, free=free) if step.last else []
    of_colour, alignment = _colour(step) if step.last and colour else ([], None)
    found += of_colour
    found += _alike(step, edges, prior, tolerance_m, colour=colour) if step.last else []
    reasons += _against(found)
    spreads, open_loop = [], _open_loop(step, edges, closure_expected=closure_expected)
    if step.last:
        about_mean = AboutMean.of(step.solution)
        spreads = _spreads(step, edges, tolerance_m, about_mean)
        model = step.model if _only_turns_are_open(spreads, open_loop, step) else None
        # How far a body of revolution turned about its axis, or a ball in any way, is no matter of its surface.
        if model is not None and len(turns := SymmetryFinder().free_turns(model)):
            spreads = _spreads(step, edges, tolerance_m, about_mean.but_for(turns, step.solution.trajectory))
            open_loop = []
        spreads += _size(step, depth_scale_sigma, tolerance_m)
    reasons += [*open_loop, *_unconfirmed_join(edges), *_against(spreads)]
    checks = {finding.name: finding.check for finding in (*found, *spreads)}
    return Verdict(tuple(reasons), checks, tolerance_m, {} if free is None else free.contradictions, alignment)


@dataclass(frozen=True)
class _Finding:
    """A value of the evidence, and the reason given if it exceeds its limit."""

    name: str
    check: Check
    code: str
    words: str


def _against(found: Sequence[_Finding]) -> list[Shortcoming]:
    """Return the findings that exceed their limits, the first per code."""
    against = [finding for finding in found if not finding.check.holds]
    words = {finding.code: finding.words for finding in reversed(against)}
    return [Shortcoming(code, words[code]) for code in dict.fromkeys(finding.code for finding in against)]


def _found(
    step: Step,
    frames: Sequence[FrameRecord],
    edges: Sequence[Edge],
    prior: AbstractPrior | None,
    tolerance_m: float,
    *,
    free: FreeSpace | None,
) -> list[_Finding]:
    """Return the evidence of a whole run, from its last step, all frames, the edges that take part, and the prior."""
    views, solution, found = step.views, step.solution, []
    accepted = [frame for frame in frames if frame.accepted]
    if accepted:
        unsure = sum(frame.mask == Outcome.UNSURE_MASK.label for frame in accepted)
        words = f"the masks of {unsure} of {len(accepted)} frames are unsure: another object may have been modelled"
        found.append(_Finding("unsure_masks", Check(unsure / len(accepted), MAX_UNSURE), "unsure_masks", words))
    if (moved_m := displacement(views, solution)) is not None:
        words = (
            f"the object did not move measurably: its surface moved by {1000.0 * moved_m.value:.1f} mm at most, and "
            f"the camera's noise hides up to {1000.0 * moved_m.limit:.1f} mm"
        )
        found.append(_Finding("motion_m", moved_m, "no_motion", words))
    places = {frame: place for place, frame in enumerate(sorted(frame.id for frame in frames))}
    distances = [] if prior is None else prior_distances(edges, views, prior, places, solution)
    if (against := contradiction(distances)) is not None:
        edge, check = against
        words = (
            f"the images contradict the prior: from frame {edge.target} to {edge.source} the object moved "
            f"{check.value:.0f} standard deviations from the prior"
        )
        found.append(_Finding("prior_sds", check, "prior_contradicted", words))
    if (together := prior_check(distances)) is not None:
        words = (
            f"the images contradict the prior in all pairs together: squared distances from it are "
            f"{together.value:.1f} times those of its standard deviations (up to {together.limit:.1f} by chance)"
        )
        found.append(_Finding("prior_chi2", together, "prior_contradicted", words))
    centroids_m = {frame: view.centroid_m for frame, view in views.items()}
    if (loop := loop_check(loop_closure_errors(step.edges_so_far, solution, centroids_m), tolerance_m)) is not None:
        error, check = loop
        words = f"{error.words}: the focal length, the depth scale or an edge is wrong"
        found.append(_Finding("loop_sigmas", check, "loop_open", words))
    if (fit := graph_check(edges, solution, views, tolerance_m)) is not None:
        words = (
            f"the edges contradict each other: their squared residuals are {fit.value:.1f} times those "
            f"expected from their covariances (up to {fit.limit:.1f} by chance)"
        )
        found.append(_Finding("graph_chi2", fit, "edges_disagree", words))
    if free is not None:
        words = (
            f"{100.0 * free.violations.value:.0f} % of the surface of frame {free.frame} violates the free space of "
            f"other frames by more than {1000.0 * tolerance_m:.1f} mm: {_NO_SURFACE}"
        )
        found.append(_Finding("free_space_violations", free.violations, "free_space_violations", words))
        words = (
            f"{100.0 * free.false_surface.value:.0f} % of the surface of frame {free.contradicted_frame} is "
            f"contradicted by most frames that observe it: {_NO_SURFACE}"
        )
        found.append(_Finding("false_surface", free.false_surface, "false_surface", words))
    others = other_modes(edges, solution, views, tolerance_m)
    words = f"with a probability of {100.0 * others.value:.0f} %, some pair is at a wrong mode"
    found.append(_Finding("other_modes", others, "other_modes", words))
    return found


def _colour(step: Step) -> tuple[list[_Finding], ColourAlignment | None]:
    """Return whether colour fits depth, and where it is, if surface that two views see has colour."""
    compared = Comparison.of(step.views, step.solution.trajectory)
    if compared is None:
        return [], None
    fit = compared.fit()
    alignment = colour_alignment(compared, fit.displacement)
    words = (
        "colour does not fit depth: its correlation on surface that two frames see is "
        f"{fit.correlation:.2f}, and {fit.elsewhere:.2f} if it {fit.displacement} ({alignment}): is it aligned?"
    )
    return [_Finding("colour_fit", fit.check, "colour_misaligned", words)], alignment


def _alike(
    step: Step, edges: Sequence[Edge], prior: AbstractPrior | None, tolerance_m: float, *, colour: bool
) -> list[_Finding]:
    """Return whether views that match may show different sides that are alike, as far as print and shape tell."""
    joined = {(min(edge.source, edge.target), max(edge.source, edge.target)): edge.kind for edge in edges}
    across = {pair for pair, kind in joined.items() if kind == "join"}
    pairs = likenesses(step.views, step.solution.trajectory, tolerance_m, joined, across, colour=colour)
    found = []
    if (by_print := print_check(pairs)) is not None:
        pair, check = by_print
        words = (
            f"print contradicts that frames {pair.first} and {pair.second} show the same surface: it correlates by "
            f"{pair.correlation:.2f}, {100.0 * check.value:.0f} % of what that of others does"
        )
        found.append(_Finding("print_fit", check, "print_contradicts", words))
    places = {frame: place for place, frame in enumerate(sorted(frame.id for frame in step.frames_so_far))}
    if (by_shape := flat_check(pairs, step.views, places, prior)) is not None:
        frame, check = by_shape
        words = (
            f"{check.value:.0f} frames, {frame} among them, match the others by part of a flat face alone, which "
            "another side of the object may match as well"
        )
        found.append(_Finding("flat_frames", check, "flat_match", words))
    return found


def _only_turns_are_open(spreads: Sequence[_Finding], open_loop: Sequence[Shortcoming], step: Step) -> bool:
    """Return whether a rotation is too uncertain, and whatever closures were refused leave one open."""
    unsure = any(finding.code == "unsure_rotation" and not finding.check.holds for finding in spreads)
    refused = [edge.reason for edge in step.edges_so_far if edge.kind == "closure" and not edge.accepted]
    by_turns = all(isinstance(reason, OpenRotation) for reason in refused)
    return unsure and all(one.code == "closures_refused" and by_turns for one in open_loop)


def _spreads(step: Step, edges: Sequence[Edge], tolerance_m: float, about_mean: AboutMean) -> list[_Finding]:
    """Return the uncertainty of the poses of a whole run."""
    found, factor, focal = [], misfit(edges, step.solution), step.solution.focal
    if (turn := spread_of_rotations(about_mean, factor)) is not None:
        words = f"the rotation of frame {turn.frame} is uncertain by {turn.check.value:.1f}° (one standard deviation)"
        words += f", {turn.count - 1} more by over {turn.check.limit:.1f}°" if turn.count > 1 else ""
        found.append(_Finding("pose_sd_deg", turn.check, "unsure_rotation", words))
    if (place := spread_of_positions(step.views, step.solution, about_mean, tolerance_m, factor)) is not None:
        value_mm, limit_mm = 1000.0 * place.check.value, 1000.0 * place.check.limit
        words = f"the position of frame {place.frame} is uncertain by {value_mm:.1f} mm (one standard deviation)"
        words += f", {place.count - 1} more by over {limit_mm:.1f} mm" if place.count > 1 else ""
        found.append(_explained(_Finding("pose_sd_m", place.check, "unsure_place", words), place.by_focal_m, focal))
    return found


def _explained(spread: _Finding, by_focal: float, focal: FocalLength | None) -> _Finding:
    """Return a finding on the uncertainty of poses, with the reason if the focal length causes most of the variance.

    `by_focal` is the standard deviation caused by the focal length alone, in the finding's unit.
    """
    if focal is None or 2.0 * by_focal**2 < spread.check.value**2:
        return spread
    why = f"mostly because the focal length is known only to {100.0 * focal.sigma:.1f} %"
    return replace(spread, code="unsure_focal", words=f"{spread.words}, {why}")


def _size(step: Step, depth_scale_sigma: float, tolerance_m: float) -> list[_Finding]:
    """Return the uncertainty of the model's size, unless depth scale and focal length are exact."""
    focal = step.solution.focal
    sigma = float(np.hypot(total_depth_scale_sigma(depth_scale_sigma, focal), 0.0 if focal is None else focal.sigma))
    if sigma == 0.0:
        return []
    check = size_check(step.views, step.solution.trajectory, sigma, tolerance_m)
    words = (
        f"the model's size is known only to {100.0 * sigma:.0f} %, {1000.0 * check.value:.1f} mm of its surface: focal "
        "length or depth scale are uncertain"
    )
    return [_Finding("size_m", check, "unsure_size", words)]


def _left_out(frames: Sequence[FrameRecord], segment_of: Mapping[int, int]) -> list[str]:
    """Return in words which frames were left out and why, consecutive ones with the same reason together.

    Frames between two segments are not included: they show at most the object in a hand that turns it over.
    """
    words, ordered = [], sorted(frames, key=lambda frame: frame.id)
    before = list(itertools.accumulate((segment_of.get(frame.id) for frame in ordered), _latest))
    after = list(itertools.accumulate((segment_of.get(frame.id) for frame in reversed(ordered)), _latest))[::-1]
    between = {
        frame.id
        for frame, one, other in zip(ordered, before, after, strict=True)
        if not frame.accepted and None not in (one, other) and one != other
    }
    counted = [frame for frame in ordered if frame.id not in between]
    for outcome, together in itertools.groupby(counted, key=lambda frame: frame.outcome):
        ids = [frame.id for frame in together]
        if outcome != ACCEPTED:
            which = f"frame {ids[0]} was" if len(ids) == 1 else f"frames {ids[0]} to {ids[-1]} were"
            words.append(f"{which} left out: {outcome}")
    return words


def _latest(before: int | None, now: int | None) -> int | None:
    """Return the newest number of a segment."""
    return before if now is None else now


def _open_loop(step: Step, edges: Sequence[Edge], *, closure_expected: bool) -> list[Shortcoming]:
    """Return the reason if no loop was closed although the object is known to come back to its start."""
    if loops_closed(edges):
        return []
    closures = [edge for edge in step.edges_so_far if edge.kind == "closure"]
    joining = [edge for edge in closures if edge in edges]
    rejected = [
        edge for edge in closures if edge not in joining and (closure_expected or _is_conclusive(edge, step.solution))
    ]
    if rejected:
        last = rejected[-1]
        why = explain(OptimisationOutlier() if last in step.solution.outliers else last.reason)
        pair = f"frame {last.source} on frame {last.target}"
        words = f"none of {len(closures)} closures closed a loop; the last rejected one, {pair}: {why}"
        return [Shortcoming("closures_refused", words)]
    if joining:
        words = "the edge between the first frames and the last is unconfirmed: no loop was closed"
        return [Shortcoming("unconfirmed", words)]
    if closure_expected:
        words = "the object never came back to an earlier view, so no loop was closed"
        return [Shortcoming("never_came_back", words)]
    joins = any(edge.kind == "join" for edge in edges)
    back = None if closures or joins else _came_back(step.solution)
    if back is not None:
        frame, first = back
        words = f"frame {frame} shows the same side of the object as frame {first}, but no loop was tried"
        return [Shortcoming("not_tried", words)]
    return []


def _unconfirmed_join(edges: Sequence[Edge]) -> list[Shortcoming]:
    """Return the reason if segments are joined by a single pair of views."""
    alone = [edge for edge in edges if edge.kind == "join" and not joined_without(edge, edges)]
    words = "the edge between frames {} and {}, of two segments, is not confirmed by another pair of views"
    return [Shortcoming("unconfirmed", words.format(edge.target, edge.source)) for edge in alone[:1]]


def _is_conclusive(edge: Edge, solution: Solution) -> bool:
    """Return whether a rejected closure is conclusive: views far apart may share too little surface for one."""
    unlike = LowOverlap | LowLikelihood | LowCorrelation
    bare = isinstance(edge.reason, unlike) or edge.reason == Failed(Outcome.NO_OVERLAP)
    known = edge.source in solution.trajectory and edge.target in solution.trajectory
    near = known and np.degrees(se3.rotation_angle(solution.relative(edge.target, edge.source))) <= NEAR_DEG
    return bool(near) or not bare


def _came_back(solution: Solution) -> tuple[int, int] | None:
    """Return the frame nearest to the first view after the object had turned away, and the first frame.

    None if no frame comes near.
    """
    first, *frames = sorted(solution.trajectory) or [0]
    angles_deg = np.array([np.degrees(se3.rotation_angle(solution.relative(first, frame))) for frame in frames])
    away = np.flatnonzero(angles_deg >= AWAY_DEG)
    if not len(away):
        return None
    after_deg = angles_deg[away[0] :]
    nearest = int(np.argmin(after_deg))
    return (frames[away[0] + nearest], first) if after_deg[nearest] <= NEAR_DEG else None
