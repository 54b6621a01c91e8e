"""Array types, the error for unusable input, checks of arguments and parameters, and outcomes of attempts."""

from __future__ import annotations

import enum
import functools
import inspect
import numbers
import types
from collections.abc import Callable, Sequence
from dataclasses import fields
from itertools import chain
from typing import Any, Final, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
Float32Array = npt.NDArray[np.float32]
T = TypeVar("T")


class InputError(Exception):
    """Unusable input, in one line: what is wrong, where, and what to do. Commands exit with status 2."""


SOME_VIEWS: Final = 24
"""Of a run, evenly spread, that stand for all of its views: one every 15° of a turn."""
SOME_POINTS: Final = 400
"""Of a surface, by which a share of it is estimated: the standard deviation of a share of 0.1 is then 0.015."""


def spread(items: Sequence[T], most: int) -> list[T]:
    """Return all items, or `most` of them that are evenly spread."""
    places = np.linspace(0, len(items) - 1, min(len(items), most)).astype(int)
    return [items[place] for place in np.unique(places)]


class Outcome(enum.Enum):
    """Outcome of an attempt, with a sentence of advice."""

    CONVERGED = "converged", "The posterior has one narrow mode; nothing to do."
    AMBIGUOUS = "ambiguous", "Several poses explain the images; add a prior (table, turntable) or more views."
    DEGENERATE = (
        "degenerate",
        "Too few distinct samples carry the weight; use a narrower prior, or views that share more surface.",
    )
    NO_OVERLAP = "no overlap", "The views share too little surface; use a smaller step between frames."
    AT_LIMIT = (
        "at the prior's limit",
        "The motion may be larger than the prior allows; raise its limits of rotation, offset or shift.",
    )
    TOO_FEW_POINTS = (
        "too few points",
        "The object covers too few pixels, or noise and holes leave too little of it; check the mask, the region of "
        "interest and the largest depth.",
    )
    UNSURE_MASK = (
        "unsure mask",
        "The object is hard to segment; give a region of interest, a largest depth, or masks that hold only the "
        "object.",
    )
    CUT_OFF = (
        "cut off by the image",
        "The object, or an arm that is taken for part of it, leaves the image; check the masks in the report.",
    )
    NOT_APPLICABLE = (
        "prior does not apply",
        "These views lack what the prior needs; show it to the camera, or use another prior.",
    )

    label: str
    advice: str

    def __new__(cls, label: str, advice: str) -> Outcome:
        """Make a member whose value is its label."""
        member = object.__new__(cls)
        member._value_ = label
        member.label = label
        member.advice = advice
        return member


_Called = TypeVar("_Called", bound=Callable[..., Any])

_NUMBERS: Final = {float: numbers.Real, int: numbers.Integral, bool: (bool, np.bool_)}  # Python's and NumPy's
_ARRAYS: Final = frozenset(get_args(npt.ArrayLike))


def checked(what: _Called) -> _Called:
    """Refuse arguments of other types than a function, or a dataclass for its fields, states; a decorator.

    Elements of sequences are checked, too; of what becomes an array, only that it is not None.
    """
    function: Any = what.__init__ if inspect.isclass(what) else what
    annotations = {name: str(one.annotation) for name, one in inspect.signature(function).parameters.items()}

    @functools.cache
    def hints() -> dict[str, Any]:  # once it is called: modules may import each other
        return get_type_hints(what)

    @functools.wraps(function)
    def call(*positional: Any, **named: Any) -> Any:
        known = hints()
        for name, value in chain(zip(annotations, positional, strict=False), named.items()):
            if name in known and not _fits(value, known[name]):
                shown = "None" if value is None else f"of type {type(value).__name__}"
                wanted = annotations[name].replace("npt.", "").replace("np.", "").replace(" | ", " or ")
                raise InputError(f"{what.__qualname__}: `{name}` is {shown}; give {wanted}")
        return function(*positional, **named)

    if inspect.isclass(what):
        what.__init__ = call
    return what if inspect.isclass(what) else call  # pyright: ignore[reportReturnType]


def _fits(value: object, hint: Any) -> bool:
    """Return whether a value is of a type."""
    kind, of = get_origin(hint), get_args(hint)
    if kind in (Union, types.UnionType):
        return (value is not None and frozenset(of) >= _ARRAYS) or any(_fits(value, one) for one in of)
    if kind is Literal:
        return any(isinstance(value, type(one)) and value == one for one in of)
    if kind in (tuple, Sequence):  # an array serves as well
        if not isinstance(value, Sequence | np.ndarray) or isinstance(value, str | bytes):
            return False
        return all(map(_fits, value, of if len(of) == len(value) else of[:1] * len(value)))
    wanted = _NUMBERS.get(hint, hint) if kind is None else kind
    return not isinstance(wanted, type | tuple) or isinstance(value, wanted)


MAX_LENGTH_M: Final = 5.0  # beyond the reach of hands and tables: most larger ones are in mm
_LIMITS: Final = {"deg": ("degrees", 180.0), "m": ("metres", MAX_LENGTH_M), "s": ("seconds", 1e4)}
_MAY_BE_ZERO: Final = {"step_sigma_deg", "axis_sigma_deg", "axis_sigma_m", "wobble_deg", "wobble_m"}
_MAX_TURN_DEG = 360.0  # a full turn
_MAX_COORDINATE = 100.0  # in m, or of a direction of any length: most larger ones are in mm


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
    """Check the fields of a dataclass by the units in their names, to be called in `__post_init__`.

    Raises:
        ParameterError: if one is not finite, or out of range.
    """
    for field in fields(component):
        check_parameter(field.name, getattr(component, field.name))


def check_covariance(name: str, covariance: Array) -> None:
    """Check that a covariance (n, n) is finite, symmetric and positive definite."""
    valid = np.isfinite(covariance).all() and np.allclose(covariance, covariance.T, rtol=1e-6, atol=0.0)
    if not valid or np.linalg.eigvalsh(covariance)[0] <= 0.0:
        raise InputError(f"{name} is not a covariance; give a finite, symmetric, positive definite matrix")
