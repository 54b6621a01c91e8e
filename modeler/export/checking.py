"""Whether what stands in `report.json` is what `modeler` writes there, before anything relies on it."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from modeler import se3
from modeler.types import Outcome

Test = Callable[[Any], bool]
_FARTHEST_M, _WIDEST, _NARROWEST = 1e6, 1e9, 1e-30
_ROUND = 1e-6


def fault(report: Mapping[str, Any]) -> str | None:
    """Return what is wrong with a report, in words; None where nothing is.

    What other programs may leave out, or add, is not looked at.
    """
    for name, test in _WHOLE.items():
        if not test(report.get(name)):
            return f"{name!r} is missing or is not what it should be"
    for name, tests in (("frames", _FRAME), ("edges", _EDGE), ("poses", _POSE)):
        for place, record in enumerate(report[name]):
            wrong = _wrong(record, tests) or _impossible(record)
            if wrong is not None:
                return f"{wrong} of entry {place} of {name!r} is missing or is not what it should be"
    if not {pose["id"] for pose in report["poses"]} <= {frame["id"] for frame in report["frames"]}:
        return "'poses' has frames that 'frames' has not"
    wrong = _wrong(report["settings"], _SETTINGS, may_lack=frozenset(_SETTINGS))
    return None if wrong is None else f"{wrong} of 'settings' is not what it should be"


def _wrong(record: Any, tests: Mapping[str, Test], may_lack: frozenset[str] = frozenset({"modes"})) -> str | None:
    if not isinstance(record, dict):
        return "all"
    for name, test in tests.items():
        if not test(record[name]) if name in record else name not in may_lack:
            return repr(name)
    return None


def _impossible(record: Mapping[str, Any]) -> str | None:
    """Return which pose of an edge that takes part, or of a frame, is no motion, or which covariance is none."""
    if not record.get("accepted", "object_from_camera" in record):
        return None
    for part in (record, *(record.get("modes") or ())):
        for name in ("target_from_source", "object_from_camera"):
            if name in part and not _rigid(part[name]):
                return repr(name)
        if not _definite(part["covariance"], 0.0 if "accepted" in record else -_ROUND):
            return "'covariance'"
    return None


def _rigid(numbers: list[float | None]) -> bool:
    pose = np.array(numbers, dtype=np.float64).reshape(4, 4)
    return se3.is_rigid(pose, tolerance=_ROUND, farthest_m=_FARTHEST_M)


def _definite(numbers: list[float | None], least: float) -> bool:
    covariance = np.array(numbers, dtype=np.float64).reshape(6, 6)
    if not (np.abs(covariance) < _WIDEST).all():  # not so of NaN
        return False
    sigmas = np.sqrt(np.maximum(np.diag(covariance), _NARROWEST))
    correlation = covariance / np.outer(sigmas, sigmas)
    return bool(np.abs(correlation - correlation.T).max() < _ROUND and np.linalg.eigvalsh(correlation)[0] > least)


def _whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**62


def _number(value: Any) -> bool:
    """Return whether it is a number that floats hold: JSON's whole numbers may be of any size, and NaN is none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _known(value: Any) -> bool:
    """Return whether it is a number, or null for one that is not finite."""
    return value is None or _number(value)


def _is(kind: type) -> Test:
    return lambda value: isinstance(value, kind)


def _null_or(test: Test) -> Test:
    return lambda value: value is None or test(value)


def _numbers(count: int) -> Test:
    return lambda value: isinstance(value, list) and len(value) == count and all(map(_known, value))


def _direction(value: Any) -> bool:
    return _numbers(3)(value) and None not in value and abs(math.hypot(*value) - 1.0) < _ROUND


def _modes(value: Any) -> bool:
    return isinstance(value, list) and all(_wrong(mode, _MODE) is None for mode in value)


_WHOLE: dict[str, Test] = {
    "sequence": _is(str),
    "settings": _is(dict),
    "frames": _is(list),
    "edges": _is(list),
    "poses": _is(list),
    "closed": _is(bool),
    "trustworthy": _is(bool),
    "reasons": lambda value: isinstance(value, list) and all(map(_is(str), value)),
    "seconds": lambda value: isinstance(value, dict) and all(map(_number, value.values())),
    "up": _null_or(_direction),
}
_FRAME: dict[str, Test] = {"id": _whole, "timestamp": _number, "points": _whole, "outcome": _is(str)}
_POSE: dict[str, Test] = {"id": _whole, "object_from_camera": _numbers(16), "covariance": _numbers(36)}
_MODE: dict[str, Test] = {"weight": _known, "target_from_source": _numbers(16), "covariance": _numbers(36)}
_EDGE: dict[str, Test] = {
    "source": _whole,
    "target": _whole,
    "kind": lambda value: value in ("odometry", "closure"),
    "accepted": _is(bool),
    "outcome": lambda value: value in [outcome.label for outcome in Outcome],
    "target_from_source": _numbers(16),
    "covariance": _numbers(36),
    "information": _null_or(_numbers(36)),
    "modes": _null_or(_modes),
    "overlap": _known,
    "effective_samples": _known,
    "pareto_k": _known,
    "log_evidence": _known,
    "seconds": _known,
}
_SETTINGS: dict[str, Test] = {
    "joined": lambda value: isinstance(value, list) and len(value) == 2 and all(map(_is(str), value)),
    "offset": _whole,
    "sensor": _is(str),
    "roi": _null_or(lambda value: isinstance(value, list) and len(value) == 4 and all(map(_whole, value))),
    "max_depth_m": _null_or(_number),
    "voxel_m": _null_or(_number),
}
