"""Array types, the error for unusable input, and outcomes of attempts."""

from __future__ import annotations

import enum
from collections.abc import Sequence
from typing import TypeVar

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
