"""Names of image files: the role, the frame number and the time of capture that they state."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from modeler.sequences.input_files import frame_number
from modeler.sequences.recording import nearest
from modeler.types import InputError


def frame_numbers(stems: list[str]) -> dict[str, int] | None:
    """Parse frame numbers: whole names, leading digits, or the only digits that differ; None if ambiguous."""
    for numbered in _readings(stems):
        numbers = [frame_number(stem) for stem in numbered]
        known = [number for number in numbers if number is not None]
        if len(set(known)) == len(stems):
            return dict(zip(stems, known, strict=True))
    return None


def _readings(stems: list[str]) -> Iterator[list[str]]:
    """Yield what of names may be their numbers."""
    yield stems
    yield [re.split(r"[^0-9]", stem)[0] for stem in stems]
    yield _differences(stems)


def _differences(stems: list[str]) -> list[str]:
    """Return the digits in which names such as `depth_9` and `depth_10` differ, if nothing else does.

    Time stamps beside a frame number, as in `DepthImage_636000000005000000_1`, may differ too.
    """
    rows = [re.split(r"([0-9]+)", stem) for stem in stems]
    if len({len(row) for row in rows}) != 1:
        return []
    differ = [place for place, words in enumerate(zip(*rows, strict=True)) if len(set(words)) > 1]
    if len(differ) > 1:
        differ = [place for place in differ if not all(len(row[place]) >= _STAMP_DIGITS for row in rows)]
    counted = len(differ) == 1 and differ[0] % 2 == 1 and rows[0][differ[0] - 1] != "."  # which begins a fraction
    return [row[differ[0]] for row in rows] if counted else []


def said_of_angles(numbers: Iterable[int]) -> tuple[str, ...]:
    """Say so if frame numbers look like a turntable's angles in degrees: equal steps around a whole turn."""
    places = sorted(numbers)
    step = math.gcd(*(after - before for before, after in itertools.pairwise(places)))
    # Views farther apart share no surface.
    if not 1 < step <= 90 or places[-1] - places[0] not in (360 - step, 360) or 360 % step:
        return ()
    return (
        f"frame numbers look like angles, in steps of {step}°; if they are, give `prior` turntable and `step_deg` 1",
    )


_STAMP_DIGITS: Final = 10  # of seconds since 1970, the shortest stamp
_STAMP: Final = re.compile(
    r"(?<![0-9])(1[0-9]{9}|1[0-9]{12}|1[0-9]{15}|1[0-9]{18}|6[0-9]{17})(?![0-9])(?:[._]([0-9]{1,9}))?"
)
"""Time since 1970 in s, ms, microseconds or ns, or since the year 1 in 100 ns; only seconds have fractions."""
_UNITS_S: Final = {10: 1.0, 13: 1e-3, 16: 1e-6, 18: 1e-7, 19: 1e-9}
_FRACTION: Final = re.compile(r"[0-9]{1,9}\.[0-9]+")


def stamps_s(stems: Sequence[str]) -> dict[str, float] | None:
    """Parse times in s by name, all different; None if a name states none."""
    found: dict[str, float] = {}
    for stem in stems:
        stamp = _STAMP.search(stem)
        if _FRACTION.fullmatch(stem):
            found[stem] = float(stem)
        elif stamp is None:
            return None
        elif len(stamp[1]) == _STAMP_DIGITS:
            found[stem] = float(f"{stamp[1]}.{stamp[2] or '0'}")
        else:
            found[stem] = int(stamp[1]) * _UNITS_S[len(stamp[1])]
    return found if len(set(found.values())) == len(stems) else None


_ROLES: Final = {
    "depth": ("depth", "depths", "depthmap", "depthimage"),
    "mask": ("mask", "masks", "seg", "segmentation", "silhouette"),
    "confidence": ("confidence", "conf"),
    "colour": ("color", "colour", "rgb", "image", "img"),
}
_WORDS: Final = re.compile(r"[._\-\s]+|(?<=[a-z])(?=[A-Z])")


def role_of(stem: str) -> tuple[str | None, str]:
    """Return the role that a name such as `frame-000000.depth` or `7_mask` states, and the name without it."""
    words = _WORDS.split(stem)
    roles = [next((role for role, names in _ROLES.items() if word.lower() in names), None) for word in words]
    found = next((role for role in _ROLES if role in roles), None)
    return found, "_".join(word for word, role in zip(words, roles, strict=True) if role is None)


def partners(
    found: Mapping[str, Path], depth: Iterable[str], what: str
) -> tuple[dict[str, Path], list[Path], tuple[str, ...]]:
    """Return images by the name of the depth image to which they belong, the other images, and remarks.

    Images belong together by name; by frame number; by the time stamps in their names, the nearest within half the
    time from one depth image to the next; or, of as many images, by order.
    """
    depth = list(depth)
    if not found:
        return {}, [], ()
    remarks: list[str] = []
    same = {stem: found[stem] for stem in depth if stem in found}
    ours_s, theirs_s = stamps_s(depth), stamps_s(list(found))
    best = same
    if len(same) < min(len(depth), len(found)) and ours_s is not None and theirs_s is not None:
        best, apart_s = _nearest_in_time(found, ours_s, theirs_s)
        if best:
            remarks.append(f"{what} belong to depth images by the times in their names, up to {_time(apart_s)} apart")
    elif len(same) < len(depth):
        ours, theirs = frame_numbers(depth) or {}, frame_numbers(list(found)) or {}
        named = {number: stem for stem, number in theirs.items()}
        alike = {stem: found[named[number]] for stem, number in ours.items() if number in named}
        best = alike if len(alike) > len(same) else same
    if not best and len(found) == len(depth):
        best = dict(zip(depth, found.values(), strict=True))
        remarks.append(f"{what} belong to depth images by order: neither names, numbers nor times match")
    if not best:
        raise InputError(
            f"{next(iter(found.values())).parent}: its {len(found)} images cannot be matched with the {len(depth)} "
            "depth images; give those of one frame the same name."
        )
    used = set(map(id, best.values()))  # which hashes faster than paths
    return best, [path for path in found.values() if id(path) not in used], tuple(remarks)


def _nearest_in_time(
    found: Mapping[str, Path], ours_s: Mapping[str, float], theirs_s: Mapping[str, float]
) -> tuple[dict[str, Path], float]:
    """Return images by the name of the depth image nearest in time, each once, and the largest difference in s."""
    times_s, others, names = list(ours_s.values()), list(theirs_s.values()), list(theirs_s)
    period_s = float(np.median(np.diff(np.sort(times_s)))) if len(times_s) > 1 else np.inf
    back = nearest(others, times_s, 0.5 * period_s)
    best, apart_s = {}, 0.0
    for place, (stem, other) in enumerate(zip(ours_s, nearest(times_s, others, 0.5 * period_s), strict=True)):
        if other is not None and back[other] == place:
            best[stem] = found[names[other]]
            apart_s = max(apart_s, abs(others[other] - times_s[place]))
    return best, apart_s


def _time(seconds: float) -> str:
    return f"{seconds * 1000.0:.0f} ms" if seconds < 10.0 else f"{seconds:.1f} s"
