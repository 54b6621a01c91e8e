"""Which loops take part in a solution, and the poses then: from where the one before stood, or else afresh."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

from modeler.graph.factors import Factor, chain
from modeler.graph.incremental import Incremental
from modeler.graph.optimise import agree, joining, optimise, poses_of
from modeler.types import Array

_QUORUM = 3  # loops that agree with each other before new ones are judged by them alone
_JUDGED = 3  # new loops that may be judged so at once

Inlier = tuple[bool, ...]
"""Which loops take part, in their order."""


def closed(
    tree: Sequence[Factor],
    loops: Sequence[Factor],
    start: Mapping[int, Array],
    *,
    root: int,
    threshold: float,
    before: tuple[Inlier, Incremental | None] = ((), None),
) -> tuple[Mapping[int, Array], Inlier, Incremental | None]:
    """Return the poses under all loops, which loops take part, and the engine that can go on from there.

    Args:
        tree: factors that are trusted.
        loops: factors that may be contradicted, those of before first.
        start: object_from_camera (4, 4) by frame number.
        root: the frame whose pose is the identity.
        threshold: half the squared Mahalanobis distance beyond which a loop is left out.
        before: which of the loops took part in the solution before, and its engine.
    """
    inlier, engine = before
    if engine is not None:
        found = _went_on((inlier, engine), tree, loops, start, threshold)
        if found is not None:
            return poses_of(found[1].values, start, root), *found
    if not loops:
        return chain(tree, root, {}), (), None
    optimum = optimise(tree, loops, start, root=root, threshold=threshold, inlier=inlier)
    chosen = joining(loops, optimum.inlier)
    if not chosen:  # dead reckoning meets every edge exactly
        return chain(tree, root, {}), optimum.inlier, None
    return optimum.poses, optimum.inlier, Incremental.of([*tree, *chosen], optimum.poses, root)


def _went_on(
    before: tuple[Inlier, Incremental],
    tree: Sequence[Factor],
    loops: Sequence[Factor],
    start: Mapping[int, Array],
    threshold: float,
) -> tuple[Inlier, Incremental] | None:
    """Return which loops take part and their solution, from where the engine is; None: all is to be asked again.

    Some of the new loops may be left out, if enough of the others agree to judge them by: the choice is the one that
    costs least of those that stand.
    """
    known, engine = before
    new = len(loops) - len(known)
    choices = [(True,) * new]
    if sum(known) >= max(_QUORUM, 2 * known.count(False)) and new <= _JUDGED:
        choices = sorted(itertools.product((True, False), repeat=new), key=lambda choice: choice.count(False))
    best: tuple[float, Inlier, Incremental] | None = None
    for choice in choices:
        inlier = (*known, *choice)
        found = engine.plus([*tree, *joining(loops, inlier)], start)
        if found is not None and agree(loops, found.values, threshold) == inlier:
            if all(choice):
                return inlier, found
            cost = found.error + threshold * inlier.count(False)
            if best is None or cost < best[0]:
                best = cost, inlier, found
    return None if best is None else best[1:]
