"""The demonstration of suggestions: a robot that does what is suggested, from its first view to a run folder."""

import json
from pathlib import Path

import pytest
from command_runner import FILES, Run

from studies.active.demo import main

RECIPE = {
    "name": "step",
    "object": {
        "kind": "compound",
        "parts": [
            {"shape": {"kind": "box", "size_m": [0.09, 0.05, 0.04]}},
            {"shape": {"kind": "box", "size_m": [0.03, 0.05, 0.05]}, "offset_m": [0.03, 0.0, 0.045]},
        ],
    },
    "view": {"width": 160, "height": 120, "focal_px": 143.75, "distance_m": 0.5},
}


@pytest.mark.slow
def test_a_robot_turns_the_object_as_suggested_and_leaves_a_run(
    cli: Run, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    recipe, out = tmp_path / "step.json", tmp_path / "demo"
    recipe.write_text(json.dumps(RECIPE))
    assert main(["--shape", str(recipe), "--actions", "1", "--out", str(out)]) in (0, 3)  # one turn is rarely enough
    assert "turn by " in capfd.readouterr().err
    report = json.loads((out / "run" / "report.json").read_text())
    assert [frame["id"] for frame in report["frames"]] == [0, 1]
    assert {path.name for path in (out / "run").iterdir()} >= FILES
    again = cli("suggest", out / "run")
    assert again.status == 0
    assert "of the visible surface observed" in again.err


def test_a_shape_that_is_not_known_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["--shape", "nothing", "--out", str(tmp_path / "demo")]) == 2
    assert capfd.readouterr().err.count("\n") == 1
    assert not (tmp_path / "demo").exists()
