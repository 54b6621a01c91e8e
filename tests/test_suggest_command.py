"""`modeler suggest`: what it prints, how it ends, and which files of candidates it takes."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from command_runner import Run
from input_errors import refused

from modeler.composition.candidate_file import read_candidates

FIELDS = {"action", "gain_nats", "new_surface", "words"}
POSE = [1.0, 0.0, 0.0, 0.01, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]


def test_a_run_gets_a_ranked_list_of_words(cli: Run, built: Path) -> None:
    ended = cli("suggest", built)
    assert ended.status == 0
    lines = ended.out.splitlines()
    assert len(lines) == 8
    assert lines[0].startswith(("turn by ", "poke at "))
    assert all("% new surface" in line for line in lines)
    assert "of the visible surface observed" in ended.err
    assert ended == cli("suggest", built)


def test_programs_get_json_of_the_same_list(cli: Run, built: Path, tmp_path: Path) -> None:
    given = tmp_path / "candidates.json"
    given.write_text(
        json.dumps(
            [
                {"kind": "turn", "turn_deg": 20, "cost": 2},
                {"kind": "poke", "point_m": [0, 0, 0.8], "direction": [1, 0, 0], "length_m": 0.02},
                {"kind": "lay"},
                {"kind": "pose", "name": "grasp 3", "new_from_last": POSE, "sigma_deg": 1, "sigma_m": 0.002},
            ]
        )
    )
    ended = cli("suggest", built, "--candidates", given, "--json")
    found = json.loads(ended.out)
    assert {each["action"] for each in found} == {"turn", "poke", "lay", "pose"}
    assert all(each.keys() >= FIELDS for each in found)
    gains = [each["worth_nats"] / each["cost"] for each in found]
    assert gains == sorted(gains, reverse=True)
    assert next(each for each in found if each["action"] == "turn")["turn_deg"] == 20
    assert "grasp 3" in next(each for each in found if each["action"] == "pose")["words"]


def test_what_the_prior_excludes_is_said(cli: Run, built: Path, tmp_path: Path) -> None:
    given = tmp_path / "candidates.json"
    given.write_text('[{"kind": "turn", "turn_deg": 170}]')
    ended = cli("suggest", built, "--candidates", given)
    assert (ended.status, ended.out) == (0, "")
    assert "1 of 1 candidates are excluded by the run's prior" in ended.err


def test_a_goal_decides_the_status(cli: Run, built: Path) -> None:
    near, far = cli("suggest", built, "--until-seen", "0.1"), cli("suggest", built, "--until-seen", "1")
    assert (near.status, far.status) == (0, 3)
    assert "\nmodeler: goal reached: " in near.err
    assert "\nmodeler: goal not reached: " in far.err
    assert cli("suggest", built, "--until-sigma-mm", "0.001", "--until-seen", "0.1").status == 3


@pytest.mark.parametrize(
    "options", [("--until-seen", "1.5"), ("--until-seen", "0"), ("--until-sigma-mm", "nan"), ("--until-pose-deg", "-1")]
)
def test_goals_out_of_range_are_refused(refusal: Callable[..., str], built: Path, options: tuple[str, str]) -> None:
    assert options[0] in refusal("suggest", built, *options)


def test_poses_may_come_as_a_table(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text("name,cost,tx,ty,tz,qx,qy,qz,qw\nleft,2,0.1,0,0,0,0,0,1\n,1,0,0,0,0,0.7071068,0,0.7071068\n")
    left, second = read_candidates(path)
    assert (left.name, left.cost, second.name) == ("left", 2.0, "line 3")
    assert [row[3] for row in left.new_from_last] == [0.1, 0.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.json", "[]", "holds no candidates"),
        ("a.json", '[{"kind": "fly"}]', '"kind"'),
        ("a.json", '[{"kind": "turn", "turn_deg": 3, "cost": 0}]', "cost must be positive"),
        ("a.json", '[{"kind": "pose", "new_from_last": [1, 2]}]', "16 numbers"),
        ("a.json", json.dumps([{"kind": "pose", "new_from_last": [1.0] * 16}]), "rigid"),
        ("a.csv", "name,cost\n", "no column 'tx'"),
        ("a.csv", "name,cost,tx,ty,tz,qx,qy,qz,qw\na,1,x,0,0,0,0,0,1\n", "line 2"),
        ("a.csv", "name,cost,tx,ty,tz,qx,qy,qz,qw\na,1,0,0,0,0,0,0,0\n", "unit quaternion"),
    ],
)
def test_files_that_say_nothing_usable_are_refused(tmp_path: Path, name: str, text: str, words: str) -> None:
    (tmp_path / name).write_text(text)
    with refused(words):
        read_candidates(tmp_path / name)
