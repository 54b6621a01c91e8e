"""Variances of matching surface from squared residuals (method, eq. 4.7 and 4.8)."""

from __future__ import annotations

from modeler.types import Array

_SIGNIFICANT = 2.0  # standard errors above which errors near silhouettes are part of the model


def significant_variances(sums: Array, independent: float) -> tuple[float, float]:
    """Return b² and the variance near silhouettes in m²; 0 for the latter within two of its standard errors.

    Args:
        sums: (3, 3), see `point_likelihood.residual_excess`.
        independent: number of independent squares among those of the matches.
    """
    (aa, ab, a), (_, bb, b), (_, _, square) = sums.tolist()
    surface_m2, rim_m2 = nonnegative_solution(aa, ab, bb, a, b)
    determinant = max(aa * bb - ab * ab, 1e-9 * aa * bb)
    scatter = max(square - surface_m2 * a - rim_m2 * b, 0.0) / aa  # aa is about the number of matches
    if rim_m2**2 * determinant > _SIGNIFICANT**2 * scatter * aa * max(aa / independent, 1.0):
        return surface_m2, rim_m2
    return max(a, 0.0) / aa, 0.0


def nonnegative_solution(aa: float, ab: float, bb: float, a: float, b: float) -> tuple[float, float]:
    """Return x, y ≥ 0 of least squares, from the normal equations aa x + ab y = a and ab x + bb y = b."""
    determinant = aa * bb - ab * ab
    if determinant > 1e-9 * aa * bb:
        x, y = (bb * a - ab * b) / determinant, (aa * b - ab * a) / determinant
        if x >= 0.0 and y >= 0.0:
            return x, y
    x, y = max(a, 0.0) / aa, max(b, 0.0) / max(bb, 1e-300)  # one of them is 0: that which explains less
    return (x, 0.0) if a * x >= b * y else (0.0, y)
