"""Marks long lists of cases: some of them in every run of the tests, the rest in `make test-slow`."""

from collections.abc import Iterable
from typing import Any

import pytest


def sampled(cases: Iterable[Any], *, every: int, fast: int = 0) -> list[Any]:
    """Return cases for `parametrize`, all slow but every so many, counted from the one numbered `fast`."""
    return [case if number % every == fast else _slow(case) for number, case in enumerate(cases)]


def quick_first(cases: Iterable[Any], count: int = 1) -> list[Any]:
    """Return cases for `parametrize`, all slow but the first."""
    return [case if number < count else _slow(case) for number, case in enumerate(cases)]


def _slow(case: Any) -> Any:
    return pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.slow)
