"""`modeler demo-active`: a robot that does what is suggested, from its first view to a run folder."""

from __future__ import annotations

import json
from pathlib import Path

from command_runner import FILES, Run

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


def test_a_robot_turns_the_object_as_suggested_and_leaves_a_run(cli: Run, tmp_path: Path) -> None:
    recipe, out = tmp_path / "step.json", tmp_path / "demo"
    recipe.write_text(json.dumps(RECIPE))
    ended = cli("demo-active", "--shape", recipe, "--actions", "2", "--out", out)
    assert ended.status in (0, 3)  # two turns are rarely enough
    assert "turn by " in ended.err
    report = json.loads((out / "run" / "report.json").read_text())
    assert [frame["id"] for frame in report["frames"]] == [0, 1, 2]
    assert {path.name for path in (out / "run").iterdir()} >= FILES
    again = cli("suggest", out / "run")
    assert again.status == 0
    assert "of the visible surface observed" in again.err


def test_what_the_robot_cannot_do_is_refused(cli: Run, tmp_path: Path) -> None:
    for options in (("--actions", "0"), ("--until-seen", "2"), ("--shape", "nothing")):
        ended = cli("demo-active", *options, "--out", tmp_path / "demo")
        assert (ended.status, ended.out, ended.err.count("\n")) == (2, "", 1)
        assert not (tmp_path / "demo").exists()
