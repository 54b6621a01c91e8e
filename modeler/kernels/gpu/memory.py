"""Copies of host arrays on a device."""
# pyright: reportInvalidTypeForm=false

import weakref
from typing import TYPE_CHECKING, Any, cast

import numpy as np

if TYPE_CHECKING:
    wp = cast("Any", None)  # type checkers do not understand Warp kernels
else:
    import warp as wp

_sent: dict[tuple[object, ...], wp.array] = {}


def sent(array: np.ndarray, device: str, dtype: Any = None) -> wp.array:
    """Return the copy of a host array on a device, cached while the host array exists; it must not be modified.

    Args:
        array: of the host.
        device: name of the Warp device.
        dtype: Warp type of an element, such as a vector; None = a number.
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
    """Drop all copies."""
    _sent.clear()
