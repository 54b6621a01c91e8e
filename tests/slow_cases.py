"""Marks long lists of cases: some of them in every run of the tests, the rest in `make test-slow`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def sampled(cases: Iterable[Any], *, every: int, fast: int = 0) -> list[Any]:
    """Return cases for `parametrize`, all slow but every so many, counted from the one numbered `fast`."""
    return [
        case if number % every == fast else pytest.param(case, marks=pytest.mark.slow)
        for number, case in enumerate(cases)
    ]
