"""The ablation study: every variant registers a pair, and its table marks what differs by more than chance."""

import json
from pathlib import Path

import numpy as np
import pytest
from bundled_views import views
from slow_cases import sampled

from modeler.priors import GeneralPrior
from studies.ablation.__main__ import registered
from studies.ablation.pairs import Case
from studies.ablation.tables import table
from studies.ablation.variants import VARIANTS, Variant


@pytest.fixture(scope="module")
def case() -> Case:
    """Return the first two frames of the bundled box."""
    source, target, truth = views("box", 1, 0)
    return Case("shapes", "box", "n-fold", "general", source, target, GeneralPrior().between(source, target), truth, 0)


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
