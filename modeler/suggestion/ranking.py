"""Ranks actions by predicted gain, in words, and tests whether the goal is reached."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from modeler.priors import turntable_in
from modeler.suggestion.belief import Belief, Prediction
from modeler.suggestion.candidates import Candidate, pokes, turns

_COARSE_DEG = 10.0  # between compared turns; between the last ones half of it, as turning by hand is not more precise
_ALIKE = 0.9  # of the better gain: a turn is then equally good either way


@dataclass(frozen=True)
class Goal:
    """When a model is good enough."""

    pose_deg: float = 1.0
    """Largest standard deviation of a pose's rotation."""
    seen: float = 0.95
    """Least observed share (0..1) of the surface that turns on the table can show."""
    sigma_m: float | None = None
    """Largest standard deviation of the surface in a view, by noise and pose; None: any."""

    def reached(self, belief: Belief) -> bool:
        """Return whether a model is good enough."""
        fine = self.sigma_m is None or belief.sigma_m <= self.sigma_m
        return fine and belief.pose_deg <= self.pose_deg and belief.seen >= self.seen


@dataclass(frozen=True, eq=False)
class Suggestion:
    """One action and its predicted effect, in words."""

    prediction: Prediction
    """Its predicted effect."""
    words: str
    """For people."""

    def record(self) -> dict[str, Any]:
        """Return it as JSON values."""
        found = self.prediction
        candidate = found.candidate
        record: dict[str, Any] = {
            "action": candidate.action,
            "gain_nats": _rounded(found.gain_nats),
            "worth_nats": _rounded(found.worth_nats),
            "pose_nats": _rounded(found.pose_nats),
            "surface_nats": _rounded(found.surface_nats),
            "mode_nats": _rounded(found.mode_nats),
            "probability": _rounded(found.right),
            "new_surface": _rounded(found.new_surface),
            "spin_sd_deg": _rounded(found.spin_deg),
            "pose_sd_deg": _rounded(found.pose_deg),
            "cost": candidate.cost,
            "words": self.words,
        }
        if candidate.action in ("turn", "poke"):
            record["turn_deg"] = _rounded(candidate.turn_deg)
        if candidate.poke is not None:
            record["poke"] = {
                "point_m": list(candidate.poke.point_m),
                "direction": list(candidate.poke.direction),
                "length_m": candidate.poke.length_m,
            }
        if candidate.name:
            record["name"] = candidate.name
        return record


@dataclass(frozen=True, eq=False)
class Suggestions:
    """Actions ranked by predicted gain over cost, and the current state of the model."""

    ranked: tuple[Suggestion, ...]
    """Best first."""
    summary: str
    """State of the model in words, and whether the goal is reached."""
    reached: bool
    seen: float
    """Observed share (0..1) of the surface that turns on the table can show."""
    pose_deg: float
    """Largest standard deviation of a pose's rotation."""
    sigma_m: float
    """Standard deviation of the surface in the worst view."""
    excluded: int = 0
    """Number of given candidates that are not ranked: the prior excludes them, or they show nothing."""

    @property
    def best(self) -> tuple[Suggestion, ...]:
        """The first of them, as many as people read."""
        return self.ranked[:8]


def suggest(belief: Belief, candidates: Sequence[Candidate] | None = None, goal: Goal | None = None) -> Suggestions:
    """Return what to do next.

    Args:
        belief: about poses and surface.
        candidates: possible actions; None: turns either way, pokes if the support is visible, laying it on its side.
        goal: None: every pose within 1°, 95 % of the visible surface observed.
    """
    goal = Goal() if goal is None else goal
    found = _default(belief) if candidates is None else _predicted(belief, candidates)
    found.sort(key=lambda each: -each.worth_nats / each.candidate.cost)
    reached = goal.reached(belief)
    ranked = [Suggestion(each, words) for each, words in _in_words(belief, found)]
    state = belief.seen, belief.pose_deg, belief.sigma_m
    excluded = 0 if candidates is None else len(candidates) - len(found)
    return Suggestions(tuple(ranked), _summary(belief, ranked, reached=reached), reached, *state, excluded)


def _predicted(belief: Belief, candidates: Sequence[Candidate]) -> list[Prediction]:
    found = (belief.predict(candidate) for candidate in candidates)
    return [each for each in found if each is not None]


def _default(belief: Belief) -> list[Prediction]:
    """Return predictions of actions of a person at a table; turns near the best ones are sampled more finely."""
    table = turntable_in(belief.prior)
    lying = Candidate("lay", cost=8.0)  # a separate run: a full turn in steps of 45° at least
    others = _predicted(belief, [*pokes(belief.last, belief.stand, belief.object_from_last), lying])
    if table is not None:
        return others + _predicted(belief, turns(abs(table.step_deg)))
    found = _predicted(belief, turns(_COARSE_DEG))
    fine = [
        Candidate("turn", turn_deg=best.candidate.turn_deg + offset_deg)
        for sign in (1.0, -1.0)
        for best in sorted((f for f in found if f.candidate.turn_deg * sign > 0.0), key=lambda f: -f.worth_nats)[:1]
        for offset_deg in (-0.5 * _COARSE_DEG, 0.5 * _COARSE_DEG)
    ]
    return others + found + _predicted(belief, fine)


def _in_words(belief: Belief, found: Sequence[Prediction]) -> list[tuple[Prediction, str]]:
    """Return predictions with their words; a turn that is equally good either way occurs once."""
    worded, passed = [], set()
    for place, each in enumerate(found):
        if id(each) in passed:
            continue
        mirrored = -each.candidate.turn_deg if each.candidate.action == "turn" else None
        others = (one for one in found[place:] if (one.candidate.action, one.candidate.turn_deg) == ("turn", mirrored))
        other = next(others, None)
        either = other is not None and other.worth_nats >= _ALIKE * each.worth_nats > 0.0
        if either:
            passed.add(id(other))
        worded.append((each, f"{_action(each.candidate, either=either)}: {_effect(belief, each)}"))
    return worded


def _action(candidate: Candidate, *, either: bool) -> str:
    if candidate.action == "pose":
        return candidate.name
    if candidate.action == "lay":
        return "lay it on its side, as a separate run to join"
    way = (
        "either way"
        if either
        else "counter-clockwise from above"
        if candidate.turn_deg > 0.0
        else "clockwise from above"
    )
    turn = f"by {abs(candidate.turn_deg):.0f}°"
    if candidate.action == "turn":
        return f"turn {turn} ({way})"
    assert candidate.poke is not None
    x, y, z = (round(1000.0 * value) for value in candidate.poke.point_m)
    push = f"push by {1000.0 * candidate.poke.length_m:.0f} mm"
    return f"poke at ({x}, {y}, {z}) mm in the camera, {push} (turns it {turn}, {way})"


def _effect(belief: Belief, found: Prediction) -> str:
    before_deg, after_deg = belief.spin_deg, found.spin_deg
    parts = []
    if found.edges and after_deg < before_deg - 0.1:  # the resolution of the text
        parts.append(f"spin from {_degrees(before_deg)} to {_degrees(after_deg)}")
    elif found.edges:
        parts.append(f"spin known to {_degrees(after_deg)}")
    parts.append(f"{100.0 * found.new_surface:.0f} % new surface")
    if found.right < 0.9:
        parts.append(f"placed correctly with probability {100.0 * found.right:.0f} %")
    return ", ".join(parts)


def _degrees(value: float) -> str:
    return f"{value:.0f}°" if value >= 9.95 else f"{value:.1f}°"


def _summary(belief: Belief, ranked: Sequence[Suggestion], *, reached: bool) -> str:
    """Return in words the state of the model, and what is left to do."""
    state = (
        f"every pose within {_degrees(belief.pose_deg)}, surface within {1000.0 * belief.sigma_m:.1f} mm, "
        f"{100.0 * belief.seen:.0f} % of the visible surface observed"
    )
    if not reached:
        kinds = [each.prediction.candidate.action for each in ranked]
        useless = "poke" in kinds and "turn" in kinds and kinds.index("turn") < kinds.index("poke")
        return f"{state}; no poke is more informative than a turn" if useless else state
    lays = [each for each in ranked if each.prediction.candidate.action == "lay"]
    rest = "; lay it on its side for the rest" if lays else ""
    return f"nothing more to gain: {state}{rest}"


def _rounded(value: float) -> float | None:
    return float(np.round(value, 4)) if np.isfinite(value) else None
