"""The ablation study: every variant registers a pair, and its table marks what differs by more than chance."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from slow_cases import sampled

from modeler.evaluation import true_motion
from modeler.priors import GeneralPrior
from modeler.sequences import bundled, open_sequence
from modeler.views import Sensor
from studies.ablation.__main__ import registered
from studies.ablation.pairs import Case
from studies.ablation.tables import table
from studies.ablation.variants import VARIANTS, Variant


@pytest.fixture(scope="module")
def case() -> Case:
    """Return the first two frames of the bundled box."""
    sequence = open_sequence(bundled("box"))
    truth, noise = sequence.truth(), sequence.sensor()
    assert truth is not None
    assert noise is not None
    target, source = (Sensor(noise).ray_image(sequence.frame(index)) for index in (0, 1))
    density = GeneralPrior().between(source, target)
    return Case("shapes", "box", "n-fold", "general", source, target, density, true_motion(truth, 0, 1), 0)


@pytest.mark.parametrize("variant", sampled(VARIANTS, every=20), ids=lambda variant: f"{variant.kind} {variant.name}")
def test_every_variant_registers_an_easy_pair(variant: Variant, case: Case) -> None:
    record = registered(variant, case)
    assert record["usable"], record
    assert float(str(record["error_deg"])) < 5.0


def test_variants_have_names_of_their_own() -> None:
    assert len({(variant.name, variant.kind) for variant in VARIANTS}) == len(VARIANTS)


def test_the_table_marks_what_differs_by_more_than_chance(tmp_path: Path) -> None:
    rng, kinds = np.random.default_rng(0), {"a": "default", "b": "default", "worse": "removed", "alike": "removed"}
    records = [
        {
            "block": "0",
            "variant": name,
            "kind": kind,
            "case": str(case),
            "group": "shapes",
            "symmetry": "n-fold",
            "usable": True,
            "error_deg": (3.0 if name == "worse" else 1.0) * float(rng.uniform(0.5, 1.5)),
            "nees": float(rng.chisquare(6)),
            "seconds": 2.0 if name == "worse" else 1.0,
        }
        for name, kind in kinds.items()
        for case in range(100)
    ]
    file = tmp_path / "records.jsonl"
    file.write_text("".join(json.dumps(record) + "\n" for record in records))
    rows = {line.split(" | ")[0].strip("| "): line for line in table(file).splitlines() if line.startswith("|")}
    assert "**" in rows["worse"]
    assert "**" not in rows["alike"]
    assert rows["worse"].rstrip("| ").endswith("2.00")
