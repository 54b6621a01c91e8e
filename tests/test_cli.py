"""The command line: what goes where, how commands end, what they leave, and what `build` remarks at its end."""

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from command_runner import BOX, FILES, Run

from modeler import priors, se3
from modeler.cli import main
from modeler.composition import compose
from modeler.composition.compose import comes_back
from modeler.composition.options import PriorOptions
from modeler.export import RunFolder, model_upright
from modeler.sequences import bundled, open_sequence
from modeler.types import ACCEPTED, Outcome
from modeler.verdict.advice import measured_step, sign_is_ambiguous, visible_frames

TUBE = bundled("tube")
QUICK = ("--prior", "table", "--voxel-m", "0.004", "--frames", "0:3")


@pytest.fixture(scope="module")
def box(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene that says what is known of its camera and motion."""
    folder = shutil.copytree(scene, tmp_path_factory.mktemp("known") / "box")
    shutil.copy(bundled("box") / "sequence.json", folder)
    return folder


@pytest.fixture(scope="module")
def built(box: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("built") / "run"
    assert main(["build", str(box), "--out", str(folder), *QUICK]) == 0
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    """Return what must not depend on when a run was made."""
    return {name: (folder / name).read_bytes() for name in FILES - {"recording.rrd", "report.json"}}


def report(folder: Path) -> dict:
    return json.loads((folder / "report.json").read_bytes())


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ((), "no command"),
        (("frobnicate", "x"), "'frobnicate'"),
        (("biuld", "x"), "'build'?"),
        (("build", "SCENE"), "--out"),
        (("build", "SCENE", "--out", "OUT", "--frob"), "--frob"),
        (("build", "SCENE", "--out", "OUT", "--prio", "table"), "--prior NAME"),
        (("build", "SCENE", "--out", "OUT", "--intrinsics", "2", "2", "2", "2"), "--intrinsics"),
        (("build", "SCENE", "--out"), "'--out'"),
        (("--verson",), "'--verson'"),
        (("build", "SCENE", "--out", "OUT", "--step-deg", "0.3rad"), "--step-deg"),
        (("build", "SCENE", "--out", "OUT", "--max-offset-m", "40"), "at most 5\n"),
        (("build", "SCENE", "--out", "OUT", "--voxel-m", "0"), "--voxel-m 0 is out of range"),
        (("build", "SCENE", "--out", "OUT", "--method", "magic"), "'magic'"),
        (("export", "OUT", "--out", "OUT.glb", "--tint", "red"), "'red'"),
        (("register", "SCENE", "one", "0"), "SOURCE: "),
        (("build", "SCENE", "--out", "OUT", "--prior", "magic"), "'general', 'table'"),
        (("build", "SCENE", "--out", "OUT", "--roi", "1", "2", "3"), "--roi"),
        (("build", "SCENE", "--out", "OUT", "--every", "0"), "--every 0"),
        (("build", "SCENE", "--out", "OUT", "--frames", "1-3"), "--frames '1-3'"),
        (("build", "SCENE", "--out", "OUT", "--frames", "50:60"), "0 to 2"),
        (("build", "SCENE", "--out", "OUT", "--frames", "0:" + "9" * 5000), "--frames"),
        (("build", "SCENE", "--out", "OUT", "--seed", "-1"), "--seed: "),
        (("build", "SCENE", "--out", "OUT", "--prior", "table", "--max-offset-m", "1"), "--max-offset-m"),
        (("build", "SCENE", "--out", "OUT", "--prior", "table+table"), "names table twice"),
        (("build", "SCENE", "--out", "OUT", "--prior", "held"), "no robot.txt"),
        (("build", "SCENE", "--out", "OUT", "--prior", "poke"), "--poke-point-m"),
        (("build", "SCENE", "--out", "OUT", "--prior", "turntable", "--step-deg", "0"), "--step-deg 0"),
        (("build", "SCENE", "--out", "OUT", "--prior", "turntable", "--step-sigma-deg", "-1"), "--step-sigma-deg -1"),
        (("build", "SCENE", "--out", "OUT", "--prior", "turntable", "--step-sigma-deg", "0"), "--step-sigma-deg 0"),
        (("build", "SCENE", "--out", "OUT", "--prior", "turntable", "--axis-sigma-m", "0"), "--axis-sigma-m 0"),
        (
            ("build", "SCENE", "--out", "OUT", "--prior", "turntable", "--axis-direction", "0", "0", "0"),
            "--axis-direction",
        ),
        (("build", "SCENE", "--out", "OUT", "--prior", "turntable", "--held-sigma-m", "1"), "--held-sigma-m"),
        (("build", "SCENE", "--out", "OUT", "--max-rotation-deg", "nan"), "--max-rotation-deg nan"),
        (("build", "SCENE", "--out", "OUT", "--max-rotation-deg", "181"), "--max-rotation-deg 181"),
        (("build", "SCENE", "--out", "OUT", "--resume", "--overwrite"), "--resume"),
        (("build", "SCENE", "--model", "NOWHERE", "--out", "OUT", "--voxel-m", "0.002"), "leave out --voxel-m\n"),
        (("build", "NOWHERE", "--out", "OUT"), "NOWHERE"),
        (("register", "SCENE", "0", "99"), "no frame 99"),
        (("register", "SCENE", "2", "2"), "both frame 2"),
        (("register", "SCENE", "0", "1", "--roi", "160", "0", "175", "9"), "160 x 120"),
        (("register", "SCENE", "0", "1", "--roi", "150", "0", "161", "9"), "--roi 150 0 161 9"),
        (("build", "SCENE", "--out", "OUT", "--roi", "0", "0", "160", "121"), "--roi 0 0 160 121"),
        (("build", "SCENE", "--out", "OUT", "--roi", "0", "120", "9", "125"), "--roi 0 120 9 125"),
        (("register", "SCENE", "0", "1", "--max-depth-m", "0.1"), "too few points"),
        (("evaluate", "--out", "OUT"), "no sequence"),
        (("evaluate", "SCENE", "--out", "OUT", "--methods", "icp,magic"), "'magic'"),
        (("evaluate", "SCENE", "--out", "OUT", "--offsets", "0"), "--offsets 0"),
        (("evaluate", "SCENE", "--out", "OUT", "--offsets", "1,3"), "--offsets 3"),
        (("evaluate", "SCENE", "--out", "OUT", "--points", "0"), "--points 0"),
        (("build", "SCENE", "--out", "OUT", "--connect", "nowhere"), "--connect nowhere"),
        (("report", __file__, "--out", "OUT"), "no report"),
        (("evaluate", "SCENE", "--out", "OUT", "--roi", "0", "120", "9", "125"), "--roi 0 120 9 125"),
        (("render", "nothing", "--out", "OUT"), "box"),
        (("view", "NOWHERE"), "NOWHERE"),
        (("info", str(TUBE.parent)), "box, flashlight, tube"),
        (("convert", "SCENE", "--out", "OUT.txt"), "is not a run folder"),
        (("export", "NOWHERE", "--out", "OUT.glb"), "NOWHERE"),
        (("export", "SCENE", "--out", "OUT.glb"), "no report"),
    ],
)
def test_unusable_input_gives_status_2_and_one_line(
    refusal: Callable[..., str], scene: Path, tmp_path: Path, arguments: tuple[str, ...], says: str
) -> None:
    places = {name: tmp_path / name for name in ("OUT", "OUT.glb", "OUT.txt", "NOWHERE")} | {"SCENE": scene}
    assert says in refusal(*(places.get(argument, argument) for argument in arguments))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("arguments", [(), ("build",)])
def test_a_reader_who_has_left_is_no_error(arguments: tuple[str, ...]) -> None:
    ours, theirs = os.pipe()
    os.close(ours)
    command = [sys.executable, "-m", "modeler", *arguments, "--help"]
    ended = subprocess.run(command, stdout=theirs, stderr=subprocess.PIPE, text=True, check=False)
    os.close(theirs)
    assert (ended.returncode, ended.stderr) == (1, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
@pytest.mark.parametrize("arguments", [("--help",), ("--version",), ("info", "SCENE")])
def test_a_full_disk_under_stdout_is_reported_in_one_line(
    refusal: Callable[..., str], scene: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...]
) -> None:
    with Path("/dev/full").open("w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        said = refusal(*(scene if argument == "SCENE" else argument for argument in arguments))
    assert "No space left on device" in said


def test_register_prints_one_edge_the_same_for_the_same_seed(cli: Run, scene: Path) -> None:
    ended = cli("register", scene, "1", "0", "--prior", "table", "--seed", "5")
    assert ended.status == 0
    edge = json.loads(ended.out)
    assert (edge["source"], edge["target"], edge["kind"], edge["outcome"]) == (1, 0, "odometry", "converged")
    assert "seconds" not in edge
    truth = open_sequence(scene).truth()
    found = np.array(edge["target_from_source"]).reshape(4, 4)
    error = se3.inverse(truth[0] @ se3.inverse(truth[1])) @ found
    assert np.degrees(se3.rotation_angle(error)) < 2.0
    covariance = np.array(edge["covariance"]).reshape(6, 6)
    assert np.array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance)[0] > 0.0
    assert cli("register", scene, "1", "0", "--prior", "table", "--seed", "5").out == ended.out
    assert cli("register", scene, "1", "0", "--prior", "table", "--seed", "6").out != ended.out


def test_the_sequence_says_what_is_known_and_the_user_is_informed(cli: Run, box: Path, tmp_path: Path) -> None:
    given = cli("register", box, "1", "0", "--method", "icp")
    assert given.status == 0
    assert "prior table" in given.err
    assert given.out == cli("register", box, "1", "0", "--method", "icp", "--prior", "table").out
    given = cli("register", box, "1", "0", "--method", "icp", "--prior", "turntable")
    assert "step 25°" in given.err
    ended = cli("build", box, "--out", tmp_path / "run", "--method", "icp", "--voxel-m", "0.004", "--frames", "0:2")
    assert ended.err.startswith("modeler: prior table")
    assert report(tmp_path / "run")["prior"] == "table"


def test_register_gives_the_edge_that_build_finds(cli: Run, box: Path, built: Path) -> None:
    edge = json.loads(cli("register", box, "1", "0", *QUICK[:2]).out)
    found = report(built)["edges"][0]
    for name in ("source", "target", "outcome", "target_from_source", "covariance", "overlap"):
        assert edge[name] == found[name]


def test_build_fills_a_run_folder(built: Path) -> None:
    assert {path.name for path in built.iterdir()} == FILES | {".pairs.done"}
    given = report(built)
    assert (given["schema"], given["seed"], given["prior"]) == (2, 0, "table")
    assert given["settings"] == {"method": "visibility", "colour": True, "voxel_m": 0.004, "every": 1, "frames": "0:3"}
    assert (given["complete"], given["trustworthy"], given["reasons"]) == (True, True, [])
    assert [(frame["id"], frame["outcome"]) for frame in given["frames"]] == [(k, "accepted") for k in range(3)]
    edges = {(edge["source"], edge["target"]): edge["accepted"] for edge in given["edges"]}
    assert {(1, 0), (2, 1)} <= set(edges)
    assert all(edges.values())
    poses = np.array([pose["object_from_camera"] for pose in given["poses"]]).reshape(-1, 4, 4)
    assert np.allclose(poses[0], np.eye(4), atol=1e-9)
    assert given["seconds"]["total"] > given["seconds"]["registration"] > 0.0
    assert len((built / "trajectory.txt").read_text().splitlines()) == 3
    mesh = trimesh.load_mesh(built / "model.ply")
    assert 0.1 < np.linalg.norm(mesh.extents) < 0.6
    assert (built / "recording.rrd").stat().st_size > 100_000


def test_build_says_nothing_on_stdout_and_two_lines_on_stderr(cli: Run, box: Path, tmp_path: Path) -> None:
    ended = cli("build", box, "--out", tmp_path / "run", *QUICK[:-1], "0:2")
    assert (ended.status, ended.out) == (0, "")
    assert re.fullmatch(
        r"modeler: 2 of 2 frames, no loop closed, \d+ s: .*\nmodeler: the model can be trusted to .* mm\n", ended.err
    )


def test_same_seed_same_bytes_and_nothing_is_replaced_unasked(cli: Run, box: Path, built: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(built, folder)
    (folder / "model.ply").write_text("an earlier model")
    (folder / "notes.txt").write_text("the user's own")
    refused = cli("build", box, "--out", folder, *QUICK)
    assert refused.status == 2
    assert (folder / "model.ply").read_text() == "an earlier model"
    assert {path.name for path in folder.iterdir()} == FILES | {"notes.txt", ".pairs.done"}
    assert cli("build", box, "--out", folder, *QUICK, "--overwrite").status == 0
    assert contents(folder) == contents(built)
    assert (folder / "notes.txt").read_text() == "the user's own"


def test_a_run_that_loses_frames_ends_with_status_3_and_says_why(cli: Run, box: Path, tmp_path: Path) -> None:
    ended = cli("build", box, "--out", tmp_path, *QUICK, "--max-depth-m", "0.1")
    assert (ended.status, ended.out) == (3, "")
    assert f"frame 0 is left out: {Outcome.TOO_FEW_POINTS.label}" in ended.err
    given = report(tmp_path)
    assert not given["trustworthy"]
    assert given["complete"]
    assert [frame["outcome"].partition(":")[0] for frame in given["frames"]] == [Outcome.TOO_FEW_POINTS.label] * 3
    reasons = dict(zip(given["reason_codes"], given["reasons"], strict=True))
    assert reasons["left_out"].startswith("frames 0 to 2 ")
    assert {path.name for path in tmp_path.iterdir()} == FILES - {"model.ply", "cloud.ply"}


@pytest.mark.parametrize(
    "arguments", [("register", TUBE, 1, 0), ("build", TUBE), ("evaluate", TUBE, "--frames", "0:2", "--prior", "table")]
)
def test_coloured_icp_refuses_what_has_no_colour(
    refusal: Callable[..., str], tmp_path: Path, arguments: tuple[object, ...]
) -> None:
    named = ("--methods" if arguments[0] == "evaluate" else "--method", "coloured-icp")
    out = () if arguments[0] == "register" else ("--out", tmp_path / "out")
    assert "has no colour" in refusal(*arguments, *named, *out)
    assert not (tmp_path / "out" / "report.json").exists()


@pytest.mark.parametrize("arguments", [("register", TUBE, 1, 0), ("evaluate", TUBE, "--prior", "table")])
def test_kiss_is_refused_where_it_is_not_installed(
    refusal: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[object, ...]
) -> None:
    monkeypatch.setitem(sys.modules, "kiss_matcher", None)
    named = ("--methods", "kiss", "--out", tmp_path / "out") if arguments[0] == "evaluate" else ("--method", "kiss")
    assert "-m pip install 'modeler[peers]'" in refusal(*arguments, *named)


def test_evaluate_writes_errors_and_prints_a_table(cli: Run, box: Path, tmp_path: Path) -> None:
    ended = cli("evaluate", box, "--out", tmp_path, "--methods", "icp,gicp", "--frames", "0:3", "--prior", "table")
    assert (ended.status, ended.err) == (0, "")
    rows = ended.out.splitlines()
    assert [row.split()[:5] for row in rows[1:]] == [["box", name, "1", "2", "2"] for name in ("icp", "gicp")]
    assert len({len(row) for row in rows}) == 1
    assert {path.name for path in tmp_path.iterdir()} == {"results.json", "results.csv", "rotation_errors.png"}
    assert len(json.loads((tmp_path / "results.json").read_bytes())["trials"]) == 4


@pytest.mark.parametrize("suffix", ["ply", "obj", "glb", "stl"])
def test_export_keeps_the_mesh(cli: Run, built: Path, tmp_path: Path, suffix: str) -> None:
    whole = ("--triangles", "1000000") if suffix == "stl" else ()  # a mesh without colours is simplified otherwise
    ended = cli("export", built, "--out", tmp_path / f"box.{suffix}", *whole)
    assert (ended.status, ended.out) == (0, "")
    lines = ended.err.splitlines()
    assert re.fullmatch(rf"modeler: \d+ triangles: \S+/box\.{suffix}", lines[0])
    assert f"box.{suffix}.pose.json" in lines[1]
    mesh, original = (trimesh.load_mesh(path) for path in (tmp_path / f"box.{suffix}", built / "model.ply"))
    assert len(mesh.faces) == len(original.faces)
    up = 1 if suffix == "glb" else 2
    assert mesh.bounds[0, up] == pytest.approx(0.0, abs=4e-3)  # on its support
    pose = json.loads((tmp_path / f"box.{suffix}.pose.json").read_text())["object_from_mesh"]
    mesh.apply_transform(np.reshape(pose, (4, 4)))
    assert np.allclose(mesh.bounds, original.bounds, atol=1e-5)


def test_export_at_the_camera_keeps_the_coordinates_of_the_run(cli: Run, built: Path, tmp_path: Path) -> None:
    assert cli("export", built, "--out", tmp_path / "box.ply", "--origin", "camera").status == 0
    assert (tmp_path / "box.ply").read_bytes() == (built / "model.ply").read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["box.ply"]
    assert cli("export", built, "--out", tmp_path / "box.glb", "--origin", "camera").status == 0
    mesh, original = (trimesh.load_mesh(path) for path in (tmp_path / "box.glb", built / "model.ply"))
    turn = np.diag([1.0, -1.0, -1.0, 1.0])
    turn[:3, :3] @= model_upright(RunFolder(built).report()).T
    original.apply_transform(turn)
    assert np.allclose(mesh.bounds, original.bounds, atol=1e-5)
    assert cli("export", built, "--out", tmp_path / "obj_000001.ply", "--bop", "--up", "z").status == 2


def test_a_rendered_sequence_can_be_opened(cli: Run, tmp_path: Path) -> None:
    recipe = {
        "name": "small",
        "object": {"kind": "box", "size_m": [0.12, 0.2, 0.06]},
        "trajectory": {"kind": "tabletop", "frames": 3},
        "view": {"width": 96, "height": 72, "focal_px": 86.0},
    }
    path = tmp_path / "small.json"
    path.write_text(json.dumps(recipe))
    ended = cli("render", path, "--out", tmp_path / "small", "--seed", "3")
    assert (ended.status, ended.out) == (0, ""), ended.err
    assert len(open_sequence(tmp_path / "small")) == 3
    assert cli("render", path, "--out", tmp_path / "small").status == 2


# What `build` remarks on at its end.


def test_a_step_between_numbers_that_leave_some_out_is_reported_as_a_step_between_frames() -> None:
    options, whole = PriorOptions(prior="turntable", step_deg=-10.0), open_sequence(BOX)
    assert compose.resolved_prior(options, whole) == ("turntable", "")
    _, remark = compose.resolved_prior(options, whole.select(every=3))
    assert [words for words in ("by 3", "-10°", "-30°") if words not in remark] == []
    assert compose.resolved_prior(PriorOptions(prior="table"), whole.select(every=3)) == ("table", "")


@pytest.mark.parametrize(
    ("frames", "given_deg", "expected"),
    [
        (slice(0, 14), None, False),  # 13 steps of 25°, as sequence.json says, and 35° to go
        (slice(0, 14), 27.0, True),
        (slice(0, 14), -27.0, True),
        (slice(0, 8), 50.0, True),
        (slice(0, 8), 25.0, False),
    ],
)
def test_a_turn_that_is_given_by_hand_counts_more(frames: slice, given_deg: float | None, *, expected: bool) -> None:
    given = [priors.GeneralPrior()]
    if given_deg is not None:
        table = priors.TurntablePrior(given_deg)
        given = [table, priors.ProductPrior(priors.GeneralPrior(), table), priors.VelocityPrior(table)]
    for prior in given:
        assert comes_back(open_sequence(BOX).select(frames=frames), prior, reach_deg=20.0) is expected


def test_a_table_that_turns_the_other_way_is_doubted() -> None:
    lost = {"frames": [{"cause": ""}, {"cause": Outcome.NO_OVERLAP.label}], "reason_codes": ["left_out"]}
    known, unknown = (priors.TurntablePrior(-25.0, 3.0, step_sign=sign) for sign in ("known", "unknown"))
    assert sign_is_ambiguous(lost, known)
    assert not sign_is_ambiguous(lost, unknown)
    assert not sign_is_ambiguous(lost, priors.TablePrior())
    assert not sign_is_ambiguous({"frames": [], "reason_codes": ["interrupted"]}, known)


def test_a_step_that_the_views_contradict_is_reported() -> None:
    def steps(turn_deg: float, count: int = 4, gap: int = 1) -> list[dict]:
        turn = se3.exp(np.array([0.0, np.radians(turn_deg), 0.0, 0.0, 0.0, 0.0]))
        modes = [{"weight": 1.0, "weight_in_graph": None}]
        covariance = np.diag(np.repeat([np.radians(0.5), 1e-3], 3) ** 2).ravel().tolist()
        edge = {"accepted": True, "kind": "odometry", "target_from_source": turn.ravel().tolist()}
        edge |= {"covariance": covariance, "modes": modes}
        return [edge | {"source": gap * (k + 1), "target": gap * k} for k in range(count)]

    prior = priors.TurntablePrior(-30.0, 2.0)
    said = measured_step(steps(15.0), prior)
    assert [words for words in ("15.0°", "30° ± 2°", "`step_deg` -15.0") if words not in said] == []
    assert "turned by 15.0°" in measured_step(steps(45.0, gap=3), prior)
    again = [edge | {"source": edge["target"], "target": edge["source"]} for edge in steps(-29.0)[:1]]
    assert measured_step(steps(29.0) + again, prior) == ""  # a frame that was tried again lies before its target
    assert "turned by 15.0°" in measured_step(steps(15.0) + again, prior)
    lost = {"accepted": False, "kind": "odometry", "source": 9, "target": 8, "target_from_source": np.eye(4).tolist()}
    both_senses = steps(50.0, count=2) + steps(-43.0)[2:]
    unsure = [edge | {"modes": [{"weight": w, "weight_in_graph": w} for w in (0.8, 0.2)]} for edge in steps(15.0)]
    wide = np.diag(np.repeat([np.radians(8.0), 1e-3], 3) ** 2).ravel().tolist()
    uncertain = [edge | {"covariance": wide} for edge in steps(15.0)]
    few = steps(15.0, count=2)
    for edges in (steps(25.0), steps(90.0, gap=3), few, [lost] * 5, [], both_senses, unsure, uncertain):
        assert measured_step(edges, prior) == ""
    assert measured_step(steps(15.0), priors.TablePrior()) == ""
    still = measured_step(steps(0.02), prior)
    assert "turned by 0.0°" in still
    assert "`step_deg`" not in still  # which refuses 0
    assert "turned by 15.0°" in measured_step(steps(15.0), priors.ProductPrior(priors.GeneralPrior(), prior))


def test_frames_before_the_object_came_are_reported() -> None:
    few, lost = Outcome.TOO_FEW_POINTS.label, Outcome.NO_OVERLAP.label

    def said(*outcomes: str) -> str:
        return visible_frames([{"id": 2 * place, "cause": cause} for place, cause in enumerate(outcomes)])

    assert "`frames` 4: " in said(few, few, ACCEPTED, lost, ACCEPTED)
    assert "`frames` :7 " in said(ACCEPTED, few, lost, ACCEPTED, few)
    assert "`frames` 2:5 " in said(few, ACCEPTED, ACCEPTED, few)
    for whole in ((ACCEPTED, few, ACCEPTED), (lost, ACCEPTED, lost), (few, few, few), (few, ACCEPTED), ()):
        assert said(*whole) == ""


@pytest.mark.parametrize(("hand", "given"), [(0, True), (1, True), (2, True), (3, False), (4, False)])
def test_frames_without_a_hand_are_not_said_to_lack_the_object(hand: int, given: bool) -> None:
    """Where a hand is taken for the object, its masks are unsure, and nothing is found in the frames that lack it."""
    few = {"cause": Outcome.TOO_FEW_POINTS.label, "mask": Outcome.TOO_FEW_POINTS.label}
    masks = [Outcome.UNSURE_MASK] * hand + [Outcome.CONVERGED] * (4 - hand)
    frames = [few, *({"cause": "", "mask": mask.label} for mask in masks)]
    assert bool(visible_frames([frame | {"id": place} for place, frame in enumerate(frames)])) is given
