"""Arguments of public functions and classes, checked against their annotations."""

from __future__ import annotations

import functools
import inspect
import numbers
import types
from collections.abc import Callable, Sequence
from itertools import chain
from typing import Any, Final, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
import numpy.typing as npt

from modeler.types.base import InputError

T = TypeVar("T", bound=Callable[..., Any])

_NUMBERS: Final = {float: numbers.Real, int: numbers.Integral, bool: (bool, np.bool_)}  # Python's and NumPy's
_ARRAYS: Final = frozenset(get_args(npt.ArrayLike))


def checked(what: T) -> T:
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
