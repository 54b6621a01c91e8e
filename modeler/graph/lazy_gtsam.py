"""GTSAM, imported when it is first used: that takes 0.07 s, and no pair of views needs it."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gtsam import *  # noqa: F403  # pyright: ignore[reportWildcardImportFromLibrary]


def __getattr__(name: str) -> object:
    """Return what GTSAM calls so."""
    value = globals()[name] = getattr(importlib.import_module("gtsam"), name)
    return value
