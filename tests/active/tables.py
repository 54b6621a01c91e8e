"""What trials show, in figures with their intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import rankdata

MEASURES = {
    "gain_nats": ("predicted_gain", "gain"),
    "pose_nats": ("predicted_pose_nats", "pose_nats"),
    "new_surface": ("predicted_new", "new"),
    "sigma_deg": ("predicted_sigma_deg", "sigma_deg"),
}


def steps(records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return all actions with their gains: 0 where the view was left out."""
    found = []
    for record in records:
        for one in record["outcomes"]:
            predicted = one["right"] * (one["predicted_pose_nats"] + one["predicted_surface_nats"])
            gain = one["pose_nats"] + one["surface_nats"] if one["accepted"] else 0.0
            found.append({**one, "shape": record["shape"], "predicted_gain": predicted, "gain": gain})
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
    print("| policy | trials | reached | actions, mean (95 %) | with the truth within 3 sd + 1° |")
    print("|---|---|---|---|---|")
    for policy in dict.fromkeys(record["policy"] for record in records):
        some = [record for record in records if record["policy"] == policy]
        reached = [needed(record) for record in some]
        counts = np.array([len(r["outcomes"]) + 1 if n is None else n for r, n in zip(some, reached, strict=True)])
        low, high = interval(counts.astype(float), np.mean, rng)
        right = sum(
            r["worst_error_deg"][-1] <= 3.0 * r["pose_sd_deg"][-1] + 1.0 for r, n in zip(some, reached, strict=True)
        )
        print(
            f"| {policy} | {len(some)} | {sum(n is not None for n in reached)} | "
            f"{counts.mean():.1f} ({low:.1f} to {high:.1f}) | {right} |"
        )


def needed(record: dict[str, Any]) -> int | None:
    """Return the actions until every pose was stated to 1° and 95 % of what can be seen was; None: never."""
    for count, (seen, sd_deg) in enumerate(zip(record["seen"], record["pose_sd_deg"], strict=True)):
        if seen >= 0.95 and sd_deg <= 1.0:
            return count
    return None
