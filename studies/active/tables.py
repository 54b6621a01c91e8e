"""What trials show, in figures with their intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import rankdata

from studies.active.trial import done

MEASURES = {
    "gain_nats": ("predicted_gain", "gain"),
    "pose_nats": ("predicted_pose_nats", "pose_nats"),
    "new_surface": ("predicted_new", "new"),
    "sigma_deg": ("predicted_sigma_deg", "sigma_deg"),
}


def steps(records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return all actions with their gains: zero if the view was left out or its pose is wrong."""
    found = []
    for record in records:
        for one in record["outcomes"]:
            predicted = one["usable"] * (one["predicted_pose_nats"] + one["predicted_surface_nats"])
            right = one["accepted"] and one["error_deg"] <= 3.0 * one["edge_sigma_deg"] + 3.0
            gain = one["pose_nats"] + one["surface_nats"] if right else 0.0
            found.append({**one, "shape": record["shape"], "predicted_gain": predicted, "gain": gain, "placed": right})
    return found


def slope(predicted: np.ndarray, realised: np.ndarray) -> float:
    """Return the slope of the line through the origin that fits best by least squares."""
    return float(predicted @ realised / max(predicted @ predicted, 1e-300))


def rank_correlation(predicted: np.ndarray, realised: np.ndarray) -> float:
    """Return Spearman's."""
    return float(np.corrcoef(rankdata(predicted), rankdata(realised))[0, 1])


def interval(values: np.ndarray, statistic, rng: np.random.Generator) -> tuple[float, float]:
    """Return the 95 % interval of a statistic of rows, by the bootstrap."""
    drawn = [statistic(values[rng.integers(0, len(values), len(values))]) for _ in range(1000)]
    low, high = np.percentile(drawn, [2.5, 97.5])
    return float(low), float(high)


def printed(records: Sequence[dict[str, Any]]) -> None:
    """Print the tables."""
    rng = np.random.default_rng(0)
    print("| policy | measure | steps | slope (95 %) | rank correlation (95 %) |")
    print("|---|---|---|---|---|")
    for policy in dict.fromkeys(record["policy"] for record in records):
        some = steps([record for record in records if record["policy"] == policy])
        for name, (predicted, realised) in MEASURES.items():
            pairs = np.array([(one[predicted], one[realised]) for one in some], dtype=np.float64)
            pairs = pairs[np.isfinite(pairs).all(axis=1)]
            if len(pairs) < 5:
                continue
            low, high = interval(pairs, lambda p: slope(*p.T), rng)
            ranks = interval(pairs, lambda p: rank_correlation(*p.T), rng)
            print(
                f"| {policy} | {name} | {len(pairs)} | {slope(*pairs.T):.2f} ({low:.2f} to {high:.2f}) | "
                f"{rank_correlation(*pairs.T):.2f} ({ranks[0]:.2f} to {ranks[1]:.2f}) |"
            )
    print()
    print("| policy | trials | reached | actions, mean (95 %); one more than the most where never |")
    print("|---|---|---|---|")
    most = 1 + max(len(record["outcomes"]) for record in records)
    means = {}
    for policy in dict.fromkeys(record["policy"] for record in records):
        counts = {(r["shape"], r["seed"]): needed(r) for r in records if r["policy"] == policy}
        means[policy] = counts
        values = np.array([most if n is None else n for n in counts.values()], dtype=np.float64)
        low, high = interval(values, np.mean, rng)
        print(
            f"| {policy} | {len(values)} | {sum(n is not None for n in counts.values())} | "
            f"{values.mean():.1f} ({low:.1f} to {high:.1f}) |"
        )
    print()
    for policy in ("random", "even"):
        common = sorted(means.get("suggest", {}).keys() & means.get(policy, {}).keys())
        pairs = np.array([[means[p][key] or most for p in ("suggest", policy)] for key in common], dtype=np.float64)
        if len(pairs) > 1:
            low, high = interval(pairs, lambda p: p[:, 0].mean() / p[:, 1].mean(), rng)
            share = pairs[:, 0].mean() / pairs[:, 1].mean()
            print(f"suggest / {policy}: {share:.2f} ({low:.2f} to {high:.2f}) over {len(pairs)} shapes")


def needed(record: dict[str, Any]) -> int | None:
    """Return the actions until every pose was within 1° and 95 % of the visible surface observed; None: never."""
    pairs = zip(record["seen"], record["worst_error_deg"], strict=True)
    return next((count for count, (seen, error_deg) in enumerate(pairs) if done(seen, error_deg)), None)
