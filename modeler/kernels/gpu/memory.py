"""Arrays of the host on a device."""
# pyright: reportInvalidTypeForm=false

import weakref
from typing import TYPE_CHECKING, Any, cast

import numpy as np

if TYPE_CHECKING:
    wp = cast("Any", None)  # what Warp compiles is no Python to a type checker
else:
    import warp as wp

_sent: dict[tuple[object, ...], wp.array] = {}


def sent(array: np.ndarray, device: str, dtype: Any = None) -> wp.array:
    """Return the copy of a host's array on a device, sent once as long as the host has it; nobody may write to it.

    Args:
        array: of the host.
        device: Warp's name of the device.
        dtype: Warp's type of an element, such as a vector; None = that of a number.
    """
    owner = array
    while isinstance(owner.base, np.ndarray):
        owner = owner.base
    key = (array.__array_interface__["data"][0], array.shape, array.strides, array.dtype.str, device, dtype)
    if key not in _sent:
        _sent[key] = wp.array(array, dtype=Any if dtype is None else dtype, device=device, copy=True)
        weakref.finalize(owner, _sent.pop, key, None)
    return _sent[key]


def forget() -> None:
    """Drop what was sent."""
    _sent.clear()
