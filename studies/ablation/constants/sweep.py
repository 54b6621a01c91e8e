"""Halve and double each named number of some rooms, and measure what the stages that use it make of the same inputs.

Each variant runs in a process of its own, forked after all inputs are computed, with the modules that depend on the
number imported again. Every result is written as it comes, and a study that was stopped goes on where it was.
"""

from __future__ import annotations

import importlib
import json
import os
import resource
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from studies.ablation.constants import inputs, source
from studies.ablation.constants.source import Number

_STUDY: Final = "studies.ablation.constants"
STAGES: Final = {
    "masks": "masks",
    "planes": "masks",
    "surface": "surfaces",
    "preview": "surfaces",
    "closed": "surfaces",
    "symmetries": "surfaces",
    "alignment": "surfaces",
    "pairs": "pairs",
    "poses": "builds",
    "densities": "densities",
}
"""The stages, each a function of a module of this study."""
_FACTORS: Final = (0.5, 2.0)
Case = tuple[str, str]
"""A stage and the name of its input."""
ROOMS: Final = ("segmentation", "fusion", "closure", "graph", "priors", "views", "registration")
_LONGEST: Final = 6.0  # times as long as with the default numbers, and
_LONGEST_S: Final = 20.0  # so many seconds more, after which a variant is given up


def cases(data: Path, bundled: Path, rooms: Sequence[str] = ROOMS, *, few: bool = False) -> dict[Case, Any]:
    """Return the inputs of the stages that rooms need, by stage and name.

    Args:
        data: folder of captures.
        bundled: folder of the rendered sequences that come with the package.
        rooms: whose numbers are varied.
        few: whether one input of each stage does.
    """
    found: dict[Case, Any] = {}
    if "segmentation" in rooms:
        found |= _masks(data, bundled, few=few)
    if {"fusion", "priors"} & set(rooms):
        box = _posed(bundled / "box")
        found |= {
            (stage, "box"): box for stage in ("densities", "surface", "preview", "closed", "symmetries", "alignment")
        }
    if {"views", "registration"} & set(rooms):
        found["pairs", "six sequences"] = _pairs(data, bundled)
    if set(rooms) <= {"segmentation", "views", "registration"}:
        return found  # which no whole build measures
    if {"closure", "graph", "priors"} & set(rooms) or not few:
        found["poses", "dragon"] = _footage(data / "dragon", "dragon", slice(None), exact=True)
    if not few:
        found["poses", "cap"] = _footage(data / "cap", "cap", slice(None, None, 2))
        tube = _footage(bundled / "tube", STEP_KNOWN, slice(None))
        found["poses", STEP_KNOWN] = replace(tube, step_deg=25.0)
    for (stage, name), footage in list(found.items()):
        if stage == "poses":
            last = _registered(footage)
            if name == "cap" and "fusion" in rooms:
                trajectory = last.solution.trajectory
                covariances = {frame: last.solution.covariances[frame] for frame in trajectory}
                found["surface", name] = inputs.Posed(name, last.views, trajectory, covariances)
    return found


def _masks(data: Path, bundled: Path, *, few: bool) -> dict[Case, Any]:
    """Return frames to be segmented, with the masks that the default numbers find."""
    from modeler.sequences import open_sequence
    from studies.ablation.constants import masks

    found: dict[Case, Any] = {}
    for name, every, most in _MASKS[: 1 if few else None]:
        sequence = open_sequence(data / name)
        frames = [replace(sequence.frame(index), mask=None) for index in sequence.indices[::every][:most]]
        found["masks", name] = inputs.Footage(name, frames)
    tube = _footage(bundled / "tube", "tube", slice(6))
    true = [frame.mask for frame in tube.frames if frame.mask is not None]
    found["masks", "tube"] = replace(tube, frames=[replace(one, mask=None) for one in tube.frames], true_masks=true)
    found["masks", "box, masks given"] = _footage(bundled / "box", "box, masks given", slice(6))
    found |= {("planes", name): found["masks", name] for name in ("cap", "box, masks given")}
    for footage in found.values():
        if not footage.found:
            masks.masks(footage)
    return found


def _pairs(data: Path, bundled: Path) -> list[inputs.Footage]:
    """Return the frames whose pairs are registered, with the masks that the default numbers find."""
    from studies.ablation.constants import masks

    found = [_footage(bundled / name, name, slice(3)) for name in ("box", "tube")]
    for name, some in _PAIRS:
        found.append(_footage(data / name, name, some, exact=name == "dragon"))
    for footage in found:
        masks.masks(footage)
    return found


def _posed(folder: Path) -> inputs.Posed:
    """Return the first views of a rendered sequence with their true poses."""
    from modeler import se3
    from modeler.pipeline import Modeler
    from modeler.sequences import open_sequence

    sequence, modeler = open_sequence(folder), Modeler()
    frames, truth = [sequence.frame(index) for index in sequence.indices[:7]], sequence.truth()
    assert truth is not None
    scene = modeler.segmenter.scene(frames)
    views = {frame.index: modeler.prepare(frame, scene).view for frame in frames}
    trajectory = {frame.index: se3.inverse(truth[frame.index]) for frame in frames}
    return inputs.Posed(folder.name, {k: view for k, view in views.items() if view is not None}, trajectory, {})


def _registered(footage: inputs.Footage) -> Any:
    """Segment frames and register their pairs, so that they are known; return the last step."""
    from studies.ablation.constants import builds, masks

    masks.masks(footage)
    return builds.run(footage)


_MASKS: Final = (
    ("cap", 3, 7),
    ("figure", 4, 6),
    ("plant", 2, 6),
    ("bear", 1, 6),
    ("iron", 5, 6),
    ("kleenex", 4, 6),
    ("dog_upright", 1, 6),
    ("carton", 4, 5),
)
"""Captures, every how manyth of their frames, and how many at most."""
_PAIRS: Final = (
    ("dragon", slice(3)),
    ("dragon", slice(0, 6, 2)),
    ("bear", slice(3)),
    ("kleenex", slice(0, 6, 2)),
    ("cap", slice(0, 6, 2)),
)
"""Captures with reference poses, and which of their frames follow each other."""
STEP_KNOWN: Final = "tube, step known"
"""A rendered sequence under the prior of a turntable, which only that prior's numbers change."""


def _footage(folder: Path, name: str, some: slice, *, exact: bool = False) -> inputs.Footage:
    from modeler.sequences import open_sequence

    sequence = open_sequence(folder)
    frames = [sequence.frame(index) for index in sequence.indices[some]]
    return inputs.Footage(name, frames, truth=sequence.truth(), is_focal_exact=exact)


def stages_of(number: Number, names: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return the stages, with their inputs, that may depend on a number, by its room and module."""
    module = number.module.rpartition(".")[2]
    if number.room not in ("segmentation", "fusion") and module not in ("axis", "common_axis", "turntable"):
        names = [one for one in names if one != ("poses", STEP_KNOWN)]
    match number.room, module:
        case "segmentation", "planes":
            wanted = ("planes", "masks")
        case "segmentation", _:
            wanted = ("masks",)
        case "fusion", "alignment":
            wanted = ("alignment",)
        case "fusion", "symmetries" | "paint":
            wanted = ("symmetries",)
        case "fusion", "watertight":
            wanted = ("closed",)
        case "fusion", "by_focal":
            wanted = ("poses",)
        case "fusion", _:
            wanted = ("preview",) if number.name.startswith("PREVIEW") else ("surface",)
        case "priors", _:
            wanted = ("densities", "poses")  # in this order
        case "views" | "registration", _:
            wanted = ("pairs",)
        case _:
            wanted = ("poses",)
    return [one for stage in wanted for one in names if one[0] == stage]


def run(
    found: Mapping[tuple[str, str], Any], numbers: Sequence[Number], out: Path, *, every_input: bool = False
) -> None:
    """Measure the variants that are not measured yet, and append each to a file.

    Args:
        found: inputs by stage and name.
        numbers: to vary.
        out: one line a measurement.
        every_input: whether all inputs are measured; else those of a number end with the first that differs.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    lines = out.read_text().splitlines() if out.exists() else []
    records = [json.loads(line) for line in lines]
    done = {(one["number"], one["factor"], one["stage"], one["input"]) for one in records}
    spent: dict[tuple[str, str], float] = {}
    defaults: dict[tuple[str, str], object] = {}
    source.imports()  # here, so that no child has to read all sources again
    with out.open("a") as stream:

        def written(record: Mapping[str, object]) -> None:
            print(json.dumps(record), file=stream, flush=True)

        for case in found:
            (result,) = _in_child(None, 1.0, {case: found[case]}, {}, 600.0)
            spent[case], defaults[case] = float(result.get("seconds", 0.0)), result.get("digest")
            print(f"{' of '.join(case)}: {spent[case]:.1f} s", file=sys.stderr, flush=True)
            if ("", 1.0, *case) not in done:
                written({"number": "", "factor": 1.0, **result})
        for number in numbers:
            for factor in _FACTORS:
                earlier = [one for one in records if (one["number"], one["factor"]) == (number.key, factor)]
                measured = {(one["stage"], one["input"]): one.get("digest") for one in earlier}
                if not every_input and any(one != defaults.get(case) for case, one in measured.items()):
                    continue
                wanted = [case for case in stages_of(number, list(found)) if case not in measured]
                if not wanted:
                    continue
                limit_s = _LONGEST * sum(spent[case] for case in wanted) + _LONGEST_S
                until = {} if every_input else defaults
                for result in _in_child(number, factor, {case: found[case] for case in wanted}, until, limit_s):
                    written({"number": number.key, "factor": factor, **result})


def _in_child(
    number: Number | None, factor: float, given: Mapping[Case, Any], until: Mapping[Case, object], limit_s: float
) -> list[dict[str, Any]]:
    """Return the figures of stages with a number changed, or the error, from a forked process.

    Args:
        number: to change; None: none.
        factor: of it.
        given: inputs by stage and name.
        until: the first result with another digest than these is the last.
        limit_s: processor time after which it ends.
    """
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        resource.setrlimit(resource.RLIMIT_CPU, (int(limit_s) + 1, int(limit_s) + 2))
        if number is not None:
            source.put_in_place(number, factor, [f"{_STUDY}.{module}" for module in STAGES.values()])
        for (stage, name), inputs_of in given.items():
            began = time.process_time()
            try:
                figures = getattr(importlib.import_module(f"{_STUDY}.{STAGES[stage]}"), stage)(inputs_of)
                result = {**figures, "seconds": round(time.process_time() - began, 2)}
            except Exception as error:
                result = {"error": f"{type(error).__name__}: {error}"[:200]}
            os.write(writing, (json.dumps({"stage": stage, "input": name, **result}) + "\n").encode())
            if (stage, name) in until and result.get("digest") != until[stage, name]:
                break
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as stream:
        results = [json.loads(line) for line in stream.read().splitlines()]
    if os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) != 0:
        stage, name = list(given)[len(results)]
        results.append({"stage": stage, "input": name, "error": f"no end within {limit_s:.0f} s"})
    return results


def numbers_of(rooms: Sequence[str]) -> Iterator[Number]:
    """Yield the numbers of rooms."""
    return (number for number in source.all_numbers() if number.room in rooms)
