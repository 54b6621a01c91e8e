"""The study that halves and doubles every named number."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modeler.sequences import bundled, open_sequence
from studies.ablation.constants import builds, masks, pairs
from studies.ablation.constants.inputs import Footage
from studies.ablation.constants.source import Number, changed, dependents, numbers_in
from studies.ablation.constants.tables import RESULTS, on_page, table
from studies.numbers import table as counts

SOURCE = '''"""Words."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

COUNT, SHARE = 5, 0.8
_WIDTH_M = 0.6
_COSINE = np.cos(np.radians(60.0))
_SURE = 1.0 - 1e-3
NAMES = ("a", "b")
EMPTY = np.zeros((0, 3))


@dataclass
class Part:
    """Words."""

    limits: tuple[float, float] = (0.25, 3.0)
    passes: int = field(default=1)
    offset: float = 0.0
'''


def values(name: str, factor: float) -> dict[str, Any]:
    """Names of the source with one number changed."""
    number = next(one for one in numbers_in("modeler.some", SOURCE) if one.name == name)
    found: dict[str, Any] = {"__name__": __name__}
    exec(changed(SOURCE, number, factor), found)
    return found


def test_numbers_are_named_constants_and_defaults_other_than_zero() -> None:
    names = [number.name for number in numbers_in("modeler.some", SOURCE)]
    assert names == ["COUNT", "SHARE", "_WIDTH_M", "_COSINE", "_SURE", "Part.limits", "Part.passes"]


@pytest.mark.parametrize(
    ("name", "factor", "expected"),
    [
        ("COUNT", 2.0, 10),
        ("COUNT", 0.5, 2),
        ("SHARE", 0.5, 0.4),
        ("SHARE", 2.0, 0.9),  # half of the way to 1
        ("_WIDTH_M", 2.0, 1.2),
        ("_COSINE", 0.5, np.cos(np.radians(30.0))),
        ("_SURE", 2.0, 0.998),
    ],
)
def test_only_the_number_in_question_changes(name: str, factor: float, expected: float) -> None:
    before, after = values("Part.limits", 1.0), values(name, factor)
    assert after[name] == pytest.approx(expected)
    assert type(after[name]) is type(before[name])
    for other in {"COUNT", "SHARE", "_WIDTH_M", "_COSINE", "_SURE"} - {name}:
        assert after[other] == before[other]
    assert after["Part"]().limits == (0.25, 3.0)


def test_defaults_of_fields_change() -> None:
    part = values("Part.limits", 2.0)["Part"]
    assert (part().limits, part().passes) == ((0.5, 6.0), 1)
    assert values("Part.passes", 2.0)["Part"]().passes == 2


def test_what_depends_on_a_module_is_imported_again() -> None:
    found = dependents("modeler.segmentation.planes")
    assert {"modeler.segmentation.planes", "modeler.segmentation", "modeler.pipeline.modeler"} <= found
    assert not {"modeler", "modeler.types.views", "modeler.fusion.fuser"} & found


def test_rooms_are_counted() -> None:
    numbers = [
        Number("modeler.a.b", "_C", 1, "1"),
        Number("modeler.a.b", "D.e", 2, "2"),
        Number("modeler.f", "G", 1, "3"),
    ]
    assert "| a | 1 | 1 | 2 |" in counts(numbers)
    assert "| . | 1 | 0 | 1 |" in counts(numbers)
    assert "| all | 2 | 1 | 3 |" in counts(numbers)


def test_the_page_states_the_results() -> None:
    page = Path(__file__).parents[1] / "docs" / "ablation.md"
    assert on_page(page.read_text(), table(RESULTS)) == page.read_text()


def test_stages_register_frames_with_the_masks_found() -> None:
    sequence = open_sequence(bundled("tube"))
    frames = [sequence.frame(index) for index in sequence.indices[:3]]
    footage = Footage("tube", frames, truth=sequence.truth(), is_focal_exact=True)
    masks.masks(footage)
    assert pairs.pairs([footage])["usable"] == 2.0
    assert builds.poses(footage)["placed"] == 3.0
