"""Array types, the error for unusable input, the check of arguments, and outcomes of attempts."""

from __future__ import annotations

import enum
import functools
import inspect
import numbers
import types
from collections.abc import Callable, Sequence
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
        "The object covers too few pixels; check the mask, the region of interest and the largest depth.",
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

    Raises:
        InputError: when it is called with one; the error names it.
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
