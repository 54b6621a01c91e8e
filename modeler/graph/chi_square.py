"""Quantiles of the chi-square distribution. Importing `scipy.stats` for them costs a command 0.4 s."""

from scipy.special import gammaincinv


def chi_square_quantile(probability: float, degrees: int) -> float:
    """Return what chi² with so many degrees of freedom stays below with a probability (0..1)."""
    return 2.0 * float(gammaincinv(0.5 * degrees, probability))
