"""Validation of the parameters of priors: one schema for options, files and code.

A parameter's name ends with its unit. Upper limits reject values in another unit, such as lengths in mm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, Final

import numpy as np

from modeler.types import Array, InputError

MAX_LENGTH_M: Final = 5.0
_LIMITS: Final = {"deg": ("degrees", 180.0), "m": ("metres", MAX_LENGTH_M), "s": ("seconds", 1e4)}
_MAY_BE_ZERO: Final = {"step_sigma_deg", "axis_sigma_deg", "axis_sigma_m", "wobble_deg", "wobble_m"}
_MAX_TURN_DEG = 360.0
_MAX_COORDINATE = 100.0


class ParameterError(InputError):
    """A parameter out of range."""

    def __init__(self, name: str, value: float | Sequence[float], allowed: str) -> None:
        """Word the error.

        Args:
            name: of the parameter.
            value: a number or three.
            allowed: the range, such as `a positive number of metres, at most 5`.
        """
        numbers = value if isinstance(value, Sequence) else (value,)
        self.name = name
        self.fault = f"{' '.join(f'{number:g}' for number in numbers)} is out of range; give {allowed}"
        super().__init__(f"{name} {self.fault}")


def check_parameter(name: str, value: object, *, exact: bool = True) -> None:
    """Check one parameter by the unit in its name; only numbers and triples of numbers are checked.

    Args:
        name: ends with its unit: `_deg`, `_m`, `_s`. Only `step_deg` may be negative.
        value: of the parameter.
        exact: whether standard deviations of a turntable may be 0, as for simulated ones.

    Raises:
        ParameterError: if it is not finite, or out of range.
    """
    if isinstance(value, tuple) and value and all(isinstance(number, int | float) for number in value):
        direction = not name.endswith("_m")
        if len(value) != 3 or not all(abs(number) <= _MAX_COORDINATE for number in value):
            raise ParameterError(name, value, f"three numbers of -{_MAX_COORDINATE:g} to {_MAX_COORDINATE:g}")
        if direction and not any(value):
            raise ParameterError(name, value, "three numbers that are not all 0")
    if isinstance(value, bool) or not isinstance(value, int | float):
        return
    if name == "step_deg":
        if not 0.0 < abs(value) <= _MAX_TURN_DEG:
            raise ParameterError(name, value, f"a turn of -{_MAX_TURN_DEG:g} to {_MAX_TURN_DEG:g} degrees, but not 0")
    elif name.rpartition("_")[2] in _LIMITS:
        unit, largest = _LIMITS[name.rpartition("_")[2]]
        if not (0.0 < value <= largest or (value == 0.0 and exact and name in _MAY_BE_ZERO)):
            raise ParameterError(name, value, f"a positive number of {unit}, at most {largest:g}")
    elif isinstance(value, float) and not 0.0 < value < np.inf:
        raise ParameterError(name, value, "a positive number")


def check_parameters(component: Any) -> None:
    """Check the fields of a dataclass by the units in their names, to be called in `__post_init__`."""
    for field in fields(component):
        check_parameter(field.name, getattr(component, field.name))


def check_covariance(name: str, covariance: Array) -> None:
    """Check that a covariance (n, n) is finite, symmetric and positive definite."""
    valid = np.isfinite(covariance).all() and np.allclose(covariance, covariance.T, rtol=1e-6, atol=0.0)
    if not valid or np.linalg.eigvalsh(covariance)[0] <= 0.0:
        raise InputError(f"{name} is not a covariance; give a finite, symmetric, positive definite matrix")
